"""The compiled library of the renderer, and its sources: `build` compiles them."""

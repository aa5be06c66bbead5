"""A whole compression of trained scenes, step by step, on photographs that were held out."""

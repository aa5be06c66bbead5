# SPDX-License-Identifier: Apache-2.0
"""Render on a GPU, from models or from the integers of `.csplat` files.

`device` opens a GPU, `packing` writes the layout that the shaders read, `renderer` runs the passes, and `scoring`
compares two scenes.
"""

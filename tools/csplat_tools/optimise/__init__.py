"""The one search: the file of a scene that keeps to a target, by every move that files have.

`target` and `bounds` want no renderer.
"""

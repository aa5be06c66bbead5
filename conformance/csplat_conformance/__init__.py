"""Conformance vectors of the csplat format: what a file must decode to, and why a broken one is refused.

The vectors and the manifest are dedicated to the public domain (CC0 1.0). They come from `recipes`, which
writes every byte itself (`builder`) and computes every expected number itself (`reference`): neither our
encoder nor our decoder has a part in them.
"""

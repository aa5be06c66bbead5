"""Conformance vectors of the csplat format: what a file must decode to, and why a broken one is refused.

The vectors and the manifest are dedicated to the public domain (CC0 1.0). They come from
`csplat_authoring`, which a checkout has, and which writes every byte and computes every expected number itself.
"""

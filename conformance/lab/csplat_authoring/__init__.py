# SPDX-License-Identifier: CC0-1.0
"""Authoring of the vectors: `python -m csplat_authoring` writes them, the manifest, and annexes A and C of the spec.

`builder` writes every byte and `reference` computes every expected number, without our encoder and decoder. Only in a
checkout, not in the wheel.
"""

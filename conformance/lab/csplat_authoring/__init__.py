# SPDX-License-Identifier: CC0-1.0
"""Authoring of the vectors: `python -m csplat_authoring` writes them, their manifest and two pages.

`builder` writes every byte and `reference` computes every expected number, without our encoder and decoder. Only in a
checkout, not in the wheel.
"""

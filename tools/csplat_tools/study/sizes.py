"""Sizes of a scene in raw float32, or in codebooks and indices: the rule of studies without an entropy coder."""

from __future__ import annotations

from collections.abc import Iterable

_FLOAT_BYTES = 4


def attribute_floats(sh_degree: int) -> dict[str, int]:
    """Return the values per splat of each attribute at an SH degree: 14 in all at degree 0, 23 at degree 1."""
    return {"means": 3, "quats": 4, "scales": 3, "opacities": 1, "sh0": 3, "shN": 3 * ((sh_degree + 1) ** 2 - 1)}


def raw_bytes(floats: int, rows: int) -> int:
    """Return the bytes of `rows` rows of `floats` float32 values."""
    return _FLOAT_BYTES * floats * rows


def index_bits(sizes: Iterable[int]) -> int:
    """Return the bits of one splat's indices into codebooks of these sizes: ceil(log2 K) each."""
    return sum((size - 1).bit_length() for size in sizes)

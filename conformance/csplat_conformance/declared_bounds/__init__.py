# SPDX-License-Identifier: CC0-1.0
"""Verify declared error bounds: the errors that a file declares against its source (spec 5.5, chunk SERR).

    >>> from csplat_conformance.declared_bounds import Source, verify_bounds
    >>> verify_bounds(Source.of(model), scene.model, scene.header, scene.declared_bounds).holds     # doctest: +SKIP
    True

`csplat verify` and the encoder suite use this package. Our encoder measures errors with separate code.
"""

from __future__ import annotations

from csplat_conformance.declared_bounds.bounds_verification import (
    BoundsVerification,
    MeasureVerification,
    WorstSplat,
    verify_bounds,
    verify_bounds_by_tile,
)
from csplat_conformance.declared_bounds.measurement import Source, check_source_index, find_wrong_extras, measure_pairs
from csplat_conformance.declared_bounds.partners import find_partners, lattice_radii
from csplat_conformance.declared_bounds.tile_pairs import comparison_bytes, measure_pairs_by_tile, splats_in_memory

__all__ = [
    "BoundsVerification",
    "MeasureVerification",
    "Source",
    "WorstSplat",
    "check_source_index",
    "comparison_bytes",
    "find_partners",
    "find_wrong_extras",
    "lattice_radii",
    "measure_pairs",
    "measure_pairs_by_tile",
    "splats_in_memory",
    "verify_bounds",
    "verify_bounds_by_tile",
]

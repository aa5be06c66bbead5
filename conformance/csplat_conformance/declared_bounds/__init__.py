"""Verify declared error bounds: the errors that a file states against its source (spec 5.5, chunk SERR).

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
)
from csplat_conformance.declared_bounds.measurement import Source, check_source_index, find_wrong_extras, measure_pairs
from csplat_conformance.declared_bounds.out_of_core_verification import PartSizes, fits_memory, verify_out_of_core
from csplat_conformance.declared_bounds.partners import find_partners, lattice_radii

__all__ = [
    "BoundsVerification",
    "MeasureVerification",
    "PartSizes",
    "Source",
    "WorstSplat",
    "check_source_index",
    "find_partners",
    "find_wrong_extras",
    "fits_memory",
    "lattice_radii",
    "measure_pairs",
    "verify_bounds",
    "verify_out_of_core",
]

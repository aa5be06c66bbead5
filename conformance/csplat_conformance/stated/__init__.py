"""Stated errors: what they are measured against, how, and how far a checker lets them be off (spec 5.5).

    >>> from csplat_conformance.stated import Source, prove
    >>> prove(Source.of(model), scene.model, scene.header, scene.stated_errors).holds     # doctest: +SKIP
    True

`csplat verify` and the encoder suite judge by this package; our encoder measures apart from it.
"""

from __future__ import annotations

from csplat_conformance.stated.by_disk import PartSizes, fits_memory, prove_by_disk
from csplat_conformance.stated.matching import lattice_radii, match
from csplat_conformance.stated.pairs import check_source_index, measure_pairs, wrong_extras
from csplat_conformance.stated.proof import prove
from csplat_conformance.stated.source import Source
from csplat_conformance.stated.verdict import MeasureProof, Proof, Worst

__all__ = [
    "MeasureProof",
    "PartSizes",
    "Proof",
    "Source",
    "Worst",
    "check_source_index",
    "fits_memory",
    "lattice_radii",
    "match",
    "measure_pairs",
    "prove",
    "prove_by_disk",
    "wrong_extras",
]

"""Warn of files that are legal and honest, but coarser than anyone is likely to intend; they still pass.

Centres of the inputs keep a distance (`Input.apart`):

| what | warned beyond | csplat's coarsest preset reaches |
|---|---|---|
| means, largest error | a quarter of `apart` | 0.07 |
| covariance, largest | 1.15 | 0.63 |
| covariance, rms | 0.65 | 0.31 |
| opacities, largest | 0.25 | 0.12 |
| sh0 and bands, largest | 0.3, or a 25th of the source's largest coefficient | 0.13 |
| splats left out | a quarter | 0 |

A rotation that is quite another one gives a covariance error of 1.41 for needles, and some 1.1 for splats as thick as
most here: it is needles that show it.
"""

from __future__ import annotations

import numpy as np

from csplat_conformance.encoders.inputs import Input
from csplat_conformance.stated import MeasureProof, Proof, Source

MEANS_OF_APART = 0.25
COVARIANCE_MAX, COVARIANCE_RMS = 1.15, 0.65
OPACITIES_MAX = 0.25
SH_MAX, SH_OF_LARGEST = 0.3, 0.04
PRUNED_MAX = 0.25


def coarse_errors(one: Input, source: Source, proof: Proof) -> dict[str, str]:
    """Return by measure a line for each stated error that is beyond its bound."""
    lines: dict[str, str] = {}
    for measure in proof.measures:
        if measure.stated_max is None or measure.stated_rms is None:
            continue
        bound = _bound(measure, one, source)
        if measure.stated_max > bound:
            coarse = "coarse, or a wrong rotation" if measure.name == "covariance" else "coarse"
            what = f"an error of {measure.stated_max:.3g}, beyond {bound:.3g} is {coarse}{_whose(measure)}"
        elif measure.name == "covariance" and measure.stated_rms > COVARIANCE_RMS:
            what = f"an rms of {measure.stated_rms:.3g}, beyond {COVARIANCE_RMS:g} is coarse"
        else:
            continue
        lines[measure.name] = f"{measure.name}: {what}"
    return lines


def coarse_pruning(missing: int, count: int) -> str:
    """Return a line if much of an input was left out."""
    if missing <= PRUNED_MAX * count:
        return ""
    return f"{missing} of {count} splats left out"


def _bound(measure: MeasureProof, one: Input, source: Source) -> float:
    if measure.name == "means":
        return MEANS_OF_APART * one.apart
    if measure.name == "covariance":
        return COVARIANCE_MAX
    if measure.name == "opacities":
        return OPACITIES_MAX
    largest = max(float(np.abs(array).max(initial=0.0)) for array in (source.sh0, source.shN))
    return max(SH_MAX, SH_OF_LARGEST * largest)


def _whose(measure: MeasureProof) -> str:
    worst = measure.worst
    return "" if worst is None else f": splat {worst.splat} (source splat {worst.source_splat})"

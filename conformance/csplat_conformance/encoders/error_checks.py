# SPDX-License-Identifier: CC0-1.0
"""L3: check the error bounds that a file declares, and warn of bounds that are correct but probably unintended.

Files with coarse values are valid. A warning means that the values are probably coarser than intended. `separation` is
the smallest distance between centres of the input:

| bound | warning above | csplat's coarsest preset reaches |
|---|---|---|
| means, maximum | a quarter of `separation` | 0.07 |
| covariance, maximum | 1.15 | 0.63 |
| covariance, rms | 0.65 | 0.31 |
| opacities, maximum | 0.25 | 0.12 |
| sh0 and bands, maximum | 0.3, or 4 % of the source's largest coefficient | 0.13 |
| pruned splats (`file_checks`) | a quarter | 0 |

An unrelated rotation gives a covariance error of 1.41 for needles, and about 1.1 for splats as thick as most here.

An encoder that truncates instead of rounding is valid, too, if its bounds cover the error, but its errors are twice as
large. Two signs of truncation are searched for in the measures that a file declares:

- Means and opacities lie on a lattice that the file specifies. Rounding causes errors of at most half a step,
  truncation of up to one step.
- Errors of scales, rotations and colours have either sign equally often. If nearly all have one sign, or point towards
  0, values were truncated. Equal source values count once, because their errors are equal. Values that became 0 do not
  count, because rounding also moves them towards 0.

Neither sign is a proof, because encoders that optimise rate and distortion may prefer smaller integers.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from csplat import _spec
from csplat.decoder import DecodedScene, SceneHeader
from csplat.model import SplatModel
from csplat.types import F64, I64
from csplat_conformance.conformance_report import Status
from csplat_conformance.declared_bounds import BoundsVerification, MeasureVerification, Source, verify_bounds
from csplat_conformance.encoders.encoder_inputs import EncoderInput
from csplat_conformance.encoders.encoder_run import Verdict, join_lines
from csplat_conformance.encoders.file_checks import SplatPairs

# Largest bounds without a warning; see the table above.
MEANS_PER_SEPARATION = 0.25
COVARIANCE_MAX, COVARIANCE_RMS = 1.15, 0.65
OPACITIES_MAX = 0.25
SH_MAX, SH_PER_LARGEST = 0.3, 0.04

# Signs of truncation.
STEPS_MAX = 0.75  #: lattice steps; rounding causes 0.5, or 0.71 next to alpha 0 if it searches the nearest alpha
ONE_SIDED = 0.95  #: fraction of the errors with one sign; 40 random signs are this one-sided once in 10^9 times
_TRUNCATED_STEPS_MAX = 1.05  # lattice steps; truncation causes at most 1
_VALUES_MIN = 40  # smallest number of distinct values for which signs are significant
_SINGLE_ROUNDING, _DOUBLE_ROUNDING = 2.0**-23, 2.0**-50  # relative; at least the error of reconstructing a centre
_NEGLIGIBLE = 1e-6  # relative size of a difference that rounding alone explains
_ROWS_MAX = 4096  # splats to examine
_SAME_ROTATION_MIN = 0.8  # smallest cosine of half the angle between rotations that are compared

_NOT_PAIRED = "the source splat of each splat is unknown"
_NO_BOUNDS = "the file declares no bounds"
_TRUNCATED = "truncated instead of rounded?"


def check_errors(case: EncoderInput, scene: DecodedScene, pairs: SplatPairs) -> tuple[Verdict, str]:
    """Check L3: the declared bounds hold (SER-5). Measures without a bound are not verified.

    Args:
        case: the input.
        scene: the decoded scene.
        pairs: the source splat of each decoded splat.

    Returns:
        The verdict, and the reason why only renders can check the rest; empty if they are not needed.
    """
    source = case.source() if case.source is not None else None
    if source is None or pairs.strays or pairs.surplus:
        return Verdict(Status.SKIPPED, _NOT_PAIRED), ""
    declared = scene.declared_bounds
    if declared is None:
        # An empty scene has no errors.
        return (
            (Verdict(Status.NOT_PROVED, _NO_BOUNDS), _NO_BOUNDS) if len(scene.model) else (Verdict(Status.PASSED), "")
        )
    verification = verify_bounds(source, scene.model, scene.header, declared, pairs.source_index)
    details = verification.as_json()["measures"]
    unverified = (
        f"{', '.join(verification.unverified)}: refitted, no bound is declared" if verification.unverified else ""
    )
    why = f"{', '.join(verification.unverified)} refitted" if verification.unverified and declared.refitted else ""
    if not verification.holds:
        return Verdict(Status.FAILED, join_lines(verification.failures), verification.clauses, details=details), why
    coarse = coarse_errors(case, source, verification)
    warnings = [*coarse.values()]
    if len(scene.model) and not declared.refitted:  # refitted values differ on purpose
        names = frozenset(record.measure for record in declared.records) - coarse.keys()
        warnings += find_truncation(source, scene.model, scene.header, pairs.source_index, names)
    message = join_lines((unverified, *warnings) if unverified else tuple(warnings))
    status = Status.NOT_PROVED if unverified else Status.WARNED if warnings else Status.PASSED
    return Verdict(status, message, details=details), why


def coarse_errors(case: EncoderInput, source: Source, verification: BoundsVerification) -> dict[str, str]:
    """Return a line by measure for each declared bound that deserves a warning."""
    lines: dict[str, str] = {}
    for measure in verification.measures:
        if measure.declared_max is None or measure.declared_rms is None:
            continue
        bound = _warning_threshold(measure, case, source)
        if measure.declared_max > bound:
            coarse = "coarse, or a wrong rotation" if measure.name == "covariance" else "coarse"
            what = f"an error of {measure.declared_max:.3g}, beyond {bound:.3g} is {coarse}{_worst_splat(measure)}"
        elif measure.name == "covariance" and measure.declared_rms > COVARIANCE_RMS:
            what = f"an rms of {measure.declared_rms:.3g}, beyond {COVARIANCE_RMS:g} is coarse"
        else:
            continue
        lines[measure.name] = f"{measure.name}: {what}"
    return lines


def _warning_threshold(measure: MeasureVerification, case: EncoderInput, source: Source) -> float:
    """Return the largest maximum of a measure without a warning, in its unit; see the table above."""
    if measure.name == "means":
        return MEANS_PER_SEPARATION * case.separation
    if measure.name == "covariance":
        return COVARIANCE_MAX
    if measure.name == "opacities":
        return OPACITIES_MAX
    largest = max(float(np.abs(array).max(initial=0.0)) for array in (source.sh0, source.shN))
    return max(SH_MAX, SH_PER_LARGEST * largest)


def _worst_splat(measure: MeasureVerification) -> str:
    """Return the end of a message with the worst splat, empty if it is unknown."""
    worst = measure.worst
    return "" if worst is None else f": splat {worst.splat} (source splat {worst.source_splat})"


def find_truncation(
    source: Source, decoded: SplatModel, header: SceneHeader, index: I64, declared: frozenset[str]
) -> list[str]:
    """Search for signs of truncation.

    Args:
        source: the encoded scene.
        decoded: the decoded file.
        header: header of the file.
        index: [N], source splat of each decoded splat.
        declared: names of the measures to examine.

    Returns:
        A line for each attribute that shows signs of truncation.
    """
    return [line for measure, line in _find_truncated_attributes(source, decoded, header, index) if measure in declared]


def _find_truncated_attributes(
    source: Source, decoded: SplatModel, header: SceneHeader, index: I64
) -> Iterator[tuple[str, str]]:
    """Yield a measure and a line for each attribute that shows signs of truncation; `index` is as above."""
    for measure, steps in (
        ("means", _largest_mean_steps(source, decoded, header, index)),
        ("opacities", _largest_opacity_steps(source, decoded, header, index)),
    ):
        if steps > STEPS_MAX:
            what = _TRUNCATED if steps < _TRUNCATED_STEPS_MAX else "not rounded to nearest?"
            yield measure, f"{measure}: errors up to {steps:.2f} lattice steps, expected at most 0.5: {what}"
    rows = np.linspace(0, len(decoded) - 1, min(len(decoded), _ROWS_MAX)).astype(np.int64)
    source_rows = index[rows]
    # Axes may be permuted: compare sorted scales.
    yield from _compare_one_sided(
        "covariance", "scales", *(np.sort(a, axis=1) for a in (source.scales[source_rows], decoded.scales[rows]))
    )
    yield from _compare_one_sided("covariance", "quats", *_align_quats(source.quats[source_rows], decoded.quats[rows]))
    yield from _compare_one_sided(
        "sh0", "sh0", *_select_coded_colours(source.sh0[source_rows], decoded.sh0[rows], header, _spec.ATTRIBUTE_SH0)
    )
    for band in range(1, min(decoded.sh_degree, source.sh_degree) + 1):
        coefficients = slice(band * band - 1, (band + 1) ** 2 - 1)
        pair = source.shN[source_rows, coefficients], decoded.shN[rows, coefficients]
        yield from _compare_one_sided(
            f"sh{band}", f"sh{band}", *_select_coded_colours(*pair, header, _spec.ATTRIBUTE_SH0 + band)
        )


# Steps ---------------------------------------------------------------------------------------------


def _largest_mean_steps(source: Source, decoded: SplatModel, header: SceneHeader, index: I64) -> float:
    """Return the largest error of a mean along an axis in lattice steps, less what rounding to binary32 may add.

    `index` is [N]. 0 without splats.
    """
    step = header.attribute(_spec.ATTRIBUTE_MEANS).step
    near, reach = source.about(decoded.origin), source.reach(decoded.origin)
    largest = 0.0
    for tile in header.tiles:
        rows = slice(tile.start, tile.start + tile.splat_count)
        means = decoded.means[rows].astype(np.float64)
        theirs = near.means[index[rows]].astype(np.float64)
        rounding = np.abs(means) * _SINGLE_ROUNDING + reach * _DOUBLE_ROUNDING
        errors = np.abs(means - theirs) - rounding
        largest = max(largest, float(errors.max(initial=0.0)) / math.ldexp(step, tile.exponent))
    return largest


def _largest_opacity_steps(source: Source, decoded: SplatModel, header: SceneHeader, index: I64) -> float:
    """Return the largest error in steps of alpha, or of its root if the file's mapping is SQUARE; `index` is [N]."""
    record = header.attribute(_spec.ATTRIBUTE_OPACITIES)
    ours, theirs = decoded.opacities.astype(np.float64), source.opacities[index].astype(np.float64)
    if record.mapping == _spec.MAPPING_SQUARE:
        ours, theirs = np.sqrt(ours), np.sqrt(theirs)
    return float(np.abs(ours - theirs).max(initial=0.0)) * record.levels


# Sides ---------------------------------------------------------------------------------------------


def _compare_one_sided(
    measure: str, name: str, source: NDArray[np.floating], decoded: NDArray[np.floating]
) -> Iterator[tuple[str, str]]:
    """Yield `measure` and a line about `name` if nearly all errors of two arrays of one shape have one sign.

    The errors are signed or towards 0. Too few distinct values give no line.
    """
    theirs, ours = source.astype(np.float64).ravel(), decoded.astype(np.float64).ravel()
    theirs, first = np.unique(theirs, return_index=True)
    ours = ours[first]
    kept = (ours != 0.0) & (np.abs(ours - theirs) > _NEGLIGIBLE * np.abs(theirs))
    if int(kept.sum()) < _VALUES_MIN:
        return
    ours, theirs = ours[kept], theirs[kept]
    below, towards = float((ours < theirs).mean()), float((np.abs(ours) < np.abs(theirs)).mean())
    sides = {"below": below, "above": 1.0 - below, "closer to 0 than": towards, "farther from 0 than": 1.0 - towards}
    side = max(sides, key=sides.__getitem__)
    if sides[side] >= ONE_SIDED:
        yield measure, f"{name}: {100.0 * sides[side]:.0f} % of the values are {side} the source's: {_TRUNCATED}"


def _select_coded_colours(
    source: NDArray[np.float32], decoded: NDArray[np.float32], header: SceneHeader, attribute: int
) -> tuple[F64, F64]:
    """Return what the encoder rounds of both scenes' colours, [..., 3]: R, G, B, or Co and Cg, [2, ...].

    Y is left out, because it compensates errors of the other two.
    """
    theirs, ours = source.astype(np.float64), decoded.astype(np.float64)
    if header.attribute(attribute).mapping != _spec.MAPPING_YCOCG:
        return theirs, ours
    return _chroma(theirs), _chroma(ours)


def _chroma(rgb: F64) -> F64:
    """Return Co and Cg, [2, ...], of colours [..., 3]; values no larger than rounding errors become 0."""
    r, g, b = rgb[..., 0], rgb[..., 1], rgb[..., 2]
    chroma: F64 = np.stack([r - b, g - (r + b) / 2.0])
    return np.where(np.abs(chroma) > _NEGLIGIBLE * np.abs(rgb).max(initial=0.0), chroma, 0.0)


def _align_quats(source: NDArray[np.float32], decoded: NDArray[np.float32]) -> tuple[F64, F64]:
    """Return x, y, z of both scenes' rotations, [n, 3], the source's in the axis order and sign of the file's.

    Splats whose rotations differ too much are omitted, so that n may be smaller than the number of rows.
    """
    theirs, ours = source.astype(np.float64), decoded.astype(np.float64)
    turned = np.einsum("nq,tqp->tnp", theirs, _AXIS_ROTATIONS)  # [24, n, 4]
    cosines = np.einsum("tnp,np->tn", turned, ours)
    best = np.abs(cosines).argmax(axis=0)
    rows = np.arange(len(ours))
    signs = np.sign(cosines[best, rows])[:, None]
    near = np.abs(cosines[best, rows]) > _SAME_ROTATION_MIN
    return (turned[best, rows] * signs)[near, 1:], ours[near, 1:]


def _axis_rotations() -> F64:
    """Return the rotations that map axes to axes as right factors of quaternions, [24, 4, 4]."""
    # Their quaternions have one, two or four components of equal magnitude, the others are 0.
    halves = [np.array(q, np.float64) for q in itertools.product((-1, 0, 1), repeat=4) if sum(map(abs, q)) in (1, 2, 4)]
    units = [q / np.sqrt(np.square(q).sum()) for q in halves if q[np.flatnonzero(q)[0]] > 0]  # −q is the same rotation
    return np.stack([_right_factor(q) for q in units])


def _right_factor(q: F64) -> F64:
    """Return M [4, 4] with p·M = p q for quaternions p as rows, and q [4]."""
    w, x, y, z = q
    return np.array([[w, x, y, z], [-x, w, -z, y], [-y, z, w, -x], [-z, -y, x, w]])


_AXIS_ROTATIONS = _axis_rotations()

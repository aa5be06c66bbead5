"""Signs that an encoder truncates instead of rounding: legal, honest if the stated errors cover it, twice as coarse.

Two signs are looked for, in the measures that a file states:

- means and opacities lie on a lattice that the file itself names. Rounding leaves at most half a step, `STEPS_MAX`
  leaves room for whoever rounds in another domain, cutting goes up to a whole one.
- errors of scales, rotations and colours lie on either side of the source about as often. Where `ONE_SIDED` of them or
  more lie on one, below the source or towards 0, values were cut. Equal source values err alike, so that they count
  once, and values that became 0 do not count: whatever rounds makes them smaller.

Nothing here proves anything: encoders that weigh bytes against errors may prefer smaller integers, too.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from csplat import _spec
from csplat.decoder import SceneHeader
from csplat.model import SplatModel
from csplat.types import F64, I64
from csplat_conformance.stated import Source

STEPS_MAX = 0.75  #: lattice steps; rounding leaves 0.5, and 0.71 next to alpha 0 if it looks for the nearest alpha
ONE_SIDED = 0.95  #: share of the errors with one sign; 40 fair coins are this one-sided once in 10^9 throws
_CUT_MAX = 1.05  # lattice steps: cutting alone leaves 1 at most
_ENOUGH = 40  # different values
_ROWS_MAX = 4096  # splats that are looked at: enough to see a habit
_SAME_TURN = 0.8  # smallest cosine of half the angle between two rotations that count as the same
_QUESTION = "cut instead of rounded?"


def find_cuts(
    source: Source, decoded: SplatModel, header: SceneHeader, index: I64, stated: frozenset[str]
) -> list[str]:
    """Look for them.

    Args:
        source: the encoded scene.
        decoded: the decoded file.
        header: header of the file.
        index: [N] which splat of the source each of the file is.
        stated: the measures to look at.

    Returns:
        A line for each attribute that looks cut.
    """
    return [line for measure, line in _cuts(source, decoded, header, index) if measure in stated]


def _cuts(source: Source, decoded: SplatModel, header: SceneHeader, index: I64) -> Iterator[tuple[str, str]]:
    for measure, steps in (
        ("means", _mean_steps(source, decoded, header, index)),
        ("opacities", _opacity_steps(source, decoded, header, index)),
    ):
        if steps > STEPS_MAX:
            what = _QUESTION if steps < _CUT_MAX else "not rounded to the nearest?"
            yield measure, f"{measure}: up to {steps:.2f} lattice steps off, rounding leaves 0.5: {what}"
    rows = np.linspace(0, len(decoded) - 1, min(len(decoded), _ROWS_MAX)).astype(np.int64)
    theirs = index[rows]
    # Axes may be permuted; sorted scales are rounded as well as any.
    yield from _one_sided(
        "covariance", "scales", *(np.sort(a, axis=1) for a in (source.scales[theirs], decoded.scales[rows]))
    )
    yield from _one_sided("covariance", "quats", *_same_gauge(source.quats[theirs], decoded.quats[rows]))
    yield from _one_sided("sh0", "sh0", *_coded(source.sh0[theirs], decoded.sh0[rows], header, _spec.ATTRIBUTE_SH0))
    for band in range(1, min(decoded.sh_degree, source.sh_degree) + 1):
        coefficients = slice(band * band - 1, (band + 1) ** 2 - 1)
        pair = source.shN[theirs, coefficients], decoded.shN[rows, coefficients]
        yield from _one_sided(f"sh{band}", f"sh{band}", *_coded(*pair, header, _spec.ATTRIBUTE_SH0 + band))


# Steps ---------------------------------------------------------------------------------------------


def _mean_steps(source: Source, decoded: SplatModel, header: SceneHeader, index: I64) -> float:
    """Return the largest error along an axis in steps of the tile's lattice, less what binary32 adds."""
    step = header.attribute(_spec.ATTRIBUTE_MEANS).step
    near, reach = source.about(decoded.origin), source.reach(decoded.origin)
    largest = 0.0
    for tile in header.tiles:
        rows = slice(tile.start, tile.start + tile.splat_count)
        means = decoded.means[rows].astype(np.float64)
        theirs = near.means[index[rows]].astype(np.float64)
        rounding = np.abs(means) * 2.0**-23 + reach * 2.0**-50
        errors = np.abs(means - theirs) - rounding
        largest = max(largest, float(errors.max(initial=0.0)) / math.ldexp(step, tile.exponent))
    return largest


def _opacity_steps(source: Source, decoded: SplatModel, header: SceneHeader, index: I64) -> float:
    """Return the largest error of alpha, or of its root if the levels are of roots, in steps."""
    record = header.attribute(_spec.ATTRIBUTE_OPACITIES)
    ours, theirs = decoded.opacities.astype(np.float64), source.opacities[index].astype(np.float64)
    if record.mapping == _spec.MAPPING_SQUARE:
        ours, theirs = np.sqrt(ours), np.sqrt(theirs)
    return float(np.abs(ours - theirs).max(initial=0.0)) * record.levels


# Sides ---------------------------------------------------------------------------------------------


def _one_sided(
    measure: str, name: str, source: NDArray[np.floating], decoded: NDArray[np.floating]
) -> Iterator[tuple[str, str]]:
    """Yield a line if nearly all errors lie on one side."""
    theirs, ours = source.astype(np.float64).ravel(), decoded.astype(np.float64).ravel()
    theirs, first = np.unique(theirs, return_index=True)
    ours = ours[first]
    kept = (ours != 0.0) & (np.abs(ours - theirs) > 1e-6 * np.abs(theirs))
    if int(kept.sum()) < _ENOUGH:
        return
    ours, theirs = ours[kept], theirs[kept]
    below, towards = float((ours < theirs).mean()), float((np.abs(ours) < np.abs(theirs)).mean())
    sides = {"below": below, "above": 1.0 - below, "nearer to 0 than": towards, "farther from 0 than": 1.0 - towards}
    side = max(sides, key=sides.__getitem__)
    if sides[side] >= ONE_SIDED:
        yield measure, f"{name}: {100.0 * sides[side]:.0f} % of the values lie {side} the source's: {_QUESTION}"


def _coded(
    source: NDArray[np.float32], decoded: NDArray[np.float32], header: SceneHeader, attribute: int
) -> tuple[F64, F64]:
    """Return colours as they are rounded: R, G, B, or Co and Cg, for which Y makes up."""
    theirs, ours = source.astype(np.float64), decoded.astype(np.float64)
    if header.attribute(attribute).mapping != _spec.MAPPING_YCOCG:
        return theirs, ours
    return _chroma(theirs), _chroma(ours)


def _chroma(rgb: F64) -> F64:
    r, g, b = rgb[..., 0], rgb[..., 1], rgb[..., 2]
    chroma: F64 = np.stack([r - b, g - (r + b) / 2.0])
    return np.where(np.abs(chroma) > 1e-6 * np.abs(rgb).max(initial=0.0), chroma, 0.0)  # 0 but for rounding


def _same_gauge(source: NDArray[np.float32], decoded: NDArray[np.float32]) -> tuple[F64, F64]:
    """Return x, y, z of rotations, the source's with the axes in the order and of the signs of the file's.

    Splats that are turned too far to tell are left out.
    """
    theirs, ours = source.astype(np.float64), decoded.astype(np.float64)
    turned = np.einsum("nq,tqp->tnp", theirs, _TURNS)  # [24, n, 4]
    cosines = np.einsum("tnp,np->tn", turned, ours)
    best = np.abs(cosines).argmax(axis=0)
    rows = np.arange(len(ours))
    signs = np.sign(cosines[best, rows])[:, None]
    near = np.abs(cosines[best, rows]) > _SAME_TURN
    return (turned[best, rows] * signs)[near, 1:], ours[near, 1:]


def _turns() -> F64:
    """The rotations that map axes to axes, as matrices to multiply quaternions by on the right, [24, 4, 4]."""
    halves = [np.array(q, np.float64) for q in itertools.product((-1, 0, 1), repeat=4) if sum(map(abs, q)) in (1, 2, 4)]
    units = [q / np.sqrt(np.square(q).sum()) for q in halves if q[np.flatnonzero(q)[0]] > 0]  # −q turns as q does
    return np.stack([_right(q) for q in units])


def _right(q: F64) -> F64:
    """Return M with p·M = p q for quaternions p as rows."""
    w, x, y, z = q
    return np.array([[w, x, y, z], [-x, w, -z, y], [-y, z, w, -x], [-z, -y, x, w]])


_TURNS = _turns()

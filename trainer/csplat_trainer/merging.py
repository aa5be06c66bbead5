# SPDX-License-Identifier: Apache-2.0
"""Merge pairs of splats: find pairs that are alike, and average their values.

Trainings that copy splats (MCMC) leave many copies in place: 11 to 35 % of the splats of four scenes have a neighbour
with nearly the same centre and shape. One splat can stand for both.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from csplat.encoder import covariance_entries, mean_axes
from csplat.encoder.error_bounds import SCALE_MOST
from csplat.model import SplatModel
from csplat.types import F32, F64, I64
from csplat_render.neighbours import nearest_neighbours

_NEIGHBOURS = 4  # nearest neighbours that are compared with a splat; larger groups of copies shrink in later rounds
_MOST_APART = 1.0  # largest difference of log sizes, which is far above the mismatch that is allowed
_FLATTEST = -15.0  # least log standard deviation relative to the largest, so that inverse variances stay finite
_AXES = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))  # row and column of each entry of a covariance
_MISMATCH_MAX = 1.0  # estimated error of merging above which removing a splat is better
_OPACITY_MAX = 0.9999  # of merged splats, so that their logits are finite and refits can change them
_TINY = np.finfo(np.float64).tiny


def find_alike(splats: SplatModel) -> tuple[I64, F64]:
    """Find pairs of neighbouring splats that one splat could replace.

    Args:
        splats: [N] splats with finite values.

    Returns:
        [2, P] int64, the rows of the splat to keep, which has more light (`light_of`), and of the splat to merge into
        it; a splat may be in several pairs. [P], the mismatch, 0 to 1: the squared error of merging, estimated as a
        fraction of the smaller error of removing one of them. It is the sum of the squares of the distance in standard
        deviations, of the relative difference of the covariances, and of the smaller opacity, because two equal splats
        of opacity a hide up to a² / 4 less or more than one. In three scenes the error of all merges is 0.9 to 1.8
        times the estimate.
    """
    edges = neighbour_edges(splats.means, np.zeros(len(splats), np.int64), _NEIGHBOURS)
    largest = _limited(splats.scales).max(axis=1, initial=-np.inf)
    sizes = largest[edges]
    distances = np.linalg.norm(splats.means[edges[1]].astype(np.float64) - splats.means[edges[0]], axis=1)
    # Pairs that the exact mismatch would refuse; most are, so that the rest takes little time and memory.
    is_near = np.log(np.maximum(distances, _TINY)) <= sizes.min(axis=0)
    edges = edges[:, is_near & (np.abs(sizes[0] - sizes[1]) <= _MOST_APART)]
    mismatch = _mismatch(splats, edges, largest)
    is_alike = mismatch < _MISMATCH_MAX
    edges, mismatch = edges[:, is_alike], mismatch[is_alike]
    light = light_of(splats)[edges]
    return np.where(light[0] >= light[1], edges, edges[::-1]), mismatch


def neighbour_edges(means: F32, nodes: I64, most: int) -> I64:
    """Return each splat with its up to `most` nearest neighbours in the same node, as edges.

    Args:
        means: [N, 3].
        nodes: [N], the node of each splat.

    Returns:
        [2, M] int64, the rows of both splats, the lower first; each edge once, ascending. M is 0 if each is alone.
    """
    by_node = np.argsort(nodes, kind="stable")
    sizes = np.unique(nodes, return_counts=True)[1]
    near = nearest_neighbours(means[by_node].astype(np.float64), most, sizes)[0]
    starts, k = np.nonzero(near >= 0)
    ends, starts = by_node[near[starts, k]], by_node[starts]
    keys = np.sort(np.minimum(starts, ends) * len(means) + np.maximum(starts, ends))  # one integer for both rows
    return np.stack(np.divmod(keys[np.diff(keys, prepend=-1) > 0], max(1, len(means))))


def _mismatch(splats: SplatModel, edges: I64, largest: F64) -> F64:
    """Return the mismatch of the splats of each edge; `largest` are their largest log standard deviations, [N]."""
    unit = largest[edges].max(axis=0)  # so that squares neither overflow nor vanish
    offsets = (splats.means[edges[1]].astype(np.float64) - splats.means[edges[0]]) * np.exp(-unit)[:, None]
    covariances, apart = [], np.zeros(edges.shape[1])
    for rows in edges:
        variances = np.exp(2.0 * np.maximum(_limited(splats.scales[rows]) - unit[:, None], _FLATTEST))
        covariances.append(covariance_entries(splats.quats[rows].T, variances.T))
        inverse = covariance_entries(splats.quats[rows].T, 1.0 / variances.T)
        squares = sum(
            (1.0 if i == j else 2.0) * inverse[entry] * offsets[:, i] * offsets[:, j]
            for entry, (i, j) in enumerate(_AXES)
        )
        apart = np.maximum(apart, squares)
    weights = np.array([1.0 if i == j else 2.0 for i, j in _AXES])
    norms = [weights @ np.square(entries) for entries in covariances]
    difference = weights @ np.square(covariances[0] - covariances[1]) / np.sqrt(norms[0] * norms[1])
    return np.asarray(apart + difference + np.square(splats.opacities[edges].min(axis=0).astype(np.float64)))


def merge_alike(splats: SplatModel, pairs: I64) -> SplatModel:
    """Return all splats, with the first splat of each pair standing for both at its own centre.

    Args:
        splats: [N] splats, which are not changed.
        pairs: [2, P], rows of two splats; no splat is in two pairs.
    """
    values = average_pairs(splats, pairs)
    del values["means"]
    transparency = 1.0 - splats.opacities[pairs].astype(np.float64)
    values["opacities"] = np.minimum(1.0 - transparency[0] * transparency[1], _OPACITY_MAX)
    return with_values(splats, pairs[0], values)


def average_pairs(splats: SplatModel, pairs: I64) -> dict[str, NDArray[np.floating]]:
    """Return averages of pairs, weighted by light: means, quats and scales of their covariance, sh0, shN.

    Args:
        splats: [N] splats.
        pairs: [2, P], rows of two splats.
    """
    two = [splats.select(rows) for rows in pairs]
    light = [light_of(part) for part in two]
    share = light[0] / (light[0] + light[1])

    def averaged(first: NDArray[np.floating], second: NDArray[np.floating]) -> F64:
        """Return the averages of [P, ...] values, weighted by light."""
        weights = share.reshape(-1, *[1] * (first.ndim - 1))
        return np.asarray(weights * first + (1.0 - weights) * second)

    offsets = (two[1].means.astype(np.float64) - two[0].means).T
    own_covariances = [covariance_entries(part.quats.T, np.exp(2.0 * _limited(part.scales)).T) for part in two]
    between = np.stack([offsets[i] * offsets[j] for i, j in _AXES]) * (share * (1.0 - share))  # covariance of centres
    covariances = averaged(own_covariances[0].T, own_covariances[1].T).T + between
    trace = np.maximum(covariances[:3].sum(axis=0), _TINY)
    quats, scales = mean_axes(covariances / trace)
    return {
        "means": averaged(two[0].means, two[1].means),
        "quats": quats,
        "scales": (scales + 0.5 * np.log(trace)[:, None]).astype(np.float32),
        "sh0": averaged(two[0].sh0, two[1].sh0),
        "shN": averaged(two[0].shN, two[1].shN),
    }


def with_values(splats: SplatModel, rows: I64, values: dict[str, NDArray[np.floating]]) -> SplatModel:
    """Return the splats with other values in some rows."""
    changed = {name: getattr(splats, name).copy() for name in values}
    for name, array in values.items():
        changed[name][rows] = array
    return replace(splats, **changed)


def light_of(splats: SplatModel) -> F64:
    """Return opacity × area of each splat, above 0."""
    return np.maximum(splats.opacities * mean_areas(splats.scales), _TINY)


def mean_areas(scales: F32) -> F64:
    """Return the areas [N] of projections of ellipsoids [N, 3], mean over directions, up to a factor (Knud Thomsen)."""
    a, b, c = np.exp(_limited(scales)).T
    return np.asarray((a * b + a * c + b * c) / 3.0)


def _limited(scales: F32) -> F64:
    """Return log standard deviations whose exponentials and squares are finite."""
    return np.clip(scales.astype(np.float64), -SCALE_MOST, SCALE_MOST)

# SPDX-License-Identifier: Apache-2.0
"""Merge neighbouring splats in pairs, starting with the pairs that change images least.

The cost of a pair is the squared difference between images of both splats and of the splat that replaces them, over
views along the three axes. This has a closed form, since it leaves out what splats hide.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from csplat.encoder import covariance_entries
from csplat.model import SplatModel
from csplat.spherical_harmonics import SH_C0
from csplat.types import F32, F64, I64
from csplat_render import kernels
from csplat_trainer.merging import average_pairs, light_of, mean_areas, neighbour_edges, with_values

#: Neighbours with which a splat may be merged; 16 gain 0.1 dB at level 1, and take twice as long.
NEIGHBOURS = 8
# Fraction of the splats that a pass keeps: three passes leave a quarter. With more passes, clumps of unmerged splats
# stay; with fewer, bad pairs are merged.
_KEPT = 0.629
# A cost is divided by this power of the squared sum of both images. With 0, all small splats are merged before any
# large splat; with 1, size does not count.
_ENERGY_EXPONENT = 0.6
# Merged splats keep opacity × area. What an opacity above 0.99 would have to carry goes into the area with this power:
# all of it hides too much, and none of it leaves holes.
_GROWTH = 0.5
_OPACITY_MAX = 0.99  # alpha that renderers cap at
_THINNEST = 1e-3  # least standard deviation, divided by the largest, so that a flat splat has an image from the side
_SINGULAR = 1e-12  # least determinant of a covariance, divided by the product of its variances
_BLOCK = 1 << 14  # edges at once, so that temporary arrays stay in the cache
_VIEWS = (((0, 1), (0, 3, 1)), ((0, 2), (0, 4, 2)), ((1, 2), (1, 5, 2)))  # axes of an image, entries of its covariances
_TINY = np.finfo(np.float64).tiny


def merge_neighbours(
    splats: SplatModel, nodes: I64, count: int, neighbours: int = NEIGHBOURS
) -> tuple[I64, SplatModel]:
    """Merge splats of the same node until `count` splats are left, or one in each node.

    Args:
        splats: the splats.
        nodes: [N], the node of each splat.
        count: number of splats to keep, from 1.
        neighbours: number of nearest neighbours with which a splat may be merged in a pass.

    Returns:
        The node of each splat that is left, and the splats, without extra columns. Means, covariances and SH of merged
        splats are averages by opacity × area, the sum of which they keep.
    """
    splats = replace(splats, extra={}, means_double=None)
    while len(splats) > count:
        kept_count = max(count, math.floor(_KEPT * len(splats)))
        pairs = _choose_pairs(splats, nodes, len(splats) - kept_count, neighbours)
        if not len(pairs[0]):
            break
        splats = _merge_pairs(splats, pairs)
        is_kept = np.ones(len(nodes), bool)
        is_kept[pairs[1]] = False  # merged into the first splat of the pair
        splats, nodes = splats.select(np.flatnonzero(is_kept)), nodes[is_kept]
    return nodes, splats


def _choose_pairs(splats: SplatModel, nodes: I64, most: int, neighbours: int) -> I64:
    """Return the rows of disjoint pairs of neighbours in the same node, the cheapest, at most `most`, [2, M]."""
    edges = neighbour_edges(splats.means, nodes, neighbours)
    cheapest = np.argsort(_merge_costs(splats, edges), kind="stable")
    partners = np.full(len(splats), -1, np.int64)
    kernels.call("pair_up", edges, cheapest, len(cheapest), most, partners)
    first = np.flatnonzero(partners > np.arange(len(splats)))
    return np.stack([first, partners[first]])


def _merge_costs(splats: SplatModel, edges: I64) -> F64:
    """Return the cost of merging the splats of each edge, [M]; `edges` are rows, [2, M]."""
    scales = splats.scales.astype(np.float64)
    scales = np.maximum(scales, scales.max(axis=1, keepdims=True) + math.log(_THINNEST))
    covariances = covariance_entries(splats.quats.T, np.exp(2.0 * scales).T)
    colours = np.maximum(SH_C0 * splats.sh0 + 0.5, 0.0)
    amplitudes = splats.opacities[:, None] * np.column_stack([colours, np.ones(len(splats))])
    light = light_of(splats)
    blocks = (edges[:, start : start + _BLOCK] for start in range(0, edges.shape[1], _BLOCK))
    return np.concatenate(
        [np.zeros(0), *(_block_costs(splats.means, covariances, amplitudes, light, block) for block in blocks)]
    )


def _block_costs(means: F32, covariances: F64, amplitudes: F64, light: F64, edges: I64) -> F64:
    """Return the cost of merging the splats of each edge: what images along the three axes change, squared.

    Args:
        means: [N, 3].
        covariances: [6, N], entries in the order of `_AXES`.
        amplitudes: [N, 4], red, green, blue and alpha of each splat.
        light: [N], the weight of each splat in a merged splat.
        edges: [2, M], rows of two splats.

    Returns:
        [M], the squared error, up to a factor, divided by a power of the energy of both splats.
    """
    i, j = edges
    a, b = amplitudes[i], amplitudes[j]
    aa, bb, ab = (np.einsum("nc,nc->n", left, right) for left, right in ((a, a), (b, b), (a, b)))
    share = light[i] / (light[i] + light[j])
    costs, energies = np.zeros(len(i)), np.zeros(len(i))
    for axes, entries in _VIEWS:
        x, y = ((means[j, axis] - means[i, axis]).astype(np.float64) for axis in axes)
        first, second = (tuple(covariances[entry, rows] for entry in entries) for rows in edges)
        apart = share * (1.0 - share)
        both = tuple(
            share * first_entry + (1.0 - share) * second_entry + apart * offset
            for first_entry, second_entry, offset in zip(first, second, (x * x, x * y, y * y), strict=True)
        )
        sizes = [np.sqrt(_determinant(shape)) for shape in (first, second, both)]
        # The volume of the merged splat's image is the sum of both volumes: its amplitude is s a + t b.
        s, t = sizes[0] / sizes[2], sizes[1] / sizes[2]
        with_first = _overlap(first, both, (1.0 - share) * x, (1.0 - share) * y)
        with_second = _overlap(second, both, share * x, share * y)
        energy = 0.5 * (aa * sizes[0] + bb * sizes[1])
        costs += (
            energy
            + 2.0 * ab * _overlap(first, second, x, y)
            + 0.5 * sizes[2] * (s * s * aa + 2.0 * s * t * ab + t * t * bb)
        )
        costs -= 2.0 * ((s * aa + t * ab) * with_first + (s * ab + t * bb) * with_second)
        energies += energy
    return costs / np.maximum(energies, _TINY) ** _ENERGY_EXPONENT


def _overlap(first: tuple[F64, ...], second: tuple[F64, ...], x: F64, y: F64) -> F64:
    """Return the integral of the product of two Gaussians of height 1 in a plane, up to 2π.

    Args:
        first, second: entries xx, xy, yy of their covariances, [n] each.
        x, y: the offset between their centres, [n].
    """
    total = tuple(a + b for a, b in zip(first, second, strict=True))
    determinant = _determinant(total)
    distance = (total[2] * x * x - 2.0 * total[1] * x * y + total[0] * y * y) / determinant
    height = np.exp(-0.5 * np.maximum(distance, 0.0))
    return np.asarray(np.sqrt(_determinant(first) * _determinant(second) / determinant) * height)


def _determinant(entries: tuple[F64, ...]) -> F64:
    """Return the determinants of covariances in a plane, above 0, from their entries xx, xy, yy, [n] each."""
    product = entries[0] * entries[2]
    return np.maximum(product - entries[1] * entries[1], _SINGULAR * product) + _TINY


def _merge_pairs(splats: SplatModel, pairs: I64) -> SplatModel:
    """Return all splats, with the first splat of each pair replaced by the merged splat, and the second unchanged.

    Args:
        splats: [N] splats, which are not changed.
        pairs: [2, P], rows of two splats; no splat is in two pairs.
    """
    values = average_pairs(splats, pairs)
    scales = values["scales"]
    opacities = light_of(splats)[pairs].sum(axis=0) / mean_areas(scales.astype(np.float32))
    growth = np.maximum(opacities / _OPACITY_MAX, 1.0) ** _GROWTH
    values["scales"] = scales + 0.5 * np.log(growth)[:, None]
    values["opacities"] = np.minimum(opacities, _OPACITY_MAX)
    return with_values(splats, pairs[0], values)

# SPDX-License-Identifier: Apache-2.0
"""Measure the errors of the nodes of levels of detail with the renderer (spec E.5), on the decoded splats.

A node is compared with the splats of level 0 below it. If these are too many to be rendered at once, a finer level of
its subtree takes their place, and the error of that level, which has been measured before, is added: root mean squares
of differences of images add up at most.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from csplat.context import DEFAULT_CONTEXT, Context
from csplat.decoder import decode
from csplat.encoder import EncodedTiles, FileNode
from csplat.errors import LimitError
from csplat.model import SplatModel
from csplat.types import F32, F64
from csplat_render.camera import Camera, look_at
from csplat_render.rasteriser import Rasteriser

#: Maximum number of splats that a node is compared with: as many as a bucket has, so that each node of a bucket is
#: compared with level 0. Six renders of them take 1 s.
REFERENCE_SPLATS = 1 << 19

# Spec E.5.
_DISTANCE = 4.0  # radii from the camera to the centre
_RADIUS_PIXELS = 256
_IMAGE_PIXELS = 3 * _RADIUS_PIXELS
_SIZES = _RADIUS_PIXELS.bit_length()  # pixel sizes of 1 to 256 pixels of the images
_SQUARED_ERROR_MAX = 1e-3  # 30 dB
_COVERED = 1.0 / 255.0  # alpha
_NEAR_RADII = 1e-3  # radii from a camera to its near plane
_DIRECTIONS = [(axis, sign) for axis in range(3) for sign in (1.0, -1.0)]


def measure_errors(
    encoded: EncodedTiles,
    *,
    reference_splats: int = REFERENCE_SPLATS,
    context: Context = DEFAULT_CONTEXT,
) -> EncodedTiles:
    """Return the same tiles with errors of the nodes that have none yet.

    Args:
        encoded: the tiles, with nodes by ascending level.
        reference_splats: maximum number of splats that a node is compared with, if a level of its subtree has as few.
        context: threads and progress.
    """
    nodes = list(encoded.nodes)
    children: list[list[int]] = [[] for _ in nodes]
    for number, node in enumerate(nodes):
        if node.parent is not None:
            children[node.parent].append(number)
    step = encoded.plan.parameters.lattice.step
    regions = np.empty((len(nodes), 2, 3))
    rasteriser = Rasteriser(context=context)
    for number, node in enumerate(nodes):  # children come before their parents
        corners = [corner for tile in node.tiles for corner in tile.corners(step)]
        corners += [corner for child in children[number] for corner in regions[child]]
        regions[number] = np.min(corners, axis=0), np.max(corners, axis=0)
        if node.level == 0 or node.squares:
            continue
        cut = _reference_cut(nodes, children, number, reference_splats)
        coarse, fine = decode(encoded.part([node])), decode(encoded.part([nodes[index] for index in cut]))
        radius = _radius(regions[number], fine)
        try:
            squares = _squared_errors(rasteriser, coarse, fine, regions[number].mean(axis=0), radius)
        except LimitError:  # too many splats at one place to be rendered: as different as can be
            squares = np.ones(_SIZES)
        below = _errors_below([(nodes[index], _radius(regions[index])) for index in cut], radius)
        squares = (np.sqrt(squares) + np.sqrt(below)) ** 2
        error = max(_least_alike_size(squares, radius), *(nodes[child].error for child in children[number]))
        nodes[number] = replace(node, error=error, squares=tuple(squares.tolist()))
        context.progress("measuring levels", (number + 1) / len(nodes))
    return replace(encoded, nodes=nodes)


def _reference_cut(
    nodes: Sequence[FileNode], children: Sequence[Sequence[int]], number: int, splat_count: int
) -> list[int]:
    """Return the nodes of the level of a subtree with which its root is compared.

    Args:
        nodes: all nodes.
        children: indices of the children of each node.
        number: index of the root, above level 0.
        splat_count: maximum number of splats.

    Returns:
        Indices of the nodes of the finest level with at most this number of splats, or else of the level below the
        root. A branch that has no node of the level is represented by its next finer nodes.
    """
    cut: list[int] = []
    for level in range(nodes[number].level):
        pending, cut = list(reversed(children[number])), []
        while pending:
            index = pending.pop()
            if nodes[index].level > level:
                pending += reversed(children[index])
            else:
                cut.append(index)
        if sum(nodes[index].splat_count for index in cut) <= splat_count:
            break
    return cut


def _radius(region: F64, splats: SplatModel | None = None) -> float:
    """Return half the diagonal of a region, [2, 3], or, if that is 0, the largest standard deviation of splats."""
    radius = float(np.linalg.norm(region[1] - region[0])) / 2.0
    return radius if radius or splats is None else float(np.exp(np.float64(splats.scales.max())))


def _errors_below(cut: Sequence[tuple[FileNode, float]], radius: float) -> F64:
    """Return the squared errors of a level of a subtree, [_SIZES], at the pixel sizes of a node of this radius.

    They are averages over the nodes, weighted by the areas of their regions. The error of a node is its error at the
    next finer size that was measured; 0 for a node of level 0, and if all regions are points.

    Args:
        cut: the nodes of the level, and the radius of each, scene units.
        radius: radius of the root, scene units.
    """
    total, area = np.zeros(_SIZES), 0.0
    for node, node_radius in cut:
        area += node_radius * node_radius
        if node.squares and node_radius:
            finer = np.arange(_SIZES) + math.floor(math.log2(radius / node_radius))
            total += node_radius * node_radius * np.array(node.squares)[np.clip(finer, 0, _SIZES - 1)]
    return total / area if area else total


def _least_alike_size(squares: F64, radius: float) -> float:
    """Return the smallest pixel size, scene units, from which on all squared errors, [_SIZES], are small, as float32.

    If the error at the coarsest size is not small, return the next coarser size.
    """
    # Number of small errors at the coarse end: the index of the first False, which is appended if all are small.
    alike_count = int(np.argmin([*(squares <= _SQUARED_ERROR_MAX)[::-1], False]))
    first = _SIZES - alike_count
    return float(np.float32(radius * 2.0**first / _RADIUS_PIXELS))


def _squared_errors(rasteriser: Rasteriser, coarse: SplatModel, fine: SplatModel, centre: F64, radius: float) -> F64:
    """Return the mean squared error of two models in six views at each pixel size, finest first, [_SIZES].

    The mean is over red, green, blue and alpha of the pixels that either model covers; 0 if none is covered.

    Args:
        rasteriser: renders both.
        coarse, fine: the models.
        centre: [3], scene units.
        radius: scene units, above 0.

    Raises:
        LimitError: too many splats at one place to be rendered.
    """
    squares, pixels = np.zeros(_SIZES), np.zeros(_SIZES, np.int64)
    for camera in _cameras(centre, radius):
        a, b = (_image(rasteriser, splats, camera) for splats in (coarse, fine))
        # Averages are linear, so that the difference and both alphas are all that has to be averaged.
        images = np.concatenate([a - b, a[3:], b[3:]])
        for size in range(_SIZES):
            covered = np.maximum(images[4], images[5]) >= np.float32(_COVERED)
            error = np.einsum("cyx,cyx->yx", images[:4], images[:4])
            squares[size] += float(np.sum(error[covered], dtype=np.float64)) / 4.0  # channels
            pixels[size] += int(covered.sum())
            images = _halved(images)  # the next coarser size
    return squares / np.maximum(pixels, 1)


def _image(rasteriser: Rasteriser, splats: SplatModel, camera: Camera) -> F32:
    """Return red, green, blue and alpha, [4, H, W]."""
    image = rasteriser.forward(splats, camera, antialiased=splats.metadata.antialiased)
    return np.concatenate([np.clip(image.rgb, 0.0, 1.0).transpose(2, 0, 1), image.alpha[None]])


def _halved(images: F32) -> F32:
    """Return the averages of two by two pixels, [C, H // 2, W // 2]."""
    side = images.shape[1] // 2 * 2
    rows = images[:, 0:side:2] + images[:, 1:side:2]
    return (rows[:, :, 0:side:2] + rows[:, :, 1:side:2]) * np.float32(0.25)


def _cameras(centre: F64, radius: float) -> list[Camera]:
    """Return a camera in each direction of the axes that looks at the centre, [3], of a node of this radius."""
    focal, middle = _DISTANCE * _RADIUS_PIXELS, _IMAGE_PIXELS / 2.0
    K = np.array([[focal, 0.0, middle], [0.0, focal, middle], [0.0, 0.0, 1.0]])
    cameras = []
    for axis, sign in _DIRECTIONS:
        away = np.zeros(3)
        away[axis] = sign * _DISTANCE * radius
        up = np.eye(3)[(axis + 1) % 3]
        cameras.append(look_at(centre + away, centre, up, K, _IMAGE_PIXELS, _IMAGE_PIXELS, near=radius * _NEAR_RADII))
    return cameras

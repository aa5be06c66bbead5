"""Build the levels of detail of a scene, and measure their errors with the renderer.

Levels that a scene has already, in streamed SOG, are taken instead.

Space is cut by medians into leaves of equal numbers of splats. Four nodes have one parent; above the last common one,
a chain of nodes goes on to a few thousand splats. Each level has a quarter of the splats of the finer one, those that
matter most, fitted to renders of the scene (`level_fitting.py`). In larger scenes, four neighbouring splats are merged
to one by their moments instead. `error` of each node is measured as specified (spec E.5), on the decoded splats of the
finished file.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from csplat.decoder import Node, decode
from csplat.decoder.tree import node_regions
from csplat.encoder import (
    EncodeOptions,
    EncodePlan,
    EncodeResult,
    LevelNode,
    covariance_entries,
    encode_levels,
    mean_axes,
)
from csplat.formats import open_scene
from csplat.formats.sog.sog_reader import read_leaf_numbers
from csplat.model import SplatModel
from csplat.scene_source import join_blocks
from csplat.splat_file import open as opened
from csplat.types import F32, F64, I64, Progress, null_progress
from csplat_render.camera import Camera, look_at
from csplat_render.rasteriser import Rasteriser
from csplat_tools.level_fitting import LevelFitter, areas

#: Maximum number of splats of a leaf; smaller leaves take more bytes, larger ones load later when they are seen.
LEAF_SPLATS = 1 << 14
#: Maximum number of splats of a root: about 50 kB, the first picture of a scene.
ROOT_SPLATS = 1 << 12

#: Number of splats up to which levels are fitted.
FITTED_SPLATS = 2_000_000

_MERGED = 4  # splats that become one
_CHILDREN = 4  # maximum number of children of a node, so that nodes of all levels have about as many splats
_OPACITY_MAX = 0.99  # alpha that renderers cap at

# Spec E.5.
_DISTANCE = 4.0  # radii from the camera to the centre
_RADIUS_PIXELS = 256
_IMAGE_PIXELS = 3 * _RADIUS_PIXELS
_SQUARED_ERROR_MAX = 1e-3  # 30 dB
_COVERED = 1.0 / 255.0  # alpha
_DIRECTIONS = [(axis, sign) for axis in range(3) for sign in (1.0, -1.0)]


def encode_with_levels(
    model: SplatModel,
    options: EncodeOptions | None = None,
    *,
    nodes: Sequence[LevelNode] | None = None,
    leaf_splats: int = LEAF_SPLATS,
    root_splats: int = ROOT_SPLATS,
    progress: Progress | None = None,
) -> EncodeResult:
    """Encode a scene with levels of detail, in memory.

    Args:
        model: the scene.
        options: default: the preset "balanced".
        nodes: nodes of the scene, whose errors are measured; `None`: build them.
        leaf_splats, root_splats: see `build_levels`.
        progress: called with the stage and the fraction done, 0 to 1.

    Raises:
        InputError: a value fits no lattice, or an option is not allowed for the model.
    """
    progress = progress or null_progress
    settings: dict[str, Any] = {"levels": "of the source"}
    if nodes is None:
        nodes = build_levels(model, leaf_splats, root_splats, progress) if len(model) else []
        how = "fitted" if len(model) <= FITTED_SPLATS else "merged"
        settings = {"levels": {"splats": how, "leaf_splats": leaf_splats, "root_splats": root_splats}}
    encoded = encode_levels(EncodePlan.of(model, options, progress=progress), nodes, progress)
    if any(node.level for node in nodes):
        encoded = encoded.with_node_errors(measure_errors(encoded.write().data, progress))
    return encoded.write(settings)


def read_streamed_levels(path: Path) -> list[LevelNode]:
    """Return the levels of detail of streamed SOG: each leaf of its tree becomes a chain of nodes.

    Raises:
        InputError: the file is damaged, or no streamed SOG.
        OSError: it cannot be read.
    """
    with open_scene(path) as scene:
        count = len(scene.levels)
    levels = []
    for level in range(count):
        with open_scene(path, level=level) as scene:
            levels.append((scene.model(), read_leaf_numbers(path, level)))
    return chain_leaves(levels)


def chain_leaves(levels: Sequence[tuple[SplatModel, I64]]) -> list[LevelNode]:
    """Return a chain of nodes for each leaf, without levels that have no fewer splats than the finer one.

    Args:
        levels: the splats of each level, finest first, and the number of the leaf of each splat.
    """
    nodes: list[LevelNode] = []
    finest = levels[0][1]
    for leaf in np.unique(finest):
        nodes.append(LevelNode(0, None, rows=np.flatnonzero(finest == leaf)))
        splat_count = int(np.count_nonzero(finest == leaf))
        for level, (model, numbers) in enumerate(levels[1:], 1):
            rows = np.flatnonzero(numbers == leaf)
            if 0 < len(rows) < splat_count:
                nodes[-1] = replace(nodes[-1], parent=len(nodes))
                nodes.append(LevelNode(level, None, splats=_with_bands(model.select(rows), levels[0][0])))
                splat_count = len(rows)
    return nodes


def _with_bands(splats: SplatModel, scene: SplatModel) -> SplatModel:
    """Return splats with as many SH coefficients as those of a scene, and without extra columns."""
    shN = np.zeros((len(splats), *scene.shN.shape[1:]), np.float32)
    kept = min(shN.shape[1], splats.shN.shape[1])
    shN[:, :kept] = splats.shN[:, :kept]
    return replace(splats, shN=shN, extra={})


def build_levels(
    model: SplatModel,
    leaf_splats: int = LEAF_SPLATS,
    root_splats: int = ROOT_SPLATS,
    progress: Progress = null_progress,
) -> list[LevelNode]:
    """Build the nodes of a scene, by ascending level; errors are 0.

    Args:
        model: the scene, of one splat or more.
        leaf_splats: maximum number of splats of a leaf.
        root_splats: maximum number of splats of the root.
        progress: called with the fraction of the levels that are done.
    """
    groups = kd_groups(model.means, math.ceil(len(model) / leaf_splats))
    plain = replace(model, extra={}, means_double=None)
    nodes = [LevelNode(0, None, rows=rows) for rows in groups]
    node_count, splats, level = len(nodes), plain, 0
    places = np.empty(len(model), np.int64)  # the node of each splat, counted per level
    for place, rows in enumerate(groups):
        places[rows] = place
    steps = max(1, math.ceil(math.log(len(model) / root_splats, _MERGED)))
    while node_count > 1 or len(splats) > root_splats:
        level += 1
        first = len(nodes)
        for child in range(node_count):
            at = first - node_count + child
            nodes[at] = replace(nodes[at], parent=first + child // _CHILDREN)
        node_count = math.ceil(node_count / _CHILDREN)
        places //= _CHILDREN
        if len(model) <= FITTED_SPLATS:
            count = max(node_count, math.ceil(len(splats) / _MERGED))
            kept, splats = LevelFitter(plain, progress).fit(splats, places, count, level)
            places = places[kept]
        else:
            merged = [merge_neighbours(splats.select(rows)) for rows in _rows_by_node(places, node_count)]
            splats = join_blocks(plain, merged)
            places = np.repeat(np.arange(node_count), [len(part) for part in merged])
        nodes += [LevelNode(level, None, splats=splats.select(rows)) for rows in _rows_by_node(places, node_count)]
        progress("building levels", min(1.0, level / steps))
    return nodes


def _rows_by_node(places: I64, node_count: int) -> list[NDArray[np.intp]]:
    """Return the rows of the splats of each node, ascending."""
    ends = np.cumsum(np.bincount(places, minlength=node_count))
    return np.split(np.argsort(places, kind="stable"), ends[:-1])


def kd_groups(points: F32, count: int) -> list[NDArray[np.intp]]:
    """Cut points at the medians of the longest sides of their boxes.

    Args:
        points: [N, 3].
        count: number of groups, 1 to N.

    Returns:
        Rows of each group, in spatial order; their numbers differ by 1 at most.
    """
    order = np.arange(len(points))
    sizes = np.array([len(points)], np.int64)  # points in each box
    counts = np.array([count], np.int64)  # groups in each box
    while counts.max() > 1:
        starts = np.cumsum(sizes) - sizes
        inside = points[order]
        sides = np.maximum.reduceat(inside, starts) - np.minimum.reduceat(inside, starts)
        box = np.repeat(np.arange(len(sizes)), sizes)
        along = inside[np.arange(len(points)), sides.argmax(axis=1)[box]]
        order = order[np.lexsort((along, box))]
        near = counts // 2
        splats = sizes * near // counts
        sizes = np.stack([splats, sizes - splats], axis=1).reshape(-1)
        counts = np.stack([near, counts - near], axis=1).reshape(-1)
        sizes, counts = sizes[counts > 0], counts[counts > 0]
    return np.split(order, np.cumsum(sizes)[:-1])


def merge_neighbours(splats: SplatModel) -> SplatModel:
    """Merge groups of up to four neighbouring splats to one with the same mean, covariance and opacity × area.

    Sums weight each splat by opacity × area. Opacity is limited to 0.99; splats that grow instead, to keep the product,
    look up to 4 dB worse (fox60k_noreg).
    """
    groups = kd_groups(splats.means, math.ceil(len(splats) / _MERGED))
    order = np.concatenate(groups)
    starts = np.cumsum([0, *(len(rows) for rows in groups[:-1])])
    group = np.repeat(np.arange(len(groups)), [len(rows) for rows in groups])
    chosen = splats.select(order)
    light = chosen.opacities * areas(chosen.scales)
    weights = np.maximum(light, np.finfo(np.float64).tiny)
    weights = weights / np.add.reduceat(weights, starts)[group]

    def averaged(values: NDArray[np.floating]) -> F64:
        flat = values.reshape(len(values), -1).astype(np.float64)
        return np.add.reduceat(flat * weights[:, None], starts)

    means = averaged(chosen.means)
    offsets = (chosen.means - means[group]).T
    variances = np.exp(2.0 * chosen.scales.astype(np.float64)).T
    entries = covariance_entries(chosen.quats.T, variances)
    entries += np.stack([offsets[i] * offsets[j] for i, j in ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))])
    covariances = averaged(entries.T).T
    trace = np.maximum(covariances[:3].sum(axis=0), np.finfo(np.float64).tiny)
    quats, scales = mean_axes(covariances / trace)
    scales = (scales + 0.5 * np.log(trace)[:, None]).astype(np.float32)
    opacities = np.add.reduceat(light, starts) / areas(scales)
    return replace(
        chosen.select(slice(0, len(groups))),
        means=means.astype(np.float32),
        quats=quats,
        scales=scales,
        opacities=np.minimum(opacities, _OPACITY_MAX).astype(np.float32),
        sh0=averaged(chosen.sh0).astype(np.float32),
        shN=averaged(chosen.shN).reshape(len(groups), *chosen.shN.shape[1:]).astype(np.float32),
        extra={},
        means_double=None,
    )


def measure_errors(data: bytes, progress: Progress = null_progress) -> list[float]:
    """Measure the errors of the nodes of a file (spec E.5), on its decoded splats.

    Args:
        data: the file.
        progress: called with the fraction of the nodes that are done.
    """
    with opened(data) as file:
        nodes, regions = file.nodes, node_regions(file.header, file.nodes)
        count = len(file.header.all_tiles)
    splats = decode(data, tiles=range(count))
    rasteriser = Rasteriser(gradients=False)
    errors: list[float] = []
    leaves: list[list[Node]] = []
    for number, node in enumerate(nodes):  # children come before their parents
        leaves.append([node] if node.level == 0 else [leaf for child in node.children for leaf in leaves[child]])
        if node.level == 0:
            errors.append(0.0)
            continue
        coarse, fine = (
            splats.select(np.concatenate([_rows(one) for one in some])) for some in ([node], leaves[number])
        )
        error = _error_of(rasteriser, coarse, fine, regions[number])
        errors.append(max(float(np.float32(error)), *(errors[child] for child in node.children)))
        progress("measuring levels", (number + 1) / len(nodes))
    return errors


def _rows(node: Node) -> NDArray[np.intp]:
    return np.arange(node.tiles[0].start, node.tiles[-1].start + node.tiles[-1].splat_count)


def _error_of(rasteriser: Rasteriser, coarse: SplatModel, fine: SplatModel, box: F64) -> float:
    """Return the smallest pixel size at which two sets of splats look alike, scene units."""
    radius = float(np.linalg.norm(box[1] - box[0])) / 2.0
    if radius == 0.0:
        radius = float(np.exp(np.float64(fine.scales.max())))
    levels = _RADIUS_PIXELS.bit_length()  # pixel sizes of 1 to 256 pixels of the images
    squares, pixels = np.zeros(levels), np.zeros(levels, np.int64)
    for camera in _cameras(box.mean(axis=0), radius):
        a, b = (_image(rasteriser, splats, camera) for splats in (coarse, fine))
        for at in range(levels):
            covered = np.maximum(a[..., 3], b[..., 3]) >= _COVERED
            squares[at] += float(np.sum((a - b)[covered] ** 2)) / 4.0
            pixels[at] += int(covered.sum())
            a, b = _halved(a), _halved(b)
    is_alike = squares <= _SQUARED_ERROR_MAX * pixels
    first = levels - int(np.argmin([*is_alike[::-1], False]))  # all sizes from this one on are alike
    return radius * 2.0**first / _RADIUS_PIXELS


def _image(rasteriser: Rasteriser, splats: SplatModel, camera: Camera) -> F64:
    """Return red, green, blue and alpha, [H, W, 4]."""
    image = rasteriser.forward(splats, camera, antialiased=splats.antialiased)
    return np.concatenate([np.clip(image.rgb, 0.0, 1.0), image.alpha[..., None]], axis=2).astype(np.float64)


def _halved(image: F64) -> F64:
    """Return the averages of two by two pixels."""
    side = len(image) // 2
    return np.asarray(image[: 2 * side, : 2 * side].reshape(side, 2, side, 2, 4).mean(axis=(1, 3)))


def _cameras(centre: F64, radius: float) -> list[Camera]:
    focal, middle = _DISTANCE * _RADIUS_PIXELS, _IMAGE_PIXELS / 2.0
    K = np.array([[focal, 0.0, middle], [0.0, focal, middle], [0.0, 0.0, 1.0]])
    cameras = []
    for axis, sign in _DIRECTIONS:
        away = np.zeros(3)
        away[axis] = sign * _DISTANCE * radius
        up = np.eye(3)[(axis + 1) % 3]
        cameras.append(look_at(centre + away, centre, up, K, _IMAGE_PIXELS, _IMAGE_PIXELS, near=radius * 1e-3))
    return cameras

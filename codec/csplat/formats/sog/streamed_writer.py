# SPDX-License-Identifier: Apache-2.0
"""Write streamed SOG, version 1: a scene in levels of detail, which viewers load part by part.

Follows https://developer.playcanvas.com/user-manual/gaussian-splatting/formats/streamed-sog. A binary tree cuts space
into leaves. Each has, for each level, a run of splats in Morton order in a SOG, a *chunk*. A viewer draws one level of
each leaf. Here, a splat of any level belongs to the leaf in which its centre lies, as in the files of splat-transform.

`errors` are not written, as by default in splat-transform. They are relative squared errors of renders of a leaf, while
nodes of csplat have the pixel sizes from which on they look right. Viewers go by distances and numbers of splats then.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import count, takewhile
from pathlib import Path
from typing import Any

import numpy as np

from csplat.disk_files import atomic_folder, read_json, resolve_links
from csplat.encoder import covariance_entries
from csplat.encoder.entropy import morton_codes
from csplat.errors import InputError
from csplat.file_source import write_file
from csplat.formats.common import scene_of_rows, sorted_parts
from csplat.formats.sog.sog_writer import SogLosses, encode_files
from csplat.lint import Finding
from csplat.model import SplatModel
from csplat.scene import Scene
from csplat.types import F32, F64, I64

#: Name of the file that lists all others.
LEVELS_NAME = "lod-meta.json"

_LEAF_SPLATS = 1 << 14  # maximum at the finest level, as in `encode --levels`; splat-transform takes at least 8,192
_CHUNK_SPLATS = 1 << 19  # approximate maximum, as in splat-transform: a viewer loads a chunk as a whole
_SAMPLE = 1 << 22  # maximum number of positions that determine the leaves; they take 50 MB
_CELL_BITS = 14  # bits per axis of the Morton codes in a leaf
_QUANTILES = (0.05, 0.95)  # between which positions spread, so that a few splats far away do not choose the axis
_DIGITS = 7  # significant digits of bounds, by section 5


@dataclass(frozen=True)
class _Cut:
    """An inner node of the tree.

    Attributes:
        axis, place: positions with a coordinate below `place` are in `low`, the others in `high`.
        low, high: the children: further cuts, or numbers of leaves.
    """

    axis: int
    place: float
    low: _Cut | int
    high: _Cut | int


@dataclass(frozen=True)
class _LevelStatistics:
    """The splats of a level by leaf.

    Attributes:
        counts: [L], number of splats.
        centres: [L, 2, 3], bounds of their centres, scene units; infinite without splats.
        extents: [L, 2, 3], bounds of their ellipsoids.
        chunks: [L], index of the chunk.
    """

    counts: I64
    centres: F64
    extents: F64
    chunks: I64


def write_streamed_sog(path: Path, levels: Sequence[Scene]) -> list[Finding]:
    """Write a folder of streamed SOG (`Format.write_levels`).

    Takes about 430 MB of memory for chunks of 500,000 splats without SH, 640 MB with degree 3, for scenes of any size;
    and in the parent folder the space of the largest level as float32 values.

    Args:
        path: path of the lod-meta.json. Its folder is new, empty, or a streamed SOG, which is replaced.
        levels: the levels, finest first; their blocks are read twice, the blocks of the finest level three times. The
            first level without splats and all after it are left out.

    Raises:
        InputError: there are no splats, the folder contains other files, or Pillow is not installed.
        OSError: a file cannot be written.
    """
    folder = resolve_links(path.parent)
    _check_folder(folder)
    levels = list(takewhile(lambda level: level.count, levels))
    if not levels:
        raise InputError(f"{path}: the scene has no splats, and streamed SOG has no empty leaves")
    tree, leaf_count = _cut_space(levels[0])
    surveys = [_measure_leaves(level, tree, leaf_count) for level in levels]
    filenames, losses = list[str](), SogLosses()
    leaves: list[dict[str, dict[str, int]]] = [{} for _ in range(leaf_count)]
    with atomic_folder(path.parent) as temporary:
        for number, (level, statistics) in enumerate(zip(levels, surveys, strict=True)):
            _add_level_of_leaves(leaves, number, statistics, len(filenames))
            names = [f"{number}_{chunk}" for chunk in range(int(statistics.chunks[-1]) + 1)]
            _write_chunks([temporary / name for name in names], level, tree, statistics, losses)
            filenames += [f"{name}/meta.json" for name in names]
        extents = np.stack([survey.extents for survey in surveys])
        bounds = np.stack([extents[:, :, 0].min(0), extents[:, :, 1].max(0)], axis=1)
        counts = [level.count for level in levels]
        meta = {
            "version": 1, "asset": {"generator": "csplat"}, "count": sum(counts), "counts": counts,
            "lodLevels": len(levels), "lodErrors": False, "filenames": filenames,
            "tree": _describe_node(tree, bounds, leaves)[0],
        }  # fmt: skip
        write_file(temporary / LEVELS_NAME, json.dumps(meta, separators=(",", ":")).encode("ascii"))
    return losses.findings(levels[0].metadata)


def _check_folder(folder: Path) -> None:
    """Refuse a folder that contains anything but streamed SOG, because all of it is replaced."""
    if not folder.exists():
        return
    names = {entry.name for entry in folder.iterdir()}
    if LEVELS_NAME in names:
        meta = read_json(folder / LEVELS_NAME)
        files = meta.get("filenames") if isinstance(meta, dict) else None
        own = [*files, meta.get("environment")] if isinstance(files, list) else []
        names -= {LEVELS_NAME, *(name.split("/")[0] for name in own if isinstance(name, str))}
    if names or folder == Path.cwd():
        reason = f"contains {min(names)}" if names else "is the current one"
        raise InputError(f"{folder} {reason}, and a new folder replaces it: name another, as in scene/{LEVELS_NAME}")


def _cut_space(scene: Scene) -> tuple[_Cut | int, int]:
    """Cut space by medians of a sample of positions; return the tree and the number of leaves.

    A cell of more than `_LEAF_SPLATS` splats is cut across the widest axis on which they differ, if there is any.
    """
    step = -(-scene.count // _SAMPLE)
    sample = np.concatenate([model.means[-rows.start % step :: step] for rows, model in scene.numbered()])
    numbers = count()

    def cut(points: F32) -> _Cut | int:
        if len(points) * step > _LEAF_SPLATS:
            low, high = np.quantile(points, _QUANTILES, axis=0)
            for axis in np.argsort(low - high, kind="stable"):
                values = points[:, axis]
                place = np.partition(values, len(values) // 2)[len(values) // 2]
                if place == values.min():  # half of the splats or more are in a plane
                    place = values.min(where=values > place, initial=np.float32(np.inf))
                if place <= values.max():
                    below = values < place
                    return _Cut(int(axis), float(place), cut(points[below]), cut(points[~below]))
        return next(numbers)

    return cut(sample), next(numbers)


def _number_leaves(tree: _Cut | int, means: F32) -> I64:
    """Return the number of the leaf, [n], that contains each position [n, 3]."""
    numbers = np.empty(len(means), np.int64)
    pending: list[tuple[_Cut | int, I64]] = [(tree, np.arange(len(means)))]
    while pending:
        node, rows = pending.pop()
        if isinstance(node, int):
            numbers[rows] = node
            continue
        below = means[rows, node.axis] < node.place
        pending += [(child, part) for child, part in ((node.low, rows[below]), (node.high, rows[~below])) if len(part)]
    return numbers


def _measure_leaves(scene: Scene, tree: _Cut | int, leaf_count: int) -> _LevelStatistics:
    """Measure the leaves of the tree at a level, and distribute them among chunks; reads all blocks."""
    counts = np.zeros(leaf_count, np.int64)
    centres = np.stack([np.full((leaf_count, 3), np.inf), np.full((leaf_count, 3), -np.inf)], axis=1)
    extents = centres.copy()
    for model in scene.blocks():
        numbers = _number_leaves(tree, model.means)
        counts += np.bincount(numbers, minlength=leaf_count)
        means, half = model.means.astype(np.float64), _half_extents(model)
        order = np.argsort(numbers, kind="stable")
        present, starts = np.unique(numbers[order], return_index=True)  # leaves of this block, and their first splats
        for bounds, least, most in ((centres, means, means), (extents, means - half, means + half)):
            bounds[present, 0] = np.minimum(bounds[present, 0], np.minimum.reduceat(least[order], starts))
            bounds[present, 1] = np.maximum(bounds[present, 1], np.maximum.reduceat(most[order], starts))
    chunk_count = -(-scene.count // _CHUNK_SPLATS)
    middles = np.cumsum(counts) - (counts + 1) // 2
    _, chunks = np.unique(np.clip(middles * chunk_count // scene.count, 0, chunk_count - 1), return_inverse=True)
    return _LevelStatistics(counts, centres, extents, chunks)


def _half_extents(model: SplatModel) -> F64:
    """Return half the sizes of the boxes around ellipsoids of one standard deviation, [n, 3], scene units."""
    variances = covariance_entries(model.quats.T, np.exp(2.0 * model.scales.T.astype(np.float64)))[:3]
    half: F64 = np.sqrt(variances.T)
    return half


def _add_level_of_leaves(
    leaves: Sequence[dict[str, dict[str, int]]], level: int, statistics: _LevelStatistics, file_count: int
) -> None:
    """Add a level to `lods` of each leaf, whose files begin at index `file_count`.

    A leaf without splats gets the level, too: our reader takes another level for a missing one.
    """
    ends = np.cumsum(statistics.counts)
    firsts = np.searchsorted(statistics.chunks, statistics.chunks)  # the first leaf in the same chunk
    for leaf, lods in enumerate(leaves):
        count = int(statistics.counts[leaf])
        chunk_start = int(ends[firsts[leaf]] - statistics.counts[firsts[leaf]])
        lods[str(level)] = {
            "file": file_count + int(statistics.chunks[leaf]),
            "offset": int(ends[leaf]) - count - chunk_start,
            "count": count,
        }


def _write_chunks(
    folders: Sequence[Path], scene: Scene, tree: _Cut | int, statistics: _LevelStatistics, losses: SogLosses
) -> None:
    """Write a SOG into each folder: the splats of a chunk, sorted by leaf, then along a Z curve through the leaf."""
    low, high = statistics.centres[:, 0], statistics.centres[:, 1]
    scales = np.divide(2**_CELL_BITS - 1, high - low, out=np.zeros_like(low), where=high > low)

    def keys(means: F32) -> I64:
        numbers = _number_leaves(tree, means)
        cells = ((means - low[numbers]) * scales[numbers]).astype(np.int64)
        return numbers << 3 * _CELL_BITS | morton_codes(cells.T)

    first_leaves = np.searchsorted(statistics.chunks, np.arange(1, len(folders)))
    splits = first_leaves.astype(np.int64) << 3 * _CELL_BITS
    with sorted_parts(scene, folders[0].parent, keys, splits) as parts:
        for folder, rows in zip(folders, parts.rows(0, len(folders)), strict=True):
            folder.mkdir()
            for name, data in encode_files(scene_of_rows(parts.empty, rows), losses):
                write_file(folder / name, data)


def _describe_node(
    node: _Cut | int, bounds: F64, leaves: Sequence[dict[str, dict[str, int]]]
) -> tuple[dict[str, Any], F64]:
    """Return the JSON of a node with all below it, and its bounds, [2, 3]; leaves have `bounds` [L, 2, 3]."""
    if isinstance(node, int):
        box, content = bounds[node], dict[str, Any](lods=leaves[node])
    else:
        children = [_describe_node(child, bounds, leaves) for child in (node.low, node.high)]
        child_boxes = np.stack([child_box for _, child_box in children])
        box = np.stack([child_boxes[:, 0].min(0), child_boxes[:, 1].max(0)])
        content = {"children": [child for child, _ in children]}
    least, most = ([float(f"{value:.{_DIGITS}g}") for value in side] for side in box)
    return {"bound": {"min": least, "max": most}, **content}, box

# SPDX-License-Identifier: Apache-2.0
"""Convert scene files between formats, and filter their splats."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import csplat
from csplat.decoder import Limits
from csplat.disk_files import resolve_links, size_on_disk
from csplat.editing.transform import axes_rotation, convert_axes, rotate_scene, scale_scene, translate_scene
from csplat.encoder import PresetName
from csplat.errors import InputError, counted
from csplat.formats import format_by_name, format_by_suffix, survey_losses, write_levels
from csplat.formats.format import ARRAYS
from csplat.lint import Finding
from csplat.model import SplatModel
from csplat.scene import Scene
from csplat.scene_metadata import UNSPECIFIED, UP
from csplat.splat_file import SplatFile
from csplat.types import F64, Mask, Progress
from csplat_tools.file_streams import is_one_way, local_path, mapped_csplat, write_model
from csplat_tools.scene_files import MetadataOverrides, findings_as_json, with_first_view, with_progress

_WITH_VIEW = ("csplat", "gltf-csplat")  # formats whose viewers start at the view of the file
_CELL = 0.01  # radius of a splat's neighbourhood, as a fraction of the scene's extent
_SPREAD = 4.0  # the same in standard deviations of the splat, used if it is larger
_OCTAVES_MAX = 40.0  # doublings of the cell for larger splats, so that its size stays finite
_CELLS_MAX = 2.0**19  # cells from the corner of the scene; splats beyond share the last cell
_KEY_BITS = 21  # bits of a cell along one axis in the key of the cell
_LOG_SIZE_MAX = 80.0  # log scales are clipped to plus or minus this, so that their exponentials are finite in float32
_NEIGHBOURS_MIN = 8  # splats in the neighbourhood, including itself; a splat with fewer is a floater


@dataclass(frozen=True)
class Filters:
    """Changes of a scene, applied in the order of the fields; `None` and False change nothing.

    Attributes:
        to_axes: convert the scene to these axes, as in `SplatModel`; a scene without axes is assumed to have x right,
            y down, z forward.
        axes: axes along which `rotate`, `translate` and the crops are given; `None`: the axes of the scene.
        rotate: rotate about x, y, z in this order, degrees, counter-clockwise as seen from the tip of the axis. The
            scene keeps the names of its axes, so that converting it to axes of a format does not rotate it back.
        scale: scale the scene about the origin of its coordinates by this factor.
        translate: offset added to all positions, scene units.
        crop_box: keep splats whose centres lie between two corners, x y z each.
        crop_sphere: keep splats whose centres lie within a sphere, x y z and radius.
        drop_floaters: drop splats with almost no others around them.
        sh_degree: drop the SH bands above.
    """

    to_axes: str | None = None
    axes: str | None = None
    rotate: tuple[float, float, float] | None = None
    scale: float | None = None
    translate: tuple[float, float, float] | None = None
    crop_box: tuple[float, ...] | None = None
    crop_sphere: tuple[float, ...] | None = None
    drop_floaters: bool = False
    sh_degree: int | None = None

    def apply(self, scene: Scene) -> Scene:
        """Return the changed scene."""
        if self.to_axes is not None:
            scene = convert_axes(scene, self.to_axes)
        letters = scene.metadata.coordinate_system
        turn = np.eye(3) if self.axes is None or self.axes == letters else axes_rotation(self.axes, letters)
        if self.rotate is not None:
            matrix = turn @ _rotation_matrix(self.rotate) @ turn.T
            scene = scene.map(lambda model: _rotate_in_axes(model, matrix))
        if self.scale is not None:
            factor = self.scale
            scene = scene.map(lambda model: scale_scene(model, factor))
        if self.translate is not None:
            x, y, z = (turn @ self.translate).tolist()
            scene = scene.map(lambda model: translate_scene(model, (x, y, z)))
        if self.crop_box is not None:
            corners = np.sort(np.array(self.crop_box).reshape(2, 3) @ turn.T, axis=0)
            scene = _select_splats(scene, lambda model: _inside_box(model, corners))
        if self.crop_sphere is not None:
            sphere = np.array([*(turn @ self.crop_sphere[:3]), self.crop_sphere[3]])
            scene = _select_splats(scene, lambda model: _inside_sphere(model, sphere))
        if self.drop_floaters:
            scene = _without_floaters(scene)
        if self.sh_degree is not None:
            degree = self.sh_degree
            scene = scene.with_sh_degree(degree)
        return scene


def _rotate_in_axes(model: SplatModel, matrix: F64) -> SplatModel:
    """Rotate a scene whose axes keep their names. An up direction in its metadata rotates with it."""
    turned, letters = rotate_scene(model, matrix), model.metadata.coordinate_system
    if letters == UNSPECIFIED:
        return turned
    entries = dict(turned.metadata.entries)
    if UP not in model.metadata.entries:
        entries.pop(UP, None)
    return replace(turned, metadata=replace(turned.metadata, coordinate_system=letters, entries=entries))


def find_floaters(points: F64, sizes: F64) -> Mask:
    """Find splats with almost no others within 1 % of the extent, or within four times their own size.

    Args:
        points: [N, 3] centres.
        sizes: [N] standard deviations, scene units.

    Returns:
        [N] bool, True for floaters.
    """
    if len(points) < _NEIGHBOURS_MIN:
        return np.zeros(len(points), np.bool_)
    low, high = np.quantile(points, [0.05, 0.95], axis=0)
    extent = float(np.sqrt(np.sum((high - low) ** 2)))
    if not extent > 0.0:
        return np.zeros(len(points), np.bool_)
    with np.errstate(divide="ignore", over="ignore"):
        octaves = np.ceil(np.log2(np.maximum(_SPREAD * sizes / (_CELL * extent), 1.0)))
    octaves = np.minimum(octaves, _OCTAVES_MAX).astype(np.int64)
    floaters = np.zeros(len(points), np.bool_)
    for octave in np.unique(octaves):
        places = (points - low) / (_CELL * extent * 2.0**octave)
        cells = np.floor(np.clip(places, -_CELLS_MAX, _CELLS_MAX)).astype(np.int64)
        keys, counts = np.unique(_cell_keys(cells), return_counts=True)
        own = np.flatnonzero(octaves == octave)
        neighbours = np.zeros(len(own), np.int64)
        for step in np.ndindex(3, 3, 3):
            expected = _cell_keys(cells[own] + (np.array(step) - 1))
            at = np.minimum(np.searchsorted(keys, expected), len(keys) - 1)
            neighbours += np.where(keys[at] == expected, counts[at], 0)
        floaters[own] = neighbours < _NEIGHBOURS_MIN
    return floaters


def _cell_keys(cells: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return one integer for each cell, [N], from its three, [N, 3], whose absolute values are below 2**20."""
    x, y, z = (cells[:, k] + (1 << (_KEY_BITS - 1)) for k in range(3))
    key: NDArray[np.int64] = (x << (2 * _KEY_BITS)) | (y << _KEY_BITS) | z
    return key


def _select_splats(scene: Scene, keep: Callable[[SplatModel], Mask]) -> Scene:
    """Return a scene of the splats that `keep` marks in each block. Reads the scene once, to count them."""

    def blocks() -> Iterator[SplatModel]:
        """Yield the kept splats, without empty blocks."""
        for model in scene.blocks():
            kept = keep(model)
            if kept.any():
                yield model.select(kept)

    count = sum(int(np.count_nonzero(keep(model))) for model in scene.blocks())
    return scene.changed(count=count, reader=blocks)


def _without_floaters(scene: Scene) -> Scene:
    """Return a scene without isolated splats. Reads the scene once; 16 bytes of each splat are kept in memory."""
    points, sizes = np.empty((scene.count, 3), np.float32), np.empty(scene.count, np.float32)
    start = 0
    for model in scene.blocks():
        part = slice(start, start + len(model))
        log_sizes = np.clip(model.scales.max(axis=1), -_LOG_SIZE_MAX, _LOG_SIZE_MAX)
        points[part], sizes[part] = model.means, np.exp(log_sizes)
        start += len(model)
    is_floater = find_floaters(points.astype(np.float64), sizes.astype(np.float64))

    def blocks() -> Iterator[SplatModel]:
        """Yield the other splats, without empty blocks."""
        start = 0
        for model in scene.blocks():
            is_kept = ~is_floater[start : start + len(model)]
            start += len(model)
            if is_kept.any():
                yield model.select(is_kept)

    return scene.changed(count=scene.count - int(np.count_nonzero(is_floater)), reader=blocks)


def _inside_box(model: SplatModel, corners: F64) -> Mask:
    """Return True, [N], for centres within two corners, [2, 3] in world coordinates, the lower corner first."""
    places = model.means + np.array(model.origin)
    inside: Mask = ((places >= corners[0]) & (places <= corners[1])).all(axis=1)
    return inside


def _inside_sphere(model: SplatModel, sphere: F64) -> Mask:
    """Return True, [N], for centres within a sphere, [4]: its centre in world coordinates, and its radius."""
    places = model.means + np.array(model.origin)
    with np.errstate(over="ignore"):
        inside: Mask = np.sum((places - sphere[:3]) ** 2, axis=1) <= sphere[3] ** 2
    return inside


def _rotation_matrix(degrees: tuple[float, float, float]) -> F64:
    """Return the matrix, [3, 3], of rotations about the fixed axes x, y and z, in this order, counterclockwise."""
    matrix = np.eye(3)
    for axis, angle in enumerate(np.radians(degrees)):
        turn = np.eye(3)
        i, j = (axis + 1) % 3, (axis + 2) % 3
        c, s = np.cos(angle), np.sin(angle)
        turn[i, i], turn[i, j], turn[j, i], turn[j, j] = c, -s, s, c
        matrix = turn @ matrix
    return matrix


@dataclass(frozen=True)
class Conversion:
    """The outcome of a conversion.

    Attributes:
        source_format, target_format: names of the formats.
        source_count: number of splats of the source.
        count, sh_degree: number of splats and SH degree of the target.
        floater_count: number of floaters dropped.
        levels: number of splats of each level of detail of the target, finest first.
        source_bytes, size_bytes: sizes of the files; in a dry run the latter is an estimate, or `None` if unknown.
        lost: contents that the reader leaves out or the target format does not support.
        rounded: names of the arrays that the target rounds.
        losses: findings about values that the target does not hold: clamped, or moved visibly; a dry run does not find
            the latter.
        axes: axes before and after.
        filter_axes: axes along which the filters were given.
        findings: lint findings in the source.
    """

    source_format: str
    target_format: str
    source_count: int
    count: int
    floater_count: int
    sh_degree: int
    levels: tuple[int, ...]
    source_bytes: int
    size_bytes: int | None
    lost: tuple[str, ...]
    rounded: tuple[str, ...]
    losses: tuple[Finding, ...]
    axes: tuple[str, str]
    filter_axes: str
    findings: tuple[Finding, ...]

    def as_json(self) -> dict[str, Any]:
        """Return everything as JSON-compatible values."""
        return {
            "source_format": self.source_format,
            "format": self.target_format,
            "source_splats": self.source_count,
            "splats": self.count,
            "floaters": self.floater_count,
            "sh_degree": self.sh_degree,
            "levels": list(self.levels),
            "source_bytes": self.source_bytes,
            "size_bytes": self.size_bytes,
            "lost": list(self.lost),
            "rounded": list(self.rounded),
            "losses": findings_as_json(self.losses),
            "axes": list(self.axes),
            "filter_axes": self.filter_axes,
            "findings": findings_as_json(self.findings),
        }

    def lost_words(self) -> str:
        """Describe in one line the contents and precision that are lost. The line is empty if nothing is lost.

        Attributes with a finding in `losses` are left out: more than their precision is lost.
        """
        rounded = [name for name in self.rounded if name not in {finding.attribute for finding in self.losses}]
        return "; ".join([*self.lost, *([f"precision of {', '.join(rounded)}"] if rounded else [])])


def convert_file(
    source: str,
    target: str,
    *,
    read_as: str | None = None,
    write_as: str | None = None,
    level: int = 0,
    max_splats: int | None = None,
    overrides: MetadataOverrides | None = None,
    filters: Filters | None = None,
    no_loss: bool = False,
    dry_run: bool = False,
    preset: PresetName = "balanced",
    progress: Progress | None = None,
) -> Conversion:
    """Read a scene in one format and write it in another, block by block.

    Args:
        source: a file, or a folder, or `-`.
        target: the file or folder to write; it is replaced without a check.
        read_as: name of the source's format, if its content does not identify it.
        write_as: name of the target's format; `None`: by the file name ending.
        level: level of detail to read if the source has several; 0 is the finest. Streamed SOG (a target
            lod-meta.json) gets it and all coarser levels.
        max_splats: as in `csplat.open`; streamed SOG gets one level then.
        overrides: overrides of the source's metadata.
        filters: changes of the scene. By default, they are along `to_axes`, otherwise along the axes of the source's
            format, if these are fixed, although the scene is read along others.
        no_loss: refuse if anything would be lost.
        dry_run: write nothing.
        preset: precision of formats that have several, which is SPZ.
        progress: progress callback; some formats read splats twice.

    Raises:
        CsplatError: the source is damaged, the target cannot hold it, or `no_loss` is set and something is lost.
        OSError: a file cannot be read or written.
    """
    path = Path(target)
    writes = (format_by_suffix(path) if write_as is None else format_by_name(write_as)).at(preset)
    if writes.write is None:
        raise InputError(f"{target} has the name of {writes.title}, which csplat does not write")
    if writes.takes_levels(path) and resolve_links(path.parent) in (
        place := resolve_links(source),
        *place.parents,
    ):
        raise InputError(f"{source} is in the folder of {target}, which a new folder replaces: name another")
    changes, sh_degree = filters or Filters(), None if filters is None else filters.sh_degree
    with local_path(source) as local, ExitStack() as stack:

        def opened(number: int) -> Scene:
            scene = csplat.open(local, read_as, level=number, max_splats=max_splats, sh_degree=sh_degree)
            return stack.enter_context(scene)

        reader = opened(level)
        has_levels = writes.takes_levels(path) and max_splats is None
        more = [opened(number) for number in range(level + 1, len(reader.levels))] if has_levels else []
        if more and changes.drop_floaters:
            raise InputError("floaters cannot be dropped from several levels: coarser ones have too few splats to tell")
        before = (overrides or MetadataOverrides()).apply(reader.metadata).coordinate_system
        own = reader.file_axes if overrides is None or overrides.coordinate_system is None else ""
        filter_axes = changes.axes or changes.to_axes or own or before
        changes = replace(changes, axes=None if filter_axes == UNSPECIFIED else filter_axes)
        last = Filters(drop_floaters=changes.drop_floaters, sh_degree=sh_degree)
        changes = replace(changes, drop_floaters=False, sh_degree=None)
        levels = [changes.apply((overrides or MetadataOverrides()).apply_to_scene(scene)) for scene in (reader, *more)]
        count, levels = levels[0].count, [last.apply(scene) for scene in levels]
        if writes.name in _WITH_VIEW and not dry_run and not writes.keeps(levels[0]):
            levels = [with_first_view(levels[0], progress=progress)]
        scene, counts = levels[0], tuple(changed.count for changed in levels if changed.count)
        if no_loss:
            for _ in reader.blocks():  # which may add findings
                pass
        left_out = _left_out(reader, whole=bool(level or max_splats is not None or has_levels))
        lost, keeps = writes.losses(scene), writes.keeps(scene)
        exact = frozenset(ARRAYS) if keeps else writes.exact - ({"means"} if scene.has_doubles else set())
        rounded = tuple(name for name in ARRAYS if name not in exact and (name != "shN" or scene.sh_degree))
        result = Conversion(
            reader.format, writes.name, reader.count, scene.count, count - scene.count, scene.sh_degree, counts or (0,),
            size_on_disk(local), writes.expected_bytes(scene), (*left_out, *lost), rounded, (),
            (before, writes.axes or scene.metadata.coordinate_system), filter_axes, (),
        )  # fmt: skip
        repairs = [finding for finding in reader.findings if finding.kind == "repair"]
        if no_loss and (result.lost or rounded or repairs):
            told = {words for finding in repairs for words in finding.lost}
            rest = replace(result, lost=tuple(words for words in result.lost if words not in told)).lost_words()
            reasons = [rest] * bool(rest) + [f"{finding.id}: {finding.text}" for finding in repairs]
            raise InputError(f"{writes.title} does not keep all of {source}: {'; '.join(reasons)}")
        reporting = [
            changed if keeps else with_progress(changed, f"reading level {level + at}" if more else "reading", progress)
            for at, changed in enumerate(levels)
        ]
        if dry_run:
            losses = survey_losses(reporting, writes.name, preset)
        else:
            losses = write_levels(path, reporting, writes.name, preset)
            result = replace(result, size_bytes=size_on_disk(path))
        result = replace(result, losses=tuple(finding for finding in losses if finding.id != "lost-contents"))
        findings = tuple(finding for finding in reader.findings if not (more and finding.id == "levels"))
        left_out = _left_out(reader, whole=bool(level or max_splats is not None or has_levels))  # also by its blocks
        return replace(result, lost=(*left_out, *lost), findings=findings)


def _left_out(scene: Scene, *, whole: bool) -> list[str]:
    """Return what the reader of a scene leaves out, in a few words each; its coarser levels, too, unless `whole`."""
    words = [lost for finding in scene.findings for lost in finding.lost]
    coarser = 0 if whole else len(scene.levels) - 1
    return [*dict.fromkeys(words), *([f"{counted(coarser, 'coarser level')} of detail"] if coarser > 0 else [])]


def decode_file(
    source: str,
    target: str,
    *,
    sh_degree: int | None = None,
    absolute: bool = False,
    limit_splats: int | None = None,
    overrides: MetadataOverrides | None = None,
    progress: Progress | None = None,
) -> tuple[int, int]:
    """Decode a .csplat file to a PLY, block by block.

    Args:
        source: the file, or `-`.
        target: the PLY to write, or `-`; it is replaced without a check.
        sh_degree: drop the SH bands above.
        absolute: add the origin and write doubles.
        limit_splats: refuse a scene of more splats; `None`: no limit.
        overrides: overrides of the file's metadata for the PLY.
        progress: progress callback.

    Returns:
        The number of splats written, and their SH degree.

    Raises:
        CsplatError: the file is not valid, or too large; no PLY is written then.
        OSError: a file cannot be read or written.
    """
    limits = None if limit_splats is None else Limits(splats=limit_splats)
    with mapped_csplat(source) as data, SplatFile.open(data, limits=limits) as decoded:
        # All bands are decoded, even if some are dropped, so that damage anywhere is found.
        scene = Filters(sh_degree=sh_degree).apply((overrides or MetadataOverrides()).apply_to_scene(decoded))
        if is_one_way(target):
            for _ in with_progress(decoded, "checking", progress).blocks():
                pass
        write_model(target, with_progress(scene, "decoding", progress), absolute=absolute)
    return scene.count, scene.sh_degree

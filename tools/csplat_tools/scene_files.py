# SPDX-License-Identifier: Apache-2.0
"""Read scenes in any format, and override their metadata."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

import csplat
from csplat import formats
from csplat.context import DEFAULT_CONTEXT, Context
from csplat.disk_files import size_on_disk
from csplat.errors import LimitError
from csplat.file_source import File
from csplat.lint import Finding, refuse
from csplat.model import SplatModel
from csplat.ply.column_names import dropped_columns
from csplat.scene import Scene, drop_bands, join_blocks
from csplat.scene_metadata import AUTHOR, LICENCE, VIEW, Direction, SceneMetadata
from csplat.splat_file import SplatFile
from csplat.system import available_memory_bytes
from csplat.types import Progress
from csplat_render.camera_files import load_cameras
from csplat_render.first_view import SAMPLE_SPLATS, view_entry, viewing_metadata
from csplat_tools.file_streams import is_csplat, kept_path, local_path, naming, source_path

#: Formats that are opened without unpacking, and are read as a whole in fewer passes.
CHEAP_TO_REOPEN = ("ply", "csplat")
_SMALL = 1 << 20  # bytes; smaller files of any format always fit in memory
#: Bytes of memory of a comparison in addition to the scenes' arrays: for the program, and per splat.
_BASE_BYTES, _SPLAT_BYTES = 200_000_000, 320
#: Largest number of splats, about, by which cameras are placed in a .csplat file with levels.
FRAMED_SPLATS = 2_000_000
_SAMPLE_SPLATS = 1 << 19  # splats of a sample of a scene that does not fit in memory


#: A scene as an argument: a model, an open scene, or a file in any format.
SceneLike = SplatModel | Scene | File


def load_scene(
    scene: SceneLike, *, level: int = 0, max_splats: int | None = None, sh_degree: int | None = None
) -> Scene:
    """Read a scene in any format into memory.

    Args:
        scene: a path, an open binary file, or bytes; the path `-` is standard input. A model or a scene in memory is
            not read again. A model counts with the size of its plain PLY.
        level, max_splats, sh_degree: as in `csplat.open`.

    Returns:
        The scene, whose splats are its `in_memory`; a `SplatFile` for level 0 of a .csplat file.

    Raises:
        CsplatError: the scene is not valid, or not a file.
        LimitError: the scene does not fit in the free memory.
        OSError: the file cannot be read.
    """
    if isinstance(scene, SplatModel):
        return Scene.of(scene).changed(size_bytes=len(scene) * ply_splat_bytes(scene.sh_degree), name="scene")
    if isinstance(scene, Scene) and scene.in_memory is not None:
        return scene
    if not isinstance(scene, Scene):
        with local_path(scene) as local:
            if not (level or max_splats is not None or is_csplat(local)):
                _check_fits(size_on_disk(local))
                return formats.read_scene(local, sh_degree=sh_degree)
            with csplat.open(local, level=level, max_splats=max_splats, sh_degree=sh_degree) as opened:
                return load_scene(opened)
    _check_fits(scene.count * ply_splat_bytes(scene.sh_degree))
    return scene.loaded()


def _check_fits(wanted_bytes: int) -> None:
    """Check that this number of bytes is available in memory.

    Raises:
        LimitError: it is not.
    """
    free_bytes = available_memory_bytes()
    if wanted_bytes > free_bytes:
        raise LimitError("memory for all splats at once", wanted_bytes, free_bytes)


def splats_to_frame(path: str, model: SplatModel) -> SplatModel:
    """Return the splats by which cameras are placed: some of level 0, so that all levels have the same cameras.

    Args:
        path: path of the scene; standard input and pipes cannot be read again.
        model: the splats that were read, which are returned unless they are of a .csplat file with levels.

    Raises:
        CsplatError, OSError: as for `load_scene`.
    """
    if not Path(path).is_file() or not is_csplat(Path(path)):
        return model
    with SplatFile.open(path) as file:
        tiles = range(len(file.header.tiles))
        every = max(1, -(-file.count // FRAMED_SPLATS))
        if not file.header.coarse_tiles or len(model) == file.count <= FRAMED_SPLATS:
            return model
        return file.read(tiles=tiles[::every], sh_degree=0)


def read_source(
    file: File,
    overrides: MetadataOverrides | None = None,
    *,
    format: str | None = None,
    strict: bool = False,
    keep_extra: bool = False,
    sh_degree: int | None = None,
    opened: Scene | None = None,
    in_memory: bool = True,
    context: Context = DEFAULT_CONTEXT,
) -> Scene:
    """Read a scene to be encoded, and repair defects if that is safe.

    Args:
        file: a path, or `-`; an open binary file; or bytes.
        overrides: overrides of the scene's metadata.
        format, sh_degree: as in `csplat.open`.
        strict: refuse defects that would be repaired.
        keep_extra: keep additional columns.
        opened: the scene of the file, if it is open, with `sh_degree`.
        in_memory: read all splats into memory. Otherwise the result is `opened` with the overrides.
        context: threads and progress.

    Raises:
        CsplatError: the scene is not valid.
        OSError: the scene cannot be read.
    """
    overrides = overrides or MetadataOverrides()
    if opened is not None and not in_memory:
        refuse(opened.findings, strict=strict)
        return overrides.apply_to_scene(opened)
    context.progress("reading", 0.0)
    with source_path(file) as local:
        if opened is None or opened.format in CHEAP_TO_REOPEN:
            scene = formats.read_scene(
                local, format, strict=strict, keep_extra=keep_extra, sh_degree=sh_degree, context=context
            )
        else:
            scene = (opened if keep_extra else opened.without_extra()).loaded()
            refuse(scene.findings, strict=strict)
    context.progress("reading", 1.0)
    assert scene.in_memory is not None
    model = overrides.apply_to_model(scene.in_memory)
    return scene.changed(metadata=model.metadata, in_memory=model)


@contextmanager
def open_scenes(scenes: Sequence[SceneLike], context: Context = DEFAULT_CONTEXT) -> Iterator[Sequence[Scene]]:
    """Read scenes for a comparison into memory, or open all of them if they do not fit together.

    Args:
        scenes: as for `load_scene`. If any is in memory already, all are read into memory; scenes that are open
            remain so.
        context: memory; the limit is approximate.

    Yields:
        The scenes, which can be read within the context. Scenes in memory are as from `load_scene`.

    Raises:
        CsplatError: as for `load_scene`.
        OSError: a file cannot be read.
    """
    if all(isinstance(scene, Scene) and scene.in_memory is None for scene in scenes):
        yield [scene for scene in scenes if isinstance(scene, Scene)]
        return
    with ExitStack() as stack:
        local: dict[int, Path] = {}
        fits: dict[int, Scene] = {}
        for place, scene in enumerate(scenes):
            if not isinstance(scene, (SplatModel, Scene)):
                with naming(scene):
                    local[place] = stack.enter_context(kept_path(scene))
        has_large = context.memory is not None or any(size_on_disk(path) > _SMALL for path in local.values())
        if len(local) == len(scenes) and has_large:
            with ExitStack() as opening:
                opened = [_open_on_stack(opening, scenes[place], path) for place, path in local.items()]
                if _together_bytes(opened) > context.memory_limit:
                    stack.push(opening.pop_all())
                    yield opened
                    return
                fits = {
                    place: scene.loaded() for place, scene in enumerate(opened) if scene.format not in CHEAP_TO_REOPEN
                }
        loaded = []
        for place, scene in enumerate(scenes):
            with naming(scene):
                loaded.append(fits[place] if place in fits else load_scene(local.get(place, scene)))
        yield loaded


def _open_on_stack(stack: ExitStack, source: object, path: Path) -> Scene:
    """Open a scene until the stack ends; errors of opening and, but for .csplat files, of reading name the source."""
    with naming(source):
        scene = stack.enter_context(csplat.open(path))

    def reader() -> Iterator[SplatModel]:
        """Yield the scene's blocks; errors name the source."""
        with naming(source):
            yield from scene.blocks()

    return scene if isinstance(scene, SplatFile) else scene.changed(reader=reader)


def _together_bytes(scenes: Sequence[Scene]) -> float:
    """Estimate the bytes of memory for a comparison with all splats in memory."""
    arrays = sum(scene.count * ply_splat_bytes(scene.sh_degree) for scene in scenes)
    return _BASE_BYTES + arrays + _SPLAT_BYTES * max(scene.count for scene in scenes)


def sample_scene(
    scene: Scene, *, splats_max: int = _SAMPLE_SPLATS, progress: Progress | None = None
) -> tuple[SplatModel, int]:
    """Return every Nth splat without SH bands, and N; for a scene in memory, all splats and 1.

    Args:
        scene: the scene; its blocks are read once.
        splats_max: largest number of splats.
        progress: progress callback.

    Raises:
        CsplatError: the scene is truncated or damaged.
    """
    if scene.in_memory is not None:
        return scene.in_memory, 1
    every = max(1, -(-scene.count // splats_max))
    parts = []
    for rows, block in scene.numbered():
        parts.append(_plain(block.select(np.arange(-rows.start % every, len(block), every))))
        if progress is not None:
            progress("sampling the scene", rows.stop / scene.count)
    return join_blocks(_plain(scene.empty()), parts), every


def _plain(model: SplatModel) -> SplatModel:
    return replace(drop_bands(model, 0), extra={}, means_double=None)


def scene_sizes(scene: Scene) -> dict[str, Any]:
    """Return size and counts as JSON-compatible values."""
    return {
        "size_bytes": scene.size_bytes,
        "splats": scene.count,
        "sh_degree": scene.sh_degree,
        "bytes_per_splat": scene.size_bytes / scene.count if scene.count else None,
    }


def findings_of(scene: Scene) -> Sequence[Finding]:
    """Return the findings about a scene, and that its extra columns are not compared or shown."""
    is_open_ply = scene.format == "ply" and scene.in_memory is None and scene.extra
    return [*scene.findings, *([dropped_columns(list(scene.extra))] if is_open_ply else [])]


def findings_as_json(findings: tuple[Finding, ...] | list[Finding]) -> list[dict[str, Any]]:
    """Return findings as JSON-compatible values."""
    return [
        {"id": finding.id, "kind": finding.kind, "count": finding.count, "text": finding.text}
        | ({"attribute": finding.attribute, "largest_error": finding.largest_error} if finding.attribute else {})
        for finding in findings
    ]


def ply_splat_bytes(sh_degree: int) -> int:
    """Return the bytes of a splat in a PLY of the INRIA trainer, which has float columns: 248 at SH degree 3."""
    return 4 * (14 + 3 * (sh_degree + 1) ** 2)  # 14: position, normal, opacity, scale, rotation; the others: colours


def with_first_view(
    scene: Scene, camera: str | Path | None = None, *, report: list[str] | None = None, progress: Progress | None = None
) -> Scene:
    """Return a scene whose metadata have a first view and an up direction, as `viewing_metadata` chooses them.

    Args:
        scene: the scene; its blocks are read once if it is not in memory and lacks one of both.
        camera: a camera file, whose first camera is the view of an author; `None`: a view that the scene has, or an
            estimate.
        report: receives remarks on camera files of other programs.
        progress: progress callback.

    Raises:
        InputError: the camera file has no cameras.
        CsplatError: the scene is truncated or damaged.
    """
    metadata = scene.metadata
    if camera is not None:
        first = load_cameras(camera, report, scene.origin)[0]
        metadata = metadata.with_entries(view=view_entry(first, AUTHOR))
    if VIEW not in metadata.entries or metadata.up is None:
        sample, every = sample_scene(scene, splats_max=SAMPLE_SPLATS, progress=progress)
        metadata = viewing_metadata(sample.with_metadata(metadata), every=every)
    if scene.in_memory is not None:
        return scene.changed(metadata=metadata, in_memory=scene.in_memory.with_metadata(metadata))
    return scene.map(lambda block: block.with_metadata(metadata))


def with_progress(scene: Scene, stage: str, progress: Progress | None) -> Scene:
    """Return the scene with blocks that report progress while they are written."""
    if progress is None:
        return scene
    reporting = scene.with_progress(stage, progress)

    def blocks() -> Iterator[SplatModel]:
        yield from reporting.blocks()
        progress("writing", 0.0)  # the blocks have been read; another pass restarts the stage

    return scene.changed(reader=blocks)


@dataclass(frozen=True)
class MetadataOverrides:
    """Overrides of a scene's metadata; `None` keeps the file's.

    Attributes:
        coordinate_system, unit_metres, antialiased: as in `SceneMetadata`.
        licence: text for the metadata.
        up: the up direction, see `SceneMetadata.with_up`.
    """

    coordinate_system: str | None = None
    unit_metres: float | None = None
    antialiased: bool | None = None
    licence: str | None = None
    up: Direction | None = None

    def apply(self, metadata: SceneMetadata) -> SceneMetadata:
        """Return metadata with these overrides."""
        changes: dict[str, Any] = {
            name: value for name in ("unit_metres", "antialiased") if (value := getattr(self, name)) is not None
        }
        if self.licence is not None:
            changes["entries"] = {**metadata.entries, LICENCE: self.licence}
        return replace(metadata, **changes).with_up(self.up, self.coordinate_system)

    def apply_to_model(self, model: SplatModel) -> SplatModel:
        """Return the model with these overrides."""
        return model.with_metadata(self.apply(model.metadata))

    def apply_to_scene(self, scene: Scene) -> Scene:
        """Return the scene with these overrides; the scene itself without any."""
        if self == MetadataOverrides():
            return scene
        metadata = self.apply(scene.metadata)
        return scene.map(lambda block: block.with_metadata(metadata))

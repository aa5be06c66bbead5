"""Read scenes in any format, and override their metadata."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from csplat import formats, splat_file
from csplat import scene_source as scenes
from csplat.decoder import DeclaredBounds, Limits, SceneHeader, decode_scene
from csplat.editing.up_axis import Direction, with_up
from csplat.errors import LimitError
from csplat.file_source import File
from csplat.lint import Finding
from csplat.model import SplatModel
from csplat.ply.column_names import dropped_columns
from csplat.scene_source import SceneSource, drop_bands, join_blocks
from csplat.system import available_memory_bytes, default_memory_bytes
from csplat.types import Progress, null_progress
from csplat_tools.file_streams import is_csplat, kept_path, local_path, mapped_csplat, naming, source_path

#: Names of files that represent the whole folder they are in: SOG as a folder, and with levels.
FOLDER_NAMES = ("meta.json", "lod-meta.json")

#: Formats that are opened without unpacking, and are read as a whole in fewer passes.
CHEAP_TO_REOPEN = ("ply", "csplat")
_SMALL = 1 << 20  # bytes; smaller files of any format always fit in memory
#: Bytes of memory of a comparison in addition to the scenes' arrays: for the program, and per splat.
_BASE_BYTES, _SPLAT_BYTES = 200_000_000, 320
#: Largest number of splats, about, by which cameras are placed in a .csplat file with levels.
FRAMED_SPLATS = 2_000_000


@dataclass(frozen=True, eq=False)
class LoadedModel:
    """A scene in memory, with the metadata of its file.

    Attributes:
        model: the splats.
        size_bytes: size of the file; of the tiles, for a coarser version in a .csplat file; of its plain PLY, for a
            model without a file.
        header: header of a .csplat file; `None` for other formats.
        declared_bounds: declared error bounds of a .csplat file, if any.
        name: name of the file.
        findings: lint findings.
    """

    model: SplatModel
    size_bytes: int
    header: SceneHeader | None = None
    declared_bounds: DeclaredBounds | None = None
    name: str = "scene"
    findings: tuple[Finding, ...] = ()

    def _repr_html_(self) -> str | None:
        """Return the HTML that a notebook shows, see `SplatModel`."""
        return self.model._repr_html_()  # the protocol of notebooks

    def sample(self, progress: Progress | None = None) -> tuple[SplatModel, int]:  # noqa: ARG002  # as in `OpenedScene`
        """Return all splats, and 1, as `OpenedScene.sample` does."""
        return self.model, 1

    @property
    def count(self) -> int:
        """Number of splats."""
        return len(self.model)

    @property
    def metadata_model(self) -> SplatModel:
        """The model itself, for its metadata."""
        return self.model

    def as_json(self) -> dict[str, Any]:
        """Return size and counts as JSON-compatible values."""
        return _sizes(self.count, self.metadata_model, self.size_bytes)


@dataclass(frozen=True, eq=False)
class OpenedScene:
    """A scene that is open, but not in memory.

    Attributes:
        scene: the splats, in blocks.
        size_bytes: size of the file.
        path: path of the file.
        memory_bytes: approximate limit of the memory for working with the scene.
        sample_splats: largest number of splats in the sample.
    """

    scene: SceneSource
    size_bytes: int
    path: Path
    memory_bytes: int
    sample_splats: int = 1 << 19
    _sample: list[SplatModel] = field(default_factory=list, init=False)

    def sample(self, progress: Progress | None = None) -> tuple[SplatModel, int]:
        """Return every Nth splat, without SH bands, and N. The sample is read once and cached.

        Raises:
            CsplatError: the scene is truncated or damaged.
        """
        every = max(1, -(-self.count // self.sample_splats))
        if not self._sample:
            parts = []
            for rows, block in self.scene.numbered():
                if progress is not None:
                    progress("sampling the scene", rows.start / max(1, self.count))
                parts.append(_plain(block.select(np.arange(-rows.start % every, len(block), every))))
            self._sample.append(join_blocks(_plain(self.metadata_model), parts))
        return self._sample[0], every

    @property
    def count(self) -> int:
        """Number of splats."""
        return self.scene.count

    @property
    def findings(self) -> tuple[Finding, ...]:
        """Lint findings."""
        extra = list(self.metadata_model.extra)
        return (*self.scene.findings, *([dropped_columns(extra)] if extra and self.scene.format == "ply" else []))

    @property
    def metadata_model(self) -> SplatModel:
        """A model without splats that has the scene's metadata."""
        return self.scene.metadata_model

    def as_json(self) -> dict[str, Any]:
        """Return size and counts as JSON-compatible values."""
        return _sizes(self.count, self.metadata_model, self.size_bytes)


def _plain(model: SplatModel) -> SplatModel:
    return replace(drop_bands(model, 0), extra={}, means_double=None)


def _sizes(count: int, metadata_model: SplatModel, size_bytes: int) -> dict[str, Any]:
    return {
        "size_bytes": size_bytes,
        "splats": count,
        "sh_degree": metadata_model.sh_degree,
        "bytes_per_splat": size_bytes / count if count else None,
    }


#: A scene as an argument: a model, or a file in any format.
SceneLike = SplatModel | LoadedModel | File


def load_model(
    scene: SceneLike, *, level: int = 0, max_splats: int | None = None, sh_degree: int | None = None
) -> LoadedModel:
    """Read a scene in any format (`csplat.formats.formats()`), detected by its content.

    Args:
        scene: a path, an open binary file, or bytes; the path `-` is standard input. A model or a `LoadedModel` is
            not read again.
        level, max_splats: as in `csplat.formats.open_scene`. A version other than level 0 has no header and no bounds.
        sh_degree: drop the SH bands above; required to read files of a higher degree than 4. `None`: keep all.

    Examples:
        >>> import csplat_tools
        >>> scene = csplat_tools.load_model("scene.csplat")
        >>> scene.model, len(scene.header.tiles), scene.size_bytes < 20_000
        (SplatModel(1000 splats, sh_degree=3), 1, True)

    Raises:
        CsplatError: the scene is not valid, or not a file.
        LimitError: the scene does not fit in the free memory.
        OSError: the file cannot be read.
    """
    if isinstance(scene, LoadedModel):
        return scene
    if isinstance(scene, SplatModel):
        return LoadedModel(scene, len(scene) * ply_splat_bytes(scene.sh_degree))
    with local_path(scene) as local:
        if level or max_splats is not None:
            return _load_version(local, level, max_splats, sh_degree)
        return _loaded(local, sh_degree)


def _load_version(local: Path, level: int, max_splats: int | None, sh_degree: int | None) -> LoadedModel:
    with formats.open_scene(local, level=level, max_splats=max_splats, sh_degree=sh_degree) as scene:
        wanted, free = scene.count * ply_splat_bytes(scene.metadata_model.sh_degree), available_memory_bytes()
        if wanted > free:
            raise LimitError("memory for all splats at once", wanted, free)
        model = formats.read_all(scene)
    size_bytes = size_on_disk(local)
    if is_csplat(local):
        with splat_file.open(local) as file:
            tiles = file.cut(level=level) if max_splats is None else file.cut(max_splats=max_splats)
            size_bytes = sum(layer.size for index in tiles for layer in file.header.all_tiles[index].layers.values())
    return LoadedModel(model, size_bytes, name=local.name, findings=tuple(scene.findings))


def splats_to_frame(path: str, model: SplatModel) -> SplatModel:
    """Return the splats by which cameras are placed: some of level 0, so that all levels have the same cameras.

    Args:
        path: path of the scene; standard input and pipes cannot be read again.
        model: the splats that were read, which are returned unless they are of a .csplat file with levels.

    Raises:
        CsplatError, OSError: as for `load_model`.
    """
    if not Path(path).is_file() or not is_csplat(Path(path)):
        return model
    with splat_file.open(path) as file:
        header = file.header
        tiles = [number for number, tile in enumerate(header.all_tiles) if tile.level == 0]
        every = max(1, -(-header.splat_count // FRAMED_SPLATS))
        if len(tiles) == len(header.all_tiles) or len(model) == header.splat_count <= FRAMED_SPLATS:
            return model
        return file.read(tiles=tiles[::every], sh_degree=0)


def _loaded(local: Path, sh_degree: int | None = None) -> LoadedModel:
    size_bytes, name, free = size_on_disk(local), local.name, available_memory_bytes()
    if not is_csplat(local):
        if size_bytes > free:
            raise LimitError("memory for all splats at once", size_bytes, free)
        findings: list[Finding] = []
        model = formats.read(local, sh_degree=sh_degree, report=findings)
        return LoadedModel(model, size_bytes, name=name, findings=tuple(findings))
    with mapped_csplat(str(local)) as data:
        decoded = decode_scene(data, limits=Limits(bytes=min(Limits().bytes, free)), sh_degree=sh_degree)
    return LoadedModel(decoded.model, size_bytes, decoded.header, decoded.declared_bounds, name)


def read_source(
    file: File,
    overrides: MetadataOverrides | None = None,
    *,
    strict: bool = False,
    keep_extra: bool = False,
    sh_degree: int | None = None,
    opened: SceneSource | None = None,
    progress: Progress | None = None,
) -> LoadedModel:
    """Read a scene to be encoded, in any format but .csplat, and repair defects if that is safe.

    Args:
        file: a path, or `-`; an open binary file; or bytes.
        overrides: overrides of the scene's metadata.
        strict: refuse defects that would be repaired.
        keep_extra: keep additional columns.
        sh_degree: as for `load_model`.
        opened: the scene of the file, if it is open; `sh_degree` has no effect then.
        progress: progress callback.

    Raises:
        CsplatError: the scene is not valid.
        OSError: the scene cannot be read.
    """
    findings: list[Finding] = []
    report = progress or null_progress
    report("reading", 0.0)
    with source_path(file) as local:
        if opened is None:
            model = formats.read(local, strict=strict, keep_extra=keep_extra, sh_degree=sh_degree, report=findings)
        else:
            model = formats.read_all(opened, strict=strict, keep_extra=keep_extra, report=findings)
        size_bytes, name = size_on_disk(local), local.name
    report("reading", 1.0)
    return LoadedModel((overrides or MetadataOverrides()).apply(model), size_bytes, name=name, findings=tuple(findings))


@contextmanager
def open_scenes(
    given: Sequence[SceneLike | OpenedScene], memory_bytes: int | None = None
) -> Iterator[Sequence[LoadedModel] | Sequence[OpenedScene]]:
    """Read scenes for a comparison into memory, or open all of them if they do not fit together.

    Args:
        given: scenes as for `load_model`. If one is in memory already, all are read into memory; if all are open
            already, they remain so.
        memory_bytes: approximate limit of the memory; `None`: half of the free memory.

    Yields:
        The scenes, which can be read within the context.

    Raises:
        CsplatError: as for `load_model`.
        OSError: a file cannot be read.
    """
    opened = [one for one in given if isinstance(one, OpenedScene)]
    if opened:
        assert len(opened) == len(given), "either all scenes are in memory, or none"
        yield opened
        return
    bound = default_memory_bytes() if memory_bytes is None else memory_bytes
    with ExitStack() as stack:
        local: dict[int, Path] = {}
        fits: dict[int, LoadedModel] = {}
        for place, one in enumerate(given):
            if not isinstance(one, (SplatModel, LoadedModel, OpenedScene)):
                with naming(one):
                    local[place] = stack.enter_context(kept_path(one))
        has_large = memory_bytes is not None or any(size_on_disk(path) > _SMALL for path in local.values())
        if len(local) == len(given) and has_large:
            opening = stack.enter_context(ExitStack())
            found = [_opened(opening, given[place], path, bound) for place, path in local.items()]
            if _together_bytes(found) > bound:
                yield found
                return
            fits = {
                place: _in_memory(one) for place, one in enumerate(found) if one.scene.format not in CHEAP_TO_REOPEN
            }
            opening.close()
            del found
        loaded = []
        for place, one in enumerate(given):
            if place in fits:
                loaded.append(fits[place])
                continue
            if isinstance(one, (SplatModel, LoadedModel)):
                loaded.append(load_model(one))
                continue
            with naming(one):
                loaded.append(_loaded(local[place]))
        yield loaded


def _opened(stack: ExitStack, given: object, path: Path, bound: int) -> OpenedScene:
    with naming(given):
        scene = stack.enter_context(formats.open_scene(path))

    def blocks() -> Iterator[SplatModel]:
        with naming(given):
            yield from scene.blocks()

    return OpenedScene(replace(scene, blocks=blocks), size_on_disk(path), path, bound)


def _in_memory(opened: OpenedScene) -> LoadedModel:
    model = formats.read_all(opened.scene)
    return LoadedModel(model, opened.size_bytes, name=opened.path.name, findings=tuple(opened.findings))


def _together_bytes(found: Sequence[OpenedScene]) -> float:
    """Estimate the bytes of memory for a comparison with all splats in memory."""
    arrays = sum(one.count * ply_splat_bytes(one.metadata_model.sh_degree) for one in found)
    return _BASE_BYTES + arrays + _SPLAT_BYTES * max(one.count for one in found)


def size_on_disk(path: Path) -> int:
    """Return the size in bytes of a file, or of all files of a folder; for SOG, without other files of its folder."""
    manifest = path.name.lower() if path.name.lower() in FOLDER_NAMES else ""
    if not (path.is_dir() or manifest):
        return path.stat().st_size
    folder = path if path.is_dir() else path.parent
    manifest = manifest or next((name for name in reversed(FOLDER_NAMES) if (folder / name).is_file()), "")
    inside = folder.iterdir() if manifest == "meta.json" else folder.rglob("*")
    parts = (".webp", *FOLDER_NAMES) if manifest else ("",)
    return sum(one.stat().st_size for one in inside if one.name.lower().endswith(parts) and one.is_file())


def findings_as_json(findings: tuple[Finding, ...] | list[Finding]) -> list[dict[str, Any]]:
    """Return findings as JSON-compatible values."""
    return [
        {"id": one.id, "kind": one.kind, "count": one.count, "text": one.text}
        | ({"attribute": one.attribute, "largest_error": one.largest_error} if one.attribute else {})
        for one in findings
    ]


def ply_splat_bytes(sh_degree: int) -> int:
    """Return the bytes of a splat in a PLY of the INRIA trainer, which has float columns: 248 at SH degree 3."""
    return 4 * (14 + 3 * (sh_degree + 1) ** 2)  # 14: position, normal, opacity, scale, rotation; the others: colours


def with_progress(scene: SceneSource, stage: str, progress: Progress | None) -> SceneSource:
    """Return the scene with blocks that report progress while they are written."""
    if progress is None:
        return scene
    reporting = scenes.with_progress(scene, stage, progress)

    def blocks() -> Iterator[SplatModel]:
        yield from reporting.blocks()
        progress("writing", 0.0)  # the blocks have been read; another pass restarts the stage

    return replace(scene, blocks=blocks)


def without_extra_columns(scene: SceneSource) -> SceneSource:
    """Return the scene without additional columns."""
    if not scene.metadata_model.extra:
        return scene
    return replace(
        scene,
        metadata_model=replace(scene.metadata_model, extra={}),
        blocks=lambda: (replace(model, extra={}) for model in scene.blocks()),
    )


@dataclass(frozen=True)
class MetadataOverrides:
    """Overrides of a scene's metadata; `None` keeps that of the file.

    Attributes:
        coordinate_system, unit_metres, antialiased: as in `SplatModel`.
        licence: text for the metadata.
        up: the up direction, see `with_up`.
    """

    coordinate_system: str | None = None
    unit_metres: float | None = None
    antialiased: bool | None = None
    licence: str | None = None
    up: Direction | None = None

    def apply(self, model: SplatModel) -> SplatModel:
        """Return the model with these overrides."""
        changes: dict[str, Any] = {
            name: value for name in ("unit_metres", "antialiased") if (value := getattr(self, name)) is not None
        }
        if self.licence is not None:
            changes["metadata"] = {**model.metadata, "licence": self.licence}
        model = replace(model, **changes) if changes else model
        return with_up(model, self.up, self.coordinate_system)

    def apply_to_scene(self, scene: SceneSource) -> SceneSource:
        """Return the scene with these overrides."""
        return replace(
            scene, metadata_model=self.apply(scene.metadata_model), blocks=lambda: map(self.apply, scene.blocks())
        )

# SPDX-License-Identifier: Apache-2.0
"""Read and write splat files in any format.

Each format has a module or package with a `FORMAT`; `formats` lists them. A file is identified by its content, and by
its name only if the content is ambiguous. Scenes of formats with fixed axes are converted to x right, y down, z
forward, the axes assumed for PLY, so all scenes have the same orientation.
"""

from __future__ import annotations

import os
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, ExitStack, contextmanager
from dataclasses import replace
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING, Any
from urllib.parse import urlsplit

from csplat._spec import MAGIC
from csplat.byte_store import Store
from csplat.context import DEFAULT_CONTEXT, Context
from csplat.decoder import Limits, decode
from csplat.detect import detect_content, detect_name, read_head, refusal
from csplat.disk_files import local_file, size_on_disk, temporary_folder, work_folder
from csplat.editing.transform import DEFAULT_AXES, convert_axes
from csplat.errors import InputError
from csplat.file_source import Buffer, File, open_binary
from csplat.formats.format import ARRAYS, Format, ValueRange
from csplat.lint import Finding, refuse
from csplat.model import MAX_SH_DEGREE, SplatModel, check_model, check_sh_degree
from csplat.plugins import load_plugins
from csplat.ply import lint_ply, open_ply, read_ply, write_scene_ply
from csplat.ply.columns import HUGE_LOG
from csplat.ply.comments import unwritten_entries
from csplat.remote_store import is_url, open_store
from csplat.scene import Scene
from csplat.splat_file import SplatFile

if TYPE_CHECKING:
    from csplat.formats.common import ClampStatistics

__all__ = [
    "ARRAYS",
    "Format",
    "detect_format",
    "format_by_name",
    "format_by_suffix",
    "formats",
    "lint_file",
    "open",
    "read",
    "read_scene",
    "survey_losses",
    "write",
    "write_levels",
    "write_scene",
]

_PLY, _CSPLAT = "ply", "csplat"  # `read` calls their own readers, which load a file in one pass without extra copies


def formats() -> tuple[Format, ...]:
    """Return all formats: first the built-in formats, then the formats of plugins (`csplat.plugins`)."""
    return (*_own_formats().values(), *load_plugins("csplat.formats").values())


def read(
    file: File,
    format: str | None = None,
    *,
    strict: bool = False,
    keep_extra: bool = True,
    sh_degree: int | None = None,
) -> SplatModel:
    """Read a scene in any format into memory.

    Args:
        file, format, sh_degree: as in `open`.
        strict: refuse files that need repairs.
        keep_extra: keep columns that are not splat attributes, in `SplatModel.extra`.

    Examples:
        >>> import csplat
        >>> csplat.read("scene.ply")
        SplatModel(1000 splats, sh_degree=3)

    Raises:
        InputError: csplat cannot read the format, or the file is incomplete.
        FormatError: it is a .csplat file that violates the specification.
        OSError: it cannot be read.
    """
    return read_scene(file, format, strict=strict, keep_extra=keep_extra, sh_degree=sh_degree).model()


def read_scene(
    file: File,
    format: str | None = None,
    *,
    strict: bool = False,
    keep_extra: bool = False,
    sh_degree: int | None = None,
    context: Context = DEFAULT_CONTEXT,
) -> Scene:
    """Read a scene into memory as `read` does, on threads, with its findings, format, name and size."""
    if is_url(file):
        with open(file, format, sh_degree=sh_degree) as opened:
            return _load_scene(opened, strict=strict, keep_extra=keep_extra)
    with local_file(file) as path:
        file_format, findings = detect_format(path, format), list[Finding]()
        if file_format.name == _PLY:
            model = read_ply(
                path, strict=strict, keep_extra=keep_extra, sh_degree=sh_degree, report=findings, context=context
            )
        elif file_format.name == _CSPLAT:
            check_sh_degree(sh_degree)
            degree = None if sh_degree is None else min(sh_degree, file_format.degree)
            model = decode(path, sh_degree=degree, context=context)
        else:
            with open(path, format, sh_degree=sh_degree) as opened:
                return _load_scene(opened, strict=strict, keep_extra=keep_extra)
        scene = Scene.of(model if keep_extra or not model.extra else replace(model, extra={}))
        return scene.changed(findings=findings, format=file_format.name, name=path.name, size_bytes=size_on_disk(path))


def _load_scene(opened: Scene, *, strict: bool, keep_extra: bool) -> Scene:
    """Return a scene with all splats in memory; raise an `InputError` if its findings require that (`refuse`)."""
    scene = (opened if keep_extra else opened.without_extra()).loaded()
    refuse(scene.findings, strict=strict)
    return scene


def open(
    file: File,
    format: str | None = None,
    *,
    level: int = 0,
    max_splats: int | None = None,
    sh_degree: int | None = None,
    limits: Limits | None = None,
    storage: Mapping[str, Any] | None = None,
) -> Scene:
    """Open a scene in any format; its splats are read when they are needed.

    If the file is a `.csplat` file, only header and index are read, and the scene is a `SplatFile`, which can read
    parts of the file. A file of another format is read from disk. If it is at a URL, it is downloaded; an open file or
    bytes are copied to a temporary file.

    Args:
        file: path of a file or folder; a URL that fsspec supports (`https://…`, `s3://…`; requires the extra `remote`);
            an open binary file, which is read to its end; or bytes.
        format: name of the format, as in `formats()`, for a file whose content does not identify it; default: by its
            name.
        level: level of detail, if the file has several; 0 is the finest.
        max_splats: open the best version of at most this number of splats instead: of a `.csplat` file the cut with the
            smallest errors, of streamed SOG the finest level. `None`: open `level`.
        sh_degree: drop the SH bands above this degree, 0 to 4; the file's own degree may exceed 4. `None`: keep all.
        limits: limits of a `.csplat` file, as in `decode`, for each part.
        storage: options of fsspec's file system for the URL: `{"endpoint_url": …, "anon": True}`.

    Examples:
        >>> import csplat
        >>> with csplat.open("scene.csplat") as file:
        ...     for tile in file.tiles(sh_degree=0):
        ...         print(len(tile.means), tile.shN.shape)
        1000 (1000, 0, 3)
        >>> with csplat.open("scene.ply") as scene:
        ...     sum(len(block) for block in scene.blocks())
        1000

    Raises:
        InputError: csplat cannot read the format, the file is incomplete, or the coarsest version has more than
            `max_splats` splats; `file` has another type; storage options without a URL; the extra is not installed.
            Reading a block may raise it, too.
        FormatError, UnsupportedError: as in `read_header`, or a `.csplat` file is shorter or longer than its header
            specifies.
        StoreError: the server does not answer, does not support ranges (HTTP Range), or closes the connection, also
            when requests are repeated; or the file has changed since it was opened.
        OSError: the file does not exist or cannot be read.
    """
    with ExitStack() as stack:
        if is_url(file) or isinstance(file, Buffer):
            store = open_store(file, storage)
            stack.callback(store.close)
            (head,) = store.read([(0, min(store.size, store.sizes.first))])
            if MAGIC.startswith(head[: len(MAGIC)]):  # an empty file, too: the error is the same as in `decode`
                opened = SplatFile(store, limits or Limits(), head)
                return _version_of(_CSPLAT_FORMAT, opened, store.name, level, max_splats, sh_degree).keep_open(
                    stack.pop_all()
                )
            file = stack.enter_context(_local_copy(store))
        elif storage:
            raise InputError("storage options require a URL, and the file is not one")
        path = stack.enter_context(local_file(file))
        file_format = detect_format(path, format)
        scene = stack.enter_context(
            SplatFile.open(path, limits=limits)
            if file_format.name == _CSPLAT
            else _open_format(file_format, path, level, max_splats, sh_degree)
        )
        scene = _version_of(file_format, scene, path.name, level, max_splats, sh_degree)
        if not scene.format:
            scene = scene.changed(format=file_format.name, name=path.name, size_bytes=size_on_disk(path))
        scene.modified_ns = path.stat().st_mtime_ns
        return scene.keep_open(stack.pop_all())  # which closes a `SplatFile` itself a second time, without effect


def lint_file(path: Path) -> list[Finding]:
    """List the defects of a file in any format without refusing it.

    Args:
        path: path of the file.

    Returns:
        Findings in the order of reading; the last finding is an error if `read` would refuse the file.

    Raises:
        InputError: csplat cannot read the format, or cannot parse the header.
        OSError: the file cannot be read.
    """
    file_format = detect_format(path)
    if file_format.name == _PLY:
        return lint_ply(path)
    with _open_format(file_format, path) as scene:
        if all(finding.repairable for finding in scene.findings):
            try:
                for _ in _along_default_axes(file_format, scene).blocks():
                    pass
            except InputError as error:
                return [*scene.findings, Finding("malformed", 1, str(error), "error")]
        return scene.findings


def write(path: str | os.PathLike[str], model: SplatModel, format: str | None = None) -> list[Finding]:
    """Write a scene in any format.

    Args:
        path: path of the file; it appears when complete, replacing an older file.
        model: the scene.
        format: name of the format, if the suffix of the path does not identify it.

    Returns:
        Findings about everything that the format cannot hold, apart from precision: parts of the scene, values beyond
        its ranges, positions that are rounded visibly. Empty if the format holds everything.

    Examples:
        >>> import csplat
        >>> csplat.write("copy.ply", csplat.read("scene.ply"))
        []

    Raises:
        InputError: csplat cannot write the format, or the format cannot store the scene.
        OSError: the file cannot be written.
    """
    check_model("write", model)
    return write_scene(path, Scene.of(model), format)


def write_scene(path: str | os.PathLike[str], scene: Scene, format: str | None = None) -> list[Finding]:
    """Write a scene block by block; arguments and result are the same as in `write`."""
    return write_levels(path, [scene], format)


def write_levels(
    path: str | os.PathLike[str], levels: Sequence[Scene], format: str | None = None, preset: str = "balanced"
) -> list[Finding]:
    """Write the levels of detail of a scene block by block.

    Args:
        path: as in `write`. Only streamed SOG, a file lod-meta.json in a folder of its own, has several levels.
        levels: the scene at each level, finest first.
        format: as in `write`.
        preset: precision of the format, see `Format.presets`.

    Returns:
        As in `write`.

    Raises:
        InputError: as in `write`, or the format has only one level and there are several.
        OSError: the file cannot be written.
    """
    target = Path(path)
    file_format = (format_by_suffix(target) if format is None else format_by_name(format)).at(preset)
    if file_format.write is None:
        raise InputError(f"{target.name} would be {file_format.title}, which csplat does not write")
    statistics = _clamp_statistics()
    scenes = [_watched(scene, file_format, statistics) for scene in levels]
    if file_format.write_levels is not None and file_format.takes_levels(target):
        findings = file_format.write_levels(target, scenes)
    elif len(scenes) != 1:
        raise InputError(f"{target.name} would be {file_format.title}, which has one level, found {len(scenes)}")
    else:
        findings = file_format.write(target, scenes[0])
    return [*_lost_contents(file_format, levels), *_clamped_values(file_format, levels, statistics), *(findings or ())]


def survey_losses(levels: Sequence[Scene], format: str, preset: str = "balanced") -> list[Finding]:
    """Return what `write_levels` returns without writing, except findings that depend on how positions are coded."""
    file_format = format_by_name(format).at(preset)
    statistics = _clamp_statistics()
    for scene in levels if file_format.ranges else ():
        for _ in () if file_format.keeps(scene) else _watched(scene, file_format, statistics).blocks():
            pass
    return [*_lost_contents(file_format, levels), *_clamped_values(file_format, levels, statistics)]


def _clamp_statistics() -> ClampStatistics:
    """Return empty statistics for `_clamped_values`."""
    from csplat.formats.common import ClampStatistics  # imported lazily: reading does not load the encoder

    return ClampStatistics()


def _watched(scene: Scene, file_format: Format, statistics: ClampStatistics) -> Scene:
    """Return a scene as a format stores it, whose values are counted if the format may clamp them."""
    if file_format.keeps(scene):
        return scene
    return statistics.watch(scene.with_sh_degree(file_format.degree), file_format.ranges)


def _lost_contents(file_format: Format, levels: Sequence[Scene]) -> list[Finding]:
    """Return a finding about contents that the format cannot hold; none without levels or losses."""
    lost = file_format.losses(levels[0]) if levels else ()
    text = f"{file_format.title} cannot hold {', '.join(lost)}"
    return [Finding("lost-contents", len(lost), text, "loss")] if lost else []


def _clamped_values(file_format: Format, levels: Sequence[Scene], statistics: ClampStatistics) -> list[Finding]:
    """Return findings about values that a writer clamped, each with the other formats that hold such values."""
    degree = max((scene.sh_degree for scene in levels), default=0)

    def holders(name: str, least: float, most: float) -> list[str]:
        return [
            holder.name
            for holder in formats()
            if holder.write is not None and (name != "shN" or holder.degree >= min(degree, file_format.degree))
            if name not in holder.ranges or holder.ranges[name].holds(least, most)
        ]

    return statistics.findings(file_format.title, holders)


def detect_format(path: Path, format: str | None = None) -> Format:
    """Identify the format of a file or folder by its content.

    Args:
        path: path of the file or folder.
        format: name of the format if the content does not identify it; default: by its name.

    Raises:
        InputError: csplat cannot read the format, or the content makes the format of its name unlikely. The message
            names the probable format and a converter.
        OSError: the file cannot be read.
    """
    if format is not None and format_by_name(format).open is None:
        raise InputError(f"the format is {format}, which csplat does not read")
    head = read_head(path)
    kind = detect_content(path, head)
    file_format = None if kind is None else _find(kind.name)
    if file_format is None and format is not None:
        return format_by_name(format)
    if file_format is not None:
        if file_format.open is None:
            raise InputError(f"{path.name} is {file_format.title}, which csplat does not read")
        return file_format
    kind = kind or (detect_name(path) if head or path.is_dir() else None)
    file_format = None if kind is None else _find(kind.name)
    if kind is None or (file_format is None and kind.remedy):
        raise refusal(path, head)
    if file_format is None:
        raise InputError(f"{path.name} is {kind.title}, which csplat reads where csplat_trainer is installed")
    doubt = file_format.doubt(path)
    if doubt:
        raise InputError(f"{path.name} is hardly {kind.title}: {doubt}; if it is one, read it with --from {kind.name}")
    return file_format


def format_by_suffix(path: Path) -> Format:
    """Return the format for the suffix of a file name.

    Raises:
        InputError: no format has its suffix.
    """
    kind = detect_name(path)
    file_format = None if kind is None else _find(kind.name)
    if file_format is None:
        endings = ", ".join(writable.suffixes[0] for writable in formats() if writable.write is not None)
        what = "a folder, not the name of a file" if path.is_dir() else "no format has that ending"
        page = "; `csplat export-html` writes pages" if path.suffix.lower() in {".html", ".htm"} else ""
        raise InputError(f"{path.name or path}: {what}, expected one of {endings}{page}")
    return file_format


def format_by_name(name: str) -> Format:
    """Return the format of a name.

    Raises:
        InputError: there is no such format.
    """
    file_format = _find(name)
    if file_format is None:
        raise InputError(f"the format is {name!r}, expected one of {', '.join(known.name for known in formats())}")
    return file_format


def _write_csplat(path: Path, scene: Scene) -> None:
    """Write a file with the default options and all extra columns (`Format.write`)."""
    from csplat.encode_api import encode  # imported lazily: reading does not load the encoder
    from csplat.encoder import EncodeOptions

    with tempfile.TemporaryDirectory(prefix=".csplat-", dir=work_folder(path)) as folder:
        encode(scene, EncodeOptions(keep_extra=True), out=path, context=Context(folder=Path(folder) / "work"))


_PLY_FORMAT = Format(
    name=_PLY,
    open=open_ply,
    open_bands=open_ply,
    write=write_scene_ply,
    degree=MAX_SH_DEGREE,
    splat_bytes=(68.0, 104.0, 164.0, 248.0, 356.0),
    exact=frozenset(ARRAYS),
    carries=frozenset(
        {"antialiased", "origin", "coordinate_system", "unit_metres", "flat", "colour_space", "extra", "metadata"}
    ),
    unwritten=unwritten_entries,
)
_CSPLAT_FORMAT = Format(
    name=_CSPLAT,
    open=SplatFile.open,
    write=_write_csplat,
    degree=MAX_SH_DEGREE,
    splat_bytes=(7.0, 8.0, 9.0, 10.0, 10.3),
    ranges={"scales": ValueRange(-HUGE_LOG, HUGE_LOG)},
    carries=_PLY_FORMAT.carries | {"cameras"},
)


def _own_formats() -> dict[str, Format]:
    """Return the built-in formats by name, in the order of lists."""
    # Imported lazily: the libraries of these formats delay the start of programs that do not need them.
    from csplat.formats import compressed_ply, gltf, ksplat, sog, splat, spz

    built_in = [compressed_ply.FORMAT, _PLY_FORMAT, _CSPLAT_FORMAT, spz.FORMAT, spz.FORMAT_4]
    built_in += [splat.FORMAT, ksplat.FORMAT, sog.FORMAT, gltf.FORMAT, gltf.COMPRESSED_FORMAT]
    return {file_format.name: file_format for file_format in built_in}


def _find(name: str) -> Format | None:
    """Return the format of a name or `None`; plugins are loaded only if no built-in format has it."""
    return _own_formats().get(name) or load_plugins("csplat.formats").get(name)


@contextmanager
def _local_copy(store: Store) -> Iterator[Path]:
    """Copy a file to a temporary folder under its own name, or as "data" without one; removed on exit."""
    with temporary_folder() as folder:
        path = folder / (PurePosixPath(urlsplit(store.name).path).name or "data")
        with open_binary(path, "x") as stream:
            for start in range(0, store.size, store.sizes.batch):
                stream.writelines(store.read([(start, min(start + store.sizes.batch, store.size))]))
        yield path


def _open_format(
    file_format: Format, path: Path, level: int = 0, max_splats: int | None = None, sh_degree: int | None = None
) -> AbstractContextManager[Scene]:
    """Open a file of another format than csplat.

    Raises:
        InputError: both `level` and `max_splats` are given, or a level of a format without levels.
    """
    check_sh_degree(sh_degree)
    assert file_format.open is not None
    if level and max_splats is not None:
        raise InputError("level and max_splats exclude each other")
    if level and file_format.open_level is None:
        raise InputError(f"{path.name} is {file_format.title}, which has no levels: level {level} cannot be read")
    if file_format.open_level is not None:
        return file_format.open_level(path, level, max_splats)
    if file_format.open_bands is not None and sh_degree is not None:
        return file_format.open_bands(path, sh_degree)
    return file_format.open(path)


def _version_of(
    file_format: Format, opened: Scene, name: str, level: int, max_splats: int | None, sh_degree: int | None
) -> Scene:
    """Return the requested version of an opened scene along the default axes."""
    check_sh_degree(sh_degree)
    if level and max_splats is not None:
        raise InputError("level and max_splats exclude each other")
    scene = opened.version(level=level, max_splats=max_splats) if isinstance(opened, SplatFile) else opened
    if max_splats is not None and scene.count > max_splats:
        which = "the coarsest version" if scene.levels else "the scene, which has no other version,"
        raise InputError(f"{name}: {which} has {scene.count:,} splats, expected at most {max_splats:,}")
    refuse(scene.findings, strict=False)
    return _along_default_axes(file_format, scene if sh_degree is None else scene.with_sh_degree(sh_degree))


def _along_default_axes(file_format: Format, scene: Scene) -> Scene:
    """Rotate a scene to the default axes and keep its own as `file_axes`; unchanged for a format without fixed axes."""
    file_axes = scene.metadata.coordinate_system
    return convert_axes(scene, DEFAULT_AXES).changed(file_axes=file_axes) if file_format.axes else scene

"""Read and write splat files in any format.

Each format has a module or package with a `FORMAT`; `formats` lists them. A file is identified by its content, and by
its name only if the content is ambiguous. Scenes of formats with fixed axes are converted to x right, y down, z
forward, the axes assumed for PLY, so all scenes have the same orientation.
"""

from __future__ import annotations

import os
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from csplat.decoder import decode, open_tiles
from csplat.decoder.tree import select_tiles
from csplat.detect import detect_content, detect_name, read_head, refusal
from csplat.disk_files import local_file, work_folder
from csplat.editing.transform import DEFAULT_AXES, convert_axes
from csplat.errors import InputError, counted
from csplat.file_source import File
from csplat.formats.format import ARRAYS, Format, ValueRange
from csplat.lint import Finding, refuse
from csplat.model import MAX_SH_DEGREE, SplatModel, check_model, check_sh_degree
from csplat.plugins import load_plugins
from csplat.ply import lint_ply, open_ply, read_ply, write_scene_ply
from csplat.ply.columns import HUGE_LOG
from csplat.scene_source import SceneSource, drop_bands, source_from_model

if TYPE_CHECKING:
    from csplat.formats.common import ClampStatistics

__all__ = [
    "ARRAYS",
    "Format",
    "assume_format",
    "detect_format",
    "format_by_name",
    "format_by_suffix",
    "formats",
    "lint_file",
    "open_scene",
    "read",
    "read_all",
    "survey_losses",
    "write",
    "write_levels",
    "write_scene",
]

_PLY, _CSPLAT = "ply", "csplat"  # `read` calls their own readers, which load a file in one pass without extra copies
_assumed: ContextVar[str | None] = ContextVar("assumed", default=None)  # set by `assume_format`


def formats() -> tuple[Format, ...]:
    """Return all formats: first the built-in ones, then those of plugins (`csplat.plugins`)."""
    return (*_own_formats().values(), *load_plugins("csplat.formats").values())


def read(
    file: File,
    format: str | None = None,
    *,
    strict: bool = False,
    keep_extra: bool = False,
    sh_degree: int | None = None,
    report: list[Finding] | None = None,
) -> SplatModel:
    """Read a scene in any format.

    Args:
        file: path of a file or folder, an open binary file, or bytes.
        format: name of the format, as in `formats()`, if neither content nor name identify it.
        strict: refuse files that need repairs.
        keep_extra: keep columns that are not splat attributes.
        sh_degree: drop the SH bands above this degree, 0 to 4; the file's own degree may exceed 4. `None`: keep all.
        report: findings, including repairs, are appended to this list.

    Examples:
        >>> import csplat
        >>> csplat.read("scene.ply")
        SplatModel(1000 splats, sh_degree=3)

    Raises:
        InputError: csplat cannot read the format, or the file is incomplete.
        FormatError: it is a .csplat file that violates the specification.
        OSError: it cannot be read.
    """
    with local_file(file) as path:
        found = _readable_format(path, format)
        if found.name == _PLY:
            return read_ply(path, strict=strict, keep_extra=keep_extra, sh_degree=sh_degree, report=report)
        if found.name == _CSPLAT:
            check_sh_degree(sh_degree)
            model = decode(path, sh_degree=None if sh_degree is None else min(sh_degree, found.degree))
            return model if keep_extra or not model.extra else replace(model, extra={})
        with _open(found, path, sh_degree=sh_degree) as scene:
            return read_all(scene, strict=strict, keep_extra=keep_extra, report=report)


def read_all(
    scene: SceneSource, *, strict: bool = False, keep_extra: bool = False, report: list[Finding] | None = None
) -> SplatModel:
    """Read all splats of an open scene; arguments are those of `read`."""
    model = scene.model()
    if report is not None:
        report += scene.findings
    refuse(scene.findings, strict=strict)
    return model if keep_extra or not model.extra else replace(model, extra={})


@contextmanager
def assume_format(format: str | None) -> Iterator[None]:
    """Within the context, read files as this format unless their content identifies another one.

    Args:
        format: name of the format; `None`: use file names, as usual.

    Raises:
        InputError: csplat cannot read a format of that name.
    """
    if format is not None and format_by_name(format).open is None:
        raise InputError(f"the format is {format}, which csplat does not read")
    token = _assumed.set(format)
    try:
        yield
    finally:
        _assumed.reset(token)


@contextmanager
def open_scene(
    file: File,
    format: str | None = None,
    *,
    level: int = 0,
    max_splats: int | None = None,
    sh_degree: int | None = None,
) -> Iterator[SceneSource]:
    """Open a scene in any format to read it block by block.

    Args:
        file: as in `read`.
        format: as in `read`.
        level: level of detail, if the file has several; 0 is the finest.
        max_splats: open the best version of at most this number of splats instead: of a .csplat file the cut with the
            smallest errors, of streamed SOG the finest level. `None`: open `level`.
        sh_degree: as in `read`.

    Yields:
        The scene; its blocks can be read until the context ends.

    Raises:
        InputError: csplat cannot read the format, the file is incomplete, or the coarsest version has more than
            `max_splats` splats. Reading a block may raise it, too.
        OSError: the file cannot be read.
    """
    with local_file(file) as path, _open(_readable_format(path, format), path, level, max_splats, sh_degree) as scene:
        yield scene


def lint_file(path: Path) -> list[Finding]:
    """List the defects of a file in any format without refusing it.

    Args:
        path: path of the file.

    Returns:
        Findings in the order of reading; the last one is an error if `read` would refuse the file.

    Raises:
        InputError: csplat cannot read the format, or cannot parse the header.
        OSError: the file cannot be read.
    """
    found = _readable_format(path, None)
    if found.name == _PLY:
        return lint_ply(path)
    with _open(found, path, lenient=True) as scene:
        if all(one.repairable for one in scene.findings):
            try:
                for _ in scene.blocks():
                    pass
            except InputError as error:
                return [*scene.findings, Finding("malformed", 1, str(error), "error")]
        return scene.findings


def write(path: str | os.PathLike[str], model: SplatModel, format: str | None = None) -> list[Finding]:
    """Write a scene in any format.

    Args:
        path: path of the file; it appears when complete, replacing an older one.
        model: the scene.
        format: name of the format, if the suffix of the path does not identify it.

    Returns:
        What the format cannot hold, apart from precision: parts of the scene, values beyond its ranges, positions that
        are rounded visibly. Empty if that is nothing.

    Examples:
        >>> import csplat
        >>> csplat.write("copy.ply", csplat.read("scene.ply"))
        []

    Raises:
        InputError: csplat cannot write the format, or the format cannot store the scene.
        OSError: the file cannot be written.
    """
    check_model("write", model)
    return write_scene(path, source_from_model(model), format)


def write_scene(path: str | os.PathLike[str], scene: SceneSource, format: str | None = None) -> list[Finding]:
    """Write a scene block by block; arguments and result are those of `write`."""
    return write_levels(path, [scene], format)


def write_levels(
    path: str | os.PathLike[str], levels: Sequence[SceneSource], format: str | None = None
) -> list[Finding]:
    """Write the levels of detail of a scene block by block.

    Args:
        path: as in `write`. Only streamed SOG, a file lod-meta.json in a folder of its own, has several levels.
        levels: the scene at each level, finest first.
        format: as in `write`.

    Returns:
        As in `write`.

    Raises:
        InputError: as in `write`, or the format has one level and there are several.
        OSError: the file cannot be written.
    """
    target = Path(path)
    found = format_by_suffix(target) if format is None else format_by_name(format)
    if found.write is None:
        raise InputError(f"{target.name} would be {found.title}, which csplat does not write")
    statistics = _clamp_statistics()
    scenes = [statistics.watch(_with_fewer_bands(scene, found.degree), found.ranges) for scene in levels]
    if found.write_levels is not None and found.takes_levels(target):
        findings = found.write_levels(target, scenes)
    elif len(scenes) != 1:
        raise InputError(f"{target.name} would be {found.title}, which has one level, found {len(scenes)}")
    else:
        findings = found.write(target, scenes[0])
    return [*_lost_contents(found, levels), *_clamped_values(found, levels, statistics), *(findings or ())]


def survey_losses(levels: Sequence[SceneSource], format: str) -> list[Finding]:
    """Return what `write_levels` returns without writing, except findings that depend on how positions are coded."""
    found = format_by_name(format)
    statistics = _clamp_statistics()
    for scene in levels if found.ranges else ():
        for _ in statistics.watch(_with_fewer_bands(scene, found.degree), found.ranges).blocks():
            pass
    return [*_lost_contents(found, levels), *_clamped_values(found, levels, statistics)]


def _clamp_statistics() -> ClampStatistics:
    from csplat.formats.common import ClampStatistics  # imported lazily: reading does not load the encoder

    return ClampStatistics()


def _lost_contents(found: Format, levels: Sequence[SceneSource]) -> list[Finding]:
    lost = found.losses(levels[0].metadata_model) if levels else ()
    return [Finding("lost-contents", len(lost), f"{found.title} cannot hold {', '.join(lost)}", "loss")] if lost else []


def _clamped_values(found: Format, levels: Sequence[SceneSource], statistics: ClampStatistics) -> list[Finding]:
    degree = max((scene.metadata_model.sh_degree for scene in levels), default=0)

    def holders(name: str, least: float, most: float) -> list[str]:
        return [
            one.name
            for one in formats()
            if one.write is not None and (name != "shN" or one.degree >= min(degree, found.degree))
            if name not in one.ranges or one.ranges[name].holds(least, most)
        ]

    return statistics.findings(found.title, holders)


def detect_format(path: Path) -> Format:
    """Identify the format of a file or folder by its content, otherwise by its name.

    Raises:
        InputError: csplat cannot read the format, or the content makes the format of its name unlikely. The message
            names the probable format and a converter.
        OSError: the file cannot be read.
    """
    head, assumed = read_head(path), _assumed.get()
    kind = detect_content(path, head)
    found = None if kind is None else _find(kind.name)
    if found is not None:
        return found
    if assumed is not None:
        return format_by_name(assumed)
    kind = kind or (detect_name(path) if head or path.is_dir() else None)
    found = None if kind is None else _find(kind.name)
    if kind is None or (found is None and kind.remedy):
        raise refusal(path, head)
    if found is None:
        raise InputError(f"{path.name} is {kind.title}, which csplat reads where csplat_trainer is installed")
    doubt = found.doubt(path)
    if doubt:
        raise InputError(f"{path.name} is hardly {kind.title}: {doubt}; if it is one, read it with --from {kind.name}")
    return found


def format_by_suffix(path: Path) -> Format:
    """Return the format for the suffix of a file name.

    Raises:
        InputError: no format has its suffix.
    """
    kind = detect_name(path)
    found = None if kind is None else _find(kind.name)
    if found is None:
        endings = ", ".join(one.suffixes[0] for one in formats() if one.write is not None)
        what = "a folder, not the name of a file" if path.is_dir() else "no format has that ending"
        page = "; `csplat export-html` writes pages" if path.suffix.lower() in {".html", ".htm"} else ""
        raise InputError(f"{path.name or path}: {what}, expected one of {endings}{page}")
    return found


def format_by_name(name: str) -> Format:
    """Return the format of a name.

    Raises:
        InputError: there is no such format.
    """
    found = _find(name)
    if found is None:
        raise InputError(f"the format is {name!r}, expected one of {', '.join(one.name for one in formats())}")
    return found


@contextmanager
def _open_csplat(path: Path, level: int = 0, max_splats: int | None = None) -> Iterator[SceneSource]:
    """Open a version (`Format.open`, `Format.open_level`); a file with level 0 alone is read as a whole."""
    opened = open_tiles(path)
    header, last = opened.header, max((tile.level for tile in opened.header.coarse_tiles), default=0)
    if level > last:
        wanted = "0: it has no other levels" if last == 0 else f"0 to {last}"
        raise InputError(f"{path.name}: the level is {level}, expected {wanted}")
    if last == 0:
        yield SceneSource(header.splat_count, opened.metadata_model, opened.models)
        return
    cuts = [select_tiles(header, opened.nodes, level=one) for one in range(last + 1)]
    counts = tuple(sum(tile.splat_count for tile in tiles) for tiles in cuts)
    tiles = cuts[level]
    if max_splats is not None:  # the caller refuses a coarsest version that is too large
        tiles = select_tiles(header, opened.nodes, max_splats=max(max_splats, counts[last]))
    is_scene = len(tiles) == len(header.tiles) and all(tile.level == 0 for tile in tiles)
    count = sum(tile.splat_count for tile in tiles)
    metadata_model = opened.metadata_model if is_scene else replace(opened.metadata_model, extra={})

    def blocks() -> Iterator[SplatModel]:
        for model in opened.models(None if is_scene else [tile.index for tile in tiles]):
            yield model if is_scene or not model.extra else replace(model, extra={})  # coarser tiles have none

    which = f"level {level} alone is read" if max_splats is None else f"a version of {counted(count, 'splat')} is read"
    findings = [Finding("levels", last, f"{counted(last, 'coarser level')} of detail: {which}", "note")]
    yield SceneSource(count, metadata_model, blocks, findings, levels=counts)


def _write_csplat(path: Path, scene: SceneSource) -> None:
    from csplat.encoder import EncodeOptions  # imported lazily: reading does not load the encoder
    from csplat.out_of_core import OutOfCoreOptions, encode_scene

    with tempfile.TemporaryDirectory(prefix=".csplat-", dir=work_folder(path)) as folder:
        encode_scene(scene, path, EncodeOptions(keep_extra=True), OutOfCoreOptions(folder=Path(folder) / "work"))


_PLY_FORMAT = Format(
    name=_PLY,
    open=open_ply,
    open_bands=open_ply,
    write=write_scene_ply,
    degree=MAX_SH_DEGREE,
    splat_bytes=(68.0, 104.0, 164.0, 248.0, 356.0),
    exact=frozenset(ARRAYS),
    carries=frozenset({"antialiased", "origin", "coordinate_system", "unit_metres", "flat", "extra", "metadata"}),
)
_CSPLAT_FORMAT = Format(
    name=_CSPLAT,
    open=_open_csplat,
    open_level=_open_csplat,
    write=_write_csplat,
    degree=MAX_SH_DEGREE,
    splat_bytes=(7.0, 8.0, 9.0, 10.0, 10.3),
    ranges={"scales": ValueRange(-HUGE_LOG, HUGE_LOG)},
    carries=_PLY_FORMAT.carries | {"cameras"},
)


def _own_formats() -> dict[str, Format]:
    # Imported lazily: the libraries of these formats delay the start of programs that do not need them.
    from csplat.formats import compressed_ply, gltf, ksplat, sog, splat, spz

    found = [compressed_ply.FORMAT, _PLY_FORMAT, _CSPLAT_FORMAT, spz.FORMAT, spz.FORMAT_4]
    found += [splat.FORMAT, ksplat.FORMAT, sog.FORMAT, gltf.FORMAT]
    return {one.name: one for one in found}


def _find(name: str) -> Format | None:
    """Return the format of a name or `None`; plugins are loaded only if no built-in format has it."""
    return _own_formats().get(name) or load_plugins("csplat.formats").get(name)


def _readable_format(path: Path, format: str | None) -> Format:
    found = detect_format(path) if format is None else format_by_name(format)
    if found.open is None:
        raise InputError(f"{path.name} is {found.title}, which csplat does not read")
    return found


@contextmanager
def _open(
    found: Format,
    path: Path,
    level: int = 0,
    max_splats: int | None = None,
    sh_degree: int | None = None,
    *,
    lenient: bool = False,
) -> Iterator[SceneSource]:
    """Open a scene along the default axes; `lenient` accepts findings that are errors."""
    assert found.open is not None
    check_sh_degree(sh_degree)
    if level and max_splats is not None:
        raise InputError("level and max_splats exclude each other")
    if level and found.open_level is None:
        raise InputError(f"{path.name} is {found.title}, which has no levels: level {level} cannot be read")
    if found.open_level is not None:
        opened = found.open_level(path, level, max_splats)
    elif found.open_bands is not None and sh_degree is not None:
        opened = found.open_bands(path, sh_degree)
    else:
        opened = found.open(path)
    with opened as all_bands:
        if max_splats is not None and all_bands.count > max_splats:
            which = "the coarsest version" if all_bands.levels else "the scene, which has no other version,"
            raise InputError(f"{path.name}: {which} has {all_bands.count:,} splats, expected at most {max_splats:,}")
        refuse([] if lenient else all_bands.findings, strict=False)
        scene = all_bands if sh_degree is None else _with_fewer_bands(all_bands, sh_degree)
        if found.axes:
            scene = replace(convert_axes(scene, DEFAULT_AXES), file_axes=all_bands.metadata_model.coordinate_system)
        yield replace(scene, format=found.name)


def _with_fewer_bands(scene: SceneSource, sh_degree: int) -> SceneSource:
    if sh_degree >= scene.metadata_model.sh_degree:
        return scene
    return replace(
        scene,
        metadata_model=drop_bands(scene.metadata_model, sh_degree),
        blocks=lambda: (drop_bands(model, sh_degree) for model in scene.blocks()),
    )

"""Files of splats in any format: `read`, `write`, and what each format can carry.

One module a format; each has a `FORMAT`. What a file is, its content says first, its name second. What a format of
fixed axes holds is turned to x right, y down, z forward, as a PLY is taken to stand: so all scenes lie alike.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from contextvars import ContextVar
from dataclasses import replace
from importlib import import_module
from pathlib import Path

from csplat.decoder import decode
from csplat.detect import by_content, by_name, head_of, refusal
from csplat.errors import InputError
from csplat.files import local_file
from csplat.formats.format import Format
from csplat.inputs import File
from csplat.lint import Finding, refuse
from csplat.model import SplatModel, check_model, check_sh_degree
from csplat.ply import lint_ply, read_ply
from csplat.scene import Scene, scene_of, without_bands
from csplat.turning import USUAL, in_axes

__all__ = [
    "Format",
    "format_of",
    "formats",
    "insisting",
    "lint",
    "named",
    "named_by",
    "open_scene",
    "read",
    "read_all",
    "write",
    "write_scene",
]

_PLY, _OWN = "ply", "csplat"  # their readers need no second copy where all of a scene is wanted at once

_MODULES = (
    "csplat.formats.compressed_ply",
    "csplat.formats.ply",
    "csplat.formats.own",
    "csplat.formats.spz",
    "csplat.formats.spz4",
    "csplat.formats.splat",
    "csplat.formats.ksplat",
    "csplat.formats.sog",
    "csplat.formats.gltf",
)
_insisted: ContextVar[str | None] = ContextVar("insisted", default=None)  # a command's --from, for all that it reads
#: Of packages that stand on this one, by their names: nothing here knows them, and they may be absent.
_ABOVE = ("csplat_trainer.torch_checkpoints",)


def formats() -> tuple[Format, ...]:
    """All formats that are known, those of this package first."""
    found = [import_module(name).FORMAT for name in _MODULES]
    for name in _ABOVE:
        with suppress(ModuleNotFoundError):
            found.append(import_module(name).FORMAT)
    return tuple(found)


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
        file: its path, also of a folder; an open binary file; or bytes.
        format: its name, one of `csplat formats`, where its content and its name do not say it.
        strict: refuse what would be repaired.
        keep_extra: keep columns that splats do not have.
        sh_degree: leave out the SH bands above, 0 to 3, also of a file of a higher degree than 3; `None`: keep all.
        report: findings are appended to this list, repairs among them.

    Examples:
        >>> import csplat
        >>> csplat.read("scene.ply")
        SplatModel(1000 splats, sh_degree=3)

    Raises:
        InputError: the file is in no format that is read, or not whole.
        FormatError: it is a .csplat file that breaks a clause.
        OSError: it cannot be read.
    """
    with local_file(file) as path:
        found = _readable(path, format)
        if found.name == _PLY:
            return read_ply(path, strict=strict, keep_extra=keep_extra, sh_degree=sh_degree, report=report)
        if found.name == _OWN:
            model = decode(path, sh_degree=sh_degree)
            return model if keep_extra or not model.extra else replace(model, extra={})
        with _opened(found, path, sh_degree=sh_degree) as scene:
            return read_all(scene, strict=strict, keep_extra=keep_extra, report=report)


def read_all(
    scene: Scene, *, strict: bool = False, keep_extra: bool = False, report: list[Finding] | None = None
) -> SplatModel:
    """Read all splats of a scene that is open; the rest as `read`."""
    model = scene.model()
    if report is not None:
        report += scene.findings
    refuse(scene.findings, strict=strict)
    return model if keep_extra or not model.extra else replace(model, extra={})


@contextmanager
def insisting(format: str | None) -> Iterator[None]:
    """Take files for this format, as long as the context lasts, where their content is that of no format that is read.

    Args:
        format: its name; `None`: their names decide, as usual.

    Raises:
        InputError: no format that is read has that name.
    """
    if format is not None and named(format).open is None:
        raise InputError(f"the format is {format}, which csplat does not read")
    token = _insisted.set(format)
    try:
        yield
    finally:
        _insisted.reset(token)


@contextmanager
def open_scene(
    file: File, format: str | None = None, *, level: int = 0, sh_degree: int | None = None
) -> Iterator[Scene]:
    """Open a scene in any format, to be read some splats at a time.

    Args:
        file: as of `read`.
        format: as of `read`.
        level: of a file that has the scene several times; 0 is the finest.
        sh_degree: as of `read`.

    Yields:
        The scene; its blocks can be read as long as the context lasts.

    Raises:
        InputError: the file is in no format that is read, or not whole. Blocks raise it, too.
        OSError: it cannot be read.
    """
    with local_file(file) as path, _opened(_readable(path, format), path, level, sh_degree) as scene:
        yield scene


def lint(path: Path, *, sh_degree: int | None = None) -> list[Finding]:
    """Find out what is wrong with a file of any format, without refusing it.

    Args:
        path: of it.
        sh_degree: as of `read`.

    Returns:
        Findings in the order of reading; the last one is an error where `read` would refuse.

    Raises:
        InputError: it is in no format that is read, or its header cannot be understood.
        OSError: it cannot be read.
    """
    found = _readable(path, None)
    if found.name == _PLY:
        return lint_ply(path, sh_degree=sh_degree)
    with _opened(found, path, sh_degree=sh_degree, lenient=True) as scene:
        if all(one.repairable for one in scene.findings):
            try:
                for _ in scene.blocks():
                    pass
            except InputError as error:
                return [*scene.findings, Finding("malformed", 1, str(error), "error")]
        return scene.findings


def write(path: str | os.PathLike[str], model: SplatModel, format: str | None = None) -> None:
    """Write a scene in any format.

    Args:
        path: of the file, which it takes when it is complete, replacing an older one.
        model: the scene.
        format: its name, where that of the file does not say it.

    Examples:
        >>> import csplat
        >>> csplat.write("copy.ply", csplat.read("scene.ply"))

    Raises:
        InputError: no format that is written has that name, or it cannot hold the scene.
        OSError: the file cannot be written.
    """
    check_model("write", model)
    write_scene(path, scene_of(model), format)


def write_scene(path: str | os.PathLike[str], scene: Scene, format: str | None = None) -> None:
    """Write a scene that is read some splats at a time; the rest as of `write`."""
    target = Path(path)
    found = named_by(target) if format is None else named(format)
    if found.write is None:
        raise InputError(f"{target.name} would be {found.title}, which csplat does not write")
    found.write(target, scene)


def format_of(path: Path) -> Format:
    """Find the format of a file or folder, by its content, else by its name.

    Raises:
        InputError: it is in none that is read, or its content makes that of its name hardly possible; the message says
            what it may be, and what converts it.
        OSError: it cannot be read.
    """
    head, insisted = head_of(path), _insisted.get()
    known = {one.name: one for one in formats()}
    kind = by_content(path, head)
    if kind is not None and kind.name in known:
        return known[kind.name]
    if insisted is not None:
        return known[insisted]
    kind = kind or (by_name(path) if head or path.is_dir() else None)
    if kind is None or kind.remedy:
        raise refusal(path, head)
    if kind.name not in known:
        raise InputError(f"{path.name} is {kind.title}, which csplat reads where csplat_trainer is installed")
    doubt = known[kind.name].doubt(path)
    if doubt:
        raise InputError(f"{path.name} is hardly {kind.title}: {doubt}; if it is one, read it with --from {kind.name}")
    return known[kind.name]  # its reader says what is wrong


def named_by(path: Path) -> Format:
    """The format that a file of that name is in.

    Raises:
        InputError: none.
    """
    name = path.name.lower()
    found = [(len(suffix), one) for one in formats() for suffix in one.suffixes if name.endswith(suffix)]
    if not found:
        endings = ", ".join(one.suffixes[0] for one in formats() if one.write is not None)
        raise InputError(f"{path.name}: no format has that ending, wanted one of {endings}")
    return max(found, key=lambda pair: pair[0])[1]


def _readable(path: Path, format: str | None) -> Format:
    found = format_of(path) if format is None else named(format)
    if found.open is None:
        raise InputError(f"{path.name} is {found.title}, which csplat does not read")
    return found


@contextmanager
def _opened(
    found: Format, path: Path, level: int = 0, sh_degree: int | None = None, *, lenient: bool = False
) -> Iterator[Scene]:
    """Open a scene along the usual axes; one with findings that are errors only if `lenient`."""
    assert found.open is not None
    check_sh_degree(sh_degree)
    if level and found.open_level is None:
        raise InputError(f"{path.name} is {found.title}, which has no levels, and level {level} is wanted")
    if found.open_level is not None:
        opened = found.open_level(path, level)
    elif found.open_bands is not None and sh_degree is not None:
        opened = found.open_bands(path, sh_degree)
    else:
        opened = found.open(path)
    with opened as every_band:
        refuse([] if lenient else every_band.findings, strict=False)
        scene = every_band if sh_degree is None else _without_bands(every_band, sh_degree)
        placed = in_axes(scene, USUAL) if found.axes else scene
        yield replace(placed, format=found.name)


def _without_bands(scene: Scene, sh_degree: int) -> Scene:
    if sh_degree >= scene.facts.sh_degree:
        return scene
    return replace(
        scene,
        facts=without_bands(scene.facts, sh_degree),
        blocks=lambda: (without_bands(model, sh_degree) for model in scene.blocks()),
    )


def named(name: str) -> Format:
    """The format of that name.

    Raises:
        InputError: there is none.
    """
    for one in formats():
        if one.name == name:
            return one
    raise InputError(f"the format is {name!r}, wanted one of {', '.join(one.name for one in formats())}")

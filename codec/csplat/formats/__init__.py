"""Files of splats in any format: `read`, `write`, and what each format can carry.

One module a format; each has a `FORMAT`. What a file is, its content says first, its name second.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from importlib import import_module
from pathlib import Path

from csplat.errors import InputError
from csplat.files import local_file
from csplat.foreign import HEAD_SIZE, unknown
from csplat.formats.format import Format
from csplat.inputs import File
from csplat.model import SplatModel, check_model
from csplat.scene import Scene, scene_of

__all__ = ["Format", "format_of", "formats", "named_by", "open_scene", "read", "register", "write", "write_scene"]

_MODULES = ("csplat.formats.ply", "csplat.formats.own", "csplat.formats.gltf")
_registered: list[Format] = []


def formats() -> tuple[Format, ...]:
    """All formats that are known, those of this package first."""
    return (*(import_module(name).FORMAT for name in _MODULES), *_registered)


def register(format: Format) -> None:
    """Make another format known; one of the same name gives way."""
    _registered[:] = [one for one in _registered if one.name != format.name] + [format]


def read(file: File, format: str | None = None) -> SplatModel:
    """Read a scene in any format.

    Args:
        file: its path, also of a folder; an open binary file; or bytes.
        format: its name, one of `csplat formats`, where its content and its name do not say it.

    Examples:
        >>> import csplat
        >>> csplat.read("scene.ply")
        SplatModel(1000 splats, sh_degree=3)

    Raises:
        InputError: the file is in no format that is read, or not whole.
        FormatError: it is a .csplat file that breaks a clause.
        OSError: it cannot be read.
    """
    with open_scene(file, format) as scene:
        return scene.model()


@contextmanager
def open_scene(file: File, format: str | None = None) -> Iterator[Scene]:
    """Open a scene in any format, to be read some splats at a time.

    Args:
        file: as of `read`.
        format: as of `read`.

    Yields:
        The scene; its blocks can be read as long as the context lasts.

    Raises:
        InputError: the file is in no format that is read, or not whole. Blocks raise it, too.
        OSError: it cannot be read.
    """
    with local_file(file) as path:
        found = format_of(path) if format is None else _named(format)
        if found.open is None:
            raise InputError(f"{path.name} is {found.title}, which csplat does not read")
        with found.open(path) as scene:
            yield scene


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
    found = named_by(target) if format is None else _named(format)
    if found.write is None:
        raise InputError(f"{target.name} would be {found.title}, which csplat does not write")
    found.write(target, scene)


def format_of(path: Path) -> Format:
    """The format of a file or folder, by its content, else by its name.

    Raises:
        InputError: it is in none that is known; the message says what it may be, and what converts it.
        OSError: it cannot be read.
    """
    head = b""
    if not path.is_dir():
        with path.open("rb") as stream:
            head = stream.read(HEAD_SIZE)
    for one in formats():
        if one.sniff(path, head):
            return one
    if head or path.is_dir():
        for one in formats():
            if path.name.lower().endswith(one.suffixes):
                return one  # its reader says what is wrong
    raise unknown(path, head)


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


def _named(name: str) -> Format:
    for one in formats():
        if one.name == name:
            return one
    raise InputError(f"the format is {name!r}, wanted one of {', '.join(one.name for one in formats())}")

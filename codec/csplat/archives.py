"""Read NumPy archives (.npz), which may be damaged or something else, and name the scenes in zips and folders."""

from __future__ import annotations

import json
import lzma
import re
import struct
import textwrap
import tokenize
import zipfile
import zlib
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
from numpy.typing import NDArray

from csplat.errors import InputError
from csplat.file_source import describe_substitute

#: Exceptions of NumPy and zipfile for damaged files: RuntimeError for passwords and unknown compression, MemoryError
#: for impossible sizes, OSError for offsets outside the file and broken bz2.
DAMAGED = (ValueError, EOFError, KeyError, TypeError, AttributeError, RuntimeError, OverflowError, MemoryError,
            SyntaxError, OSError, struct.error, tokenize.TokenError, lzma.LZMAError, zlib.error,
            zipfile.BadZipFile)  # fmt: skip


#: File name endings of scenes, which a zip may hold.
_SCENES = (".ply", ".spz", ".splat", ".ksplat", ".sog", ".glb", ".gltf", ".csplat", ".pt", ".ckpt", ".pth")
#: Their places in the output folders of INRIA's trainer, gsplat's and nerfstudio's.
_PLACES = ("*", "iteration_*/*", "point_cloud/iteration_*/*", "ply/*", "ckpts/*", "nerfstudio_models/*")
_POINTS = "input.ply"  # initial points of INRIA's trainer
_NAMED = 5  # maximum number of scenes in a message


def scenes_of(names: Iterable[str]) -> list[str]:
    """Return the names of files that are scenes by their endings."""
    return [name for name in names if name.lower().endswith(_SCENES)]


def zip_refusal(path: Path) -> str:
    """Return the message for a zip that is not a scene; it names the scenes in it."""
    try:
        with zipfile.ZipFile(path) as archive:
            names = [name for name in archive.namelist() if not name.startswith("__MACOSX/")]
    except DAMAGED:
        return f"{path.name} is a zip, and damaged: copy or download it again"
    if names and all(name.endswith(".npy") for name in names):
        arrays = textwrap.shorten(", ".join(name.removesuffix(".npy") for name in names), 120)
        what = f"an archive of NumPy arrays ({arrays}), no scene"
        return f"{path.name} is {what}: csplat.from_gsplat makes one of arrays under gsplat's names"
    scenes = scenes_of(names)
    if not scenes:
        return f"{path.name} is a zip that holds no scene: {textwrap.shorten(', '.join(names), 120) or 'nothing'}"
    shown = ", ".join(scenes[:_NAMED]) + (f" and {len(scenes) - _NAMED} more" if len(scenes) > _NAMED else "")
    return f"{path.name} is a zip that holds {shown}: unzip it, and name the scene"


def folder_refusal(path: Path) -> str:
    """Return the message for a folder that is not a scene; it names the scenes that a trainer left in it."""
    found = {one for place in _PLACES for one in path.glob(place) if one.name.lower().endswith(_SCENES)}
    scenes = sorted(one.relative_to(path).as_posix() for one in found if one.name != _POINTS)
    if not scenes:
        return f"{path} is a folder, and no scene"
    newest = max(scenes, key=lambda name: [int(number) for number in re.findall(r"\d+", name)])
    count = f", the last of {len(scenes)} scenes in it" if len(scenes) > 1 else ""
    return f"{path} is a folder, and no scene: name {newest}{count}"


class Archive(dict[str, NDArray[Any]]):
    """The arrays of a file by name; a missing one raises `InputError`.

    Args:
        path: the file.
        kind: its kind, for messages: "a checkpoint of csplat train".
        arrays: its arrays.
    """

    def __init__(self, path: str | Path, kind: str, arrays: dict[str, NDArray[Any]]) -> None:
        super().__init__(arrays)
        self._path, self._kind = path, kind

    def __missing__(self, name: str) -> NDArray[Any]:
        self.refuse(f"it holds no {name}")

    def refuse(self, reason: object) -> NoReturn:
        """Raise the `InputError` for a file that is not of its kind."""
        text = textwrap.shorten(str(reason), 120)
        raise InputError(f"{self._path} is not {self._kind}: {text}")

    def facts(self) -> dict[str, Any]:
        """Return the JSON object in the array of bytes "facts".

        Raises:
            InputError: there is no such object.
        """
        try:
            found = json.loads(self["facts"].tobytes())
        except (ValueError, RecursionError) as error:
            self.refuse(error)
        if not isinstance(found, dict):
            self.refuse(f"its facts are a {type(found).__name__}")
        return found

    def check(self, facts: Mapping[str, Any], kinds: Mapping[str, type]) -> None:
        """Refuse the file unless its facts have these names and kinds."""
        for name, kind in kinds.items():
            if not isinstance(facts.get(name), kind):
                self.refuse(f"its {name} is no {kind.__name__}")


def read_archive(path: str | Path, kind: str) -> Archive:
    """Read all arrays of a .npz file, without pickle.

    Args:
        path: the file.
        kind: as in `Archive`.

    Raises:
        InputError: it is damaged, or not a .npz file.
        OSError: it cannot be read.
    """
    nothing = Archive(path, kind, {})
    with Path(path).open("rb") as stream:  # opened here: np.load leaves a damaged file open
        if instead := describe_substitute(stream.read(64)):
            raise InputError(f"{path} is {instead}")
        if not zipfile.is_zipfile(stream):  # np.load would call others unsafe to load
            nothing.refuse("it is no .npz file")
        stream.seek(0)
        try:
            with np.load(stream, allow_pickle=False) as file:
                arrays = {name: file[name] for name in file.files}
        except DAMAGED as error:
            nothing.refuse(error)
    for name, array in arrays.items():
        if not isinstance(array, np.ndarray):  # NumPy gives the bytes of what is no array
            nothing.refuse(f"its {name} is no array")
    return Archive(path, kind, arrays)

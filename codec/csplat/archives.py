# SPDX-License-Identifier: Apache-2.0
"""Read NumPy archives (.npz) from untrusted sources, and describe zips and folders that are not scenes."""

from __future__ import annotations

import io
import re
import struct
import textwrap
import zipfile
import zlib
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, BinaryIO, NoReturn, cast

from numpy.typing import NDArray

from csplat.disk_files import parse_array, parse_json
from csplat.errors import InputError
from csplat.file_source import describe_substitute, open_binary

#: Exceptions that zipfile and Pillow raise for damaged files: RuntimeError for passwords and unknown compression,
#: MemoryError for impossible sizes, OSError for offsets outside the file.
DAMAGED = (ValueError, EOFError, KeyError, TypeError, AttributeError, RuntimeError, OverflowError, MemoryError,
            SyntaxError, OSError, struct.error, zlib.error, zipfile.BadZipFile)  # fmt: skip

_COMPRESSIONS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)  # other methods expand further, LZMA with 4 GiB of memory
_FREE = 1 << 28  # bytes that compressed data may unpack to regardless of its size
_EXPANSION = 64  # largest expansion of larger data; trained values compress to a tenth at best
_MAX_ARRAYS = 4096  # an array of an archive takes 60 bytes of the file if they overlap, and 60 microseconds


#: File name suffixes of scenes.
_SCENES = (".ply", ".spz", ".splat", ".ksplat", ".sog", ".glb", ".gltf", ".csplat", ".pt", ".ckpt", ".pth")
#: Locations of scenes in the output folders of INRIA's trainer, gsplat and nerfstudio.
_PATTERNS = ("*", "iteration_*/*", "point_cloud/iteration_*/*", "ply/*", "ckpts/*", "nerfstudio_models/*")
_POINTS = "input.ply"  # initial points of INRIA's trainer, not a scene
_NAMED = 5  # maximum number of scenes listed in a message


def scenes_of(names: Iterable[str]) -> list[str]:
    """Return the file names that have the suffix of a scene."""
    return [name for name in names if name.lower().endswith(_SCENES)]


def zip_refusal(path: Path) -> str:
    """Return the error message for a zip that is not a scene, listing the scenes in it."""
    try:
        with zipfile.ZipFile(path) as archive:
            names = [name for name in archive.namelist() if not name.startswith("__MACOSX/")]
    except DAMAGED:
        return f"{path.name} is a damaged zip: copy or download it again"
    if names and all(name.endswith(".npy") for name in names):
        arrays = textwrap.shorten(", ".join(name.removesuffix(".npy") for name in names), 120)
        what = f"an archive of NumPy arrays ({arrays}), not a scene"
        return f"{path.name} is {what}: csplat.from_gsplat converts arrays under gsplat's names"
    scenes = scenes_of(names)
    if not scenes:
        return f"{path.name} is a zip without a scene: {textwrap.shorten(', '.join(names), 120) or 'empty'}"
    shown = ", ".join(scenes[:_NAMED]) + (f" and {len(scenes) - _NAMED} more" if len(scenes) > _NAMED else "")
    return f"{path.name} is a zip that contains {shown}: unzip it and name the scene"


def folder_refusal(path: Path) -> str:
    """Return the error message for a folder that is not a scene, naming the newest scene that a trainer left in it."""
    files = {file for pattern in _PATTERNS for file in path.glob(pattern) if file.name.lower().endswith(_SCENES)}
    scenes = sorted(file.relative_to(path).as_posix() for file in files if file.name != _POINTS)
    if not scenes:
        return f"{path} is a folder, not a scene"
    newest = max(scenes, key=lambda name: [int(number) for number in re.findall(r"\d+", name)])
    count = f", the last of {len(scenes)} scenes in it" if len(scenes) > 1 else ""
    return f"{path} is a folder, not a scene: name {newest}{count}"


class Archive(dict[str, NDArray[Any]]):
    """The arrays of a file by name. A missing name raises `InputError`.

    Args:
        path: path of the file.
        kind: description of the file for messages: "a checkpoint of csplat train".
        arrays: the arrays.
    """

    def __init__(self, path: str | Path, kind: str, arrays: dict[str, NDArray[Any]]) -> None:
        super().__init__(arrays)
        self._path, self._kind = path, kind

    def __missing__(self, name: str) -> NDArray[Any]:
        self.refuse(f"it has no {name}")

    def refuse(self, reason: object) -> NoReturn:
        """Raise an `InputError`, which says that the file is not of the expected kind."""
        text = textwrap.shorten(str(reason), 120)
        raise InputError(f"{self._path} is not {self._kind}: {text}")

    def facts(self) -> dict[str, Any]:
        """Return the JSON object stored in the byte array "facts".

        Raises:
            InputError: the array is missing, or is not a JSON object.
        """
        try:
            facts = parse_json(self["facts"].tobytes())
        except InputError as error:
            self.refuse(error)
        if not isinstance(facts, dict):
            self.refuse(f"its facts are a {type(facts).__name__}, expected an object")
        return facts

    def check(self, facts: Mapping[str, Any], kinds: Mapping[str, type]) -> None:
        """Raise an `InputError` unless each name has a value of its type."""
        for name, kind in kinds.items():
            if not isinstance(facts.get(name), kind):
                self.refuse(f"its {name} is not of type {kind.__name__}")


def unpacked_limit(size: int) -> int:
    """Return the number of bytes that compressed data of this size may unpack to: 256 MiB, or 64 times its size."""
    return max(_FREE, _EXPANSION * size)


def member_refusal(info: zipfile.ZipInfo, max_bytes: int) -> str:
    """Return the reason to refuse a member of a zip before it is unpacked; "" if it is accepted.

    Unpacking stops at the declared size, so a member with more data is refused by its checksum.

    Args:
        info: the member.
        max_bytes: maximum declared size.
    """
    if info.compress_type not in _COMPRESSIONS:
        return f"is compressed by method {info.compress_type}, expected 8 (deflate): zip it again"
    if info.file_size > max_bytes:
        return f"of {info.compress_size:,} bytes declares an unpacked size of {info.file_size:,}, allowed {max_bytes:,}"
    return ""


def read_archive(path: str | Path, kind: str) -> Archive:
    """Read all arrays of a .npz file, without pickle.

    Args:
        path: path of the file.
        kind: as in `Archive`.

    Raises:
        InputError: the file is damaged, not a .npz file, or unpacks to more than `unpacked_limit`.
        OSError: the file cannot be read.
    """
    with open_binary(path) as stream:
        if instead := describe_substitute(stream.read(64)):
            raise InputError(f"{path} is {instead}")
        try:
            return Archive(path, kind, _read_arrays(stream))
        except (InputError, *DAMAGED) as error:
            Archive(path, kind, {}).refuse(error)


def _read_arrays(stream: BinaryIO) -> dict[str, NDArray[Any]]:
    """Read the members of a .npz; raises an exception of `DAMAGED`, or an `InputError` with the reason alone."""
    if not zipfile.is_zipfile(stream):
        raise InputError("it is not a .npz file")
    arrays: dict[str, NDArray[Any]] = {}
    remaining_bytes = unpacked_limit(stream.seek(0, io.SEEK_END))
    with zipfile.ZipFile(stream) as archive:
        members = archive.infolist()
        if len(members) > _MAX_ARRAYS:
            raise InputError(f"it has {len(members):,} members, expected at most {_MAX_ARRAYS:,}")
        for info in members:
            name = info.filename.removesuffix(".npy")
            if name in arrays:
                raise InputError(f"it has two arrays {name[:80]}")
            if reason := member_refusal(info, remaining_bytes):
                raise InputError(f"its {name[:80]} {reason}")
            remaining_bytes -= info.file_size
            with archive.open(info) as member:
                try:
                    arrays[name] = parse_array(cast(io.BufferedIOBase, member), info.file_size)
                except InputError as error:
                    raise InputError(f"its {name[:80]} is not an array: {error}") from None
    return arrays

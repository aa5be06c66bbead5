# SPDX-License-Identifier: Apache-2.0
"""Find the files of a SOG in a folder or zip, and read its JSON; neither is trusted."""

from __future__ import annotations

import math
import zipfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any, NoReturn

import numpy as np
from numpy.typing import NDArray

from csplat.archives import DAMAGED, member_refusal, scenes_of
from csplat.disk_files import parse_json, path_inside
from csplat.errors import InputError
from csplat.file_source import describe_substitute, open_binary
from csplat.image_opener import open_image
from csplat.lint import Finding

_LARGEST_JSON = 1 << 25  # bytes
_LARGEST_PART = 1 << 30  # bytes
_LONGEST_NAME = 200  # characters
_SHOWN = 80  # characters of a name in messages
_SHOWN_REASON = 120  # characters of a library's error in messages
_LARGEST_NUMBER = 1e30  # largest magnitude of a number in the JSON, well within float32
_RIFF_HEAD_SIZE = 12  # bytes before the first chunk of a WebP
_ONE, _LEVELS = "meta.json", "lod-meta.json"  # manifests of a single scene, and of a scene in levels
_OF_MACOS = "__MACOSX"  # folder with file attributes that macOS adds to zips
_OF_SYSTEMS = {_OF_MACOS.casefold(), ".ds_store", "thumbs.db"}  # what systems add to folders: attributes, icons
_NAMED = 5  # maximum number of scenes that a message lists
_EXPANSION = 4  # maximum expansion of a zip member: images and short texts do not compress further
_FREE = 1 << 20  # bytes of a member that are accepted regardless of its expansion


class _ZipDirectory:
    """The directory of a zip, which is read once; owns the open archive within `kept_open`.

    Args:
        path: path of the zip.
        title: name of the zip for messages.
    """

    def __init__(self, path: Path, title: str) -> None:
        self._path, self._title = path, title
        self._archive: zipfile.ZipFile | None = None
        with self._open_archive() as archive:
            self.members = archive.infolist()
        self._named: list[dict[str, list[zipfile.ZipInfo]]] = []
        for key in _NAME_KEYS:
            named: dict[str, list[zipfile.ZipInfo]] = {}
            for info in self.members:
                named.setdefault(key(info.filename), []).append(info)
            self._named.append(named)

    @contextmanager
    def kept_open(self) -> Iterator[None]:
        """Keep the archive open until the context ends; otherwise each `read` opens it."""
        with self._open_archive() as archive:
            self._archive = archive
            try:
                yield
            finally:
                self._archive = None

    def find(self, name: str) -> list[zipfile.ZipInfo]:
        """Return the members with a name: exact matches, else matches after `use_slashes`, else ignoring case, too."""
        for key, named in zip(_NAME_KEYS, self._named, strict=True):
            if key(name) in named:
                return named[key(name)]
        return []

    def read(self, info: zipfile.ZipInfo) -> bytes:
        """Unpack a member; raises an error in `DAMAGED` if that fails."""
        if self._archive is not None:
            return self._archive.read(info)
        with zipfile.ZipFile(self._path) as archive:
            return archive.read(info)

    def _open_archive(self) -> zipfile.ZipFile:
        """Open the zip; raise an `InputError` with a reason if it is damaged."""
        try:
            return zipfile.ZipFile(self._path)
        except DAMAGED as error:
            reason = " ".join(str(error).split())[:_SHOWN_REASON] or type(error).__name__
            if "not a zip file" in reason:  # it begins like a zip
                reason = "its end is missing, where its list of files is"
            raise InputError(f"{self._title}: a damaged zip: {reason}: copy or download it again") from None


def use_slashes(name: str) -> str:
    """Replace the backslashes that Windows programs write in names."""
    return name.replace("\\", "/")


#: Keys by which names are compared, tried in this order.
_NAME_KEYS: tuple[Callable[[str], str], ...] = (str, use_slashes, lambda name: use_slashes(name).casefold())


@dataclass(frozen=True)
class SogParts:
    """The files of a SOG, called parts, by name.

    Attributes:
        path: path of the folder or zip.
        title: name for messages.
        folder: folder within the zip; `None` if there is no zip.
        zip: the zip; `None` if the parts are files in a folder.
        findings: findings about unusual names in the zip.
    """

    path: Path
    title: str
    folder: PurePosixPath | None = None
    zip: _ZipDirectory | None = None
    findings: tuple[Finding, ...] = ()

    @contextmanager
    def kept_open(self) -> Iterator[None]:
        """Keep a zip open until the context ends, so its directory is not read for each part."""
        with nullcontext() if self.zip is None else self.zip.kept_open():
            yield

    def nested(self, name: str) -> tuple[SogParts, str]:
        """Return the parts of a nested SOG and the name of its JSON.

        Args:
            name: path of the SOG, relative to the folder of this one; within a zip it must be the path of a JSON.

        Raises:
            InputError: the name leads out of the folder; in a folder, there is no SOG of this name; in a zip, it is not
                the name of a JSON. A JSON that is missing from a zip is reported when it is read.
            OSError: the SOG cannot be read.
        """
        shown = name[:_SHOWN]
        title = f"{self.title}: {shown}"
        if self.folder is None:
            return find_parts(self.file(name), title)
        path = self._inside(name)
        if path.suffix.lower() != ".json":
            self.refuse(
                f"{shown} is not a .json; a SOG within a zip cannot be a zip itself: unpack {self.title} and name its "
                f"{_LEVELS}"
            )
        return SogParts(self.path, title, self.folder / path.parent, self.zip), path.name

    def read(self, name: str, most: int = _LARGEST_PART) -> bytes:
        """Read a part.

        Raises:
            InputError: it does not exist, is too large or damaged, or its name leads out of the folder.
            OSError: it cannot be read.
        """
        if self.folder is not None:
            data = self._unzip(str(self.folder / self._inside(name)), most)
        else:
            with open_binary(self.file(name)) as stream:
                data = stream.read(most + 1)
            if len(data) > most:
                self.refuse(f"{name[:_SHOWN]} has more than {most:,} bytes")
        if instead := describe_substitute(data[:64]):
            self.refuse(f"{name[:_SHOWN]} is {instead}")
        return data

    def file(self, name: str) -> Path:
        """Return the path of a part in a folder; raises the errors of `read`."""
        inside = self._inside(name)
        try:
            path = path_inside(self.path, str(inside))
            if path is not None and (self.folder is not None or not path.is_file()):
                self.refuse(f"there is no {name[:_SHOWN]}")
        except (ValueError, OSError, RuntimeError) as error:  # RuntimeError: circular links
            self.refuse(f"{name[:_SHOWN]!r} cannot be read: {error}")
        if path is None:
            self.refuse(f"the part {name[:_SHOWN]!r} is a link that leads out of it: copy the file there")
        return path

    def _inside(self, name: str) -> PurePosixPath:
        """Return the path of a part; refuse names that are long, absolute or lead out of the folder."""
        path = PurePosixPath(name)
        if path.is_absolute() or ".." in path.parts or len(name) > _LONGEST_NAME or set(name) & {"\\", ":", "\0"}:
            self.refuse(f"the part {name[:_SHOWN]!r} would be outside of it")
        return path

    def _unzip(self, name: str, most: int) -> bytes:
        """Return a part in a zip of at most `most` bytes; refuse absent, ambiguous, damaged and too large parts."""
        assert self.zip is not None, "`folder` is only set within a zip"
        matches = self.zip.find(name)
        if not matches:
            self.refuse(f"there is no {name[:_SHOWN]}")
        if len({info.filename for info in matches}) > 1:
            self.refuse(f"{' and '.join(info.filename[:_SHOWN] for info in matches[:2])} would both be {name[:_SHOWN]}")
        info = matches[-1]
        if reason := member_refusal(info, min(most, _FREE + _EXPANSION * info.compress_size)):
            self.refuse(f"{name[:_SHOWN]} {reason}")
        try:
            return self.zip.read(info)
        except DAMAGED as error:
            self.refuse(f"{name[:_SHOWN]}: {' '.join(str(error).split())[:_SHOWN_REASON] or type(error).__name__}")

    def unread_members(self, used: Sequence[str], folders: Sequence[PurePosixPath] = ()) -> list[str]:
        """Return the members of the zip that have bytes and are not used; none without a zip.

        Args:
            used: names of the parts that are used.
            folders: folders relative to this one; everything in them is used.
        """
        if self.folder is None or self.zip is None:
            return []
        sizes = {use_slashes(info.filename): info.file_size for info in self.zip.members}
        paths = {name: PurePosixPath(name.casefold()) for name, size in sizes.items() if size}
        known = {PurePosixPath(str(self.folder / use_slashes(name)).casefold()) for name in used}
        inside = [PurePosixPath(str(self.folder / folder).casefold()) for folder in folders]
        scenes = set(scenes_of(sizes))  # `_report_others` names them
        return [
            name
            for name, path in paths.items()
            if path not in known and name not in scenes and not _OF_SYSTEMS.intersection(path.parts)
            if not any(path.is_relative_to(folder) for folder in inside)
        ]

    def json(self, name: str) -> JsonValue:
        """Read and parse a JSON part."""
        data = self.read(name, _LARGEST_JSON)
        try:
            value = parse_json(data)
        except InputError as error:
            self.refuse(f"{name[:_SHOWN]} is not JSON: {error}")
        return JsonValue(self, name, value)

    def refuse(self, reason: str) -> NoReturn:
        """Raise the `InputError` for a reason."""
        raise InputError(f"{self.title}: {reason}")


@dataclass(frozen=True)
class JsonValue:
    """A JSON value and its path; methods raise `InputError` if it has another type."""

    parts: SogParts
    json_path: str
    value: Any

    def __contains__(self, name: str) -> bool:
        return isinstance(self.value, dict) and self.value.get(name) is not None

    def __getitem__(self, name: str) -> JsonValue:
        inside = JsonValue(self.parts, f"{self.json_path} {name}", None)
        if name not in self:
            self.parts.refuse(f"{inside.json_path} is missing")
        return JsonValue(self.parts, inside.json_path, self.value[name])

    def list(self) -> list[JsonValue]:
        """Return the values of a list."""
        if not isinstance(self.value, list):
            self.parts.refuse(f"{self.json_path} is not a list")
        return [JsonValue(self.parts, self.json_path, item) for item in self.value]

    def text(self) -> str:
        """Return a string."""
        if not isinstance(self.value, str):
            self.parts.refuse(f"{self.json_path} is not a string")
        return self.value

    def whole(self, most: int) -> int:
        """Return an integer from 0 to `most`."""
        if type(self.value) is not int or not 0 <= self.value <= most:
            self.parts.refuse(f"{self.json_path} is {str(self.value)[:40]}, expected an integer from 0 to {most:,}")
        return int(self.value)

    def numbers(self, least: int, most: int) -> NDArray[np.float64]:
        """Return `least` to `most` finite numbers; a single number needs no brackets."""
        values = self.value if isinstance(self.value, list) else [self.value]
        if not least <= len(values) <= most:
            self.parts.refuse(
                f"{self.json_path} has {len(values)} numbers, expected {least if least == most else most}"
            )
        for number in values:
            if type(number) not in (int, float) or not abs(number) <= _LARGEST_NUMBER or not math.isfinite(number):
                self.parts.refuse(f"{self.json_path} contains {str(number)[:40]}, expected finite numbers")
        return np.array(values, np.float64)


def find_parts(path: Path, title: str | None = None) -> tuple[SogParts, str]:
    """Return the parts of a SOG and the name of its JSON.

    Args:
        path: path of a folder, of a zip, or of the meta.json in a folder.
        title: name for messages; `None`: the name of the path.

    Raises:
        InputError: the path contains no SOG, or several scenes.
        OSError: the path cannot be read.
    """
    title = title or path.name
    if path.is_dir():
        manifests = [PurePosixPath(name) for name in (_ONE, _LEVELS) if (path / name).is_file()]
        if not manifests:
            SogParts(path, title).refuse(f"a folder without {_ONE}, not a SOG")
        return SogParts(path, title), str(_only_scene(SogParts(path, title), manifests))
    with open_binary(path) as stream:
        zipped = stream.read(2) == b"PK"
    if not zipped:
        return SogParts(path.parent, title), path.name
    whole = _ZipDirectory(path, title)
    names = [info.filename for info in whole.members]
    manifests = [member for member in map(PurePosixPath, map(use_slashes, names)) if _is_manifest(member)]
    if not manifests:
        SogParts(path, title).refuse(f"a zip without {_ONE}, not a SOG")
    parts = SogParts(path, title, PurePosixPath(), whole)
    only = _only_scene(parts, manifests)
    oddities = ["backslashes in the names of the zip, read as slashes"] if any("\\" in name for name in names) else []
    oddities += [f"{only.name} is read as {only.name.lower()}"] if only.name != only.name.lower() else []
    findings = [Finding("zip-names", 1, "; ".join(oddities), "note")] if oddities else []
    findings += _report_others(parts, only, names)
    return SogParts(path, title, only.parent, whole, tuple(findings)), only.name


def _report_others(parts: SogParts, only: PurePosixPath, names: Sequence[str]) -> list[Finding]:
    """Report scenes of other formats in the folder of the SOG; refuse a zip with scenes in other folders."""
    paths = [path for path in map(PurePosixPath, map(use_slashes, names)) if _OF_MACOS not in path.parts]
    others = [PurePosixPath(name) for name in scenes_of(map(str, paths))]
    if not others:
        return []
    if not all(other.is_relative_to(only.parent) for other in others):
        _refuse_several(parts, [only, *others])
    shown = _list_paths(others)
    text, lost = f"the zip also holds {shown}: not read", (f"files {shown} of the zip",)
    return [Finding("other-scenes", len(others), text, "note", lost=lost)]


def _is_manifest(path: PurePosixPath) -> bool:
    """Return True for the JSON of a SOG or streamed SOG, except in the folder that macOS adds to zips."""
    return path.name.lower() in (_ONE, _LEVELS) and _OF_MACOS not in path.parts


def _only_scene(parts: SogParts, manifests: Sequence[PurePosixPath]) -> PurePosixPath:
    """Return the only manifest that is not part of another scene.

    Args:
        parts: the folder or the whole zip.
        manifests: paths of all manifests.
    """
    inside: set[PurePosixPath] = set()
    for manifest in manifests if len(manifests) > 1 else ():
        if manifest.name.lower() == _LEVELS:
            meta = parts.json(str(manifest)).value
            files = meta.get("filenames") if isinstance(meta, dict) else None
            names = [*files, meta.get("environment")] if isinstance(files, list) else []
            inside |= {manifest.parent / use_slashes(name) for name in names if isinstance(name, str)}
    scenes = [manifest for manifest in manifests if manifest not in inside]
    if len(scenes) != 1:
        _refuse_several(parts, scenes)
    return scenes[0]


def _refuse_several(parts: SogParts, scenes: Sequence[PurePosixPath]) -> NoReturn:
    """Raise an `InputError` about several scenes in a zip or folder."""
    remedy = "name one of these files" if parts.folder is None else "unpack it and name one of these files"
    parts.refuse(f"it contains {len(scenes)} scenes, expected one ({_list_paths(scenes)}): {remedy}")


def _list_paths(paths: Sequence[PurePosixPath]) -> str:
    """Format the first `_NAMED` paths for messages, in alphabetical order."""
    return ", ".join(str(path)[:_SHOWN] for path in sorted(paths)[:_NAMED]) + (", ..." if len(paths) > _NAMED else "")


def decode_webp(parts: SogParts, name: str, data: bytes, fits: Any) -> NDArray[np.uint8]:
    """Decode the pixels of a lossless WebP, [H, W, 4].

    Args:
        parts: the SOG of the image.
        name: name of the image, for messages.
        data: the encoded image.
        fits: called with width and height before pixels are decoded; returns True if the size is acceptable.

    Raises:
        InputError: the image is damaged, lossy or of another size; or Pillow is not installed.
    """
    if _is_lossy(data):
        parts.refuse(
            f"{name} is a lossy WebP, expected a lossless one: its codes are changed; use the file as exported"
        )
    with open_image(data, f"{parts.title}: {name}", formats=("WebP",), budget=False) as image:
        if not fits(*image.size):
            parts.refuse(f"{name} has {image.size[0]} x {image.size[1]} pixels, which does not match the metadata")
        return np.asarray(image.convert("RGBA"))


def _is_lossy(data: bytes) -> bool:
    """Return True if a WebP has a chunk of lossy pixels (RFC 9649, 2.5)."""
    at = _RIFF_HEAD_SIZE
    while len(data) >= at + 8:
        if data[at : at + 4] == b"VP8 ":
            return True
        size = int.from_bytes(data[at + 4 : at + 8], "little")
        at += 8 + size + size % 2  # chunks begin at even offsets
    return False

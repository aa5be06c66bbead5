"""Inspect a scene before work on it begins: its content, and the time and memory that a command is expected to take."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any
from urllib.parse import unquote

from csplat.encoder import EncodeOptions
from csplat.errors import CsplatError
from csplat.formats import format_of
from csplat_tools.files.by_disk import Scale, expected
from csplat_tools.files.scenes import FOLDER_NAMES, size_of

_FILE_SPLAT_BYTES = 16.0  # bytes per splat if a file does not state its count; .splat, SPZ and SOG have about as many
_UNBOUNDED = 1 << 62
#: Bytes that a process holds in addition to its command: the renderer draws the thumbnail.
RENDERER_BYTES = 160_000_000
#: By command: seconds per scene, seconds per splat, bytes per scene, bytes per splat; `encode` predicts its own if it
#: can. Measured at SH degree 3 on two cores with 120,000 to 1.1 million splats; bytes include a margin of a fifth.
_COSTS = {
    "encode": (0.1, 40e-6, 120e6, 750.0),
    "decode": (0.05, 2.5e-6, 60e6, 300.0),
    "convert": (0.05, 9e-6, 140e6, 150.0),
    "extract": (0.02, 0.1e-6, 40e6, 30.0),
}
_OTHER_BYTES = (340e6, 3000.0)  # bytes per scene and per splat of commands that render: a guess on the safe side


@dataclass(frozen=True)
class Look:
    """A scene's file.

    Attributes:
        sha256: hash of its content; for a folder, of its files and their names.
        size_bytes: size of the file, or of all files of a folder.
        splats: number of splats; `None` if the file does not state it.
        format: the name of its format; "" if it has none.
        encode_seconds, encode_bytes: expected time and memory of encoding it in memory; `None` if not known.
    """

    sha256: str
    size_bytes: int
    splats: int | None
    format: str
    encode_seconds: float | None = None
    encode_bytes: int | None = None

    def as_json(self) -> dict[str, Any]:
        """Return it as JSON-compatible values, which `Look(**...)` takes."""
        return asdict(self)


@dataclass(frozen=True)
class Expected:
    """The time and memory that a command is expected to take for a scene.

    Attributes:
        seconds: expected time on two cores with SH degree 3; `None` if nothing is known of the command.
        memory_bytes: expected peak memory of the process.
    """

    seconds: float | None
    memory_bytes: int


def look(path: Path) -> Look:
    """Read a scene's header and hash its content; defects of the scene are left for the command to report.

    Raises:
        OSError: the file cannot be read.
    """
    size, content = size_of(path), content_hash(path)
    try:
        name = format_of(path).name
        found = expected(path, EncodeOptions(), Scale(memory_bytes=_UNBOUNDED))
    except (CsplatError, ValueError, MemoryError):  # no prediction for such a file
        return Look(content, size, None, "")
    return Look(content, size, found.count, name, found.seconds, found.needs.memory_bytes)


def expect(command: str, known: Look) -> Expected:
    """Return the time and memory that a command with default options is expected to take."""
    splats = known.splats if known.splats is not None else known.size_bytes / _FILE_SPLAT_BYTES
    if command == "encode" and known.encode_bytes is not None:
        return Expected(known.encode_seconds, RENDERER_BYTES + known.encode_bytes)
    if command not in _COSTS:
        each, by_splat = _OTHER_BYTES
        return Expected(None, round(RENDERER_BYTES + each + by_splat * splats))
    seconds, seconds_by_splat, each, by_splat = _COSTS[command]
    return Expected(seconds + seconds_by_splat * splats, round(RENDERER_BYTES + each + by_splat * splats))


def content_hash(path: Path) -> str:
    """Return the SHA-256 of a file; for a scene of several files or a folder, that of their names and contents.

    Raises:
        OSError: a file cannot be read.
    """
    files = _files(path)
    if files == [path]:
        return _hashed(path)
    base = path if path.is_dir() else path.parent
    lines = [f"{_hashed(one)} {one.relative_to(base).as_posix()}\n" for one in files]
    return hashlib.sha256("".join(lines).encode()).hexdigest()


def _files(path: Path) -> list[Path]:
    """List the files of a scene, or of a folder of results."""
    folder = path.parent if path.name.lower() in FOLDER_NAMES else path
    if folder.is_dir():
        return sorted(one for one in folder.rglob("*") if one.is_file())
    return [path, *_beside(path)] if path.suffix.lower() == ".gltf" else [path]


def _beside(path: Path) -> Iterator[Path]:
    """Yield the buffer files that a glTF names and that exist in its folder; none if the JSON cannot be parsed."""
    try:
        buffers = json.loads(path.read_bytes()).get("buffers", [])
        names = [unquote(one["uri"]) for one in buffers if not one.get("uri", "data:").startswith("data:")]
    except (ValueError, TypeError, AttributeError):
        return
    for name in names:
        if (path.parent / name).is_file() and (path.parent / name).resolve().is_relative_to(path.parent.resolve()):
            yield path.parent / name


def _hashed(path: Path) -> str:
    with path.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()

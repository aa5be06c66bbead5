"""Targets of the fuzzer: the readers of PLY and of other formats."""

from __future__ import annotations

import gzip
import io
import math
import random
import tempfile
import warnings
import zipfile
import zlib
from collections.abc import Callable, Generator, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

import csplat
from csplat.errors import InputError
from csplat.formats import formats, read, write
from csplat.model import QUAT_LENGTH_TOLERANCE, SplatModel, normalise_quats
from csplat.ply import lint_ply, read_ply, write_ply
from csplat_selftest.fuzzing import ply_damage
from csplat_selftest.fuzzing.decoder_targets import FuzzCase
from csplat_selftest.fuzzing.ply_damage import Ply, changed

_PACKAGE = Path(csplat.__file__).parent


class FileTarget:
    """A base of targets that read files from a scratch folder, within this process."""

    def __init__(self) -> None:
        memory = Path("/dev/shm")  # noqa: S108 - a new folder is created in it; a disk would take most of the time
        self._folder = tempfile.TemporaryDirectory(prefix="csplat-fuzz-", dir=memory if memory.is_dir() else None)

    def memory(self) -> str:
        """Return a line if another process exceeds its memory; there is none here."""
        return ""

    def coverage(self) -> str:
        """Return the coverage of other processes; there are none here."""
        return ""

    def close(self) -> None:
        """Remove the scratch folder."""
        self._folder.cleanup()


class PlyTarget(FileTarget):
    """The PLY reader and linter, which must agree, and return a valid model or raise InputError."""

    name = "ply"
    suffix = ".ply"
    watched: Sequence[Path] = (_PACKAGE / "ply", _PACKAGE / "lint.py", _PACKAGE / "detect.py")

    def __init__(self) -> None:
        super().__init__()
        self._file = Path(self._folder.name) / "case.ply"

    def seeds(self, paths: Iterable[Path]) -> list[Ply]:
        """Return small PLYs of all degrees, encodings and special cases, and the given files."""
        return ply_damage.seeds() + [Ply.parse(path.read_bytes()) for path in paths]

    def case(self, rng: random.Random, corpus: Sequence[Ply]) -> FuzzCase:
        """Damage header, body or both."""
        ply = changed(rng, rng.choice(corpus))
        data = ply.data
        if rng.random() < 0.05:
            data = data[: rng.randrange(len(data) + 1)]
        return FuzzCase(data, lambda: ply)

    def attempt(self, data: bytes) -> tuple[str, str]:
        """Read and lint a file; occasionally with extra columns, or write it and read it again strictly."""
        self._file.write_bytes(data)
        chance = zlib.crc32(data)
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            errors = _linted(self._file)
            try:
                model = read_ply(self._file, keep_extra=chance % 4 == 0)
            except InputError as error:
                if errors == [] and "csplat" not in str(error):
                    return "finding", f"lint reports no error, but read_ply refuses: {error}"
                return "refused", ""
            if errors:
                return "finding", f"read_ply accepts a file with the lint error {errors[0]}"
            wrong = unsound(model)
            if not wrong and chance % 8 == 1:
                wrong = self._written(model)
        return ("finding", wrong) if wrong else ("read", "")

    def _written(self, model: SplatModel) -> str:
        """Write a model and read it again."""
        path = self._file.with_name("again.ply")
        try:
            write_ply(path, model)
            again = read_ply(path, strict=True)
        except InputError as error:
            # A PLY cannot represent every name of an extra column.
            return "" if model.extra else f"the model cannot be written and read again: {error}"
        if model.extra:
            return ""
        for name in ("means", "scales", "sh0", "shN"):
            if not np.array_equal(getattr(model, name), getattr(again, name)):
                return f"{name} differ after writing and reading"
        return "" if again.origin == model.origin else "the origin differs after writing and reading"

    def smaller(self, data: bytes, corpus: Sequence[Ply]) -> Generator[bytes, bytes | None, None]:  # noqa: ARG002 - as all targets
        """Drop lines of the header and pieces of the body."""
        ply = Ply.parse(data)
        for k in reversed(range(len(ply.lines))):
            smaller = Ply(ply.lines[:k] + ply.lines[k + 1 :], ply.body, ply.newline)
            ply = ply if (yield smaller.data) is None else smaller
        piece = len(ply.body)
        while piece := piece // 2:
            for start in reversed(range(0, len(ply.body), piece)):
                smaller = Ply(ply.lines, ply.body[:start] + ply.body[start + piece :], ply.newline)
                ply = ply if (yield smaller.data) is None else smaller


# Checks --------------------------------------------------------------------------------------------


def _linted(path: Path) -> list[str] | None:
    """Return the ids of the errors that lint reports, None if it refuses the file."""
    try:
        return [finding.id for finding in lint_ply(path) if finding.kind == "error"]
    except InputError:
        return None


def unsound(model: SplatModel) -> str:
    """Return a line about a defect of a model, or an empty string."""
    arrays = {name: getattr(model, name) for name in ("means", "quats", "scales", "opacities", "sh0", "shN")}
    for name, array in arrays.items():
        if array.dtype != np.float32 or len(array) != len(model.means):
            return f"{name} is {array.dtype} {array.shape}"
        if not np.isfinite(array).all():
            return f"{name} contains NaN or infinity"
    lengths = np.linalg.norm(model.quats.astype(np.float64), axis=1)
    if len(lengths) and np.abs(lengths - 1.0).max() > QUAT_LENGTH_TOLERANCE:
        return "a rotation is not of unit length"
    if not ((model.opacities >= 0) & (model.opacities <= 1)).all():
        return "an opacity is outside 0 to 1"
    return "" if all(map(math.isfinite, model.origin)) else "the origin is not finite"


_OWN = ("ply", "csplat")  # formats with separate targets
_COUNTS = (b"\x00\x00\x00\x00", b"\x01\x00\x00\x00", b"\xff\xff\xff\x7f", b"\xff\xff\xff\xff", b"\x00\x00\x00\x80")


@dataclass(frozen=True)
class Seed:
    """A file with the ending of its name."""

    ending: str
    content: bytes

    @property
    def data(self) -> bytes:
        """The ending, a line feed and the content."""
        return self.ending.encode() + b"\n" + self.content

    @classmethod
    def of(cls, data: bytes) -> Seed:
        """Split the result of `data`."""
        ending, _, content = data.partition(b"\n")
        return cls(ending.decode("ascii", "replace").replace("/", "_").replace("\0", "_"), content)


class FormatTarget(FileTarget):
    """The readers of other formats, which must return a valid model or raise InputError."""

    name = "formats"
    suffix = ".case"
    watched: Sequence[Path] = (_PACKAGE / "formats",)

    def seeds(self, paths: Iterable[Path]) -> list[Seed]:
        """Return small scenes in every format that can be written to one file, and the given files."""
        folder = Path(self._folder.name)
        found = []
        for one in formats():
            if one.write is None or one.open is None or one.name in _OWN:
                continue
            for degree in range(one.degree + 1):
                path = folder / f"seed{(one.suffixes or ('.' + one.name,))[0]}"
                write(path, _scene(degree), one.name)
                found.append(Seed("".join(path.suffixes), path.read_bytes()))
        return found + [Seed("".join(path.suffixes), path.read_bytes()) for path in paths]

    def case(self, rng: random.Random, corpus: Sequence[Seed]) -> FuzzCase:
        """Damage a file or its compressed contents."""
        seed = rng.choice(corpus)
        change = _inside if rng.random() < 0.6 else _damaged
        changed = Seed(seed.ending, change(rng, seed.content))
        return FuzzCase(changed.data, lambda: changed)

    def attempt(self, data: bytes) -> tuple[str, str]:
        """Read a file."""
        seed = Seed.of(data)
        path = Path(self._folder.name) / f"case{seed.ending}"
        path.write_bytes(seed.content)
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            try:
                model = read(path, keep_extra=zlib.crc32(data) % 4 == 0)
            except InputError:
                return "refused", ""
            wrong = unsound(model)
        return ("finding", wrong) if wrong else ("read", "")

    def smaller(self, data: bytes, corpus: Sequence[Seed]) -> Generator[bytes, bytes | None, None]:  # noqa: ARG002 - as all targets
        """Drop pieces of the content."""
        seed = Seed.of(data)
        piece = len(seed.content)
        while piece := piece // 2:
            for start in reversed(range(0, len(seed.content), piece)):
                less = Seed(seed.ending, seed.content[:start] + seed.content[start + piece :])
                seed = seed if (yield less.data) is None else less


def _inside(rng: random.Random, data: bytes) -> bytes:
    """Damage the contents of a gzip stream or of a member of an archive, with a valid checksum."""
    if data[:2] == b"\x1f\x8b":
        try:
            return gzip.compress(_damaged(rng, gzip.decompress(data)), 1, mtime=0)
        except (OSError, EOFError, zlib.error):
            return _damaged(rng, data)
    if data[:4] == b"PK\x03\x04":
        return _archive(rng, data)
    return _damaged(rng, data, 64)  # most structure is in the header


def _archive(rng: random.Random, data: bytes) -> bytes:
    out = io.BytesIO()
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as before, zipfile.ZipFile(out, "w") as after:
            names = before.namelist()
            chosen = "meta.json" if "meta.json" in names and rng.random() < 0.5 else rng.choice(names)
            for name in names:
                content = before.read(name)
                after.writestr(name, _damaged(rng, content) if name == chosen else content)
    except (zipfile.BadZipFile, OSError, ValueError, IndexError, NotImplementedError, RuntimeError, zlib.error):
        return _damaged(rng, data)
    return out.getvalue()


def _damaged(rng: random.Random, data: bytes, reach: int | None = None) -> bytes:
    """Change, remove, insert or duplicate a few of the first `reach` bytes."""
    changed = bytearray(data)
    for _ in range(rng.choice((1, 1, 2, 5))):
        at = rng.randrange(min(len(changed), reach or len(changed)) or 1)
        rng.choice(_CHANGES)(rng, changed, at)
    return bytes(changed)


def _flip(rng: random.Random, data: bytearray, at: int) -> None:
    data[at : at + 1] = bytes([(data[at] if at < len(data) else 0) ^ (1 << rng.randrange(8))])


def _count(rng: random.Random, data: bytearray, at: int) -> None:
    data[at : at + 4] = rng.choice(_COUNTS)


def _cut(rng: random.Random, data: bytearray, at: int) -> None:
    del data[at : at + rng.choice((1, 4, 100, len(data)))]


def _twice(rng: random.Random, data: bytearray, at: int) -> None:
    data[at:at] = data[at : at + rng.choice((1, 4, 30))]


def _digit(rng: random.Random, data: bytearray, at: int) -> None:
    """Change a number of a text within the next 200 bytes."""
    for place in range(at, min(at + 200, len(data))):
        if 48 <= data[place] < 58:
            data[place : place + 1] = rng.choice((b"0", b"-1", b"9999999999", b"1e400", b"null", b"[]", b'"x"'))
            return


_CHANGES: tuple[Callable[[random.Random, bytearray, int], None], ...] = (_flip, _flip, _count, _cut, _twice, _digit)


def _scene(degree: int, count: int = 12) -> SplatModel:
    rng = np.random.default_rng(degree)
    return SplatModel(
        means=rng.standard_normal((count, 3)).astype(np.float32),
        quats=normalise_quats(rng.standard_normal((count, 4))),
        scales=rng.uniform(-4.0, -1.0, (count, 3)).astype(np.float32),
        opacities=rng.uniform(0.1, 0.9, count).astype(np.float32),
        sh0=rng.uniform(-1.0, 1.0, (count, 3)).astype(np.float32),
        shN=rng.uniform(-0.3, 0.3, (count, (degree + 1) ** 2 - 1, 3)).astype(np.float32),
    )

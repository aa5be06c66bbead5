# SPDX-License-Identifier: CC0-1.0
"""Targets of the fuzzer: the readers of PLY and of other formats, and ways to damage their files."""

from __future__ import annotations

import gzip
import io
import math
import random
import struct
import tempfile
import warnings
import zipfile
import zlib
from collections.abc import Callable, Generator, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

import csplat
from csplat.errors import FormatError, InputError, LimitError, UnsupportedError
from csplat.formats import formats, read, write
from csplat.model import QUAT_LENGTH_TOLERANCE, SplatModel, normalise_quats
from csplat.ply import lint_ply, read_ply, write_ply
from csplat_authoring.samples import integers
from csplat_selftest.fuzzing.decoder_targets import FuzzCase

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
        return ply_seeds() + [Ply.parse(path.read_bytes()) for path in paths]

    def case(self, rng: random.Random, corpus: Sequence[Ply]) -> FuzzCase:
        """Damage header, body or both."""
        ply = damaged_ply(rng, rng.choice(corpus))
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
            errors = _lint(self._file)
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


def _lint(path: Path) -> list[str] | None:
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
    """The readers of other formats: a valid model, an `InputError`, or the error of a .csplat inside."""

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
        change = _inside if rng.random() < 0.6 else _damage
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
            except (InputError, FormatError, UnsupportedError, LimitError):
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
            return gzip.compress(_damage(rng, gzip.decompress(data)), 1, mtime=0)
        except (OSError, EOFError, zlib.error):
            return _damage(rng, data)
    if data[:4] == b"PK\x03\x04":
        return _archive(rng, data)
    return _damage(rng, data, 64)  # most structure is in the header


def _archive(rng: random.Random, data: bytes) -> bytes:
    out = io.BytesIO()
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as before, zipfile.ZipFile(out, "w") as after:
            names = before.namelist()
            chosen = "meta.json" if "meta.json" in names and rng.random() < 0.5 else rng.choice(names)
            for name in names:
                content = before.read(name)
                after.writestr(name, _damage(rng, content) if name == chosen else content)
    except (zipfile.BadZipFile, OSError, ValueError, IndexError, NotImplementedError, RuntimeError, zlib.error):
        return _damage(rng, data)
    return out.getvalue()


def _damage(rng: random.Random, data: bytes, reach: int | None = None) -> bytes:
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
    for index in range(at, min(at + 200, len(data))):
        if 48 <= data[index] < 58:
            data[index : index + 1] = rng.choice((b"0", b"-1", b"9999999999", b"1e400", b"null", b"[]", b'"x"'))
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


# Damaged PLYs ---------------------------------------------------------------------------------------

_KINDS = ("binary_little_endian", "binary_big_endian", "ascii")
_TYPES = ("char", "uchar", "short", "ushort", "int", "uint", "float", "double", "int8", "uint16", "float32", "float64")
_CODES = {"char": "b", "uchar": "B", "short": "h", "ushort": "H", "int": "i", "uint": "I", "float": "f", "double": "d"}
_NUMBERS = (b"0", b"1", b"-1", b"3", b"7", b"65536", b"2147483648", b"4294967296", b"99999999999999999999", b"1e3")
_WORDS = (
    *_NUMBERS,
    *(word.encode() for word in (*_TYPES, *_KINDS)),
    *(b"element vertex property list comment obj_info format end_header face x y z nx opacity rot_0 rot_4".split()),
    *(b"f_dc_0 f_rest_0 f_rest_8 f_rest_9 f_rest_44 f_rest_71 f_rest_00 scale_2 scale_3 packed_position".split()),
    b"",
    b"\xff\xfe",
    b"nan",
    b"inf",
    b"1.1",
    b"\0",
)
_LINES = (
    *(f"comment csplat {text}".encode() for text in ("antialiased", "flat", "unit_metres 2", "unit_metres 1e-320")),
    *(f"comment csplat {text}".encode() for text in ("unit_metres -1", "origin 1 2 3", "origin 1e308 -1e308 0")),
    *(f"comment csplat {text}".encode() for text in ("origin nan 0 0", "absolute_origin 4e6 5e6 0", "origin 1 2")),
    *(f"comment csplat {text}".encode() for text in ("coordinate_system RDF", "coordinate_system RRR", "licence CC0")),
    b"comment " + b"long " * 3000,
    b"comment",
    b"obj_info by hand",
    b"element face 1",
    b"element vertex 2",
    b"element empty 0",
    b"property list uchar int vertex_indices",
    b"property list float double odd",
    b"property float label",
    b"property double x",
    b"property float rot_4",
    b"property list uint uchar huge",
    b"end_header",
)
_VALUES = (0.0, -0.0, 1.0, -1.0, 5e-324, 1e-45, 1e-30, 3e38, 1e39, 1e308, math.inf, -math.inf, math.nan)
_TOKENS = (b"nan", b"inf", b"-inf", b"1e999", b"-1e-999", b"0x10", b"1_0", b"", b"--1", b"1,5", b"\xc3\xa9", b"9" * 400)


@dataclass(frozen=True)
class Ply:
    """The parts of a PLY.

    Attributes:
        lines: lines of the header, without `end_header`; empty if there is no header.
        body: the bytes after the header.
        newline: line ending of the header.
    """

    lines: tuple[bytes, ...]
    body: bytes
    newline: bytes = b"\n"

    @property
    def data(self) -> bytes:
        """The file."""
        if not self.lines:
            return self.body
        return self.newline.join((*self.lines, b"end_header")) + self.newline + self.body

    @classmethod
    def parse(cls, data: bytes) -> Ply:
        """Split any file into header and body."""
        head, mark, body = data.partition(b"end_header")
        newline = b"\r\n" if b"\r\n" in head else b"\n"
        if not mark:
            return cls((), data, newline)
        return cls(tuple(head.rstrip(b"\r\n").split(newline)), body.removeprefix(newline), newline)


def ply_seeds() -> list[Ply]:
    """Return small PLYs of all degrees, encodings and special cases."""
    made = [_seed(degree, kind, rows) for degree in (0, 1) for kind in _KINDS for rows in (0, 1, 3)]
    made += [_seed(degree, _KINDS[0], 1) for degree in (2, 3, 4)]
    made += [_seed(1, kind, 2, types={"x": "double", "y": "double", "z": "double"}) for kind in _KINDS]
    made += [Ply((), data) for data in (_zip("meta.json"), _zip("a"), gzip.compress(b"NGSP" + bytes(40), mtime=0))]
    made += [_seed(0, kind, 2, extra=("label", "scale_3"), types={"label": "uchar"}) for kind in _KINDS]
    return made


def damaged_ply(rng: random.Random, ply: Ply) -> Ply:
    """Damage header, body or both."""
    for _ in range(rng.choice((1, 1, 1, 2, 3, 5))):
        ply = rng.choice(_PLY_CHANGES)(rng, ply)
    return ply


def _zip(name: str) -> bytes:
    """Return a zip archive of one empty file, because the reader recognises other formats by it."""
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w") as archive:
        archive.writestr(zipfile.ZipInfo(name), b"")
    return out.getvalue()


def _seed(
    degree: int, kind: str, rows: int, *, extra: tuple[str, ...] = (), types: dict[str, str] | None = None
) -> Ply:
    rest = [f"f_rest_{i}" for i in range(3 * ((degree + 1) ** 2 - 1))]
    names = ["x", "y", "z", *(("nx", "ny", "nz") if degree % 2 else ()), "f_dc_0", "f_dc_1", "f_dc_2", *rest]
    names += ["opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3", *extra]
    kinds = [(types or {}).get(name, "float") for name in names]
    lines = ["ply", f"format {kind} 1.0", f"element vertex {rows}"]
    lines += [f"property {kind} {name}" for kind, name in zip(kinds, names, strict=True)]
    values = [value / 64 for value in integers(degree + 7 * rows, rows * len(names), -99, 99)]
    table = [values[i * len(names) : (i + 1) * len(names)] for i in range(rows)]
    if kind == "ascii":
        body = "".join(" ".join(_text(v, kind) for v, kind in zip(row, kinds, strict=True)) + "\n" for row in table)
        return Ply(tuple(line.encode() for line in lines), body.encode())
    layout = struct.Struct((">" if "big" in kind else "<") + "".join(_CODES[kind] for kind in kinds))
    cast = [
        [v if kind in ("float", "double") else int(abs(v)) for v, kind in zip(row, kinds, strict=True)] for row in table
    ]
    return Ply(tuple(line.encode() for line in lines), b"".join(layout.pack(*row) for row in cast))


def _text(value: float, kind: str) -> str:
    return repr(value) if kind in ("float", "double") else str(int(abs(value)))


# Changes -------------------------------------------------------------------------------------------


def _line_changes(rng: random.Random, ply: Ply) -> Ply:
    """Remove, duplicate, move or insert a line."""
    lines = list(ply.lines)
    at = rng.randrange(len(lines) + 1)
    kind = rng.randrange(5)
    if kind == 0 and lines:
        del lines[at : at + rng.choice((1, 1, 3))]
    elif kind == 1:
        lines[at:at] = lines[at : at + 1]
    elif kind == 2 and len(lines) > 1:
        i, k = rng.randrange(len(lines)), rng.randrange(len(lines))
        lines[i], lines[k] = lines[k], lines[i]
    else:
        lines.insert(at, rng.choice(_LINES))
    return Ply(tuple(lines), ply.body, ply.newline)


def _word_changes(rng: random.Random, ply: Ply) -> Ply:
    """Replace or insert a word in a line of the header."""
    if not ply.lines:
        return ply
    lines = list(ply.lines)
    at = rng.randrange(min(4, len(lines))) if rng.random() < 0.5 else rng.randrange(len(lines))
    words = lines[at].split(b" ")
    index = rng.randrange(len(words) + 1)
    words[index : index + rng.choice((0, 1, 1, 1))] = [rng.choice(_WORDS)]
    lines[at] = b" ".join(words)
    return Ply(tuple(lines), ply.body, ply.newline)


def _header_bytes(rng: random.Random, ply: Ply) -> Ply:
    """Change bytes or line endings of the header."""
    if rng.random() < 0.3:
        return Ply(ply.lines, ply.body, rng.choice((b"\n", b"\r\n", b"\r", b"\n\n", b" \n")))
    if not ply.lines:
        return ply
    lines = list(ply.lines)
    at = rng.randrange(len(lines))
    line = bytearray(lines[at])
    for _ in range(rng.choice((1, 1, 2))):
        if line:
            line[rng.randrange(len(line))] = rng.choice((0, 9, 10, 13, 32, 127, 128, 255, rng.randrange(256)))
    lines[at] = bytes(line)
    return Ply(tuple(lines), ply.body, ply.newline)


def _body_values(rng: random.Random, ply: Ply) -> Ply:
    """Replace numbers by special values."""
    if any(b"ascii" in line for line in ply.lines[:3]):
        tokens = ply.body.split(b" ")
        for _ in range(rng.choice((1, 1, 4))):
            tokens[rng.randrange(len(tokens))] = rng.choice((*_TOKENS, repr(rng.choice(_VALUES)).encode()))
        return Ply(ply.lines, b" ".join(tokens), ply.newline)
    body = bytearray(ply.body)
    code = rng.choice(("<f", ">f", "<d", ">d"))
    size = struct.calcsize(code)
    for _ in range(rng.choice((1, 1, 4, 16))):
        if len(body) >= size:
            at = rng.randrange(0, len(body) - size + 1) // 4 * 4
            value = rng.choice(_VALUES)
            body[at : at + size] = struct.pack(code, value if "d" in code or abs(value) < 3.4e38 else math.inf)
    return Ply(ply.lines, bytes(body), ply.newline)


def _body_bytes(rng: random.Random, ply: Ply) -> Ply:
    """Flip bits, truncate, extend or repeat."""
    body = bytearray(ply.body)
    kind = rng.randrange(4)
    if kind == 0 and body:
        for _ in range(rng.choice((1, 2, 8))):
            body[rng.randrange(len(body))] ^= 1 << rng.randrange(8)
    elif kind == 1:
        del body[rng.randrange(len(body) + 1) :]
    elif kind == 2:
        body += rng.choice((b"\0", b"\n", b" \n\t", rng.randbytes(rng.randrange(1, 40)), bytes(body)))
    elif body:
        at = rng.randrange(len(body))
        body[at:at] = body[at : at + rng.choice((1, 4, 17))]
    return Ply(ply.lines, bytes(body), ply.newline)


def _count_changes(rng: random.Random, ply: Ply) -> Ply:
    """Change the declared number of rows, and in some cases repeat the rows to match."""
    lines = list(ply.lines)
    found = [i for i, line in enumerate(lines) if line.startswith(b"element")]
    if not found:
        return ply
    at, times = rng.choice(found), rng.choice((0, 1, 2, 5, 300))
    words = lines[at].split()
    if len(words) != 3 or not words[2].isdigit():
        return ply
    fits = rng.random() < 0.5
    new = str(int(words[2]) * times).encode() if fits else rng.choice(_NUMBERS)
    lines[at] = b" ".join((*words[:2], new))
    return Ply(tuple(lines), ply.body * times if fits and len(ply.body) < 2000 else ply.body, ply.newline)


_PLY_CHANGES = (
    _line_changes,
    _line_changes,
    _word_changes,
    _word_changes,
    _header_bytes,
    _body_values,
    _body_bytes,
    _count_changes,
)

"""Damage PLY files for fuzzing: seeds of all degrees and encodings, and changes of header and body."""

from __future__ import annotations

import gzip
import io
import math
import random
import struct
import zipfile
from dataclasses import dataclass

from csplat_authoring.samples import integers

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


def seeds() -> list[Ply]:
    """Return small PLYs of all degrees, encodings and special cases."""
    made = [_seed(degree, kind, rows) for degree in (0, 1) for kind in _KINDS for rows in (0, 1, 3)]
    made += [_seed(degree, _KINDS[0], 1) for degree in (2, 3)]
    made += [_seed(1, kind, 2, types={"x": "double", "y": "double", "z": "double"}) for kind in _KINDS]
    made += [Ply((), data) for data in (_zip("meta.json"), _zip("a"), gzip.compress(b"NGSP" + bytes(40), mtime=0))]
    made += [_seed(0, kind, 2, extra=("label", "scale_3"), types={"label": "uchar"}) for kind in _KINDS]
    return made


def changed(rng: random.Random, ply: Ply) -> Ply:
    """Damage header, body or both."""
    for _ in range(rng.choice((1, 1, 1, 2, 3, 5))):
        ply = rng.choice(_CHANGES)(rng, ply)
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
    word = rng.randrange(len(words) + 1)
    words[word : word + rng.choice((0, 1, 1, 1))] = [rng.choice(_WORDS)]
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


def _count(rng: random.Random, ply: Ply) -> Ply:
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


_CHANGES = (
    _line_changes,
    _line_changes,
    _word_changes,
    _word_changes,
    _header_bytes,
    _body_values,
    _body_bytes,
    _count,
)

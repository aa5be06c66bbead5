"""Bytes with a name for every field, so that a vector can break one field and say where it lies."""

from __future__ import annotations

import re
import struct
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any

from csplat import _spec


@dataclass(frozen=True)
class Field:
    """A field's place: offset in the bytes that hold it, struct format, structure that it belongs to."""

    offset: int
    format: str
    structure: str = ""

    @property
    def size(self) -> int:
        """Bytes of the field."""
        return struct.calcsize(self.format)


@dataclass
class Writer:
    """Bytes that grow, and the fields in them."""

    data: bytearray = field(default_factory=bytearray)
    fields: dict[str, Field] = field(default_factory=dict)

    def structure(self, name: str, structure: str, values: Iterable[Any]) -> None:
        """Append a structure of the registry; its fields are called `name.field`."""
        packer: struct.Struct = getattr(_spec, f"{structure.upper()}_STRUCT")
        offsets: dict[str, int] = getattr(_spec, f"{structure.upper()}_OFFSETS")
        for key, (offset, code) in _formats(packer.format, offsets).items():
            self.fields[f"{name}.{key}"] = Field(len(self.data) + offset, code, structure)
        flat = [v for value in values for v in (value if isinstance(value, tuple) else (value,))]
        self.data += packer.pack(*flat)

    def value(self, name: str, code: str, value: Any) -> None:
        """Append one field with a struct code."""
        self.fields[name] = Field(len(self.data), "<" + code)
        self.data += struct.pack("<" + code, *(value if isinstance(value, tuple) else (value,)))

    def raw(self, name: str, data: bytes) -> None:
        """Append bytes as one field."""
        self.value(name, f"{len(data)}s", data)

    def append(self, other: Writer, prefix: str = "") -> None:
        """Append another writer's bytes and fields."""
        for name, entry in other.fields.items():
            self.fields[prefix + name] = Field(entry.offset + len(self.data), entry.format, entry.structure)
        self.data += other.data

    def patch(self, name: str, value: Any) -> None:
        """Overwrite a field: a number, a tuple, or the bytes themselves."""
        entry = self.fields[name]
        if isinstance(value, bytes):
            packed = value
        else:
            packed = struct.pack(entry.format, *(value if isinstance(value, Sequence) else (value,)))
        if len(packed) != entry.size:
            raise ValueError(f"{name} has {entry.size} bytes, not {len(packed)}")
        self.data[entry.offset : entry.offset + entry.size] = packed


def _formats(packed: str, offsets: dict[str, int]) -> dict[str, tuple[int, str]]:
    """Split a struct format at the offsets of the fields: name to (offset, format)."""
    codes = re.findall(r"\d*[a-zA-Z]", packed.lstrip("<"))
    result: dict[str, tuple[int, str]] = {}
    at, name = 0, ""
    starts = {offset: key for key, offset in offsets.items()}
    for code in codes:
        if at in starts:
            name = starts[at]
            result[name] = (at, "<")
        result[name] = (result[name][0], result[name][1] + code)
        at += struct.calcsize("<" + code)
    return result

# SPDX-License-Identifier: CC0-1.0
"""Locate the fields of a file by name, and write structures with named fields."""

from __future__ import annotations

import re
import struct
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from functools import cache
from typing import Any

from csplat import _spec

_CRC_SIZE = 4


@dataclass(frozen=True)
class Field:
    """The position of a field: offset, struct format, and the structure that it belongs to."""

    offset: int
    format: str
    structure: str = ""

    @property
    def size(self) -> int:
        """Size in bytes."""
        return struct.calcsize(self.format)


@dataclass
class Writer:
    """A writer of bytes that records the positions of fields."""

    data: bytearray = field(default_factory=bytearray)
    fields: dict[str, Field] = field(default_factory=dict)

    def structure(self, name: str, structure: str, values: Iterable[Any]) -> None:
        """Append a structure of the registry, with fields named `name.field`."""
        packer: struct.Struct = getattr(_spec, f"{structure.upper()}_STRUCT")
        for key, (offset, code) in _fields_of(structure).items():
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


def read_fields(data: bytes) -> tuple[dict[str, Field], dict[str, tuple[int, int]]]:
    """Locate the fields of header, index records and chunk headers in any valid file.

    Returns:
        Places of the fields by name; offset and size of each chunk by name, in the order of the file.

    Raises:
        ValueError: the records do not fill the index.
    """
    out = Writer()
    out.structure("header", "header", _spec.unpack_header(data))
    index_size = _spec.unpack_header(data).index_size
    head = _spec.unpack_index_head(data, _spec.HEADER_SIZE)
    out.structure("index", "index_head", head)
    spans: dict[str, tuple[int, int]] = {}
    if head.head_size > _spec.INDEX_HEAD_SIZE:
        out.raw("index.tail", data[len(out.data) : _spec.HEADER_SIZE + head.head_size])

    def record(name: str, structure: str) -> tuple[int, ...]:
        """Append the next record and the tail that `head` gives it, if any, to `out`; return its values."""
        unpack = getattr(_spec, f"unpack_{structure}")
        values: tuple[int, ...] = unpack(data, len(out.data))
        at = len(out.data)
        out.structure(name, structure, values)
        end = at + int(getattr(head, structure.replace("_record", "_size")))
        if end > len(out.data):
            out.raw(f"{name}.tail", data[len(out.data) : end])
        return values

    for structure, count in (("attribute", head.attribute_count), ("codebook", head.codebook_count)):
        for i in range(count):
            record(f"{structure}[{i}]", f"{structure}_record")
    for i in range(head.extra_count):
        record(f"extra[{i}]", "extra_record")
    for i in range(head.directory_count):
        entry = _spec.DirectoryRecord(*record(f"directory[{i}]", "directory_record"))  # type: ignore[arg-type]  # one field is bytes
        spans[f"{i}"] = (entry.offset, entry.size)
    for i in range(head.tile_count):
        tile = _spec.TileRecord(*record(f"tile[{i}]", "tile_record"))  # type: ignore[arg-type]  # some fields are tuples
        for k in range(tile.layer_count):
            layer = _spec.LayerRecord(*record(f"tile[{i}].layer[{k}]", "layer_record"))
            spans[f"TILE.{i}.{k}"] = (layer.offset, layer.size)
        out.raw(f"tile[{i}].tables", data[len(out.data) : len(out.data) + 2 * tile.table_count])
    if len(out.data) + _CRC_SIZE != _spec.HEADER_SIZE + index_size:
        raise ValueError("the records do not fill the index")
    for name, (offset, _) in spans.items():
        for key, field_offset in _spec.CHUNK_HEADER_OFFSETS.items():
            out.fields[f"{name}/header.{key}"] = Field(
                offset + field_offset, "<H" if key in ("flags", "reserved_0") else "<I"
            )
    return out.fields, dict(sorted(spans.items(), key=lambda item: item[1]))


@cache
def _fields_of(structure: str) -> dict[str, tuple[int, str]]:
    """Return offset and struct format of each field of a structure of the registry, by name.

    A field has all codes up to the offset of the next field. The first field is at offset 0.
    """
    packer: struct.Struct = getattr(_spec, f"{structure.upper()}_STRUCT")
    offsets: dict[str, int] = getattr(_spec, f"{structure.upper()}_OFFSETS")
    codes = re.findall(r"\d*[a-zA-Z]", packer.format.lstrip("<"))
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

# SPDX-License-Identifier: CC0-1.0
"""Index (spec 4.3): head and records, directory, tiles, and the chunks that they name."""

from __future__ import annotations

import math
import zlib
from collections.abc import Sequence
from dataclasses import dataclass, field
from fractions import Fraction
from typing import Any

import numpy as np

from csplat import _spec
from csplat_conformance.validator.violation_log import Payload, PlacedRecord, ViolationLog, read_record

# Bits that are not ancillary (ANC-1), written by hand to check the registry.
_REGISTERED_FLAGS, _REGISTERED_SCENE_FLAGS = 0x00FF, 0x0F
#: Bytes of the fields that this version knows.
_SIZES_MIN = {
    "head": _spec.INDEX_HEAD_SIZE,
    "attribute": _spec.ATTRIBUTE_RECORD_SIZE,
    "codebook": _spec.CODEBOOK_RECORD_SIZE,
    "extra": _spec.EXTRA_RECORD_SIZE,
    "directory": _spec.DIRECTORY_RECORD_SIZE,
    "tile": _spec.TILE_RECORD_SIZE,
    "layer": _spec.LAYER_RECORD_SIZE,
}
_CODEBOOK_ID_SIZE = 2  # bytes
_STEP_MIN = Fraction(1, 2**1022)  # the smallest normal binary64
_BINARY32_MIN, _BINARY32_MAX = Fraction(1, 2**126), Fraction(2**128 - 2**104)  # normal values
_BINARY32_BITS = 24  # bits of a binary32 significand
_STEP_MAX = Fraction((2**53 - 1) * 2**971)  # the largest finite binary64
#: Axis of each direction (right, left, up, down, front, back): an orientation names each axis once.
_AXIS_OF_DIRECTION = {"R": 0, "L": 0, "U": 1, "D": 1, "F": 2, "B": 2}

Head = PlacedRecord[_spec.IndexHead]
AttributeAt = PlacedRecord[_spec.AttributeRecord]
CodebookAt = PlacedRecord[_spec.CodebookRecord]


@dataclass
class Index:
    """The contents of the index as far as they could be read.

    Attributes:
        head: the index head.
        degree: `sh_degree`; `None` if it is beyond SH_DEGREE_MAX.
        attributes: attribute records by registry value.
        steps: steps that obey ATT-6 and ATT-10, by registry value.
        levels: levels that obey ATT-3 or ATT-4, by registry value.
        codebooks: codebook records with valid kind and sizes, by id.
        codebook_ids: ids of all codebook records.
        extras: bytes per value and number of components of each extra column, `None` if type or coding is unknown.
        complete: whether all records read so far fit into the index.
        end: offset of the end of these records.
    """

    head: Head
    degree: int | None
    attributes: dict[int, AttributeAt] = field(default_factory=dict)
    steps: dict[int, float] = field(default_factory=dict)
    levels: dict[int, int] = field(default_factory=dict)
    codebooks: dict[int, CodebookAt] = field(default_factory=dict)
    codebook_ids: set[int] = field(default_factory=set)
    extras: list[tuple[int, int] | None] = field(default_factory=list)
    complete: bool = True
    end: int = 0

    def size_of(self, kind: str) -> int:
        """Return the size of the head or of a kind of record with its tail, at least the size of its fields."""
        return max(_SIZES_MIN[kind], int(getattr(self.head.record, f"{kind}_size")))


def scaled_step(step: float, exponent: int, *, single: bool = False) -> float | None:
    """Return step × 2^exponent, `None` if it is infinite or subnormal in binary64 or binary32 (TIL-9, LAT-1)."""
    if abs(exponent) > 4096:  # beyond binary64 for every step; avoids huge integers
        return None
    product = Fraction(step) * Fraction(2) ** exponent
    low, high = (_BINARY32_MIN, _BINARY32_MAX) if single else (_STEP_MIN, _STEP_MAX)
    return float(product) if low <= product <= high else None


def value_bits(n: int, scale: float) -> bytes:
    """Return float32(float64(n) × s), little-endian (7.2)."""
    with np.errstate(over="ignore", under="ignore"):
        return np.array(float(n) * scale, np.float64).astype("<f4").tobytes()


def is_finite(n: int, scale: float) -> bool:
    """Return True if the value of a lattice integer is finite in binary32 (LAT-5, MEA-1)."""
    return math.isfinite(float(np.frombuffer(value_bits(n, scale), "<f4")[0]))


def read_records(view: memoryview, end: int, log: ViolationLog) -> Index:
    """Read the records of the index before the directory.

    Args:
        view: the file.
        end: offset of the index's CRC according to the header, not beyond the data.
        log: receives the violations.
    """
    start = _spec.HEADER_SIZE
    head = read_record(view, _spec.IndexHead, start, "index")
    record = head.record
    index = Index(head, record.sh_degree if record.sh_degree <= _spec.SH_DEGREE_MAX else None)
    kinds = ("attribute", "codebook", "extra", "directory", "tile")
    needed = index.size_of("head") + sum(getattr(record, f"{kind}_count") * index.size_of(kind) for kind in kinds)
    if start + needed > end:
        log.add("IDX-2", start, "index", f"its counts require at least {needed} bytes, it has {end - start}")
    _check_head(log, head)
    at = start + index.size_of("head")
    at = _read_attributes(view, at, end, index, log)
    at = _read_codebooks(view, at, end, index, log)
    index.end = _read_extras(view, at, end, index, log)
    return index


def _count_fitting_records(index: Index, at: int, end: int, count: int, size: int) -> int:
    """Return how many of `count` records of `size` bytes fit between `at` and `end`.

    Sets `index.complete` to False if not all fit, and returns 0 if it already is False.
    """
    fitting = min(count, max(0, (end - at) // size)) if index.complete else 0
    index.complete &= fitting == count
    return fitting


def _check_head(log: ViolationLog, head: Head) -> None:
    """Check the index head: RES-1, RES-2, IDX-3 to IDX-6, IDX-8, EXR-4."""
    record = head.record
    log.check_reserved(head)
    for kind, least in _SIZES_MIN.items():
        size = getattr(record, f"{kind}_size")
        if size < least:
            log.add_field("IDX-8", head, f"{kind}_size", f"{size}, expected at least {least}")
    if record.extra_count > _spec.EXTRA_COLUMNS_MAX:
        log.add_field("EXR-4", head, "extra_count", f"{record.extra_count}, expected at most {_spec.EXTRA_COLUMNS_MAX}")
    if record.sh_degree > _spec.SH_DEGREE_MAX:
        log.add_field("IDX-3", head, "sh_degree", f"{record.sh_degree}, expected at most {_spec.SH_DEGREE_MAX}")
    if record.kernel not in _spec.KERNEL_NAMES:
        kernel = _spec.KERNEL_RESERVED.get(record.kernel, str(record.kernel)).upper()
        log.add_field("RES-2", head, "kernel", f"{kernel} is not a kernel of this version")
    for key, known in (("projection", (0,)), ("antialiasing", (0, 1)), ("colour_space", (0, 1))):
        value = getattr(record, key)
        if value not in known and value < _spec.ANCILLARY_ID_MIN:
            log.add_field("RES-2", head, key, f"{value} is not in the registry")
    unlisted = record.scene_flags & _REGISTERED_SCENE_FLAGS & ~sum(_spec.SCENE_FLAG_NAMES)
    if unlisted:
        log.add_field("RES-1", head, "scene_flags", f"bits {unlisted:#04x} are reserved")
    letters = [_spec.DIRECTION_LETTER.get(axis) for axis in record.axes]
    if any(record.axes) and {_AXIS_OF_DIRECTION.get(letter or "") for letter in letters} != {0, 1, 2}:
        log.add_field("IDX-4", head, "axes", f"{list(record.axes)}, expected zeros or directions along three lines")
    if not 0.0 <= record.unit_metres < math.inf:
        log.add_field("IDX-5", head, "unit_metres", f"{record.unit_metres}, expected 0, or positive and finite")
    for axis, value in enumerate(record.origin):
        if not math.isfinite(value):
            log.add_field(
                "IDX-6", head, "origin", f"component {axis} is {value}, expected a finite number", within=8 * axis
            )


# Attribute records ---------------------------------------------------------------------------------


def _read_attributes(view: memoryview, at: int, end: int, index: Index, log: ViolationLog) -> int:
    """Read the attribute records from `at` on, check RES-1 and ATT-1 to ATT-10, and return the end offset.

    Adds the first record of each known attribute to `index.attributes`, and its valid step or levels to the index.
    """
    count = index.head.record.attribute_count
    bands = 0 if index.degree is None else index.degree
    expected = [value for value, layer in _spec.ATTRIBUTE_LAYER.items() if layer <= bands]
    if index.degree is not None and count != len(expected):
        message = f"{count}, expected {len(expected)} for SH degree {bands}"
        log.add_field("ATT-1", index.head, "attribute_count", message)
    for i in range(_count_fitting_records(index, at, end, count, index.size_of("attribute"))):
        attribute = view[at]
        name = f"attribute[{_spec.ATTRIBUTE_NAMES.get(attribute, attribute)}]"
        placed = read_record(view, _spec.AttributeRecord, at, name)
        log.check_reserved(placed)
        if count == len(expected) and index.degree is not None and attribute != expected[i]:
            log.add_field("ATT-1", placed, "attribute", f"{attribute}, expected {expected[i]} at index {i}")
        if attribute in _spec.ATTRIBUTE_NAMES and attribute not in index.attributes:
            index.attributes[attribute] = placed
            _check_attribute(log, placed, index)
        at += index.size_of("attribute")
    return at


def _check_attribute(log: ViolationLog, placed: AttributeAt, index: Index) -> None:
    """Check ATT-2 and ATT-8 to ATT-10, and the clauses of levels and lattices."""
    record = placed.record
    legal = _spec.ATTRIBUTE_MAPPINGS[record.attribute]
    if _spec.MAPPING_NAMES.get(record.mapping) not in legal:
        log.add_field("ATT-2", placed, "mapping", f"{record.mapping}, expected {' or '.join(legal) or 'none'}")
    if record.chroma_shift > _spec.CHROMA_SHIFT_MAX:
        log.add_field(
            "ATT-8", placed, "chroma_shift", f"{record.chroma_shift}, expected at most {_spec.CHROMA_SHIFT_MAX}"
        )
    if record.chroma_shift and record.mapping != _spec.MAPPING_YCOCG:
        log.add_field("ATT-9", placed, "chroma_shift", f"{record.chroma_shift}, expected 0 without YCOCG")
    kind = _spec.ATTRIBUTE_KIND[record.attribute]
    if kind == "lattice":
        _check_lattice(log, placed, index)
    elif kind == "levels":
        _check_levels(log, placed, index)


def _check_levels(log: ViolationLog, placed: AttributeAt, index: Index) -> None:
    """Check ATT-3, ATT-4 and ATT-7; add valid levels to the index."""
    record = placed.record
    clause, low, high = "ATT-4", _spec.QUAT_LEVELS_MIN, _spec.QUAT_LEVELS_MAX
    if record.attribute == _spec.ATTRIBUTE_OPACITIES:
        clause, low, high = "ATT-3", 1, _spec.OPACITY_LEVELS_MAX
    if low <= record.levels <= high:
        index.levels[record.attribute] = record.levels
    else:
        log.add_field(clause, placed, "levels", f"{record.levels}, expected {low} to {high}")
    if record.step != 0.0 or math.copysign(1.0, record.step) < 0.0:
        log.add_field("ATT-7", placed, "step", f"{record.step} for an attribute of levels, expected +0")


def _check_lattice(log: ViolationLog, placed: AttributeAt, index: Index) -> None:
    """Check ATT-5, ATT-6 and ATT-10; add a valid step to the index."""
    record = placed.record
    if record.levels:
        log.add_field("ATT-5", placed, "levels", f"{record.levels} for a lattice, expected 0")
    if not 2.0**-1022 <= record.step < math.inf:
        log.add_field("ATT-6", placed, "step", f"{record.step}, expected positive, finite and at least 2^-1022")
    elif record.attribute != _spec.ATTRIBUTE_MEANS and not _is_normal_binary32(Fraction(record.step)):
        log.add_field("ATT-10", placed, "step", f"{record.step}, expected a binary32 value of at least 2^-126")
    else:
        index.steps[record.attribute] = record.step


def _is_normal_binary32(step: Fraction) -> bool:
    """Return True for a normal binary32 value: at most 24 bits from the first 1 to the last."""
    if not _BINARY32_MIN <= step <= _BINARY32_MAX:
        return False
    numerator = step.numerator  # the denominator is a power of two
    return (numerator // (numerator & -numerator)).bit_length() <= _BINARY32_BITS


# Codebook records ----------------------------------------------------------------------------------


def _read_codebooks(view: memoryview, at: int, end: int, index: Index, log: ViolationLog) -> int:
    """Read the codebook records from `at` on, check RES-1 and CBR-1 to CBR-4, and return the end offset.

    Adds valid records to `index.codebooks`, and all ids to `index.codebook_ids`.
    """
    last = -1
    for _ in range(_count_fitting_records(index, at, end, index.head.record.codebook_count, index.size_of("codebook"))):
        identity = int.from_bytes(view[at : at + _CODEBOOK_ID_SIZE], "little")
        name = f"codebook[{identity}]"
        placed = read_record(view, _spec.CodebookRecord, at, name)
        log.check_reserved(placed)
        if identity <= last:
            log.add_field("CBR-1", placed, "codebook_id", f"{identity} after {last}, expected ascending ids")
        last = identity
        index.codebook_ids.add(identity)
        if _is_sound_codebook(log, placed, index):
            index.codebooks.setdefault(identity, placed)
        at += index.size_of("codebook")
    return at


def _is_sound_codebook(log: ViolationLog, placed: CodebookAt, index: Index) -> bool:
    """Check RES-2 of the kind, CBR-2 and CBR-4; return True if they hold."""
    record = placed.record
    violation_count = len(log.violations)
    first, last = record.band_first, record.band_last
    if record.kind not in _spec.CODEBOOK_KIND_NAMES:
        log.add_field("RES-2", placed, "kind", f"{record.kind} is not a kind of this version")
    elif record.kind == _spec.CODEBOOK_KIND_SH:
        highest = _spec.SH_DEGREE_MAX if index.degree is None else index.degree
        if not 1 <= first <= last <= highest:
            log.add_field("CBR-2", placed, "band_first", f"bands {first} to {last}, expected 1 to {highest}, ascending")
    elif first or last:
        log.add_field("CBR-2", placed, "band_first", f"bands {first} to {last} for a kind without bands, expected 0")
    if not 1 <= record.size <= _spec.CODEBOOK_ENTRIES_MAX:
        log.add_field("CBR-4", placed, "size", f"{record.size} entries, expected 1 to {_spec.CODEBOOK_ENTRIES_MAX}")
    return len(log.violations) == violation_count


# Extra column records ------------------------------------------------------------------------------


def _read_extras(view: memoryview, at: int, end: int, index: Index, log: ViolationLog) -> int:
    """Read the extra column records from `at` on and return the end offset; check RES-1, RES-2 and EXR, except EXR-4.

    Adds the bytes per value and the components of each column to `index.extras`, `None` for unknown types and codings.
    """
    names: set[str] = set()
    for i in range(_count_fitting_records(index, at, end, index.head.record.extra_count, index.size_of("extra"))):
        placed = read_record(view, _spec.ExtraRecord, at, f"extra[{i}]")
        record = placed.record
        log.check_reserved(placed)
        if record.dtype < _spec.ANCILLARY_ID_MIN and record.dtype not in _spec.EXTRA_DTYPE_NAMES:
            log.add_field("RES-2", placed, "dtype", f"{record.dtype} is not in the registry")
        if record.coding < _spec.ANCILLARY_ID_MIN and record.coding != _spec.CODING_RAW:
            log.add_field("EXR-6", placed, "coding", f"{record.coding}, expected {_spec.CODING_RAW}")
        if not 1 <= record.components <= _spec.EXTRA_COMPONENTS_MAX:
            message = f"{record.components}, expected 1 to {_spec.EXTRA_COMPONENTS_MAX}"
            log.add_field("EXR-5", placed, "components", message)
        if not 1 <= record.name_size <= _spec.EXTRA_NAME_MAX:
            log.add_field("EXR-1", placed, "name_size", f"{record.name_size}, expected 1 to {_spec.EXTRA_NAME_MAX}")
        else:
            name = _check_text(log, placed, "name", record.name_size, "EXR-2")
            if name in names:
                log.add_field("EXR-2", placed, "name", f"a second column is named {name!r}")
            names |= set() if name is None else {name}
        if record.semantic_size > _spec.EXTRA_SEMANTIC_MAX:
            message = f"{record.semantic_size}, expected at most {_spec.EXTRA_SEMANTIC_MAX}"
            log.add_field("EXR-7", placed, "semantic_size", message)
        else:
            _check_text(log, placed, "semantic", record.semantic_size, "EXR-7")
        size = _spec.EXTRA_DTYPE_BYTES.get(record.dtype) if record.coding == _spec.CODING_RAW else None
        index.extras.append(None if size is None else (size, record.components))
        at += index.size_of("extra")
    return at


def _check_text(
    log: ViolationLog, placed: PlacedRecord[_spec.ExtraRecord], field_name: str, size: int, clause: str
) -> str | None:
    """Check EXR-3, and by `clause` that the first `size` bytes are a text, which is returned, `None` if not UTF-8."""
    data: bytes = getattr(placed.record, field_name)
    if any(data[size:]):
        log.add_field("EXR-3", placed, field_name, f"bytes after the {field_name} are not 0", within=size)
    try:
        text = data[:size].decode("utf-8")
    except UnicodeDecodeError as error:
        log.add_field(clause, placed, field_name, f"byte {error.start} is not UTF-8", within=error.start)
        return None
    if any(ord(character) < 0x20 or ord(character) == 0x7F for character in text):
        log.add_field(clause, placed, field_name, f"a control character in {text!r}")
    return text


#: Chunks that 4.3.6 recommends at the end of a file with levels.
_LAST_CHUNKS = (_spec.CHUNK_CAMERAS, _spec.CHUNK_OPTIONS, _spec.CHUNK_DECLARED_ERRORS)
_SINGLE_CHUNKS = (_spec.CHUNK_METADATA, *_LAST_CHUNKS, _spec.CHUNK_TREE)
#: The first number after the layers of this version; the order of later layers is not checked (4.3.6).
_LAYER_END = _spec.LAYER_EXTRA + _spec.EXTRA_COLUMNS_MAX


KNOWN_LAYERS = {*_spec.LAYER_NAMES, *range(_spec.LAYER_EXTRA, _LAYER_END)}


@dataclass
class Chunk:
    """A chunk of a directory or layer record.

    Attributes:
        name: `META`, `CODB.2.0`, `TILE.0.1`.
        kind: chunk type.
        flags: flags of the record, or the flags registered for TILE.
        record: directory or layer record; both have `size` and `offset`.
        identity: codebook id, or index of the tile.
        layer: layer of the record.
        level: level of detail of the tile; 0 for chunks of the directory.
        whole: whether its bytes exist and do not overlap another chunk.
    """

    name: str
    kind: bytes
    flags: int
    record: PlacedRecord[Any]
    identity: int
    layer: int
    level: int = 0
    whole: bool = False

    @property
    def offset(self) -> int:
        """Offset in the file."""
        return int(self.record.record.offset)

    @property
    def size(self) -> int:
        """Size in bytes with the chunk header."""
        return int(self.record.record.size)

    def rank(self, *, has_levels: bool) -> tuple[int, ...]:
        """Return the rank in the order that 4.3.6 recommends.

        TREE and ancillary chunks come first, then each layer, codebooks before tiles, and the highest level first.
        """
        if self.kind == _spec.CHUNK_TILE:
            return (self.layer, 1, -self.level, self.identity)
        if self.kind == _spec.CHUNK_CODEBOOK:
            return (self.layer, 0)
        if self.kind == _spec.CHUNK_TREE:
            return (-2,)
        return (_LAYER_END,) if has_levels and self.kind in _LAST_CHUNKS else (-1,)


def registered_flags(kind: bytes) -> int:
    """Return the flags that the registry has for a known type."""
    return sum(bit for bit, name in _spec.CHUNK_FLAG_NAMES.items() if name in _spec.CHUNK_FLAGS[kind])


def check_chunk_size(log: ViolationLog, chunk: Chunk) -> Chunk:
    """Check CHK-3 as far as possible with the record alone: a chunk has a header."""
    least = _spec.CHUNK_HEADER_SIZE
    if chunk.size < least:
        log.add_field("CHK-3", chunk.record, "size", f"{chunk.size}, expected at least {least}")
    return chunk


def read_directory(view: memoryview, at: int, end: int, index: Index, log: ViolationLog) -> list[Chunk]:
    """Read the directory records within the index and check DIR-1, DIR-2, DIR-4 to DIR-6, RES-1, CHK-3 and CHK-4.

    Sets `index.end`, and clears `index.complete` if records are cut off.
    """
    start = at
    chunks = list[Chunk]()
    count = index.head.record.directory_count
    size = index.size_of("directory")
    for _ in range(min(count, max(0, (end - at) // size))):
        record = _spec.unpack_directory_record(view, at)
        name = _chunk_name(record, [chunk.name for chunk in chunks])
        placed = read_record(view, _spec.DirectoryRecord, at, f"directory[{name}]")
        log.check_reserved(placed)
        chunks.append(check_chunk_size(log, Chunk(name, record.type, record.flags, placed, record.id, record.layer)))
        _check_type(log, placed)
        at += size
    index.complete &= len(chunks) == count
    index.end = at
    _check_single(log, chunks)
    if index.complete:
        _check_codebook_chunks(log, chunks, index, start)
    return chunks


def _chunk_name(record: _spec.DirectoryRecord, known: list[str]) -> str:
    """Return the name of a chunk, `META`, `META#1` or `CODB.2.0`, with escapes for bytes that are not printable.

    `known` are the names of the preceding chunks.
    """
    kind = ascii(record.type.decode("latin-1"))[1:-1]
    if record.type == _spec.CHUNK_CODEBOOK:
        kind = f"CODB.{record.id}.{record.layer}"
    return kind if kind not in known else f"{kind}#{known.count(kind)}"


def _check_type(log: ViolationLog, placed: PlacedRecord[_spec.DirectoryRecord]) -> None:
    """Check type and flags of a directory record: DIR-1, DIR-2, DIR-6, RES-1, CHK-4."""
    record = placed.record
    kind = record.type
    if kind == _spec.CHUNK_TILE:
        log.add_field("DIR-1", placed, "type", "TILE, which only layer records list")
        return
    if not all(0x20 <= byte <= 0x7E for byte in kind):  # printable ASCII
        log.add_field("DIR-1", placed, "type", f"{kind!r}, expected bytes 0x20 to 0x7E")
    flags = record.flags & _REGISTERED_FLAGS
    unlisted = flags & ~sum(_spec.CHUNK_FLAG_NAMES)
    if unlisted:
        log.add_field("RES-1", placed, "flags", f"bits {unlisted:#06x} are reserved")
    if kind in _spec.CHUNK_NAMES:
        if flags & ~unlisted != registered_flags(kind):
            log.add_field("CHK-4", placed, "flags", f"{record.flags:#06x}, expected {registered_flags(kind):#06x}")
    elif flags & _spec.CHUNK_FLAG_CRITICAL:
        if kind[:1].islower():
            log.add_field("DIR-6", placed, "flags", f"{kind!r} is private and critical")
        log.add_field("DIR-2", placed, "type", f"{kind!r} is critical and unknown")


def _check_single(log: ViolationLog, chunks: Sequence[Chunk]) -> None:
    """Check DIR-4: there is at most one chunk of certain types, with id and layer 0."""
    seen_kinds: set[bytes] = set()
    for chunk in chunks:
        if chunk.kind not in _SINGLE_CHUNKS:
            continue
        if chunk.kind in seen_kinds:
            log.add_field("DIR-4", chunk.record, "type", f"a second {chunk.kind.decode()}")
        if chunk.identity or chunk.layer:
            where = f"id {chunk.identity} and layer {chunk.layer}"
            log.add_field("DIR-4", chunk.record, "type", f"{chunk.kind.decode()} with {where}, expected 0 and 0")
        seen_kinds.add(chunk.kind)


def _check_codebook_chunks(log: ViolationLog, chunks: Sequence[Chunk], index: Index, start: int) -> None:
    """Check DIR-5, if all codebook records are valid; `start` is the offset of the directory."""
    if len(index.codebooks) != index.head.record.codebook_count:
        return  # violations of the other records were already added
    required = {
        (identity, layer)
        for identity, book in index.codebooks.items()
        for layer in range(book.record.band_first, book.record.band_last + 1)
    }
    for chunk in chunks:
        if chunk.kind != _spec.CHUNK_CODEBOOK:
            continue
        key = (chunk.identity, chunk.layer)
        if key not in required:
            log.add_field("DIR-5", chunk.record, "type", "not required by a codebook record, or a duplicate")
        required.discard(key)
    for identity, layer in sorted(required):
        log.add("DIR-5", start, "directory", f"no CODB chunk for codebook {identity}, layer {layer}")


def check_coverage(log: ViolationLog, chunks: Sequence[Chunk], index_end: int, file_size: int, data_size: int) -> None:
    """Check COV-1, set `whole` of the chunks, and add a remark if the order differs from 4.3.6.

    Args:
        log: receives the violations.
        chunks: all chunks of the file; `whole` is set to True if a chunk can be read.
        index_end: end of the index, where the first chunk starts.
        file_size: size that the header declares.
        data_size: size of the bytes at hand, which may be truncated.
    """
    ordered = sorted(chunks, key=lambda chunk: (chunk.offset, chunk.size))
    expected = index_end
    read_end = index_end  # end of the last whole chunk
    for chunk in ordered:
        if chunk.offset != expected:
            log.add_field("COV-1", chunk.record, "offset", f"{chunk.offset}, expected {expected}")
        end = chunk.offset + chunk.size
        # Overlapping chunks are not read, because a file could list the same bytes a million times.
        chunk.whole = read_end <= chunk.offset <= end - _spec.CHUNK_HEADER_SIZE and end <= min(data_size, file_size)
        if not chunk.whole:
            log.skip(chunk.name, "its bytes are missing, or belong to another chunk")
        expected = end
        read_end = max(read_end, end) if chunk.whole else read_end
    if expected != file_size:
        log.add(
            "COV-1",
            _spec.HEADER_OFFSETS["file_size"],
            "header.file_size",
            f"the last chunk ends at {expected}, the file at {file_size}",
        )
    has_levels = any(chunk.level for chunk in chunks)
    ranks = [chunk.rank(has_levels=has_levels) for chunk in ordered if chunk.layer < _LAYER_END]
    if ranks != sorted(ranks):
        log.remarks.append("the chunks are not in the recommended order (4.3.6)")


def check_frame(view: memoryview, chunk: Chunk, clause: str, log: ViolationLog) -> Payload:
    """Check header and CRC of a whole chunk (CHK-1, CHK-3) and return its payload.

    Args:
        view: the file.
        chunk: the chunk.
        clause: the clause that requires the payload to end with its last structure.
        log: receives the violations.
    """
    at, end = chunk.offset, chunk.offset + chunk.size
    stored, computed = chunk.record.record.crc, zlib.crc32(view[at:end])
    if stored != computed:
        log.add("CHK-1", at, chunk.name, f"{chunk.record.path('crc')} is {stored:#010x}, computed {computed:#010x}")
    header = read_record(view, _spec.ChunkHeader, at, f"{chunk.name}/header")
    log.check_reserved(header)
    payload_size = chunk.size - _spec.CHUNK_HEADER_SIZE
    for key, expected in (("type", chunk.kind), ("flags", chunk.flags), ("payload_size", payload_size)):
        value = getattr(header.record, key)
        if value != expected:
            log.add_field("CHK-3", header, key, f"{value!r}, expected {expected!r} by its record")
    # The end of the payload follows from the size in the record, which passed COV-1.
    return Payload(view, at + _spec.CHUNK_HEADER_SIZE, end, chunk.name, clause, log)


_SH_LAYERS = range(1, _spec.SH_DEGREE_MAX + 1)


@dataclass
class Tile:
    """A tile record with its layers and codebook ids.

    Attributes:
        index: index of the tile, from 0.
        record: the tile record.
        chunks: TILE chunks in the order of the layer records.
        codebook_ids: ids of the codebooks that the tile lists.
    """

    index: int
    record: PlacedRecord[_spec.TileRecord]
    chunks: list[Chunk] = field(default_factory=list)
    codebook_ids: set[int] = field(default_factory=set)

    @property
    def count(self) -> int:
        """Number of splats."""
        return self.record.record.splat_count

    @property
    def level(self) -> int:
        """Level of detail."""
        return self.record.record.level


def read_tiles(view: memoryview, at: int, end: int, index: Index, log: ViolationLog) -> list[Tile]:
    """Read the tile records; check that they fill the index (IDX-2), and that tiles of level 0 have N splats (IDX-7).

    Args:
        view: the file.
        at: offset of the first record.
        end: offset of the index's CRC.
        index: the preceding records.
        log: receives the violations.
    """
    tiles: list[Tile] = []
    head = index.head.record
    # `read_records` already reported a count that does not fit into the index.
    reported = index.size_of("tile") * head.tile_count > end - at
    while len(tiles) < head.tile_count:
        size = _tile_size(view, at, end, index)
        if size > end - at:
            if not reported:
                log.add("IDX-2", at, f"tile[{len(tiles)}]", "the index ends within the tile")
            log.skip(f"tile[{len(tiles)}] and later tiles", "the index ends before them")
            return tiles
        tiles.append(_read_tile(view, at, len(tiles), index, log))
        _check_level(log, tiles[-1], tiles[-2].level if len(tiles) > 1 else 0)
        at += size
    if at != end:
        log.add("IDX-2", at, "index.rest", f"{end - at} bytes follow the last tile")
    total = sum(tile.count for tile in tiles if tile.level == 0)
    if total != head.splat_count:
        message = f"{head.splat_count}, expected {total}, the sum of the tiles of level 0"
        log.add_field("IDX-7", index.head, "splat_count", message)
    return tiles


def _tile_size(view: memoryview, at: int, end: int, index: Index) -> int:
    """Return the size of the tile record at `at` with its layer records and codebook ids, as far as it is known."""
    size = index.size_of("tile")
    if end - at < size:
        return size
    record = _spec.unpack_tile_record(view, at)
    return size + record.layer_count * index.size_of("layer") + _CODEBOOK_ID_SIZE * record.table_count


def _read_tile(view: memoryview, at: int, number: int, index: Index, log: ViolationLog) -> Tile:
    """Read a tile record with its layer records and codebook ids.

    Checks RES-1, RES-2, and TIL-1 to TIL-9 but TIL-4, which is a permission.
    """
    placed = read_record(view, _spec.TileRecord, at, f"tile[{number}]")
    log.check_reserved(placed)
    tile = Tile(number, placed)
    if not 1 <= tile.count <= _spec.TILE_SPLATS_MAX:
        log.add_field("TIL-1", placed, "splat_count", f"{tile.count}, expected 1 to {_spec.TILE_SPLATS_MAX}")
    _check_tile_box(log, tile, index)
    at += index.size_of("tile")
    _read_layers(view, at, tile, index, log)
    _read_codebook_ids(view, at + placed.record.layer_count * index.size_of("layer"), tile, index, log)
    return tile


def _check_level(log: ViolationLog, tile: Tile, lowest: int) -> None:
    """Check TIL-12: the tile's level is at least `lowest`, the level of the preceding tile, or 0 for the first tile."""
    if tile.level < lowest:
        log.add_field("TIL-12", tile.record, "level", f"{tile.level} after {lowest}, expected ascending levels")


def _check_tile_box(log: ViolationLog, tile: Tile, index: Index) -> None:
    """Check TIL-7 and TIL-8, TIL-9 if the step is valid, and MEA-1 if all of them hold."""
    record = tile.record.record
    violation_count = len(log.violations)
    for axis, (corner, extent) in enumerate(zip(record.corner, record.extent, strict=True)):
        if max(abs(corner), abs(corner + extent)) > _spec.INTEGER_MAX:
            message = f"axis {axis} is {corner} to {corner + extent}, expected at most {_spec.INTEGER_MAX} in magnitude"
            log.add_field("TIL-7", tile.record, "corner", message, within=8 * axis)
        if extent >= 1 << _spec.AXIS_BITS_MAX:
            message = f"axis {axis} is {extent}, expected less than 2^{_spec.AXIS_BITS_MAX}"
            log.add_field("TIL-8", tile.record, "extent", message, within=4 * axis)
    step = index.steps.get(_spec.ATTRIBUTE_MEANS)
    if step is None:
        return
    scale = scaled_step(step, record.exponent)
    if scale is None:
        message = f"{step} x 2^{record.exponent} is not finite and at least 2^-1022"
        log.add_field("TIL-9", tile.record, "exponent", message)
    elif len(log.violations) == violation_count:
        for axis, (corner, extent) in enumerate(zip(record.corner, record.extent, strict=True)):
            if not (is_finite(corner, scale) and is_finite(corner + extent, scale)):
                message = f"axis {axis} is ({corner} to {corner + extent}) x {scale}, expected numbers of binary32"
                log.add_field("MEA-1", tile.record, "corner", message, within=8 * axis)


def _read_layers(view: memoryview, at: int, tile: Tile, index: Index, log: ViolationLog) -> None:
    """Read the layer records of a tile from `at` on; check RES-1, RES-2, TIL-2, TIL-3, TIL-5 and CHK-3.

    Adds a chunk for each record to `tile.chunks`.
    """
    start = at
    last = -1  # highest layer so far
    flags = registered_flags(_spec.CHUNK_TILE)
    for i in range(tile.record.record.layer_count):
        layer = view[at]
        name = f"{tile.record.name}.layer[{layer}]"
        placed = read_record(view, _spec.LayerRecord, at, name)
        log.check_reserved(placed)
        if i == 0 and layer != _spec.LAYER_GEOMETRY:
            log.add_field("TIL-2", placed, "layer", f"the first is {layer}, expected {_spec.LAYER_GEOMETRY}")
        elif layer <= last:
            log.add_field("TIL-2", placed, "layer", f"{layer} after {last}, expected ascending layers")
        if layer < _spec.ANCILLARY_ID_MIN and layer not in KNOWN_LAYERS:
            log.add_field("RES-2", placed, "layer", f"{layer} is not a layer of this version")
        if index.degree is not None and layer in _SH_LAYERS and layer > index.degree:
            log.add_field("TIL-3", placed, "layer", f"band {layer}, expected at most sh_degree, {index.degree}")
        chunk = Chunk(f"TILE.{tile.index}.{layer}", _spec.CHUNK_TILE, flags, placed, tile.index, layer, tile.level)
        tile.chunks.append(check_chunk_size(log, chunk))
        last = max(last, layer)
        at += index.size_of("layer")
    if not tile.chunks:
        log.add("TIL-2", start, f"{tile.record.name}.layer", "no layer, expected layer 0")
        return  # TIL-5 follows from this
    extras = index.head.record.extra_count
    found = {chunk.layer for chunk in tile.chunks if _spec.LAYER_EXTRA <= chunk.layer < _LAYER_END}
    if found != set(range(_spec.LAYER_EXTRA, _spec.LAYER_EXTRA + (0 if tile.level else extras))):
        message = f"a tile of level {tile.level} with the layers {sorted(found)}; the scene has {extras} extra columns"
        log.add("TIL-5", start, f"{tile.record.name}.layer", message)


def _read_codebook_ids(view: memoryview, at: int, tile: Tile, index: Index, log: ViolationLog) -> None:
    """Read the codebook ids of a tile from `at` on, check TIL-6, and add all ids to `tile.codebook_ids`."""
    last = -1
    for k in range(tile.record.record.table_count):
        identity = int.from_bytes(view[at : at + _CODEBOOK_ID_SIZE], "little")
        name = f"{tile.record.name}.table[{k}]"
        if identity <= last:
            log.add("TIL-6", at, name, f"{identity} after {last}, expected ascending ids")
        elif identity not in index.codebook_ids:
            log.add("TIL-6", at, name, f"there is no codebook {identity}")
        tile.codebook_ids.add(identity)
        last = max(last, identity)
        at += _CODEBOOK_ID_SIZE

# SPDX-License-Identifier: CC0-1.0
"""Results of a validation, readers of structures with their offsets, the log of violations, and codes of clauses."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, Final, Generic, TypeVar

from csplat import _spec

T = TypeVar("T")

#: Largest number of violations; garbage with valid sizes can violate a clause every few bytes.
VIOLATIONS_MAX = 10_000


@dataclass(frozen=True)
class Violation:
    """A violation of a clause of the spec.

    Attributes:
        clause: id of the clause.
        code: error code with which a decoder refuses the file; empty for SER-5, which decoders do not check.
        offset: offset in the file of the offending field or, if there is none, of its structure.
        field: name of structure and field, `tile[0].layer[1].offset`, `TILE.0.1/sh1.stream.count`.
        message: one line: the value found and the value expected.
    """

    clause: str
    code: str
    offset: int
    field: str
    message: str

    def __str__(self) -> str:
        code = f"{self.code} " if self.code else ""
        return f"{self.clause} {code}at byte {self.offset}, {self.field}: {self.message}"


@dataclass(frozen=True)
class Unread:
    """A part of the file that could not be checked because of an earlier violation.

    Attributes:
        field: name of the part.
        reason: the reason in a few words.
    """

    field: str
    reason: str

    def __str__(self) -> str:
        return f"not checked: {self.field} ({self.reason})"


@dataclass(frozen=True)
class Validation:
    """The result of validating a file.

    Attributes:
        violations: violations by offset. If there are none, the file conforms (CNF-1).
        remarks: a line for each recommendation of the spec that the file does not follow.
        unread: parts that were not checked; none without violations.
        splat_count: N in the index, 0 if the index could not be read.
        tile_count: number of tile records that were read.
        checks: names of the checks that were made.
    """

    violations: tuple[Violation, ...]
    remarks: tuple[str, ...] = ()
    unread: tuple[Unread, ...] = ()
    splat_count: int = 0
    tile_count: int = 0
    checks: tuple[str, ...] = ()

    @property
    def conforms(self) -> bool:
        """True if no clause is violated."""
        return not self.violations


@dataclass(frozen=True)
class PlacedRecord(Generic[T]):
    """A structure of the registry with its offset in the file.

    Attributes:
        record: the fields.
        offset: offset in the file.
        name: prefix of the names of its fields, `tile[0]`.
        field_offsets: offset of each field within the structure.
    """

    record: T
    offset: int
    name: str
    field_offsets: dict[str, int]

    def at(self, key: str, within: int = 0) -> int:
        """Return the offset in the file of a field, or of a byte within it."""
        return self.offset + self.field_offsets[key] + within

    def path(self, key: str) -> str:
        """Return the full name of a field."""
        return f"{self.name}.{key}"


@dataclass(frozen=True)
class _Layout:
    """The layout of a structure of the registry.

    Attributes:
        unpack: reads the structure at an offset.
        size: size in bytes.
        offsets: offset of each field within the structure.
    """

    unpack: Callable[[memoryview, int], Any]
    size: int
    offsets: dict[str, int]


_LAYOUTS: Final[dict[type[Any], _Layout]] = {
    _spec.Header: _Layout(_spec.unpack_header, _spec.HEADER_SIZE, _spec.HEADER_OFFSETS),
    _spec.IndexHead: _Layout(_spec.unpack_index_head, _spec.INDEX_HEAD_SIZE, _spec.INDEX_HEAD_OFFSETS),
    _spec.AttributeRecord: _Layout(
        _spec.unpack_attribute_record, _spec.ATTRIBUTE_RECORD_SIZE, _spec.ATTRIBUTE_RECORD_OFFSETS
    ),
    _spec.CodebookRecord: _Layout(
        _spec.unpack_codebook_record, _spec.CODEBOOK_RECORD_SIZE, _spec.CODEBOOK_RECORD_OFFSETS
    ),
    _spec.ExtraRecord: _Layout(_spec.unpack_extra_record, _spec.EXTRA_RECORD_SIZE, _spec.EXTRA_RECORD_OFFSETS),
    _spec.DirectoryRecord: _Layout(
        _spec.unpack_directory_record, _spec.DIRECTORY_RECORD_SIZE, _spec.DIRECTORY_RECORD_OFFSETS
    ),
    _spec.TileRecord: _Layout(_spec.unpack_tile_record, _spec.TILE_RECORD_SIZE, _spec.TILE_RECORD_OFFSETS),
    _spec.LayerRecord: _Layout(_spec.unpack_layer_record, _spec.LAYER_RECORD_SIZE, _spec.LAYER_RECORD_OFFSETS),
    _spec.NodeRecord: _Layout(_spec.unpack_node_record, _spec.NODE_RECORD_SIZE, _spec.NODE_RECORD_OFFSETS),
    _spec.ChunkHeader: _Layout(_spec.unpack_chunk_header, _spec.CHUNK_HEADER_SIZE, _spec.CHUNK_HEADER_OFFSETS),
    _spec.TileHead: _Layout(_spec.unpack_tile_head, _spec.TILE_HEAD_SIZE, _spec.TILE_HEAD_OFFSETS),
    _spec.CodebookHead: _Layout(_spec.unpack_codebook_head, _spec.CODEBOOK_HEAD_SIZE, _spec.CODEBOOK_HEAD_OFFSETS),
    _spec.BlockHead: _Layout(_spec.unpack_block_head, _spec.BLOCK_HEAD_SIZE, _spec.BLOCK_HEAD_OFFSETS),
    _spec.LatticeParams: _Layout(_spec.unpack_lattice_params, _spec.LATTICE_PARAMS_SIZE, _spec.LATTICE_PARAMS_OFFSETS),
    _spec.MortonParams: _Layout(_spec.unpack_morton_params, _spec.MORTON_PARAMS_SIZE, _spec.MORTON_PARAMS_OFFSETS),
    _spec.CodebookParams: _Layout(
        _spec.unpack_codebook_params, _spec.CODEBOOK_PARAMS_SIZE, _spec.CODEBOOK_PARAMS_OFFSETS
    ),
    _spec.SparseParams: _Layout(_spec.unpack_sparse_params, _spec.SPARSE_PARAMS_SIZE, _spec.SPARSE_PARAMS_OFFSETS),
    _spec.StreamHead: _Layout(_spec.unpack_stream_head, _spec.STREAM_HEAD_SIZE, _spec.STREAM_HEAD_OFFSETS),
    _spec.DeclaredErrorsHead: _Layout(
        _spec.unpack_declared_errors_head, _spec.DECLARED_ERRORS_HEAD_SIZE, _spec.DECLARED_ERRORS_HEAD_OFFSETS
    ),
    _spec.DeclaredErrorRecord: _Layout(
        _spec.unpack_declared_error_record, _spec.DECLARED_ERROR_RECORD_SIZE, _spec.DECLARED_ERROR_RECORD_OFFSETS
    ),
}


def read_record(view: memoryview, kind: type[T], at: int, name: str) -> PlacedRecord[T]:
    """Read a structure that is known to fit into the data."""
    layout = _LAYOUTS[kind]
    return PlacedRecord(layout.unpack(view, at), at, name, layout.offsets)


class TooManyViolationsError(Exception):
    """Raised at VIOLATIONS_MAX, to end the validation."""


@dataclass
class ViolationLog:
    """The violations, remarks and unread parts that were added so far, in any order."""

    violations: list[Violation] = field(default_factory=list)
    remarks: list[str] = field(default_factory=list)
    unread: list[Unread] = field(default_factory=list)
    checks: list[str] = field(default_factory=list)

    def add(self, clause: str, offset: int, name: str, message: str, code: str = "") -> None:
        """Add a violation.

        Args:
            clause: id of the clause.
            offset: offset in the file.
            name: name of the field.
            message: the value found and the value expected.
            code: error code, if it differs from the clause's usual code.

        Raises:
            TooManyViolationsError: the list is full.
        """
        self.violations.append(Violation(clause, code or CODES[clause], offset, name, message))
        if len(self.violations) >= VIOLATIONS_MAX:
            self.remarks.append(f"at least {VIOLATIONS_MAX} violations: the rest of the file was not checked")
            raise TooManyViolationsError

    def add_field(
        self, clause: str, placed: PlacedRecord[Any], key: str, message: str, code: str = "", within: int = 0
    ) -> None:
        """Add a violation in a field of a structure."""
        self.add(clause, placed.at(key, within), placed.path(key), message, code)

    def check_reserved(self, placed: PlacedRecord[Any]) -> None:
        """Check RES-1: "A reserved field or bit MUST be 0"."""
        for key in placed.field_offsets:
            value = getattr(placed.record, key)
            if key.startswith("reserved_") and value != 0:
                self.add_field("RES-1", placed, key, f"{value} in a reserved field, expected 0")

    def skip(self, name: str, reason: str) -> None:
        """Add a part that is not checked."""
        self.unread.append(Unread(name, reason))


class UnreadableError(Exception):
    """Raised if a wrong length or type makes the position of the rest unknown; the violation was already added."""


class Payload:
    """A reader of the payload of a chunk, from its beginning to its end.

    Args:
        view: the whole file.
        at: offset of the payload.
        end: offset of its end.
        name: name of the chunk, `TILE.0.0`.
        clause: the clause that requires the payload to end with its last structure.
        log: receives the violations.
    """

    def __init__(self, view: memoryview, at: int, end: int, name: str, clause: str, log: ViolationLog) -> None:
        self.view = view
        self.at = at
        self.end = end
        self.name = name
        self.clause = clause
        self.log = log

    @property
    def left(self) -> int:
        """Number of remaining bytes."""
        return self.end - self.at

    def take(self, size: int, what: str) -> int:
        """Skip `size` bytes and return their offset.

        Raises:
            UnreadableError: fewer bytes are left.
        """
        at = self.at
        if size > self.left:
            self.log.add(
                self.clause, at, f"{self.name}/{what}", f"the payload ends here, {self.left} of {size} bytes are left"
            )
            raise UnreadableError
        self.at += size
        return at

    def structure(self, kind: type[T], what: str) -> PlacedRecord[T]:
        """Read the next structure, named after the chunk and `what`, and check its reserved fields."""
        at = self.take(_LAYOUTS[kind].size, what)
        placed = read_record(self.view, kind, at, f"{self.name}/{what}")
        self.log.check_reserved(placed)
        return placed

    def finish(self) -> None:
        """Check that nothing follows the last structure."""
        if self.left:
            self.log.add(self.clause, self.at, f"{self.name}/tail", f"{self.left} bytes follow the last structure")


#: The error code of each requirement on a file, the usual code if the clause has two. Clauses about decoders, partial
#: readers and editors are omitted. A test compares this table with the text of the spec.
CODES: Final[dict[str, str]] = {
    "RES-1": _spec.ERROR_RESERVED,
    "RES-2": _spec.ERROR_UNSUPPORTED,
    "HDR-1": _spec.ERROR_MAGIC,
    "HDR-2": _spec.ERROR_VERSION,
    "HDR-3": _spec.ERROR_CRC,
    "HDR-4": _spec.ERROR_UNSUPPORTED,
    "HDR-5": _spec.ERROR_TRUNCATED,
    "HDR-6": _spec.ERROR_TRAILING,
    "HDR-7": _spec.ERROR_VALUE,
    "HDR-11": _spec.ERROR_TRUNCATED,
    "IDX-1": _spec.ERROR_CRC,
    "IDX-2": _spec.ERROR_INDEX,
    "IDX-3": _spec.ERROR_UNSUPPORTED,
    "IDX-4": _spec.ERROR_VALUE,
    "IDX-5": _spec.ERROR_VALUE,
    "IDX-6": _spec.ERROR_VALUE,
    "IDX-7": _spec.ERROR_INDEX,
    "IDX-8": _spec.ERROR_VALUE,
    "ATT-1": _spec.ERROR_INDEX,
    "ATT-2": _spec.ERROR_VALUE,
    "ATT-3": _spec.ERROR_VALUE,
    "ATT-4": _spec.ERROR_VALUE,
    "ATT-5": _spec.ERROR_RESERVED,
    "ATT-6": _spec.ERROR_VALUE,
    "ATT-10": _spec.ERROR_VALUE,
    "ATT-7": _spec.ERROR_RESERVED,
    "ATT-8": _spec.ERROR_VALUE,
    "ATT-9": _spec.ERROR_VALUE,
    "CBR-1": _spec.ERROR_INDEX,
    "CBR-2": _spec.ERROR_VALUE,
    "CBR-4": _spec.ERROR_VALUE,
    "EXR-1": _spec.ERROR_VALUE,
    "EXR-2": _spec.ERROR_VALUE,
    "EXR-3": _spec.ERROR_RESERVED,
    "EXR-4": _spec.ERROR_VALUE,
    "EXR-5": _spec.ERROR_VALUE,
    "EXR-6": _spec.ERROR_UNSUPPORTED,
    "EXR-7": _spec.ERROR_VALUE,
    "DIR-1": _spec.ERROR_VALUE,
    "DIR-2": _spec.ERROR_UNSUPPORTED,
    "DIR-6": _spec.ERROR_VALUE,
    "DIR-4": _spec.ERROR_INDEX,
    "DIR-5": _spec.ERROR_INDEX,
    "TIL-1": _spec.ERROR_VALUE,
    "TIL-2": _spec.ERROR_INDEX,
    "TIL-3": _spec.ERROR_INDEX,
    "TIL-5": _spec.ERROR_INDEX,
    "TIL-6": _spec.ERROR_INDEX,
    "TIL-7": _spec.ERROR_VALUE,
    "TIL-8": _spec.ERROR_VALUE,
    "TIL-9": _spec.ERROR_VALUE,
    "TIL-10": _spec.ERROR_BOX,
    "TIL-11": _spec.ERROR_BOX,
    "TIL-12": _spec.ERROR_INDEX,
    "COV-1": _spec.ERROR_INDEX,
    "CHK-1": _spec.ERROR_CRC,
    "CHK-3": _spec.ERROR_INDEX,
    "CHK-4": _spec.ERROR_VALUE,
    "TLE-1": _spec.ERROR_INDEX,
    "TLE-2": _spec.ERROR_STREAM,
    "TLE-3": _spec.ERROR_STREAM,
    "CDB-1": _spec.ERROR_INDEX,
    "CDB-2": _spec.ERROR_STREAM,
    "JSN-1": _spec.ERROR_JSON,
    "JSN-2": _spec.ERROR_STREAM,
    "SER-1": _spec.ERROR_VALUE,
    "SER-2": _spec.ERROR_VALUE,
    "SER-3": _spec.ERROR_STREAM,
    "SER-4": _spec.ERROR_VALUE,
    "SER-5": "",  # decoders do not check it
    "TRE-1": _spec.ERROR_INDEX,
    "TRE-2": _spec.ERROR_STREAM,
    "TRE-3": _spec.ERROR_INDEX,
    "TRE-4": _spec.ERROR_INDEX,
    "TRE-5": _spec.ERROR_INDEX,
    "TRE-6": _spec.ERROR_INDEX,
    "TRE-7": _spec.ERROR_INDEX,
    "TRE-8": _spec.ERROR_VALUE,
    "STR-1": _spec.ERROR_STREAM,
    "STR-2": _spec.ERROR_STREAM,
    "STR-3": _spec.ERROR_STREAM,
    "STR-4": _spec.ERROR_STREAM,
    "STR-5": _spec.ERROR_STREAM,
    "STR-6": _spec.ERROR_STREAM,
    "STR-8": _spec.ERROR_LIMIT,
    "COD-1": _spec.ERROR_CODER,
    "COD-2": _spec.ERROR_CODER,
    "COD-5": _spec.ERROR_CODER,
    "COD-6": _spec.ERROR_CODER,
    "COD-7": _spec.ERROR_CODER,
    "COD-8": _spec.ERROR_CODER,
    "TRF-1": _spec.ERROR_CODER,
    "BLK-1": _spec.ERROR_VALUE,
    "LEV-1": _spec.ERROR_RANGE,
    "MOR-1": _spec.ERROR_VALUE,
    "MOR-2": _spec.ERROR_RANGE,
    "AXI-1": _spec.ERROR_RANGE,
    "LAT-1": _spec.ERROR_VALUE,
    "LAT-2": _spec.ERROR_VALUE,
    "LAT-3": _spec.ERROR_VALUE,
    "LAT-4": _spec.ERROR_RANGE,
    "LAT-5": _spec.ERROR_RANGE,
    "CBK-1": _spec.ERROR_CODEBOOK,
    "CBK-2": _spec.ERROR_CODEBOOK,
    "CBK-3": _spec.ERROR_CODEBOOK,
    "CBK-4": _spec.ERROR_CODEBOOK,
    "CBK-5": _spec.ERROR_STREAM,
    "SPA-1": _spec.ERROR_VALUE,
    "SPA-2": _spec.ERROR_RANGE,
    "SPA-3": _spec.ERROR_RANGE,
    "RAW-2": _spec.ERROR_STREAM,
    "MEA-1": _spec.ERROR_RANGE,
    "QUA-1": _spec.ERROR_RANGE,
    "QUA-2": _spec.ERROR_RANGE,
    "LIM-1": _spec.ERROR_LIMIT,
    "RSL-1": _spec.ERROR_VALUE,
    "RSL-2": _spec.ERROR_VALUE,
}

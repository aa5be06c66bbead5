"""Mistakes of the Python decoder: each replaces one of its functions."""

from __future__ import annotations

import math
import zlib
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import replace
from types import SimpleNamespace
from typing import Any, Final
from unittest import mock

import numpy as np

from csplat import _spec
from csplat.decoder import blocks, container, entropy, reconstruct
from csplat.errors import FormatError, UnsupportedError
from csplat_conformance.validator.inflate import CodedError, Inflater
from csplat_selftest.mistakes import Mistake, Wrong, method, nothing, replaced

# What is checked -----------------------------------------------------------------------------------


def _cut_to_size(right: Wrong, data: Any) -> memoryview:
    """Read as many bytes as the header announces, and no more."""
    view: memoryview = right(data)
    if len(view) < _spec.HEADER_SIZE:
        return view
    return view[: max(_spec.HEADER_SIZE, _spec.unpack_header(view).file_size)]


def crc_but(unchecked: str) -> Wrong:
    """Return a mistake that checks all CRCs but those of one clause."""

    def wrong(right: Wrong, covered: memoryview, stored: int, at: int, clause: str) -> None:
        if clause != unchecked:
            right(covered, stored, at, clause)

    return wrong


def _no_side_chunks(_right: Wrong, _job: Any) -> tuple[None, None]:
    return None, None


def _tail_of_inflate(_right: Wrong, coded: memoryview, size: int, at: int) -> bytes:  # noqa: ARG001 - as the right one
    return zlib.decompressobj(-zlib.MAX_WBITS).decompress(coded, size).ljust(size, b"\0")


class _CarelessInflater(Inflater):
    """Inflates without looking at one clause."""

    def __init__(self, coded: bytes, ignored: str) -> None:
        super().__init__(coded)
        self._ignored = ignored

    def refuse(self, clause: str, message: str) -> None:
        if clause != self._ignored:
            super().refuse(clause, message)


def _inflate_without(clause: str) -> Wrong:
    def inflate(_right: Wrong, coded: memoryview, size: int, at: int) -> bytes:
        inflater = _CarelessInflater(bytes(coded), clause)
        try:
            packed = inflater.inflate(size)
        except CodedError as error:
            raise FormatError(_spec.ERROR_CODER, at, error.clause, str(error)) from None
        if len(packed) != size or inflater.used != len(coded):
            raise FormatError(_spec.ERROR_CODER, at, "COD-2", "another size")
        return packed

    return inflate


def _skip_critical(right: Wrong, record: _spec.DirectoryRecord, at: int) -> None:
    try:
        right(record, at)
    except UnsupportedError:
        return


def _constants(**values: int) -> Callable[[ExitStack], None]:
    def apply(stack: ExitStack) -> None:
        for name, value in values.items():
            stack.enter_context(mock.patch.object(_spec, name, value))

    return apply


def _without_tails(stack: ExitStack) -> None:
    """Use the structures' own sizes in place of the sizes in the file."""
    right = _spec.unpack_index_head

    def unpack(data: Any, at: int) -> _spec.IndexHead:
        return right(data, at)._replace(
            attribute_size=_spec.ATTRIBUTE_RECORD_SIZE,
            directory_size=_spec.DIRECTORY_RECORD_SIZE,
            tile_size=_spec.TILE_RECORD_SIZE,
            layer_size=_spec.LAYER_RECORD_SIZE,
        )

    stack.enter_context(mock.patch.object(_spec, "unpack_index_head", unpack))


def _known_extras(right: Wrong, *args: Any) -> Any:
    return tuple(column for column in right(*args) if column.dtype)


def _no_limits(stack: ExitStack) -> None:
    for name in ("CHROMA_SHIFT_MAX", "QUAT_LEVELS_MAX", "OPACITY_LEVELS_MAX", "COLUMN_MAX", "JSON_DEPTH_MAX"):
        stack.enter_context(mock.patch.object(_spec, name, 2**60))


# Streams -------------------------------------------------------------------------------------------


def _zigzag(right: Wrong, elements: Any, width: int) -> Any:
    result = right(elements, width)
    return entropy._wrap(np.where(elements & 1, result + elements.dtype.type(1), result), width)  # noqa: SLF001 - to break it


def _no_wrap(_right: Wrong, elements: Any, _width: int) -> Any:
    return elements


def _as_unsigned(_right: Wrong, elements: Any, _width: int) -> Any:
    return elements


# Codebooks -----------------------------------------------------------------------------------------


def _no_escapes(right: Wrong, block: blocks.CodebookBlock, *args: Any) -> Any:
    object.__setattr__(block, "escapes", None)
    return right(block, *args)


def _no_summand(right: Wrong, block: blocks.CodebookBlock, *args: Any) -> Any:
    object.__setattr__(block, "summand", None)
    return right(block, *args)


def _mask_from_the_top(right: Wrong, cursor: Any, context: Any, attribute: int) -> Any:
    block = right(cursor, context, attribute)
    return replace(block, places=np.minimum(block.places ^ 7, context.tile.splat_count - 1))


# Numbers -------------------------------------------------------------------------------------------


def _binary32_product(_right: Wrong, integers: Any, step: float, out: Any) -> None:
    out[...] = integers.astype(np.float32) * np.float32(step)


def _loose_quats(right: Wrong, block: Any, record: _spec.AttributeRecord, out: Any) -> None:
    """Compute q / (M √2) in another order of operations."""
    right(block, record, out)
    for start, stop, q, r in reconstruct.quat_rows(block, record, len(out)):
        out[start:stop, 0] = np.sqrt(r / 2.0) / record.levels
        out[start:stop, 1:] = (q / record.levels / np.sqrt(2.0)).T


def _minus_w(right: Wrong, block: Any, record: _spec.AttributeRecord, out: Any) -> None:
    right(block, record, out)
    out[:, 0] *= -1.0


def _w_last(right: Wrong, block: Any, record: _spec.AttributeRecord, out: Any) -> None:
    right(block, record, out)
    out[:] = np.roll(out, -1, axis=1)


def _linear(right: Wrong, record: _spec.AttributeRecord) -> Any:
    return right(record._replace(mapping=_spec.MAPPING_LINEAR))


def _bands_swapped(right: Wrong, parts: Any, records: Any, out: Any) -> None:
    right(parts, records, out)
    if len(records) > 1:
        out[:, :8] = np.concatenate([out[:, 3:8], out[:, :3]], axis=1)


def _channels_innermost(_right: Wrong, block: Any, record: _spec.AttributeRecord, out: Any, **_: Any) -> None:
    step = math.ldexp(record.step, block.exponent)
    for start, stop, parts in reconstruct.lattice_rows(block, record, len(out)):
        columns = np.concatenate(parts)
        for channel in range(3):
            for coefficient, row in enumerate(columns[channel::3]):
                reconstruct._scale(row, step, out[start:stop, coefficient, channel])  # noqa: SLF001 - as the right one


def _without_corner(right: Wrong, block: Any, record: _spec.AttributeRecord, count: int, **options: Any) -> Any:
    for start, stop, parts in right(block, record, count, **options):
        if record.attribute == _spec.ATTRIBUTE_MEANS:
            parts = tuple(part - offset for part, offset in zip(parts, block.offsets, strict=True))  # noqa: PLW2901 - the mistake
        yield start, stop, parts


def _added_as_floats(right: Wrong, block: Any, record: _spec.AttributeRecord, out: Any) -> int:
    """Add the tile's corner after rounding both parts to binary32."""
    largest: int = right(block, record, out)
    if record.attribute == _spec.ATTRIBUTE_MEANS:
        step = math.ldexp(record.step, block.exponent)
        for axis, offset in enumerate(block.offsets):
            out[:, axis] = np.float32(offset * step) + (block.elements[axis] * step).astype(np.float32)
    return largest


def _no_chroma_shift(right: Wrong, y: Any, co: Any, cg: Any, _chroma_shift: int) -> Any:
    return right(y, co, cg, 0)


def _lift_towards_zero(_right: Wrong, y: Any, co: Any, cg: Any, chroma_shift: int) -> Any:
    co, cg = co << chroma_shift, cg << chroma_shift
    t = y - np.trunc(cg / 2).astype(cg.dtype)
    green = cg + t
    blue = t - np.trunc(co / 2).astype(co.dtype)
    return blue + co, green, blue


def _no_exponents(stack: ExitStack) -> None:
    flat = SimpleNamespace(ldexp=lambda step, _exponent: step, inf=float("inf"))
    stack.enter_context(mock.patch.object(reconstruct, "math", flat))


def _sorted_codes(right: Wrong, codes: Any) -> Any:
    return right(np.sort(codes))


MISTAKES: Final = (
    Mistake("CRC ignored", "no CRC-32 is compared", "CHK-1", replaced("_check_crc", nothing)),
    Mistake("CRC of the index", "the chunks have theirs", "IDX-1", replaced("_check_crc", crc_but("IDX-1"))),
    Mistake("CRCs of chunks", "the index has its own", "CHK-1", replaced("_check_crc", crc_but("CHK-1"))),
    Mistake("chunks unused", "what is not used is not read", "CHK-2", replaced("read_side_chunks", _no_side_chunks)),
    Mistake("trailing bytes", "bytes behind the file are accepted", "HDR-6", replaced("view_of", _cut_to_size)),
    Mistake("tails of payloads", "a payload may go on", "TLE-3", method(container.Cursor, "finish", nothing)),
    Mistake("lenient inflate", "as most libraries do by default", "COD-2", replaced("_inflate", _tail_of_inflate)),
    Mistake(
        "DEFLATE, counts", "any number of 5 bits is a count", "COD-5", replaced("_inflate", _inflate_without("COD-5"))
    ),
    Mistake("DEFLATE, codes", "complete or not", "COD-6", replaced("_inflate", _inflate_without("COD-6"))),
    Mistake("DEFLATE, lengths", "repetitions as they come", "COD-7", replaced("_inflate", _inflate_without("COD-7"))),
    Mistake("DEFLATE, symbols", "each means something", "COD-8", replaced("_inflate", _inflate_without("COD-8"))),
    Mistake("reserved bits", "reserved fields are not looked at", "RES-1", replaced("check_reserved", nothing)),
    Mistake(
        "critical chunks", "whatever is unknown is skipped", "DIR-2", replaced("_check_chunk_type", _skip_critical)
    ),
    Mistake("tails of records", "a record is as long as its fields", "IDX-9", _without_tails),
    Mistake(
        "flags",
        "what is not listed is refused",
        "ANC-1",
        _constants(ANCILLARY_SCENE_FLAGS=0, ANCILLARY_CHUNK_FLAGS=0),
    ),
    Mistake("layers", "what is not known is refused", "ANC-2", _constants(ANCILLARY_ID_MIN=256)),
    Mistake("extra types", "an unknown one has no block", "ANC-3", replaced("read_extras", _known_extras)),
    Mistake("limits", "levels, shifts, columns, nesting without bound", "LAT-4", _no_limits),
    Mistake("box", "max_scale is believed", "TIL-11", replaced("check_max_scale", nothing)),
    Mistake("zigzag", "odd values are one too large", "STR-3", replaced("_undo_zigzag", _zigzag)),
    Mistake("modulus", "DELTA and ZIGZAG not modulo 2^(8w)", "STR-2", replaced("_wrap", _no_wrap)),
    Mistake("sign", "elements of SIGNED read as unsigned", "LAT-4", replaced("_as_signed", _as_unsigned)),
    Mistake("order", "Morton codes taken for sorted", "ORD-1", replaced("morton_axes", _sorted_codes)),
    Mistake(
        "escapes", "escaped splats take the last entry", "CBK-3", method(blocks.CodebookBlock, "rows", _no_escapes)
    ),
    Mistake("unused entries", "entries of a codebook are believed", "CBK-7", replaced("_check_entries", nothing)),
    Mistake(
        "summand", "the common summand of SHAPE is dropped", "CBK-1", method(blocks.CodebookBlock, "rows", _no_summand)
    ),
    Mistake("mask", "bits from the highest on", "SPA-2", replaced("read_sparse", _mask_from_the_top)),
    Mistake("rounding", "products in binary32", "NUM-1", replaced("_scale", _binary32_product)),
    Mistake("quats, order of operations", "q / M / √2", "NUM-1", replaced("write_quats", _loose_quats)),
    Mistake("quats, sign of w", "w is negative", "QUA-2", replaced("write_quats", _minus_w)),
    Mistake("quats, place of w", "x, y, z, w", "QUA-2", replaced("write_quats", _w_last)),
    Mistake("opacities", "the square is forgotten", "LEV-1", replaced("opacity_table", _linear)),
    Mistake("layers swapped", "band 2 before band 1", "ATT-1", replaced("write_bands", _bands_swapped)),
    Mistake("SH columns", "coefficient by coefficient", "ATT-1", replaced("write_colour", _channels_innermost)),
    Mistake("tile offset", "the tile's corner is not added", "TIL-7", replaced("lattice_rows", _without_corner)),
    Mistake(
        "tile offset as float", "corner and rest rounded apart", "TIL-7", replaced("write_lattice", _added_as_floats)
    ),
    Mistake("exponents", "2^exponent is forgotten", "LAT-1", _no_exponents),
    Mistake("chroma shift", "Co and Cg are not shifted", "ATT-8", replaced("lift", _no_chroma_shift)),
    Mistake("lifting", "halves rounded towards zero", "ATT-2", replaced("lift", _lift_towards_zero)),
)

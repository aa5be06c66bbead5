"""Decoders that are wrong on purpose, one fault each: the suite has to notice every one of them.

Usage:
    python -m csplat_selftest.decoder_faults             # the table: fault, vectors failed, clauses
    python -m csplat_selftest.decoder_faults --only python --vectors

Faults replace a function of the Python decoder (here), or a piece of the text of a function in Python or a module in
JavaScript (`decoder_faults.toml`). Some compute in single precision, badly, and are tested by the class *renderer*.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
import tomllib
import zlib
from contextlib import ExitStack
from dataclasses import replace
from functools import cache
from pathlib import Path
from types import SimpleNamespace
from typing import Any, Final
from unittest import mock

import numpy as np

from csplat import _spec
from csplat.decoder import blocks, container, entropy, reconstruct
from csplat.errors import FormatError, InputError, UnsupportedError
from csplat_conformance.single_precision import GPUS, GpuArithmetic, lattice_values, opacities, quats
from csplat_conformance.tolerance import RENDERER
from csplat_conformance.validator.inflate import CodedError, Inflater
from csplat_selftest.faults import (
    DecoderFault,
    ModuleEdit,
    Plant,
    Wrong,
    constants,
    edited,
    find,
    nothing,
    replaced,
    table,
    together,
)

_EDITS: Final = Path(__file__).with_suffix(".toml")


@cache
def all_faults() -> list[DecoderFault]:
    """Return all planted faults of our decoders."""
    result = list(_REPLACEMENTS)
    for language, rows in tomllib.loads(_EDITS.read_text(encoding="utf-8")).items():
        for row in rows:
            edits = {edit["old"]: edit["new"] for edit in row.get("edits", [row])}
            plant = edited(row["in"], edits) if language == "python" else ModuleEdit(row["in"], edits)
            result.append(DecoderFault(row["name"], row["what"], row["clause"], plant))
    return result


def main() -> int:
    """Print the table; the exit status is 1 if a fault goes unnoticed."""
    parser = argparse.ArgumentParser(
        prog="csplat_selftest.decoder_faults", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--only", choices=("python", "javascript"), help="one of the two decoders")
    parser.add_argument("--vectors", action="store_true", help="list the vectors that each fault fails")
    args = parser.parse_args()
    findings = []
    for fault in all_faults():
        if args.only in (None, fault.language.lower()):
            try:
                findings.append(find(fault))
            except InputError as error:
                sys.stderr.write(f"SKIPPED: {fault.language}, {fault.name}: {error}\n")
    sys.stdout.write(table(findings) + "\n")
    if args.vectors:
        for one in findings:
            sys.stdout.write(f"\n{one.fault.language}, {one.fault.name}: {', '.join(one.vectors)}\n")
    missed = [one.fault for one in findings if one.fault.clause not in one.clauses]
    for fault in missed:
        sys.stderr.write(f"unnoticed: {fault.language}, {fault.name} ({fault.clause})\n")
    return 1 if missed else 0


# What is checked -----------------------------------------------------------------------------------


def _cut_to_size(right: Wrong, data: Any) -> memoryview:
    """Read as many bytes as the header announces, and no more."""
    view: memoryview = right(data)
    if len(view) < _spec.HEADER_SIZE:
        return view
    return view[: max(_spec.HEADER_SIZE, _spec.unpack_header(view).file_size)]


def crc_but(unchecked: str) -> Wrong:
    """Return a fault that checks all CRCs but those of one clause."""

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
            parts = tuple(part - offset for part, offset in zip(parts, block.offsets, strict=True))  # noqa: PLW2901 - the fault
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


# Pieces of text -------------------------------------------------------------------------------------


def _library_json(_right: Wrong, text: bytes, _kind: type, at: int) -> Any:
    try:
        return json.loads(text)
    except ValueError as error:
        raise FormatError(_spec.ERROR_JSON, at, "JSN-1", str(error)) from None


# Single precision ----------------------------------------------------------------------------------


def single_precision(gpu: GpuArithmetic) -> Plant:
    """Return what makes the Python decoder compute section 7 as a GPU does, and as CNF-7 allows."""

    def lattice(_right: Wrong, integers: Any, step: float, out: Any, **_options: Any) -> None:
        out[...] = lattice_values(integers.astype(np.int64), step, 0, gpu)

    def table(_right: Wrong, record: _spec.AttributeRecord) -> Any:
        return opacities(np.arange(record.levels + 1), record, gpu)

    def rotations(_right: Wrong, block: Any, record: _spec.AttributeRecord, out: Any) -> None:
        for start, stop, q, _ in reconstruct.quat_rows(block, record, len(out)):
            out[start:stop] = quats(q.T.astype(np.int64), record.levels, gpu)

    parts = (replaced("_scale", lattice), replaced("opacity_table", table), replaced("write_quats", rotations))
    return together(*parts)


def off_by(ulps: int) -> Plant:
    """Return a fault that makes means, scales and colours larger by `ulps` ulps of binary32."""

    def wrong(right: Wrong, integers: Any, step: float, out: Any, **options: Any) -> None:
        right(integers, step, out, **options)
        for _ in range(ulps):
            out[...] = np.where(np.abs(out) < np.finfo(np.float32).max, np.nextafter(out, np.float32(np.inf)), out)

    return replaced("_scale", wrong)


def _corner_as_float(right: Wrong, block: Any, record: _spec.AttributeRecord, out: Any) -> int:
    """Add corner × s, exact but for one rounding, and q × s."""
    largest: int = right(block, record, out)
    if record.attribute == _spec.ATTRIBUTE_MEANS:
        step = math.ldexp(record.step, block.exponent)
        for axis, offset in enumerate(block.offsets):
            out[:, axis] = np.float32(offset * step) + block.elements[axis].astype(np.float32) * np.float32(step)
    return largest


def _rounded_radicand(right: Wrong, block: Any, record: _spec.AttributeRecord, out: Any) -> None:
    right(block, record, out)
    twice = np.float32(2 * record.levels**2)
    for start, stop, q, _ in reconstruct.quat_rows(block, record, len(out)):
        a, b, c = (q.astype(np.float32)) ** 2
        out[start:stop, 0] = np.sqrt(np.maximum(twice - a - b - c, 0)) * np.float32(1 / (record.levels * math.sqrt(2)))


def _rest_of_unit(right: Wrong, block: Any, record: _spec.AttributeRecord, out: Any) -> None:
    right(block, record, out)
    x, y, z = out[:, 1:].T
    out[:, 0] = np.sqrt(np.maximum(np.float32(1) - x * x - y * y - z * z, 0))


def _half_precision(right: Wrong, record: _spec.AttributeRecord) -> Any:
    return right(record).astype(np.float16).astype(np.float32)


def _overflowing(_right: Wrong, integers: Any, step: float, out: Any, **_options: Any) -> None:
    with np.errstate(over="ignore"):
        out[...] = integers.astype(np.float32) * np.float32(step)


def _checked_when_rounded(_right: Wrong, parts: Any, step: float, record: Any, at: int) -> None:
    """Ask whether the values in single precision are finite."""
    with np.errstate(over="ignore"):
        finite = all(np.isfinite(part.astype(np.float32) * np.float32(step)).all() for part in parts)
    if not finite:
        raise FormatError(_spec.ERROR_RANGE, at, "MEA-1", _spec.ATTRIBUTE_NAMES[record.attribute])


def _never(_right: Wrong, _integer: int, _step: float) -> bool:
    return False


def _renderer(name: str, what: str, clause: str, plant: Plant) -> DecoderFault:
    return DecoderFault(f"renderer: {name}", what, clause, plant, RENDERER)


_NO_LIMITS = constants(
    **dict.fromkeys(
        ("CHROMA_SHIFT_MAX", "QUAT_LEVELS_MAX", "OPACITY_LEVELS_MAX", "COLUMN_MAX", "JSON_DEPTH_MAX"), 2**60
    )
)
_NOTHING_READ = together(replaced("json_chunk", nothing), replaced("bounds_chunk", nothing))

_REPLACEMENTS: Final = (
    DecoderFault("CRC ignored", "no CRC-32 is compared", "CHK-1", replaced("_check_crc", nothing)),
    DecoderFault("CRC of the index", "the chunks have theirs", "IDX-1", replaced("_check_crc", crc_but("IDX-1"))),
    DecoderFault("CRCs of chunks", "the index has its own", "CHK-1", replaced("_check_crc", crc_but("CHK-1"))),
    DecoderFault(
        "chunks unused", "what is not used is not read", "CHK-2", replaced("read_side_chunks", _no_side_chunks)
    ),
    DecoderFault("trailing bytes", "bytes behind the file are accepted", "HDR-6", replaced("view_of", _cut_to_size)),
    DecoderFault("tails of payloads", "a payload may go on", "TLE-3", replaced("finish", nothing, container.Cursor)),
    DecoderFault("lenient inflate", "as most libraries do by default", "COD-2", replaced("_inflate", _tail_of_inflate)),
    DecoderFault(
        "DEFLATE, counts", "any number of 5 bits is a count", "COD-5", replaced("_inflate", _inflate_without("COD-5"))
    ),
    DecoderFault("DEFLATE, codes", "complete or not", "COD-6", replaced("_inflate", _inflate_without("COD-6"))),
    DecoderFault(
        "DEFLATE, lengths", "repetitions as they come", "COD-7", replaced("_inflate", _inflate_without("COD-7"))
    ),
    DecoderFault("DEFLATE, symbols", "each means something", "COD-8", replaced("_inflate", _inflate_without("COD-8"))),
    DecoderFault("reserved bits", "reserved fields are not looked at", "RES-1", replaced("check_reserved", nothing)),
    DecoderFault(
        "critical chunks", "whatever is unknown is skipped", "DIR-2", replaced("_check_chunk_type", _skip_critical)
    ),
    DecoderFault("tails of records", "a record is as long as its fields", "IDX-9", _without_tails),
    DecoderFault(
        "flags",
        "what is not listed is refused",
        "ANC-1",
        constants(ANCILLARY_SCENE_FLAGS=0, ANCILLARY_CHUNK_FLAGS=0),
    ),
    DecoderFault("layers", "what is not known is refused", "ANC-2", constants(ANCILLARY_ID_MIN=256)),
    DecoderFault("extra types", "an unknown one has no block", "ANC-3", replaced("read_extras", _known_extras)),
    DecoderFault("limits", "levels, shifts, columns, nesting without bound", "LAT-4", _NO_LIMITS),
    DecoderFault("box", "max_scale is believed", "TIL-11", replaced("check_max_scale", nothing)),
    DecoderFault("zigzag", "odd values are one too large", "STR-3", replaced("_undo_zigzag", _zigzag)),
    DecoderFault("modulus", "DELTA and ZIGZAG not modulo 2^(8w)", "STR-2", replaced("_wrap", _no_wrap)),
    DecoderFault("sign", "elements of SIGNED read as unsigned", "LAT-4", replaced("_as_signed", _as_unsigned)),
    DecoderFault("order", "Morton codes taken for sorted", "ORD-1", replaced("morton_axes", _sorted_codes)),
    DecoderFault(
        "escapes", "escaped splats take the last entry", "CBK-3", replaced("rows", _no_escapes, blocks.CodebookBlock)
    ),
    DecoderFault("unused entries", "entries of a codebook are believed", "CBK-7", replaced("_check_entries", nothing)),
    DecoderFault(
        "summand",
        "the common summand of SHAPE is dropped",
        "CBK-1",
        replaced("rows", _no_summand, blocks.CodebookBlock),
    ),
    DecoderFault("mask", "bits from the highest on", "SPA-2", replaced("read_sparse", _mask_from_the_top)),
    DecoderFault("rounding", "products in binary32", "NUM-1", replaced("_scale", _binary32_product)),
    DecoderFault("quats, order of operations", "q / M / √2", "NUM-1", replaced("write_quats", _loose_quats)),
    DecoderFault("quats, sign of w", "w is negative", "QUA-2", replaced("write_quats", _minus_w)),
    DecoderFault("quats, place of w", "x, y, z, w", "QUA-2", replaced("write_quats", _w_last)),
    DecoderFault("opacities", "the square is forgotten", "LEV-1", replaced("opacity_table", _linear)),
    DecoderFault("layers swapped", "band 2 before band 1", "ATT-1", replaced("write_bands", _bands_swapped)),
    DecoderFault("SH columns", "coefficient by coefficient", "ATT-1", replaced("write_colour", _channels_innermost)),
    DecoderFault("tile offset", "the tile's corner is not added", "TIL-7", replaced("lattice_rows", _without_corner)),
    DecoderFault(
        "tile offset as float", "corner and rest rounded apart", "TIL-7", replaced("write_lattice", _added_as_floats)
    ),
    DecoderFault("exponents", "2^exponent is forgotten", "LAT-1", _no_exponents),
    DecoderFault("chroma shift", "Co and Cg are not shifted", "ATT-8", replaced("lift", _no_chroma_shift)),
    DecoderFault("lifting", "halves rounded towards zero", "ATT-2", replaced("lift", _lift_towards_zero)),
    DecoderFault("CRC of the header", "the index has its own", "HDR-12", replaced("_check_crc", crc_but("HDR-3"))),
    DecoderFault("steps", "binary64, as the means'", "ATT-10", replaced("_is_single", lambda *_: True)),
    DecoderFault("lattices", "step × 2^exponent may be anything", "LAT-1", replaced("check_step", nothing)),
    DecoderFault("columns", "within 2^50, as in 0.1", "LAT-4", constants(COLUMN_MAX=2**50)),
    DecoderFault("unnamed codebooks", "are not read", "CHK-2", replaced("check_unnamed_codebooks", nothing)),
    DecoderFault("unread payloads", "nor are frame and CRC looked at, which CHK-6 demands", "CHK-2", _NOTHING_READ),
    DecoderFault("JSON", "as the library reads it", "JSN-1", replaced("parse_json", _library_json)),
    _renderer("3 ulp", "values of lattices", "CNF-7", off_by(3)),
    _renderer(
        "corner as float", "corner and rest meet as floats", "CNF-7", replaced("write_lattice", _corner_as_float)
    ),
    _renderer("radicand", "R of squares in binary32", "CNF-7", replaced("write_quats", _rounded_radicand)),
    _renderer("rest of a unit", "w as √(1 − x² − y² − z²)", "CNF-7", replaced("write_quats", _rest_of_unit)),
    _renderer("half precision", "opacities of 16 bits", "CNF-7", replaced("opacity_table", _half_precision)),
    _renderer("overflow", "a product beyond the largest number is infinite", "CNF-7", replaced("_scale", _overflowing)),
    _renderer(
        "range by rounded values",
        "refuses what overflows in single precision",
        "CNF-8",
        together(replaced("_is_finite", _never), replaced("_check_finite", _checked_when_rounded)),
    ),
    _renderer(
        "range by cut values",
        "a GPU that cuts products has no infinite ones, and the range is not looked at",
        "CNF-8",
        together(replaced("_check_finite", nothing), single_precision(GPUS["WGSL"][1])),
    ),
)

if __name__ == "__main__":
    sys.exit(main())

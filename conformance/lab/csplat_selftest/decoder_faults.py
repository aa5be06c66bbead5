# SPDX-License-Identifier: CC0-1.0
"""Plant typical mistakes of implementers in our decoders, and check that the suite notices each of them.

Usage:
    python -m csplat_selftest.decoder_faults             # table of faults, failed vectors and clauses
    python -m csplat_selftest.decoder_faults --only python --vectors

A fault replaces a function of the Python decoder (in this module), or edits the source of a function in Python or of a
module in JavaScript (`decoder_faults.toml`). Some faults compute imprecisely in single precision, and are tested with
the tolerances of the class *renderer*.
"""

from __future__ import annotations

import argparse
import inspect
import json
import math
import shutil
import sys
import tempfile
import tomllib
import zlib
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from functools import cache, partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any, Final
from unittest import mock

import numpy as np

from csplat import _spec, decoder
from csplat.decoder import blocks, container, entropy, index, reconstruct
from csplat.errors import FormatError, InputError, UnsupportedError
from csplat_authoring.recipes import exact_floats
from csplat_conformance.adapter import answer, cuts_of
from csplat_conformance.answers import (
    PARTS,
    Answer,
    check_payload_consistency,
    compare_answer,
    compare_cuts,
    cuts_of_vector,
)
from csplat_conformance.conformance_report import Outcome, Status
from csplat_conformance.manifest import Vector, load
from csplat_conformance.tolerance import EXACT, RENDERER
from csplat_conformance.validator.inflate import CodedError, Inflater
from csplat_selftest.decoder_processes import JsDecoder, js_folder, select_in_javascript
from csplat_selftest.single_precision import GPUS, GpuArithmetic, lattice_values, opacities, quats

_EDITS: Final = Path(__file__).with_suffix(".toml")
#: A faulty function; called with the original function and then the arguments.
Wrong = Callable[..., Any]
#: Plants a fault in the Python decoder until the stack is closed.
Plant = Callable[[ExitStack], None]

_SHOWN_CLAUSES = 4


@dataclass(frozen=True)
class ModuleEdit:
    """An edit of the JavaScript decoder's source.

    Attributes:
        file: module.
        edits: pieces of its text, each of which occurs once, and their replacements.
    """

    file: str
    edits: Mapping[str, str]


@dataclass(frozen=True)
class DecoderFault:
    """A fault of a decoder.

    Attributes:
        name: short name.
        what: the mistake, such as an implementer might make.
        clause: the clause of the specification that it violates.
        plant: plants it in the Python decoder or in the JavaScript decoder.
        by: class (spec 9.2) for which the decoder is tested.
    """

    name: str
    what: str
    clause: str
    plant: Plant | ModuleEdit
    by: str = EXACT

    @property
    def language(self) -> str:
        """Language of the decoder."""
        return "JavaScript" if isinstance(self.plant, ModuleEdit) else "Python"


@dataclass(frozen=True)
class Finding:
    """The suite's findings about a decoder with a fault."""

    fault: DecoderFault
    failed: Sequence[Outcome]

    @property
    def vectors(self) -> list[str]:
        """Names of the vectors that failed."""
        return list(dict.fromkeys(outcome.name for outcome in self.failed))

    @property
    def clauses(self) -> list[str]:
        """Clauses of the failed vectors, the most frequent first."""
        by_vector = {outcome.name: outcome.clauses for outcome in self.failed}
        counts = Counter(clause for clauses in by_vector.values() for clause in clauses)
        return [clause for clause, _ in counts.most_common()]


def find(fault: DecoderFault, vectors: Iterable[Vector] | None = None) -> Finding:
    """Run a decoder with a fault over the vectors, or over some of them.

    Codes of refusals are not compared, as for other decoders. Cuts (L5) are compared for faults of TRE-9 alone, because
    a process for each vector takes a second.

    Raises:
        InputError: Node or the JavaScript decoder is missing.
    """
    outcomes: list[Outcome] = []
    with ExitStack() as stack:
        ask: Callable[[bytes], Answer]
        select: Callable[[Vector], Answer]
        if isinstance(fault.plant, ModuleEdit):
            folder = _edited_javascript(stack, fault.plant)
            ask, select = stack.enter_context(JsDecoder(folder)).ask, partial(select_in_javascript, folder)
        else:
            fault.plant(stack)
            ask, select = _answer, _cuts
        near = exact_floats if fault.by == RENDERER else None
        for vector in load() if vectors is None else vectors:
            outcomes += compare_answer(vector, ask(vector.data), tuple(PARTS), near=near)
            if fault.clause == "TRE-9" and cuts_of_vector(vector):
                outcomes.append(compare_cuts(vector, select(vector)))
    return Finding(fault, [one for one in check_payload_consistency(outcomes)[0] if not one.good])


def _answer(data: bytes) -> Answer:
    try:
        return answer(data)
    except Exception as error:  # noqa: BLE001 - a faulty decoder may fail in any way
        return Answer(Status.CRASHED, f"{type(error).__name__}: {error}")


def _cuts(vector: Vector) -> Answer:
    try:
        return Answer(Status.PASSED, cuts=cuts_of(vector.data, cuts_of_vector(vector)))
    except Exception as error:  # noqa: BLE001 - a faulty decoder may fail in any way
        return Answer(Status.CRASHED, f"{type(error).__name__}: {error}")


def _edited_javascript(stack: ExitStack, edit: ModuleEdit) -> Path:
    folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="csplat-fault-")))
    for path in js_folder().glob("*.mjs"):
        shutil.copy(path, folder)
    (folder / edit.file).write_text(edited_module(edit), encoding="utf-8")
    return folder


def table(findings: Sequence[Finding]) -> str:
    """Return a Markdown table of the faults."""
    lines = [
        "| decoder | fault | mistake | vectors failed | for example | clauses |",
        "|---|---|---|---|---|---|",
    ]
    for one in findings:
        fault, clauses = one.fault, one.clauses
        named = [fault.clause, *(clause for clause in clauses if clause != fault.clause)]
        more = f" and {len(named) - _SHOWN_CLAUSES} more" if len(named) > _SHOWN_CLAUSES else ""
        example = next((o.name for o in one.failed if fault.clause in o.clauses), "none")
        cells = (fault.language, fault.name, fault.what, str(len(one.vectors)), f"`{example}`")
        lines.append(f"| {' | '.join(cells)} | {', '.join(named[:_SHOWN_CLAUSES])}{more} |")
    return "\n".join(lines)


@cache
def all_faults() -> list[DecoderFault]:
    """Return all faults."""
    result = list(_REPLACEMENTS)
    for language, rows in tomllib.loads(_EDITS.read_text(encoding="utf-8")).items():
        for row in rows:
            edits = {edit["old"]: edit["new"] for edit in row.get("edits", [row])}
            plant = edited(row["in"], edits) if language == "python" else ModuleEdit(row["in"], edits)
            result.append(DecoderFault(row["name"], row["what"], row["clause"], plant))
    return result


def main() -> int:
    """Print the table; return exit status 1 if a fault is not noticed."""
    parser = argparse.ArgumentParser(
        prog="csplat_selftest.decoder_faults", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--only", choices=("python", "javascript"), help="test only one of the two decoders")
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
        sys.stderr.write(f"not noticed: {fault.language}, {fault.name} ({fault.clause})\n")
    return 1 if missed else 0


# Ways to plant a fault -----------------------------------------------------------------------------


def replaced(name: str, wrong: Wrong, owner: object = None) -> Plant:
    """Return a plant that replaces a function of an owner, or wherever the decoder has imported it."""

    def plant(stack: ExitStack) -> None:
        owners = _owners(name) if owner is None else [owner]
        assert owners, f"the decoder has no {name}"
        for one in owners:
            stack.enter_context(mock.patch.object(one, name, _bound(wrong, getattr(one, name))))

    return plant


def edited(name: str, edits: Mapping[str, str]) -> Plant:
    """Return a plant that replaces pieces of the source of a function, each of which must occur once."""

    def plant(stack: ExitStack) -> None:
        (right,) = {getattr(module, name) for module in _owners(name)}
        made: dict[str, Any] = {}
        exec(_edited_text(name, inspect.getsource(right), edits), right.__globals__, made)  # noqa: S102 - our source
        replaced(name, lambda _right, *args, **options: made[name](*args, **options))(stack)

    return plant


def edited_module(edit: ModuleEdit) -> str:
    """Return the text of a JavaScript module with its edit."""
    text = (js_folder() / edit.file).read_text(encoding="utf-8")
    return _edited_text(edit.file, text, edit.edits)


def constants(**values: int) -> Plant:
    """Return a plant that changes constants of the format."""
    return together(
        *(lambda stack, k=k, v=v: stack.enter_context(mock.patch.object(_spec, k, v)) for k, v in values.items())
    )


def together(*plants: Plant) -> Plant:
    """Return a plant of several faults."""

    def plant(stack: ExitStack) -> None:
        for one in plants:
            one(stack)

    return plant


def nothing(_right: Wrong, *_args: Any, **_options: Any) -> None:
    """Do nothing; replaces a function."""


def _owners(name: str) -> list[object]:
    prefix = decoder.__name__ + "."
    modules = [module for key, module in list(sys.modules.items()) if key.startswith(prefix)]
    return [module for module in modules if hasattr(module, name)]


def _bound(wrong: Wrong, right: Wrong) -> Wrong:
    def replacement(*args: Any, **options: Any) -> Any:
        return wrong(right, *args, **options)

    return replacement


def _edited_text(name: str, text: str, edits: Mapping[str, str]) -> str:
    for old, new in edits.items():
        if text.count(old) != 1:
            raise ValueError(f"{name} contains {old!r} {text.count(old)} times, expected once: update the fault")
        text = text.replace(old, new)
    return text


# Checks --------------------------------------------------------------------------------------------


def _cut_to_size(right: Wrong, data: Any) -> memoryview:
    """Drop the bytes after the file size in the header."""
    view: memoryview = right(data)
    if len(view) < _spec.HEADER_SIZE:
        return view
    return view[: max(_spec.HEADER_SIZE, _spec.unpack_header(view).file_size)]


def crc_but(unchecked: str) -> Wrong:
    """Return a fault that does not check the CRCs of one clause."""

    def wrong(right: Wrong, covered: memoryview, stored: int, at: int, clause: str) -> None:
        if clause != unchecked:
            right(covered, stored, at, clause)

    return wrong


def _no_side_chunks(_right: Wrong, _job: Any) -> tuple[None, None]:
    return None, None


def _tail_of_inflate(_right: Wrong, coded: memoryview, size: int, at: int) -> bytes:  # noqa: ARG001 - the original's signature
    return zlib.decompressobj(-zlib.MAX_WBITS).decompress(coded, size).ljust(size, b"\0")


class _CarelessInflater(Inflater):
    """An inflater that ignores one clause."""

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
            raise FormatError(_spec.ERROR_CODER, at, "COD-2", "wrong size")
        return packed

    return inflate


def _skip_critical(right: Wrong, record: _spec.DirectoryRecord, at: int) -> None:
    try:
        right(record, at)
    except UnsupportedError:
        return


def _without_tails(stack: ExitStack) -> None:
    """Use the sizes of the structures instead of the sizes in the file."""
    right = _spec.unpack_index_head

    def unpack(data: Any, at: int) -> _spec.IndexHead:
        return right(data, at)._replace(
            attribute_size=_spec.ATTRIBUTE_RECORD_SIZE,
            directory_size=_spec.DIRECTORY_RECORD_SIZE,
            tile_size=_spec.TILE_RECORD_SIZE,
            layer_size=_spec.LAYER_RECORD_SIZE,
        )

    stack.enter_context(mock.patch.object(_spec, "unpack_index_head", unpack))


def _skip_by_layer(_right: Wrong, _header: Any, layer: int) -> bool:
    return layer >= _spec.ANCILLARY_ID_MIN


def _splat_by_splat(right: Wrong, cursor: Any, count: int, column: Any) -> Any:
    elements = right(cursor, count, column)
    return elements if column.components == 1 else elements.T.reshape(count, column.components)


def _without_semantics(right: Wrong, *args: Any) -> Any:
    return tuple(replace(column, semantic="") for column in right(*args))


# Streams -------------------------------------------------------------------------------------------


def _zigzag(right: Wrong, elements: Any, width: int) -> Any:
    result = right(elements, width)
    return entropy._wrap(np.where(elements & 1, result + elements.dtype.type(1), result), width)  # noqa: SLF001 - a fault


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
    return replace(block, splat_indices=np.minimum(block.splat_indices ^ 7, context.tile.splat_count - 1))


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
                reconstruct._scale(row, step, out[start:stop, coefficient, channel])  # noqa: SLF001 - a fault


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


# Texts ----------------------------------------------------------------------------------------------


def _library_json(_right: Wrong, text: bytes, _kind: type, at: int) -> Any:
    try:
        return json.loads(text)
    except ValueError as error:
        raise FormatError(_spec.ERROR_JSON, at, "JSN-1", str(error)) from None


# Single precision ----------------------------------------------------------------------------------


def single_precision(gpu: GpuArithmetic) -> Plant:
    """Return a plant that makes the Python decoder compute section 7 with the arithmetic of a GPU (CNF-7)."""

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
    """Add corner × s, rounded once, and q × s."""
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


def _checked_when_rounded(right: Wrong, tile: container.Tile, means_step: float) -> None:
    """Check that the corners of a box in single precision are finite."""
    right(tile, means_step)
    with np.errstate(over="ignore", invalid="ignore"):
        ends = np.array([tile.corner, np.add(tile.corner, tile.extent)], np.float32)
        finite = np.isfinite(ends * np.float32(math.ldexp(means_step, tile.exponent))).all()
    if not finite:
        raise FormatError(_spec.ERROR_RANGE, tile.offset, "MEA-1", "corner")


def _boxes_without_limit(stack: ExitStack) -> None:
    stack.enter_context(mock.patch.object(index, "_SINGLE_END", math.inf))


def _wide_corners(_right: Wrong, tile: container.Tile, step: float) -> tuple[list[float], list[float]]:
    scaled = math.ldexp(step, tile.exponent)
    low = [n * scaled for n in tile.corner]
    return low, [(n + m) * scaled for n, m in zip(tile.corner, tile.extent, strict=True)]


def _renderer(name: str, what: str, clause: str, plant: Plant) -> DecoderFault:
    return DecoderFault(f"renderer: {name}", what, clause, plant, RENDERER)


_NO_LIMITS = constants(
    **dict.fromkeys(
        ("CHROMA_SHIFT_MAX", "QUAT_LEVELS_MAX", "OPACITY_LEVELS_MAX", "COLUMN_MAX", "JSON_DEPTH_MAX"), 2**60
    )
)
_NOTHING_READ = together(replaced("json_chunk", nothing), replaced("bounds_chunk", nothing))

_REPLACEMENTS: Final = (
    DecoderFault(
        "boxes", "corners are not rounded to binary32", "TRE-9", replaced("corners", _wide_corners, container.Tile)
    ),
    DecoderFault("CRC of the index", "not checked", "IDX-1", replaced("_check_crc", crc_but("IDX-1"))),
    DecoderFault("CRCs of chunks", "not checked", "CHK-1", replaced("_check_crc", crc_but("CHK-1"))),
    DecoderFault("unused chunks", "unused chunks are not read", "CHK-2", replaced("read_side_chunks", _no_side_chunks)),
    DecoderFault("trailing bytes", "trailing bytes are accepted", "HDR-6", replaced("view_of", _cut_to_size)),
    DecoderFault(
        "tails of payloads",
        "bytes may follow the last structure",
        "TLE-3",
        replaced("finish", nothing, container.Cursor),
    ),
    DecoderFault(
        "lenient inflate",
        "trailing bytes are ignored, as by most libraries",
        "COD-2",
        replaced("_inflate", _tail_of_inflate),
    ),
    DecoderFault(
        "DEFLATE, counts", "any 5-bit number is a count", "COD-5", replaced("_inflate", _inflate_without("COD-5"))
    ),
    DecoderFault(
        "DEFLATE, codes", "incomplete codes are accepted", "COD-6", replaced("_inflate", _inflate_without("COD-6"))
    ),
    DecoderFault(
        "DEFLATE, lengths", "repetitions are not checked", "COD-7", replaced("_inflate", _inflate_without("COD-7"))
    ),
    DecoderFault(
        "DEFLATE, symbols", "every symbol is accepted", "COD-8", replaced("_inflate", _inflate_without("COD-8"))
    ),
    DecoderFault("reserved bits", "reserved fields are not checked", "RES-1", replaced("check_reserved", nothing)),
    DecoderFault(
        "critical chunks", "all unknown chunks are skipped", "DIR-2", replaced("_check_chunk_type", _skip_critical)
    ),
    DecoderFault("tails of records", "records have the size of their fields", "IDX-9", _without_tails),
    DecoderFault(
        "flags",
        "unlisted flags are refused",
        "ANC-1",
        constants(ANCILLARY_SCENE_FLAGS=0, ANCILLARY_CHUNK_FLAGS=0),
    ),
    DecoderFault("layers", "unknown layers are refused", "ANC-2", constants(ANCILLARY_ID_MIN=256)),
    DecoderFault(
        "extra types",
        "columns of unknown types are read",
        "ANC-3",
        replaced("skips", _skip_by_layer, container.SceneHeader),
    ),
    DecoderFault("components", "components lie side by side", "TIL-5", replaced("read_raw", _splat_by_splat)),
    DecoderFault("semantics", "semantics are not returned", "EXR-7", replaced("read_extras", _without_semantics)),
    DecoderFault("limits", "levels, shifts, columns and nesting are unlimited", "LAT-4", _NO_LIMITS),
    DecoderFault("box", "max_scale is not checked", "TIL-11", replaced("check_max_scale", nothing)),
    DecoderFault("zigzag", "odd values are one too large", "STR-3", replaced("_undo_zigzag", _zigzag)),
    DecoderFault("modulus", "DELTA and ZIGZAG are not modulo 2^(8w)", "STR-2", replaced("_wrap", _no_wrap)),
    DecoderFault("sign", "elements of SIGNED are read as unsigned", "LAT-4", replaced("_as_signed", _as_unsigned)),
    DecoderFault("order", "Morton codes are assumed sorted", "ORD-1", replaced("morton_axes", _sorted_codes)),
    DecoderFault(
        "escapes", "escaped splats use the last entry", "CBK-3", replaced("rows", _no_escapes, blocks.CodebookBlock)
    ),
    DecoderFault("unused entries", "codebook entries are not checked", "CBK-7", replaced("_check_entries", nothing)),
    DecoderFault(
        "summand",
        "the common summand of SHAPE is dropped",
        "CBK-1",
        replaced("rows", _no_summand, blocks.CodebookBlock),
    ),
    DecoderFault("mask", "bits are read from the highest", "SPA-2", replaced("read_sparse", _mask_from_the_top)),
    DecoderFault("rounding", "products are computed in binary32", "NUM-1", replaced("_scale", _binary32_product)),
    DecoderFault("quats, order of operations", "q / M / √2", "NUM-1", replaced("write_quats", _loose_quats)),
    DecoderFault("quats, sign of w", "w is negative", "QUA-2", replaced("write_quats", _minus_w)),
    DecoderFault("opacities", "SQUARE is ignored", "LEV-1", replaced("opacity_table", _linear)),
    DecoderFault("layers swapped", "band 2 before band 1", "ATT-1", replaced("write_bands", _bands_swapped)),
    DecoderFault("SH columns", "coefficient by coefficient", "ATT-1", replaced("write_colour", _channels_innermost)),
    DecoderFault("tile offset", "the tile's corner is not added", "TIL-7", replaced("lattice_rows", _without_corner)),
    DecoderFault(
        "tile offset as float",
        "corner and rest rounded separately",
        "TIL-7",
        replaced("write_lattice", _added_as_floats),
    ),
    DecoderFault("exponents", "2^exponent is ignored", "LAT-1", _no_exponents),
    DecoderFault("chroma shift", "Co and Cg are not shifted", "ATT-8", replaced("lift", _no_chroma_shift)),
    DecoderFault("lifting", "halves rounded towards zero", "ATT-2", replaced("lift", _lift_towards_zero)),
    DecoderFault("CRC of the header", "not checked", "HDR-12", replaced("_check_crc", crc_but("HDR-3"))),
    DecoderFault("steps", "all steps may be any binary64", "ATT-10", replaced("_is_single", lambda *_: True)),
    DecoderFault("lattices", "step × 2^exponent is not checked", "LAT-1", replaced("check_step", nothing)),
    DecoderFault("unnamed codebooks", "are not read", "CHK-2", replaced("check_unnamed_codebooks", nothing)),
    DecoderFault("unread payloads", "frame and CRC of unread payloads are not checked", "CHK-2", _NOTHING_READ),
    DecoderFault("JSON", "everything that json.loads accepts", "JSN-1", replaced("parse_json", _library_json)),
    _renderer("3 ulp", "lattice values are 3 ulp too large", "CNF-7", off_by(3)),
    _renderer(
        "corner as float", "corner and rest are added as floats", "CNF-7", replaced("write_lattice", _corner_as_float)
    ),
    _renderer("radicand", "R from squares in binary32", "CNF-7", replaced("write_quats", _rounded_radicand)),
    _renderer("rest of a unit", "w as √(1 − x² − y² − z²)", "CNF-7", replaced("write_quats", _rest_of_unit)),
    _renderer("half precision", "opacities in 16 bits", "CNF-7", replaced("opacity_table", _half_precision)),
    _renderer("overflow", "products beyond the largest number are infinite", "CNF-7", replaced("_scale", _overflowing)),
    _renderer(
        "range by rounded values",
        "values that overflow in single precision are refused",
        "CNF-8",
        replaced("_check_tile", _checked_when_rounded),
    ),
    _renderer(
        "range by truncated values",
        "truncating arithmetic gives no infinite values, and the range is not checked",
        "CNF-8",
        together(_boxes_without_limit, single_precision(GPUS["WGSL"][1])),
    ),
)

if __name__ == "__main__":
    sys.exit(main())

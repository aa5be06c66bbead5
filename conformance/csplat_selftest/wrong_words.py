"""Mistakes of the Python decoder that take a few other words in a function: clauses that 0.2 added, above all."""

from __future__ import annotations

import json
from contextlib import ExitStack
from typing import Any, Final
from unittest import mock

from csplat import _spec
from csplat.errors import FormatError
from csplat_selftest.mistakes import Mistake, Wrong, nothing, replaced, reworded
from csplat_selftest.wrong_python import crc_but


def _columns_of_0_1(stack: ExitStack) -> None:
    stack.enter_context(mock.patch.object(_spec, "COLUMN_MAX", 2**50))


def _library_json(_right: Wrong, text: bytes, _kind: type, at: int) -> Any:
    try:
        return json.loads(text)
    except ValueError as error:
        raise FormatError(_spec.ERROR_JSON, at, "JSN-1", str(error)) from None


def _unread(stack: ExitStack) -> None:
    for name in ("read_json", "read_serr"):
        replaced(name, nothing)(stack)


_COUNT = {"not 1 <= params.present_count <= count": "False"}
_BITS = {"len(present) != params.present_count": "False"}
_OF_THE_KIND = """context.first.get(params.codebook_id) or next(
        (one for one in context.first.values() if one.book.record.kind == book.record.kind), None
    )"""
_CHECKED = """block = ColumnBlock(elements.reshape(1, count), offsets, 0, at)
    check_integers(block.lows, block.highs, context.header.attribute(attribute), at)
    return block"""
_NFC = "__import__('unicodedata').normalize('NFC', {})"

MISTAKES: Final = (
    Mistake(
        "version",
        "any minor version is read",
        "HDR-2",
        reworded("read_file_header", {"version != (_spec.VERSION_MAJOR, _spec.VERSION_MINOR)": "version[0]"}),
    ),
    Mistake("CRC of the header", "the index has its own", "HDR-12", replaced("_check_crc", crc_but("HDR-3"))),
    Mistake("steps", "binary64, as the means'", "ATT-10", replaced("_is_single", lambda *_: True)),
    Mistake("lattices", "step × 2^exponent may be anything", "LAT-1", replaced("check_step", nothing)),
    Mistake(
        "offsets", "sums alone are looked at", "LAT-3", reworded("read_offsets", {"> _spec.COLUMN_MAX": "> 2**32"})
    ),
    Mistake("columns", "within 2^50, as in 0.1", "LAT-4", _columns_of_0_1),
    Mistake(
        "columns of chroma",
        "the limit holds before the shift",
        "LAT-4",
        reworded("_check_columns", {"record.chroma_shift if 3 * column >= len(lows) else 0": "0"}),
    ),
    Mistake(
        "values of entries", "where they are used", "CBK-7", reworded("_check_entries", {"check_values(": "id, ("})
    ),
    Mistake("unnamed codebooks", "are not read", "CHK-2", replaced("check_unnamed_codebooks", nothing)),
    Mistake("unread payloads", "nor are frame and CRC looked at, which CHK-6 demands", "CHK-2", _unread),
    Mistake("present splats", "the mask alone counts", "SPA-1", reworded("read_sparse", _COUNT | _BITS)),
    Mistake(
        "bits of the mask",
        "as many as `present_count` says, from the first on",
        "SPA-2",
        reworded("read_sparse", _BITS | {"np.flatnonzero(bits)": "np.flatnonzero(bits)[: params.present_count]"}),
    ),
    Mistake(
        "end of the mask",
        "bits that belong to no splat are cut off",
        "SPA-3",
        reworded("read_sparse", {"if bits[count:].any()": "bits = bits[:count]\n    if False"}),
    ),
    Mistake(
        "names of columns",
        "compared after normalisation",
        "EXR-2",
        reworded(
            "read_extras", {"name in columns": f"{_NFC.format('name')} in [{_NFC.format('one')} for one in columns]"}
        ),
    ),
    Mistake(
        "codebooks of a kind",
        "a later block takes the indices of another, where its own has none",
        "CBK-4",
        reworded("_indices", {"context.first.get(params.codebook_id)": _OF_THE_KIND}),
    ),
    Mistake(
        "indices",
        "beyond the escape index the last entry serves",
        "CBK-2",
        reworded("_read_indices", {"largest > size": "False"}),
    ),
    Mistake(
        "summands",
        "LAT-4 holds for them, too",
        "LAT-4",
        reworded("_read_summand", {"return ColumnBlock(elements.reshape(1, count), offsets, 0, at)": _CHECKED}),
    ),
    Mistake("JSON", "as the library reads it", "JSN-1", replaced("parse_json", _library_json)),
)

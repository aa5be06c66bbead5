"""Mistakes of the JavaScript decoder: each replaces a piece of its text in a copy."""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from csplat_conformance.answers import PARTS, check_payload_consistency, compare_answer
from csplat_conformance.manifest import Vector, load
from csplat_selftest.decoder_processes import JsDecoder, js_folder
from csplat_selftest.mistakes import Caught, Mistake


@dataclass(frozen=True)
class Edit:
    """One mistake.

    Attributes:
        name: short.
        what: the mistake that a hurried implementer might make.
        clause: the clause of the spec that it breaks.
        file: module of the decoder.
        old: a piece of its text that occurs once.
        new: its replacement.
    """

    name: str
    what: str
    clause: str
    file: str
    old: str
    new: str


EDITS: Final = (
    Edit(
        "version",
        "any minor version is read",
        "HDR-2",
        "container.mjs",
        "major !== spec.VERSION_MAJOR || minor !== spec.VERSION_MINOR",
        "major !== spec.VERSION_MAJOR",
    ),
    Edit("steps", "binary64, as the means'", "ATT-10", "file_index.mjs", "Math.fround(step) === step && ", ""),
    Edit(
        "lattices",
        "step × 2^exponent may be anything",
        "LAT-1",
        "codings.mjs",
        "if (!(s >= SINGLE_MIN && s < 2 ** 128))",
        "if (false)",
    ),
    Edit(
        "columns of chroma",
        "the limit holds before the shift",
        "LAT-4",
        "codings.mjs",
        "spec.COLUMN_MAX / 2 ** attribute.chromaShift",
        "spec.COLUMN_MAX",
    ),
    Edit("bits of the mask", "uncounted", "SPA-2", "codings.mjs", "if (found !== count) throw", "if (false) throw"),
    Edit(
        "end of the mask",
        "not looked at",
        "SPA-3",
        "codings.mjs",
        "if (n & 7 && mask[n >> 3] >> (n & 7)) throw",
        "if (false) throw",
    ),
    Edit("CRCs of chunks", "ignored", "CHK-1", "container.mjs", "checkCrc(chunk, place.crc, offset, 'CHK-1');", ""),
    Edit(
        "CRC of the index",
        "ignored",
        "IDX-1",
        "container.mjs",
        "checkCrc(index.subarray(0, at), found, spec.HEADER_SIZE + at, 'IDX-1');",
        "",
    ),
    Edit(
        "chunks unused",
        "chunks of the directory are opened where they are read",
        "CHK-2",
        "reader.mjs",
        "for (const [place, chunk] of chunks) if (!",
        "for (const [place, chunk] of chunks) if (place.type in spec.CHUNK_NAMES && !",
    ),
    Edit(
        "tails of payloads", "a payload may go on", "TLE-3", "payload.mjs", "if (this.left) throw", "if (false) throw"
    ),
    Edit(
        "lenient inflate",
        "as Node's inflateRaw by default",
        "COD-2",
        "inflate.mjs",
        "if (used !== coded.length) throw",
        "if (false) throw",
    ),
    Edit(
        "zigzag",
        "the sign is lost",
        "STR-3",
        "transforms.mjs",
        "x[i] = ((x[i] >>> 1) ^ -(x[i] & 1)) & mask",
        "x[i] >>>= 1",
    ),
    Edit("carry", "from the lower half of wide elements", "STR-2", "transforms.mjs", "(sum > 0xffffffff ? 1 : 0)", "0"),
    Edit(
        "escapes",
        "escaped splats take what index 0 gives",
        "CBK-3",
        "codebooks.mjs",
        "block.columns[Math.floor(i / n) * stride + escaped[i % n]] = escapes.columns[i];",
        "",
    ),
    Edit(
        "mask",
        "bits from the highest on",
        "SPA-2",
        "codings.mjs",
        "if ((mask[i >> 3] >> (i & 7)) & 1)",
        "if ((mask[i >> 3] >> (7 - (i & 7))) & 1)",
    ),
    Edit(
        "unused entries",
        "entries of a codebook are believed",
        "CBK-7",
        "codebooks.mjs",
        "  checkEntries({",
        "  if (false) checkEntries({",
    ),
    Edit("quats, sign of w", "w is negative", "QUA-2", "arrays.mjs", "out[at] = Math.sqrt(", "out[at] = -Math.sqrt("),
    Edit(
        "opacities",
        "the square is forgotten",
        "LEV-1",
        "arrays.mjs",
        "if (mapping === spec.MAPPING_NAMES[spec.MAPPING_SQUARE]) {",
        "if (false) {",
    ),
    Edit("lifting", "halves rounded towards zero", "ATT-2", "lattice.mjs", "Math.floor(co / 2)", "Math.trunc(co / 2)"),
    Edit(
        "power",
        "step × 2^exponent by way of 2^exponent, which may overflow",
        "TIL-9",
        "lattice.mjs",
        "return view.getFloat64(0);",
        "return x * 2 ** exponent;",
    ),
)


def edited(edit: Edit, text: str) -> str:
    """Return a module's text with the mistake in it."""
    if text.count(edit.old) != 1:
        raise ValueError(f"{edit.file} has {edit.old!r} {text.count(edit.old)} times, wanted once: mend the edit")
    return text.replace(edit.old, edit.new)


def catch_all() -> list[Caught]:
    """Run each wrong decoder over the vectors.

    Raises:
        InputError: Node or the decoder is not here.
    """
    return [catch_edit(edit) for edit in EDITS]


def catch_edit(edit: Edit, vectors: Sequence[Vector] | None = None) -> Caught:
    """Run one wrong decoder over the vectors, or over some of them."""
    mistake = Mistake(edit.name, edit.what, edit.clause, lambda _: None)
    with tempfile.TemporaryDirectory(prefix="csplat-wrong-") as name:
        folder = Path(name)
        for path in js_folder().glob("*.mjs"):
            shutil.copy(path, folder)
        target = folder / edit.file
        target.write_text(edited(edit, target.read_text(encoding="utf-8")), encoding="utf-8")
        outcomes = []
        with JsDecoder(folder) as decoder:
            for vector in load() if vectors is None else vectors:
                outcomes += compare_answer(vector, decoder.ask(vector.data), tuple(PARTS))
    return Caught("JavaScript", mistake, [one for one in check_payload_consistency(outcomes)[0] if not one.good])

# SPDX-License-Identifier: CC0-1.0
"""Targets of the fuzzer: the decoders in Python, JavaScript and C, and the validator."""

from __future__ import annotations

import json
import random
import struct
import warnings
import zlib
from collections.abc import Callable, Generator, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import csplat
from csplat import _spec, decoder
from csplat.context import Context
from csplat.errors import CsplatError
from csplat_authoring.builder import Built, build, repair
from csplat_authoring.recipes import sound_recipes
from csplat_conformance import adapter, validator
from csplat_conformance.answers import Answer
from csplat_conformance.conformance_report import Status
from csplat_conformance.manifest import VECTORS, load
from csplat_selftest import decoder_processes
from csplat_selftest.decoder_processes import CDecoder, DecoderProcess, missing_c
from csplat_selftest.fuzzing.damage import built_from, damaged_from

LIMITS = decoder.Limits(splats=100_000, bytes=32_000_000, json_bytes=1_000_000)

_SMALL = decoder.Limits(splats=10_000, bytes=8_000_000, json_bytes=1_000_000)  # smaller, because arrays are hashed
#: The same limits by their names in JavaScript.
JS_LIMITS = {"splats": _SMALL.splats, "bytes": _SMALL.bytes, "jsonBytes": _SMALL.json_bytes}
C_LIMITS = (_SMALL.splats, _SMALL.bytes, _SMALL.json_bytes)
_LARGEST_SEED = 3000  # bytes; small files allow many cases per second
_MEMORY = 700_000_000  # bytes of another process: a heap of 512 MiB, and Node itself


@dataclass(frozen=True)
class FuzzCase:
    """A damaged file.

    Attributes:
        data: the file.
        source: returns an entry for the corpus, of the target's own type, to damage it again; None if impossible.
        notes: names to count, such as `(not repaired)`.
    """

    data: bytes
    source: Callable[[], Any]
    notes: tuple[str, ...] = ()


class DecoderTarget:
    """The Python decoder, which must decode within small limits or refuse with a CsplatError.

    Attributes:
        name: name on the command line.
        suffix: suffix of its files.
        watched: Python files, or folders of them, whose coverage guides the fuzzer.
    """

    name = "decoder"
    suffix = ".csplat"
    watched: Sequence[Path] = (Path(csplat.__file__).parent / "decoder",)

    def seeds(self, paths: Iterable[Path]) -> list[Built]:
        """Return the small valid vectors with all their fields, and the given files."""
        # Select by the size of the vector's file, because building all scenes takes two seconds.
        small = {vector.name for vector in load() if (VECTORS / vector.file).stat().st_size <= _LARGEST_SEED}
        scenes = [recipe.scene for recipe in sound_recipes() if recipe.scene is not None and recipe.name in small]
        return [build(scene) for scene in scenes] + [built_from(p.read_bytes()) for p in paths]

    def case(self, rng: random.Random, corpus: Sequence[Built]) -> FuzzCase:
        """Damage a file of the corpus."""
        base = rng.choice(corpus)
        data, repaired, in_place = damaged_from(rng, base, corpus)
        again = (lambda: Built(data, base.fields, base.spans)) if in_place else (lambda: _built(data))
        return FuzzCase(data, again, () if repaired else ("(not repaired)",))

    def attempt(self, data: bytes) -> tuple[str, str]:
        """Decode; occasionally with the other decoding functions, too, which must agree."""
        chance = zlib.crc32(data)
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("error")
                # One thread is three times faster on small files; occasionally use all.
                model = decoder.decode(data, limits=LIMITS, context=Context(threads=1 if chance % 16 else None))
                if len(model) > LIMITS.splats:
                    return "finding", "more splats than the limits permit"
                return _compare_decoders(data, len(model)) if chance % 8 == 1 else ("decoded", "")
        except CsplatError as error:
            return error.code, ""

    def smaller(self, data: bytes, corpus: Sequence[Built]) -> Generator[bytes, bytes | None, None]:
        """Restore changed bytes one by one, if the length is that of a seed."""
        same = [base for base in corpus if len(base.data) == len(data)]
        if not same:
            return
        base = min(same, key=lambda other: sum(a != b for a, b in zip(other.data, data, strict=True)))
        for at in [i for i in range(len(data)) if data[i] != base.data[i]]:
            kept = yield repair(data[:at] + base.data[at : at + 1] + data[at + 1 :], base.records)
            data = data if kept is None else kept

    def memory(self) -> str:
        """Return a line if another process exceeds its memory; there is none here."""
        return ""

    def coverage(self) -> str:
        """Return the coverage of other processes; there are none here."""
        return ""

    def close(self) -> None:
        """End other processes; there are none here."""


def missing_others() -> dict[str, str]:
    """Return the reasons why other decoders cannot run here, by language."""
    found = {"JavaScript": decoder_processes.missing_javascript(), "C": missing_c()}
    return {name: why for name, why in found.items() if why}


class OthersTarget(DecoderTarget):
    """The decoders in JavaScript and C, compared with the Python decoder.

    They must accept the same files and return the same arrays. Refusals with different codes are only counted.

    Args:
        scratch: folder for the coverage that Node writes.
        languages: languages of the decoders.
        memory_bytes: largest resident memory of a process.

    Attributes:
        decoders: decoders that can run here, by language.
        memory_bytes: largest resident memory of a process.
    """

    name = "others"

    def __init__(
        self,
        scratch: Path | None = None,
        *,
        languages: Sequence[str] = ("JavaScript", "C"),
        memory_bytes: int = _MEMORY,
    ) -> None:
        self._scratch = scratch
        self.memory_bytes = memory_bytes
        self.decoders: dict[str, DecoderProcess] = {}
        here = set(languages) - set(missing_others())
        if "JavaScript" in here:
            self.decoders["JavaScript"] = decoder_processes.JsDecoder(limits=JS_LIMITS, coverage=scratch)
        if "C" in here:
            self.decoders["C"] = CDecoder(limits=C_LIMITS)

    def attempt(self, data: bytes) -> tuple[str, str]:
        """Decode with all decoders and compare."""
        ours = adapter.answer(data, _SMALL, context=Context(threads=1))  # one thread, because others are not traced
        if ours.status not in (Status.PASSED, Status.REFUSED):
            return "finding", f"Python, {ours.status}: {ours.message}"
        became = {ours.code or "decoded"}
        for name, other in self.decoders.items():
            theirs = other.ask(data)
            if theirs.status not in (Status.PASSED, Status.REFUSED):
                return "finding", f"{name}, {theirs.status}: {theirs.message}"
            found, what = compared(ours, theirs, name)
            if what:
                return found, what
            became.add(found)
        return next(name for name in (_spec.ERROR_LIMIT, "another code", *became) if name in became), ""

    def memory(self) -> str:
        """Check the resident memory of the other processes."""
        held = {name: one.resident_bytes() for name, one in self.decoders.items()}
        return next((f"{name} holds {size:,} bytes" for name, size in held.items() if size > self.memory_bytes), "")

    def close(self) -> None:
        """End the processes; Node then writes its coverage."""
        for one in self.decoders.values():
            one.close()

    def coverage(self) -> str:
        """Return the fraction of the JavaScript decoder's text that ran."""
        return js_coverage(self._scratch) if self._scratch else ""


def _built(data: bytes) -> Built | None:
    """Return a rearranged file with its fields, if its index still locates its chunks."""
    try:
        found = built_from(data)
    except (ValueError, LookupError, struct.error):
        return None
    inside = all(
        offset + size <= len(data) and size >= _spec.CHUNK_HEADER_SIZE for offset, size in found.spans.values()
    )
    return found if inside else None


def _compare_decoders(data: bytes, count: int) -> tuple[str, str]:
    """Decode a valid file with the other decoding functions, which must accept it, too."""
    level_0 = range(len(decoder.read_header(data).tiles))  # `decode` leaves coarser tiles unread
    try:
        integers = decoder.decode_integers(data, limits=LIMITS, tiles=level_0, context=Context(threads=1))
        tiles = list(decoder.iter_tiles(data, limits=LIMITS))
    except CsplatError as error:
        if error.code == _spec.ERROR_LIMIT:  # a budget counts the bytes of the returned arrays, which differ
            return "decoded", ""
        return "finding", f"decode accepts a file that another function refuses: {error}"
    if not len(integers["means"]) == sum(len(tile.means) for tile in tiles) == count:
        return "finding", "decoding functions differ in the number of splats"
    return "decoded", ""


def compared(ours: Answer, theirs: Answer, name: str) -> tuple[str, str]:
    """Compare the answers of the Python decoder and of another one, with its name."""
    codes = (ours.code, theirs.code)
    if _spec.ERROR_LIMIT in codes:
        return _spec.ERROR_LIMIT, ""
    if ours.status != theirs.status:
        words = [f"{one.status} {one.code} {one.clause or ''}".strip() for one in (ours, theirs)]
        return "finding", f"Python {words[0]}, {name} {words[1]}"
    if ours.status is Status.REFUSED:
        return (ours.code if codes[0] == codes[1] else "another code"), ""
    if dict(ours.header) != dict(theirs.header):
        return "finding", f"{name}: the headers differ"
    differ = [key for key in {*ours.arrays, *theirs.arrays} if ours.arrays.get(key) != theirs.arrays.get(key)]
    return ("finding", f"{name}: arrays differ: {', '.join(sorted(differ))}") if differ else ("decoded", "")


def js_coverage(folder: Path) -> str:
    """Return the fraction of the decoder's text that ran, from the coverage that Node wrote to a folder."""
    ran: dict[str, bytearray] = {}
    home = decoder_processes.js_folder()
    for path in folder.glob("coverage-*.json"):
        for script in json.loads(path.read_text(encoding="utf-8"))["result"]:
            file = Path(script["url"].removeprefix("file://"))
            if file.parent != home or not file.exists():
                continue
            marks = bytearray(b"\1" * len(file.read_text(encoding="utf-8")))
            for function in script["functions"]:
                for part in function["ranges"]:
                    start, end = part["startOffset"], part["endOffset"]
                    marks[start:end] = bytes([part["count"] > 0]) * len(marks[start:end])
            old = ran.get(file.name, bytes(len(marks)))
            ran[file.name] = bytearray(a | b for a, b in zip(marks, old, strict=True))
    total = sum(map(len, ran.values()))
    covered = sum(sum(marks) for marks in ran.values())
    return f"{100 * covered / total:.1f} % of the text of {len(ran)} modules ran" if total else ""


class ValidatorTarget(DecoderTarget):
    """The validator, which must report a violation exactly for those files that the decoder refuses."""

    name = "validator"
    watched: Sequence[Path] = (Path(validator.__file__).parent,)

    def attempt(self, data: bytes) -> tuple[str, str]:
        """Decode and validate."""
        error: CsplatError | None = None
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            try:
                decoder.decode(data, limits=LIMITS, context=Context(threads=1))
                if decoder.read_header(data).coarse_tiles:
                    # reads the coarser levels, too
                    decoder.decode_integers(data, limits=LIMITS, context=Context(threads=1))
            except CsplatError as caught:
                error = caught
            if error is not None and error.code == _spec.ERROR_LIMIT:  # budgets are not part of the format
                return error.code, ""
            found = validator.validate(data, json_bytes_max=LIMITS.json_bytes, splats_max=LIMITS.splats)
        # SER-5, which decoders do not check, has no code.
        clauses = {one.clause for one in found.violations if one.code}
        if error is None:
            return (
                ("finding", f"decoded, but the validator reports {', '.join(sorted(clauses))}")
                if clauses
                else ("decoded", "")
            )
        clause = getattr(error, "clause", "")
        if not clauses:
            return "finding", f"refused with {error.code} ({clause}), but the validator reports nothing"
        # If several clauses are violated, the validator may attribute the damage to another one.
        return (error.code if clause in clauses else "another clause"), ""

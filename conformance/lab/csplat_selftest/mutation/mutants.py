# SPDX-License-Identifier: CC0-1.0
"""Mutants of a decoder, and their results with vectors and fuzzed files."""

from __future__ import annotations

import random
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from enum import StrEnum
from functools import cache
from typing import Any, Protocol

from csplat_conformance.answers import PARTS, Answer, compare_answer, compare_cuts, cuts_of_vector
from csplat_conformance.conformance_report import Status
from csplat_conformance.manifest import Vector, load
from csplat_selftest.fuzzing.decoder_targets import DecoderTarget

_SHOWN = 100  # characters of a piece of text


@dataclass(frozen=True)
class Mutant:
    """One change of a source file.

    Attributes:
        file: file name.
        line: line of the change, from 1.
        start: index of the first character of the old text.
        old: the old text: the smallest expression or statement that changes.
        new: its replacement.
    """

    file: str
    line: int
    start: int
    old: str
    new: str

    def apply(self, text: str) -> str:
        """Return the file's text with the change."""
        end = self.start + len(self.old)
        assert text[self.start : end] == self.old, f"{self.file} has changed"
        return text[: self.start] + self.new + text[end:]

    def lines(self, text: str) -> tuple[str, str]:
        """Return the changed lines of the file's text, before and after the change."""
        start, end = text.rfind("\n", 0, self.start) + 1, text.find("\n", self.start + len(self.old))
        return text[start:end], self.apply(text)[start : end - len(self.old) + len(self.new)]


class Fate(StrEnum):
    """The result of a mutant."""

    CAUGHT = "caught"  #: a vector fails
    MISSED = "missed"  #: all vectors pass, but a fuzzed file reveals a difference
    SAME = "same"  #: no file reveals a difference


@dataclass(frozen=True)
class MutantResult:
    """A mutant and its fate.

    Attributes:
        mutant: the mutant.
        fate: the result; other runners define their own.
        by: the vector, or the fuzzed file with the difference.
    """

    mutant: Mutant
    fate: StrEnum
    by: str = ""


class Decoder(Protocol):
    """A decoder and its mutants."""

    @property
    def texts(self) -> Mapping[str, str]:
        """The decoder's source files by name."""
        ...

    @property
    def mutants(self) -> Sequence[Mutant]:
        """All mutants."""
        ...

    def valid(self, mutant: Mutant) -> bool:
        """Return True if the mutant is a valid program."""
        ...

    def attempt(self, mutant: Mutant) -> MutantResult:
        """Run the vectors and, if all pass, the fuzzed files."""
        ...


def sample(decoder: Decoder, count: int, seed: int, only: str = "") -> list[Mutant]:
    """Choose random valid mutants, in the order of the files, of those whose file or line contains a text."""
    lines = {file: ["", *text.splitlines()] for file, text in decoder.texts.items()}
    mixed = [one for one in decoder.mutants if only in one.file or only in lines[one.file][one.line]]
    random.Random(seed).shuffle(mixed)  # noqa: S311 - repeatable, no secret
    chosen: list[Mutant] = []
    for mutant in mixed:
        if len(chosen) == count:
            break
        if decoder.valid(mutant):
            chosen.append(mutant)
    return sorted(chosen, key=lambda mutant: (mutant.file, mutant.start, mutant.new))


def score(results: Sequence[MutantResult]) -> float:
    """Return the percentage of caught mutants among those that show a difference."""
    counts = [sum(result.fate is fate for result in results) for fate in (Fate.CAUGHT, Fate.MISSED)]
    return 100.0 * counts[0] / max(1, sum(counts))


def table(
    results: Sequence[MutantResult],
    texts: Mapping[str, str],
    fates: Sequence[StrEnum] = (Fate.MISSED, Fate.SAME),
    seen: str = "seen in",
) -> str:
    """Return a Markdown table of the surviving mutants.

    Args:
        results: all results of a run.
        texts: source files by name.
        fates: the fates to list, in this order.
        seen: heading of the column `by`.
    """
    lines = [f"| fate | where | was | is | {seen} |", "|---|---|---|---|---|"]
    for fate in fates:
        for result in results:
            if result.fate is fate:
                one = result.mutant
                was, now = (f"`{_short(line)}`" for line in one.lines(texts[one.file]))
                cells = (fate, f"{one.file}:{one.line}", was, now, result.by)
                lines.append(f"| {' | '.join(cell.replace('|', chr(0xA6)) for cell in cells)} |")
    return "\n".join(lines)


def _short(text: str) -> str:
    line = " ".join(text.split())
    return line if len(line) <= _SHOWN else f"{line[: _SHOWN - 4]} ..."


#: Decodes a file.
Ask = Callable[[bytes], Answer]

_SHOWN_ANSWER = 100  # characters of an answer to show


@cache
def vectors() -> Sequence[tuple[Vector, bytes]]:
    """Return the vectors with their files. No refusal is optional, because our decoders read every chunk."""
    required = [replace(one, error=one.error | {"optional": ""}) if one.error else one for one in load()]
    return [(vector, vector.data) for vector in required]


def failing(ask: Ask) -> str:
    """Return the name of the first vector that fails, or an empty string. Codes of refusals are not compared."""
    for vector, data in vectors():
        outcomes = compare_answer(vector, ask(data), tuple(PARTS))
        if not all(one.good for one in outcomes):
            return vector.name
    return ""


def failing_cuts(ask: Callable[[Vector], Answer]) -> str:
    """Return the name of the first vector whose cuts fail, or an empty string.

    Args:
        ask: selects the tiles of the cuts of a vector.
    """
    chosen = (vector for vector, _ in vectors() if cuts_of_vector(vector))
    return next((f"cuts of {vector.name}" for vector in chosen if not compare_cuts(vector, ask(vector)).good), "")


def fuzzed(count: int, seed: int) -> list[bytes]:
    """Return damaged files, most of them with their checksums repaired."""
    target, rng = DecoderTarget(), random.Random(seed)  # noqa: S311 - repeatable, no secret
    corpus = target.seeds(())
    return [target.case(rng, corpus).data for _ in range(count)]


def verdict(answer: Answer) -> Any:
    """Return the parts of an answer to compare, without the reason of a refusal."""
    return (answer.status, *((dict(answer.header), dict(answer.arrays)) if answer.status is Status.PASSED else ()))


def difference(ask: Ask, files: Sequence[bytes], expected: Sequence[Any]) -> str:
    """Return a line about the first file with another verdict than expected, or an empty string."""
    for number, (data, right) in enumerate(zip(files, expected, strict=True)):
        answer = ask(data)
        if verdict(answer) != right:
            words = f"{answer.status} {answer.code} {answer.message}"[:_SHOWN_ANSWER].strip()
            return f"file {number}: {words}, expected {right[0]}"
    return ""

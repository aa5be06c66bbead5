"""Run mutants on the vectors, and those that pass on fuzzed files."""

from __future__ import annotations

import random
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cache
from typing import Any

from csplat_conformance.answers import PARTS, Answer, compare_answer
from csplat_conformance.conformance_report import Status
from csplat_conformance.manifest import Vector, load
from csplat_selftest.fuzzing.targets import DecoderTarget

#: Decodes a file.
Ask = Callable[[bytes], Answer]

_WORDS = 100  # characters of an answer that are shown


@cache
def vectors() -> Sequence[tuple[Vector, bytes]]:
    """Return the vectors with their files. These decoders read every chunk: what another one may accept they refuse."""
    wanted = [replace(one, error=one.error | {"optional": ""}) if one.error else one for one in load()]
    return [(vector, vector.data) for vector in wanted]


def failing(ask: Ask) -> str:
    """Return the name of the first vector that fails, or nothing. Of refusals the code does not count."""
    for vector, data in vectors():
        outcomes = compare_answer(vector, ask(data), tuple(PARTS))
        if not all(one.good for one in outcomes):
            return vector.name
    return ""


def fuzzed(count: int, seed: int) -> list[bytes]:
    """Return damaged files, most of them with their checksums repaired."""
    target, rng = DecoderTarget(), random.Random(seed)  # noqa: S311 - repeatable, no secret
    corpus = target.seeds(())
    return [target.mutant(rng, corpus).data for _ in range(count)]


def verdict(answer: Answer) -> Any:
    """Return what counts of an answer: why a file is refused does not."""
    return (answer.status, *((dict(answer.header), dict(answer.arrays)) if answer.status is Status.PASSED else ()))


def difference(ask: Ask, files: Sequence[bytes], wanted: Sequence[Any]) -> str:
    """Return where a decoder first differs from what is wanted, or nothing."""
    for number, (data, right) in enumerate(zip(files, wanted, strict=True)):
        answer = ask(data)
        if verdict(answer) != right:
            words = f"{answer.status} {answer.code} {answer.message}"[:_WORDS].strip()
            return f"file {number}: {words} for {right[0]}"
    return ""

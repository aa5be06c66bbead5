# SPDX-License-Identifier: CC0-1.0
"""Mutate single operators of a decoder or a package, and list the mutants that vectors or tests miss.

Usage:
    python -m csplat_selftest.mutation                                  # 400 mutants of the Python decoder
    python -m csplat_selftest.mutation --decoder javascript --jobs 2    # requires node, and `npm ci` before
    python -m csplat_selftest.mutation --decoder c                      # requires cc
    python -m csplat_selftest.mutation --package csplat.encoder --count 60 --out before.json    # judged by tests
    python -m csplat_selftest.mutation --package csplat.encoder --from before.json --out after.json

Vectors judge a decoder. A mutant is caught if a vector fails. Mutants that pass all vectors also decode fuzzed files.
If a mutant differs from the original decoder there, the vectors miss it. The remaining mutants may be equivalent,
beyond the reach of vectors, or rarely different. Code and clause of a refusal are not compared, as for other decoders.

Tests judge a package (`packages.py`). `--from` judges the mutants of an earlier run again, after a change of tests.
"""

from __future__ import annotations

import argparse
import multiprocessing
import os
import sys
import time
from collections import Counter
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Final

from csplat.errors import InputError
from csplat_selftest.mutation.decoders import NO_FORK, JavaScriptDecoder, NativeDecoder, PythonDecoder
from csplat_selftest.mutation.mutants import Decoder, Fate, Mutant, MutantResult, fuzzed, sample, score, table, vectors
from csplat_selftest.mutation.packages import Checkout, JudgedMutant, read_mutants, write_mutants

_FILES = 2000
_DECODERS: Final[dict[str, Callable[[Sequence[bytes]], Decoder]]] = {
    "python": PythonDecoder,
    "javascript": JavaScriptDecoder,
    "c": NativeDecoder,
}
_decoder: Decoder  # set before workers are forked, which inherit it


def main() -> int:
    """Print the surviving mutants and the score."""
    parser = argparse.ArgumentParser(
        prog="csplat_selftest.mutation", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--decoder", choices=(*_DECODERS,), default="python")
    parser.add_argument("--count", type=int, default=400, help="number of mutants (default 400)")
    parser.add_argument(
        "--only", metavar="TEXT", default="", help="mutants of files or of lines that contain this text"
    )
    parser.add_argument("--seed", type=int, default=0, help="seed of the choice of mutants (default 0)")
    parser.add_argument("--jobs", type=int, default=1, help="parallel processes (default 1)")
    packages = parser.add_argument_group("mutants of packages, judged by tests")
    packages.add_argument("--package", help="csplat.encoder, csplat_trainer or another package of the project")
    packages.add_argument("--root", type=Path, default=Path(), help="checkout (default: the current folder)")
    packages.add_argument("--work", type=Path, default=Path("out", "mutation"), help="folder for copies and map")
    packages.add_argument("--from", dest="earlier", type=Path, metavar="FILE", help="judge the mutants of this file")
    packages.add_argument("--out", type=Path, metavar="FILE", help="write mutants and verdicts as JSON")
    args = parser.parse_args()
    if args.package:
        return _packages(args)
    if not hasattr(os, "fork"):
        sys.stderr.write(f"error: {NO_FORK}\n")
        return 1
    global _decoder  # noqa: PLW0603 - forked workers inherit it; it cannot be pickled as an argument
    try:
        _decoder = _DECODERS[args.decoder](fuzzed(_FILES, args.seed))
        chosen = sample(_decoder, args.count, args.seed, args.only)
    except InputError as error:
        sys.stderr.write(f"error: {error}\n")
        return 1
    vectors()  # read them once, before the workers are forked
    results = _all(chosen, args.jobs)
    counts = {fate: sum(result.fate is fate for result in results) for fate in Fate}
    words = ", ".join(f"{count} {fate}" for fate, count in counts.items())
    sys.stdout.write(f"{table(results, _decoder.texts)}\n\n")
    sys.stdout.write(f"{args.decoder}: {len(chosen)} of {len(_decoder.mutants)} mutants: {words}\n")
    sys.stdout.write(f"{score(results):.1f} % of the mutants that show a difference are caught\n")
    return 0


def _packages(args: argparse.Namespace) -> int:
    """Judge mutants of a package by its tests; print survivors and counts."""
    checkout = Checkout(args.root.resolve(), args.work.resolve())
    try:
        drawn = read_mutants(args.earlier) if args.earlier else checkout.draw(args.package, args.count, args.seed)
    except InputError as error:
        sys.stderr.write(f"error: {error}\n")
        return 1
    judged: list[JudgedMutant] = []
    for one in checkout.judge(drawn, args.jobs):
        judged.append(one)
        sys.stderr.write(f"\r{len(judged)} of {len(drawn)}: {one.verdict} {one.file} {one.line.strip()[:50]:50}")
        if args.out:
            write_mutants(args.out, judged)
    sys.stderr.write("\n")
    was = {replace(one, verdict="", by="", is_unmarked=False, left_out=0): one.verdict for one in drawn}
    for one in judged:
        before = was[replace(one, verdict="", by="", is_unmarked=False, left_out=0)]
        if one.verdict != "caught":
            note = f" (was {before})" if before else ""
            sys.stdout.write(f"{one.verdict}{note}: {one.file}: {one.line.strip()}: `{one.old}` -> `{one.new}`\n")
    counts = Counter(one.verdict for one in judged)
    unmarked = sum(one.is_unmarked for one in judged)
    sys.stdout.write(f"{args.package}: {dict(counts)}; {unmarked} caught by unmarked tests\n")
    return 0


def _all(mutants: Sequence[Mutant], jobs: int) -> list[MutantResult]:
    results, began = [], time.monotonic()
    with ProcessPoolExecutor(jobs, multiprocessing.get_context("fork")) as pool:
        for result in pool.map(_attempt, mutants):
            results.append(result)
            survivors = sum(one.fate is not Fate.CAUGHT for one in results)
            seconds = time.monotonic() - began
            sys.stderr.write(f"\r{len(results)} of {len(mutants)}, {survivors} survive, {seconds:.0f} s")
            sys.stderr.flush()
    sys.stderr.write("\n")
    return results


def _attempt(mutant: Mutant) -> MutantResult:
    return _decoder.attempt(mutant)


if __name__ == "__main__":
    sys.exit(main())

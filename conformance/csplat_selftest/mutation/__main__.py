"""Mutate single operators of a decoder, and list the mutants that the vectors miss.

Usage:
    python -m csplat_selftest.mutation                                  # 400 mutants of the Python decoder
    python -m csplat_selftest.mutation --decoder javascript --jobs 2    # requires node, and `npm ci` before
    python -m csplat_selftest.mutation --decoder c                      # requires cc

A mutant is caught if a vector fails. Mutants that pass all vectors also decode fuzzed files. If a mutant differs from
the original decoder there, the vectors miss it. The remaining mutants may be equivalent, beyond the reach of vectors,
or rarely different. Code and clause of a refusal are not compared, as for other decoders.
"""

from __future__ import annotations

import argparse
import multiprocessing
import os
import sys
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from typing import Final

from csplat.errors import InputError
from csplat_selftest.mutation.decoders import NO_FORK, JavaScriptDecoder, NativeDecoder, PythonDecoder
from csplat_selftest.mutation.mutants import Decoder, Fate, Mutant, MutantResult, fuzzed, sample, score, table, vectors

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
    args = parser.parse_args()
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

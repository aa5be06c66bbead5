"""Change a decoder operator by operator, one change at a time: which changes do the vectors miss?

Usage:
    python -m csplat_selftest.mutation                                  # 400 mutants of the Python decoder
    python -m csplat_selftest.mutation --decoder javascript --jobs 2    # requires node, and `npm ci` before
    python -m csplat_selftest.mutation --decoder c                      # requires cc

A mutant is caught if a vector fails. Whatever passes them all reads damaged files, too: one that differs from the
right decoder there is missed by the vectors; the others may be equivalent, or out of the vectors' reach, or show
themselves too rarely. Neither code nor clause of a refusal counts, as for any decoder that is not ours.
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
from csplat_selftest.mutation.javascript import JavaScriptDecoder
from csplat_selftest.mutation.mutants import Decoder, Fate, Mutant, MutantResult, fuzzed, sample, score, table, vectors
from csplat_selftest.mutation.native import NativeDecoder
from csplat_selftest.mutation.python import NO_FORK, PythonDecoder

_FILES = 2000
_DECODERS: Final[dict[str, Callable[[Sequence[bytes]], Decoder]]] = {
    "python": PythonDecoder,
    "javascript": JavaScriptDecoder,
    "c": NativeDecoder,
}
_decoder: Decoder  # the decoder of a worker, which is forked with it


def main() -> int:
    """Print the survivors and the score."""
    parser = argparse.ArgumentParser(
        prog="csplat_selftest.mutation", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--decoder", choices=(*_DECODERS,), default="python")
    parser.add_argument("--count", type=int, default=400, help="mutants (default 400)")
    parser.add_argument("--seed", type=int, default=0, help="of the choice of mutants")
    parser.add_argument("--jobs", type=int, default=1, help="processes at a time (default 1)")
    args = parser.parse_args()
    if not hasattr(os, "fork"):
        sys.stderr.write(f"error: {NO_FORK}\n")
        return 1
    global _decoder  # noqa: PLW0603 - workers get it by the fork, which no argument can do
    try:
        _decoder = _DECODERS[args.decoder](fuzzed(_FILES, args.seed))
        chosen = sample(_decoder, args.count, args.seed)
    except InputError as error:
        sys.stderr.write(f"error: {error}\n")
        return 1
    vectors()  # read before the workers are forked, each of which would read them
    results = _all(chosen, args.jobs)
    counts = {fate: sum(result.fate is fate for result in results) for fate in Fate}
    words = ", ".join(f"{count} {fate}" for fate, count in counts.items())
    sys.stdout.write(f"{table(results, _decoder.texts)}\n\n")
    sys.stdout.write(f"{args.decoder}: {len(chosen)} of {len(_decoder.mutants)} mutants: {words}\n")
    sys.stdout.write(f"{score(results):.1f} % of those that show a difference are caught\n")
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

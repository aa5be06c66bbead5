"""Flip bits of valid files and truncate them, and check that the validator detects every damage.

Usage:
    python -m csplat_selftest.fuzzing.bit_flips scene.csplat ...            # 250 flipped bits each, and 250 prefixes
    python -m csplat_selftest.fuzzing.bit_flips scene.csplat --flips 1000 --prefixes 0 --seed 7

Flipped bits have two rows: one for the damaged file, and one with all checksums repaired, so that only structure and
values can reveal the damage. In the second row, a flip may result in another valid file: a colour that is one step
greener violates no clause. The exit status is 1 if a flip of the first row, or a prefix, is not detected.
"""

from __future__ import annotations

import argparse
import random
import sys
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

from csplat_authoring.builder import chunk_records, repair
from csplat_conformance.validator import validate

_CLAUSES_SHOWN = 6


@dataclass
class DamageStatistics:
    """Statistics of damaged files.

    Attributes:
        what: kind of damage.
        count: number of files.
        found: number of files in which the validator finds a violation.
        clauses: number of files by violated clause.
        missed: bits or lengths of the damages that the validator did not find.
    """

    what: str
    count: int = 0
    found: int = 0
    clauses: Counter[str] = field(default_factory=Counter)
    missed: list[int] = field(default_factory=list)

    def add(self, damage: int, data: bytes | bytearray) -> None:
        """Validate a damaged file."""
        violations = validate(data).violations
        self.count += 1
        self.found += bool(violations)
        self.clauses.update({one.clause for one in violations})
        if not violations:
            self.missed.append(damage)


def flip(data: bytes, bit: int) -> bytearray:
    """Return the file with one bit flipped; bit 0 is the lowest bit of byte 0."""
    damaged = bytearray(data)
    damaged[bit // 8] ^= 1 << bit % 8
    return damaged


def flips(
    data: bytes, count: int, seed: int, progress: Callable[[str, int], None] | None = None
) -> tuple[DamageStatistics, DamageStatistics]:
    """Flip `count` different bits, one at a time.

    Args:
        data: a valid file.
        count: number of flips, at most the number of bits.
        seed: seed of the choice.
        progress: called with the stage and the number of completed flips.

    Returns:
        Statistics without and with repaired checksums.
    """
    chosen = random.Random(seed).sample(range(8 * len(data)), min(count, 8 * len(data)))  # noqa: S311 - repeatable, no secret
    result = (DamageStatistics("flipped bits"), DamageStatistics("all checksums repaired"))
    records = chunk_records(data)
    for number, bit in enumerate(chosen):
        damaged = flip(data, bit)
        result[0].add(bit, damaged)
        result[1].add(bit, repair(bytes(damaged), records))
        if progress is not None:
            progress("flips", number + 1)
    return result


def prefixes(data: bytes, count: int, progress: Callable[[str, int], None] | None = None) -> DamageStatistics:
    """Truncate the file to `count` evenly spread lengths from 0 to all but one byte, or to all lengths if fewer."""
    last = len(data) - 1
    lengths = range(len(data)) if count > last else sorted({i * last // max(1, count - 1) for i in range(count)})
    result = DamageStatistics("prefixes")
    for number, length in enumerate(lengths):
        result.add(length, data[:length])
        if progress is not None:
            progress("prefixes", number + 1)
    return result


def main() -> int:
    """Test the files of the command line and print the statistics."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("files", nargs="+", type=Path, help="valid .csplat files")
    parser.add_argument("--flips", type=int, default=250, help="bits to flip per file (default 250)")
    parser.add_argument("--prefixes", type=int, default=250, help="prefixes to test per file (default 250)")
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args()
    good = True
    for path in args.files:
        data = path.read_bytes()
        sound = validate(data)
        if not sound.conforms:
            sys.stderr.write(f"error: {path} is not valid: {sound.violations[0]}\n")
            return 1
        rows = [*flips(data, args.flips, args.seed, _tick), prefixes(data, args.prefixes, _tick)]
        sys.stdout.write(f"{path.name}, {len(data)} bytes\n")
        sys.stdout.writelines(_line(row) for row in rows)
        good &= all(not row.missed for row in (rows[0], rows[2]))
    return 0 if good else 1


def _tick(stage: str, done: int) -> None:
    if sys.stderr.isatty():
        sys.stderr.write(f"\r{stage} {done}\x1b[K")
        sys.stderr.flush()


def _line(row: DamageStatistics) -> str:
    often = ", ".join(f"{clause} {count}" for clause, count in row.clauses.most_common(_CLAUSES_SHOWN))
    return f"  {row.what:<24}{row.found:>6} of {row.count:<6} found; {often}\n"


if __name__ == "__main__":
    sys.exit(main())

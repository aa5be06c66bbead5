"""Everything that can be measured on a scene: rows by kind and name."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

from csplat.encoder import EncodeOptions, EncodePlan, fix_quantisation
from csplat_bench.common.captures import Training
from csplat_bench.common.kept import Kept
from csplat_bench.compression.ablation import ablation
from csplat_bench.compression.controls import control, eight_bits
from csplat_bench.compression.rows import Facts, Row
from csplat_bench.compression.runs import Bench
from csplat_trainer.sensitivity import measure_sensitivity
from csplat_trainer.tuning import FinetuneOptions, tune

#: Kinds of rows.
KINDS = ("main", "control", "others", "sizes", "escapes", "positions", "curve")

Job = tuple[str, str, Callable[[], object]]


@dataclass(frozen=True)
class Lists:
    """Values of the parameters that are varied.

    Attributes:
        sizes: numbers of entries of both codebooks.
        escapes: shares of the splats that keep values of their own (0 to 1).
        bits: bits of positions, per axis.
        keep: shares of the splats that are kept if the scene is simplified first.
    """

    sizes: Sequence[int]
    escapes: Sequence[float]
    bits: Sequence[int]
    keep: Sequence[float]


def variants(encoding: EncodeOptions, lists: Lists) -> dict[tuple[str, str], EncodeOptions]:
    """Return encoder options that differ from the given ones, by kind and name of the row.

    Raises:
        InputError: an option is out of its range.
    """
    books = replace(encoding, sh_coding="codebook")
    found = {("sizes", f"{n:,}"): replace(books, codebook_size=n, shape_codebook_size=n) for n in lists.sizes}
    for share in lists.escapes:
        found["escapes", f"SH {100 * share:g} %"] = replace(books, escape_fraction=share)
    for share in lists.escapes:
        found["escapes", f"shapes {100 * share:g} %"] = replace(encoding, shape_escape_fraction=share)
    found |= {("positions", f"{bits} bits"): replace(encoding, position_bits=bits) for bits in lists.bits}
    without = replace(encoding, shape_codebook_size=None)
    found["others", "no codebook of shapes"] = without
    found["others", "no codebooks"] = replace(without, sh_coding="scalar")
    return found


def find_jobs(bench: Bench, kept: Kept, lists: Lists) -> list[Job]:
    """Everything that can be measured: its kind, its name, how."""
    jobs: list[Job] = [
        ("main", "main", partial(_main, bench, kept)),
        ("control", "main", partial(control, bench)),
        ("others", "8 bits", lambda: bench.row(bench.tuned(eight_bits(bench.chosen()[0].model, bench.encoding)))),
        ("others", "no sensitivities", lambda: bench.row(bench.tuned(bench.encoding, bench.chosen(told=False)))),
    ]
    jobs += [(*name, partial(_row, bench, encoding)) for name, encoding in variants(bench.encoding, lists).items()]
    jobs += [("curve", f"keep {keep:g}", partial(_row, bench, bench.encoding, keep)) for keep in lists.keep]
    return jobs


def _row(bench: Bench, encoding: EncodeOptions, keep: float | None = None) -> Row:
    return bench.row(bench.tuned(encoding, None if keep is None else bench.chosen(keep)))


def _main(bench: Bench, kept: Kept) -> Row:
    tuned = bench.tuned(bench.encoding)
    row = bench.row(tuned)
    kept.measure("ablation", "main", partial(ablation, bench, tuned))
    return row


def facts_of(bench: Bench, training: Training) -> Facts:
    """Return the facts that tables show of the scene and its training."""
    return {
        "splats": len(bench.source),
        "sh_degree": bench.source.sh_degree,
        "train_views": len(bench.looks.training),
        "test_views": len(bench.looks.test),
        "scores": bench.judge({"source": bench.source})["source"],
        "training": training,
    }


def warm(bench: Bench) -> None:
    """Compile what a tuning runs: no row is to pay for it."""
    some = bench.source.select(slice(0, 500))
    options = EncodeOptions(sh_coding="codebook", codebook_size=16, threads=bench.threads)
    fixed = fix_quantisation(EncodePlan.of(some, options, allow_classes=False))
    tune(fixed, bench.views, FinetuneOptions(iterations=1), threads=bench.threads)
    measure_sensitivity(some, bench.looks.training[:1], metric=True)

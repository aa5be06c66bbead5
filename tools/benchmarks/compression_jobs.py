"""Everything that `compression.py` can measure on a scene: rows by kind and name."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from typing import Any

from compression_ablation import ablation
from compression_controls import control, eight_bits, histogram, sh0_rows
from compression_runs import Bench
from compression_scenes import Kept

from csplat.encoder import Draft, EncodeOptions
from csplat_trainer.finetune import FinetuneOptions, finetune
from csplat_trainer.sensitivity import measure_sensitivity

__all__ = ["Ways", "facts_of", "find_jobs", "find_ways", "warm"]

Ways = dict[str, dict[str, EncodeOptions]]
Job = tuple[str, str, Callable[[], Any]]

_SH0_ESCAPES = 0.05  # the most that the publication keeps out of clustering


def find_ways(args: argparse.Namespace, encoding: EncodeOptions) -> Ways:
    """What the encoder is told, by kind and name of the row.

    Raises:
        InputError: an option is out of its range.
    """
    books = replace(encoding, sh_coding="codebook")
    return {
        "sizes": {f"{n:,}": replace(books, codebook_size=n, shape_codebook_size=n) for n in args.sizes},
        "escapes": {
            **{f"SH {100 * share:g} %": replace(books, escape_fraction=share) for share in args.escapes},
            **{f"shapes {100 * share:g} %": replace(encoding, shape_escape_fraction=share) for share in args.escapes},
        },
        "positions": {f"{bits} bits": replace(encoding, position_bits=bits) for bits in args.bits},
        "curve": {
            f"quality {decibels:g}": replace(encoding, attribute_psnr=decibels)
            for decibels in (*args.qualities, *(decibels for _, decibels in args.both))
        },
        "others": {
            "no codebook of shapes": replace(encoding, shape_codebook_size=None),
            "no codebooks": replace(encoding, shape_codebook_size=None, sh_coding="scalar"),
        },
    }


def find_jobs(bench: Bench, kept: Kept, ways: Ways, args: argparse.Namespace) -> Iterator[Job]:
    """Everything that can be measured: its kind, its name, how."""
    yield "main", "main", partial(_main, bench, kept)
    yield "control", "main", partial(control, bench)
    yield "histogram", "main", lambda: histogram(bench.sensitivity)
    yield "others", "8 bits", lambda: bench.row(bench.tuned(eight_bits(bench.chosen()[0].model, bench.encoding)))
    yield "others", "no sensitivities", lambda: bench.row(bench.tuned(bench.encoding, bench.chosen(told=False)))
    for size in args.sizes:
        yield "sh0", f"{size}", partial(sh0_rows, bench, size, _SH0_ESCAPES)
    for kind, rows in ways.items():
        for name, encoding in rows.items():
            yield kind, name, partial(_row, bench, encoding)
    for keep in args.keep:
        yield "curve", f"keep {keep:g}", partial(_row, bench, bench.encoding, keep)
    for keep, decibels in args.both:
        encoding = replace(bench.encoding, attribute_psnr=decibels)
        yield "curve", f"keep {keep:g}, quality {decibels:g}", partial(_row, bench, encoding, keep)


def _row(bench: Bench, encoding: EncodeOptions, keep: float | None = None) -> dict[str, Any]:
    return bench.row(bench.tuned(encoding, None if keep is None else bench.chosen(keep)))


def _main(bench: Bench, kept: Kept) -> dict[str, Any]:
    tuned = bench.tuned(bench.encoding)
    row = bench.row(tuned)
    kept.measure("ablation", "main", lambda: ablation(bench, tuned))
    bench.picture(tuned, kept.path.with_suffix(".png"))
    return row


def facts_of(bench: Bench, training: dict[str, Any]) -> dict[str, Any]:
    """What tables say of the scene itself, and of its training."""
    return {
        "splats": len(bench.source),
        "sh_degree": bench.source.sh_degree,
        "train_views": len(bench.looks.teaches),
        "test_views": len(bench.looks.judges),
        "scores": bench.judge({"source": bench.source})["source"],
        "training": training,
    }


def warm(bench: Bench) -> None:
    """Compile what a tuning runs: no row is to pay for it."""
    some = bench.source.select(slice(0, 500))
    options = EncodeOptions(sh_coding="codebook", codebook_size=16, threads=bench.threads)
    frozen = Draft.of(some, options, graded=False).frozen()
    finetune(frozen, bench.views, FinetuneOptions(iterations=1), threads=bench.threads)
    measure_sensitivity(some, bench.looks.teaches[:1], metric=True)

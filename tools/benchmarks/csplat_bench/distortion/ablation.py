"""Measure what each part of the search for a target is worth: its files with all parts, and without each of them.

    python -m csplat_bench.distortion.ablation                     # four scenes at 34 and 40 dB; an hour on two cores
    python -m csplat_bench.distortion.ablation --scenes plane3 --psnr 40
    python -m csplat_bench.distortion.ablation --tables --markdown # print what was measured

Files are those of `csplat encode --target-psnr`. What was measured is kept scene by scene in
tools/benchmarks/results/ablation/NAME.json: an interrupted run continues where it stopped; --again forgets.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Mapping
from contextlib import ExitStack
from dataclasses import dataclass, field
from functools import partial
from types import ModuleType
from typing import Annotated, Any, TypedDict
from unittest.mock import patch

import typer

from csplat.encoder import EncodeOptions
from csplat.model import SplatModel
from csplat.ply import read_ply
from csplat_bench.common.command import AGAIN, MARKDOWN, OUT, SCENES, TABLES, listed, numbers, run
from csplat_bench.common.kept import Kept, read_kept
from csplat_bench.common.report import Table, laid_out, tell_machine
from csplat_bench.common.scenes import ROOT, find_scenes
from csplat_tools.optimise import precision_search, splat_refit, subsets, target_search
from csplat_tools.optimise.pruning_order import SimplifyOptions
from csplat_tools.optimise.target_encoding import encode_to

_SCENES = "plane3,donut,lego60k,fox120k"
_KEPT = ROOT / "tools" / "benchmarks" / "results" / "ablation"


@dataclass(frozen=True)
class _Without:
    """A search that lacks a part: by options, or by what stands in for something of a module.

    Attributes:
        simplifying, encoding: options that are not the usual ones.
        no_prune: no splat goes.
        instead: replacement of something that the search calls or reads, with its module and name.
        sh: the part is one of scenes with SH alone.
    """

    simplifying: Mapping[str, Any] = field(default_factory=dict)
    encoding: Mapping[str, Any] = field(default_factory=dict)
    no_prune: bool = False
    instead: tuple[tuple[ModuleType, str, object], ...] = ()
    sh: bool = False


#: By what a search is without.
_WITHOUT = {
    "nothing": _Without(),
    "adjustment through quantisers": _Without(
        instead=(
            (subsets, "quantisation_aware_refit", lambda fixed, *_, **__: fixed.start()),
            (target_search, "REFIT_GAIN", 0.0),
            (precision_search, "REFIT_GAIN", 0.0),
        )
    ),
    "price of bits in it": _Without(instead=((splat_refit, "rate_exponent", lambda _: math.inf),)),
    "grades": _Without(encoding={"max_classes": 1}),
    "bands by splat": _Without(simplifying={"bands": False}, sh=True),
    "any fit": _Without(simplifying={"refit": False}),
    "removal": _Without(no_prune=True),
}


class Found(TypedDict):
    """A file: how large, how good by the views that judge and by others, and how many were made for it."""

    size_bytes: int
    psnr: float
    elsewhere: dict[str, float]
    splats: int
    encodes: int


def main(
    *,
    scenes: SCENES = _SCENES,
    psnr: Annotated[str, typer.Option(help="dB, separated by commas")] = "34,40",
    again: AGAIN = False,
    tables: TABLES = False,
    markdown: MARKDOWN = False,
    out: OUT = _KEPT,
) -> None:
    """Measure what the command line names; print tables of all that is known."""
    if not tables:
        machine = tell_machine()
        for scene in find_scenes(listed(scenes)):
            source, kept = read_ply(scene.path), Kept(out / f"{scene.name}.json", again=again)
            kept.values["machine"] = machine
            for goal in numbers(psnr, float):
                for name, without in _WITHOUT.items():
                    if source.sh_degree or not without.sh:
                        kept.measure(f"{goal:g} dB", name, partial(_found, source, goal, without))
    known = {name: one for name, one in read_kept(out).items() if name in listed(scenes)}
    whats = [(goal, what) for goal in numbers(psnr, float) for what in ("kB", "splats")]
    print(laid_out([_table(known, goal, what) for goal, what in whats], markdown=markdown))


def _found(source: SplatModel, goal: float, without: _Without) -> Found:
    """The file of a search that lacks a part."""
    with ExitStack() as stands:
        for module, name, value in without.instead:
            stands.enter_context(patch.object(module, name, value))
        found = encode_to(
            source, psnr=goal, options=EncodeOptions(**without.encoding), no_prune=without.no_prune,
            simplifying=SimplifyOptions(**without.simplifying),
        )  # fmt: skip
    chosen = found.report.chosen
    return {
        "size_bytes": len(found.data),
        "psnr": chosen["psnr"],
        "elsewhere": dict(found.report.elsewhere),
        "splats": chosen["splats"],
        "encodes": found.report.encodes,
    }


def _table(known: Mapping[str, Mapping[str, Any]], goal: float, what: str) -> Table:
    """Kilobytes or splats of each scene's file at a PSNR, without each part."""
    measured: dict[str, Mapping[str, Found]] = {name: one.get(f"{goal:g} dB", {}) for name, one in known.items()}
    measured = {name: files for name, files in measured.items() if files}
    rows = []
    for without in _WITHOUT if measured else ():
        cells = [_cell(files.get(without), files.get("nothing"), what) for files in measured.values()]
        rows.append((without, *cells))
    return Table((f"{what} at {goal:g} dB without", *measured), rows)


def _cell(found: Found | None, whole: Found | None, what: str) -> str:
    if found is None:
        return "–"
    if what == "splats":
        return f"{found['splats']:,}"
    beside = "" if whole is None or found is whole else f" ({found['size_bytes'] / whole['size_bytes'] - 1.0:+.0%})"
    return f"{found['size_bytes'] / 1e3:.1f}{beside}"


if __name__ == "__main__":
    sys.exit(run(main))

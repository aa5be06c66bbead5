"""Measure targets: bytes, PSNR and seconds, compared with presets, fixed shares of the splats, and another build.

    python -m csplat_bench.targets                                  # what is missing; hours on two cores
    python -m csplat_bench.targets --scenes plane3,donut --psnr 38 --sizes 4,8
    python -m csplat_bench.targets --build before --csplat OTHER/.venv/bin/csplat --removal=--simplify
    python -m csplat_bench.targets --tables --markdown              # print what was measured

Every file is written by the command line in a process of its own, and judged from sixteen virtual cameras that no
search consults: those of `psnr`, but for the seed. What was measured is kept in .../results/targets/NAME.json,
file by file: an interrupted run continues where it stopped. A row is *beaten* if another file of the same scene is
smaller by more than 1 % and better by more than 0.1 dB; files that hold every splat are compared among themselves.
"""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import typer

from csplat.decoder import decode
from csplat.encoder import PRESETS
from csplat.errors import InputError
from csplat.ply import read_ply
from csplat_bench.common.command import MARKDOWN, SCENES, TABLES, listed, run
from csplat_bench.common.kept import Kept, read_kept
from csplat_bench.common.report import describe
from csplat_bench.common.scenes import ROOT, Scene, find_scenes
from csplat_bench.targets.tables import Build, File, tables
from csplat_render.scorer import Scorer
from csplat_render.virtual_cameras import virtual_cameras
from csplat_tools.console import note
from csplat_tools.views import BLACK

_SCENES = "plane3,horse,donut,jacket,lego60k,fox60k_noreg,angel,fox120k,st-peter,statue"  # the quick ones first
_KEEPS = (0.7, 0.5)
_SEEDS = (1, 2)  # seeds of the judging cameras; targets themselves use seed 0
_KEPT = ROOT / "tools" / "benchmarks" / "results" / "targets"
_CSPLAT = str(Path(sys.executable).with_name("csplat"))


@dataclass(frozen=True)
class Row:
    """A file to make.

    Attributes:
        name: unique in its scene.
        arguments: arguments of `csplat encode`.
        all_splats: whether every splat of the source is kept.
    """

    name: str
    arguments: Sequence[str]
    all_splats: bool


def main(
    *,
    scenes: SCENES = _SCENES,
    with_removal: Annotated[
        str, typer.Option(help="scenes with rows that remove splats")
    ] = "plane3,horse,jacket,lego60k",
    psnr: Annotated[str, typer.Option(help="dB")] = "30,34,38,42,46",
    sizes: Annotated[str, typer.Option(help="bytes per splat of the source, as 4,8")] = "",
    build: Annotated[str, typer.Option(help="under which name rows are kept")] = "now",
    csplat: Annotated[str, typer.Option(help="the program measured")] = _CSPLAT,
    removal: Annotated[str, typer.Option(help="option with which that program's targets remove splats")] = "",
    again: Annotated[bool, typer.Option("--again", help="forget this build's rows of these scenes")] = False,
    show: TABLES = False,
    markdown: MARKDOWN = False,
    kept: Annotated[Path, typer.Option(help="folder where rows are kept")] = _KEPT,
) -> None:
    """Measure what the command line names, and print the tables."""
    names, fewer = listed(scenes), listed(with_removal)
    if not show:
        if shutil.which(csplat) is None:
            raise InputError(f"no such program: {csplat}")
        for scene in find_scenes(names):
            rows = list(_rows(scene, listed(psnr), listed(sizes)))
            rows += _removing(rows, listed(removal)) if scene.name in fewer else []
            _measure(scene, rows, Kept(kept / f"{scene.name}.json"), build, csplat, again=again)
    known = read_kept(kept)
    print(tables({name: known[name] for name in names if name in known}, markdown=markdown))


def _rows(scene: Scene, psnrs: Sequence[str], sizes: Sequence[str]) -> Iterator[Row]:
    """Yield the files that keep every splat of a scene, the fastest first."""
    for preset in PRESETS:
        yield Row(preset, ["--preset", preset], True)
    for psnr in psnrs:
        yield Row(f"{float(psnr):g} dB, every splat", ["--target-psnr", psnr, "--no-prune"], True)
    for size in sizes:
        target = f"{float(size) * scene.splat_count:.0f}"
        yield Row(f"{float(size):g} B/splat, every splat", ["--target-size", target, "--no-prune"], True)


def _removing(rows: Sequence[Row], words: Sequence[str]) -> Iterator[Row]:
    """Fixed shares of the splats, and the same targets with as many splats as they want."""
    for keep in _KEEPS:
        yield Row(f"keep {keep:g}", [*words, "--keep", f"{keep:g}"], False)
    for row in rows:
        name, _, every = row.name.partition(", ")
        if every:
            yield Row(name, [*words, *(word for word in row.arguments if word != "--no-prune")], False)


def _measure(scene: Scene, rows: Sequence[Row], kept: Kept, name: str, program: str, *, again: bool) -> None:
    """Make what is missing of a scene, and keep each file's figures."""
    kept.values |= {"splats": scene.splat_count, "sh_degree": scene.sh_degree, "ply_bytes": scene.size_bytes}
    builds: dict[str, Build] = kept.values.setdefault("builds", {})
    machine = describe()["machine"]
    if again or name not in builds:
        builds[name] = {"machine": machine, "rows": {}}
    build = builds[name]
    missing = [row for row in rows if row.name not in build["rows"]]
    if not missing:
        return
    source = read_ply(scene.path)
    # Cameras that no search knows.
    cameras = [camera for seed in _SEEDS for camera in virtual_cameras(source, 8, 640, 480, seed=seed)]
    judge = Scorer.of_source(source, cameras, BLACK)
    for row in missing:
        build["rows"][row.name] = found = _made(program, scene, row, judge)
        if machine != build["machine"]:
            found["machine"] = machine  # its seconds cannot be compared with other rows
        kept.write()
        note(f"{scene.name} {name} {row.name}: {json.dumps(found)}")


def _made(program: str, scene: Scene, row: Row, judge: Scorer) -> File:
    """Make a file in a process of its own, and judge it; or say why there is none."""
    with tempfile.TemporaryDirectory() as folder:
        output = Path(folder) / "file.csplat"
        start = time.perf_counter()
        command = [program, "encode", str(scene.path), str(output), *row.arguments, "--json"]
        done = subprocess.run(command, check=False, capture_output=True, text=True)
        seconds = round(time.perf_counter() - start, 1)
        if done.returncode:
            said = done.stderr.strip().splitlines() or [f"status {done.returncode}"]
            return {"error": said[-1], "seconds": seconds}
        report, model = json.loads(done.stdout), decode(output.read_bytes())
    stated = (report.get("target") or report.get("simplified") or {}).get("psnr")
    return {
        "bytes": report["size_bytes"],
        "splats": report["splats"],
        "psnr": round(judge.psnr(model), 3),
        "stated": None if stated is None else round(stated, 3),
        "seconds": seconds,
        "all_splats": row.all_splats,
    }


if __name__ == "__main__":
    sys.exit(run(main))

"""Train a scene once, make files of several sizes of it, judge them, and draw them beside published ones.

    python -m csplat_bench.photographs tools/benchmarks/photographs/lego800.toml FOLDER --lpips alex.npz
    python -m csplat_bench.photographs tools/benchmarks/photographs/lego800.toml --tables --markdown

FOLDER is the data set. A configuration file says with which words `csplat train` is called: `training` for all files,
`files` for each, by name. The training lies in --work as NAME.ply, with its checkpoint, its files beside it. Figures of
the held-out photographs are kept in NAME.json beside the configuration file, and drawn in NAME.svg: an interrupted run
goes on where it ended. PSNR is the mean over the photographs, as papers print it, and pooled; LPIPS is AlexNet's.
"""

from __future__ import annotations

import json
import subprocess
import sys
import time
import tomllib
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import typer

from csplat.decoder import decode
from csplat.errors import InputError
from csplat.model import SplatModel
from csplat.ply import read_ply
from csplat_bench.common.command import LPIPS, MARKDOWN, TABLES, run
from csplat_bench.common.kept import Kept
from csplat_bench.common.report import describe
from csplat_bench.common.scenes import OUT
from csplat_bench.photographs.tables import plot, tables
from csplat_render.lpips import Lpips, load_lpips
from csplat_trainer.data import DataSet, load
from csplat_trainer.evaluate import photograph_judge


def main(
    config: Annotated[Path, typer.Argument(metavar="CONFIG.toml", help="what is trained, and which files are made")],
    folder: Annotated[Path | None, typer.Argument(metavar="FOLDER", help="the data set")] = None,
    *,
    files: Annotated[str | None, typer.Option(help="only these, by name, separated by commas")] = None,
    work: Annotated[Path, typer.Option(help="folder for the training and its files")] = OUT / "photographs",
    lpips: LPIPS = None,
    show: TABLES = False,
    markdown: MARKDOWN = False,
) -> None:
    """Make what is missing, and print and draw all that is known."""
    wanted = tomllib.loads(config.read_text("utf-8"))
    kept = Kept(config.with_suffix(".json"))
    if not show:
        if folder is None:
            raise InputError("wanted the folder of the data set, or --tables")
        chosen = [name for name in wanted["files"] if files is None or name in files.split(",")]
        weights = None if lpips is None else load_lpips(None if lpips == "auto" else lpips)
        _measure(config.stem, wanted, chosen, folder, work, weights, kept)
    print(tables(kept.values, config.stem, markdown=markdown))
    plot(kept.values, config.stem, config.with_suffix(".svg"))


def _measure(
    name: str, wanted: dict[str, Any], files: Sequence[str], folder: Path, work: Path, lpips: Lpips | None, kept: Kept
) -> None:
    data = load(folder, test_every=8)
    if not data.test:
        raise InputError(f"{folder} holds out no photographs to judge by")
    work.mkdir(parents=True, exist_ok=True)
    ply, run_file = work / f"{name}.ply", work / f"{name}.npz"
    kept.values |= {"title": wanted["title"], "machine": describe(), "test_views": len(data.test)}
    training = ["csplat", "train", str(folder), *wanted["training"]]

    def trained() -> dict[str, Any]:
        words = [*training, "-o", str(ply), "--checkpoint", str(run_file), "--checkpoint-every", "1000"]
        found = _called(words if not run_file.exists() else [*words, "--resume", str(run_file)], ply)
        source = read_ply(ply)
        return {
            "command": _said(training, folder), "seconds": round(found["seconds"]), "splats": len(source),
            "size_bytes": ply.stat().st_size, "peak_memory_bytes": found["peak_memory_bytes"],
            **_scores(source, data, lpips),
        }  # fmt: skip

    def made(file: str) -> dict[str, Any]:
        path, start = work / f"{name}-{file.replace(' ', '')}.csplat", time.perf_counter()
        words = [*training, *wanted["files"][file], "--resume", str(run_file), "-o", str(path)]
        found = _called(words, path)["file"]
        seconds = time.perf_counter() - start - found["seconds"].get("judging", 0.0)
        return {
            "command": _said([*training, *wanted["files"][file]], folder), "seconds": round(seconds),
            "stages": found["seconds"], "steps": found["steps"], "splats": found["splats"],
            "size_bytes": found["size_bytes"], "peak_memory_bytes": found["peak_memory_bytes"],
            "attribute_bytes": found["bytes_by_attribute"], "before_tuning": found["scores"]["before tuning"],
            **_scores(decode(path.read_bytes()), data, lpips),
        }  # fmt: skip

    kept.measure("training", "scene", trained)
    for file in files:
        kept.measure("files", file, partial(made, file))


def _called(words: Sequence[str], output: Path) -> dict[str, Any]:
    """Run a command as a user would, in a process of its own; its report."""
    report = output.with_suffix(".json")
    program = [sys.executable, "-m", "csplat_tools", *words[1:]]
    subprocess.run([*program, "--report", str(report), "--force"], check=True)
    found: dict[str, Any] = json.loads(report.read_text())
    return found


def _said(words: Sequence[str], folder: Path) -> str:
    return " ".join(words).replace(str(folder), folder.name)


def _scores(model: SplatModel, data: DataSet, lpips: Lpips | None) -> dict[str, float | None]:
    """Of the held-out photographs."""
    found = photograph_judge(data.test, data.background, origin=(0.0, 0.0, 0.0)).scores(model, lpips=lpips)
    return {score: getattr(found, score) for score in ("psnr_mean", "psnr", "ssim", "lpips")}


if __name__ == "__main__":
    sys.exit(run(main))

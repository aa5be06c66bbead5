"""Train a scene, make files of several sizes of it, judge them, and plot them with published ones.

    python -m csplat_bench.photographs tools/benchmarks/results/photographs/lego800.toml FOLDER --lpips alex.npz
    python -m csplat_bench.photographs tools/benchmarks/results/photographs/lego800.toml --tables --markdown

FOLDER is the data set. A configuration file has the arguments of `csplat train`: `trainings`, by name,
each from nothing or `after` another one, from whose end it goes on; `files`, by name, each `of` a training; `size`, if
photographs are to be made smaller. Seconds are those of one training, or one file, on top of those before it. A file
that is not made by `csplat train` says `by` what: `finetune` or `encode` of the trained PLY, FOLDER among its words
where that is to look at photographs. A file `without` what others have is drawn apart from them. Trainings lie in
--work as NAME-TRAINING.ply, with their checkpoints, files next to them. Figures of the held-out photographs are kept in
NAME.json next to the configuration file, and plotted in NAME.svg: an interrupted run continues. PSNR is the
mean over the photographs, as papers print it, and pooled; LPIPS is AlexNet's.
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
from csplat_tools.cli.shared_options import parse_size
from csplat_trainer.data import DataSet, load
from csplat_trainer.posed_images import image_scorer
from csplat_trainer.training_checkpoint import load_checkpoint


def main(
    config: Annotated[Path, typer.Argument(metavar="CONFIG.toml", help="what is trained, and which files are made")],
    folder: Annotated[Path | None, typer.Argument(metavar="FOLDER", help="the data set")] = None,
    *,
    files: Annotated[str | None, typer.Option(help="only these, by name, separated by commas")] = None,
    work: Annotated[Path, typer.Option(help="folder for trainings and files")] = OUT / "photographs",
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
    size = wanted.get("size")
    data = load(folder, None if size is None else parse_size(size), test_every=8)
    if not data.test:
        raise InputError(f"{folder} holds out no photographs to judge by")
    work.mkdir(parents=True, exist_ok=True)
    kept.values |= {"title": wanted["title"], "machine": describe(), "test_views": len(data.test)}
    trainings: dict[str, dict[str, Any]] = wanted["trainings"]

    def words_of(training: str) -> list[str]:
        sized = [] if size is None else ["--size", size]
        return ["csplat", "train", str(folder), *sized, *trainings[training]["words"]]

    def checkpoint(training: str) -> Path:
        return work / f"{name}-{training}.npz"

    def trained(training: str) -> dict[str, Any]:
        ply, run_file, after = work / f"{name}-{training}.ply", checkpoint(training), trainings[training].get("after")
        begin = run_file if run_file.exists() else None if after is None else checkpoint(after)
        resumed = [] if begin is None else ["--resume", str(begin)]
        words = [*words_of(training), "-o", str(ply), "--checkpoint", str(run_file), "--checkpoint-every", "1000"]
        found = _called([*words, *resumed], ply)
        source, seconds = read_ply(ply), found["seconds"]
        if after is not None:
            seconds -= load_checkpoint(checkpoint(after)).log["seconds"]
        said = [] if after is None else ["--resume", checkpoint(after).name]
        return {
            "command": _said([*words_of(training), *said], folder), "seconds": round(seconds),
            "splats": len(source), "size_bytes": ply.stat().st_size, "peak_memory_bytes": found["peak_memory_bytes"],
            **_scores(source, data, lpips),
        }  # fmt: skip

    def made(file: str) -> dict[str, Any]:
        path, start = work / f"{name}-{file.replace(' ', '')}.csplat", time.perf_counter()
        training, by = wanted["files"][file]["of"], wanted["files"][file].get("by", "train")
        without = wanted["files"][file].get("without")
        words = ["csplat", by, str(work / f"{name}-{training}.ply")]
        if by == "train":
            words = [*words_of(training), "--resume", str(checkpoint(training))]
        words += [str(folder) if word == "FOLDER" else word for word in wanted["files"][file]["words"]]
        found = _called([*words, "-o", str(path)], path)
        seconds = time.perf_counter() - start
        found = found.get("file", found)
        decoded, stages = decode(path.read_bytes()), found.get("seconds")
        stages = stages if isinstance(stages, dict) else {}
        return {
            "training": training, "by": by, "without": without, "command": _said(words, folder).replace(f"{work}/", ""),
            "seconds": round(seconds - stages.get("judging", 0.0)), "stages": stages, "steps": found.get("steps"),
            "splats": len(decoded), "size_bytes": path.stat().st_size,
            "peak_memory_bytes": found.get("peak_memory_bytes"), "attribute_bytes": found.get("bytes_by_attribute"),
            "size_bytes_before_tuning": found.get("size_bytes_before_tuning"),
            "before_tuning": found.get("scores", {}).get("before tuning"), **_scores(decoded, data, lpips),
        }  # fmt: skip

    for file in files:
        chain = [wanted["files"][file]["of"]]
        while (after := trainings[chain[0]].get("after")) is not None:
            chain.insert(0, after)
        for training in chain:
            kept.measure("trainings", training, partial(trained, training))
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
    """Return the scores of a model on the held-out photographs."""
    found = image_scorer(data.test, data.background, origin=(0.0, 0.0, 0.0)).scores(model, lpips=lpips)
    return {score: getattr(found, score) for score in ("psnr_mean", "psnr", "ssim", "lpips")}


if __name__ == "__main__":
    sys.exit(run(main))

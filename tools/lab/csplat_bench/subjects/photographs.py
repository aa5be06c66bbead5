# SPDX-License-Identifier: Apache-2.0
"""Files made from photographs: trained, tuned, scored on held-out photographs, next to published figures.

A scene is a data set: a folder in the data folder, or its path; option `sizes` gives widths and heights by scene.
A case is one of

    train = { max_splats = 40000, iterations = 7000 }    # TrainOptions; `after`: the training that it resumes
    of = "40k", target_size = "0.1MB"                    # a file by the end of a training; also keep, target_psnr,
                                                         # lambda, final_share
    of = "40k", command = "finetune {ply} {file} --data {data} --preset small"    # a file by a command
    command = "train {data} {file} --time 10min"                                  # the same without a training before

Seconds are those of one training or file, without those that it builds on. Trainings stay in the work folder. PSNR is
the mean over the photographs, as papers print it (`psnr_mean`), and pooled (`psnr`); LPIPS is AlexNet's.
"""

from __future__ import annotations

import json
import shlex
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from csplat.decoder import decode
from csplat.encoder import EncodeOptions, Target
from csplat.errors import InputError
from csplat.model import SplatModel
from csplat.ply import read_ply
from csplat.sizes import parse_size
from csplat_bench.measuring import alone, run_program
from csplat_bench.protocol import AbsentError, Measure, Setup
from csplat_bench.suites import Case
from csplat_render.lpips import Lpips, load_lpips
from csplat_tools.training.training_run import plan_training, run_training, run_training_to_file, tuning_after
from csplat_tools.training.tuning_run import SHAPE_ENTRIES
from csplat_tools.views import DataOptions
from csplat_trainer.data import DataSet, load
from csplat_trainer.posed_images import image_scorer
from csplat_trainer.training_options import Outputs, TrainOptions

_TEST_EVERY = 8


@dataclass(frozen=True)
class _Set:
    """A data set, and the folder of its trainings."""

    name: str
    path: Path
    size: tuple[int, int] | None
    work: Path

    @property
    def options(self) -> DataOptions:
        """The set for the command line's functions."""
        return DataOptions(str(self.path), self.size, test_every=_TEST_EVERY)

    def path_of(self, case: str, suffix: str) -> Path:
        """Return the path of a case's file."""
        return self.work / f"{self.name}-{case.replace(' ', '')}{suffix}"


@contextmanager
def measure_photographs(setup: Setup, name: str, cases: Sequence[Case]) -> Iterator[Measure]:
    """Yield the function that trains or makes a file, and scores it."""
    sizes = setup.options.get("sizes", {})
    path, size = find_data_set(setup, name), sizes.get(Path(name).name)
    data_set = _Set(Path(name).name, path, None if size is None else (size[0], size[1]), setup.work / "photographs")
    data_set.work.mkdir(parents=True, exist_ok=True)
    data = load(path, data_set.size, test_every=_TEST_EVERY)
    if not data.test:
        raise InputError(f"{path} holds out no photographs to score by")
    lpips = None if setup.lpips is None else load_lpips(None if setup.lpips == "auto" else setup.lpips)
    trainings = {case.name: case for case in cases if "train" in case.settings}

    def ensure_trained(training: str) -> None:
        if training not in trainings:
            raise InputError(f"the training {training!r} is not among the cases of this run")
        after = trainings[training].get("after")
        if not data_set.path_of(training, ".ply").exists():
            if after is not None:
                ensure_trained(after)
            _train(data_set, trainings[training])

    def measure(case: Case) -> Mapping[str, Any]:
        if "train" in case.settings:
            ensure_trained(case.name)
            ply = data_set.path_of(case.name, ".ply")
            report = json.loads(data_set.path_of(case.name, ".json").read_text())
            return {"by": "train", **report, "ply_bytes": ply.stat().st_size, **_scores(read_ply(ply), data, lpips)}
        if case.get("of") in trainings:
            ensure_trained(case["of"])
        file = data_set.path_of(case.name, ".csplat")
        values = (
            _by_command(setup, data_set, case, file) if "command" in case.settings else _finish(data_set, case, file)
        )
        series = f"csplat {values['by']}{', without ' + case['without'] if 'without' in case.settings else ''}"
        model = decode(file.read_bytes())
        record = model.metadata.training
        size = None if record is None or record.size is None else "{}×{}".format(*record.size)
        return {"training": case.get("of"), "series": series, "images": size, **values, **_scores(model, data, lpips)}

    yield measure


def find_data_set(setup: Setup, name: str) -> Path:
    """Return the folder of a data set.

    Raises:
        AbsentError: there is none.
    """
    for path in (setup.data / "images" / name, setup.data / "benchmarks" / name, setup.data / name, Path(name)):
        if path.exists():
            return path
    raise AbsentError(f"there is no data set {name} in {setup.data}")


def _train(data_set: _Set, case: Case) -> None:
    """Train in a process of its own; write PLY, checkpoint and a report for the row."""
    checkpoint, after = data_set.path_of(case.name, ".npz"), case.get("after")
    resume = checkpoint if checkpoint.exists() else None if after is None else data_set.path_of(after, ".npz")
    files = Outputs(str(checkpoint), resume=None if resume is None else str(resume))
    ply, start = data_set.path_of(case.name, ".ply"), time.perf_counter()
    report = alone(run_training, data_set.options, str(ply), TrainOptions(**case["train"]), files, quiet=True)
    row = {
        "seconds": time.perf_counter() - start, "splats": report["splats"], "steps": len(report["losses"]),
        "peak_memory_bytes": report["peak_memory_bytes"],
    }  # fmt: skip
    data_set.path_of(case.name, ".json").write_text(json.dumps(row))


def _finish(data_set: _Set, case: Case, file: Path) -> dict[str, Any]:
    """Make a file by the end of a training, in a process of its own; see `csplat train` for the defaults."""
    training = data_set.path_of(case["of"], ".npz")
    if not training.exists():
        raise InputError(f"{training} does not exist, expected the checkpoint of the training {case['of']!r}")
    size = None if "target_size" not in case.settings else parse_size(case["target_size"])
    start = time.perf_counter()
    report = alone(finish_training, data_set.options, str(training), str(file), dict(case.settings), size)
    return {"by": "train", **_describe(report["file"], time.perf_counter() - start, file)}


def finish_training(
    data: DataOptions, checkpoint: str, output: str, settings: Mapping[str, Any], size_bytes: int | None
) -> dict[str, Any]:
    """Make a file from the checkpoint of a training.

    Args:
        data: the data set.
        checkpoint, output: paths.
        settings: of the case.
        size_bytes: largest size of the file.
    """
    from csplat_trainer.fit_checkpoint import load_checkpoint

    known = TrainOptions(**load_checkpoint(checkpoint).options)
    target = None
    if size_bytes is not None or "target_psnr" in settings or "keep" in settings:
        target = Target(settings.get("target_psnr"), size_bytes, keep=settings.get("keep"))
    options = plan_training(known, target, max_splats=known.max_splats)
    options = replace(options, final_share=settings.get("final_share", options.final_share))
    return run_training_to_file(
        data, output, options, Outputs(resume=checkpoint),
        EncodeOptions(settings.get("preset", "small"), shape_codebook_size=SHAPE_ENTRIES),
        tuning_after(options, settings.get("lambda")), target=target, quiet=True,
    )  # fmt: skip


def _by_command(setup: Setup, data_set: _Set, case: Case, file: Path) -> dict[str, Any]:
    ply = data_set.path_of(case.get("of", case.name), ".ply")
    words = [argument.format(ply=ply, file=file, data=data_set.path) for argument in shlex.split(case["command"])]
    used = run_program([*setup.csplat, *words, "--force", "--quiet", "--json"])
    report = json.loads(used.stdout)
    options = report["training"]["options"] if "training" in report else {}
    planned = {name: options.get(name) for name in ("max_splats", "iterations")}
    return {"by": words[0], **planned, **_describe(report.get("file", report), used.wall, file)}


def _describe(report: Mapping[str, Any], seconds: float, file: Path) -> dict[str, Any]:
    """Return fields of a file's row; `seconds` leaves out the time of scoring."""
    stages = report.get("seconds") if isinstance(report.get("seconds"), dict) else {}
    return {
        "seconds": seconds - (stages or {}).get("judging", 0.0), "stages": stages,
        "steps": report.get("steps"), "size_bytes": file.stat().st_size,
        "peak_memory_bytes": report.get("peak_memory_bytes"), "attribute_bytes": report.get("bytes_by_attribute"),
        "size_bytes_before_tuning": report.get("size_bytes_before_tuning"),
        "before_tuning": report.get("scores", {}).get("before_tuning"),
    }  # fmt: skip


def _scores(model: SplatModel, data: DataSet, lpips: Lpips | None) -> dict[str, Any]:
    """Score a model on the held-out photographs."""
    found = image_scorer(data.test, data.background, origin=(0.0, 0.0, 0.0)).scores(model, lpips=lpips)
    scores = {name: getattr(found, name) for name in ("psnr_mean", "psnr", "ssim", "lpips")}
    return {"splats": len(model), "sh_degree": model.sh_degree, "test_views": len(data.test), **scores}

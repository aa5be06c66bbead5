# SPDX-License-Identifier: Apache-2.0
"""The benchmark scenes that papers report, trained and scored by their protocols, then encoded or tuned, and scored.

Scenes are found below the folder of `--data` (see `data_set_folders`). Option `train` holds TrainOptions, `size` a
width and height, `downscale` a divisor of the papers' sizes. A PLY in the work folder (captures/KEY.ply) is not
trained again; that of another trainer may be put there. A training continues from its checkpoint (captures/KEY.npz).
A case is the trained PLY (no setting), a `preset`, or a file tuned to the images in `megabytes` of 10^6 bytes at most,
captures/KEY-SIZEMB.csplat, which continues the training from its checkpoint. Such a file is not made again either, and
may come from another machine, with its record (.json). All are scored as decoded, by the rasteriser on the CPU,
whatever trained them. PSNR is the mean over the held-out images, as papers print it; SSIM has INRIA's window; LPIPS is
AlexNet's. `remarks` names what makes a row differ from the papers' settings.
"""

from __future__ import annotations

import json
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

from csplat.context import Context
from csplat.decoder import decode
from csplat.encode_api import encode
from csplat.encoder import EncodeOptions, Target
from csplat.errors import InputError
from csplat.ply import read_ply, write_ply
from csplat_bench.data_set_folders import (
    PAPER_STEPS,
    TEST_EVERY,
    SceneFolder,
    choose_images,
    choose_scenes,
    find_scene_folders,
    papers_size,
)
from csplat_bench.measuring import timed
from csplat_bench.protocol import Measure, Setup
from csplat_bench.results import describe, write_json
from csplat_bench.suites import Case
from csplat_render.lpips import load_lpips
from csplat_tools.console import note
from csplat_tools.file_streams import write_bytes
from csplat_tools.training.training_run import plan_training, stored_settings, tuning_after
from csplat_tools.training.tuning_run import SHAPE_ENTRIES, choose_and_finetune
from csplat_tools.views import find_view_set
from csplat_trainer.data import DataSet, load
from csplat_trainer.fitter import FitStep
from csplat_trainer.posed_images import image_scorer
from csplat_trainer.training_loop import train
from csplat_trainer.training_options import Outputs, TrainOptions

_NOTES = 5  # lines of progress of a training


def scene_keys(setup: Setup, names: Sequence[str]) -> list[str]:
    """Return the keys of the scenes below the data folder that names or `*` choose."""
    found = find_scene_folders(setup.data)
    return [one.key for one in (found if "*" in names else choose_scenes(found, names))]


@contextmanager
def measure_capture(setup: Setup, key: str, _: Sequence[Case]) -> Iterator[Measure]:
    """Train a scene unless its PLY exists; yield the function that scores a file of it."""
    folder = next(one for one in find_scene_folders(setup.data) if one.key == key)
    size, downscale = setup.options.get("size"), setup.options.get("downscale", 1.0)
    choice = choose_images(folder, None if size is None else (size[0], size[1]), downscale)
    images = load(folder.path, choice.size, images=choice.images, test_every=TEST_EVERY)
    if not images.test:
        raise InputError(f"{folder.path} holds out no images to score by")
    lpips = None if setup.lpips is None else load_lpips(None if setup.lpips == "auto" else setup.lpips)
    ply = setup.work / "captures" / f"{key}.ply"
    options = TrainOptions(**setup.options.get("train", {}))
    scorer = image_scorer(images.test, images.background, origin=(0.0, 0.0, 0.0))
    camera = images.test[0].camera
    pixels = (camera.W, camera.H)

    def measure(case: Case) -> Mapping[str, Any]:
        if "megabytes" in case.settings:
            file, record = _tuned(ply, images, options, case["megabytes"])
            training = record.pop("training")
            model, values = decode(file), {"size_bytes": len(file), **record}
        else:
            training = _train(ply, images, options)
            model, values = read_ply(ply), {"size_bytes": ply.stat().st_size}
        if "preset" in case.settings:
            file, timing = timed(encode, model, EncodeOptions(preset=case["preset"]))
            model, values = decode(file), {"size_bytes": len(file), "encode_seconds": timing.wall}
        scores = scorer.scores(model, lpips=lpips)
        return {
            "set": folder.protocol.slug, "splats": len(model), "sh_degree": model.sh_degree, "width": pixels[0],
            "height": pixels[1], "test_views": len(images.test), "steps": training.get("iterations"),
            "train_seconds": training.get("seconds"), **values,
            "remarks": "; ".join([*choice.remarks, *_differences(folder, pixels, choice.protocol_size, training)]),
            **{name: getattr(scores, name) for name in ("psnr_mean", "ssim", "lpips")},
        }  # fmt: skip

    yield measure


def _train(ply: Path, data: DataSet, options: TrainOptions) -> dict[str, Any]:
    """Train a scene unless its PLY exists; return its options and seconds, empty if another trainer made it."""
    record = ply.with_suffix(".training.json")
    if ply.exists():
        known: dict[str, Any] = json.loads(record.read_text()) if record.exists() else {}
        if known and known["options"] != asdict(options):
            raise InputError(f"{ply} was trained with other options, expected those of the suite: remove it, or --work")
        return {**known.get("options", {}), **known}
    every = max(1, options.iterations // _NOTES // options.log_every) * options.log_every

    def show(now: FitStep) -> None:
        if now.iteration % every == 0:
            note(f"{ply.stem}: {now.iteration}/{now.iterations}, {now.splat_count} splats, {now.seconds:.0f} s")

    checkpoint = ply.with_suffix(".npz")
    checkpoint.parent.mkdir(parents=True, exist_ok=True)
    outputs = Outputs(checkpoint, resume=checkpoint if checkpoint.exists() else None)
    result = train(replace(data, test=[]), options, outputs=outputs, on_step=show)
    # The record first: a PLY without one counts as that of another trainer.
    write_json(record, {"options": asdict(options), "seconds": result.log["seconds"]})
    write_ply(ply, result.model)
    return {**asdict(options), "seconds": result.log["seconds"]}


def _tuned(ply: Path, data: DataSet, options: TrainOptions, megabytes: float) -> tuple[bytes, dict[str, Any]]:
    """Return a file tuned in a size, and its record; made as by `csplat train --resume` unless it exists."""
    path = ply.with_name(f"{ply.stem}-{megabytes:g}MB.csplat")
    if not path.exists():
        training, checkpoint = _train(ply, data, options), ply.with_suffix(".npz")
        if not checkpoint.exists():
            raise InputError(f"{checkpoint} is missing: tuning continues a training of csplat")
        target, start = Target(size=round(1e6 * megabytes)), time.perf_counter()
        trained = train(
            replace(data, test=[]),
            plan_training(options, target, max_splats=stored_settings(checkpoint).max_splats),
            outputs=Outputs(resume=checkpoint),
        )
        pruning = time.perf_counter() - start
        encoding = EncodeOptions("small", shape_codebook_size=SHAPE_ENTRIES)
        views = find_view_set(trained.model, data=data, validation_count=0)
        tuned = choose_and_finetune(
            trained.model, views, encoding, tuning_after(options), target, context=Context(seed=options.seed or 0)
        )
        seconds = {"pruning": round(pruning, 1), **tuned.seconds}
        write_json(path.with_suffix(".json"), {"training": training, "seconds": seconds, "machine": _machine(options)})
        write_bytes(str(path), tuned.made.data)
    return path.read_bytes(), json.loads(path.with_suffix(".json").read_text())


def _machine(options: TrainOptions) -> str:
    if options.device == "cpu":
        return describe()[0]
    import torch

    return f"{torch.cuda.get_device_name()}, {describe()[0]}"


def _differences(
    folder: SceneFolder, pixels: tuple[int, int], protocol_size: tuple[int, int], training: Mapping[str, Any]
) -> Iterator[str]:
    """Yield what makes the figures of a scene differ from the papers' settings; nothing for other data sets."""
    papers = papers_size(folder, protocol_size)
    if papers is None:
        return
    if pixels[0] < papers[0]:
        yield f"images {pixels[0]}×{pixels[1]}, the papers' {papers[0]}×{papers[1]}"
    if training.get("iterations", PAPER_STEPS) < PAPER_STEPS:
        yield f"{training['iterations']} steps, the papers' {PAPER_STEPS}"
    if "max_splats" in training:
        yield f"at most {training['max_splats']} splats, 3DGS without limit"

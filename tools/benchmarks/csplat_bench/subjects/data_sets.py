"""The benchmark scenes that papers report, trained and scored by their protocols, then encoded and scored again.

Scenes are found below the folder of `--data` (see `data_set_folders`). Option `train` holds TrainOptions, `size` a
width and height, `downscale` a divisor of the papers' sizes. A PLY in the work folder (data_sets/KEY.ply) is not
trained again; that of another trainer may be put there.
A case is the trained PLY (no setting) or a `preset`. PSNR is the mean over the held-out images, as papers print it;
SSIM has INRIA's window; LPIPS is AlexNet's. `remarks` names what makes a row differ from the papers' settings.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

from csplat.decoder import decode
from csplat.encoder import EncodeOptions, encode
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
from csplat_bench.results import write_json
from csplat_bench.suites import Case
from csplat_render.lpips import load_lpips
from csplat_tools.console import note
from csplat_trainer.data import DataSet, load
from csplat_trainer.fitter import FitStep
from csplat_trainer.posed_images import image_scorer
from csplat_trainer.training_loop import train
from csplat_trainer.training_options import TrainOptions

_NOTES = 5  # lines of progress of a training


def scene_keys(setup: Setup, names: Sequence[str]) -> list[str]:
    """Return the keys of the scenes below the data folder that names or `*` choose."""
    found = find_scene_folders(setup.data)
    return [one.key for one in (found if "*" in names else choose_scenes(found, names))]


@contextmanager
def measure_data_set(setup: Setup, key: str, _: Sequence[Case]) -> Iterator[Measure]:
    """Train a scene unless its PLY exists; yield the function that scores a file of it."""
    folder = next(one for one in find_scene_folders(setup.data) if one.key == key)
    size, downscale = setup.options.get("size"), setup.options.get("downscale", 1.0)
    choice = choose_images(folder, None if size is None else (size[0], size[1]), downscale)
    data = load(folder.path, choice.size, images=choice.images, test_every=TEST_EVERY)
    if not data.test:
        raise InputError(f"{folder.path} holds out no images to score by")
    lpips = None if setup.lpips is None else load_lpips(None if setup.lpips == "auto" else setup.lpips)
    ply = setup.work / "data_sets" / f"{key}.ply"
    training = _train(ply, data, TrainOptions(**setup.options.get("train", {})))
    source, scorer = read_ply(ply), image_scorer(data.test, data.background, origin=(0.0, 0.0, 0.0))
    camera = data.test[0].camera
    pixels = (camera.W, camera.H)
    facts = {
        "set": folder.protocol.slug, "splats": len(source), "sh_degree": source.sh_degree, "width": pixels[0],
        "height": pixels[1], "test_views": len(data.test), "steps": training.get("iterations"),
        "train_seconds": training.get("seconds"),
        "remarks": "; ".join([*choice.remarks, *_differences(folder, pixels, choice.protocol_size, training)]),
    }  # fmt: skip

    def measure(case: Case) -> Mapping[str, Any]:
        model, values = source, dict[str, Any](size_bytes=ply.stat().st_size)
        if "preset" in case.settings:
            data, timing = timed(encode, source, EncodeOptions(preset=case["preset"]))
            model, values = decode(data), {"size_bytes": len(data), "encode_seconds": timing.wall}
        scores = scorer.scores(model, lpips=lpips)
        return {**facts, **values, **{name: getattr(scores, name) for name in ("psnr_mean", "ssim", "lpips")}}

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

    result = train(replace(data, test=[]), options, on_step=show)
    # The record first: a PLY without one counts as that of another trainer.
    write_json(record, {"options": asdict(options), "seconds": result.log["seconds"]})
    write_ply(ply, result.model)
    return {**asdict(options), "seconds": result.log["seconds"]}


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

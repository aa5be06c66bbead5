"""Extreme scenes through all stages: read, encoded, rendered, pruned, trained on, tuned. Needs the extra [render].

`python tests/extremes_chain.py` writes the figures of `tools/docs/results/extremes.md`.
"""

from __future__ import annotations

import json
import tempfile
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import numpy as np
from captures import cameras, views_of
from extremes import COPIES, COUNT, DRAWN, NAMES, PRESETS, RESULTS, encoded, scene, scorer, write_small_scene

from csplat import EncodeOptions, SplatModel, decode, read_ply
from csplat.decoder import read_declared_bounds, read_header
from csplat.encoder import EncodePlan, EncodeResult, FixedQuantisation, encode_with_report, fix_quantisation
from csplat.errors import InputError
from csplat.lint import Finding
from csplat.ply import lint_ply
from csplat_conformance.declared_bounds import BoundsVerification, Source, verify_bounds
from csplat_render import Camera, render
from csplat_render.conventions import RenderResult
from csplat_render.rasteriser import Rasteriser
from csplat_render.scorer import ReferenceImage, Scorer
from csplat_render.virtual_cameras import virtual_cameras
from csplat_tools.optimise.pruning import Simplified, simplify
from csplat_tools.optimise.pruning_order import SimplifyOptions
from csplat_trainer.data import DataSet
from csplat_trainer.posed_images import PosedImage
from csplat_trainer.training_loop import train
from csplat_trainer.training_options import TrainOptions, TrainResult
from csplat_trainer.tuning import FinetuneOptions, TuningResult, TuningViews, renders_of, split_views, tune

ARRAYS = ("means", "quats", "scales", "opacities", "sh0", "shN")
TRAINED = ("float32 limits", "exploded")  # conditions with the largest values: their chain includes learning
SMALL = (160, 120)
FEW = SimplifyOptions(views=10, view_size=(60, 45))
QUICK = TrainOptions(
    max_splats=COUNT, sh_degree=1, iterations=120, refine_start=20, refine_every=20, log_every=40, background="black"
)
SHORT = FinetuneOptions(iterations=250, warm_up=10, validate_every=50, log_every=50)
COARSE = EncodeOptions(preset="small", attribute_psnr=36.0)
BLACK = np.zeros(3, np.float32)


@dataclass(frozen=True)
class Learnt:
    """A condition after a few steps of learning.

    Attributes:
        half: the scene with half its splats.
        trained: splats trained on renders of the scene.
        losses: training loss of each step.
        tuned: the decoded scene of the tuned file, or the reason why it cannot be tuned.
    """

    half: SplatModel
    trained: SplatModel
    losses: tuple[float, ...]
    tuned: SplatModel | str


@dataclass(frozen=True)
class Chain:
    """A condition after each stage.

    Attributes:
        source: the scene as read.
        findings: findings of the reader.
        linted: ids of the repairs that `lint_ply` reports.
        refusal: message of strict reading; "" if it succeeds.
        result: the encoded file, preset `balanced`.
        decoded: the decoded scene.
        verification: verification of the declared error bounds.
        renders: renders of source and decoded scene, in the modes `fast` and `exact`.
        learnt: the scene after learning, for conditions in `TRAINED`.
    """

    source: SplatModel
    findings: tuple[Finding, ...]
    linted: tuple[str, ...]
    refusal: str
    result: EncodeResult
    decoded: SplatModel
    verification: BoundsVerification
    renders: tuple[RenderResult, ...]
    learnt: Learnt | None


def chain_of(name: str) -> Chain:
    """Take a condition through all stages, with `COPIES` instead of a million splats."""
    findings: list[Finding] = []
    with tempfile.TemporaryDirectory() as folder:
        path = write_small_scene(Path(folder), name)
        source, refusal = read_ply(path, report=findings), ""
        linted = tuple(one.id for one in lint_ply(path) if one.kind == "repair")
        try:
            read_ply(path, strict=True)
        except InputError as error:
            refusal = str(error)
    result = encode_with_report(source)
    decoded = decode(result.data)
    (camera,) = virtual_cameras(source, 1, 24, 18)
    renders = [render(model, camera, mode=mode) for model in (source, decoded) for mode in ("fast", "exact")]
    learnt = _learn(source) if name in TRAINED else None
    verification = verify(source, result, decoded)
    return Chain(source, tuple(findings), linted, refusal, result, decoded, verification, tuple(renders), learnt)


def verify(source: SplatModel, result: EncodeResult, decoded: SplatModel) -> BoundsVerification:
    """Verify the declared error bounds of a file against its source."""
    bounds = read_declared_bounds(result.data)
    return verify_bounds(Source.of(source), decoded, read_header(result.data), bounds, result.source_index)


def _learn(source: SplatModel) -> Learnt:
    views = cameras(9)
    half = simplify(source, keep=0.5, views=views_of(views), options=SimplifyOptions(rounds=1, effort=1)).model
    options = replace(QUICK, iterations=40, refine_start=10, refine_every=10)
    trained = train(images_of(source, views, source.means[:COUNT]), options)
    try:
        fixed, result, _ = tune_on_renders(source, views, 2, replace(SHORT, iterations=20))
        tuned: SplatModel | str = decode(fixed.encode(result.best_values).write().data)
    except InputError as error:
        tuned = str(error)
    return Learnt(half, trained.model, tuple(trained.log["losses"]), tuned)


def tune_on_renders(
    source: SplatModel, views: list[Camera], validation_count: int, options: FinetuneOptions
) -> tuple[FixedQuantisation, TuningResult, TuningViews]:
    """Tune a coarse file of a scene to renders of it."""
    split = split_views(renders_of(source, views, BLACK, None), BLACK, validation_count=validation_count)
    fixed = fix_quantisation(EncodePlan.of(source, COARSE))
    return fixed, tune(fixed, split, options), split


def assert_finite(model: SplatModel) -> None:
    """Fail if an array of a scene contains NaN or infinity."""
    for name in ARRAYS:
        assert np.isfinite(getattr(model, name)).all(), name


def small_scene(name: str) -> SplatModel:
    """Return a condition, with `COPIES` instead of a million splats."""
    return scene(name)[0].select(slice(COPIES))


@cache
def small_scorer(name: str) -> Scorer:
    """Return a scorer of 160×120 renders against those of a condition."""
    if name in DRAWN:
        return scorer(name, SMALL)
    model = small_scene(name)
    return Scorer.of_source(model, virtual_cameras(model, 8, *SMALL), (0.0, 0.0, 0.0))


@cache
def half(name: str) -> Simplified:
    """Simplify a condition to half its splats."""
    return simplify(small_scene(name), keep=0.5, options=FEW)


def images(name: str, points: np.ndarray | None = None) -> DataSet:
    """Return a data set of renders of a condition, and points."""
    model = small_scene(name)
    return images_of(model, virtual_cameras(model, 12, 48, 40), points)


def images_of(model: SplatModel, views: list[Camera], points: np.ndarray | None = None) -> DataSet:
    """Return a data set of renders on black, three of four for training, and points."""
    rasteriser, shots = Rasteriser(gradients=False), []
    for camera in views:
        pixels = np.clip(rasteriser.forward(model, camera).rgb, 0.0, 1.0)
        shots.append(PosedImage(camera, np.rint(pixels * 255).astype(np.uint8)))
    count = 3 * len(shots) // 4
    return DataSet("made", shots[:count], shots[count:], points)


@cache
def trained(name: str) -> TrainResult:
    """Train splats on renders of a condition, starting from its centres."""
    return train(images(name, small_scene(name).means[:COUNT]), QUICK)


@cache
def tuned(name: str) -> tuple[SplatModel, SplatModel, TuningResult, Scorer]:
    """Tune a file of a condition to 48 of 52 renders.

    Returns:
        The decoded scene before and after, the result, and a scorer of the four validation renders.
    """
    source = small_scene(name)
    fixed, result, views = tune_on_renders(source, virtual_cameras(source, 52, 48, 36), 4, SHORT)
    before, after = (decode(fixed.encode(values).write().data) for values in (fixed.start(), result.best_values))
    references = [ReferenceImage(view.reference.astype(np.float32)) for view in views.validation]
    return before, after, result, Scorer([view.camera for view in views.validation], references)


def measure(name: str) -> dict[str, object]:
    """Return the row of a condition in `results/extremes.json`."""
    row: dict[str, object] = {"scene": name}
    for preset in PRESETS:
        data, count = encoded(name, preset).data, len(scene(name)[0])
        figures = {"bytes_per_splat": round(len(data) / count, 1 if len(data) > count else 4)}
        row[preset] = figures | ({"psnr": round(scorer(name).psnr(decode(data)), 1)} if name in DRAWN else {})
    losses = trained(name).log["losses"]
    row["half_psnr"] = round(small_scorer(name).psnr(half(name).model), 1)
    row["loss_before"], row["loss_after"] = (round(float(np.mean(part)), 2) for part in (losses[:10], losses[-10:]))
    if name != "exploded":
        before, after, _, views = tuned(name)
        row["untuned_psnr"], row["tuned_psnr"] = (round(views.psnr(model), 1) for model in (before, after))
    return row


if __name__ == "__main__":
    document = json.loads(RESULTS.read_text("utf-8")) | {"rows": [measure(name) for name in NAMES]}
    RESULTS.write_text(json.dumps(document, indent=1) + "\n", "utf-8")

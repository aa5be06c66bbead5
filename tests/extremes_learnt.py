"""Scenes at the extremes after learning: simplified, trained on, tuned. Needs the extra [render].

`python tests/extremes_learnt.py` prints the figures of the guide's second table.
"""

from __future__ import annotations

from functools import cache

import numpy as np
from extremes import COPIES, COUNT, DRAWN, NAMES, judge, scene

from csplat import EncodeOptions, SplatModel, decode
from csplat.encoder import EncodePlan, FixedQuantisation, fix_quantisation
from csplat_render import Camera
from csplat_render.rasteriser import Rasteriser
from csplat_render.scorer import ReferenceImage, Scorer
from csplat_render.virtual_cameras import virtual_cameras
from csplat_tools.optimise.pruning import Simplified, simplify
from csplat_tools.optimise.pruning_order import SimplifyOptions
from csplat_trainer.data import DataSet
from csplat_trainer.posed_images import PosedImage
from csplat_trainer.training_loop import train
from csplat_trainer.training_options import TrainOptions, TrainResult
from csplat_trainer.tuning import FinetuneOptions, TuningResult, renders_of, split_views, tune

SMALL = (160, 120)
FEW = SimplifyOptions(views=10, view_size=(60, 45))
QUICK = TrainOptions(
    max_splats=COUNT, sh_degree=1, iterations=120, refine_start=20, refine_every=20, log_every=40, background="black"
)
SHORT = FinetuneOptions(iterations=250, warm_up=10, validate_every=50, log_every=50)
COARSE = EncodeOptions(preset="small", attribute_psnr=36.0)
BLACK = np.zeros(3, np.float32)


def learnt_from(name: str) -> SplatModel:
    """The scene, in fewer copies if it is a million."""
    return scene(name)[0].select(slice(COPIES))


@cache
def small_judge(name: str) -> Scorer:
    """Return a judge that compares renders of 160×120 with those of the scene."""
    if name in DRAWN:
        return judge(name, SMALL)
    model = learnt_from(name)
    return Scorer.of_source(model, virtual_cameras(model, 8, *SMALL), (0.0, 0.0, 0.0))


@cache
def half(name: str) -> Simplified:
    """The scene with half its splats."""
    return simplify(learnt_from(name), keep=0.5, options=FEW)


def photographs(name: str, points: np.ndarray | None = None) -> DataSet:
    """Return photographs of a condition in front of black, and points."""
    model = learnt_from(name)
    return images_of(model, virtual_cameras(model, 12, 48, 40), points)


def images_of(model: SplatModel, cameras: list[Camera], points: np.ndarray | None = None) -> DataSet:
    """Return photographs of a scene in front of black, three of four to be learnt from, and points."""
    rasteriser, shots = Rasteriser(gradients=False), []
    for camera in cameras:
        pixels = np.clip(rasteriser.forward(model, camera).rgb, 0.0, 1.0)
        shots.append(PosedImage(camera, np.rint(pixels * 255).astype(np.uint8)))
    count = 3 * len(shots) // 4
    return DataSet("made", shots[:count], shots[count:], points)


@cache
def trained(name: str) -> TrainResult:
    """Splats that began at the centres of the scene's, and learnt from photographs of it."""
    return train(photographs(name, learnt_from(name).means[:COUNT]), QUICK)


@cache
def tuned(name: str, count: int = 52) -> tuple[FixedQuantisation, TuningResult, Scorer]:
    """Tune the scene as a file to `count` images but four; return it and a judge of those four."""
    source = learnt_from(name)
    views = split_views(
        renders_of(source, virtual_cameras(source, count, 48, 36), BLACK, None), BLACK, validation_count=4
    )
    fixed = fix_quantisation(EncodePlan.of(source, COARSE))
    aside = Scorer(
        [view.camera for view in views.validation],
        [ReferenceImage(view.reference.astype(np.float32)) for view in views.validation],
    )
    return fixed, tune(fixed, views, SHORT), aside


def before_and_after(name: str) -> tuple[SplatModel, SplatModel]:
    """Return what the file decodes to without and with tuning."""
    fixed, result, _ = tuned(name)
    before, after = (decode(fixed.encode(values).write().data) for values in (fixed.start(), result.best_values))
    return before, after


def figures(name: str) -> list[str]:
    """The row of a condition in the guide's second table."""
    losses = trained(name).log["losses"]
    cells = [name, f"{small_judge(name).psnr(half(name).model):.1f}"]
    cells.append(f"{np.mean(losses[:10]):.2f} → {np.mean(losses[-10:]):.2f}")
    if name == "exploded":
        return [*cells, "refused"]
    return [*cells, " → ".join(f"{tuned(name)[2].psnr(model):.1f}" for model in before_and_after(name))]


if __name__ == "__main__":
    for each in NAMES:
        print("| " + " | ".join(figures(each)) + " |")

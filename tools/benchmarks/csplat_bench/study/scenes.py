"""The scenes of the study: the published baseline and its variants, scenes with photographs, scenes without."""

from __future__ import annotations

import importlib.util
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from csplat.errors import InputError
from csplat.model import SplatModel
from csplat.ply import read_ply
from csplat_bench.common.captures import CAPTURES, Capture, Training, trained
from csplat_bench.common.scenes import DATA, OUT, cameras_of
from csplat_bench.study.judge import Distance, Views, renders_at
from csplat_render import Camera
from csplat_tools.views import BLACK, DataOptions, ViewSet, find_view_set
from csplat_trainer.training_options import TrainOptions

_LPIPS_WEIGHT = 0.1

#: The published study's training and variants of it, by name: how each differs.
BASELINES = {
    "study1k": "fixed 1,000 splats that start at random in the scene's box",
    "study1k-hull": "fixed 1,000 splats that start inside the visual hull of the masks",
    "study1k-short": "as study1k, stopped after 3/70 of the iterations, where it scores about what was published",
    "study1k-sh0": "as study1k, trained at SH degree 0",
    "study1k-mcmc": "densified: 500 splats grow to 1,000 (MCMC, dead splats move)",
    "study1k-lpips": f"as study1k, with {_LPIPS_WEIGHT} LPIPS in the loss",
}

#: Scenes of the compression benchmark, judged by photographs that were held out.
OTHERS = ("lego20k", "fox", "desk29")

#: Shared scenes without photographs, judged by renders of themselves.
OWN = ("lego60k", "plane3", "donut")

#: Widths of square renders of the baseline by itself, and how many of the test cameras they are made for.
RENDERED = {400: 50, 800: 25}


@dataclass(frozen=True, eq=False)
class Subject:
    """A scene that strategies are tried on.

    Attributes:
        name: name in tables and file names.
        source: the scene.
        ply: path of the PLY.
        training: seconds and options of its training; {} if it was not trained here.
        views: views by which it is judged.
        teachers: cameras that a lower SH degree is distilled by; None for virtual ones.
        judged_by: in words.
        images: a data set by which files are tuned; None if there are none.
    """

    name: str
    source: SplatModel
    ply: Path
    training: Training
    views: Views
    teachers: Sequence[Camera] | None
    judged_by: str
    images: ViewSet | None = None


def baselines(iterations: int, count: int) -> dict[str, Capture]:
    """Return how the baseline and its variants are trained, by name.

    Args:
        iterations: 7,000 as published.
        count: number of splats, 1,000 as published.
    """
    plain = TrainOptions(max_splats=count, sh_degree=1, iterations=iterations, strategy="none", init="box")
    how = {
        "study1k": plain,
        "study1k-hull": replace(plain, init="auto"),
        "study1k-short": replace(plain, iterations=max(1, 3 * iterations // 70)),
        "study1k-sh0": replace(plain, sh_degree=0),
        "study1k-mcmc": replace(plain, strategy="mcmc", init="auto"),
        "study1k-lpips": replace(plain, lpips_weight=_LPIPS_WEIGHT),
    }
    data = DATA / "images" / "lego200"
    return {name: Capture(name, data, (200, 200), training=options) for name, options in how.items()}


def open_subject(name: str, known: Mapping[str, Capture], out: Path, lpips: Distance | None, views: int = 0) -> Subject:
    """Find a scene, train it if it has to be trained, and read what it is judged by.

    Args:
        name: one of `BASELINES`, `OTHERS`, `OWN`.
        known: by name, how the baselines are trained.
        out: folder of the scenes that are trained for the study; others lie where the compression benchmark has them.
        lpips: measures the perceptual distance.
        views: test views at most, evenly spread; 0: all.

    Raises:
        InputError: a file that it needs is absent, or torch for a baseline with LPIPS in its loss.
    """
    if name in OWN:
        return _by_itself(name, lpips)
    if name == "study1k-lpips" and importlib.util.find_spec("torch") is None:
        raise InputError(f"{name}: a loss with LPIPS needs torch (pip install csplat[train])")
    scene = known[name] if name in known else CAPTURES[name]
    folder = out if name in known else OUT / "compression"
    if not scene.data.exists():
        raise InputError(f"{name}: {scene.data} does not exist")
    ply, training = trained(scene, folder)
    source = read_ply(ply)
    found = find_view_set(
        source, data=DataOptions(str(scene.data), scene.size), background=scene.background, validation_count=0
    )
    judge, teachers = found.image_test_scorer(), list(found.training)
    if views and views < len(judge.cameras):
        judge = judge.subset([number * len(judge.cameras) // views for number in range(views)])
    cameras = list(judge.cameras)
    wanted = [judge.reference(number).rgb for number in range(len(cameras))]
    by = f"{len(cameras)} photographs of {cameras[0].W}×{cameras[0].H} that were held out"
    judged = Views(cameras, wanted, scene.background, lpips)
    return Subject(name, source, ply, training, judged, teachers, by, found)


def larger(subject: Subject, width: int, count: int) -> Subject:
    """The same scene, judged by its own renders at another size: photographs of that size there are none.

    Args:
        subject: with square pictures.
        width: width of the renders, pixels.
        count: number of the test cameras, evenly spread.
    """
    cameras = [subject.views.cameras[number * len(subject.views.cameras) // count] for number in range(count)]
    scaled = [_scaled(camera, width / camera.W) for camera in cameras]
    views = renders_at(subject.source, scaled, subject.views.background, subject.views.lpips)
    by = f"{count} renders of the baseline itself at {width}×{width}"
    return replace(subject, name=f"{subject.name}@{width}", views=views, judged_by=by)


def _by_itself(name: str, lpips: Distance | None) -> Subject:
    ply = DATA / "ply" / f"{name}.ply"
    if not ply.exists():
        raise InputError(f"{name}: {ply} does not exist")
    source = read_ply(ply)
    cameras = cameras_of(name, source)
    views = renders_at(source, cameras, BLACK, lpips)
    return Subject(name, source, ply, {}, views, None, f"{len(cameras)} virtual views of the source itself")


def _scaled(camera: Camera, factor: float) -> Camera:
    K = np.diag([factor, factor, 1.0]) @ camera.K
    return replace(camera, K=K, W=round(factor * camera.W), H=round(factor * camera.H))

"""Measure the renderer: time of a picture and of its gradients, and how far the other modes are off.

    python -m csplat_bench.rendering                             # scenes with 90,000 and 500,000 splats in view
    python -m csplat_bench.rendering --scenes donut,plane3,lego60k,fox120k --markdown

One line per scene and mode: medians over the views of the data folder's cameras (640 by 480; else virtual ones) and
over rounds. `ms` is wall-clock time; `CPU ms` is the time of all threads together, which another program on the
machine disturbs less. `dB` is the PSNR against the standard mode, pooled over the views. Scenes called NAME@COUNT are
split as training splits them, and pruned until the given number of splats is in view (median of the cameras).

What pictures and gradients are off the exact twin: `pytest -rP tests/test_rasteriser.py`.
"""

from __future__ import annotations

import statistics
import sys
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Annotated, Literal

import numpy as np
import typer
from numpy.typing import NDArray

from csplat.model import SplatModel
from csplat.ply import read_ply
from csplat_bench.common.command import CACHE, JSON, MARKDOWN, SCENES, listed, run
from csplat_bench.common.measuring import Timing, medians, timed
from csplat_bench.common.report import optional, table, tell_machine, write_json
from csplat_bench.common.scenes import MADE, cameras_of, find_scenes
from csplat_render import Camera
from csplat_render.metrics import psnr_of_mse
from csplat_render.rasteriser import Rasteriser
from csplat_render.warmup import warm_up
from csplat_tools.console import note

_SCENES = "lego60k,fox120k,lego@90k,fox@90k,lego@500k,fox@500k"
_HEADER = (
    "scene", "splats", "SH", "in view", "mode", "forward ms", "CPU ms", "backward ms", "CPU ms", "dB",
)  # fmt: skip

Mode = Literal["standard", "fast"]
Pictures = list[NDArray[np.float32]]

#: By name of a line: the mode, and whether it is antialiased.
_LINES: dict[str, tuple[Mode, bool]] = {
    "standard": ("standard", False),
    "fast": ("fast", False),
    "antialiased": ("standard", True),
}


@dataclass(frozen=True)
class Rendered:
    """Medians over views and rounds.

    Attributes:
        in_view: splats that were drawn.
        forward, backward: seconds.
        psnr: against the standard mode, dB; `None`: of itself.
    """

    in_view: int
    forward: Timing
    backward: Timing
    psnr: float | None


def main(
    *,
    scenes: SCENES = _SCENES,
    threads: Annotated[int, typer.Option(help="of the renderer")] = 2,
    rounds: Annotated[int, typer.Option(help="over all views")] = 3,
    views: Annotated[int, typer.Option(help="how many of the cameras")] = 8,
    markdown: MARKDOWN = False,
    json: JSON = None,
    cache: CACHE = MADE,
) -> None:
    """Measure the scenes that the command line names, and print a table."""
    machine = tell_machine()
    warm_up(note)
    rows, figures = [], {}
    for scene in find_scenes(listed(scenes), cache):
        model = read_ply(scene.path)
        cameras = cameras_of(scene.name, model)[:views]
        reference: Pictures | None = None
        for name, (mode, antialiased) in _LINES.items():
            one, pictures = _measured(model, cameras, mode, antialiased, threads, rounds, reference)
            reference = reference or pictures
            times = (f"{1e3 * value:.1f}" for way in (one.forward, one.backward) for value in (way.wall, way.cpu))
            cells = (scene.name, f"{len(model):,}", model.sh_degree, f"{one.in_view:,}", name)
            rows.append((*cells, *times, optional(one.psnr, ".1f", "–")))
            figures[f"{scene.name} {name}"] = asdict(one)
        note(f"{scene.name} measured")
    print(table(_HEADER, rows, markdown=markdown))
    if json is not None:
        write_json(json, {"machine": machine, "threads": threads, "results": figures})


def _measured(
    model: SplatModel,
    cameras: Sequence[Camera],
    mode: Mode,
    antialiased: bool,
    threads: int,
    rounds: int,
    reference: Pictures | None,
) -> tuple[Rendered, Pictures]:
    """Times, and the pictures of the first round."""
    plain, training = (Rasteriser(mode, gradients=wanted, threads=threads) for wanted in (False, True))
    forward, backward, drawn = list[Timing](), list[Timing](), list[int]()
    pictures: Pictures = []
    for _ in range(rounds):
        for camera in cameras:
            picture, timing = timed(plain.forward, model, camera, antialiased=antialiased)
            forward.append(timing)
            training.forward(model, camera, antialiased=antialiased)
            backward.append(timed(training.backward, np.ones_like(picture.rgb))[1])
            if len(pictures) < len(cameras):
                pictures.append(picture.rgb.clip(0.0, 1.0))
                drawn.append(picture.drawn)
    psnr = None
    if reference is not None:
        psnr = psnr_of_mse(float(np.mean([np.mean((a - b) ** 2) for a, b in zip(pictures, reference, strict=True)])))
    return Rendered(int(statistics.median(drawn)), medians(forward), medians(backward), psnr), pictures


if __name__ == "__main__":
    sys.exit(run(main))

"""Measure the renderer: time of a picture and of its gradients against how far it is off the exact twin.

    python tools/benchmarks/render.py                             # scenes with 90,000 and 500,000 splats in view
    python tools/benchmarks/render.py --scenes donut,plane3,lego60k,fox120k --markdown
    python tools/benchmarks/render.py --pairs 0 --rounds 9        # times alone

One line per scene and mode: medians over the views of the data folder's cameras (640 by 480; else virtual ones) and
over rounds. `ms` is wall-clock time; `CPU ms` is the time of all threads together, which another program on the
machine disturbs less. `dB` is the PSNR against the standard mode, pooled over the views. The twin evaluates every
splat at every pixel: it renders the middle of each picture, pixel for pixel, as many pixels as --pairs allows. `off`
is the largest difference of a colour there, the share of pixels off by more than 1/255, and the mean difference.
Scenes called NAME@COUNT are split as training splits them, and thinned until so many splats lie in view (median of
the cameras).
"""

from __future__ import annotations

import argparse
import json
import statistics
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from crowds import cameras_of
from machine import describe_machine
from oracle import cropped, difference
from scenes import ROOT, find_scenes

from csplat.model import SplatModel
from csplat.ply import read_ply
from csplat_render import Camera, render
from csplat_render.rasterise import Rasteriser
from csplat_render.warmup import warm_up
from csplat_tools.files.console import format_table

_SCENES = "lego60k,fox120k,lego@90k,fox@90k,lego@500k,fox@500k"
#: Name of a line, mode, antialiased.
_LINES = (("standard", "standard", False), ("fast", "fast", False), ("antialiased", "standard", True))
_HEADER = [
    "scene", "splats", "SH", "in view", "mode", "forward ms", "CPU ms", "backward ms", "CPU ms", "dB",
    "off: most", "> 1/255", "mean", "twin",
]  # fmt: skip


def main() -> None:
    """Measure the scenes that the command line names, and print a table."""
    args = _arguments()
    machine = describe_machine(("numpy", "numba"))
    for key, value in machine.items():
        print(f"{key}: {value}", file=sys.stderr)
    warm_up(lambda line: print(line, file=sys.stderr))
    results: list[dict[str, Any]] = []
    for scene in find_scenes([name for name in args.scenes.split(",") if name], args.cache):
        model = read_ply(scene.path)
        cameras = cameras_of(scene.name, model)[: args.views]
        reference: list[Any] = []
        for name, mode, antialiased in _LINES:
            result = _measure(model, cameras, mode, antialiased, args, reference)
            results.append(
                {"scene": scene.name, "splats": len(model), "sh_degree": model.sh_degree, "mode": name, **result}
            )
        print(f"{scene.name} measured", file=sys.stderr, flush=True)
    lines = [_line(result) for result in results]
    print(_markdown(lines) if args.markdown else format_table(_HEADER, lines))
    if args.json is not None:
        args.json.write_text(
            json.dumps({"machine": machine, "threads": args.threads, "results": results}, indent=2) + "\n"
        )


def _measure(
    model: SplatModel,
    cameras: list[Camera],
    mode: str,
    antialiased: bool,
    args: argparse.Namespace,
    reference: list[Any],
) -> dict[str, Any]:
    """Median times over views and rounds; fill `reference` in the standard mode, compare with it in others."""
    plain, training = (Rasteriser(mode, gradients=wanted, threads=args.threads) for wanted in (False, True))
    forward, backward, pictures, drawn = [], [], [], []
    for round_ in range(args.rounds):
        for camera in cameras:
            picture, *times = _timed(lambda camera=camera: plain.forward(model, camera, antialiased=antialiased))
            forward.append(times)
            training.forward(model, camera, antialiased=antialiased)
            gradient = np.ones_like(picture.rgb)
            backward.append(_timed(lambda gradient=gradient: training.backward(gradient))[1:])
            if round_ == 0:
                pictures.append(picture.rgb.clip(0.0, 1.0))
                drawn.append(picture.drawn)
    if not reference:
        reference += pictures
    error = np.mean([np.mean((a - b) ** 2) for a, b in zip(pictures, reference, strict=True)])
    return {
        "in_view": int(statistics.median(drawn)),
        "forward_ms": statistics.median(wall for wall, _ in forward),
        "forward_cpu_ms": statistics.median(cpu for _, cpu in forward),
        "backward_ms": statistics.median(wall for wall, _ in backward),
        "backward_cpu_ms": statistics.median(cpu for _, cpu in backward),
        "psnr": float(-10.0 * np.log10(error)) if error > 0 else None,
        "off": _off_the_twin(model, cameras, mode, antialiased, args.pairs) if args.pairs else None,
    }


def _timed(call: Callable[[], Any]) -> tuple[Any, float, float]:
    """What a call returns, and its wall-clock and processor time in milliseconds."""
    wall, cpu = time.perf_counter(), time.process_time()
    result = call()
    return result, 1e3 * (time.perf_counter() - wall), 1e3 * (time.process_time() - cpu)


def _off_the_twin(
    model: SplatModel, cameras: list[Camera], mode: str, antialiased: bool, pairs: float
) -> dict[str, Any]:
    """Compare the middles of the pictures with the exact twin's."""
    pixels = pairs / (len(model) * len(cameras))
    width = max(8, min(cameras[0].W, round((pixels * 4 / 3) ** 0.5)))
    height = max(6, min(cameras[0].H, round(pixels / width)))
    found, wanted, seconds = [], [], 0.0
    for camera in cameras:
        view = cropped(camera, width, height)
        exact, wall, _ = _timed(lambda view=view: render(model, view, mode="exact", antialiased=antialiased))
        seconds += wall / 1e3
        wanted.append(exact.rgb)
        found.append(render(model, view, mode=mode, antialiased=antialiased).rgb)
    off = difference(np.concatenate(found), np.concatenate(wanted))
    return {"pixels": width * height * len(cameras), "seconds": seconds, **vars(off)}


def _line(result: dict[str, Any]) -> list[str]:
    off = result["off"]
    twin = ["–"] * 4
    if off is not None:
        twin = [f"{off['most']:.1e}", f"{100 * off['share']:.3f} %", f"{off['mean']:.1e}"]
        twin.append(f"{off['seconds']:.1f} s for {off['pixels']:,} pixels")
    return [
        result["scene"],
        f"{result['splats']:,}",
        str(result["sh_degree"]),
        f"{result['in_view']:,}",
        result["mode"],
        *(f"{result[key]:.1f}" for key in ("forward_ms", "forward_cpu_ms", "backward_ms", "backward_cpu_ms")),
        "–" if result["psnr"] is None else f"{result['psnr']:.1f}",
        *twin,
    ]


def _markdown(lines: list[list[str]]) -> str:
    return "\n".join("| " + " | ".join(line) + " |" for line in [_HEADER, ["---"] * len(_HEADER), *lines])


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", default=_SCENES, help="names, with commas; default: %(default)s")
    parser.add_argument("--threads", type=int, default=2, help="default: %(default)s")
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--views", type=int, default=8, help="how many of the cameras")
    parser.add_argument(
        "--pairs", type=float, default=3e8, help="splats times pixels for the twin; 0: none; default: %(default)g"
    )
    parser.add_argument("--markdown", action="store_true", help="print the table as FIGURES.md has it")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the numbers there too")
    parser.add_argument("--cache", type=Path, default=ROOT / "out" / "scenes", help="where scenes are made")
    return parser.parse_args()


if __name__ == "__main__":
    main()

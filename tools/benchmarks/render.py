"""Measure the renderer: time of a picture and of its gradients, and what a faster mode costs in error.

    python tools/benchmarks/render.py                          # the sample and the shared scenes; a minute
    python tools/benchmarks/render.py --scenes fox120k --threads 1 --rounds 9
    python tools/benchmarks/render.py --exact 4                # also against the exact twin, at a quarter of the size

One line per scene and mode: median over the views of the data folder's cameras (640 by 480; else virtual ones) and over
rounds. `ms` is wall-clock time; `CPU ms` is the time of all threads together, which another program on the machine
disturbs less. `dB` is the PSNR against the standard mode, pooled over the views. The first call's compile time stands
on standard error.
"""

from __future__ import annotations

import argparse
import json
import statistics
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from machine import describe_machine
from scenes import DATA, ROOT, find_scenes

from csplat.model import SplatModel
from csplat.ply import read_ply
from csplat_render import Camera, render
from csplat_render.cameras import load_cameras
from csplat_render.rasterise import Rasteriser
from csplat_render.virtual import virtual_cameras
from csplat_render.warmup import warm_up
from csplat_tools.console import format_table

_SCENES = "sample,donut,plane3,lego60k,fox60k_noreg,fox120k,fox-1M"
_HEADER = [
    "scene", "splats", "SH", "in view", "mode", "forward ms", "CPU ms", "backward ms", "CPU ms", "dB", "off the twin",
]  # fmt: skip


def main() -> None:
    """Measure the scenes that the command line names, and print a table."""
    args = _arguments()
    for key, value in describe_machine(("numpy", "numba")).items():
        print(f"{key}: {value}", file=sys.stderr)
    seconds = warm_up(lambda line: print(line, file=sys.stderr))
    print(f"first call: {seconds:.1f} s (compiled, or loaded from numba's cache)", file=sys.stderr)
    results = []
    for scene in find_scenes([name for name in args.scenes.split(",") if name], args.cache):
        model = read_ply(scene.path)
        cameras = _cameras(scene.name, model)[: args.views]
        reference: list[Any] = []
        for mode in ("standard", "fast"):
            result = _measure(model, cameras, mode, args, reference)
            results.append({"scene": scene.name, "splats": len(model), "sh_degree": model.sh_degree, **result})
    print(format_table(_HEADER, [_line(result) for result in results]))
    if args.json is not None:
        args.json.write_text(json.dumps(results, indent=2) + "\n")


def _cameras(name: str, model: SplatModel) -> list[Camera]:
    path = DATA / "psnr_cameras" / f"{name.replace('-1M', '120k')}.json"
    return list(load_cameras(path) if path.exists() else virtual_cameras(model))


def _measure(
    model: SplatModel, cameras: list[Camera], mode: str, args: argparse.Namespace, reference: list[Any]
) -> dict[str, Any]:
    """Median times over views and rounds; fill `reference` in the standard mode, compare with it in others."""
    rasteriser = Rasteriser(mode, threads=args.threads)
    forward, backward, pictures, drawn = [], [], [], []
    for round_ in range(args.rounds):
        for camera in cameras:
            picture, *times = _timed(lambda camera=camera: rasteriser.forward(model, camera))
            forward.append(times)
            gradient = np.ones_like(picture.rgb)
            _, *times = _timed(lambda gradient=gradient: rasteriser.backward(gradient))
            backward.append(times)
            if round_ == 0:
                pictures.append(picture.rgb.clip(0.0, 1.0))
                drawn.append(picture.drawn)
    if not reference:
        reference += pictures
    error = np.mean([np.mean((a - b) ** 2) for a, b in zip(pictures, reference, strict=True)])
    return {
        "mode": mode,
        "in_view": int(statistics.median(drawn)),
        "forward_ms": statistics.median(wall for wall, _ in forward),
        "forward_cpu_ms": statistics.median(cpu for _, cpu in forward),
        "backward_ms": statistics.median(wall for wall, _ in backward),
        "backward_cpu_ms": statistics.median(cpu for _, cpu in backward),
        "psnr": float(-10.0 * np.log10(error)) if error > 0 else None,
        "off_the_twin": _off_the_twin(model, cameras[0], mode, args.exact) if args.exact else None,
    }


def _timed(call: Callable[[], Any]) -> tuple[Any, float, float]:
    """What a call returns, and its wall-clock and processor time in milliseconds."""
    wall, cpu = time.perf_counter(), time.process_time()
    result = call()
    return result, 1e3 * (time.perf_counter() - wall), 1e3 * (time.process_time() - cpu)


def _off_the_twin(model: SplatModel, camera: Camera, mode: str, shrink: int) -> dict[str, float]:
    """Mean difference from the exact twin, and the share of pixels that differ by more than 1/255."""
    K = camera.K.copy()
    K[:2] /= shrink
    small = replace(camera, K=K, W=camera.W // shrink, H=camera.H // shrink)
    difference = np.abs(render(model, small, mode=mode).rgb - render(model, small, mode="exact").rgb)
    return {"mean": float(difference.mean()), "pixels": float(np.mean(difference.max(2) > 1 / 255))}


def _line(result: dict[str, Any]) -> list[str]:
    off = result["off_the_twin"]
    return [
        result["scene"],
        str(result["splats"]),
        str(result["sh_degree"]),
        str(result["in_view"]),
        result["mode"],
        *(f"{result[key]:.1f}" for key in ("forward_ms", "forward_cpu_ms", "backward_ms", "backward_cpu_ms")),
        "–" if result["psnr"] is None else f"{result['psnr']:.1f}",
        "–" if off is None else f"{off['mean']:.1e}, {100 * off['pixels']:.2f} %",
    ]


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", default=_SCENES, help="names, with commas")
    parser.add_argument("--threads", type=int, help="default: all")
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--views", type=int, default=8, help="how many of the cameras")
    parser.add_argument("--exact", type=int, default=0, metavar="N", help="compare with the twin at 1/N of the size")
    parser.add_argument("--json", type=Path, help="write the numbers there too")
    parser.add_argument("--cache", type=Path, default=ROOT / "out" / "scenes", help="where large scenes are made")
    return parser.parse_args()


if __name__ == "__main__":
    main()

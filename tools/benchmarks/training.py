"""Measure a step of training, stage by stage, and the memory that training takes.

    python tools/benchmarks/training.py                        # Lego of the data folder; two minutes
    python tools/benchmarks/training.py FOLDER --rows 20000:200x200 --steps 100

FOLDER is a data set. Each row runs in a process of its own: splats start as in training, with SH degree 3 and pictures
of the row's size, --warm steps make their sizes realistic, then as many steps as --steps are timed, medians. Memory is
what the process grew by at its largest, from the moment that the pictures were read.
"""

from __future__ import annotations

import argparse
import json
import statistics
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from child import peak_bytes, reset_peak
from machine import describe_machine
from scenes import DATA

from csplat_tools.files.console import format_table

_ROWS = "1000:200x200,20000:200x200,100000:400x400,500000:640x480"
_STAGES = ("forward", "loss", "backward", "Adam", "other")
_DEGREE = 3


def main() -> None:
    """Measure the rows that the command line names, each in a process of its own, and print a table."""
    args = _arguments()
    if args.child:
        json.dump(_measure(args.folder, *_row(args.rows), args.warm, args.steps, args.threads), sys.stdout)
        return
    machine = describe_machine(("numpy", "numba"))
    for key, value in machine.items():
        print(f"{key}: {value}", file=sys.stderr)
    results = []
    for row in args.rows.split(","):
        command = [sys.executable, __file__, str(args.folder), "--child", "--rows", row, "--warm", str(args.warm)]
        command += ["--steps", str(args.steps), *(["--threads", str(args.threads)] if args.threads else [])]
        results.append(json.loads(subprocess.run(command, check=True, stdout=subprocess.PIPE).stdout))
        print(f"{row} measured", file=sys.stderr, flush=True)
    header = ["splats", "pixels", "step ms", "CPU ms", *(f"{name} ms" for name in _STAGES)]
    header += ["PSNR dB", "memory MB", "B/splat", "B/pixel"]
    print(format_table(header, [_line(result) for result in results]))
    if args.json is not None:
        args.json.write_text(json.dumps({"machine": machine, "results": results}, indent=2) + "\n")


def _measure(
    folder: Path, count: int, size: tuple[int, int], warm: int, steps: int, threads: int | None
) -> dict[str, Any]:
    from csplat_render.jit import thread_count
    from csplat_trainer.data import load
    from csplat_trainer.options import TrainOptions
    from csplat_trainer.parameters import Parameters
    from csplat_trainer.starting import scene_of, starting_splats

    data = load(folder, size)
    data.read()
    pictures = data.train
    options = TrainOptions(max_splats=count, sh_degree=_DEGREE, strategy="fixed", iterations=warm + steps)
    rng, scene = np.random.default_rng(0), scene_of(pictures)
    with thread_count(threads):
        _walk(pictures[:1], options, Parameters.starting_at(starting_splats(pictures, scene, 10, _DEGREE, rng)), 2)
        before = reset_peak()
        start = starting_splats(pictures, scene, count, _DEGREE, rng)
        parameters = Parameters.starting_at(start)
        _walk(pictures, options, parameters, warm)
        times, errors = _walk(pictures, options, parameters, steps)
    growth = peak_bytes() - before
    pixels = size[0] * size[1]
    return {
        "splats": count,
        "width": size[0],
        "height": size[1],
        "milliseconds": {name: 1e3 * statistics.median(values) for name, values in times.items()},
        "psnr": float(-10.0 * np.log10(np.mean(errors))),
        "memory_bytes": growth,
        "bytes_per_splat": growth / count,
        "bytes_per_pixel": growth / pixels,
    }


def _walk(pictures: Any, options: Any, parameters: Any, steps: int) -> tuple[dict[str, list[float]], list[float]]:
    """Make steps of training; the seconds of each stage, and the mean squared errors."""
    from csplat_trainer import engine as module
    from csplat_trainer.engine import CpuEngine
    from csplat_trainer.starting import scene_of

    spent: dict[str, float] = {}

    def clocked(name: str, call: Callable[..., Any]) -> Callable[..., Any]:
        def run(*args: Any, **keywords: Any) -> Any:
            start = time.perf_counter()
            result = call(*args, **keywords)
            spent[name] = spent.get(name, 0.0) + time.perf_counter() - start
            return result

        return run

    engine, rng, extent = CpuEngine(parameters, options), np.random.default_rng(1), scene_of(pictures).extent
    rasteriser, adam, loss_for = engine._rasteriser, module.adam_step, engine._loss_for  # noqa: SLF001 - the stages
    changed: list[tuple[Any, str, Callable[..., Any]]] = [
        (rasteriser, "forward", clocked("forward", rasteriser.forward)),
        (rasteriser, "backward", clocked("backward", rasteriser.backward)),
        (module, "adam_step", clocked("Adam", adam)),
        (engine, "_loss_for", lambda camera: (clocked("loss", loss_for(camera)[0]), loss_for(camera)[1])),
    ]
    for owner, name, call in changed:
        setattr(owner, name, call)
    times: dict[str, list[float]] = {name: [] for name in ("step", "CPU", *_STAGES)}
    errors, background = [], np.ones(3, np.float32)
    try:
        for step in range(steps):
            spent.clear()
            wall, cpu = time.perf_counter(), time.process_time()
            rates = options.learning_rates(step + 1, extent)
            errors.append(engine.step(pictures[step % len(pictures)], background, _DEGREE, rates, rng).mse)
            times["step"].append(time.perf_counter() - wall)
            times["CPU"].append(time.process_time() - cpu)
            spent["other"] = times["step"][-1] - sum(spent.values())
            for name in _STAGES:
                times[name].append(spent[name])
    finally:
        module.adam_step = adam
    return times, errors


def _row(text: str) -> tuple[int, tuple[int, int]]:
    count, _, size = text.partition(":")
    width, _, height = size.partition("x")
    return int(count), (int(width), int(height))


def _line(result: dict[str, Any]) -> list[str]:
    return [
        f"{result['splats']:,}",
        f"{result['width']}×{result['height']}",
        *(f"{result['milliseconds'][name]:.1f}" for name in ("step", "CPU", *_STAGES)),
        f"{result['psnr']:.1f}",
        f"{result['memory_bytes'] / 1e6:.0f}",
        f"{result['bytes_per_splat']:.0f}",
        f"{result['bytes_per_pixel']:.0f}",
    ]


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, nargs="?", default=DATA / "images" / "lego200", help="a data set")
    parser.add_argument("--rows", default=_ROWS, help="SPLATS:WIDTHxHEIGHT, with commas; default: %(default)s")
    parser.add_argument("--warm", type=int, default=200, help="steps before the clock starts; default: %(default)s")
    parser.add_argument("--steps", type=int, default=60, help="steps that are timed; default: %(default)s")
    parser.add_argument("--threads", type=int, help="default: all")
    parser.add_argument("--child", action="store_true", help="measure the one row here and print JSON")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the numbers there too")
    return parser.parse_args()


if __name__ == "__main__":
    main()

"""Measure the rasteriser's gradients: relative L2 error of each group of parameters.

    python tools/benchmarks/gradients.py                     # two minutes
    python tools/benchmarks/gradients.py --scenes donut --json gradients.json

Three tables: float64 kernels against finite differences of the exact twin, and against torch's autograd of the same
equations where torch is installed; float32 against float64 on the scenes of the data folder; the same on adversarial
splats. `flipped` are pixels where a comparison fell the other way in float32: as many splats are left out.
"""

from __future__ import annotations

import argparse
import importlib.util
import json
import sys
from pathlib import Path
from typing import Any

import numpy as np
from machine import describe_machine
from oracle import (
    GROUPS,
    VIEW,
    adversarial,
    finite_differences,
    float32_errors,
    gradients_of,
    random_gradients,
    random_splats,
    relative_error,
)
from scenes import DATA, ROOT, find_scenes

from csplat.ply import read_ply
from csplat_render.arrays import Splats
from csplat_render.cameras import load_cameras
from csplat_tools.files.console import format_table

_SCENES = "donut,horse,jacket,plane3,lego60k,fox60k_noreg,fox120k"
_SPLATS = 9
_BACKGROUND = (0.2, 0.5, 0.7)


def main() -> None:
    """Measure and print the tables."""
    args = _arguments()
    machine = describe_machine(("numpy", "numba", "torch"))
    for key, value in machine.items():
        print(f"{key}: {value}", file=sys.stderr)
    tables = {
        "float64 against": _against_the_twin(),
        "float32, scene": _on_scenes([name for name in args.scenes.split(",") if name]),
        "float32, case": _on_adversarial(),
    }
    for title, rows in tables.items():
        extra = [key for key in rows[0] if key not in ("name", *GROUPS)]
        cells = [
            [row["name"], *(str(row[key]) for key in extra), *(_cell(row[group]) for group in GROUPS)] for row in rows
        ]
        print(format_table([title, *extra, *GROUPS], cells), end="\n\n")
    if args.json is not None:
        args.json.write_text(json.dumps({"machine": machine, **tables}, indent=2) + "\n")


def _against_the_twin() -> list[dict[str, Any]]:
    rows: list[dict[str, Any]] = []
    for degree in range(4):
        for antialiased in (False, True):
            arrays, weights = random_splats(_SPLATS, degree, seed=degree), random_gradients(VIEW, seed=1)
            options: dict[str, Any] = {"background": _BACKGROUND, "antialiased": antialiased}
            _, found = gradients_of(Splats(**arrays), VIEW, weights, **options)
            wanted = {"finite differences": finite_differences(arrays, VIEW, weights, **options)[1]}
            if importlib.util.find_spec("torch") is not None:
                from torch_twin import autograd_gradients

                wanted["autograd"] = autograd_gradients(arrays, VIEW, weights, **options)[1]
            for name, slopes in wanted.items():
                errors = {group: relative_error(getattr(found, group), slopes[group]) for group in GROUPS}
                shown = f"{name}, SH {degree}{', antialiased' if antialiased else ''}"
                rows.append({"name": shown, **errors, **({} if degree else {"shN": None})})
    return rows


def _on_scenes(names: list[str]) -> list[dict[str, Any]]:
    rows: list[dict[str, Any]] = []
    for scene in find_scenes(names, ROOT / "out" / "scenes") if names else []:
        model, path = read_ply(scene.path), DATA / "psnr_cameras" / f"{scene.name}.json"
        if not path.exists():
            continue
        view = load_cameras(path)[0]
        flipped, errors = float32_errors(model, view, random_gradients(view, seed=2))
        rows.append({"name": scene.name, "flipped": flipped, **errors})
        if not model.sh_degree:
            rows[-1]["shN"] = None
    return rows or [{"name": "no shared scenes", **dict.fromkeys(GROUPS)}]


def _on_adversarial() -> list[dict[str, Any]]:
    rows: list[dict[str, Any]] = []
    for name, case in adversarial():
        splats, weights = Splats(**case.arrays), random_gradients(case.view, seed=1)
        flipped, errors = float32_errors(splats, case.view, weights, antialiased=case.antialiased)
        _, found = gradients_of(splats, case.view, weights, np.float32, antialiased=case.antialiased)
        finite = all(np.isfinite(getattr(found, group)).all() for group in GROUPS)
        shown: dict[str, float | None] = {**errors}
        if case.beyond:
            shown = dict.fromkeys(GROUPS)
        rows.append({"name": name, "flipped": flipped, "finite": "yes" if finite else "NO", **shown})
    return rows


def _cell(error: float | None) -> str:
    return "–" if error is None else f"{error:.1e}"


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", default=_SCENES, help="names, with commas; default: %(default)s")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the numbers there too")
    return parser.parse_args()


if __name__ == "__main__":
    main()

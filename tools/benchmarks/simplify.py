"""Measure simplification: what is left of a scene when splats go, by which method, and what a file of it costs.

    python tools/benchmarks/simplify.py removal --scenes plane3,donut      # PSNR by share removed and method
    python tools/benchmarks/simplify.py files --scenes plane3 --psnr 40    # bytes at equal PSNR, with and without
    python tools/benchmarks/simplify.py pass                               # the pass beside a render, and its twin
    python tools/benchmarks/simplify.py bands --scenes plane3              # ways to write bands that are absent
    python tools/benchmarks/simplify.py tables                             # print what was measured, plot it

What was measured is kept scene by scene in out/simplify/NAME.json: a run that is interrupted goes on where it ended.
PSNR is against the source, on cameras that decided nothing: those of the data folder (psnr_cameras/NAME.json).
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from machine import describe_machine
from scenes import DATA, ROOT
from simplify_tables import plot_files, tables

from csplat.encoder import EncodeOptions, encode_with_report
from csplat.model import SplatModel
from csplat.ply import read_ply
from csplat_render.cameras import load_cameras
from csplat_render.conventions import TRANSMITTANCE_MIN
from csplat_render.rasterise import Rasteriser
from csplat_render.removal import measure_removal, removal_exact
from csplat_render.virtual import virtual_cameras
from csplat_tools.simplify import SimplifyOptions, Target, encode_simplified
from csplat_tools.simplify.core import prepare
from csplat_tools.simplify.judge import Judge
from csplat_tools.simplify.views import VIEW_SIZE, camera_sequence

_SCENES = "plane3,lego60k,fox120k,fox60k_noreg,donut,jacket,statue"
_METHODS = ("opacity", "opacity-area", "exact", "rounds")


def main() -> None:
    """Measure what the command line names."""
    args = _arguments()
    args.out.mkdir(parents=True, exist_ok=True)
    if args.what != "tables":
        for key, value in describe_machine(("numpy", "numba", "deflate")).items():
            print(f"{key}: {value}", file=sys.stderr)
        for name in [name for name in args.scenes.split(",") if name]:
            path = _scene_path(name, args.extra)
            if path is None:
                print(f"absent: {name}", file=sys.stderr)
                continue
            {"removal": _removal, "files": _files, "pass": _pass, "bands": _bands}[args.what](name, path, args)
    results = {path.stem: json.loads(path.read_text()) for path in sorted(args.out.glob("*.json"))}
    print(tables(results))
    plot_files(results, args.out / "files.png")


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("removal", "files", "pass", "bands", "tables"))
    parser.add_argument("--scenes", default=_SCENES, help="names, separated by commas; default: %(default)s")
    parser.add_argument("--extra", type=Path, nargs="+", default=[], metavar="PLY", help="further scenes, by file")
    parser.add_argument("--gone", default="10,20,30,40,50,60,70,80", help="per cent removed; default: %(default)s")
    parser.add_argument("--psnr", default="34,37,40,43", help="of files, dB; default: %(default)s")
    parser.add_argument("--views", type=int, default=160, help="at most; default: %(default)s")
    parser.add_argument("--out", type=Path, default=ROOT / "out" / "simplify", help="default: %(default)s")
    return parser.parse_args()


def _scene_path(name: str, extra: list[Path]) -> Path | None:
    candidates = [path for path in extra if path.stem == name] + [DATA / "ply" / f"{name}.ply"]
    return next((path for path in candidates if path.exists()), None)


def _judge(name: str, source: SplatModel) -> Judge:
    path = DATA / "psnr_cameras" / f"{name}.json"
    return Judge.of_source(source, load_cameras(path) if path.exists() else virtual_cameras(source), (0.0, 0.0, 0.0))


class _Kept:
    """Results of a scene, on disk after each one. Owns the file."""

    def __init__(self, name: str, out: Path) -> None:
        self.path = out / f"{name}.json"
        self.values: dict[str, Any] = json.loads(self.path.read_text()) if self.path.exists() else {}

    def measure(self, kind: str, key: str, call: Callable[[], Any]) -> Any:
        """Return what is known, or find it out and keep it."""
        known = self.values.setdefault(kind, {})
        if key not in known:
            start = time.perf_counter()
            known[key] = call()
            self.path.write_text(json.dumps(self.values, indent=1) + "\n")
            print(f"{self.path.stem} {kind} {key}: {time.perf_counter() - start:.0f} s", file=sys.stderr, flush=True)
        return known[key]


def _removal(name: str, path: Path, args: argparse.Namespace) -> None:
    """Each method at each share removed, without and with a fit of colours."""
    source, kept = read_ply(path), _Kept(name, args.out)
    judge = _judge(name, source)
    for percent in (int(text) for text in args.gone.split(",")):
        for method in _METHODS:
            fits = method == "rounds"
            kept.measure(
                "removal", f"{percent} {method}", lambda p=percent, m=method, f=fits: _one(source, judge, p, m, f, args)
            )


def _one(
    source: SplatModel, judge: Judge, percent: int, method: str, fits: bool, args: argparse.Namespace
) -> dict[str, Any]:
    start = time.perf_counter()
    options = SimplifyOptions(method=method, views=args.views, bands=False)
    session = prepare(source, None, 1.0 - percent / 100.0, options)
    gone = min(round(len(source) * percent / 100.0), len(session.order.rows))
    rows = session.pruned(gone)
    result: dict[str, Any] = {
        "psnr": judge.psnr(source.select(rows)),
        "seconds": time.perf_counter() - start,
        "views": len(session.views.used),
        "gone": gone,
    }
    if fits:
        start = time.perf_counter()
        fitted = session.fitted(rows, session.threshold(gone))
        result["fit_seconds"] = time.perf_counter() - start
        result["fit_psnr"] = judge.psnr(fitted.model)
        own = Judge(session.views.used, session.wanted)
        result["used_psnr"], result["check_psnr"] = own.psnr(fitted.model), session.checked.psnr(fitted.model)
    return result


def _files(name: str, path: Path, args: argparse.Namespace) -> None:
    """Bytes per source splat at equal PSNR: the smallest of what was tried, and of what was not simplified."""
    source, kept = read_ply(path), _Kept(name, args.out)
    cameras = DATA / "psnr_cameras" / f"{name}.json"
    for goal in (float(text) for text in args.psnr.split(",")):

        def measured(goal: float = goal) -> dict[str, Any]:
            start = time.perf_counter()
            judged = load_cameras(cameras) if cameras.exists() else None
            file = encode_simplified(
                source, target=Target(psnr=goal), options=SimplifyOptions(views=args.views), judged_by=judged
            )
            tried = file.report["tried"]
            return {
                "tried": tried,
                "plain_bytes": min((one["size_bytes"] for one in tried if one["splats"] == len(source)), default=None),
                "size_bytes": len(file.result.data),
                "psnr": file.report["psnr"],
                "splats": file.report["splats"],
                "source_splats": len(source),
                "zero_bands": file.report.get("zero_bands"),
                "seconds": time.perf_counter() - start,
            }

        kept.measure("files", f"{goal:g}", measured)


def _pass(name: str, path: Path, args: argparse.Namespace) -> None:
    """Seconds of the pass and of plain renders of the same views; difference from the twin on a thinned scene."""
    source, kept = read_ply(path), _Kept(name, args.out)
    cameras = camera_sequence(source, 24, VIEW_SIZE)

    def seconds() -> dict[str, Any]:
        rasteriser = Rasteriser(gradients=False)
        best = {"render": np.inf, "pass": np.inf}
        for _ in range(3):
            start = time.perf_counter()
            for camera in cameras:
                rasteriser.forward(source, camera, antialiased=source.antialiased)
            best["render"] = min(best["render"], time.perf_counter() - start)
            start = time.perf_counter()
            measure_removal(source, cameras)
            best["pass"] = min(best["pass"], time.perf_counter() - start)
        return {"views": len(cameras), **best}

    def twin() -> dict[str, Any]:
        thin = source.select(slice(0, None, max(1, len(source) // 3000)))
        view = replace(cameras[0], K=np.diag([64 / 240, 64 / 240, 1.0]) @ cameras[0].K, W=64, H=48)
        seen = np.flatnonzero(measure_removal(thin, [view]).error > 0.0)
        rows = np.random.default_rng(0).choice(seen, min(len(seen), 40), replace=False)
        found = {}
        for rule, least in (("never finished", 0.0), ("finished", TRANSMITTANCE_MIN)):
            error = measure_removal(thin, [view], transmittance_min=least).error[rows]
            exact = removal_exact(thin, [view], rows, transmittance_min=least)
            off = np.abs(error - exact) / np.maximum(exact, 1e-9 * exact.max())
            total = abs(float(error.sum() / exact.sum()) - 1.0)
            found[rule] = {"largest": float(off.max()), "median": float(np.median(off)), "sum": total}
        return found

    kept.measure("pass", "seconds", seconds)
    kept.measure("pass", "twin", twin)


def _bands(name: str, path: Path, args: argparse.Namespace) -> None:
    """Bytes of the SH of half a scene whose bands have gone where they show least, written in four ways."""
    source, kept = read_ply(path), _Kept(name, args.out)
    if not source.sh_degree:
        return

    def measured() -> dict[str, Any]:
        session = prepare(source, None, 0.5, SimplifyOptions(views=args.views))
        gone = min(len(source) // 2, len(session.order.rows))
        fitted = session.fitted(session.pruned(gone), session.threshold(gone))
        model, stays = fitted.model, fitted.stays
        assert stays is not None
        scalar = EncodeOptions(sh_coding="scalar")
        geometry = len(encode_with_report(replace(model, shN=model.shN[:, :0]), scalar).data)
        degrees = stays.shape[1] - np.argmax(stays[:, ::-1], axis=1)
        degrees[~stays.any(axis=1)] = 0
        cut = 0
        for degree in range(stays.shape[1] + 1):  # tiles that lack the upper bands as a whole
            rows = np.flatnonzero(degrees == degree)
            if len(rows):
                part = model.select(rows)
                part = replace(part, shN=np.ascontiguousarray(part.shN[:, : (degree + 1) ** 2 - 1]))
                cut += len(encode_with_report(part, scalar).data)
        return {
            "splats": len(model),
            "absent": (~stays).mean(axis=0).tolist(),
            "zero codebooks": len(encode_with_report(model, scalar).data) - geometry,
            "tile cut": cut - geometry,
            "k-means codebook": len(encode_with_report(model, EncodeOptions(sh_coding="codebook")).data) - geometry,
            "values for all": _values_for_all(model, scalar) - geometry,
        }

    kept.measure("bands", "50", measured)


def _values_for_all(model: SplatModel, options: EncodeOptions) -> int:
    """Size of a file in which every splat has values: bytes of zeros, which DEFLATE makes runs of."""
    from csplat.encoder import sparse

    threshold, sparse._WORTH_TRYING = sparse._WORTH_TRYING, 2.0  # noqa: SLF001 - what would be without it
    try:
        return len(encode_with_report(model, options).data)
    finally:
        sparse._WORTH_TRYING = threshold  # noqa: SLF001 - as above


if __name__ == "__main__":
    main()

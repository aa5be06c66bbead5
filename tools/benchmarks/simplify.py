"""Measure simplification: what is left of a scene when splats go, by which method; `targets.py` has files of it.

    python tools/benchmarks/simplify.py removal --scenes plane3,donut      # PSNR by share removed and method
    python tools/benchmarks/simplify.py pass                               # the pass beside a render, and its twin
    python tools/benchmarks/simplify.py bands --scenes plane3              # ways to write bands that are absent
    python tools/benchmarks/simplify.py tables                             # print what was measured

What was measured is kept scene by scene in out/simplify/NAME.json: a run that is interrupted goes on where it ended.
PSNR is against the source, on cameras that decided nothing: those of the data folder (psnr_cameras/NAME.json).
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Sequence
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from kept import Kept
from machine import describe_machine
from scenes import DATA, ROOT
from simplify_tables import tables

from csplat.encoder import EncodeOptions, encode_with_report
from csplat.model import SplatModel
from csplat.ply import read_ply
from csplat_render import Camera
from csplat_render.cameras import direction, intrinsics, load_cameras, look_at
from csplat_render.conventions import TRANSMITTANCE_MIN
from csplat_render.judge import Judge, Look, renderer
from csplat_render.rasterise import Rasteriser
from csplat_render.refit import ColourOperator
from csplat_render.removal import measure_removal, removal_exact
from csplat_render.virtual import FIELD_OF_VIEW, scene_frame, virtual_cameras
from csplat_tools.optimise.simplify import SimplifyOptions
from csplat_tools.optimise.simplify.colours import fit
from csplat_tools.optimise.simplify.order import removal_order
from csplat_tools.optimise.simplify.simplify import prepare
from csplat_tools.views import BLACK, VIEW_SIZE, ViewSet, camera_sequence, find_view_set, with_deciders
from csplat_tools.views.agreeing import Measured, find_views

_SCENES = "plane3,lego60k,fox120k,fox60k_noreg,donut,jacket,statue"
_METHODS = ("opacity", "opacity-area", "exact", "rounds")
_FAR = 2.5  # extents


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
            {"removal": _removal, "pass": _pass, "bands": _bands}[args.what](name, path, args)
    results = {path.stem: json.loads(path.read_text()) for path in sorted(args.out.glob("*.json"))}
    print(tables(results))


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("removal", "pass", "bands", "tables"))
    parser.add_argument("--scenes", default=_SCENES, help="names, separated by commas; default: %(default)s")
    parser.add_argument("--extra", type=Path, nargs="+", default=[], metavar="PLY", help="further scenes, by file")
    parser.add_argument("--gone", default="10,20,30,40,50,60,70,80", help="per cent removed; default: %(default)s")
    parser.add_argument("--far", action="store_true", help="removal seen from twice as far, too")
    parser.add_argument("--views", type=int, default=160, help="at most; default: %(default)s")
    parser.add_argument("--out", type=Path, default=ROOT / "out" / "simplify", help="default: %(default)s")
    return parser.parse_args()


def _scene_path(name: str, extra: list[Path]) -> Path | None:
    candidates = [path for path in extra if path.stem == name] + [DATA / "ply" / f"{name}.ply"]
    return next((path for path in candidates if path.exists()), None)


def _judge(name: str, source: SplatModel) -> Judge:
    path = DATA / "psnr_cameras" / f"{name}.json"
    return Judge.of_source(source, load_cameras(path) if path.exists() else virtual_cameras(source), (0.0, 0.0, 0.0))


def _removal(name: str, path: Path, args: argparse.Namespace) -> None:
    """Each method at each share removed; the last one without and with a fit, of colours and of all that is fitted."""
    source, kept = read_ply(path), Kept(args.out / f"{name}.json")
    options = SimplifyOptions(views=args.views, bands=False)
    near = _Bench(source, _judge(name, source), options)
    away, others = _far_cameras(source)
    careless = replace(options, keep_unseen=False)
    far = _Bench(source, Judge.of_source(source, others, (0.0, 0.0, 0.0)), careless, away)
    for percent in (int(text) for text in args.gone.split(",")):
        for method in _METHODS:
            kept.measure("removal", f"{percent} {method}", lambda p=percent, m=method: near.one(p, m))
        if args.far:
            kept.measure("removal", f"{percent} far", lambda p=percent: far.one(p, "rounds"))


def _rendered(source: SplatModel, cameras: Sequence[Camera]) -> list[Any]:
    draw = renderer(source, BLACK)
    return [draw(camera).rgb for camera in cameras]


def _far_cameras(source: SplatModel) -> tuple[list[Camera], list[Camera]]:
    """Cameras that see a scene small, twice as far away as those of `psnr`: 46 to decide by, 8 to judge by.

    With them, and with what they do not show removed first, figures look much better than seen from near.
    """
    frame = scene_frame(source)
    K = intrinsics(480, 360, FIELD_OF_VIEW)
    cameras = []
    for number in range(54):
        height = np.degrees(np.arcsin(0.98 - 1.96 * (number + 0.5) / 54))
        eye = frame.centre + _FAR * frame.extent * direction(frame.up, 137.508 * number, height)
        cameras.append(look_at(eye, frame.centre, frame.up, K, 480, 360, frame.near))
    judges = set(range(3, 54, 7))
    return [c for i, c in enumerate(cameras) if i not in judges], [cameras[i] for i in sorted(judges)]


class _Bench:
    """Simplifies one scene over and over. Owns its views, found once."""

    def __init__(
        self, source: SplatModel, judge: Judge, options: SimplifyOptions, cameras: list[Camera] | None = None
    ) -> None:
        self._source, self._judge, self._options, self._cameras = source, judge, options, cameras

    @cached_property
    def _views(self) -> Measured:
        if self._cameras is None:
            return find_views(self._source, find_view_set(self._source, count=self._options.views), 0.5)
        own = with_deciders(ViewSet("far", BLACK, self._cameras, (), ()))
        return find_views(self._source, own, 0.5, size=(480, 360))

    @cached_property
    def _wanted(self) -> list[Any]:
        return _rendered(self._source, self._views.used)

    @cached_property
    def _checked(self) -> Judge:
        return Judge.of_source(self._source, self._views.check, (0.0, 0.0, 0.0))

    def one(self, percent: int, method: str) -> dict[str, Any]:
        """Remove a share by a method."""
        source, options = self._source, replace(self._options, method=method)
        views = self._views
        start = time.perf_counter()
        left = round(len(source) * (1.0 - percent / 100.0))
        order = removal_order(source, views, options, left)
        gone = min(len(source) - left, len(order.rows))
        model = source.select(order.kept(len(source), gone))
        result: dict[str, Any] = {"seconds": time.perf_counter() - start, "views": len(views.used), "gone": gone}
        result["psnr"] = self._judge.psnr(model)
        if method != "rounds":
            return result
        wanted, own = self._wanted, Judge(views.used, [Look(picture) for picture in self._wanted])
        for prefix, adjusted in (("fit", False), ("adjusted", True)):
            start = time.perf_counter()
            fitted = fit(model, views.used, wanted, replace(options, adjust=adjusted)).model
            result[f"{prefix}_seconds"] = time.perf_counter() - start
            result[f"{prefix}_psnr"] = self._judge.psnr(fitted)
            result[f"{prefix}_used"], result[f"{prefix}_check"] = own.psnr(fitted), self._checked.psnr(fitted)
        return result


def _pass(name: str, path: Path, args: argparse.Namespace) -> None:
    """Seconds of the pass and of plain renders of the same views; difference from the twin on a thinned scene."""
    source, kept = read_ply(path), Kept(args.out / f"{name}.json")
    cameras = camera_sequence(source, 24, VIEW_SIZE)

    def seconds() -> dict[str, Any]:
        rasteriser = Rasteriser(gradients=False)
        best = {"render": np.inf, "pass": np.inf, "step": np.inf}
        wanted = _rendered(source, cameras)
        colours = np.concatenate([source.sh0[:, None], source.shN], axis=1)
        operator, gradient = ColourOperator(source, cameras), np.zeros_like(colours)
        operator.error(colours, wanted, gradient)
        for _ in range(3):
            start = time.perf_counter()
            for camera in cameras:
                rasteriser.forward(source, camera, antialiased=source.antialiased)
            best["render"] = min(best["render"], time.perf_counter() - start)
            start = time.perf_counter()
            measure_removal(source, cameras)
            best["pass"] = min(best["pass"], time.perf_counter() - start)
            start = time.perf_counter()
            operator.normal(colours, gradient)
            best["step"] = min(best["step"], time.perf_counter() - start)
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
    """Bytes of the SH of half a scene whose bands have gone where they show least, written in five ways."""
    source, kept = read_ply(path), Kept(args.out / f"{name}.json")
    if not source.sh_degree:
        return

    def measured() -> dict[str, Any]:
        session = prepare(source, None, len(source) - len(source) // 2, SimplifyOptions(views=args.views))
        gone = min(len(source) // 2, len(session.order.rows))
        fitted = session.fitted(session.pruned(gone))
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
            "as runs": _values_for_all(model, scalar, long_run=1) - geometry,
        }

    kept.measure("bands", "50", measured)


def _values_for_all(model: SplatModel, options: EncodeOptions, long_run: int | None = None) -> int:
    """Size of a file in which every splat has values: bytes of zeros, left to DEFLATE, or as runs where they come so.

    Args:
        model: the scene.
        options: of the encoder.
        long_run: mean length from which runs are written as such, bytes; None: the encoder's.
    """
    from csplat.encoder import sparse, streams

    before = sparse._WORTH_TRYING, streams._LONG_RUN  # noqa: SLF001 - what would be without them
    sparse._WORTH_TRYING, streams._LONG_RUN = 2.0, long_run or before[1]  # noqa: SLF001 - as above
    try:
        return len(encode_with_report(model, options).data)
    finally:
        sparse._WORTH_TRYING, streams._LONG_RUN = before  # noqa: SLF001 - as above


if __name__ == "__main__":
    main()

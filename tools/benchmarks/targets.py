"""Measure what targets give: bytes, PSNR and seconds, beside presets, fixed shares of the splats, and another build.

    python tools/benchmarks/targets.py                                  # what is missing; hours on two cores
    python tools/benchmarks/targets.py --scenes plane3,donut --psnr 38 --sizes 4,8
    python tools/benchmarks/targets.py --build before --csplat OTHER/.venv/bin/csplat --removal=--simplify
    python tools/benchmarks/targets.py --tables --markdown              # print what was measured

Every file is written by the command line in a process of its own, and judged from sixteen virtual cameras that no
search consults: those of `psnr`, but for the seed. What was measured is kept in tools/benchmarks/targets/NAME.json,
file by file: an interrupted run goes on where it ended. A row is *beaten* where another file of the same scene is
smaller by more than 1 % and better by more than 0.1 dB; files that hold every splat are compared among themselves.
"""

from __future__ import annotations

import argparse
import json
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from machine import describe_machine
from scenes import ROOT, Scene, named_scenes
from targets_tables import tables

from csplat.decoder import decode
from csplat.encoder import PRESETS
from csplat.files import atomic_writer
from csplat.model import SplatModel
from csplat.ply import read_ply
from csplat_render.judge import Judge
from csplat_render.virtual import virtual_cameras
from csplat_tools.views import BLACK

_SCENES = "plane3,horse,donut,jacket,lego60k,fox60k_noreg,angel,fox120k,st-peter,statue"  # the quick ones first
_REMOVAL = "plane3,horse,jacket,lego60k"
_PSNRS = "30,34,38,42,46"
_KEEPS = (0.7, 0.5)
_SEEDS = (1, 2)  # of the judging cameras; targets judge by seed 0


@dataclass(frozen=True)
class Row:
    """A file to make.

    Attributes:
        name: unique in its scene.
        arguments: of `csplat encode`.
        all_splats: whether every splat of the source has to be there.
    """

    name: str
    arguments: Sequence[str]
    all_splats: bool


def main() -> None:
    """Measure what the command line names, and print the tables."""
    args = _arguments()
    args.kept.mkdir(parents=True, exist_ok=True)
    names = _words(args.scenes)
    if not args.tables:
        if shutil.which(args.csplat) is None:
            sys.exit(f"error: no such program: {args.csplat}")
        for scene in named_scenes(names, ROOT / "out" / "scenes"):
            _measure(scene, args)
    known = {path.stem: json.loads(path.read_text()) for path in args.kept.glob("*.json")}
    print(tables({name: known[name] for name in names if name in known}, markdown=args.markdown))


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", default=_SCENES, help="names, separated by commas; default: %(default)s")
    parser.add_argument(
        "--with-removal", default=_REMOVAL, help="scenes whose splats may go, too; default: %(default)s"
    )
    parser.add_argument("--psnr", default=_PSNRS, help="dB; default: %(default)s")
    parser.add_argument("--sizes", default="", help="bytes per splat of the source, as 4,8; default: none")
    parser.add_argument("--build", default="now", help="under which name rows are kept; default: %(default)s")
    parser.add_argument("--csplat", default=str(Path(sys.executable).with_name("csplat")), help="the program measured")
    parser.add_argument("--removal", default="", help="option with which that program's targets remove splats")
    parser.add_argument("--again", action="store_true", help="forget this build's rows of these scenes")
    parser.add_argument("--tables", action="store_true", help="measure nothing")
    parser.add_argument("--markdown", action="store_true", help="print tables as a guide has them")
    parser.add_argument("--kept", type=Path, default=Path(__file__).with_name("targets"), help="default: %(default)s")
    return parser.parse_args()


def _words(text: str) -> list[str]:
    return [word for word in text.split(",") if word]


def _rows(scene: Scene, args: argparse.Namespace) -> Iterator[Row]:
    """What is made of a scene, what is quick first."""
    for preset in PRESETS:
        yield Row(preset, ["--preset", preset], True)
    goals = {f"{float(text):g} dB": ["--target-psnr", text] for text in _words(args.psnr)}
    goals |= {
        f"{float(text):g} B/splat": ["--target-size", f"{float(text) * scene.splat_count:.0f}"]
        for text in _words(args.sizes)
    }
    for name, target in goals.items():
        yield Row(f"{name}, every splat", [*target, "--keep-all"], True)
    if scene.name in _words(args.with_removal):
        fewer = {f"keep {keep:g}": ["--keep", f"{keep:g}"] for keep in _KEEPS} | goals
        for name, target in fewer.items():
            yield Row(name, [*_words(args.removal), *target], False)


def _measure(scene: Scene, args: argparse.Namespace) -> None:
    """Make what is missing of a scene, and keep each file's figures."""
    path = args.kept / f"{scene.name}.json"
    known: dict[str, Any] = json.loads(path.read_text()) if path.exists() else {}
    known |= {"splats": scene.splat_count, "sh_degree": scene.sh_degree, "ply_bytes": scene.size_bytes}
    builds = known.setdefault("builds", {})
    if args.again:
        builds.pop(args.build, None)
    machine = describe_machine(("numpy", "numba"))["machine"]
    build = builds.setdefault(args.build, {"machine": machine, "rows": {}})
    missing = [row for row in _rows(scene, args) if row.name not in build["rows"]]
    judge = _judge(read_ply(scene.path)) if missing else None
    for row in missing:
        assert judge is not None
        build["rows"][row.name] = found = _made(args.csplat, scene, row, judge)
        if machine != build["machine"]:
            found["machine"] = machine  # its seconds are not to be compared with those of other rows
        with atomic_writer(path) as stream:
            stream.write((json.dumps(known, indent=1) + "\n").encode())
        print(f"{scene.name} {args.build} {row.name}: {json.dumps(found)}", file=sys.stderr, flush=True)


def _judge(source: SplatModel) -> Judge:
    """Cameras that no search knows, and what the source looks like from them."""
    cameras = [camera for seed in _SEEDS for camera in virtual_cameras(source, 8, 640, 480, seed=seed)]
    return Judge.of_source(source, cameras, BLACK)


def _made(program: str, scene: Scene, row: Row, judge: Judge) -> dict[str, Any]:
    """Make a file in a process of its own, and judge it; or say why there is none."""
    with tempfile.TemporaryDirectory() as folder:
        output = Path(folder) / "file.csplat"
        start = time.perf_counter()
        command = [program, "encode", str(scene.path), str(output), *row.arguments, "--json"]
        done = subprocess.run(command, check=False, capture_output=True, text=True)
        seconds = round(time.perf_counter() - start, 1)
        if done.returncode:
            said = done.stderr.strip().splitlines() or [f"status {done.returncode}"]
            return {"error": said[-1], "seconds": seconds}
        report, model = json.loads(done.stdout), decode(output.read_bytes())
    stated = (report.get("target") or report.get("simplified") or {}).get("psnr")
    return {
        "bytes": report["size_bytes"],
        "splats": report["splats"],
        "psnr": round(judge.psnr(model), 3),
        "stated": None if stated is None else round(stated, 3),
        "seconds": seconds,
        "all_splats": row.all_splats,
    }


if __name__ == "__main__":
    main()

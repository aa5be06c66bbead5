"""Train and score the benchmark scenes that papers report, whichever of them lie under a folder.

    python tools/benchmarks/datasets.py ROOT --out runs --lpips alex.npz
    python tools/benchmarks/datasets.py ROOT --scenes garden,truck --iterations 30000 --max-splats 1000000
    python tools/benchmarks/datasets.py ROOT --scenes fox --size 270x480 --iterations 4500 --max-splats 120000

Known are Mip-NeRF 360 (images_4 outdoors, images_2 indoors), Tanks and Temples (train, truck), Deep Blending
(drjohnson, playroom) and NeRF-synthetic; any other COLMAP, Blender or transforms.json set is scored too. Pictures wider
than 1600 pixels are scaled down to that; every 8th picture is held out where the set names no test pictures.

Each scene is trained, written as a PLY, scored on its held-out pictures, encoded with each preset, and the decoded
files are scored on the same pictures. PSNR is the mean over the pictures, as papers print it; SSIM has INRIA's window;
LPIPS is AlexNet's. A scene whose PLY lies in --out is not trained again; the PLY of another trainer may be laid there.
Where other programs want the same cores, OPENBLAS_NUM_THREADS=1 keeps LPIPS from waiting for its own threads.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import sys
from pathlib import Path
from typing import Any

from dataset_folders import SceneFolder, choose_scenes, find_scene_folders
from dataset_runs import Settings, run_scene
from dataset_tables import means_table, notes, one_line, scenes_table
from machine import describe_machine

from csplat.encoder import PRESETS
from csplat.errors import CsplatError, InputError
from csplat.files import atomic_writer
from csplat_render.lpips import Lpips, load_lpips
from csplat_render.warmup import warm_up
from csplat_trainer.options import TrainOptions

_ROOT = Path(__file__).resolve().parents[2]


def main(words: list[str] | None = None) -> int:
    """Find the scenes, run them one after the other, print the tables.

    Args:
        words: the command line without its first word; `None`: the process's.

    Returns:
        0: all is done; 1: nothing was found, or a scene failed (the others are in the tables).
    """
    # Read when GNU OpenMP is loaded: threads that wait for each other sleep soon, see `csplat train`.
    os.environ.setdefault("GOMP_SPINCOUNT", "1000")
    parser = _parser()
    arguments = parser.parse_args(words)
    settings = _settings(parser, arguments)
    try:
        scenes = choose_scenes(find_scene_folders(arguments.root, _tell), arguments.scenes)
        lpips = _weights(arguments.lpips)
        arguments.out.mkdir(parents=True, exist_ok=True)
        if arguments.json is not None:
            arguments.json.parent.stat()
    except (CsplatError, OSError) as error:
        _tell(f"error: {error}")
        return 1
    for one in scenes:
        _tell(f"found {one.title} ({one.protocol.name}, {one.kind}) in {one.path}")
    warm_up(_tell)
    rows, failed = _run_all(scenes, settings, arguments, lpips)
    if not rows:
        return 1
    machine = describe_machine(("numpy", "numba", "deflate"))
    if arguments.json is not None:
        _write_log(arguments.json, machine, rows, failed)
    _print_report(rows, machine, markdown=arguments.markdown)
    return 1 if failed else 0


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("root", type=Path, metavar="ROOT", help="folder with data sets, or one of them")
    parser.add_argument("--scenes", metavar="NAMES", help="only these, separated by commas")
    parser.add_argument("--iterations", type=int, default=7000, help="training steps; papers 30000 (default: 7000)")
    parser.add_argument("--max-splats", type=int, default=200_000, help="no more than this (default: 200000)")
    parser.add_argument("--sh-degree", type=int, default=3, help="default: 3")
    parser.add_argument("--seed", type=int, default=0, help="default: 0")
    parser.add_argument("--device", default="cpu", help="cpu, or cuda with gsplat (default: cpu)")
    parser.add_argument("--size", metavar="WxH", help="bring all pictures to this size")
    parser.add_argument("--downscale", type=float, default=1.0, help="divide the papers' width and height by this")
    parser.add_argument("--presets", default=",".join(PRESETS), help="of the encoder; default: %(default)s")
    parser.add_argument("--lpips", metavar="FILE", help="weights of LPIPS-Alex, or auto for the usual places")
    parser.add_argument("--pictures", type=int, default=3, metavar="N", help="test views to write, per scene (3)")
    parser.add_argument(
        "--out", type=Path, default=_ROOT / "out" / "datasets", help="folder for PLYs, records and pictures"
    )
    parser.add_argument("--json", type=Path, metavar="LOG", help="write all numbers, for programs")
    parser.add_argument("--markdown", action="store_true", help="print tables for documents")
    parser.add_argument("--force", action="store_true", help="train again what is trained")
    parser.add_argument("--rescore", action="store_true", help="encode and score again what is scored")
    return parser


def _settings(parser: argparse.ArgumentParser, arguments: argparse.Namespace) -> Settings:
    size = None
    if arguments.size is not None:
        found = re.fullmatch(r"([1-9]\d{0,4})x([1-9]\d{0,4})", arguments.size)
        if found is None:
            parser.error(f"--size is {arguments.size}, wanted width and height, as 640x480")
        size = (int(found[1]), int(found[2]))
        if arguments.downscale != 1.0:
            parser.error("--size and --downscale exclude each other")
    if not arguments.downscale >= 1.0:
        parser.error(f"--downscale is {arguments.downscale:g}, wanted 1 or more")
    presets = tuple(name for name in arguments.presets.split(",") if name)
    unknown = set(presets) - set(PRESETS)
    if unknown:
        parser.error(f"--presets names {', '.join(sorted(unknown))}, wanted some of {', '.join(PRESETS)}")
    try:
        TrainOptions(
            iterations=arguments.iterations,
            max_splats=arguments.max_splats,
            sh_degree=arguments.sh_degree,
            seed=arguments.seed,
            device=arguments.device,
        )
    except InputError as error:
        parser.error(str(error))
    return Settings(
        iterations=arguments.iterations,
        max_splats=arguments.max_splats,
        sh_degree=arguments.sh_degree,
        seed=arguments.seed,
        device=arguments.device,
        size=size,
        downscale=arguments.downscale,
        presets=presets,
        pictures=max(0, arguments.pictures),
        force=arguments.force,
        rescore=arguments.rescore,
    )


def _weights(name: str | None) -> Lpips | None:
    return None if name is None else load_lpips(None if name == "auto" else name)


def _run_all(
    scenes: list[SceneFolder], settings: Settings, arguments: argparse.Namespace, lpips: Lpips | None
) -> tuple[list[dict[str, Any]], dict[str, str]]:
    """Run each scene; one that fails does not stop the others."""
    rows, failed = [], {}
    for number, scene in enumerate(scenes):
        _tell(f"-- {number + 1} of {len(scenes)}: {scene.title}")
        try:
            row = run_scene(scene, settings, arguments.out, lpips, _tell)
        except (CsplatError, OSError) as error:
            failed[scene.title] = str(error)
            _tell(f"error: {scene.title}: {error}")
            continue
        rows.append(row)
        _tell(one_line(row))
    return rows, failed


def _print_report(rows: list[dict[str, Any]], machine: dict[str, str], *, markdown: bool) -> None:
    print(scenes_table(rows, markdown=markdown))
    means = means_table(rows, markdown=markdown)
    if means is not None:
        print(f"\nMeans\n\n{means}")
    remarks = notes(rows)
    if remarks:
        print("\n" + "\n".join(remarks))
    if remarks and sys.stderr.isatty() and not sys.stdout.isatty():  # whoever looks at the terminal must see it too
        _tell("\n".join(remarks))
    print("\n" + "\n".join(f"{name}: {text}" for name, text in machine.items()))


def _write_log(path: Path, machine: dict[str, str], rows: list[dict[str, Any]], failed: dict[str, str]) -> None:
    document = {"machine": machine, "scenes": rows, "failed": failed, "notes": notes(rows)}
    with atomic_writer(path) as stream:
        stream.write(json.dumps(document, indent=1, allow_nan=False).encode() + b"\n")


def _tell(text: str) -> None:
    print(text, file=sys.stderr, flush=True)


if __name__ == "__main__":
    sys.exit(main())

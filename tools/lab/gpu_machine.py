# SPDX-License-Identifier: Apache-2.0
"""Train and tune a benchmark scene on a machine with a GPU that has neither a network nor csplat.

    python tools/lab/gpu_machine.py pack garden pieces            # here: the scene and wheels, in small folders
    python tools/lab/gpu_machine.py unpack pieces/1 work          # there: once for each of them
    python tools/lab/gpu_machine.py run work --seconds 450        # there: until its exit status is 0

The machine needs this repository, with its renderer compiled by `python trainer/csplat_render/native/build.py`; Python
with torch, Pillow and typer; and nvcc of torch's CUDA version, which compiles gsplat in a minute. Each `run` ends in
time, and the next continues from checkpoints and finished files, in the folder work/bench/captures. `--suite
captures_cpu` does the same without a GPU, at a quarter of the size. Files (.csplat with .json) may be copied into that
folder of another machine, which scores them by the same suite.
"""

from __future__ import annotations

import argparse
import os
import shutil
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

_ROOT = Path(__file__).resolve().parent.parent.parent
_PACKAGES = ("codec", "trainer", "tools", "tools/lab")
_WHEELS = ("gsplat==1.5.3", "plyfile", "zstandard", "deflate")  # what machines with torch usually lack
_PLATFORMS = ("manylinux_2_28", "manylinux_2_17", "manylinux2014", "manylinux1")  # pip matches names exactly


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a subcommand, and return its exit status."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = parser.add_subparsers(required=True, dest="command")
    pack = commands.add_parser("pack", help="copy a data set and wheels into folders of a limited size")
    pack.add_argument("data", type=Path, help="folder of a scene, named as in the papers")
    pack.add_argument("pieces", type=Path, help="folder to write: 1, 2, …")
    pack.add_argument("--megabytes", type=float, default=40.0, help="largest piece, default 40")
    pack.add_argument("--python", default="3.12", help="Python of the other machine, default 3.12")
    pack.add_argument("--no-wheels", action="store_true", help="the data set alone")
    unpack = commands.add_parser("unpack", help="copy a piece into a work folder, and install its wheels")
    unpack.add_argument("piece", type=Path)
    unpack.add_argument("work", type=Path)
    run = commands.add_parser("run", help="train, tune and score; status 3: time is over, run it again")
    run.add_argument("work", type=Path)
    run.add_argument("--seconds", type=float, default=450.0, help="time limit, default 450")
    run.add_argument("--suite", default="captures", help="captures, or captures_cpu")
    run.add_argument("--only", action="append", default=[], help="pattern of case names, e.g. '4 MB'")
    given = parser.parse_args(arguments)
    if given.command == "pack":
        if not given.data.is_dir():
            parser.error(f"{given.data} is not a folder")
        if given.pieces.exists() and any(given.pieces.iterdir()):
            parser.error(f"{given.pieces} is not empty")
        wheels = given.pieces / "wheels"
        if not given.no_wheels:
            _download(wheels, given.python)
        count = pack_pieces(given.data, given.pieces, round(1e6 * given.megabytes), wheels)
        print(f"{count} pieces in {given.pieces}")
        return 0
    if given.command == "unpack":
        if not given.piece.is_dir():
            parser.error(f"{given.piece} is not a folder")
        return unpack_piece(given.piece, given.work)
    return run_suite(given.work, given.suite, given.only, given.seconds)


def pack_pieces(data: Path, pieces: Path, size: int, wheels: Path) -> int:
    """Copy a data set, and a folder of wheels if there is one, into folders of at most `size` bytes, if files allow.

    Returns:
        Number of folders, 1, 2, … in `pieces`.
    """
    files = [(path, Path("wheels") / path.name) for path in sorted(wheels.glob("*.whl"))]
    files += [
        (path, Path("data") / data.absolute().name / path.relative_to(data))
        for folder, _, names in sorted(os.walk(data, followlinks=True))
        for path in (Path(folder) / name for name in sorted(names))
    ]
    number, left = 0, 0
    for path, place in files:
        if not number or path.stat().st_size > left:
            number, left = number + 1, size
        left -= path.stat().st_size
        target = pieces / str(number) / place
        target.parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(path, target)
    shutil.rmtree(wheels, ignore_errors=True)
    return number


def unpack_piece(piece: Path, work: Path) -> int:
    """Copy a piece into a work folder, and install its wheels there; return pip's status."""
    shutil.copytree(piece, work, dirs_exist_ok=True)
    wheels = sorted(str(path) for path in (piece / "wheels").glob("*.whl"))
    if not wheels:
        return 0
    options = ["--quiet", "--no-index", "--no-deps", "--upgrade", "--target", str(work / "site")]
    return subprocess.run([sys.executable, "-m", "pip", "install", *options, *wheels], check=False).returncode


def run_suite(work: Path, suite: str, only: Sequence[str], seconds: float) -> int:
    """Run a suite of captures on the scenes of a work folder.

    Returns:
        Status of the suite; 3 if the time was over.
    """
    paths = [str(work / "site"), *(str(_ROOT / name) for name in _PACKAGES), os.environ.get("PYTHONPATH", "")]
    environment = {
        "TORCH_EXTENSIONS_DIR": str(work / "extensions"),
        **os.environ,
        "PYTHONPATH": os.pathsep.join(filter(None, paths)),
    }
    command = [sys.executable, "-m", "csplat_bench", "run", suite, "--data", str(work / "data")]
    command += ["--work", str(work / "bench"), *(word for pattern in only for word in ("--only", pattern))]
    try:
        return subprocess.run(command, env=environment, timeout=seconds, check=False).returncode
    except subprocess.TimeoutExpired:
        print("time is over: run it again to continue", file=sys.stderr)
        return 3


def _download(folder: Path, python: str) -> None:
    platforms = [word for name in _PLATFORMS for word in ("--platform", f"{name}_x86_64")]
    options = ["--no-deps", "--only-binary=:all:", "--implementation", "cp", "--python-version", python, *platforms]
    for wheel in _WHEELS:
        subprocess.run([sys.executable, "-m", "pip", "download", "-q", *options, "-d", str(folder), wheel], check=True)


if __name__ == "__main__":
    raise SystemExit(main())

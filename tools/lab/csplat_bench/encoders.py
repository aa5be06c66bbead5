# SPDX-License-Identifier: Apache-2.0
"""Encoders: functions that make a file of a scene, registered by the key that selects them in a case.

command = "encode --preset fast"    # csplat's command line, in a process of its own
bytes_per_splat = 4                 # with command: --target-size, by the number of splats
suffix = ".spz"                     # the file that the command writes ends in this. Default: .csplat
peer = "spz"                        # splat-transform; see `peers.PEERS`
library = "spz"                     # SPZ's C++ library
format = "spz4"                     # `csplat.formats.write`, in a process of its own
"""

from __future__ import annotations

import json
import shlex
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from csplat.decoder import decode
from csplat.errors import InputError
from csplat.formats import format_by_name, read, write
from csplat.model import SplatModel
from csplat.ply import read_ply
from csplat_bench.measuring import alone, run_program, timed
from csplat_bench.peers import DRIVERS, build_with_spz, read_peer, splat_transform_version, write_peer
from csplat_bench.protocol import Setup
from csplat_bench.scenes import Scene
from csplat_bench.suites import Case


@dataclass(frozen=True)
class MadeFile:
    """A file that an encoder made of a scene.

    Attributes:
        path: the file.
        values: fields of its row: time and memory, what the command reports.
        read: reads it.
    """

    path: Path
    values: Mapping[str, Any]
    read: Callable[[], SplatModel]

    @cached_property
    def model(self) -> SplatModel:
        """The decoded scene."""
        return self.read()


Encoder = Callable[[Setup, Scene, Case, Path], MadeFile]


def make_file(setup: Setup, scene: Scene, case: Case, folder: Path) -> MadeFile:
    """Make a file of a scene in a folder by the encoder of a case.

    Raises:
        InputError: the case names no encoder.
    """
    for key, encoder in ENCODERS.items():
        if key in case.settings:
            return encoder(setup, scene, case, folder)
    raise InputError(f"case {case.name!r} names no encoder, expected one of {', '.join(ENCODERS)}")


def _by_command(setup: Setup, scene: Scene, case: Case, folder: Path) -> MadeFile:
    path = folder / f"file{case.get('suffix', '.csplat')}"
    name, *words = shlex.split(case["command"])
    if "bytes_per_splat" in case.settings:
        words += ["--target-size", f"{case['bytes_per_splat'] * scene.splat_count:.0f}"]
    used = run_program([*setup.csplat, name, scene.path, path, *words, "--force", "--quiet", "--json"])
    report = json.loads(used.stdout)
    target = report.get("target") or report.get("simplified") or {}
    values = {
        "seconds": used.wall, "cpu_seconds": used.cpu, "peak_bytes": used.peak_bytes,
        "kept_splats": report.get("splats", scene.splat_count), "declared_psnr": target.get("psnr"),
    }  # fmt: skip
    return MadeFile(path, values, lambda: read_file(path))


def _by_peer(setup: Setup, scene: Scene, case: Case, folder: Path) -> MadeFile:
    path = folder / f"file.{case['peer']}"
    used = write_peer(case["peer"], scene.path, scene.splat_count, scene.sh_degree, path, setup.peers)
    values = {
        "seconds": used.wall, "cpu_seconds": used.cpu, "peak_bytes": used.peak_bytes,
        "program": splat_transform_version(setup.peers),
    }  # fmt: skip
    return MadeFile(path, values, lambda: read_peer(path, setup.peers))


def _by_library(setup: Setup, scene: Scene, _: Case, folder: Path) -> MadeFile:
    path, program = folder / "file.spz", setup.peers / "spz_encode"
    if not program.exists():
        build_with_spz(DRIVERS / "spz_encode.cc", program, setup.peers)
    used = run_program([program, scene.path, path])
    wall, cpu = map(float, used.stdout.split())
    values = {
        "seconds": used.wall, "cpu_seconds": used.cpu, "peak_bytes": used.peak_bytes,
        "encode_seconds": wall, "encode_cpu_seconds": cpu,
    }  # fmt: skip
    return MadeFile(path, values, lambda: read(path))


def _by_format(_: Setup, scene: Scene, case: Case, folder: Path) -> MadeFile:
    name = case["format"]
    path = folder / f"file{format_by_name(name).suffixes[0]}"
    wall, cpu = alone(_write_timed, scene.path, path, name)
    return MadeFile(path, {"seconds": wall, "cpu_seconds": cpu}, lambda: read(path, name))


def _write_timed(source: Path, path: Path, name: str) -> tuple[float, float]:
    _, timing = timed(write, path, read_ply(source), name)
    return timing.wall, timing.cpu


def read_file(path: Path) -> SplatModel:
    """Read a scene: a .csplat file by the decoder, any other by its format."""
    return decode(path.read_bytes()) if path.suffix == ".csplat" else read(path)


ENCODERS: dict[str, Encoder] = {
    "command": _by_command, "peer": _by_peer, "library": _by_library, "format": _by_format,
}  # fmt: skip

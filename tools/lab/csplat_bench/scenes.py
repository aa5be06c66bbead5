# SPDX-License-Identifier: Apache-2.0
"""Scenes that benchmarks measure: the sample, those of the data folder, scenes made of them, and any PLY.

lego60k         a PLY or SOG of the data folder
path/scene.ply  any PLY
fox120k-4M      copies side by side, each a little different in every number; fox120k-4M-sh0: of that SH degree
lego60k@90k     splats split as training splits them, then pruned until 90,000 are in view of the scene's cameras
"""

from __future__ import annotations

import math
import os
import re
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np

from csplat import scene as scenes
from csplat.model import SplatModel
from csplat.ply import read_ply, write_ply, write_scene_ply
from csplat_bench.made_scenes import copies, crowd
from csplat_bench.protocol import AbsentError
from csplat_render import Camera
from csplat_render.camera_files import load_cameras
from csplat_render.scorer import Scorer
from csplat_render.virtual_cameras import virtual_cameras
from csplat_tools.views import BLACK, comparison_cameras

ROOT = Path(__file__).resolve().parents[3]
DATA = Path(os.environ.get("CSPLAT_DATA", ROOT.parent / "shared" / "data"))
OUT = ROOT / "out"

#: The scene that ships with the project.
SAMPLE = ROOT / "tools" / "csplat_tools" / "data" / "sample.ply"

_MADE = re.compile(r"(?P<base>.+?)(?P<kind>[-@])(?P<count>\d+)(?P<unit>[kM])(-sh(?P<degree>[0-3]))?")
_UNITS = {"k": 1_000, "M": 1_000_000}
_UNSEEN_SEEDS = (1, 2)  # seeds of virtual cameras; searches and `csplat compare` use seed 0


@dataclass(frozen=True)
class Scene:
    """A PLY to measure on.

    Attributes:
        name: its name in results.
        path: the PLY.
        cameras: cameras of the data folder; empty if it has none.
        splat_count, sh_degree: as in its header.
    """

    name: str
    path: Path
    cameras: Sequence[Camera]
    splat_count: int
    sh_degree: int

    @property
    def size_bytes(self) -> int:
        """Size of the PLY."""
        return self.path.stat().st_size

    def scorer(self, source: SplatModel, views: str = "given") -> Scorer:
        """Return a scorer against renders of the source in front of black, 640 by 480.

        Args:
            source: the scene, read.
            views: `given`: the cameras of the data folder, else those of `csplat compare`; `unseen`: sixteen virtual
                ones that no search uses; `virtual`: those of `csplat compare`.
        """
        cameras = {"given": self.cameras or comparison_cameras(source), "virtual": comparison_cameras(source)}.get(
            views, [camera for seed in _UNSEEN_SEEDS for camera in virtual_cameras(source, 8, 640, 480, seed=seed)]
        )
        return Scorer.of_source(source, cameras, BLACK)


def find_scene(name: str, data: Path, work: Path) -> Scene:
    """Find or make a scene.

    Args:
        name: see the module's documentation.
        data: the data folder.
        work: folder for scenes that are made.

    Raises:
        AbsentError: neither the scene nor what it is made of exists.
    """
    work.mkdir(parents=True, exist_ok=True)
    if name.endswith(".ply"):
        return _describe(Path(name).stem, Path(name), [])
    made = _MADE.fullmatch(name)
    base = made["base"] if made else name
    cameras = data / "psnr_cameras" / f"{base}.json"
    given = load_cameras(cameras) if cameras.exists() else []
    path = _base_path(base, data, work)
    if made:
        source, path = path, work / f"{name}.ply"
        if not path.exists():
            _make(path, read_ply(source), given, made)
    return _describe(name, path, given)


def _base_path(name: str, data: Path, work: Path) -> Path:
    plain = SAMPLE if name == "sample" else data / "ply" / f"{name}.ply"
    if plain.exists():
        return plain
    converted = work / f"{name}.ply"
    for source in (data / "sog" / name, data / "sog" / f"{name}.sog"):
        if source.exists() and not converted.exists():
            words = [sys.executable, str(data / "tools" / "sog2ply.py"), str(source), str(converted)]
            subprocess.run(words, check=True, capture_output=True)
    if not converted.exists():
        raise AbsentError(f"there is no scene {name} in {data}")
    return converted


def _make(path: Path, model: SplatModel, given: Sequence[Camera], made: re.Match[str]) -> None:
    count = int(made["count"]) * _UNITS[made["unit"]]
    if made["kind"] == "@":
        write_ply(path, crowd(model, given or comparison_cameras(model), count))
        return
    if made["degree"] is not None:
        model = replace(model, shN=np.ascontiguousarray(model.shN[:, : (int(made["degree"]) + 1) ** 2 - 1]))
    write_scene_ply(path, scenes.Scene.like(model, count, partial(copies, model, count)))


def _describe(name: str, path: Path, cameras: Sequence[Camera]) -> Scene:
    if not path.exists():
        raise AbsentError(f"{path} does not exist")
    count = rest = 0
    with path.open("rb") as stream:
        for line in stream:
            words = line.split()
            if words[:2] == [b"element", b"vertex"]:
                count = int(words[2])
            rest += bool(words) and words[-1].startswith(b"f_rest_")
            if words == [b"end_header"]:
                break
    return Scene(name, path, cameras, count, math.isqrt(rest // 3 + 1) - 1)

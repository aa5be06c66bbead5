"""The scenes that benchmarks run on: what ships, what the data folder has, what is made of it; and their cameras.

A scene that is none of these is looked for as NAME.ply in the folder of made scenes: what was trained here lies there.
"""

from __future__ import annotations

import math
import os
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from csplat.model import SplatModel
from csplat.ply import read_ply, write_ply
from csplat_bench.common.making import blow_up, crowd
from csplat_render import Camera
from csplat_render.camera_files import load_cameras
from csplat_render.scorer import Scorer
from csplat_tools.console import note
from csplat_tools.views import BLACK, comparison_cameras

ROOT = Path(__file__).resolve().parents[4]
DATA = Path(os.environ.get("CSPLAT_DATA", ROOT.parent / "shared" / "data"))

#: Folders for what is made and measured, for made scenes, for npm packages.
OUT = ROOT / "out"
MADE = OUT / "scenes"
NPM = OUT / "peers"

#: The scene that ships with the project.
SAMPLE = ROOT / "tools" / "csplat_tools" / "data" / "sample.ply"
_SOG_TO_PLY = DATA / "tools" / "sog2ply.py"

#: By name, what is copied side by side, and splats.
_BLOWN_UP = {
    "fox-1M": ("fox120k", 1_000_000),
    "donut-1M": ("donut", 1_000_000),
    "fox-4M": ("fox120k", 4_000_000),
    "donut-4M": ("donut", 4_000_000),
}

#: By name, what is split, and splats in view of the scene's cameras.
_CROWDS = {
    "fox@90k": ("fox120k", 90_000),
    "lego@90k": ("lego60k", 90_000),
    "fox@500k": ("fox120k", 500_000),
    "lego@500k": ("lego60k", 500_000),
}

#: By name, what the data folder has in another format.
_SOG = {"statue": "statue", "fontaine": "fontaine", "angel": "angel.sog", "st-peter": "st-peter.sog"}


@dataclass(frozen=True)
class Scene:
    """A PLY to measure on."""

    name: str
    path: Path
    splat_count: int
    sh_degree: int

    @property
    def size_bytes(self) -> int:
        """Size of the PLY."""
        return self.path.stat().st_size

    @classmethod
    def of(cls, path: Path, name: str | None = None) -> Scene:
        """Read the header of a PLY."""
        count = rest = 0
        with path.open("rb") as stream:
            for line in stream:
                words = line.split()
                if words[:2] == [b"element", b"vertex"]:
                    count = int(words[2])
                rest += bool(words) and words[-1].startswith(b"f_rest_")
                if words == [b"end_header"]:
                    break
        return cls(name or path.stem, path, count, math.isqrt(rest // 3 + 1) - 1)


def find_scenes(names: Sequence[str], cache: Path = MADE, extra: Sequence[Path] = ()) -> list[Scene]:
    """Find or make scenes; absent ones are reported on standard error.

    Args:
        names: in this order.
        cache: folder for scenes that have to be made.
        extra: PLYs of others, which come after them.
    """
    cache.mkdir(parents=True, exist_ok=True)
    paths = {name: _path(name, cache) for name in names}
    absent = [name for name, path in paths.items() if path is None]
    if absent:
        note(f"absent: {', '.join(absent)}")
    found = [Scene.of(path, name) for name, path in paths.items() if path is not None]
    return [*found, *map(Scene.of, extra)]


def _path(name: str, cache: Path) -> Path | None:
    """Return the path of a scene, made if necessary; `None` if neither it nor its source exists."""
    made = cache / f"{name}.ply"
    if name in _SOG:
        source = DATA / "sog" / _SOG[name]
        if source.exists() and not made.exists():
            convert = [sys.executable, str(_SOG_TO_PLY), str(source), str(made)]
            subprocess.run(convert, check=True, stdout=subprocess.DEVNULL)
        return made if made.exists() else None
    source = SAMPLE if name == "sample" else DATA / "ply" / f"{_made_of(name)}.ply"
    if not source.exists():
        return made if made.exists() else None
    if name in _BLOWN_UP and not made.exists():
        write_ply(made, blow_up(read_ply(source), _BLOWN_UP[name][1]))
    elif name in _CROWDS and not made.exists():
        model = read_ply(source)
        write_ply(made, crowd(model, cameras_of(name, model), _CROWDS[name][1]))
    return source if name == _made_of(name) else made


def _made_of(name: str) -> str:
    return {**_BLOWN_UP, **_CROWDS}.get(name, (name, 0))[0]


def given_cameras(name: str) -> list[Camera]:
    """The eight cameras of the data folder for a scene, or for what it was made of; nothing if it has none."""
    path = DATA / "psnr_cameras" / f"{_made_of(name)}.json"
    return load_cameras(path) if path.exists() else []


def cameras_of(name: str, model: SplatModel) -> Sequence[Camera]:
    """Return the cameras of the data folder, else those of `csplat compare`."""
    return given_cameras(name) or comparison_cameras(model)


def judge_of(name: str, source: SplatModel) -> Scorer:
    """Whoever judges by these cameras, in front of black: eight views of 640 by 480, pooled."""
    return Scorer.of_source(source, cameras_of(name, source), BLACK)

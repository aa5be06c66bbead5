"""The scenes that benchmarks run on: what ships, what lies in the data folder, and copies of it side by side."""

from __future__ import annotations

import math
import os
import subprocess
import sys
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from csplat.model import SplatModel, normalise_quats
from csplat.ply import read_ply, write_ply

__all__ = [
    "BLOWN_UP",
    "CROWDS",
    "DATA",
    "ROOT",
    "Scene",
    "blow_up",
    "describe_ply",
    "find_scenes",
    "named_scenes",
]

ROOT = Path(__file__).resolve().parents[2]
DATA = Path(os.environ.get("CSPLAT_DATA", ROOT.parent / "shared" / "data"))

_SAMPLE = ROOT / "tools" / "csplat_tools" / "data" / "sample.ply"
_PLYS = ("lego60k", "fox120k", "fox60k_noreg", "plane3", "donut", "horse", "jacket")

#: Name, what it is copied from, splats.
BLOWN_UP = (
    ("fox-1M", "fox120k", 1_000_000),
    ("donut-1M", "donut", 1_000_000),
    ("fox-4M", "fox120k", 4_000_000),
    ("donut-4M", "donut", 4_000_000),
)


#: Name, what it is split from, splats in view of the scene's cameras.
CROWDS = (
    ("fox@90k", "fox120k", 90_000),
    ("lego@90k", "lego60k", 90_000),
    ("fox@500k", "fox120k", 500_000),
    ("lego@500k", "lego60k", 500_000),
)

#: Scenes that are made where they are named; the data folder has them in another format.
_SOG = {"statue": "statue", "angel": "angel.sog", "st-peter": "st-peter.sog"}


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


def find_scenes(names: list[str], cache: Path) -> list[Scene]:
    """Find or make scenes.

    Args:
        names: which ones; empty for all that are there.
        cache: folder for those that have to be made.
    """
    cache.mkdir(parents=True, exist_ok=True)
    # Others of the data folder only where they are named.
    plys = dict.fromkeys([*_PLYS, *(name for name in names if "/" not in name and name != "sample")])
    paths = {"sample": _SAMPLE, **{name: DATA / "ply" / f"{name}.ply" for name in plys}}
    chosen = []
    for name, path in paths.items():
        if path.exists() and (not names or name in names):
            chosen.append(describe_ply(name, path))
    for name, source, count in BLOWN_UP:
        if paths[source].exists() and (not names or name in names):
            path = cache / f"{name}.ply"
            if not path.exists():
                write_ply(path, blow_up(read_ply(paths[source]), count))
            chosen.append(describe_ply(name, path))
    for name, source, count in CROWDS:
        if name in names and paths[source].exists():
            path = cache / f"{name}.ply"
            if not path.exists():
                from crowds import cameras_of, crowd  # wants numba

                model = read_ply(paths[source])
                write_ply(path, crowd(model, cameras_of(name, model), count))
            chosen.append(describe_ply(name, path))
    for name, source in _SOG.items():
        if name in names and (DATA / "sog" / source).exists():
            path = cache / f"{name}.ply"
            if not path.exists():
                convert = [sys.executable, str(DATA / "tools" / "sog2ply.py"), str(DATA / "sog" / source), str(path)]
                subprocess.run(convert, check=True, stdout=subprocess.DEVNULL)
            chosen.append(describe_ply(name, path))
    return chosen


def named_scenes(names: list[str], cache: Path) -> list[Scene]:
    """As `find_scenes`, of names only; those that are absent are told of on standard error."""
    scenes = find_scenes(names, cache) if names else []
    missing = set(names) - {scene.name for scene in scenes}
    if missing:
        print(f"absent: {', '.join(sorted(missing))}", file=sys.stderr)
    return scenes


def blow_up(model: SplatModel, count: int, seed: int = 0) -> SplatModel:
    """Lay copies of a scene side by side, each a little different in every number.

    Args:
        model: a scene.
        count: splats of the result.
        seed: of the differences.
    """
    rng = np.random.default_rng(seed)
    low, high = np.quantile(model.means, (0.01, 0.99), axis=0)
    copies = math.ceil(count / len(model))
    columns = math.ceil(math.sqrt(copies))
    parts = []
    for copy in range(copies):
        part = model.select(slice(0, min(len(model), count - copy * len(model))))
        shift = (high - low) * 1.5 * np.array([copy % columns, copy // columns, 0])
        parts.append(_vary(part, rng, shift.astype(np.float32)) if copy else part)
    return replace(
        model,
        means=np.concatenate([part.means for part in parts]),
        quats=np.concatenate([part.quats for part in parts]),
        scales=np.concatenate([part.scales for part in parts]),
        opacities=np.concatenate([part.opacities for part in parts]),
        sh0=np.concatenate([part.sh0 for part in parts]),
        shN=np.concatenate([part.shN for part in parts]),
    )


def _vary(model: SplatModel, rng: np.random.Generator, shift: np.ndarray) -> SplatModel:
    def noise(like: np.ndarray, sigma: float) -> np.ndarray:
        return rng.standard_normal(like.shape, np.float32) * np.float32(sigma)

    size = np.exp(model.scales.max(axis=1, keepdims=True))
    return replace(
        model,
        means=model.means + shift + noise(model.means, 0.1) * np.minimum(size, np.float32(1.0)),
        quats=normalise_quats(model.quats + noise(model.quats, 0.01)),
        scales=model.scales + noise(model.scales, 0.02),
        opacities=np.clip(model.opacities * (1 + noise(model.opacities, 0.02)), 0, 1),
        sh0=model.sh0 + noise(model.sh0, 0.01),
        shN=model.shN * (1 + noise(model.shN, 0.05)),
    )


def describe_ply(name: str, path: Path) -> Scene:
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
    return Scene(name, path, count, math.isqrt(rest // 3 + 1) - 1)

"""Extreme scenes as PLY columns, for the tests marked `extremes`.

All are variants of one object, a shell of 300 overlapping splats about two units across. `CONDITIONS` names them;
`tools/docs/results/extremes.md` describes the results, whose figures are `EXPECTED`.
"""

from __future__ import annotations

import json
import math
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np

from csplat import EncodeOptions, read_ply
from csplat.encoder import EncodeResult, encode_with_report
from csplat.lint import Finding
from csplat.model import SplatModel, normalise_quats

RESULTS = Path(__file__).resolve().parent.parent / "tools" / "benchmarks" / "results" / "extremes.json"
#: Bytes per splat, PSNR and the like of each condition, as `python tests/extremes_chain.py` measured them.
EXPECTED = {row["scene"]: row for row in json.loads(RESULTS.read_text("utf-8"))["rows"]}
COUNT = 300
FAR = 10_000.0
TINY = 1e-42  # denormal
PRESETS = ("fast", "balanced", "small")
COPIES = 2_000  # replaces a million identical splats in training, which visits every splat in each step

Columns = dict[str, np.ndarray]


@dataclass(frozen=True)
class Condition:
    """An extreme scene.

    Attributes:
        make: returns the columns `means`, `quats`, `scales`, `logits`, `sh0`, `shN` of the PLY.
        comments: comments in the PLY's header.
        dropped: number of rows that a reader drops.
        repairs: ids of the defects that `strict` refuses.
    """

    make: Callable[[], Columns]
    comments: tuple[str, ...] = ()
    dropped: int = 0
    repairs: tuple[str, ...] = ()


def ordinary(count: int = COUNT, coefficients: int = 8) -> Columns:
    """Return the object that all scenes are variants of."""
    rng = np.random.default_rng(0)
    means = rng.standard_normal((count, 3))
    means /= np.linalg.norm(means, axis=1, keepdims=True)
    return {
        "means": means.astype(np.float32),
        "quats": normalise_quats(rng.standard_normal((count, 4))),
        "scales": rng.uniform(-2.5, -1.3, (count, 3)).astype(np.float32),
        "logits": rng.uniform(-2.0, 3.0, count).astype(np.float32),
        "sh0": (np.sin(3.0 * means) + 0.5).astype(np.float32),
        "shN": (0.1 * rng.standard_normal((count, coefficients, 3))).astype(np.float32),
    }


def far_away() -> Columns:
    columns = ordinary()
    columns["means"] += np.float32(FAR)
    return columns


def far_away_in_doubles() -> Columns:
    columns = ordinary()
    columns["means"] = columns["means"].astype(np.float64) + FAR
    return columns


def one_splat() -> Columns:
    return {name: column[:1] for name, column in ordinary().items()}


def identical(count: int = 1_000_000) -> Columns:
    return {name: np.repeat(column[:1], count, axis=0) for name, column in ordinary(coefficients=0).items()}


def needles() -> Columns:
    """Return needles, discs and blades, a third each, with axes 1 : e^20."""
    columns = ordinary()
    columns["scales"][0::3] = [-1.0, -21.0, -21.0]
    columns["scales"][1::3] = [-21.0, -1.0, -1.0]
    columns["scales"][2::3] = [-21.0, -11.0, -1.0]
    return columns


def giant_background() -> Columns:
    """Return the object at a hundredth of its size, amid twenty splats a million times larger."""
    columns = ordinary()
    columns["means"] *= np.float32(0.01)
    columns["scales"] += np.float32(math.log(0.01))
    behind = slice(None, None, 15)
    columns["means"][behind] *= np.float32(3e6)
    columns["scales"][behind] = math.log(1e4)
    columns["logits"][behind] = 4.0
    return columns


def transparent() -> Columns:
    """Return splats with alpha 0 or 1/8100, which is too faint to be drawn."""
    columns = ordinary()
    columns["logits"][:] = np.where(np.arange(COUNT) % 2, -np.inf, -9.0)
    return columns


def saturated() -> Columns:
    """Return a scene in which every third splat has coefficients of ±1e4: white from one side, black from another."""
    columns = ordinary()
    for name, middle in (("sh0", 0.5), ("shN", 0.0)):
        columns[name][::3] = np.where(columns[name][::3] > middle, np.float32(1e4), np.float32(-1e4))
    return columns


def half_nan() -> Columns:
    """Return a scene with NaN or infinity in every other row, in alternating columns."""
    columns = ordinary()
    names = list(columns)
    for number, row in enumerate(range(0, COUNT, 2)):
        name = names[number % len(names)]
        column = columns[name].reshape(COUNT, -1)
        column[row, number % column.shape[1]] = np.nan if name == "logits" or number % 4 else np.inf
    return columns


def denormals() -> Columns:
    """Return denormal numbers in every column, rotations of denormal length, and one of length 0."""
    columns = ordinary()
    columns["means"][0::3] *= np.float32(1e-40)
    columns["quats"][1::3] *= np.float32(TINY)
    columns["quats"][1] = 0.0
    columns["scales"][::4, 1] = TINY
    columns["logits"][::5] = -TINY
    columns["sh0"][::2] = TINY
    columns["shN"][::2] = -TINY
    return columns


def float32_limits() -> Columns:
    """Return centres, logits and rotations at the limits of float32, and log scales of ±60 and ±88."""
    columns = ordinary()
    columns["means"][:4] = 3e38 * np.array([[1, 0, 0], [-1, 0, 0], [0, 1, -1], [-1, 1, 1]])
    for row, value in enumerate((60.0, -60.0, 88.0, -88.0)):
        columns["scales"][10 + row] = value
        columns["scales"][20 + row, row % 3] = value
    columns["logits"][30:32] = [3e38, -3e38]
    columns["quats"][32:34] *= np.float32(1e38)
    return columns


def exploded() -> Columns:
    """Return eight splats with colours and log scales of ±3e38, as diverged training leaves them."""
    columns = ordinary()
    for row, value in enumerate((3e38, -3e38)):
        columns["sh0"][40 + row] = value
        columns["shN"][42 + row, row] = value
        columns["scales"][44 + row] = value
        columns["scales"][46 + row, row] = value
    return columns


CONDITIONS = {
    "10 km away": Condition(far_away),
    "10 km away, origin": Condition(ordinary, (f"csplat origin {FAR} {FAR} {FAR}",)),
    "10 km away, doubles": Condition(far_away_in_doubles),
    "one splat": Condition(one_splat),
    "a million identical": Condition(identical),
    "needles": Condition(needles),
    "giant background": Condition(giant_background),
    "all transparent": Condition(transparent),
    "saturated SH": Condition(saturated),
    "half the rows NaN": Condition(half_nan, dropped=COUNT // 2, repairs=("nonfinite-rows",)),
    "denormals": Condition(denormals, repairs=("zero-quats",)),
    "float32 limits": Condition(float32_limits),
    "exploded": Condition(exploded),
}
NAMES = tuple(CONDITIONS)
#: Conditions that can be rendered at 640×480; a million splats that fill the image exceed the renderer's limit.
DRAWN = tuple(name for name in NAMES if name != "a million identical")


def write_columns(path: Path, columns: Columns, comments: tuple[str, ...] = ()) -> Path:
    """Write columns unchanged, including NaN, in INRIA's layout."""
    count, rest = len(columns["means"]), columns["shN"].shape[1] * 3
    names = ["f_dc_0", "f_dc_1", "f_dc_2", *(f"f_rest_{k}" for k in range(rest))]
    names += ["opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"]
    position = {"f4": "float", "f8": "double"}[columns["means"].dtype.str[1:]]
    rows = np.empty(count, [("means", columns["means"].dtype, 3), ("others", "<f4", len(names))])
    rows["means"] = columns["means"]
    shN = columns["shN"].transpose(0, 2, 1).reshape(count, rest)
    parts = columns["sh0"], shN, columns["logits"][:, None], columns["scales"], columns["quats"]
    rows["others"] = np.concatenate(parts, axis=1)
    lines = ["ply", "format binary_little_endian 1.0", *(f"comment {line}" for line in comments)]
    lines += [f"element vertex {count}", *(f"property {position} {name}" for name in "xyz")]
    lines += [f"property float {name}" for name in names]
    path.write_bytes("\n".join([*lines, "end_header\n"]).encode() + rows.tobytes())
    return path


def write_scene(folder: Path, name: str) -> Path:
    """Write the PLY of a condition."""
    condition = CONDITIONS[name]
    return write_columns(folder / "scene.ply", condition.make(), condition.comments)


def write_small_scene(folder: Path, name: str) -> Path:
    """Write the PLY of a condition, with `COPIES` instead of a million splats."""
    if name in DRAWN:
        return write_scene(folder, name)
    return write_columns(folder / "scene.ply", identical(COPIES))


@cache
def scene(name: str) -> tuple[SplatModel, tuple[Finding, ...]]:
    """Return the scene of a condition, and the reader's findings."""
    findings: list[Finding] = []
    with tempfile.TemporaryDirectory() as folder:
        return read_ply(write_scene(Path(folder), name), report=findings), tuple(findings)


@cache
def encoded(name: str, preset: str, quality: float | None = None) -> EncodeResult:
    """Encode a condition."""
    return encode_with_report(scene(name)[0], EncodeOptions(preset=preset, attribute_psnr=quality))


@cache
def scorer(name: str, size: tuple[int, int] = (640, 480)):
    """Return a scorer of renders against those of a condition, from eight virtual cameras."""
    from csplat_render.scorer import Scorer
    from csplat_render.virtual_cameras import virtual_cameras

    model = scene(name)[0]
    return Scorer.of_source(model, virtual_cameras(model, 8, *size), (0.0, 0.0, 0.0))

"""Scenes at the extremes, as PLY files hold them: shared by the tests of the group `extremes`.

All are made of one ordinary object, a shell of 300 overlapping splats about two units across. `CONDITIONS` names them;
`codec/EXTREMES.md` describes the result of each. `python tests/extremes.py` prints that page's figures.
"""

from __future__ import annotations

import math
import re
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np

from csplat import EncodeOptions, decode, read_ply
from csplat.encoder import EncodeResult, encode_with_report
from csplat.lint import Finding
from csplat.model import SplatModel, normalise_quats

GUIDE = Path(__file__).resolve().parent.parent / "codec" / "EXTREMES.md"
COUNT = 300
FAR = 10_000.0
TINY = 1e-42  # denormal
PRESETS = ("fast", "balanced", "small")
COPIES = 2_000  # stands in for a million identical splats, each of which every training step would visit

Columns = dict[str, np.ndarray]


@dataclass(frozen=True)
class Condition:
    """A scene.

    Attributes:
        make: its columns, `means`, `quats`, `scales`, `logits`, `sh0`, `shN`, by row, as a PLY holds them.
        comments: comments in the PLY's header.
        dropped: rows that a reader drops.
        repairs: defects that `strict` refuses.
    """

    make: Callable[[], Columns]
    comments: tuple[str, ...] = ()
    dropped: int = 0
    repairs: tuple[str, ...] = ()


def ordinary(count: int = COUNT, coefficients: int = 8) -> Columns:
    """The object that all scenes are made of."""
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
    """Axes that differ by e^20: needles, discs, and blades, a third each."""
    columns = ordinary()
    columns["scales"][0::3] = [-1.0, -21.0, -21.0]
    columns["scales"][1::3] = [-21.0, -1.0, -1.0]
    columns["scales"][2::3] = [-21.0, -11.0, -1.0]
    return columns


def giant_background() -> Columns:
    """The object a hundredth as large, amid twenty splats that are a million times larger than it."""
    columns = ordinary()
    columns["means"] *= np.float32(0.01)
    columns["scales"] += np.float32(math.log(0.01))
    behind = slice(None, None, 15)
    columns["means"][behind] *= np.float32(3e6)
    columns["scales"][behind] = math.log(1e4)
    columns["logits"][behind] = 4.0
    return columns


def transparent() -> Columns:
    """Alpha 0 and alpha 1/8100, which is below what is drawn."""
    columns = ordinary()
    columns["logits"][:] = np.where(np.arange(COUNT) % 2, -np.inf, -9.0)
    return columns


def saturated() -> Columns:
    """Every third splat has coefficients of ± 1e4 alone: white from one side, black from another."""
    columns = ordinary()
    for name, middle in (("sh0", 0.5), ("shN", 0.0)):
        columns[name][::3] = np.where(columns[name][::3] > middle, np.float32(1e4), np.float32(-1e4))
    return columns


def half_nan() -> Columns:
    """Every other row holds a NaN, or an infinity, now in this column and now in that."""
    columns = ordinary()
    names = list(columns)
    for number, row in enumerate(range(0, COUNT, 2)):
        name = names[number % len(names)]
        column = columns[name].reshape(COUNT, -1)
        column[row, number % column.shape[1]] = np.nan if name == "logits" or number % 4 else np.inf
    return columns


def denormals() -> Columns:
    """Denormal numbers in every column, rotations of denormal length, and one of length 0."""
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
    """Centres at the ends of float32, log scales of ± 60 and ± 88, logits and rotations as large as they come."""
    columns = ordinary()
    columns["means"][:4] = 3e38 * np.array([[1, 0, 0], [-1, 0, 0], [0, 1, -1], [-1, 1, 1]])
    for row, value in enumerate((60.0, -60.0, 88.0, -88.0)):
        columns["scales"][10 + row] = value
        columns["scales"][20 + row, row % 3] = value
    columns["logits"][30:32] = [3e38, -3e38]
    columns["quats"][32:34] *= np.float32(1e38)
    return columns


def exploded() -> Columns:
    """Colours and log scales of ± 3e38, as training that went wrong leaves them, in eight splats."""
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
#: Conditions that can be rendered at 640×480: a million splats that fill it are more than the renderer takes.
DRAWN = tuple(name for name in NAMES if name != "a million identical")


def write_columns(path: Path, columns: Columns, comments: tuple[str, ...] = ()) -> Path:
    """Write columns as they are, NaN and all, in INRIA's layout."""
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
    """Write the same, in fewer copies if it is a million."""
    if name in DRAWN:
        return write_scene(folder, name)
    return write_columns(folder / "scene.ply", identical(COPIES))


@cache
def scene(name: str) -> tuple[SplatModel, tuple[Finding, ...]]:
    """The scene of a condition, and what its reader reported."""
    findings: list[Finding] = []
    with tempfile.TemporaryDirectory() as folder:
        return read_ply(write_scene(Path(folder), name), report=findings), tuple(findings)


@cache
def encoded(name: str, preset: str, quality: float | None = None) -> EncodeResult:
    """A file of a condition."""
    return encode_with_report(scene(name)[0], EncodeOptions(preset=preset, attribute_psnr=quality))


@cache
def judge(name: str, size: tuple[int, int] = (640, 480)):
    """Return a judge that compares renders with those of a condition, from the cameras of `psnr`."""
    from csplat_render.scorer import Scorer
    from csplat_render.virtual_cameras import virtual_cameras

    model = scene(name)[0]
    return Scorer.of_source(model, virtual_cameras(model, 8, *size), (0.0, 0.0, 0.0))


def guide_rows() -> list[list[str]]:
    """The rows of the guide's tables that begin with a condition."""
    lines = GUIDE.read_text("utf-8").splitlines()
    rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in lines if line.startswith("|")]
    return [row for row in rows if row[0] in CONDITIONS]


def guide_figures() -> dict[str, list[tuple[float, float]]]:
    """Return the guide's bytes per splat and dB, by preset, for each condition that is rendered."""
    found = {}
    for name, *cells in guide_rows():
        pairs = [re.fullmatch(r"([0-9.]+), ([0-9.]+)", cell) for cell in cells]
        if len(pairs) == len(PRESETS) and all(pairs):
            found[name] = [(float(pair[1]), float(pair[2])) for pair in pairs if pair]
    return found


def figures(name: str) -> list[str]:
    """The row of a condition in the guide's table: bytes and dB, by preset."""
    cells = [name]
    for preset in PRESETS:
        data = encoded(name, preset).data
        size = f"{len(data) / len(scene(name)[0]):.{1 if len(data) > len(scene(name)[0]) else 4}f}"
        cells.append(f"{size}, {judge(name).psnr(decode(data)):.1f}" if name in DRAWN else f"{size}, –")
    return cells


if __name__ == "__main__":
    for each in NAMES:
        print("| " + " | ".join(figures(each)) + " |")

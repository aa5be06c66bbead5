# SPDX-License-Identifier: Apache-2.0
"""Extreme scenes as PLY columns and through all stages.

All are variants of one object, a shell of 300 overlapping splats about two units across. `CONDITIONS` names them;
`tools/docs/results/extremes.md` describes the results, whose figures are `EXPECTED`.
`python tests/helpers/extremes.py` writes the figures. Requires the extra [render].
"""

import json
import math
import tempfile
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache, partial
from pathlib import Path
from types import SimpleNamespace

import numpy as np
from captures import cameras, shell, views_of

from csplat import EncodeOptions, decode
from csplat.decoder import read_declared_bounds, read_header
from csplat.encode_api import encode_with_report
from csplat.encoder import EncodePlan, Target, fix_quantisation
from csplat.errors import InputError
from csplat.ply import lint_ply, read_ply
from csplat_conformance.declared_bounds import Source, verify_bounds
from csplat_render import render
from csplat_render.rasteriser import Rasteriser
from csplat_render.scorer import ReferenceImage, Scorer
from csplat_render.virtual_cameras import virtual_cameras
from csplat_tools.optimise.simplify import SimplifyOptions, simplify
from csplat_tools.optional_packages import describe_machine
from csplat_trainer.data import DataSet
from csplat_trainer.posed_images import PosedImage
from csplat_trainer.training_loop import train
from csplat_trainer.training_options import TrainOptions
from csplat_trainer.tuning import FinetuneOptions, renders_of, split_views, tune

RESULTS = Path(__file__).resolve().parents[2] / "tools" / "lab" / "results" / "extremes.json"
#: Bytes per splat, PSNR and the like of each condition, as `python tests/helpers/extremes.py` measured them.
EXPECTED = {row["scene"]: row for row in json.loads(RESULTS.read_text("utf-8"))["rows"]}
COUNT = 300
FAR = 10_000.0
TINY = 1e-42  # denormal
PRESETS = ("fast", "balanced", "small")
COPIES = 2_000  # replaces a million identical splats in training, which visits every splat in each step


@dataclass(frozen=True)
class Condition:
    """A change of the object's columns in a PLY; its comments; how many rows are dropped, which defects repaired."""

    change: Callable
    comments: tuple = ()
    dropped: int = 0
    repairs: tuple = ()

    def make(self):
        columns = ordinary()
        return self.change(columns) or columns


def ordinary(coefficients=8):
    model = shell(coefficients)
    first = {name: getattr(model, name).copy() for name in ("means", "quats", "scales")}
    logits = np.float32(5.0) * (model.opacities - np.float32(0.1)) / np.float32(0.85) - np.float32(2.0)  # -2 to 3
    return {**first, "logits": logits, "sh0": model.sh0.copy(), "shN": model.shN.copy()}


def far_away(columns, dtype=np.float32):
    columns["means"] = columns["means"].astype(dtype) + dtype(FAR)


def identical(columns, count=1_000_000):
    columns["shN"] = ordinary(coefficients=0)["shN"]
    return {name: np.repeat(column[:1], count, axis=0) for name, column in columns.items()}


def needles(columns):
    """Make needles, discs and blades, a third each, with axes 1 : e^20."""
    columns["scales"][0::3] = [-1.0, -21.0, -21.0]
    columns["scales"][1::3] = [-21.0, -1.0, -1.0]
    columns["scales"][2::3] = [-21.0, -11.0, -1.0]


def giant_background(columns):
    """Scale the object to a hundredth, amid twenty splats a million times larger."""
    columns["means"] *= np.float32(0.01)
    columns["scales"] += np.float32(math.log(0.01))
    behind = slice(None, None, 15)
    columns["means"][behind] *= np.float32(3e6)
    columns["scales"][behind] = math.log(1e4)
    columns["logits"][behind] = 4.0


def transparent(columns):
    """Make splats with alpha 0 or 1/8100, which is too faint to be drawn."""
    columns["logits"][:] = np.where(np.arange(COUNT) % 2, -np.inf, -9.0)


def saturated(columns):
    """Make a scene in which every third splat has coefficients of ±1e4: white from one side, black from another."""
    for name, middle in (("sh0", 0.5), ("shN", 0.0)):
        columns[name][::3] = np.where(columns[name][::3] > middle, np.float32(1e4), np.float32(-1e4))


def half_nan(columns):
    """Make a scene with NaN or infinity in every other row, in alternating columns."""
    names = list(columns)
    for number, row in enumerate(range(0, COUNT, 2)):
        name = names[number % len(names)]
        column = columns[name].reshape(COUNT, -1)
        column[row, number % column.shape[1]] = np.nan if name == "logits" or number % 4 else np.inf


def denormals(columns):
    """Make denormal numbers in every column, rotations of denormal length, and one of length 0."""
    columns["means"][0::3] *= np.float32(1e-40)
    columns["quats"][1::3] *= np.float32(TINY)
    columns["quats"][1] = 0.0
    columns["scales"][::4, 1] = TINY
    columns["logits"][::5] = -TINY
    columns["sh0"][::2] = TINY
    columns["shN"][::2] = -TINY


def float32_limits(columns):
    """Make centres, logits and rotations at the limits of float32, and log scales of ±60 and ±88."""
    columns["means"][:4] = 3e38 * np.array([[1, 0, 0], [-1, 0, 0], [0, 1, -1], [-1, 1, 1]])
    for row, value in enumerate((60.0, -60.0, 88.0, -88.0)):
        columns["scales"][10 + row] = value
        columns["scales"][20 + row, row % 3] = value
    columns["logits"][30:32] = [3e38, -3e38]
    columns["quats"][32:34] *= np.float32(1e38)


def exploded(columns):
    """Make eight splats with colours and log scales of ±3e38, as diverged training leaves them."""
    for row, value in enumerate((3e38, -3e38)):
        columns["sh0"][40 + row] = value
        columns["shN"][42 + row, row] = value
        columns["scales"][44 + row] = value
        columns["scales"][46 + row, row] = value


CONDITIONS = {
    "10 km away": Condition(far_away),
    "10 km away, origin": Condition(lambda _: None, (f"csplat origin {FAR} {FAR} {FAR}",)),
    "10 km away, doubles": Condition(partial(far_away, dtype=np.float64)),
    "one splat": Condition(lambda columns: {name: column[:1] for name, column in columns.items()}),
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


def write_columns(path, columns, comments=()):
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


def write_scene(folder, name):
    condition = CONDITIONS[name]
    return write_columns(folder / "scene.ply", condition.make(), condition.comments)


@cache
def scene(name):
    with tempfile.TemporaryDirectory() as folder:
        return read_ply(write_scene(Path(folder), name))


@cache
def encoded(name, preset, quality=None):
    return encode_with_report(scene(name), EncodeOptions(preset=preset, attribute_psnr=quality))


@cache
def scorer(name, size=(640, 480)):
    model = small_scene(name)
    return Scorer.of_source(model, virtual_cameras(model, 8, *size), (0.0, 0.0, 0.0))


ARRAYS = ("means", "quats", "scales", "opacities", "sh0", "shN")
TRAINED = ("float32 limits", "exploded")  # conditions with the largest values: their chain includes learning
SMALL = (160, 120)
FEW = SimplifyOptions(views=10, view_size=(60, 45))
QUICK = TrainOptions(
    max_splats=COUNT, sh_degree=1, iterations=120, refine_start=20, refine_every=20, log_every=40, background="black"
)
SHORT = FinetuneOptions(iterations=250, warm_up=10, validate_every=50, log_every=50)
COARSE = EncodeOptions(preset="small", attribute_psnr=36.0)
BLACK = np.zeros(3, np.float32)


def chain_of(name):
    """Take a condition through all stages, with `COPIES` instead of a million splats."""
    findings = []
    with tempfile.TemporaryDirectory() as folder:
        columns = CONDITIONS[name].make() if name in DRAWN else identical(ordinary(), COPIES)
        path = write_columns(Path(folder) / "scene.ply", columns, CONDITIONS[name].comments)
        source, refusal = read_ply(path, report=findings), ""
        linted = tuple(one.id for one in lint_ply(path) if one.kind == "repair")
        try:
            read_ply(path, strict=True)
        except InputError as error:
            refusal = str(error)
    result = encode_with_report(source)
    decoded = decode(result.data)
    (camera,) = virtual_cameras(source, 1, 24, 18)
    return SimpleNamespace(
        source=source, findings=findings, linted=linted, refusal=refusal, result=result, decoded=decoded,
        renders=[render(model, camera, mode=mode) for model in (source, decoded) for mode in ("fast", "exact")],
        learnt=_learn(source) if name in TRAINED else None,
    )  # fmt: skip


def assert_bounds_hold(source, result, decoded):
    header, bounds = read_header(result.data), read_declared_bounds(result.data)
    found = verify_bounds(Source.of(source), decoded, header, bounds, result.source_index)
    assert ((), True) == (found.failures, found.rms_verified)
    assert list(range(len(source))) == sorted(result.source_index.tolist())
    assert source.origin == decoded.origin


def _learn(source):
    """Return the scene with half its splats, splats trained on its renders, and its tuned file or why there is none."""
    views = cameras(9)
    half = simplify(source, Target(keep=0.5), views=views_of(views), options=SimplifyOptions(effort=1)).model
    options = replace(QUICK, iterations=40, refine_start=10, refine_every=10)
    trained = train(images_of(source, views, source.means[:COUNT]), options)
    try:
        fixed, result, _ = tune_on_renders(source, views, 2, replace(SHORT, iterations=20))
        tuned = decode(fixed.encode(result.best_values).write().data)
    except InputError as error:
        tuned = str(error)
    return SimpleNamespace(half=half, trained=trained.model, losses=trained.log["losses"], tuned=tuned)


def tune_on_renders(source, views, validation_count, options):
    split = split_views(renders_of(source, views, BLACK), BLACK, validation_count=validation_count)
    fixed = fix_quantisation(EncodePlan.of(source, COARSE))
    return fixed, tune(fixed, split, options), split


def assert_finite(model):
    for name in ARRAYS:
        assert np.isfinite(getattr(model, name)).all(), name


def small_scene(name):
    """Return a condition, with `COPIES` instead of a million splats."""
    return scene(name).select(slice(COPIES))


@cache
def half(name):
    return simplify(small_scene(name), Target(keep=0.5), options=FEW)


def images(name, points=None):
    model = small_scene(name)
    return images_of(model, virtual_cameras(model, 12, 48, 40), points)


def images_of(model, views, points=None):
    """Return a data set of renders on black, three of four for training, and points."""
    rasteriser, shots = Rasteriser(), []
    for camera in views:
        pixels = np.clip(rasteriser.forward(model, camera).rgb, 0.0, 1.0)
        shots.append(PosedImage(camera, np.rint(pixels * 255).astype(np.uint8)))
    count = 3 * len(shots) // 4
    return DataSet("made", shots[:count], shots[count:], points)


@cache
def trained(name):
    return train(images(name, small_scene(name).means[:COUNT]), QUICK)


@cache
def tuned(name):
    """Tune to 48 of 52 renders; return the scene before and after, the result, and a scorer of the four others."""
    source = small_scene(name)
    fixed, result, views = tune_on_renders(source, virtual_cameras(source, 52, 48, 36), 4, SHORT)
    before, after = (decode(fixed.encode(values).write().data) for values in (fixed.start(), result.best_values))
    references = [ReferenceImage(view.reference.astype(np.float32)) for view in views.validation]
    return before, after, result, Scorer([view.camera for view in views.validation], references)


def measure(name):
    row = {"scene": name}
    for preset in PRESETS:
        data, count = encoded(name, preset).data, len(scene(name))
        figures = {"bytes_per_splat": round(len(data) / count, 1 if len(data) > count else 4)}
        row[preset] = figures | ({"psnr": round(scorer(name).psnr(decode(data)), 1)} if name in DRAWN else {})
    row["half_psnr"] = round(scorer(name, SMALL).psnr(half(name).model), 1)
    return row


if __name__ == "__main__":
    found = describe_machine()
    machine, rows = f"{found['processor']}, {found['cores']} cores", [measure(name) for name in NAMES]
    document = {"command": "python tests/helpers/extremes.py", "machine": machine, "rows": rows}
    RESULTS.write_text(json.dumps(document, indent=1) + "\n", "utf-8")

"""The behaviour snapshot: files, reports and renders that no change of names or modules may alter.

`tests/behaviour.json` holds what `tests/test_behaviour.py` compares:

- files: hashes of what `encode` writes for five scenes at every preset, for two targets, and of one training and one
  tuning. A file is hashed in parts (attributes, tiles, each type of chunk), so that a difference has a name. The OPTS
  chunk names library versions; it is compared as JSON without them.
- reports: the JSON that commands print for the sample scene, without times, paths and versions.

Only public names are used (`csplat.read`, `encode`, `EncodeOptions`; commands with `--json`): renaming internals does
not touch this file. `csplat view` serves until it is interrupted, and is left out.

A golden records what it may depend on: versions of libraries, and for whatever is rendered the processor. If a file or
report differs and one of these differs, too, then sizes are compared to 2 %, PSNR to 0.1 dB and numbers to 5 %, and the
test reports it at the end of the run. A search for a target may then choose another candidate, as scenes are so small:
its size is compared to 15 %, its PSNR to 0.6 dB (for a target PSNR: what is missing of it), and nothing else.

    python tests/behaviour.py renew           # make all goldens anew; list what changed
    python tests/behaviour.py renew encode    # one group: encode, fit, report or shared
"""

from __future__ import annotations

import contextlib
import hashlib
import importlib.metadata
import io
import json
import os
import platform
import re
import struct
import sys
import tempfile
from collections.abc import Callable, Iterator
from functools import cache
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np

import csplat

ROOT = Path(__file__).resolve().parent.parent
GOLDENS = ROOT / "tests" / "behaviour.json"
SAMPLE = ROOT / "tools" / "csplat_tools" / "data" / "sample.ply"
PRESETS = ("fast", "balanced", "small")
#: Scenes that are not in the project; their folder, see tests/conftest.py.
SHARED = Path(os.environ.get("CSPLAT_DATA", ROOT.parent / "shared" / "data"))
SHARED_SCENES = ("ply/lego60k.ply", "ply/plane3.ply", "ply/donut.ply", "sog/angel.sog")
#: Dependencies of a group's goldens, beyond the code.
DEPENDS = {
    "encode": ("numpy", "deflate"),
    "shared": ("numpy", "deflate"),
    "fit": ("numpy", "deflate", "numba", "pillow", "processor"),
    "report": ("numpy", "deflate", "numba", "pillow", "processor"),
}

_SAME_PSNR = 0.005  # dB; processors differ in the last digits of a render
_SIZE_SHARE = 0.02  # relative difference of sizes in another environment
_PSNR_DB = 0.1  # likewise
_NUMBER_SHARE = 0.05  # relative difference of other numbers, likewise
_SEARCH = " target "  # the names of searches contain it
_SEARCH_SIZE_SHARE = 0.15  # relative difference of sizes that searches find, likewise; two processors differ by 0.08
_SEARCH_PSNR_DB = 0.6  # likewise, dB; three processors differ by 0.4
_DIGITS = 9  # significant digits of numbers in reports: sums of float64 may differ in the last ones

Json = Any


def environment() -> dict[str, str]:
    """Return everything that goldens may depend on."""
    import llvmlite.binding

    versions = {name: importlib.metadata.version(name) for name in ("numpy", "numba", "deflate", "pillow")}
    return {**versions, "processor": f"{platform.machine()} {llvmlite.binding.get_host_cpu_name()}"}


# Scenes and cameras


def _model(rng: np.random.RandomState, count: int, degree: int, means: np.ndarray) -> csplat.SplatModel:
    quats = rng.standard_normal((count, 4))
    quats[:, 0] = np.abs(quats[:, 0]) + 0.1
    return csplat.SplatModel(
        means=means.astype(np.float32),
        quats=(quats / np.linalg.norm(quats, axis=1, keepdims=True)).astype(np.float32),
        scales=(rng.standard_normal((count, 3)) * 0.5 - 3.0).astype(np.float32),
        opacities=rng.uniform(0.05, 1.0, count).astype(np.float32),
        sh0=(rng.standard_normal((count, 3)) * 0.8).astype(np.float32),
        shN=(rng.standard_normal((count, (degree + 1) ** 2 - 1, 3)) * 0.2).astype(np.float32),
    )


def scenes() -> dict[str, csplat.SplatModel]:
    """Return the sample and four made scenes; RandomState's numbers are the same in every version of NumPy."""
    rng = np.random.RandomState(7)
    shell = rng.standard_normal((900, 3))
    shell /= np.linalg.norm(shell, axis=1, keepdims=True)
    around = rng.standard_normal((700, 3)) * (1.0, 0.3, 1.0)
    around[:60] *= 40.0  # surroundings
    around[:3] *= 5000.0  # outliers
    return {
        "sample": csplat.read(SAMPLE),
        "sh0": _model(rng, 1200, 0, rng.standard_normal((1200, 3))),
        "sh3": _model(rng, 900, 3, shell),
        "surroundings": _model(rng, 700, 1, around),
        "sh4": _model(rng, 900, 4, shell),
    }


def cameras(radius: float, count: int = 6, size: tuple[int, int] = (48, 36)) -> list[dict[str, Json]]:
    """Return cameras on a circle around the origin that look at it, as `--cameras` reads them."""
    width, height = size
    found = []
    for i in range(count):
        angle = 2.0 * np.pi * i / count
        eye = radius * np.array([np.cos(angle), -0.4, np.sin(angle)])
        forward = -eye / np.linalg.norm(eye)
        right = np.cross(np.array([0.0, 1.0, 0.0]), forward)
        right /= np.linalg.norm(right)
        turn = np.stack([right, np.cross(forward, right), forward])
        viewmat = np.eye(4)
        viewmat[:3, :3], viewmat[:3, 3] = turn, -turn @ eye
        focal = 1.1 * width
        K = [[focal, 0.0, width / 2], [0.0, focal, height / 2], [0.0, 0.0, 1.0]]
        found.append({"K": K, "viewmat": viewmat.round(12).tolist(), "W": width, "H": height, "near": 0.05})
    return found


def write_images(folder: Path, count: int = 12) -> Path:
    """Write a Blender data set: three shaded balls in front of black, with alpha."""
    from PIL import Image

    folder.mkdir(parents=True, exist_ok=True)
    balls = [
        ((0.0, 0.0, 0.0), 0.7, (200, 90, 40)),
        ((0.8, 0.3, 0.2), 0.35, (40, 160, 220)),
        ((-0.5, 0.6, -0.6), 0.3, (90, 200, 60)),
    ]
    for part, kept in (("train", lambda i: i % 4 != 0), ("test", lambda i: i % 4 == 0)):
        frames = []
        for i, camera in enumerate(cameras(4.0, count)):
            if not kept(i):
                continue
            K, to_camera = np.array(camera["K"]), np.array(camera["viewmat"])
            v, u = np.mgrid[: camera["H"], : camera["W"]] + 0.5
            rays = np.stack([(u - K[0, 2]) / K[0, 0], (v - K[1, 2]) / K[1, 1], np.ones_like(u)], axis=-1)
            rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
            pixels, depth = np.zeros((*u.shape, 4)), np.full(u.shape, np.inf)
            for centre, radius, colour in balls:
                middle = to_camera[:3, :3] @ centre + to_camera[:3, 3]
                along = rays @ middle
                inside = radius**2 - (middle @ middle - along**2)
                hit = along - np.sqrt(np.maximum(inside, 0.0))
                seen = (inside > 0) & (hit < depth)
                shade = np.abs(((rays * hit[..., None] - middle) / radius * rays).sum(axis=-1))
                pixels[seen] = np.append(np.array(colour), 255.0)
                pixels[seen, :3] *= (0.3 + 0.7 * shade[seen])[:, None]
                depth[seen] = hit[seen]
            Image.fromarray(pixels.round().astype(np.uint8), "RGBA").save(folder / f"{part}_{i}.png")
            flip = np.diag([1.0, -1.0, -1.0, 1.0])  # OpenCV's axes to OpenGL's
            pose = (np.linalg.inv(to_camera) @ flip).tolist()
            frames.append({"file_path": f"./{part}_{i}", "transform_matrix": pose})
        angle = 2.0 * np.arctan(48 / 2 / (1.1 * 48))
        document = {"camera_angle_x": float(angle), "frames": frames}
        (folder / f"transforms_{part}.json").write_text(json.dumps(document), encoding="utf-8")
    return folder


# Commands


@cache
def _program() -> Callable[[], None]:
    (script,) = importlib.metadata.entry_points(group="console_scripts", name="csplat")
    main: Callable[[], None] = script.load()
    return main


def run(*words: str | Path) -> Json:
    """Run a command in this process with --json, and return what it prints.

    Raises:
        AssertionError: its status is not 0.
    """
    stdout, stderr = io.TextIOWrapper(io.BytesIO(), encoding="utf-8"), io.StringIO()
    arguments = ["csplat", *map(str, words)]
    split = arguments.index("--") if "--" in arguments else len(arguments)
    arguments[split:split] = ["--json", "--quiet"]
    with mock.patch.object(sys, "argv", arguments), contextlib.redirect_stdout(stdout):
        with contextlib.redirect_stderr(stderr):
            try:
                _program()()
                status = 0
            except SystemExit as end:
                status = end.code or 0
        stdout.flush()
    assert status == 0, f"{' '.join(arguments)}: status {status}\n{stderr.getvalue()}"
    return json.loads(stdout.buffer.getvalue())


# What is compared


def parts(data: bytes) -> dict[str, str]:
    """Return hashes of the parts of a .csplat file (spec 4): none depends on the OPTS chunk or on where it lies."""
    head = 32
    head_size, attribute, codebook, extra, directory, tile, layer = data[head : head + 7]
    tiles, directories, codebooks, extras, attributes = struct.unpack_from("<IHHHB", data, head + 16)
    at = head + head_size + attributes * attribute + codebooks * codebook + extras * extra
    total = {"header and records": hashlib.sha256(data[:16] + data[head:at])}  # without sizes and CRC
    listed = {"tile records": hashlib.sha256()}
    for _ in range(directories):
        kind, flags_and_id, size, offset = struct.unpack_from("<4s8sIQ", data, at)
        at += directory
        if kind != b"OPTS":
            name = kind.decode("latin-1")
            listed.setdefault(name, hashlib.sha256()).update(flags_and_id + data[offset : offset + size])
    tile_bytes = hashlib.sha256()
    for _ in range(tiles):
        layers, tables = data[at + 5], struct.unpack_from("<H", data, at + 6)[0]
        listed["tile records"].update(data[at : at + tile])
        at += tile
        for _ in range(layers):
            size, offset = struct.unpack_from("<IQ", data, at + 4)
            tile_bytes.update(data[at : at + 4] + data[offset : offset + size])
            at += layer
        listed["tile records"].update(data[at : at + 2 * tables])
        at += 2 * tables
    return {name: one.hexdigest()[:24] for name, one in (total | listed | {"TILE": tile_bytes}).items()}


def options(data: bytes) -> Json:
    """Return the options that a file states, without versions."""
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder, "x.csplat")
        file.write_bytes(data)
        return plain(run("info", file)["options"])


_TIMES = re.compile(r"second|time|elapsed|minutes|(^|_)ms$|memory|rss|threads|workers")
_VERSION = re.compile(r"\b(csplat|numpy|numba|libdeflate|zlib|deflate)(-py)? \d[\w.+]*")


def plain(value: Json, folder: Path | None = None) -> Json:
    """Return JSON without times, paths and versions, numbers rounded."""
    match value:
        case dict():
            return {key: plain(one, folder) for key, one in value.items() if not _TIMES.search(key)}
        case list():
            return [plain(one, folder) for one in value]
        case float():
            return float(f"{value:.{_DIGITS}g}")
        case str():
            text = value if folder is None else value.replace(str(folder), "…").replace(str(ROOT), "…")
            return _VERSION.sub(r"\1", text)
    return value


def file_golden(data: bytes) -> dict[str, Json]:
    """Return what is recorded of a .csplat file."""
    stated = options(data)
    return {"parts": parts(data), "options": stated, "size_bytes": len(data)}


# The groups


def encode_group(folder: Path) -> Iterator[tuple[str, Json]]:
    """Yield goldens of every scene at every preset."""
    for name, model in scenes().items():
        yield from _presets(name, model, folder)


def shared_group(folder: Path) -> Iterator[tuple[str, Json]]:
    """Yield goldens of scenes that are not in the project, at every preset; of those absent, nothing."""
    for name in SHARED_SCENES:
        if (SHARED / name).exists():
            yield from _presets(name, csplat.read(SHARED / name), folder)


def _presets(name: str, model: csplat.SplatModel, folder: Path) -> Iterator[tuple[str, Json]]:
    source, file, views = folder / "source.ply", folder / "encoded.csplat", folder / "cameras.json"
    csplat.write_ply(source, model)
    views.write_text(json.dumps(cameras(6.0)), encoding="utf-8")
    for preset in PRESETS:
        data = csplat.encode(model, csplat.EncodeOptions(preset=preset))
        file.write_bytes(data)
        psnr = run("compare", source, file, "--cameras", views)["psnr"]
        yield f"{name} {preset}", {**file_golden(data), "psnr": round(psnr, 3)}


def fit_group(folder: Path) -> Iterator[tuple[str, Json]]:
    """Yield goldens of a short training, a short tuning of its result, and searches for a PSNR and for a size."""
    import pytest
    from command_line import change_options  # imports the renderer

    data, ply = write_images(folder / "images"), folder / "trained.ply"
    tuned, found = folder / "tuned.csplat", folder / "found.csplat"
    words = ("--max-splats", "300", "--sh-degree", "1", "--iterations", "120", "--seed", "5")
    report = run("train", data, ply, *words)
    golden = {"PLY": hashlib.sha256(ply.read_bytes()).hexdigest()[:24]}
    yield "trained", {"parts": golden, "size_bytes": ply.stat().st_size}
    yield "report of train", plain(report, folder)
    with pytest.MonkeyPatch.context() as patch:
        for place in (
            "csplat_tools.cli.finetune.EncodeOptions",
            "csplat_trainer.tuning.tuning_options.FinetuneOptions",
        ):
            change_options(patch, place, seed=5)
        report = run("finetune", ply, tuned, "--data", data, "--iterations", "20")
    yield "tuned", file_golden(tuned.read_bytes())
    yield "report of finetune", plain(report, folder)
    for name, target in {"PSNR": ("--target-psnr", "36"), "size": ("--target-size", "3000")}.items():
        report = run("encode", ply, found, *target, "--data", data, "--force")
        yield f"file with a target {name}", file_golden(found.read_bytes())
        yield f"report of a target {name}", plain(report, folder)


def report_group(folder: Path) -> Iterator[tuple[str, Json]]:
    """Yield what each command prints of the sample."""
    views, small = folder / "cameras.json", folder / "small.ply"
    views.write_text(json.dumps(cameras(6.0, 40)), encoding="utf-8")
    file, other, box = folder / "sample.csplat", folder / "other.csplat", "-1,-1,-1,1,1,1"
    model = csplat.read(SAMPLE)
    few = {n: getattr(model, n)[::30] for n in ("means", "quats", "scales", "opacities", "sh0", "shN")}
    csplat.write_ply(small, csplat.SplatModel(**few))
    scenes_folder = folder / "scenes"
    scenes_folder.mkdir()
    csplat.write_ply(scenes_folder / "small.ply", csplat.SplatModel(**few))
    commands: dict[str, tuple[str | Path, ...]] = {
        "encode": ("encode", SAMPLE, file, "--preset", "fast"),
        "encode --max-error": ("encode", small, other, "--max-error", "means=0.001"),
        "decode": ("decode", file, folder / "decoded.ply"),
        "info": ("info", file),
        "info of a PLY": ("info", SAMPLE),
        "verify": ("verify", file),
        "verify --source": ("verify", other, "--source", small),
        "lint": ("lint", SAMPLE),
        "extract": ("extract", file, folder / "part.csplat", "--box", box),
        "merge": ("merge", file, other, "-o", folder / "merged.csplat"),
        "convert": ("convert", SAMPLE, folder / "sample.spz"),
        "compare": ("compare", SAMPLE, file, "--cameras", views),
        "tradeoff": ("tradeoff", small, "--cameras", views, "--what", "presets"),
        "render": ("render", small, folder / "renders", "--cameras", views),
        "simplify": ("simplify", small, folder / "simple.ply", "--keep", "0.6", "--cameras", views),
        "sensitivity": ("sensitivity", small, folder / "small.npz", "--cameras", views),
        "export-html": ("export-html", file, folder / "page.html"),
        "export-element": ("export-element", folder / "element.js"),
        "conformance decoder": ("conformance", "decoder", "--filter", "valid/quats*"),
        "batch": ("batch", scenes_folder, folder / "batch", "--", "encode", "--preset", "fast"),
    }
    for name, words in commands.items():
        yield name, plain(run(*words), folder)


GROUPS: dict[str, Callable[[Path], Iterator[tuple[str, Json]]]] = {
    "encode": encode_group,
    "fit": fit_group,
    "report": report_group,
    "shared": shared_group,
}


def differences(golden: Json, found: Json, *, loosely: bool = False, where: str = "") -> list[str]:
    """Return a line for each difference between a golden and what was found, with its place.

    Args:
        golden: the recorded value.
        found: the value that the code computes now.
        loosely: the environment differs: hashes do not count, and numbers need only be near.
        where: place of both in the JSON.
    """
    match golden, found:
        case dict(), dict():
            lines = [f"{where}/{key}: is gone" for key in golden.keys() - found.keys()]
            lines += [f"{where}/{key}: is new" for key in found.keys() - golden.keys()]
            for key in golden.keys() & found.keys() - ({"parts"} if loosely else set()):
                lines += differences(golden[key], found[key], loosely=loosely, where=f"{where}/{key}")
            return sorted(lines)
        case list(), list() if len(golden) == len(found):
            pairs = enumerate(zip(golden, found, strict=True))
            return [line for i, pair in pairs for line in differences(*pair, loosely=loosely, where=f"{where}/{i}")]
        case ((int() | float()), (int() | float())) if not isinstance(golden, bool):
            near = abs(golden - found) <= _tolerance(where, max(abs(golden), abs(found)), loosely=loosely)
        case str(), str() if loosely:
            near = True  # counts and times of attempts stand in words, too
        case _:
            near = golden == found and type(golden) is type(found)
    return [] if near else [f"{where}: {golden!r} became {found!r}"]


def _tolerance(where: str, size: float, *, loosely: bool) -> float:
    is_search = _SEARCH in where
    if where.endswith("psnr"):
        return (_SEARCH_PSNR_DB if is_search else _PSNR_DB) if loosely else _SAME_PSNR
    if not loosely:
        return 0.0
    if where.endswith("size_bytes"):
        return (_SEARCH_SIZE_SHARE if is_search else _SIZE_SHARE) * size
    return _NUMBER_SHARE * size


def _outcomes(goldens: dict[str, Json]) -> dict[str, Json]:
    """Return goldens with nothing of a search but its size, and its PSNR or what it lacks of the target PSNR."""
    kept = dict(goldens)
    for name, one in goldens.items():
        if _SEARCH in name:
            kept[name] = {"size_bytes": one["size_bytes"]}
            if "target" in one:
                goal, reached = one["target"]["goal"], one["target"]["psnr"]
                kept[name]["missing psnr"] = max(0.0, goal["psnr"] - reached) if "psnr" in goal else -reached
    return kept


def make(group: str) -> dict[str, Json]:
    """Make what a group holds now."""
    with tempfile.TemporaryDirectory(prefix="csplat-behaviour-") as folder:
        return dict(GROUPS[group](Path(folder)))


def changes(group: str) -> tuple[list[str], str]:
    """Compare a group with its goldens.

    Returns:
        A line for each difference; and, if the comparison was a loose one, what differs in the environment.
    """
    known = json.loads(GOLDENS.read_text(encoding="utf-8"))[group]
    found, here = make(group), environment()
    golden = {name: one for name, one in known["goldens"].items() if group != "shared" or name in found}
    lines = differences(golden, found)
    other = [f"{name} {here[name]} for {was}" for name, was in known["environment"].items() if here[name] != was]
    if lines and other:
        near = differences(_outcomes(golden), _outcomes(found), loosely=True)
        return near, f"{len(lines)} differences in {group}: {', '.join(other)}"
    return lines, ""


def renew(groups: list[str]) -> None:
    """Make the goldens of groups anew, and print what changed."""
    known = json.loads(GOLDENS.read_text(encoding="utf-8")) if GOLDENS.exists() else {}
    for group in groups:
        found, here = make(group), environment()
        for line in differences(known.get(group, {}).get("goldens", {}), found, where=group):
            print(line)
        known[group] = {"environment": {name: here[name] for name in DEPENDS[group]}, "goldens": found}
    text = json.dumps(known, indent=1, ensure_ascii=False, sort_keys=True)
    GOLDENS.write_text(f"{text}\n", encoding="utf-8", newline="\n")


def main() -> int:
    """Run the command line."""
    words = sys.argv[1:]
    if words[:1] != ["renew"] or set(words[1:]) - GROUPS.keys():
        print(__doc__)
        return 2
    renew(words[1:] or [*GROUPS])
    return 0


if __name__ == "__main__":
    sys.exit(main())

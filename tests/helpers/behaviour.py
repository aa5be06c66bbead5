# SPDX-License-Identifier: Apache-2.0
"""The behaviour snapshot: bytes of files and keys of reports that no change of names or modules may alter.

`behaviour.json` next to `tests/system/test_behaviour.py` holds

- bytes: hashes of what `encode` writes at every preset, for five scenes here and for scenes that are not in the
  project. The OPTS chunk, which names library versions, is left out. The bytes depend on the version of libdeflate
  and on nothing else of the environment; the version is recorded.
- keys: the keys of the JSON that commands print, in dotted form.

    python tests/helpers/behaviour.py renew          # make the snapshot anew; list what changed
    python tests/helpers/behaviour.py renew bytes    # one group: bytes, shared or keys
"""

from __future__ import annotations

import contextlib
import hashlib
import importlib.metadata
import io
import json
import os
import struct
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np

import csplat

ROOT = Path(__file__).resolve().parents[2]
GOLDENS = ROOT / "tests" / "system" / "behaviour.json"
SAMPLE = ROOT / "tools" / "csplat_tools" / "data" / "sample.ply"
VECTORS = ROOT / "conformance" / "csplat_conformance" / "vectors"
PRESETS = ("fast", "balanced", "small")
#: Scenes that are not in the project; their folder, see tests/conftest.py.
SHARED = Path(os.environ.get("CSPLAT_DATA", ROOT.parent / "shared" / "data"))
SHARED_SCENES = ("ply/lego60k.ply", "ply/plane3.ply", "ply/donut.ply", "sog/angel.sog")

Json = Any


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


def run(*words: str | Path, status: int = 0) -> Json:
    """Run a command in this process with --json, and return what it prints.

    Raises:
        AssertionError: its status is another.
    """
    from csplat_program import main

    stdout, stderr = io.TextIOWrapper(io.BytesIO(), encoding="utf-8"), io.StringIO()
    arguments = ["csplat", *map(str, words)]
    split = arguments.index("--") if "--" in arguments else len(arguments)
    arguments[split:split] = ["--json", "--quiet"]
    with mock.patch.object(sys, "argv", arguments), contextlib.redirect_stdout(stdout):
        with contextlib.redirect_stderr(stderr):
            try:
                main()
                ended = 0
            except SystemExit as end:
                ended = end.code or 0
        stdout.flush()
    assert status == ended, f"{' '.join(arguments)}: status {ended}\n{stderr.getvalue()}"
    return json.loads(stdout.buffer.getvalue())


def digest(data: bytes) -> str:
    """Return a hash of a .csplat file (spec 4) that depends neither on the OPTS chunk nor on where it lies."""
    head = 32
    head_size, attribute, codebook, extra, directory, tile, layer = data[head : head + 7]
    tiles, directories, codebooks, extras, attributes = struct.unpack_from("<IHHHB", data, head + 16)
    at = head + head_size + attributes * attribute + codebooks * codebook + extras * extra
    total = hashlib.sha256(data[:16] + data[head:at])  # without sizes and CRC
    for _ in range(directories):
        kind, flags_and_id, size, offset = struct.unpack_from("<4s8sIQ", data, at)
        at += directory
        if kind != b"OPTS":
            total.update(kind + flags_and_id + data[offset : offset + size])
    for _ in range(tiles):
        layers, tables = data[at + 5], struct.unpack_from("<H", data, at + 6)[0]
        total.update(data[at : at + tile])
        at += tile
        for _ in range(layers):
            size, offset = struct.unpack_from("<IQ", data, at + 4)
            total.update(data[at : at + 4] + data[offset : offset + size])
            at += layer
        total.update(data[at : at + 2 * tables])
        at += 2 * tables
    return total.hexdigest()[:24]


def keys(value: Json, where: str = "") -> set[str]:
    """Return the keys of JSON: `splats.kept`, `rows[].psnr`."""
    if isinstance(value, dict):
        return {name for key, one in value.items() for name in keys(one, f"{where}.{key}".lstrip("."))}
    if isinstance(value, list):
        return {name for one in value for name in keys(one, f"{where}[]")} or {f"{where}[]"}
    return {where}


def bytes_group(_folder: Path) -> Iterator[tuple[str, Json]]:
    """Yield hashes of every scene at every preset."""
    for name, model in scenes().items():
        yield from _presets(name, model)


def shared_group(_folder: Path) -> Iterator[tuple[str, Json]]:
    """Yield hashes of scenes that are not in the project, at every preset; of those absent, nothing."""
    for name in SHARED_SCENES:
        if (SHARED / name).exists():
            yield from _presets(name, csplat.read(SHARED / name))


def _presets(name: str, model: csplat.SplatModel) -> Iterator[tuple[str, Json]]:
    for preset in PRESETS:
        yield f"{name} {preset}", digest(csplat.encode(model, csplat.EncodeOptions(preset=preset)))


def keys_group(folder: Path) -> Iterator[tuple[str, Json]]:
    """Yield the keys of what each command prints of small scenes, and of files with what these lack."""
    views, small = folder / "cameras.json", folder / "small.ply"
    views.write_text(json.dumps(cameras(6.0, 40)), encoding="utf-8")
    file, other, box = folder / "small.csplat", folder / "other.csplat", "-1,-1,-1,1,1,1"
    images, ply, tuned = write_images(folder / "images"), folder / "trained.ply", folder / "tuned.csplat"
    csplat.write_ply(small, csplat.read(SAMPLE).select(np.arange(0, 3000, 30)))
    scenes_folder = folder / "scenes"
    scenes_folder.mkdir()
    (scenes_folder / "small.ply").write_bytes(small.read_bytes())
    defects, damaged = folder / "defects.ply", VECTORS / "invalid" / "header_crc.csplat"
    lines = small.read_bytes().partition(b"end_header\n")
    defects.write_bytes(lines[0] + lines[1] + b"\0\0\xc0\x7f" + lines[2][4:])  # NaN
    commands: tuple[tuple[str, tuple[str | Path, ...]], ...] = (
        ("encode", ("encode", small, file, "--preset", "fast")),
        ("encode --max-error", ("encode", small, other, "--max-error", "means=0.001")),
        ("encode --target-size", ("encode", small, folder / "target.csplat", "--target-size", "2500", "--no-prune",
                                 "--cameras", views)),
        ("encode --dry-run", ("encode", small, folder / "none.csplat", "--dry-run")),
        ("decode", ("decode", file, folder / "decoded.ply")),
        ("info", ("info", file)),
        ("info", ("info", VECTORS / "valid" / "levels.csplat")),
        ("info", ("info", VECTORS / "valid" / "rich.csplat")),
        ("info of a PLY", ("info", small)),
        ("verify", ("verify", file)),
        ("verify", ("verify", damaged)),
        ("verify --source", ("verify", other, "--source", small)),
        ("lint", ("lint", defects)),
        ("extract", ("extract", file, folder / "part.csplat", "--box", box)),
        ("merge", ("merge", file, other, "-o", folder / "merged.csplat")),
        ("convert", ("convert", small, folder / "small.spz")),
        ("compare", ("compare", small, file, "--cameras", views)),
        ("compare --data", ("compare", small, file, "--data", images)),
        ("tradeoff", ("tradeoff", small, "--cameras", views, "--what", "presets")),
        ("render", ("render", small, folder / "renders", "--cameras", views)),
        ("simplify", ("simplify", small, folder / "simple.ply", "--keep", "0.6", "--cameras", views)),
        ("sensitivity", ("sensitivity", small, folder / "small.npz", "--cameras", views)),
        ("train", ("train", images, ply, "--max-splats", "50", "--sh-degree", "1", "--iterations", "50")),
        ("train to a file", ("train", images, folder / "trained.csplat", "--max-splats", "50", "--iterations", "5")),
        ("finetune", ("finetune", ply, tuned, "--data", images, "--iterations", "2")),
        ("export-html", ("export-html", file, folder / "page.html")),
        ("export-element", ("export-element", folder / "element.js")),
        ("conformance decoder", ("conformance", "decoder", "--filter", "valid/quats*")),
        ("conformance encoder", ("conformance", "encoder", "--filter", "*/one_splat", "--level", "1")),
        ("batch", ("batch", scenes_folder, folder / "batch", "--", "encode", "--preset", "fast")),
    )  # fmt: skip
    found: dict[str, set[str]] = {}
    for name, words in commands:
        found.setdefault(name, set()).update(keys(run(*words, status=int(words[1] in (defects, damaged)))))
    yield from ((name, sorted(those)) for name, those in found.items())


GROUPS = {"bytes": bytes_group, "shared": shared_group, "keys": keys_group}


def libdeflate() -> str:
    """Return the version of the library on which bytes depend."""
    return importlib.metadata.version("deflate")


def make(group: str) -> dict[str, Json]:
    """Make what a group holds now."""
    with tempfile.TemporaryDirectory(prefix="csplat-behaviour-") as folder:
        return dict(GROUPS[group](Path(folder)))


def recorded() -> dict[str, Json]:
    """Return the snapshot."""
    return json.loads(GOLDENS.read_text(encoding="utf-8"))


def renew(groups: list[str]) -> None:
    """Make groups anew, and print what changed."""
    known = recorded() if GOLDENS.exists() else {}
    for group in groups:
        made, before = make(group), known.get(group, {})
        for name in sorted(made.keys() | before.keys()):
            if made.get(name) != before.get(name):
                print(f"{group}, {name}: {before.get(name)} became {made.get(name)}")
        known[group] = made
    known["libdeflate"] = libdeflate()
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

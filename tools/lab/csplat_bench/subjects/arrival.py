# SPDX-License-Identifier: Apache-2.0
"""Scenes that arrive over a slow line: milliseconds and bytes until they can be seen, in several viewers.

A case has a `viewer` (a page of subjects/pages), a `form` of the file, all forms made from the same PLY, and `mbits`,
million bits per second over all connections together. Option: `latency_ms` before each answer. Page, modules and
renderer are already loaded. A small image of the canvas is recorded after each frame. The last image, when everything
has arrived and nothing changes, is the finished one, with which the others are compared.

    first                the first image that is not black
    db25, db30, db38     the first image with 25, 30, 38 dB against the finished one
    whole                the finished one
    asked_bytes          bytes sent in all: fewer than the files have if the viewer omits some, more if it asks twice

Times count from the first request for the scene; bytes are those sent by then. SwiftShader, a GL on the CPU, draws and
shares the cores with decoders: with a GPU, a first image takes fewer bytes. Files, which a later run uses again, and
the images of each case are written to the work folder; look at them. Requires Chromium, playwright and npm.
"""

from __future__ import annotations

import base64
import json
import shutil
import tempfile
import time
import zipfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import csplat
from csplat.encode_api import encode
from csplat.encoder import EncodeOptions, PresetName
from csplat.formats import format_by_name, write
from csplat.ply import read_ply
from csplat_bench.engine_stage import HEIGHT, WIDTH, chosen_view, opened_page, pinhole, placed_in
from csplat_bench.measuring import run_program
from csplat_bench.peers import find_splat_transform
from csplat_bench.protocol import Measure, Setup
from csplat_bench.scenes import Scene, find_scene
from csplat_bench.slow_line import SLOW, Line
from csplat_bench.suites import Case
from csplat_render.metrics import psnr
from csplat_tools.level_builder import FittedLevelBuilder
from csplat_tools.render_files import write_png

_STEPS = {"db25": 25.0, "db30": 30.0, "db38": 38.0}  # dB
_SMALL = (120, 160)  # rows and columns of the images, as pages/arrival.mjs has them
_BLACK = 8  # largest component of a black image
_STILL_SECONDS, _FRAMES = 1.5, 5  # seconds and frames without change after which an image is finished
_TIMEOUT_SECONDS = 420.0
_POLL_MS = 100
_LEVELS = ("25%", "6%")  # fractions of the splats in the levels of streamed SOG below the finest
_SUPERSPLAT = {"@playcanvas/supersplat-viewer": "1"}
_BEGIN = """async ([viewer, url, camera]) => {
  window.arrival = await import('/pages/arrival.mjs');
  arrival.begin(viewer, url, camera);
}"""

#: Writes a scene into an empty folder. The function finds splat-transform.
Writer = Callable[[Scene, Path, Callable[[], Sequence[str]]], None]


@dataclass(frozen=True)
class Record:
    """Everything that was seen in one run.

    Attributes:
        times: of the images, seconds since the epoch, increasing.
        images: [N, H, W, 3] uint8, each different from the one before; the last is the finished one.
        sent: times in seconds since the epoch, and bytes sent then.
        begun: time of the first request, seconds since the epoch.
    """

    times: Sequence[float]
    images: NDArray[np.uint8]
    sent: Sequence[tuple[float, int]]
    begun: float

    @property
    def shown(self) -> dict[str, int]:
        """Indices of the first image that is not black, the first ones nearer to the finished one, and that one."""
        finished = self.images[-1].astype(np.float32) / 255.0
        at = int(np.argmax((self.images > _BLACK).any((1, 2, 3))))
        shown = {"first": at}
        for name, least in _STEPS.items():
            while psnr(self.images[at].astype(np.float32) / 255.0, finished) < least:
                at += 1
            shown[name] = at
        return {**shown, "whole": len(self.images) - 1}

    def values(self) -> dict[str, float]:
        """Return the times of these images in milliseconds, and the bytes sent by then."""
        values: dict[str, float] = {}
        for name, index in self.shown.items():
            at = self.times[index]
            values[f"{name}_ms"] = 1e3 * (at - self.begun)
            values[f"{name}_bytes"] = sum(size for moment, size in self.sent if moment <= at)
        return {**values, "asked_bytes": sum(size for _, size in self.sent)}


@contextmanager
def measure_arrival(setup: Setup, name: str, cases: Sequence[Case]) -> Iterator[Measure]:
    """Yield the function that lets a viewer open a file once."""
    scene = find_scene(name, setup.data, setup.work)
    line = Line(1e6, 1e-3 * setup.options["latency_ms"])
    more = _SUPERSPLAT if any(case["viewer"] == "supersplat" for case in cases) else None
    with ExitStack() as stack:
        page, folder, address = stack.enter_context(opened_page(setup.chromium, setup.peers, more, line.serve))
        model, _ = chosen_view(scene)
        files: dict[str, Path] = {}

        def measure(case: Case) -> Mapping[str, Any]:
            form = case["form"]
            axes, writer = FORMS[form]
            kept = setup.work / "arrival" / f"{scene.name}-{form}"
            if form not in files:
                if not kept.exists():
                    with tempfile.TemporaryDirectory(prefix="csplat-arrival-") as name:
                        writer(scene, Path(name), lambda: find_splat_transform(setup.peers))
                        shutil.copytree(name, kept)
                target = folder / SLOW.strip("/") / kept.name
                target.parent.mkdir(exist_ok=True)
                target.symlink_to(kept.resolve())
                files[form] = target / _opened(kept).name
            _, camera = placed_in(format_by_name(axes), model)
            url = f"{address}{files[form].relative_to(folder)}"
            line.bits_per_second = 1e6 * case["mbits"]
            record = _watch(page, line, case["viewer"], url, pinhole(camera, model))
            _keep_images(
                setup.work / "arrival" / f"{scene.name}-{case.name.replace(' ', '-').replace('/', '-')}.png", record
            )
            size = sum(path.stat().st_size for path in kept.rglob("*") if path.is_file())
            return {"splats": scene.splat_count, "file_bytes": size, **record.values()}

        yield measure


def _opened(folder: Path) -> Path:
    """Return the file that viewers open: the metadata of streamed SOG, or the only file."""
    meta = folder / "lod-meta.json"
    return meta if meta.exists() else next(folder.iterdir())


def _watch(page: Any, line: Line, viewer: str, url: str, camera: dict[str, Any]) -> Record:
    """Let a viewer open a file, and watch until nothing changes.

    Raises:
        OSError: the viewer fails, or shows nothing.
    """
    page.set_viewport_size({"width": WIDTH, "height": HEIGHT})
    page.goto(f"{url.partition(SLOW)[0]}/page.html")
    line.forget()
    page.evaluate(_BEGIN, [viewer, url, camera])
    end = time.monotonic() + _TIMEOUT_SECONDS
    while True:
        page.wait_for_timeout(_POLL_MS)
        state = page.evaluate("arrival.state()")
        if state["failed"] or time.monotonic() > end:
            raise OSError(str(state["failed"] or "the image keeps changing"))
        still = min(1e-3 * state["still"], line.quiet_seconds) >= _STILL_SECONDS and state["frames"] >= _FRAMES
        if state["whole"] and still and state["pictures"]:
            break
    times, texts = zip(*page.evaluate("arrival.pictures()"), strict=True)
    images = [np.frombuffer(base64.b64decode(text), np.uint8).reshape(*_SMALL, 4)[..., :3] for text in texts]
    if line.begun is None or not (images[-1] > _BLACK).any():
        raise OSError("the last image is black")
    return Record([1e-3 * at for at in times], np.stack(images), list(line.sent), line.begun)


def _keep_images(path: Path, record: Record) -> None:
    """Write the images of all steps, from left to right."""
    path.parent.mkdir(parents=True, exist_ok=True)
    write_png(path, np.concatenate([record.images[index] for index in record.shown.values()], axis=1))


def _as_csplat(preset: PresetName) -> Writer:
    def write_form(scene: Scene, folder: Path, _: object) -> None:
        (folder / f"{scene.name}.csplat").write_bytes(encode(read_ply(scene.path), EncodeOptions(preset=preset)))

    return write_form


def _convert(format: str) -> Writer:
    def write_form(scene: Scene, folder: Path, _: object) -> None:
        write(folder / f"{scene.name}.{format}", read_ply(scene.path), format)

    return write_form


def _transform(scene: Scene, folder: Path, transform: Callable[[], Sequence[str]]) -> None:
    run_program([*transform(), "-q", "-w", "--spz-version", "3", scene.path, folder / f"{scene.name}.spz"])


def _with_levels(scene: Scene, folder: Path, _: object) -> None:
    (folder / f"{scene.name}.csplat").write_bytes(csplat.encode(csplat.read(scene.path), levels=FittedLevelBuilder()))


def _in_levels(scene: Scene, folder: Path, transform: Callable[[], Sequence[str]]) -> None:
    """Write streamed SOG of one chunk, laid out as splat-transform does.

    `csplat convert` writes each level: splat-transform's own coding of SH takes hours on a CPU.
    """
    sources = [scene.path]
    for share in _LEVELS:
        sources.append(folder / f"{share}.ply")
        run_program([*transform(), "-q", "-w", "-g", "cpu", scene.path, sources[-1], "-d", share])
    models = [read_ply(source) for source in sources]
    for level, model in enumerate(models):
        bundle = folder / "level.sog"
        write(bundle, model, "sog")
        with zipfile.ZipFile(bundle) as files:
            files.extractall(folder / f"{level}_0")
        bundle.unlink()
    for source in sources[1:]:
        source.unlink()
    means, counts = models[0].means, [len(model) for model in models]
    meta = {
        "version": 1, "asset": {"generator": "csplat_bench"}, "count": sum(counts), "counts": counts,
        "lodLevels": len(counts), "lodErrors": False, "filenames": [f"{i}_0/meta.json" for i in range(len(counts))],
        "tree": {
            "bound": {"min": means.min(0).tolist(), "max": means.max(0).tolist()},
            "lods": {str(i): {"file": i, "offset": 0, "count": count} for i, count in enumerate(counts)},
        },
    }  # fmt: skip
    (folder / "lod-meta.json").write_text(json.dumps(meta))


#: By name: the format whose axes the files have, and what writes them.
FORMS: dict[str, tuple[str, Writer]] = {
    "balanced": ("csplat", _as_csplat("balanced")),
    "small": ("csplat", _as_csplat("small")),
    "levels": ("csplat", _with_levels),
    "spz": ("spz", _convert("spz")),  # SPZ 3 of csplat
    "spz-default": ("ply", _transform),  # SPZ 3 of splat-transform, with fewer bits for SH
    "sog": ("sog", _convert("sog")),
    "sog-levels": ("sog", _in_levels),  # streamed SOG of three levels
}

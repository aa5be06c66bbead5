# SPDX-License-Identifier: Apache-2.0
"""Loaders of .csplat in engines: their memory, and how they handle aborted loads and damaged files.

A case is an `engine`; files are encoded with preset balanced and served by this machine to Chromium, 320 by 240.

    same_psnr               dB against the image of the decoded PLY in the same engine
    heap_bytes, gpu_bytes   bytes per splat on the JavaScript heap, arrays included, and of WebGL's textures and
                            buffers, after a garbage collection
    abort, abort_ms         what an aborted load rejects with, and after how many milliseconds
    damaged                 error codes for a file with a flipped bit, and for half a file
    heap_left, gpu_left     bytes after the last of twenty loads and disposals beyond those after the second

Requires Chromium, playwright and npm.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from typing import Any

from csplat.encode_api import encode
from csplat.encoder import EncodeOptions
from csplat.formats import read, write
from csplat_bench.engine_stage import ENGINES, chosen_view, opened_page, pinhole
from csplat_bench.protocol import Measure, Setup
from csplat_bench.scenes import find_scene
from csplat_bench.subjects.engine_images import settled_image
from csplat_bench.suites import Case
from csplat_render.metrics import psnr

_LOADS = 20


@contextmanager
def measure_loaders(setup: Setup, name: str, _: Sequence[Case]) -> Iterator[Measure]:
    """Yield the function that tries a loader."""
    with ExitStack() as stack:
        page, folder, address = stack.enter_context(opened_page(setup.chromium, setup.peers))
        model, camera = chosen_view(find_scene(name, setup.data, setup.work))
        data = encode(model, EncodeOptions(preset="balanced"))
        (folder / "scene.csplat").write_bytes(data)
        (folder / "flipped.csplat").write_bytes(data[:-9] + bytes([data[-9] ^ 4]) + data[-8:])
        (folder / "cut.csplat").write_bytes(data[: len(data) // 2])
        decoded = read(folder / "scene.csplat")
        write(folder / "scene.ply", decoded, "ply")

        def measure(case: Case) -> Mapping[str, Any]:
            return try_loader(Trial(page, address, case["engine"], pinhole(camera, decoded)))

        yield measure


class Trial:
    """An engine on a page, with a camera.

    Args:
        page: playwright's.
        address: address of the folder that `engine_stage.opened_page` serves.
        engine: name of its page.
        camera: a camera, as `engine_stage.pinhole` returns it.
    """

    def __init__(self, page: Any, address: str, engine: str, camera: dict[str, Any]) -> None:
        self.page, self.address, self.engine, self.camera = page, address, engine, camera
        self.version = ""

    def start(self, **options: object) -> Trial:
        """Load the page with the engine, without a scene."""
        self.page.set_viewport_size({"width": self.camera["width"], "height": self.camera["height"]})
        self.page.goto(f"{self.address}page.html")
        words = "async (words) => { window.trial = await import('/pages/trial.mjs'); return trial.start(...words); }"
        self.version = self.page.evaluate(words, [self.engine, self.camera, options])
        return self

    def show(self, file: str, *, moved: bool = True, **options: object) -> dict[str, Any]:
        """Show a file of the folder; return the report of pages/trial.mjs. The camera stays unless `moved`."""
        words = [f"{self.address}{file}", self.camera if moved else None, options]
        report: dict[str, Any] = self.page.evaluate("(words) => trial.show(...words)", words)
        return report

    def look(self, camera: dict[str, Any]) -> None:
        """Move the camera."""
        self.page.evaluate("(camera) => trial.look(camera)", camera)

    def levels(self) -> dict[str, Any]:
        """Return the number of splats drawn of a file with levels, and whether all that the camera requires is here."""
        state: dict[str, Any] = self.page.evaluate("trial.levels()")
        return state

    def remove(self) -> None:
        """Remove the scene."""
        self.page.evaluate("trial.remove()")

    def repeat(self, file: str, times: int) -> None:
        """Show and remove a file, `times` times."""
        self.page.evaluate("(words) => trial.repeat(...words)", [f"{self.address}{file}", self.camera, times])

    def memory(self) -> tuple[float, float]:
        """Return bytes on the heap, arrays included, and of WebGL, after a garbage collection."""
        session = self.page.context.new_cdp_session(self.page)
        session.send("HeapProfiler.enable")
        session.send("HeapProfiler.collectGarbage")
        heap = session.send("Runtime.getHeapUsage")
        session.detach()
        return heap["usedSize"] + heap.get("backingStorageSize", 0.0), self.page.evaluate("trial.gpuBytes()")


def try_loader(trial: Trial) -> dict[str, Any]:
    """Load scene.csplat, damaged files, and the same file twenty times."""
    file = "scene.csplat"
    trial.start().show(file, progressive=True)
    image = settled_image(trial.page)
    trial.start().show("scene.ply")
    twin = settled_image(trial.page)
    before = trial.start().memory()
    splats = trial.show(file)["count"]
    heap, gpu = ((after - was) / splats for after, was in zip(trial.memory(), before, strict=True))
    trial.remove()
    failed = [trial.show(one).get("failed", {"code": "OPENED"})["code"] for one in ("flipped.csplat", "cut.csplat")]
    aborted = trial.show(file, abortAt=1).get("failed", {"name": "OPENED", "ms": 0.0})
    trial.repeat(file, 1)
    early = trial.memory()
    trial.repeat(file, _LOADS - 2)
    heap_left, gpu_left = (after - was for after, was in zip(trial.memory(), early, strict=True))
    return {
        "engine": f"{ENGINES[trial.engine].title} {trial.version}", "splats": splats, "same_psnr": psnr(image, twin),
        "heap_bytes": heap, "gpu_bytes": gpu, "abort": aborted["name"], "abort_ms": aborted["ms"],
        "damaged": ", ".join(failed), "heap_left": heap_left, "gpu_left": gpu_left,
    }  # fmt: skip

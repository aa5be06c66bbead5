"""Measure the loaders of .csplat in engines: their memory, and their behaviour other than showing a scene.

    python -m csplat_bench.viewer.loaders
    python -m csplat_bench.viewer.loaders --scenes lego60k --engines three,spark

Encodes scenes (balanced), lets the engines open them in Chromium at 320x240 from a server on the same machine, and
does what a page does; `viewer.arrival` measures how soon something is visible. Bytes per splat on the JavaScript heap,
arrays included, and of WebGL's textures and buffers, once all is there and garbage is collected. `abort`: what comes
of a load that is ended, and within how many ms. `damaged`: codes of the errors for a file with a flipped bit and for
half a file. `20 loads`: how many MB of heap and of GPU are taken after the last of twenty loads and disposals that
were not after the second. `same`: the picture against that of the PLY decoded from the file in the same engine, dB.
Requires Chromium, playwright, npm.
"""

from __future__ import annotations

import shutil
import sys
from dataclasses import asdict, dataclass
from typing import Annotated, Any

import typer

from csplat.encoder import EncodeOptions, encode
from csplat.formats import read, write
from csplat_bench.common.command import CACHE, EXTRA, JSON, MARKDOWN, PEERS, SCENES, listed, run
from csplat_bench.common.report import table, tell_machine, write_json
from csplat_bench.common.scenes import MADE, NPM, find_scenes
from csplat_bench.viewer.owners import still
from csplat_bench.viewer.rules import ENGINES
from csplat_bench.viewer.stage import looked_at, opened_page, pinhole
from csplat_render.metrics import psnr
from csplat_tools.console import note

_LOADS = 20
_HEADER = (
    "scene", "engine", "splats", "same", "heap B/splat", "GPU B/splat", "abort", "damaged",
    "20 loads",
)  # fmt: skip


@dataclass(frozen=True)
class Loaded:
    """Measurements of a loader on a scene.

    Attributes:
        splats: number of splats that the engine holds.
        same: PSNR against the picture of the PLY in the same engine, dB.
        heap, gpu: bytes per splat on the JavaScript heap and on the GPU.
        abort: what an aborted load rejects with, and after how many ms.
        damaged: codes of the errors for a flipped bit and a file cut short.
        heap_left, gpu_left: bytes more after twenty loads than after two.
    """

    scene: str
    engine: str
    splats: int
    same: float
    heap: float
    gpu: float
    abort: str
    damaged: str
    heap_left: float
    gpu_left: float

    @property
    def cells(self) -> tuple[str, ...]:
        """The cells of its table row."""
        left = f"{self.heap_left / 1e6:+.1f}, {self.gpu_left / 1e6:+.1f}"
        numbers = (f"{one:.0f}" for one in (self.heap, self.gpu))
        same = f"{self.same:.1f}"
        return self.scene, self.engine, f"{self.splats:,}", same, *numbers, self.abort, self.damaged, left


def main(
    *,
    scenes: SCENES = "sample,fox120k,lego60k,donut",
    engines: Annotated[str, typer.Option(help="which")] = ",".join(ENGINES),
    extra: EXTRA = [],
    markdown: MARKDOWN = False,
    json: JSON = None,
    chromium: Annotated[str, typer.Option(help="the program")] = shutil.which("chromium") or "chromium",
    cache: CACHE = MADE,
    peers: PEERS = NPM,
) -> None:
    """Measure what the command line names, and print a table."""
    machine, rows = tell_machine(), list[Loaded]()
    with opened_page(chromium, peers) as (page, folder, address):
        for scene in find_scenes(listed(scenes), cache, extra):
            model, camera = looked_at(scene)
            data = encode(model, EncodeOptions(preset="balanced"))
            (folder / f"{scene.name}.csplat").write_bytes(data)
            (folder / "flipped.csplat").write_bytes(data[:-9] + bytes([data[-9] ^ 4]) + data[-8:])
            (folder / "cut.csplat").write_bytes(data[: len(data) // 2])
            decoded = read(folder / f"{scene.name}.csplat")
            write(folder / f"{scene.name}.ply", decoded, "ply")
            for name in listed(engines):
                trial = Trial(page, address, name, pinhole(camera, decoded))
                rows.append(trial.loaded(scene.name))
                note(" ".join(rows[-1].cells))
    print(table(_HEADER, [row.cells for row in rows], markdown=markdown))
    if json is not None:
        write_json(json, {"machine": machine, "rows": [asdict(row) for row in rows]})


class Trial:
    """An engine on a page, and a camera.

    Args:
        page: playwright's.
        address: address of the folder that `stage.opened_page` serves.
        engine: name of its page.
        camera: a camera as returned by `stage.pinhole`.
    """

    def __init__(self, page: Any, address: str, engine: str, camera: dict[str, Any]) -> None:
        self.page, self.address, self.engine, self.camera = page, address, engine, camera
        self.version = ""

    def start(self, **options: object) -> Trial:
        """Load the page anew, with the engine and without a scene."""
        self.page.set_viewport_size({"width": self.camera["width"], "height": self.camera["height"]})
        self.page.goto(f"{self.address}page.html")
        words = "async (words) => { window.trial = await import('/pages/trial.mjs'); return trial.start(...words); }"
        self.version = self.page.evaluate(words, [self.engine, self.camera, options])
        return self

    def show(self, file: str, *, moved: bool = True, **options: object) -> dict[str, Any]:
        """Show a file of the folder, with the camera unchanged unless `moved`; return the report of pages/trial.mjs."""
        words = [f"{self.address}{file}", self.camera if moved else None, options]
        said: dict[str, Any] = self.page.evaluate("(words) => trial.show(...words)", words)
        return said

    def remove(self) -> None:
        """Take the scene away."""
        self.page.evaluate("trial.remove()")

    def repeat(self, file: str, times: int) -> None:
        """Show a file and take it away, `times` times."""
        self.page.evaluate("(words) => trial.repeat(...words)", [f"{self.address}{file}", self.camera, times])

    def taken(self) -> tuple[float, float]:
        """Bytes on the heap, arrays included, and of WebGL, after a collection of garbage."""
        session = self.page.context.new_cdp_session(self.page)
        session.send("HeapProfiler.enable")
        session.send("HeapProfiler.collectGarbage")
        heap = session.send("Runtime.getHeapUsage")
        session.detach()
        return heap["usedSize"] + heap.get("backingStorageSize", 0.0), self.page.evaluate("trial.gpuBytes()")

    def loaded(self, scene: str) -> Loaded:
        """Do all of it."""
        file = f"{scene}.csplat"
        self.start().show(file, progressive=True)
        picture = still(self.page)
        self.start().show(f"{scene}.ply")
        twin = still(self.page)
        before = self.start().taken()
        said = self.show(file)
        splats = said["count"]
        heap, gpu = ((after - was) / splats for after, was in zip(self.taken(), before, strict=True))
        self.remove()
        failed = [self.show(one).get("failed", {"code": "OPENED"})["code"] for one in ("flipped.csplat", "cut.csplat")]
        ended = self.show(file, abortAt=1).get("failed", {"name": "OPENED", "ms": 0.0})
        self.repeat(file, 1)
        early = self.taken()
        self.repeat(file, _LOADS - 2)
        heap_left, gpu_left = (after - was for after, was in zip(self.taken(), early, strict=True))
        return Loaded(
            scene, f"{ENGINES[self.engine].title} {self.version}", splats, psnr(picture, twin),
            heap, gpu, f"{ended['name']}, {ended['ms']:.0f} ms", ", ".join(failed), heap_left, gpu_left,
        )  # fmt: skip


if __name__ == "__main__":
    sys.exit(run(main))

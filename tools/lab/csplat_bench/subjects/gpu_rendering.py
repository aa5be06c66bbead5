# SPDX-License-Identifier: Apache-2.0
"""The renderer on the GPU: milliseconds of each stage and GPU memory, for packed files and float models; and gsplat.

A case has a `layout`: `packed`, the integers of a file; `floats`, its decoded values; or `gsplat`, gsplat's kernels on
the same values, if torch has CUDA; and `copies`, how often the scene lies side by side. Options: `size`, pixels of an
image; `frames`, how many are measured of each view, after a fifth of that to warm up; `views` on an orbit; `software`,
true to use an adapter that emulates a GPU. Times are medians over frames, then means over views. `wall_ms` is the time
of a frame among many, without bringing images to the CPU; `compare_s` is that of `csplat compare --backend gpu` over
eight views of 640 by 480 pixels, once both scenes are on the GPU. PSNR is that of the first view against the rasteriser
on the CPU.
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from types import SimpleNamespace
from typing import Any

import numpy as np

import csplat
from csplat.errors import InputError
from csplat.model import SplatModel
from csplat.packed import PackedTile
from csplat.splat_file import SplatFile
from csplat_bench.protocol import AbsentError, Measure, Setup
from csplat_bench.scenes import find_scene
from csplat_bench.suites import Case
from csplat_render import Camera, render
from csplat_render.camera_paths import orbit_cameras
from csplat_render.gpu.device import Device, open_device
from csplat_render.gpu.renderer import GpuRenderer, GpuScene
from csplat_render.gpu.scoring import compare_scenes
from csplat_render.metrics import psnr

#: Stages of a frame, in order.
STAGES = ("cull", "project", "depth sort", "bin", "tile sort", "blend")
_COMPARED = (8, 640, 480)  # views, and the size of each


@dataclass(frozen=True)
class _MovedFile:
    """A file at another place."""

    file: SplatFile
    origin: tuple[float, float, float]

    @property
    def header(self) -> Any:
        return SimpleNamespace(origin=self.origin, antialiased=self.file.header.antialiased)

    def packed_tiles(self, tiles: Sequence[int] | None = None, *, sh_degree: int | None = None) -> Iterator[PackedTile]:
        return self.file.packed_tiles(tiles, sh_degree=sh_degree)

    def read(self, *, sh_degree: int | None = None) -> SplatModel:
        return self.file.read(sh_degree=sh_degree)


@contextmanager
def measure_gpu(setup: Setup, name: str, _: Sequence[Case]) -> Iterator[Measure]:
    """Yield the function that renders copies of a scene."""
    try:
        device = open_device(software=bool(setup.options.get("software")))
    except InputError as error:
        raise AbsentError(str(error)) from None
    data = csplat.encode(csplat.read(find_scene(name, setup.data, setup.work).path))
    single = csplat.decode(data)
    width, height = setup.options["size"]
    frames = setup.options["frames"]

    def measure(case: Case) -> Mapping[str, Any]:
        places = _places(single, case["copies"])
        model = _copies(single, places)
        sample = model.select(slice(None, None, len(places)))
        cameras = orbit_cameras(sample, setup.options["views"], width, height)
        common = {"splats": len(model), "sh_degree": model.sh_degree, "gpu": str(device.adapter)}
        if case["layout"] == "gsplat":
            return {**common, **_measure_gsplat(model, cameras, frames)}
        with SplatFile.open(data) as file:
            packed = case["layout"] == "packed"
            scene = GpuScene(device, [_MovedFile(file, place) for place in places] if packed else [model])
        renderer = GpuRenderer(scene)
        image = renderer.render(cameras[0])
        found = [_measure_view(renderer, device, camera, frames) for camera in cameras]
        compared = orbit_cameras(sample, *_COMPARED)
        compare_scenes(scene, scene, compared[:1])
        start = time.perf_counter()
        compare_scenes(scene, scene, compared)
        compare_s = time.perf_counter() - start
        stages = {f"{stage.replace(' ', '_')}_ms": _mean(one.get(stage) for one in found) for stage in STAGES}
        return {
            **common, **stages, "frame_ms": _mean(one.get("frame") for one in found),
            "wall_ms": _mean(one["wall"] for one in found), "compare_s": compare_s,
            "bytes_per_splat": scene.size_bytes / max(1, len(model)), "visible": image.visible, "pairs": image.pairs,
            "psnr": psnr(render(model, cameras[0]).rgb, image.rgb),
        }  # fmt: skip

    yield measure


def _places(model: SplatModel, count: int) -> list[tuple[float, float, float]]:
    """Return the origins of copies side by side in x and y."""
    low, high = np.percentile(model.means, (2, 98), axis=0)
    columns = int(np.ceil(np.sqrt(count)))
    steps = [(number % columns, number // columns) for number in range(count)]
    return [(float(x * (high - low)[0]), float(y * (high - low)[1]), 0.0) for x, y in steps]


def _copies(model: SplatModel, places: Sequence[tuple[float, float, float]]) -> SplatModel:
    """Return copies of a scene as one model, relative to the first place."""
    several = len(places)
    means = np.concatenate([model.means + np.asarray(place, np.float32) for place in places])
    rest: dict[str, Any] = {
        name: np.concatenate([getattr(model, name)] * several)
        for name in ("quats", "scales", "opacities", "sh0", "shN")
    }
    return replace(model, means=means, origin=(0.0, 0.0, 0.0), extra={}, **rest)


def _measure_view(renderer: GpuRenderer, device: Device, camera: Camera, frames: int) -> dict[str, float]:
    """Return milliseconds of each stage, of the frame and of its wall time."""
    (rows,) = renderer.bands(camera)
    for _ in range(max(2, frames // 5)):  # buffers grow, clocks rise
        renderer.draw(camera, rows)
        (rows,) = renderer.bands(camera)
    found: dict[str, float] = {}
    if device.has_timestamps:
        timed = [renderer.time(camera) for _ in range(frames)]
        found = {stage: statistics.median(one[stage] for one in timed) for stage in timed[0]}
        found["frame"] = statistics.median(sum(one.values()) for one in timed)
    start = time.perf_counter()
    for _ in range(frames):
        renderer.draw(camera, rows)
    return {**found, "wall": 1e3 * (time.perf_counter() - start) / frames}


def _mean(values: Iterable[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return statistics.fmean(known) if known else None


def _measure_gsplat(model: SplatModel, cameras: Sequence[Camera], frames: int) -> dict[str, Any]:
    """Return the same of gsplat's kernels, by CUDA events."""
    try:
        import torch
        from gsplat import rasterization
    except ModuleNotFoundError as error:
        raise AbsentError(f"{error.name} is not installed") from None
    if not torch.cuda.is_available():
        raise AbsentError("torch has no CUDA here")
    tensors = {
        name: torch.from_numpy(np.ascontiguousarray(value)).cuda()
        for name, value in {
            "means": model.means, "quats": model.quats, "scales": np.exp(model.scales), "opacities": model.opacities,
            "colors": np.concatenate([model.sh0[:, None], model.shN], axis=1),
        }.items()
    }  # fmt: skip
    make_event: Any = torch.cuda.Event
    times = []
    for camera in cameras:
        views, matrices = (torch.tensor(one, dtype=torch.float32).cuda()[None] for one in (camera.viewmat, camera.K))
        spent = []
        for _ in range(frames + max(2, frames // 5)):
            begin, end = (make_event(enable_timing=True) for _ in range(2))
            begin.record()
            with torch.no_grad():
                rasterization(
                    **tensors, viewmats=views, Ks=matrices, width=camera.W, height=camera.H, near_plane=camera.near,
                    sh_degree=model.sh_degree, packed=False,
                )  # fmt: skip
            end.record()
            end.synchronize()
            spent.append(begin.elapsed_time(end))
        times.append(statistics.median(spent[-frames:]))
    size = sum(tensor.numel() * tensor.element_size() for tensor in tensors.values())
    return {"frame_ms": statistics.fmean(times), "bytes_per_splat": size / max(1, len(model))}

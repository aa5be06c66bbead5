# SPDX-License-Identifier: Apache-2.0
"""Render a scene to PNG files in a folder, or to a video, as `csplat render` does."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from csplat.context import DEFAULT_CONTEXT, Context
from csplat.errors import InputError
from csplat.model import SplatModel
from csplat.types import F32
from csplat_render import Backend, Camera, Mode
from csplat_render.camera import fitted, resized
from csplat_render.camera_files import load_cameras
from csplat_render.camera_paths import orbit_cameras
from csplat_render.conventions import Render, RenderResult
from csplat_render.first_view import first_view
from csplat_render.scorer import Renderable, renderer
from csplat_tools.file_streams import check_output, write_array
from csplat_tools.optional_packages import require_images, require_renderer
from csplat_tools.render_files import (
    check_film,
    image_names,
    make_output_folder,
    removed_if_unfinished,
    to_uint8,
    write_film,
    write_png,
)
from csplat_tools.views import BLACK, Colour, DataOptions, Split, find_view_set

_DEFAULT_SIZE = (640, 480)


@dataclass(frozen=True)
class Rendered:
    """The written files.

    Attributes:
        files: paths in the order of the cameras.
        ignored_count: number of splats that were not drawn because they hold NaN or infinities.
    """

    files: tuple[Path, ...]
    ignored_count: int


def find_cameras(
    model: SplatModel,
    path: str | None = None,
    orbit_count: int | None = None,
    data: DataOptions | None = None,
    size: tuple[int, int] | None = None,
    *,
    split: Split = "test",
    report: list[str] | None = None,
) -> list[Camera]:
    """Return the cameras of a file, of a data set, or of an orbit; without any of these the first view alone.

    Args:
        model: the scene; cameras are relative to its origin.
        path: path of a camera file.
        orbit_count: number of cameras on a closed path; it follows the cameras of a file or a data set, if given.
        data: a data set; its own size is used instead of `size`, unless there is an orbit.
        size: width and height of the renders; `None`: the size in the file, or 640×480.
        split: the part of the data set.
        report: receives remarks on camera files of other programs.

    Raises:
        InputError: both a file and a set are given; the file or the set is invalid; `size` has another aspect ratio;
            the scene has no first view.
    """
    if path is None and orbit_count is None and data is None:
        return [fitted(first_view(model), *(size or _DEFAULT_SIZE))]
    if path is not None and data is not None:
        raise InputError("a camera file and a data set are given, expected only one of them")
    cameras: list[Camera] = []
    if path is not None:
        cameras = load_cameras(path, report, model.origin)
    elif data is not None:
        # An orbit uses the positions of the cameras, but not the size of their images: `size` is the orbit's.
        data_set = data if orbit_count is None else replace(data, size=None)
        views = find_view_set(model, data=data_set, count=0, split=split, check_fit=False)
        cameras = [*views.test, *(() if orbit_count is None else (*views.training, *views.validation))]
        if not cameras:
            raise InputError(f"{data.path} has no {split} views")
    if orbit_count is not None:
        return orbit_cameras(model, orbit_count, *(size or _DEFAULT_SIZE), along=cameras)
    return cameras if size is None or data is not None else [resized(camera, *size) for camera in cameras]


def render_folder(
    model: SplatModel,
    cameras: Sequence[Camera],
    folder: str,
    *,
    background: Colour | None = None,
    mode: Mode = "standard",
    backend: Backend = "cpu",
    depth: bool = False,
    alpha: bool = False,
    force: bool = False,
    context: Context = DEFAULT_CONTEXT,
) -> Rendered:
    """Render a scene and write NAME.png for each camera.

    Args:
        model: the scene.
        cameras: the views. Renders are named after their images, or by numbers.
        folder: the folder for the files; it is made if missing.
        background: red, green, blue, 0..1; `None`: the colour of the scene's training if known, else black.
        mode, backend: see `csplat_render.render`.
        depth: write NAME.depth.npy, too, [H, W] float32: mean depth along the camera's axis, scene units; 0 in pixels
            without splats. Requires the backend cpu.
        alpha: write NAME.alpha.png, too; 255 is opaque.
        force: existing files may be replaced.
        context: threads and progress.

    Raises:
        InputError: a file exists; the renderer is not installed; there is no GPU, or it cannot give the depth.
        OSError: a file cannot be written.
    """
    if depth and backend != "cpu":
        raise InputError(f"the depth requires the backend cpu, found {backend}")
    require_renderer()
    require_images()
    names = image_names([camera.image for camera in cameras])
    endings = [".png", *([".depth.npy"] if depth else []), *([".alpha.png"] if alpha else [])]
    is_new = not Path(folder).exists()
    target = make_output_folder(folder, [name + ending for name in names for ending in endings], force=force)
    files, ignored = list[Path](), 0
    with removed_if_unfinished(files, target if is_new else None):
        renders = _render_each(model, cameras, background, mode, backend, context)
        for name, result in zip(names, renders, strict=True):
            ignored = max(ignored, result.ignored)
            write_png(target / f"{name}.png", to_uint8(result.rgb))
            files.append(target / f"{name}.png")
            if alpha:
                write_png(target / f"{name}.alpha.png", to_uint8(result.alpha))
                files.append(target / f"{name}.alpha.png")
            if depth:
                assert isinstance(result, RenderResult)  # the CPU's
                write_array(str(target / f"{name}.depth.npy"), _mean_depth(result.depth, result.alpha))
                files.append(target / f"{name}.depth.npy")
    return Rendered(tuple(files), ignored)


def render_film(
    model: SplatModel,
    cameras: Sequence[Camera],
    path: str,
    *,
    fps: float,
    background: Colour | None = None,
    mode: Mode = "standard",
    backend: Backend = "cpu",
    force: bool = False,
    context: Context = DEFAULT_CONTEXT,
) -> Rendered:
    """Render a scene into one animated file.

    Args:
        model: the scene.
        cameras: the views, at least one, of one size.
        path: path of the file; its ending determines the format, see `write_film`.
        fps: frames per second.
        background, mode, backend, context: see `render_folder`.
        force: an existing file may be replaced.

    Raises:
        InputError: the file exists, or its format cannot hold these frames; or the renderer is not installed.
        OSError: the file cannot be written.
    """
    require_renderer()
    check_output(path, force=force)
    check_film(path, [(camera.W, camera.H) for camera in cameras], fps)
    frames, ignored = [], 0
    for result in _render_each(model, cameras, background, mode, backend, context):
        ignored = max(ignored, result.ignored)
        frames.append(to_uint8(result.rgb))
    write_film(path, frames, fps)
    return Rendered((Path(path),), ignored)


def on_backend(model: SplatModel, backend: Backend) -> SplatModel | Renderable:
    """Return a scene to render, in the memory of the GPU if the backend is a GPU.

    Raises:
        InputError: there is no GPU, or it has too little memory.
    """
    if backend == "cpu":
        return model
    from csplat_render.gpu.device import find_device
    from csplat_render.gpu.renderer import GpuScene

    device, _ = find_device(backend)
    return model if device is None else GpuScene(device, [model])


def _render_each(
    model: SplatModel,
    cameras: Sequence[Camera],
    background: Colour | None,
    mode: Mode,
    backend: Backend,
    context: Context,
) -> Iterator[Render]:
    """Yield the render of each camera, with arguments as for `render_folder`, and report progress."""
    record = model.metadata.training
    colour = background or (record.background if record else BLACK)
    draw = renderer(on_backend(model, backend), colour, mode=mode, context=context)
    for number, camera in enumerate(cameras):
        context.progress("rendering", number / len(cameras))
        yield draw(camera)
    context.progress("rendering", 1.0)


def _mean_depth(depth: F32, alpha: F32) -> F32:
    """Return the mean depth, [H, W]. The renderer's depth is a weighted sum, and alpha is the sum of the weights."""
    mean = np.divide(depth, alpha, out=np.zeros_like(depth), where=alpha > 0.0)
    return mean.astype(np.float32)

"""Pictures of a scene in a folder, or as a film: what `csplat render` does, apart from the command line."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from csplat.errors import InputError
from csplat.model import SplatModel
from csplat.training import TrainedOn
from csplat_render import Camera, Mode, render
from csplat_render.arrays import RenderResult
from csplat_render.cameras import load_cameras, resized
from csplat_render.paths import orbit_cameras
from csplat_tools.files.console import Progress
from csplat_tools.files.extras import need_pictures, need_renderer
from csplat_tools.files.pictures import check_folder, picture_names, to_bytes, write_png
from csplat_tools.files.streams import check_output, write_array
from csplat_tools.present.film import check_film, write_film
from csplat_tools.views import BLACK, Colour, DataOptions, Split, find_view_set

__all__ = ["Rendered", "find_cameras", "render_film", "render_folder"]

F32 = NDArray[np.float32]

_DEFAULT_SIZE = (640, 480)


@dataclass(frozen=True)
class Rendered:
    """Pictures that were written.

    Attributes:
        files: in the order of the cameras.
        ignored_count: splats that no picture shows because they hold NaN or infinities.
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
    """Get the cameras that a command line names: a file's, a data set's, or those of an orbit.

    Args:
        model: the scene to orbit around; a data set's cameras are brought to its origin.
        path: of a camera file.
        orbit_count: how many cameras on a closed path; it leads along those of a file or a data set where one is named.
        data: a data set, whose size counts, not `size`, unless there is an orbit.
        size: width and height of the pictures; the file's own, or 640 by 480, if left out.
        split: of a data set: which of its cameras.
        report: takes lines on how the camera file of another program was understood.

    Raises:
        InputError: none of the three is given, or both a file and a set; the file or the set is none; a picture of that
            size would be distorted.
    """
    if (path, orbit_count, data) == (None, None, None) or None not in (path, data):
        raise InputError("wanted the cameras: a file of them, a data set, or a number for an orbit")
    cameras: list[Camera] = []
    if path is not None:
        cameras = load_cameras(path, report, model.origin)
    elif data is not None:
        shots = (
            data if orbit_count is None else replace(data, size=None)
        )  # where they were taken matters, not how large
        found = find_view_set(model, data=shots, count=0, split=split)
        cameras = [*found.judges, *(() if orbit_count is None else (*found.teaches, *found.decides))]
        if not cameras:
            raise InputError(f"{data.path} has no {split} pictures")
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
    depth: bool = False,
    alpha: bool = False,
    force: bool = False,
    prepare: Callable[[], object] | None = None,
    progress: Progress | None = None,
) -> Rendered:
    """Render a scene and write NAME.png for each camera.

    Args:
        model: the scene.
        cameras: where to stand. The pictures take the names of their photographs, or numbers.
        folder: where the files go; it is made if need be.
        background: red, green, blue, 0..1; `None`: what the scene says it was trained in front of, else black.
        mode: `exact`, `standard` or `fast`.
        depth: write NAME.depth.npy too, [H, W] float32: how far along the camera's axis what is seen there lies on
            average, scene units; 0 where nothing is.
        alpha: write NAME.alpha.png too, 255 where nothing of the background shows.
        force: existing files may be replaced.
        prepare: is called when the folder is found to be fit, before the first picture.
        progress: is told how much is done.

    Raises:
        InputError: a file exists; or the renderer is not installed.
        OSError: a file cannot be written.
    """
    need_renderer()
    need_pictures()
    names = picture_names([camera.image for camera in cameras])
    endings = [".png", *([".depth.npy"] if depth else []), *([".alpha.png"] if alpha else [])]
    is_new = not Path(folder).exists()
    target = check_folder(folder, [name + ending for name in names for ending in endings], force=force)
    files, ignored = [], 0
    with _removed_if_empty(target if is_new else None):
        pictures = _pictures(model, cameras, background, mode, prepare, progress)
        for name, result in zip(names, pictures, strict=True):
            ignored = max(ignored, result.ignored)
            files.append(target / f"{name}.png")
            write_png(files[-1], to_bytes(result.rgb))
            if alpha:
                files.append(target / f"{name}.alpha.png")
                write_png(files[-1], to_bytes(result.alpha))
            if depth:
                files.append(target / f"{name}.depth.npy")
                write_array(str(files[-1]), _mean_depth(result.depth, result.alpha))
    return Rendered(tuple(files), ignored)


def render_film(
    model: SplatModel,
    cameras: Sequence[Camera],
    path: str,
    *,
    fps: float,
    background: Colour | None = None,
    mode: Mode = "standard",
    force: bool = False,
    prepare: Callable[[], object] | None = None,
    progress: Progress | None = None,
) -> Rendered:
    """Render a scene into one animated file.

    Args:
        model: the scene.
        cameras: where to stand, at least one, with pictures of one size.
        path: of the file; its ending tells the format, see `film`.
        fps: pictures per second.
        background, mode, prepare, progress: see `render_folder`.
        force: an existing file may be replaced.

    Raises:
        InputError: the file exists, or cannot hold these pictures; or the renderer is not installed.
        OSError: it cannot be written.
    """
    need_renderer()
    check_output(path, force=force)
    check_film(path, [(camera.W, camera.H) for camera in cameras], fps)
    frames, ignored = [], 0
    for result in _pictures(model, cameras, background, mode, prepare, progress):
        ignored = max(ignored, result.ignored)
        frames.append(to_bytes(result.rgb))
    write_film(path, frames, fps)
    return Rendered((Path(path),), ignored)


def _pictures(
    model: SplatModel,
    cameras: Sequence[Camera],
    background: Colour | None,
    mode: Mode,
    prepare: Callable[[], object] | None,
    progress: Progress | None,
) -> Iterator[RenderResult]:
    """Render camera after camera; see `render_folder`."""
    if prepare is not None:
        prepare()
    said = TrainedOn.of(model.metadata)
    behind = background or (said.background if said else BLACK)
    for number, camera in enumerate(cameras):
        if progress is not None:
            progress("rendering", number / len(cameras))
        yield render(model, camera, background=behind, mode=mode)
    if progress is not None:
        progress("rendering", 1.0)


@contextmanager
def _removed_if_empty(folder: Path | None) -> Iterator[None]:
    """Leave no empty folder behind where the first picture is refused."""
    try:
        yield
    except BaseException:
        if folder is not None:
            with suppress(OSError):  # it holds something
                folder.rmdir()
        raise


def _mean_depth(depth: F32, alpha: F32) -> F32:
    """The renderer sums weight times depth, and alpha is the sum of the weights."""
    mean = np.divide(depth, alpha, out=np.zeros_like(depth), where=alpha > 0.0)
    return mean.astype(np.float32)

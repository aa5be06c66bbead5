"""Two files compared in everything: what `csplat compare` does, apart from the command line."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from csplat.errors import InputError
from csplat_render.cameras import load_cameras
from csplat_render.lpips import load_lpips
from csplat_tools.attributes import AttributeErrors, attribute_errors
from csplat_tools.compare import BLACK, Colour, Comparison, Distance, OnView, compare_models, comparison_cameras
from csplat_tools.extras import need_pictures, need_renderer
from csplat_tools.inout import read_array
from csplat_tools.models import LoadedModel, load_model
from csplat_tools.pictures import check_folder, panels, picture_names, write_png

__all__ = ["USUAL_WEIGHTS", "FileComparison", "compare_files"]

#: Instead of a file of LPIPS weights: look for them where they usually are.
USUAL_WEIGHTS = "auto"


@dataclass(frozen=True, eq=False)
class FileComparison:
    """What was found out about two files.

    Attributes:
        a: the source.
        b: what became of it.
        attributes: errors of its splats; `None` where it cannot be found out which splat is which.
        quality: what pictures say.
        cameras: where they were taken from: the name of a camera file, or `virtual`.
        background, mode: of the pictures.
        seconds: reading, matching, rendering and writing.
    """

    a: LoadedModel
    b: LoadedModel
    attributes: AttributeErrors | None
    quality: Comparison
    cameras: str
    background: Colour
    mode: str
    seconds: float

    @property
    def ratio(self) -> float:
        """How many times B is smaller than A."""
        return self.a.size_bytes / self.b.size_bytes

    def as_json(self) -> dict[str, Any]:
        """Return everything as JSON-compatible values."""
        return {
            "a": self.a.as_json(),
            "b": self.b.as_json(),
            "ratio": self.ratio,
            "attributes": None if self.attributes is None else self.attributes.as_json(),
            "cameras": self.cameras,
            "background": list(self.background),
            "mode": self.mode,
            **self.quality.as_json(),
            "seconds": round(self.seconds, 3),
        }


def compare_files(
    a: str,
    b: str,
    *,
    cameras: str | None = None,
    source_index: str | None = None,
    lpips: str | None = None,
    pictures: str | None = None,
    amplification: float = 10.0,
    background: Colour = BLACK,
    mode: str = "standard",
    force: bool = False,
    progress: Callable[[str, float], None] | None = None,
) -> FileComparison:
    """Compare a file with its source.

    Args:
        a: the source, PLY or .csplat.
        b: what became of it, PLY or .csplat.
        cameras: a camera file; the virtual cameras of A if left out.
        source_index: a .npy file, which splat of A each splat of B is.
        lpips: a file of LPIPS weights, or `auto` for the usual places; it is not computed if left out.
        pictures: a folder for one PNG per view: A, B, and their amplified difference.
        amplification: of the difference.
        background: red, green, blue, 0..1.
        mode: of the renderer.
        force: existing pictures may be replaced.
        progress: is told the stages.

    Raises:
        CsplatError: a file is not valid, or exists; or the renderer is not installed.
        OSError: a file cannot be read or written.
    """
    start = time.perf_counter()
    need_renderer()
    if pictures is not None:
        need_pictures()
    if a == b == "-":
        raise InputError("A and B cannot both be standard input")
    distance = None if lpips is None else _distance(lpips)
    rows = None if source_index is None else read_array(source_index)
    source, other = load_model(a), load_model(b)
    views = comparison_cameras(source.model) if cameras is None else load_cameras(cameras)
    names = picture_names([camera.image for camera in views])
    on_view = None if pictures is None else _writer(pictures, names, amplification, force=force)
    errors = attribute_errors(source, other, rows, progress=progress)
    quality = compare_models(
        source.model,
        other.model,
        views,
        background=background,
        mode=mode,
        lpips=distance,
        on_view=on_view,
        progress=progress,
    )
    named = "virtual" if cameras is None else Path(cameras).name
    return FileComparison(source, other, errors, quality, named, background, mode, time.perf_counter() - start)


def _distance(weights: str) -> Distance:
    return load_lpips(None if weights == USUAL_WEIGHTS else weights)


def _writer(folder: str, names: list[str], amplification: float, *, force: bool) -> OnView:
    files = [f"{name}.png" for name in names]
    target = check_folder(folder, files, force=force)

    def write(number: int, a: Any, b: Any) -> None:
        write_png(target / files[number], panels(a, b, amplification))

    return write

"""Two files compared in everything: what `csplat compare` does, apart from the command line."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from csplat.errors import InputError
from csplat.model import SplatModel
from csplat_render import Camera
from csplat_render.cameras import load_cameras
from csplat_render.lpips import load_lpips
from csplat_tools.attributes import AttributeErrors, attribute_errors
from csplat_tools.compare import BLACK, WHITE, Colour, Comparison, Distance, OnView, compare_models, comparison_cameras
from csplat_tools.extras import need_pictures, need_renderer
from csplat_tools.inout import read_array
from csplat_tools.models import LoadedModel, load_model
from csplat_tools.photographs import DataViews, PhotographScores, relative_to, show_photograph
from csplat_tools.pictures import check_folder, panels, picture_names, write_png

if TYPE_CHECKING:
    from csplat_trainer.pictures import Picture

__all__ = ["USUAL_WEIGHTS", "FileComparison", "compare_files"]

F32 = NDArray[np.float32]

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
        cameras: where they were taken from: the name of a camera file or of a data set, or `virtual`.
        photographs: what A's and B's pictures score against the photographs of a data set, as `PhotographScores` says,
            by the keys `split`, `a` and `b`; `None` where there is no data set.
        background, mode: of the pictures.
        seconds: reading, matching, rendering and writing.
    """

    a: LoadedModel
    b: LoadedModel
    attributes: AttributeErrors | None
    quality: Comparison
    cameras: str
    photographs: dict[str, Any] | None
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
            "photographs": self.photographs,
            **self.quality.as_json(),
            "seconds": round(self.seconds, 3),
        }


def compare_files(
    a: str,
    b: str,
    *,
    cameras: str | None = None,
    data: DataViews | None = None,
    source_index: str | None = None,
    lpips: str | None = None,
    pictures: str | None = None,
    amplification: float = 10.0,
    background: Colour | None = None,
    mode: str = "standard",
    force: bool = False,
    prepare: Callable[[], object] | None = None,
    progress: Callable[[str, float], None] | None = None,
) -> FileComparison:
    """Compare a file with its source.

    Args:
        a: the source, PLY or .csplat.
        b: what became of it, PLY or .csplat.
        cameras: a camera file; the virtual cameras of A if left out.
        data: instead: views of a data set, whose photographs judge A and B, too.
        source_index: a .npy file, which splat of A each splat of B is.
        lpips: a file of LPIPS weights, or `auto` for the usual places; it is not computed if left out.
        pictures: a folder for one PNG per view: the photograph if there is one, A, B, and their amplified difference.
        amplification: of the difference.
        background: red, green, blue, 0..1; if left out black, or white with a data set whose pictures have alpha.
        mode: of the renderer.
        force: existing pictures may be replaced.
        prepare: is called when all that is named has been read and checked, before the first picture.
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
    if cameras is not None and data is not None:
        raise InputError("wanted cameras of a file or of a data set, not both")
    distance = None if lpips is None else load_lpips(None if lpips == USUAL_WEIGHTS else lpips)
    rows = None if source_index is None else read_array(source_index)
    given = None if cameras is None else load_cameras(cameras)
    photographs = None if data is None else data.read()
    source, other = load_model(a), load_model(b)
    colour = _background(photographs) if background is None else background
    views = _views(source.model, given, photographs)
    judges = None if photographs is None else _Judges(photographs, colour, distance)
    named = "virtual" if cameras is None else Path(cameras).name
    sheets = None
    if pictures is not None:
        sheets = _Sheets(pictures, views, photographs, colour, amplification, force=force)
    errors = attribute_errors(source, other, rows, progress=progress)
    if prepare is not None:
        prepare()
    quality = compare_models(
        source.model,
        other.model,
        views,
        background=colour,
        mode=mode,
        lpips=distance,
        on_view=_all_of([one for one in (judges, sheets) if one is not None]),
        progress=progress,
    )
    judged = None
    if data is not None and judges is not None:
        named, judged = Path(data.path).resolve().name, {"split": data.split, **judges.as_json()}
    seconds = time.perf_counter() - start
    return FileComparison(source, other, errors, quality, named, judged, colour, mode, seconds)


def _background(photographs: Sequence[Picture] | None) -> Colour:
    """White where pictures have an alpha channel: so are the published tables of such sets."""
    return WHITE if photographs is not None and any(one.has_alpha for one in photographs) else BLACK


def _views(source: SplatModel, given: list[Camera] | None, photographs: Sequence[Picture] | None) -> list[Camera]:
    if photographs is not None:
        return [relative_to(source.origin, one.camera) for one in photographs]
    return comparison_cameras(source) if given is None else given


class _Judges:
    """Scores A's and B's pictures against the photographs."""

    def __init__(self, photographs: Sequence[Picture], background: Colour, distance: Distance | None) -> None:
        self._both = [PhotographScores(photographs, background, distance) for _ in range(2)]

    def __call__(self, number: int, a: F32, b: F32) -> None:
        for judge, rendered in zip(self._both, (a, b), strict=True):
            judge.add(number, rendered)

    def as_json(self) -> dict[str, Any]:
        return {name: judge.as_json() for name, judge in zip("ab", self._both, strict=True)}


class _Sheets:
    """Writes one PNG per view, named as its photograph."""

    def __init__(
        self,
        folder: str,
        views: Sequence[Camera],
        photographs: Sequence[Picture] | None,
        background: Colour,
        amplification: float,
        *,
        force: bool,
    ) -> None:
        self._files = [f"{name}.png" for name in picture_names([camera.image for camera in views])]
        self._target = check_folder(folder, self._files, force=force)
        self._photographs, self._background, self._amplification = photographs, background, amplification

    def __call__(self, number: int, a: F32, b: F32) -> None:
        shown = None if self._photographs is None else show_photograph(self._photographs[number], self._background)
        write_png(self._target / self._files[number], panels(a, b, self._amplification, shown))


def _all_of(viewers: Sequence[OnView]) -> OnView | None:
    if not viewers:
        return None

    def show(number: int, a: F32, b: F32) -> None:
        for viewer in viewers:
            viewer(number, a, b)

    return show

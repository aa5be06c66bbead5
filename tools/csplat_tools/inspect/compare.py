"""Compare two scenes in size, errors of the splats and renders: `csplat compare` without the command line."""

from __future__ import annotations

import os
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from csplat.errors import InputError
from csplat.files import check_room
from csplat.model import SplatModel
from csplat.types import F32, Progress
from csplat_render import Mode
from csplat_render.camera import Camera
from csplat_render.lpips import load_lpips
from csplat_render.metrics import Distance, Scores, ViewScore
from csplat_render.scorer import OnView, Scorer
from csplat_tools.files.extras import need_pictures, need_renderer
from csplat_tools.files.pictures import check_folder, panels, picture_names, write_png
from csplat_tools.files.scenes import LoadedModel, OpenedScene, SceneLike, opened_scenes
from csplat_tools.inspect.attributes import AttributeErrors, attribute_errors, attribute_errors_by_disk
from csplat_tools.views import Colour, ViewSet, find_view_set
from csplat_tools.views.sliced import Sliced

#: Given instead of a file of LPIPS weights: look for them in the usual places.
USUAL_WEIGHTS = "auto"

_PIXEL_BYTES = 13  # bytes per pixel of a render of the source, which is kept


@dataclass(frozen=True, eq=False, repr=False)
class Comparison:
    """The outcome of comparing two scenes.

    Attributes:
        a: the source; opened, but not in memory, if both do not fit together.
        b: the scene compared with it; likewise.
        attributes: errors of B's splats; `None` if the pairs of splats cannot be found, which is the usual case
            without a source index if the scenes are not in memory.
        quality: scores of B's renders against A's.
        ignored: number of splats of A that were not drawn because they hold NaN or infinities.
        cameras: source of the views: the name of a camera file or of a data set, or `virtual`.
        photographs: scores of A's and B's renders against the photographs of a data set, as JSON of `Scores`, by the
            keys `split`, `a` and `b`; `None` if there is no data set.
        background, mode: background colour and renderer mode.
        notes: remarks about the views.
        seconds: time of reading scenes that were not in memory, matching, rendering and writing.
    """

    a: LoadedModel | OpenedScene
    b: LoadedModel | OpenedScene
    attributes: AttributeErrors | None
    quality: Scores
    ignored: int
    cameras: str
    photographs: dict[str, Any] | None
    background: Colour
    mode: Mode
    notes: tuple[str, ...]
    seconds: float

    def __repr__(self) -> str:
        return f"Comparison({self.a.size_bytes:,} -> {self.b.size_bytes:,} bytes, {self.quality.psnr:.2f} dB)"

    @property
    def ratio(self) -> float:
        """Size of A divided by that of B."""
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
            "ignored": {"a": self.ignored, "b": self.quality.ignored},
            "views": [
                {name: getattr(one, name) for name in ("image", "psnr", "ssim", "lpips", "cover")}
                for one in self.quality.each
            ],
            "seconds": round(self.seconds, 3),
        }


def compare(
    a: SceneLike | OpenedScene,
    b: SceneLike | OpenedScene,
    *,
    views: ViewSet | None = None,
    source_index: NDArray[np.integer[Any]] | None = None,
    lpips: str | None = None,
    pictures: str | os.PathLike[str] | None = None,
    amplification: float = 10.0,
    background: Colour | None = None,
    mode: Mode = "standard",
    force: bool = False,
    memory_bytes: int | None = None,
    prepare: Callable[[], object] | None = None,
    progress: Callable[[str, float], None] | None = None,
) -> Comparison:
    """Compare a scene with its source, as `csplat compare` does. Requires the packages of the render extra.

    Args:
        a: the source: a model, or a file in any format.
        b: the scene compared with it, likewise.
        views: its test views are rendered; if they have photographs, A and B are scored against these, too. `None`:
            the eight virtual views of `psnr`, 640×480, in front of black (`find_view_set`).
        source_index: [N] the splat of A that each splat of B is.
        lpips: a file of LPIPS weights, or `auto` for the usual places; LPIPS is not computed if left out.
        pictures: a folder for one PNG per view: the photograph if there is one, A, B, and their amplified difference.
        amplification: factor by which the difference is amplified.
        background: red, green, blue, 0..1; that of the views if left out.
        mode: mode of the renderer.
        force: existing files of `pictures` may be replaced.
        memory_bytes: approximate memory that may be taken; the disk is used if that is too little for both files.
            `None`: half of the free memory. Photographs are not included.
        prepare: called when all inputs have been read and checked, before the first render.
        progress: called with the stage and the fraction of it that is done, 0 to 1.

    Examples:
        >>> import csplat_tools
        >>> found = csplat_tools.compare("scene.ply", "scene.csplat")  # doctest: +SKIP
        >>> found.ratio, found.quality.psnr, found.attributes.errors["means"]  # doctest: +SKIP
        (12.3, 41.2, (0.00021, 0.00009))

    Raises:
        CsplatError: a file is not valid, or exists; or there are no test views; or the renderer is not installed; or
            the disk has no room for the splats of a scene that does not fit in memory, or the bound is too low even so.
        OSError: a file cannot be read or written.
    """
    start = time.perf_counter()
    need_renderer()
    if pictures is not None:
        need_pictures()
    distance = None if lpips is None else load_lpips(None if lpips == USUAL_WEIGHTS else lpips)
    with opened_scenes((a, b), memory_bytes) as (source, other):
        views = views or _views(source, background, progress)
        if not views.judges:
            raise InputError(f"{views.name} has no {views.split} pictures")
        by_photographs = views.photograph_judge(mode=mode) if views.photographs else None
        viewers: list[OnView] = []
        if pictures is not None:
            names = picture_names([camera.image for camera in views.judges])
            viewers.append(_Sheets(os.fspath(pictures), names, by_photographs, amplification, force=force))
        first, second, errors = _measured(source, other, views.judges, source_index, progress)
        if prepare is not None:
            prepare()
        judges = None if by_photographs is None else _Both(by_photographs, distance)
        viewers += [] if judges is None else [judges]
        judge = views.judge(first, mode=mode, background=background, progress=progress)
        quality = judge.scores(second, lpips=distance, on_view=_all_of(viewers), progress=progress)
        return Comparison(
            source, other, errors, quality, judge.look(0).ignored, views.name,
            None if judges is None else {"split": views.split, **judges.as_json()},
            views.background, mode, views.notes, time.perf_counter() - start,
        )  # fmt: skip


def _views(source: LoadedModel | OpenedScene, background: Colour | None, progress: Progress | None) -> ViewSet:
    model, every = source.sample(progress)
    return find_view_set(model, background=background, count=0, every=every)


def _measured(
    source: LoadedModel | OpenedScene,
    other: LoadedModel | OpenedScene,
    cameras: Sequence[Camera],
    source_index: NDArray[np.integer[Any]] | None,
    progress: Progress | None,
) -> tuple[SplatModel | Sliced, SplatModel | Sliced, AttributeErrors | None]:
    """Return a renderable form of each scene, and the errors of B's splats."""
    if isinstance(source, LoadedModel) and isinstance(other, LoadedModel):
        return source.model, other.model, attribute_errors(source, other, source_index, progress=progress)
    assert isinstance(source, OpenedScene), "both are in memory, or none"
    assert isinstance(other, OpenedScene), "likewise"
    kept = sum(_PIXEL_BYTES * camera.W * camera.H for camera in cameras)
    first, second = (
        Sliced(one.scene, *one.sample(progress), one.memory_bytes - kept, progress) for one in (source, other)
    )
    for one in (first, second):
        if one.memory_bytes < one.least_bytes:
            bound, least = (one.memory_bytes + kept) / 1e6, (one.least_bytes + kept) / 1e6
            raise InputError(f"{bound:,.0f} MB of memory are too little to draw these scenes, which want {least:,.0f}")
    check_room(
        tempfile.gettempdir(),
        max(first.disk_bytes, second.disk_bytes),
        "pictures are drawn: TMPDIR names another folder",
    )
    return first, second, attribute_errors_by_disk(source, other, source_index, progress=progress)


class _Both:
    """Scorer of A's and B's renders against the photographs."""

    def __init__(self, judge: Scorer, distance: Distance | None) -> None:
        self._judge, self._distance = judge, distance
        self._each: dict[str, list[ViewScore]] = {"a": [], "b": []}

    def __call__(self, number: int, a: F32, b: F32) -> None:
        for each, seen in zip(self._each.values(), (a, b), strict=True):
            each.append(self._judge.score(number, seen, lpips=self._distance))

    def as_json(self) -> dict[str, Any]:
        return {name: Scores.of(each).as_json() for name, each in self._each.items()}


class _Sheets:
    """Writer of one PNG per view, named after its photograph."""

    def __init__(
        self, folder: str, names: Sequence[str], photographs: Scorer | None, amplification: float, *, force: bool
    ) -> None:
        self._files = [f"{name}.png" for name in names]
        self._target = check_folder(folder, self._files, force=force)
        self._photographs, self._amplification = photographs, amplification

    def __call__(self, number: int, a: F32, b: F32) -> None:
        shown = None if self._photographs is None else self._photographs.look(number).picture
        write_png(self._target / self._files[number], panels(a, b, self._amplification, shown))


def _all_of(viewers: Sequence[OnView]) -> OnView:
    def show(number: int, a: F32, b: F32) -> None:
        for viewer in viewers:
            viewer(number, a, b)

    return show

"""What a tuned file is to look like, and which splats it is to hold: the inputs of `csplat finetune`."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from csplat.encoder import Importance
from csplat.errors import InputError
from csplat.model import SplatModel
from csplat_tools.console import note
from csplat_tools.finetune_report import Judged, judge_by_photographs, judge_by_source
from csplat_tools.importances import measure_views, read_importance
from csplat_tools.photographs import relative_to
from csplat_trainer.sensitivity_file import StoredSensitivity

if TYPE_CHECKING:
    from csplat_render import Camera
    from csplat_trainer.data import DataSet
    from csplat_trainer.finetune import Views
    from csplat_trainer.sensitivity import Sensitivity

__all__ = ["Chosen", "Looks", "Sources", "choose_splats"]

I64 = NDArray[np.int64]
Colour = tuple[float, float, float]
Progress = Callable[[str, float], None]

_RENDERS_ASIDE = 8  # one of so many renders judges and does not teach,
_MOST_ASIDE = 16  # but no more than these
_DECIDING = 160  # virtual views at most that say how much splats matter


@dataclass(frozen=True)
class Sources:
    """What the file is to look like.

    Attributes:
        data: a data set: its training pictures teach, its test pictures judge; `None`: renders of the scene itself.
        size, images, test_every, near: how the data set is read, see `csplat_trainer.data.load`.
        cameras: a camera file, for renders of the scene; `None`: virtual cameras, `views` of them.
        views: how many virtual cameras.
        view_size: of their pictures.
        background: behind everything; `None`: white with pictures that have an alpha channel, else black.
        aside: views that judge while values move, and do not teach; 0: some that teach, or one in eight renders, but
            no more than 16.
        keep: share of the splats that stay, the others being those that pictures need least; `None`: all.
        prune_unseen: leave out splats that none of the views shows; `None`: if they are those of the data set.
    """

    data: str | None = None
    size: tuple[int, int] | None = None
    images: str | None = None
    test_every: int = 8
    near: float | None = None
    cameras: str | None = None
    views: int = 480
    view_size: tuple[int, int] = (320, 240)
    background: Colour | None = None
    aside: int = 0
    keep: float | None = None
    prune_unseen: bool | None = None


@dataclass(frozen=True, eq=False)
class Looks:
    """What teaches and what judges.

    Attributes:
        data: the data set, if there is one, its cameras relative to the scene's origin.
        cameras: those of its training pictures, or of the renders.
        background: behind everything.
        deciding: those of them that say how much splats matter.
    """

    data: DataSet | None
    cameras: Sequence[Camera]
    background: Colour
    deciding: Sequence[Camera]

    @classmethod
    def read(cls, source: SplatModel, sources: Sources, *, quiet: bool) -> Looks:
        """Read the data set or the cameras, or place virtual ones.

        Raises:
            InputError: there is none, or it is damaged.
        """
        from csplat_render.cameras import load_cameras
        from csplat_tools.simplify.views import camera_sequence
        from csplat_trainer.data import load

        if sources.data is None:
            colour = sources.background or (0.0, 0.0, 0.0)
            if sources.cameras is not None:
                cameras = load_cameras(sources.cameras)
                return cls(None, cameras, colour, cameras)
            cameras = camera_sequence(source, sources.views, sources.view_size)
            return cls(None, cameras, colour, cameras[:_DECIDING])
        data = load(sources.data, sources.size, images=sources.images, test_every=sources.test_every, near=sources.near)
        if not quiet:
            for line in data.report:
                note(line)
        data.read()  # a damaged picture is found before anything is measured
        train, test = (
            [replace(one, camera=relative_to(source.origin, one.camera)) for one in part]
            for part in (data.train, data.test)
        )
        white = any(one.has_alpha for one in (*train, *test))
        colour = sources.background or ((1.0, 1.0, 1.0) if white else (0.0, 0.0, 0.0))
        cameras = [one.camera for one in train]
        return cls(replace(data, train=train, test=test), cameras, colour, cameras)

    def views(self, source: SplatModel, sources: Sources, threads: int | None) -> Views:
        """Views to learn from and to judge by; none of those that the report is about."""
        from csplat_trainer.finetune import View, renders_of, split_views

        behind = np.array(self.background, np.float32)
        if self.data is not None:
            return split_views([View(one.camera, one) for one in self.data.train], behind, sources.aside)
        renders = renders_of(source, self.cameras, behind, threads)
        return split_views(renders, behind, sources.aside or min(_MOST_ASIDE, len(renders) // _RENDERS_ASIDE))

    def judge(
        self, source: SplatModel, models: dict[str, SplatModel], distance: Any, threads: int | None
    ) -> Judged | None:
        """Score models on views that nothing was learnt from."""
        if self.data is None:
            return judge_by_source(source, models, self.background, distance, threads)
        if not self.data.test:
            return None
        return judge_by_photographs(self.data.test, models, self.background, distance, threads)


@dataclass(frozen=True, eq=False)
class Chosen:
    """The splats that the file will hold.

    Attributes:
        model: the splats; their colours are fitted anew where others were taken away.
        rows: [N] int64, which splats of the source they are, ascending.
        importance: how much pictures depend on each.
        said: what was done, JSON-compatible.
    """

    model: SplatModel
    rows: I64
    importance: NDArray[Any] | Importance
    said: Mapping[str, Any] = field(default_factory=dict)


def choose_splats(
    source: SplatModel,
    looks: Looks,
    sources: Sources,
    importance: str | None,
    threads: int | None,
    progress: Progress | None = None,
) -> Chosen:
    """Leave out what no view shows and what pictures need least, and weigh the others.

    Args:
        source: the scene.
        looks: the views.
        sources: what is to be left out.
        importance: a file of weights of the source's splats; `None`: what stays is measured in these views, as
            `csplat sensitivity` does.
        threads: how many; `None` for all.
        progress: is told the stages.

    Raises:
        InputError: no view shows anything; or the file is none, or about another scene.
    """
    from csplat_render.removal import measure_removal

    def weighed(model: SplatModel) -> Sensitivity:
        return measure_views(model, looks.deciding, looks.background, matrices=True, threads=threads, progress=progress)

    given = _read(importance, source)
    prune = looks.data is not None if sources.prune_unseen is None else sources.prune_unseen
    found = weighed(source) if given is None and sources.keep is None else None
    if found is not None and not (prune and len(looks.deciding) < len(looks.cameras)):
        seen = found.seen
    else:
        seen = measure_removal(
            source, looks.cameras, background=looks.background, threads=threads, progress=progress
        ).seen
    if not seen.any():
        raise InputError("no view shows any splat: scene and cameras do not belong together")
    rows = np.flatnonzero(seen) if prune else np.arange(len(source))
    model, said = source.select(rows), {"unseen": len(source) - len(rows)}
    if sources.keep is not None:
        model, kept = _simplified(model, looks, sources.keep * len(source) / len(rows), threads, progress)
        rows, said = rows[kept], {**said, "simplified_from": len(rows)}
    if given is not None:
        return Chosen(model, rows, given.select(rows) if isinstance(given, Importance) else given[rows], said)
    if found is not None:
        return Chosen(model, rows, StoredSensitivity.of(source, found).importance().select(rows), said)
    return Chosen(model, rows, StoredSensitivity.of(model, weighed(model)).importance(), said)


def _read(importance: str | None, source: SplatModel) -> NDArray[Any] | Importance | None:
    """What a file says of the source's splats."""
    if importance is None:
        return None
    given = read_importance(importance, source)
    if isinstance(given, StoredSensitivity):
        return given.importance()
    if isinstance(given, np.ndarray) and given.shape != (len(source),):
        raise InputError(f"{importance} has shape {given.shape}, wanted ({len(source)},)")
    return given


def _simplified(
    model: SplatModel, looks: Looks, keep: float, threads: int | None, progress: Progress | None
) -> tuple[SplatModel, I64]:
    """A share of the splats, their colours fitted, and which they are."""
    from csplat_tools.simplify import SimplifyOptions, Target, simplify

    if keep >= 1.0:
        return model, np.arange(len(model))
    options = SimplifyOptions(background=looks.background, threads=threads)
    result = simplify(model, looks.deciding, target=Target(keep=keep), options=options, progress=progress)
    return result.model, result.source_index

"""How much pictures depend on each splat: measured for `csplat sensitivity`, for tuning, and for grades."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from csplat.encoder import EncodeOptions, Importance, most_grades, trusted
from csplat.errors import InputError
from csplat.model import SplatModel
from csplat_render import Camera
from csplat_render.removal import measure_removal
from csplat_tools.files.console import Progress
from csplat_tools.files.streams import open_output
from csplat_tools.views import Colour, ViewSet, evenly
from csplat_tools.views.agreeing import find_views
from csplat_trainer.sensitivity import Sensitivity, measure_sensitivity
from csplat_trainer.sensitivity_file import GROUPS, StoredSensitivity, write_sensitivity

__all__ = [
    "MeasuredSensitivity",
    "measure_scene",
    "measure_views",
    "measured_for",
    "measured_importance",
    "measuring_views",
]

Weights = NDArray[Any] | Importance

_NOTHING = "a scene without splats has no sensitivities"
_GONE = 0.4  # share of the splats for whose removal virtual views have to agree before there are enough
_GIVEN = 40  # cameras that are enough, of those given
_VIRTUAL = {False: (120, 120), True: (80, 60)}  # small virtual ones, without and with SH; for small scenes and large
_LARGE = 40_000  # splats: of fewer, half of the views would change the size of files by a per cent


@dataclass(frozen=True, eq=False)
class MeasuredSensitivity:
    """What was found.

    Attributes:
        model: the scene. found: by splat.
        source: where the views came from, see `sensitivity_file.SOURCES`.
        missed_share: share of the splats that only views that were kept aside saw; NaN where none were.
    """

    model: SplatModel
    found: Sensitivity
    source: str
    missed_share: float

    def write(self, path: str) -> None:
        """Write the file, all of it or nothing."""
        with open_output(path) as stream:
            write_sensitivity(stream, self.model, self.found, self.source, self.missed_share)

    def as_json(self) -> dict[str, Any]:
        """Counts, shares, and quantiles of every group, JSON-compatible."""
        at = (0.0, 0.5, 0.9, 0.99, 1.0)
        return {
            "splats": len(self.model),
            "views": self.found.view_count,
            "pixels": self.found.pixel_count,
            "source": self.source,
            "unseen": int(np.count_nonzero(~self.found.seen)),
            "unseen_share": self.found.unseen_share,
            "missed_share": None if np.isnan(self.missed_share) else self.missed_share,
            "quantiles": {
                name: {str(q): float(np.quantile(getattr(self.found, name), q)) for q in at} if len(self.model) else {}
                for name in GROUPS
            },
        }


def measure_scene(
    model: SplatModel,
    views: ViewSet,
    *,
    matrices: bool = True,
    threads: int | None = None,
    progress: Progress | None = None,
) -> MeasuredSensitivity:
    """Measure a scene from views that teach: of virtual ones as many as it takes, of others all.

    Args:
        model: the scene.
        views: from where it is looked at. Where none teaches, it is measured from those that judge.
        matrices, threads, progress: as for `measure_views`.

    Raises:
        InputError: there are no splats, or no views, or they show no splat.
    """
    if not len(model):
        raise InputError(_NOTHING)
    cameras, check, source = (
        views.teaches or views.judges,
        list[Camera](),
        "training" if views.photographs else "cameras",
    )
    if views.virtual and views.teaches:
        size = (views.teaches[0].W, views.teaches[0].H)
        found = find_views(model, views, _GONE, size=size, threads=threads, progress=progress)
        cameras, check, source = found.used, found.check, "virtual"
    measured = measure_views(model, cameras, views.background, matrices=matrices, threads=threads, progress=progress)
    missed = float("nan")
    if check:
        elsewhere = measure_removal(model, check, background=views.background, bands=False, threads=threads).seen
        missed = float(np.mean(elsewhere & ~measured.seen))
    return MeasuredSensitivity(model, measured, source, missed)


def measure_views(
    model: SplatModel,
    cameras: Sequence[Camera],
    background: Colour,
    *,
    matrices: bool,
    magnitudes: bool = True,
    threads: int | None,
    progress: Progress | None = None,
) -> Sensitivity:
    """Measure a scene from given views.

    Args:
        model: the scene. cameras: relative to its origin.
        background: behind everything.
        matrices: whether those of SH coefficients are measured too.
        magnitudes: whether sensitivities are wanted beside the squares that weights are made of.
        threads: how many; `None` for all.
        progress: is told the stages.

    Raises:
        InputError: there are no splats, or no view shows any.
    """
    if not len(model):
        raise InputError(_NOTHING)
    if progress is not None:
        progress("compiling", 0.0)  # the first time takes some seconds
        measure_sensitivity(model.select(np.zeros(1, np.intp)), cameras[:1], metric=matrices, magnitudes=magnitudes)
        progress("compiling", 1.0)
    found = measure_sensitivity(
        model, cameras, background=background, metric=matrices, magnitudes=magnitudes, threads=threads,
        progress=progress,
    )  # fmt: skip
    if not found.seen.any():
        raise InputError("no view shows any splat: scene and cameras do not belong together")
    return found


def measured_importance(
    model: SplatModel,
    cameras: Sequence[Camera],
    background: Colour,
    *,
    threads: int | None,
    progress: Progress | None = None,
) -> Importance:
    """What views say for the encoder: weights of SH, none far below what opacity and size suggest, and curvatures.

    Args:
        model, cameras, background, threads, progress: as for `measure_views`.

    Raises:
        InputError: as `measure_views`.
    """
    found = measure_views(
        model, cameras, background, matrices=False, magnitudes=False, threads=threads, progress=progress
    )
    weights = StoredSensitivity.of(model, found).importance()
    return replace(weights, sh=trusted(weights.sh, model))


def measuring_views(source: SplatModel, views: ViewSet) -> Sequence[Camera]:
    """Views that say how precise splats have to be, of those that teach.

    Virtual ones look from nearer and farther, from below and beside, too. Cameras like those that judge would say less
    of what others see: plane3 graded by 40 of them has 42 dB by them and 39 by others; by these, 41 and 40.
    """
    return evenly(views.teaches, _VIRTUAL[source.sh_degree > 0][len(source) >= _LARGE] if views.virtual else _GIVEN)


def measured_for(
    source: SplatModel,
    views: ViewSet,
    encoding: EncodeOptions,
    importance: Weights | None,
    *,
    inside: bool,
    progress: Progress | None = None,
) -> tuple[Importance | None, int]:
    """Take what the caller knows, or measure the rest.

    Args:
        source: the scene.
        views: those that teach measure.
        encoding: knobs that are set; some leave nothing to grade.
        importance: what the caller knows. Where it holds curvatures, nothing is measured; else it stays for SH.
        inside: virtual views of surroundings, which do not say it.
        progress: is told the stages.

    Returns:
        Weights and curvatures, `None` where nothing says them or they would change nothing; and in how many views they
        were measured here.
    """
    several = most_grades(len(source), encoding) > 1
    if isinstance(importance, Importance) and importance.curvatures is not None:
        return (importance if several else None), 0
    has_sh = source.sh_degree > 0 and encoding.sh_degree != 0 and encoding.sh_coding != "none"
    quick = encoding.preset == "fast" and encoding.grades is None
    if inside or quick or not (several or has_sh):
        return None, 0
    seen_from = measuring_views(source, views)
    try:
        found = measured_importance(source, seen_from, views.background, threads=encoding.threads, progress=progress)
    except InputError:
        return None, 0  # nothing shows
    if isinstance(importance, Importance):
        found = replace(importance, curvatures=found.curvatures)
    elif importance is not None:
        found = replace(found, sh=np.asarray(importance))
    if not encoding.shape_codebook_size:
        found = replace(found, shape_metric=None)  # half of what it takes in memory
    return found, len(seen_from)

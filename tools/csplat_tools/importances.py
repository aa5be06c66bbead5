"""How much splats matter: measured from views for `csplat sensitivity`, read from files for `csplat encode`."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from csplat.encoder import Importance, trusted
from csplat.errors import InputError
from csplat.files import atomic_writer
from csplat.model import SplatModel
from csplat_render import Camera
from csplat_render.virtual import scene_frame
from csplat_tools.inout import read_array
from csplat_trainer.sensitivity_file import GROUPS, StoredSensitivity, read_sensitivity, write_sensitivity

if TYPE_CHECKING:
    from csplat_tools.views import ViewSet
    from csplat_trainer.sensitivity import Sensitivity

__all__ = [
    "Measured",
    "measure_scene",
    "measure_views",
    "measured_importance",
    "read_importance",
    "weights_of",
]

Colour = tuple[float, float, float]
Progress = Callable[[str, float], None]

_NOTHING = "a scene without splats has no sensitivities"
_ZIP = b"PK"  # what a .npz begins with
_GONE = 0.4  # share of the splats for whose removal virtual views have to agree before there are enough


@dataclass(frozen=True, eq=False)
class Measured:
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
        with atomic_writer(path) as stream:
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
) -> Measured:
    """Measure a scene from views that teach: of virtual ones as many as it takes, of others all.

    Args:
        model: the scene.
        views: from where it is looked at. Where none teaches, it is measured from those that judge.
        matrices, threads, progress: as for `measure_views`.

    Raises:
        InputError: there are no splats, or no views, or they show no splat.
    """
    from csplat_render.removal import measure_removal
    from csplat_tools.simplify.views import find_views

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
        elsewhere = measure_removal(model, check, background=views.background, threads=threads).seen
        missed = float(np.mean(elsewhere & ~measured.seen))
    return Measured(model, measured, source, missed)


def measure_views(
    model: SplatModel,
    cameras: Sequence[Camera],
    background: Colour,
    *,
    matrices: bool,
    threads: int | None,
    progress: Progress | None = None,
) -> Sensitivity:
    """Measure a scene from given views.

    Args:
        model: the scene. cameras: relative to its origin.
        background: behind everything.
        matrices: whether those of SH coefficients are measured too.
        threads: how many; `None` for all.
        progress: is told the stages.

    Raises:
        InputError: there are no splats, or no view shows any.
    """
    from csplat_trainer.sensitivity import measure_sensitivity

    if not len(model):
        raise InputError(_NOTHING)
    if progress is not None:
        progress("compiling", 0.0)  # the first time takes some seconds
        measure_sensitivity(model.select(np.zeros(1, np.intp)), cameras[:1], metric=matrices)
        progress("compiling", 1.0)
    found = measure_sensitivity(
        model, cameras, background=background, metric=matrices, threads=threads, progress=progress
    )
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
    found = measure_views(model, cameras, background, matrices=False, threads=threads, progress=progress)
    weights = StoredSensitivity.of(model, found).importance()
    return replace(weights, sh=trusted(weights.sh, model))


def read_importance(path: str, model: SplatModel) -> NDArray[Any] | Importance | StoredSensitivity:
    """Read weights from a .npy file, or sensitivities from a .npz file.

    Raises:
        InputError: it is neither, or is about another scene.
        OSError: it cannot be read.
    """
    with Path(path).open("rb") as stream:
        begin = stream.read(len(_ZIP))
    return read_sensitivity(path, model) if begin == _ZIP else read_array(path)


def weights_of(found: NDArray[Any] | Importance | StoredSensitivity, model: SplatModel) -> NDArray[Any] | Importance:
    """What the encoder wants of what a file says.

    Virtual views do not stand where the cameras inside surroundings do: of what those show, they show too little to
    say how coarse it may be. So they grade no splats there.

    Args:
        found: by `read_importance`.
        model: the scene that it is about.
    """
    if not isinstance(found, StoredSensitivity):
        return found
    weights = found.importance()
    if found.source == "virtual" and scene_frame(model).kind == "surrounding":
        return replace(weights, curvatures=None)
    return weights

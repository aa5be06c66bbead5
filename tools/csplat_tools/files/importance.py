"""How much splats matter, as a file says it: weights (.npy), or what `csplat sensitivity` wrote (.npz)."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from csplat.encoder import EncodeOptions, EncodeResult, Importance, Origin, encode_with_report
from csplat.errors import InputError
from csplat.files import read_array
from csplat.model import SplatModel
from csplat_render.virtual import scene_frame
from csplat_tools.files.console import Progress
from csplat_trainer.sensitivity_file import StoredSensitivity, read_sensitivity

__all__ = ["encode_by_importance", "read_importance", "read_weights", "weights_of"]

_ZIP = b"PK"  # what a .npz begins with
_ONE_GRADE = (
    "all splats are of one grade: weights alone do not say how precise they have to be, nor do virtual views inside of"
    " surroundings; `csplat sensitivity` from cameras does"
)


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


def read_weights(path: str, model: SplatModel) -> NDArray[Any] | Importance:
    """Read what the encoder wants of a file, see `read_importance`."""
    return weights_of(read_importance(path, model), model)


def encode_by_importance(
    model: SplatModel, options: EncodeOptions, path: str, *, prune_unseen: bool, progress: Progress | None = None
) -> EncodeResult:
    """Encode a scene by how much its splats matter.

    Args:
        model: the scene.
        options: of the encoder.
        path: a file as `read_importance` takes it.
        prune_unseen: leave out the splats that no view of the sensitivities saw.
        progress: is told the stages.

    Raises:
        InputError: the file is none, is about another scene, does not say what was seen, or nothing would be left.
        OSError: it cannot be read.
    """
    found = read_importance(path, model)
    stored = found if isinstance(found, StoredSensitivity) else None
    if prune_unseen and stored is None:
        raise InputError("only what `csplat sensitivity` wrote says which splats no view saw")
    weights = weights_of(found, model)
    notes = _unheeded(options, weights)
    if not prune_unseen or stored is None or stored.seen.all():
        return _noted(encode_with_report(model, options, importance=weights, progress=progress), *notes)
    rows = np.flatnonzero(stored.seen)
    if not len(rows):
        raise InputError(f"{path}: no view saw any splat; nothing would be left")
    said = {"unseen": len(model) - len(rows), "views": stored.view_count, "source": stored.source}
    result = encode_with_report(
        model.select(rows), options, importance=weights.select(rows) if isinstance(weights, Importance) else None,
        origin=Origin(len(model), rows), said={"pruned": said}, progress=progress,
    )  # fmt: skip
    if stored.missed_share > 0.0:  # not where no view was kept aside: then it is not a number
        missed = (
            f"{100 * stored.missed_share:.1f} % of the splats are left out although views that were kept aside saw"
            " them: `csplat sensitivity` with more views misses fewer"
        )
        notes = (*notes, missed)
    return _noted(result, *notes)


def _unheeded(options: EncodeOptions, weights: NDArray[Any] | Importance) -> tuple[str, ...]:
    """What an importance does not say, though it is asked for."""
    if (options.grades or 1) == 1 or (isinstance(weights, Importance) and weights.curvatures is not None):
        return ()
    return (_ONE_GRADE,)


def _noted(result: EncodeResult, *notes: str) -> EncodeResult:
    """The same, with sentences for the user."""
    return replace(result, report=replace(result.report, notes=(*result.report.notes, *notes)))

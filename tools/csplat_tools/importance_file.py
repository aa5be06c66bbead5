# SPDX-License-Identifier: Apache-2.0
"""Encode with the importance in a file: weights (.npy), or the output of `csplat sensitivity` (.npz)."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from csplat.context import DEFAULT_CONTEXT, Context
from csplat.disk_files import read_array
from csplat.encode_api import encode_planned, encode_with_report
from csplat.encoder import EncodeOptions, EncodePlan, EncodeResult, Importance, Origin, Target, Views
from csplat.errors import InputError
from csplat.file_source import open_binary
from csplat.model import SplatModel
from csplat_render.scene_frame import scene_frame
from csplat_tools.level_builder import FittedLevelBuilder
from csplat_tools.optional_packages import require_renderer
from csplat_tools.scene_sensitivity import measure_importance
from csplat_tools.views import BLACK, camera_sequence
from csplat_trainer.sensitivity_file import StoredSensitivity, read_sensitivity

_ZIP = b"PK"  # first bytes of a .npz file
_ONE_CLASS = (
    "all splats are in one quantisation class, since this importance does not determine their precision:"
    " use `csplat sensitivity` with real cameras"
)

# Virtual views from whose directions dropped SH bands are projected, and the factor of their largest distance in
# surroundings. With views at the usual distances, garden500k loses up to 4 dB from twice as far, and gains less nearby.
_VIEWS, _REACH = 80, 2.5
_PROJECTED = f"the dropped SH bands are projected onto the others, for the directions of {_VIEWS} virtual views"


def read_importance(path: str, model: SplatModel) -> NDArray[Any] | Importance | StoredSensitivity:
    """Read weights from a .npy file, or sensitivities from a .npz file.

    Raises:
        InputError: the file is neither, or belongs to another scene.
        OSError: the file cannot be read.
    """
    with open_binary(path) as stream:
        begin = stream.read(len(_ZIP))
    return read_sensitivity(path, model) if begin == _ZIP else read_array(path)


def encoder_importance(
    contents: NDArray[Any] | Importance | StoredSensitivity, model: SplatModel
) -> NDArray[Any] | Importance:
    """Return the importance for the encoder from the result of `read_importance`.

    In surrounding scenes, virtual views show too little to determine how coarsely splats may be quantised. So
    sensitivities measured in such views do not sort splats into quantisation classes.
    """
    if not isinstance(contents, StoredSensitivity):
        return contents
    weights = contents.importance()
    if contents.source == "virtual" and scene_frame(model).kind == "surrounding":
        return replace(weights, blocks=None)
    return weights


def encode_by_importance(
    model: SplatModel,
    options: EncodeOptions,
    path: str,
    *,
    target: Target | None = None,
    views: Views | None = None,
    prune_unseen: bool = False,
    levels: FittedLevelBuilder | None = None,
    context: Context = DEFAULT_CONTEXT,
) -> EncodeResult:
    """Encode a scene with the importance of its splats.

    Args:
        model: the scene.
        options: options of the encoder.
        path: a file as for `read_importance`.
        target, views: as for `csplat.encode`; not with `prune_unseen`.
        prune_unseen: prune the splats that no view of the sensitivities saw.
        levels: builds levels of detail; `None`: the file has none.
        context: as for `csplat.encode`.

    Raises:
        InputError: the file is invalid or belongs to another scene; or `prune_unseen` is set and no view saw any
            splat, or the file has weights only.
        OSError: the file cannot be read.
    """
    importance = read_importance(path, model)
    stored = importance if isinstance(importance, StoredSensitivity) else None
    if prune_unseen and stored is None:
        raise InputError("pruning unseen splats requires a file of `csplat sensitivity` as importance")
    weights = encoder_importance(importance, model)
    if target is not None:
        return encode_with_report(
            model, options, levels=levels, target=target, views=views, importance=weights, context=context
        )
    notes = _class_notes(options, weights)
    if not prune_unseen or stored is None or stored.seen.all():
        result = encode_with_report(model, options, levels=levels, importance=weights, context=context)
        return result.with_notes(*notes)
    rows = np.flatnonzero(stored.seen)
    if not len(rows):
        raise InputError(f"{path}: no view saw any splat, so all would be pruned")
    pruned = {"unseen": len(model) - len(rows), "views": stored.view_count, "source": stored.source}
    kept_weights = weights.select(rows) if isinstance(weights, Importance) else None
    origin = Origin(len(model), rows)
    plan = EncodePlan.of(model.select(rows), options, importance=kept_weights, origin=origin, context=context)
    result = encode_planned(plan, levels, {"pruned": pruned})
    if stored.missed_share > 0.0:  # NaN if no view was held out
        missed = f"{100 * stored.missed_share:.1f} % of the splats were pruned although held-out views saw them:"
        notes = (*notes, f"{missed} `csplat sensitivity` with more views misses fewer")
    return result.with_notes(*notes)


def encode_fewer_bands(
    model: SplatModel, options: EncodeOptions, *, levels: FittedLevelBuilder | None, context: Context
) -> EncodeResult:
    """Encode a scene with fewer SH bands, the dropped ones projected onto the others for the directions of views.

    Without the renderer, they are only dropped, and a note says so. Arguments are as for `encode_by_importance`.
    """
    try:
        require_renderer()
        cameras = camera_sequence(model, _VIEWS, reach=_REACH, seed=context.seed)
        weights = measure_importance(model, cameras, BLACK, matrices=True, context=context)
    except InputError as error:
        result = encode_with_report(model, options, levels=levels, context=context)
        return result.with_notes(f"the dropped SH bands are not projected onto the others: {error}")
    weights = replace(weights, blocks=None, shape_metric=None)
    result = encode_with_report(model, options, levels=levels, importance=weights, context=context)
    return result.with_notes(_PROJECTED)


def _class_notes(options: EncodeOptions, weights: NDArray[Any] | Importance) -> tuple[str, ...]:
    """Return a note if several quantisation classes are requested, and the importance lacks blocks to sort by."""
    if (options.max_classes or 1) == 1 or (isinstance(weights, Importance) and weights.blocks is not None):
        return ()
    return (_ONE_CLASS,)

# SPDX-License-Identifier: Apache-2.0
"""The expected work of searches for a target, from which their progress and their time are estimated."""

from __future__ import annotations

import math
from collections.abc import Sequence

from csplat.context import DEFAULT_CONTEXT, Context
from csplat.encoder import EncodeOptions, Target
from csplat.model import SplatModel
from csplat_render import Camera
from csplat_tools.optimise.candidates import DRAFT, FILE, LEVELS
from csplat_tools.optimise.pruning import Pruner
from csplat_tools.optimise.rate_distortion import USUAL_BYTES
from csplat_tools.planned_progress import STEP_COST, Plan, PlannedWork, planned_cost, view_cost
from csplat_tools.scene_sensitivity import importance_views
from csplat_tools.views import HELD_OUT_COUNT, ViewSet
from csplat_tools.views.view_sets import render_seconds
from csplat_trainer.pruning import ROUND_FRACTION

#: Stage of scoring the result on test views.
SCORES = "scoring the result"

# Costs of a report of each stage, relative to a view with as many splats and pixels (`view_cost`). Fits of 16 searches
# on five scenes of 14,000 to 120,000 splats, on one thread.
_RENDER, _FILE_STEP, _SENSITIVITY, _DRAFT, _FILE, _SCORES = 1.25, 1.7, 3.7, 100.0, 130.0, 170.0
_LEVELS = 16_000.0  # cost of levels of detail for each splat, in the unit of plans

# Usual numbers in searches; pairs are without and with SH.
# `_FILES` and `_DRAFTS` are means of eleven searches for 38 dB, the others are of those above.
_FILES, _DRAFTS, _DRAFTS_OF_SIZE = (3.0, 2.6), (1.7, 8.4), (3.0, 16.0)
_FILES_OF_ALL = (3.5, 9.0)  # without pruning
_LEVELLED = (1.0, 2.0)  # files with levels of detail, for a fraction of the splats and for other targets
_ORDERED_BEYOND = 0.25  # fraction of the kept splats down to which splats are ordered, unless their number is given
_KEPT_PER_DB, _NONE_KEPT = 0.025, 24.0  # fraction of the splats that is kept per dB of PSNR, above this PSNR, dB
_LEAST_KEPT, _KEPT_OF_IMAGES = 0.1, 0.4  # least of these fractions, and the fraction for a drop of PSNR


def search_plan(pruner: Pruner, target: Target, encoding: EncodeOptions, *, has_levels: bool = False) -> Plan:
    """Return the expected work of a search for a file, in its phases.

    Args:
        pruner: prunes the source, unless the target and the options keep all splats; nothing is computed.
        target: the target.
        encoding: the caller's options.
        has_levels: the file gets levels of detail.
    """
    source, has_sh = pruner.source, pruner.source.sh_degree > 0 and encoding.sh_degree != 0
    is_whole, is_search = keeps_all(target, encoding), target.keep is None
    count = len(source) if is_whole else _kept_count(source, target)
    cost, importance = view_cost(math.prod(pruner.size), count), len(importance_views(pruner.views, count))
    scored = [*pruner.views.test, *pruner.views.validation]
    last = [
        {LEVELS: PlannedWork(_LEVELLED[is_search], _LEVELS * count)} if has_levels else {},
        {SCORES: PlannedWork(1.0, _SCORES * cost)},
    ]
    if is_whole:
        return [
            _drawing(source, scored),
            {"measuring sensitivity": PlannedWork(importance, _SENSITIVITY * cost)},
            {FILE: PlannedWork(_FILES_OF_ALL[has_sh], _DRAFT * cost)},
            *last,
        ]
    files = _FILES[has_sh] if is_search else 1.0
    drafts = (_DRAFTS if target.size is None else _DRAFTS_OF_SIZE)[has_sh] if is_search else 0.0
    steps, file_steps = pruner.planned_steps(files)
    return [
        _drawing(source, scored),
        _measuring(pruner, target),
        {
            "refitting splats": PlannedWork(steps, STEP_COST * cost),
            "measuring sensitivity": PlannedWork(importance, _SENSITIVITY * cost),
            DRAFT: PlannedWork(drafts, _DRAFT * cost),
        },
        {"refitting splats": PlannedWork(file_steps, _FILE_STEP * cost), FILE: PlannedWork(files, _FILE * cost)},
        *last,
    ]


def simplify_plan(pruner: Pruner, target: Target) -> Plan:
    """Return the expected work of simplifying a scene, in its phases; arguments as for `search_plan`."""
    cost = view_cost(math.prod(pruner.size), _kept_count(pruner.source, target))
    steps = pruner.planned_steps(0.0)[0]
    return [
        _drawing(pruner.source, pruner.views.validation),
        _measuring(pruner, target),
        {"refitting splats": PlannedWork(steps * pruner.refits, STEP_COST * cost)},
        {**_drawing(pruner.source, pruner.views.test), SCORES: PlannedWork(1.0, _SCORES * cost)},
    ]


def plan_seconds(plan: Plan, source: SplatModel, views: ViewSet, context: Context = DEFAULT_CONTEXT) -> float:
    """Estimate the seconds of a plan on this machine, from the time of some renders of test views; 0 without any."""
    if not len(source) or not views.test:
        return 0.0
    return planned_cost(plan) / _render_cost(source, views.test) * render_seconds(source, views.test, context=context)


def keeps_all(target: Target, encoding: EncodeOptions) -> bool:
    """Return True if no splat may be pruned, due to the target, error bounds, extra columns or the preset `fast`."""
    blocked = not target.prune or bool(target.max_error) or encoding.preset == "fast" or encoding.keep_extra
    return target.keep is None and blocked


def _drawing(source: SplatModel, cameras: Sequence[Camera]) -> dict[str, PlannedWork]:
    """Return the work of rendering the source for a scorer."""
    return {"drawing the source": PlannedWork(len(cameras), _render_cost(source, cameras))}


def _measuring(pruner: Pruner, target: Target) -> dict[str, PlannedWork]:
    """Return the work of measuring pruning errors in training views, and of the pruning order."""
    views, count, pixels = pruner.views, len(pruner.source), math.prod(pruner.size)
    used, factor = (len(views.training) - HELD_OUT_COUNT, 2.0) if views.virtual else (len(views.training), 1.0)
    left = _kept_count(pruner.source, target) / max(1, count)
    if target.keep is None and target.size is None:
        left *= _ORDERED_BEYOND
    rounds = max(1.0, math.log(left) / math.log(ROUND_FRACTION))
    measured = count * (1.0 - left) / (1.0 - ROUND_FRACTION) / rounds * ROUND_FRACTION  # mean number of splats
    return {
        "measuring splats": PlannedWork(HELD_OUT_COUNT + factor * used, view_cost(pixels, count)),
        "ordering splats": PlannedWork(rounds, 0.5 * used * view_cost(pixels, measured)),
    }


def _render_cost(source: SplatModel, cameras: Sequence[Camera]) -> float:
    """Return the mean cost of a render of the source from some views, in the unit of a plan; 0 without views."""
    pixels = sum(camera.W * camera.H for camera in cameras)
    return _RENDER * view_cost(pixels / len(cameras), len(source)) if cameras else 0.0


def _kept_count(source: SplatModel, target: Target) -> int:
    """Return a guess of the number of splats that a search keeps, at least 1."""
    splats = len(source)
    if target.keep is not None:
        return target.count(splats)
    if target.size_bytes is not None:
        return max(1, min(round(target.size_bytes / USUAL_BYTES[source.sh_degree > 0]), splats))
    kept = _KEPT_OF_IMAGES if target.psnr is None else _KEPT_PER_DB * (target.psnr - _NONE_KEPT)
    return max(1, round(min(max(kept, _LEAST_KEPT), 1.0) * splats))

# SPDX-License-Identifier: Apache-2.0
"""Meet a target by rendering candidates; `csplat.encode` finds `meet_target` by its entry point."""

from __future__ import annotations

import time
from dataclasses import replace
from typing import TYPE_CHECKING

from csplat.context import DEFAULT_CONTEXT, Context
from csplat.encoder import EncodeOptions, EncodePlan, EncodeResult, Target, meet_bounds
from csplat.errors import InputError, SearchInterrupted, counted
from csplat.model import SplatModel
from csplat_tools.console import format_bytes
from csplat_tools.optimise.candidates import Weights
from csplat_tools.optional_packages import require_renderer
from csplat_tools.views import ViewSet, find_view_set, with_validation_views

if TYPE_CHECKING:
    from csplat_tools.level_builder import FittedLevelBuilder
    from csplat_tools.optimise.simplify import SimplifyOptions


def meet_target(
    source: SplatModel,
    options: EncodeOptions,
    *,
    target: Target,
    views: ViewSet | None = None,
    importance: Weights | None = None,
    simplifying: SimplifyOptions | None = None,
    levels: FittedLevelBuilder | None = None,
    context: Context = DEFAULT_CONTEXT,
) -> EncodeResult:
    """Search for the file that meets a target which requires rendering.

    Args:
        source: the scene.
        options, target, importance, context: as for `csplat.encode_with_report`.
        views: training, validation and test views; `None`: virtual views around the scene.
        simplifying: options of pruning and refitting, instead of the target's effort; the views determine the
            background.
        levels: builds levels of detail, whose bytes count; `None`: the file has none.

    Returns:
        The file. Its source index refers to the source, and its report contains the search's report.

    Raises:
        InputError: the renderer is not installed, there are no splats, an option is set that the target determines, or
            the target is out of reach.
        SearchInterrupted: Ctrl-C interrupted the search; `best` is the best file so far that meets the target, if any.
    """
    start = time.perf_counter()
    require_renderer()
    from csplat_tools.optimise.simplify import SimplifyOptions
    from csplat_tools.optimise.target_search import check_target, search_target

    if not (views is None or isinstance(views, ViewSet)):
        raise InputError(f"views is a {type(views).__name__}, expected csplat_tools.find_view_set(...)")
    check_target(source, target, options)
    encodes = 0
    if options.position_error is not None:
        EncodePlan.of(source, options, context=context)  # refuses an error that cannot be kept before the search
    if target.max_error:
        bounded, options = meet_bounds(source, options, target, importance=importance, context=context)
        assert bounded.report.search is not None
        encodes = bounded.report.search.encodes
    chosen, report = search_target(
        source, target, views or find_view_set(source, seed=context.seed), options, importance=importance,
        options=simplifying or SimplifyOptions(effort=target.effort), levels=levels, context=context,
    )  # fmt: skip
    seconds = round(time.perf_counter() - start, 3)
    result = chosen.result.with_search(replace(report, encodes=encodes + report.encodes, seconds=seconds))
    if report.interrupted:
        files, size = counted(report.encodes, "file"), format_bytes(chosen.size_bytes)
        raise SearchInterrupted(
            f"interrupted: the best of {files} so far was taken, {size} with {chosen.validation_psnr:.2f} dB", result
        )
    return result


def expected_search_seconds(
    source: SplatModel,
    options: EncodeOptions,
    target: Target,
    views: ViewSet,
    *,
    has_levels: bool = False,
    context: Context = DEFAULT_CONTEXT,
) -> float:
    """Estimate the seconds of `meet_target` on this machine, from the time of some renders of test views."""
    from csplat_tools.optimise.search_plan import plan_seconds, search_plan
    from csplat_tools.optimise.simplify import SimplifyOptions

    pruner = SimplifyOptions(effort=target.effort).pruner(source, with_validation_views(views))
    return plan_seconds(search_plan(pruner, target, options, has_levels=has_levels), source, views, context)

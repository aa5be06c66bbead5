# SPDX-License-Identifier: Apache-2.0
"""Find steps with which no splat's error exceeds given bounds, by encoding and measuring."""

from __future__ import annotations

import math
import time
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from numpy.typing import NDArray

from csplat import _spec
from csplat.context import DEFAULT_CONTEXT, Context
from csplat.encoder.encode_options import EncodeOptions
from csplat.encoder.encode_plan import EncodePlan
from csplat.encoder.pipeline import EncodeResult, encode_tiles
from csplat.encoder.source_lattices import exact_options
from csplat.encoder.splat_importance import Importance
from csplat.encoder.target import SearchReport, Target
from csplat.errors import InputError
from csplat.goal_search import next_value
from csplat.model import SplatModel

_TRIES = 8  # largest number of steps of a measure
_COARSENESS = (-20.0, 20.0)  # range of the logarithm of the factor by which steps may differ from the first
# Logarithms of the ratio of bound to error: new steps aim at the margin; a ratio within the tolerance ends the search.
_MARGIN, _TOLERANCE = 0.03, 0.1
_LARGEST_STEP, _LEAST_STEP = 2.0, 0.02  # logarithm of the factor from one step to the next
_SCALE_STEP_RATIO = 0.4  # first scale step, log scale, relative to the bound of the covariance; the search corrects it
_QUAT_LEVELS_RATIO = 4.0  # first rotation levels, times that bound
_QUAT_LEVELS_MIN = 8  # smallest number of rotation levels that the search tries
_STEP_MIN, _STEP_MAX = 1e-6, 1e3  # range of the steps that `EncodeOptions` accepts
_ROUNDING = 2.0**-19  # largest error if a bound is 0: of float32, in the source's program and in decoders
_KNOBS = {  # options that set the steps of a family of measures
    "means": ("position_error", "position_step", "position_bits"),
    "covariance": ("scale_step", "quat_levels", "shape_codebook_size"),
    "opacities": ("opacity_levels",),
    "sh0": ("sh0_step",),
    "sh": ("sh_step",),
}


def meet_bounds(
    source: SplatModel,
    encoding: EncodeOptions,
    target: Target,
    *,
    importance: NDArray[Any] | Importance | None = None,
    context: Context = DEFAULT_CONTEXT,
) -> tuple[EncodeResult, EncodeOptions]:
    """Find steps with which no splat's error exceeds the bounds of a target.

    Args:
        source: the scene.
        encoding: the other options; steps of unbounded measures are kept.
        target: `max_error` has the bounds.
        importance: importance of the splats, as for the encoder.
        context: threads, seed and progress.

    Returns:
        The file, and the options that made it. The largest errors that it declares are within the bounds, and close to
        them if float32 and the lattices allow it.

    Raises:
        InputError: `encoding` sets a step that a bound determines, or no step is fine enough.
    """
    start, bounds = time.perf_counter(), target.max_error
    tried = dict[EncodeOptions, dict[str, float]]()  # largest errors relative to their bounds
    # By family of measures: log of the bounds that steps are chosen for, relative to `bounds`; and for each such value
    # the log of the largest error relative to its bound.
    exact = {_family(name) for name, bound in bounds.items() if bound == 0.0}
    coarseness = {_family(name): 0.0 for name in bounds if _family(name) not in exact}
    measured = {family: dict[float, float]() for family in coarseness}
    best: tuple[EncodeResult, EncodeOptions] | None = None
    while True:
        options = _options_for(
            source,
            encoding,
            {name: bound * math.exp(coarseness.get(_family(name), 0.0)) for name, bound in bounds.items()},
            exact,
        )
        if options not in tried:
            plan = EncodePlan.of(source, options, importance=importance, context=context)
            result = encode_tiles(plan).write()
            tried[options] = {name: result.largest_error(name) / (bound or _ROUNDING) for name, bound in bounds.items()}
            is_met = max(tried[options].values()) <= 1.0
            if is_met and (best is None or result.size_bytes < best[0].size_bytes):
                best = result, options
        ratios = tried[options]
        adjusted = dict[str, float]()
        for family, excesses in measured.items():
            ratio = max(ratio for name, ratio in ratios.items() if _family(name) == family)
            excess = math.log(ratio or 1.0)  # without an error, steps need not be coarser
            excesses[coarseness[family]] = max(excess, excesses.get(coarseness[family], excess))
            proposed = next_value(
                0.0, list(excesses.items()), 1.0, bounds=_COARSENESS, margin=_MARGIN, tolerance=_TOLERANCE,
                largest_step=_LARGEST_STEP, least_step=_LEAST_STEP, tries=_TRIES,
            )  # fmt: skip
            met = [value for value, excess in excesses.items() if excess <= 0.0]
            adjusted[family] = max(met, default=coarseness[family]) if proposed is None else proposed
        if adjusted == coarseness:
            break
        coarseness = adjusted
    if best is None:
        worst = max(ratios, key=lambda name: ratios[name])
        raise InputError(
            f"no lattice keeps the error of {worst} within {bounds[worst]:g}: the best found is"
            f" {ratios[worst] * (bounds[worst] or _ROUNDING):.3g}; allow a larger error"
        )
    result, options = best
    search = SearchReport(
        goal=target.as_json(),
        size_bytes=result.size_bytes,
        splats=result.report.splat_count,
        splats_before=len(source),
        encodes=len(tried),
        seconds=round(time.perf_counter() - start, 3),
        reached={name: result.largest_error(name) for name in bounds},
    )
    return result.with_search(search), options


def _options_for(
    source: SplatModel, encoding: EncodeOptions, bounds: Mapping[str, float], exact: set[str]
) -> EncodeOptions:
    """Return the options with steps that should keep the errors within bounds; encoding shows if they do.

    Args:
        source: the scene.
        encoding: the caller's options.
        bounds: largest error by measure, >= 0.
        exact: families of measures of which a bound is 0: their attributes keep the source's values.

    Raises:
        InputError: `encoding` sets an option that a bound determines, or drops or excludes bounded SH bands; or the
            source has values on no lattice, of which a bound is 0.
    """
    chosen: dict[str, Any] = exact_options(source, exact)
    for name, bound in bounds.items():
        knobs = _KNOBS[_family(name)]
        already_set = [knob for knob in knobs if getattr(encoding, knob) is not None]
        if already_set:
            raise InputError(f"{already_set[0]} is determined by the largest error of {name}: give only one of them")
        if _family(name) in exact:
            continue
        if name == "means":
            chosen["position_error"] = bound
        elif name == "opacities":
            chosen["opacity_levels"] = _clip_levels(1.0 / bound, 1, _spec.OPACITY_LEVELS_MAX)
        elif name == "covariance":
            chosen["scale_step"] = _clip_step(_SCALE_STEP_RATIO * bound)
            chosen["quat_levels"] = _clip_levels(_QUAT_LEVELS_RATIO / bound, _QUAT_LEVELS_MIN, _spec.QUAT_LEVELS_MAX)
        else:
            step = _clip_step(math.exp(-_MARGIN) * bound)
            chosen[knobs[0]] = min(step, chosen.get(knobs[0], step))  # the bands of SH share a step
    if any(_family(name) == "sh" for name in bounds) and source.sh_degree:
        if encoding.sh_coding == "none":
            raise InputError("sh_coding none drops the SH bands whose error is bounded")
        if encoding.adaptive:
            raise InputError("adaptive steps exclude a bound on the error of SH")
        if encoding.sh_coding == "codebook":
            raise InputError("an SH codebook excludes a bound on the error of SH: leave sh_coding unset")
        bounded = max(int(name[2:]) for name in bounds if _family(name) == "sh")
        if encoding.sh_degree is not None and encoding.sh_degree < min(bounded, source.sh_degree):
            raise InputError(f"SH degree {encoding.sh_degree} drops sh{bounded}, whose error is bounded")
        chosen.update(sh_coding="scalar", adaptive=0.0, sh_degree=encoding.kept_degree(source.sh_degree))
    return replace(encoding, **chosen)


def _clip_step(step: float) -> float:
    """Clip a step to the range `_STEP_MIN` to `_STEP_MAX`."""
    return min(max(step, _STEP_MIN), _STEP_MAX)


def _family(name: str) -> str:
    """Return the key of `_KNOBS` for a measure: "sh" for the bands sh1 to sh4, its own name otherwise."""
    return "sh" if name.startswith("sh") and name != "sh0" else name


def _clip_levels(value: float, low: int, high: int) -> int:
    """Clip a value to a range, and round it up; it may be infinite for bounds near 0."""
    return math.ceil(min(max(value, low), high))

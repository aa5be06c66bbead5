"""Find steps with which no splat's error exceeds given bounds, by encoding and measuring."""

from __future__ import annotations

import math
import time
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from numpy.typing import NDArray

from csplat.context import DEFAULT_CONTEXT, Context
from csplat.encoder.encode_options import EncodeOptions
from csplat.encoder.encode_plan import EncodePlan
from csplat.encoder.pipeline import EncodeResult, encode_tiles
from csplat.encoder.splat_importance import Importance
from csplat.encoder.target import SearchReport, Target
from csplat.errors import InputError
from csplat.model import SplatModel

_TRIES = 12  # largest number of files
_NEAR = 0.9  # fraction of a bound; a coarser step is tried if the error is below
_AIM = 0.97  # fraction of a bound that a new step aims at
_FASTEST = 8.0  # largest factor from one step to the next
_KNOBS = {
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
    options = _first_options(source, encoding, bounds)
    best: tuple[EncodeResult, EncodeOptions] | None = None
    files = 0
    while True:
        files += 1
        plan = EncodePlan.of(source, options, importance=importance, context=context)
        result = encode_tiles(plan).write()
        ratios = {name: result.largest_error(name) / bounds[name] for name in bounds}
        if all(ratio <= 1.0 for ratio in ratios.values()):
            if best is None or result.size_bytes < best[0].size_bytes:
                best = result, options
            changed = _scaled_options(options, {name: ratio for name, ratio in ratios.items() if 0.0 < ratio < _NEAR})
            if changed == options or files > _TRIES // 2:
                break
        else:
            wrong = {name: ratio for name, ratio in ratios.items() if ratio > 1.0}
            if best is not None:
                break  # the last step was too coarse
            changed = _scaled_options(options, wrong)
            if changed == options or files == _TRIES:
                break
        options = changed
    if best is None:
        worst = max(ratios, key=lambda name: ratios[name])
        raise InputError(
            f"no lattice keeps the error of {worst} within {bounds[worst]:g}: the best found is"
            f" {result.largest_error(worst):.3g}; allow a larger error"
        )
    result, options = best
    search = SearchReport(
        goal=target.as_json(),
        size_bytes=result.size_bytes,
        splats=result.report.splat_count,
        splats_before=len(source),
        encodes=files,
        seconds=round(time.perf_counter() - start, 3),
        reached={name: result.largest_error(name) for name in bounds},
    )
    return result.with_search(search), options


def _first_options(source: SplatModel, encoding: EncodeOptions, bounds: Mapping[str, float]) -> EncodeOptions:
    """Return the options with first guesses for the steps of the bounded measures."""
    chosen: dict[str, Any] = {}
    for name, bound in bounds.items():
        knobs = _KNOBS[_family(name)]
        fixed = [knob for knob in knobs if getattr(encoding, knob) is not None]
        if fixed:
            raise InputError(f"{fixed[0]} is determined by the largest error of {name}: give only one of them")
        if name == "means":
            chosen["position_error"] = bound
        elif name == "opacities":
            chosen["opacity_levels"] = _clip_levels(1.0 / bound, 1, 65535)
        elif name == "covariance":
            chosen["scale_step"] = _clip_step(0.4 * bound)
            chosen["quat_levels"] = _clip_levels(4.0 / bound, 8, 32767)
        else:
            step = _clip_step(_AIM * bound)
            chosen[_KNOBS[_family(name)][0]] = min(step, chosen.get(_KNOBS[_family(name)][0], step))
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


def _scaled_options(options: EncodeOptions, ratios: Mapping[str, float]) -> EncodeOptions:
    """Return the options with steps divided by the ratios of errors to bounds."""
    chosen: dict[str, Any] = {}
    for name, ratio in ratios.items():
        factor = min(max(_AIM / max(ratio, 1e-9), 1.0 / _FASTEST), _FASTEST)
        if name == "means":
            chosen["position_error"] = (options.position_error or 1.0) * factor
        elif name == "opacities":
            levels = _scaled_levels(options.opacity_levels, factor)
            chosen["opacity_levels"] = _clip_levels(levels, 1, 65535)
        elif name == "covariance":
            chosen["scale_step"] = _clip_step((options.scale_step or 1.0) * factor)
            chosen["quat_levels"] = _clip_levels(_scaled_levels(options.quat_levels, factor), 8, 32767)
        else:
            knob = _KNOBS[_family(name)][0]
            before = getattr(options, knob)
            step = _clip_step(before * factor)
            chosen[knob] = min(step, chosen.get(knob, step))
    return replace(options, **chosen)


def _clip_step(wanted: float) -> float:
    """Return the nearest step that the encoder accepts."""
    return min(max(wanted, 1e-6), 1e3)


def _scaled_levels(levels: int | None, factor: float) -> int:
    """Return the number of levels for steps that are coarser by `factor`."""
    count = levels or 1
    scaled = math.ceil(count / factor) if factor < 1.0 else math.floor(count / factor)
    return scaled if scaled != count else count + (1 if factor < 1.0 else 0)


def _family(name: str) -> str:
    return "sh" if name.startswith("sh") and name != "sh0" else name


def _clip_levels(value: float, low: int, high: int) -> int:
    """Clip a value to a range, and round it up; it may be infinite for bounds near 0."""
    return math.ceil(min(max(value, low), high))

"""Encode within largest errors: steps are made finer, or coarser, until the file declares no larger errors."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

from numpy.typing import NDArray

from csplat.encoder import EncodeOptions, EncodeResult, Importance, encode_with_report
from csplat.errors import InputError
from csplat.model import SplatModel
from csplat.types import Progress

#: Importance of the splats, as for the encoder.
Weights = NDArray[Any] | Importance

_TRIES = 12  # largest number of files
_NEAR = 0.9  # fraction of a bound that is good enough; below it a coarser step is tried
_AIM = 0.97  # fraction of a bound at which a new step aims
_FASTEST = 8.0  # largest factor from one step to the next
_KNOBS = {
    "means": ("position_error", "position_step", "position_bits"),
    "covariance": ("scale_step", "quat_levels", "shape_codebook_size"),
    "opacities": ("opacity_levels",),
    "sh0": ("sh0_step",),
    "sh": ("sh_step",),
}


@dataclass(frozen=True, eq=False)
class Bounded:
    """A file whose errors keep within bounds.

    Attributes:
        encoding: options of the encoder.
        result: the file that they give.
        encodes: number of files that were made.
    """

    encoding: EncodeOptions
    result: EncodeResult
    encodes: int


def meet_bounds(
    source: SplatModel,
    encoding: EncodeOptions,
    bounds: Mapping[str, float],
    *,
    importance: Weights | None = None,
    progress: Progress | None = None,
) -> Bounded:
    """Find steps with which no splat's error exceeds the bounds.

    Args:
        source: the scene.
        encoding: the other options; steps of measures that are not bounded are kept.
        bounds: largest error by measure.
        importance: importance of the splats, as for the encoder.
        progress: progress callback.

    Returns:
        The file. The largest errors that it declares are within the bounds, and near them if float32 and the lattices
        allow it.

    Raises:
        InputError: the caller fixed a step that a bound would have to choose, or no step keeps to a bound.
    """
    options = _started(source, encoding, bounds)
    best: tuple[EncodeOptions, EncodeResult] | None = None
    files = 0
    while True:
        files += 1
        result = encode_with_report(source, options, importance=importance, progress=progress)
        ratios = {name: result.report.errors.get(name, (0.0, 0.0))[0] / bounds[name] for name in bounds}
        if all(ratio <= 1.0 for ratio in ratios.values()):
            if best is None or len(result.data) < len(best[1].data):
                best = options, result
            changed = _finer(options, {name: ratio for name, ratio in ratios.items() if 0.0 < ratio < _NEAR})
            if changed == options or files > _TRIES // 2:
                break
        else:
            wrong = {name: ratio for name, ratio in ratios.items() if ratio > 1.0}
            if best is not None:
                break  # the last coarser step was too coarse
            changed = _finer(options, wrong)
            if changed == options or files == _TRIES:
                break
        options = changed
    if best is None:
        worst = max(ratios, key=lambda name: ratios[name])
        raise InputError(
            f"no lattice keeps the error of {worst} within {bounds[worst]:g}: the best that was found is"
            f" {result.report.errors[worst][0]:.3g}"
        )
    return Bounded(*best, files)


def _started(source: SplatModel, encoding: EncodeOptions, bounds: Mapping[str, float]) -> EncodeOptions:
    """Return the options with first guesses for the steps of the bounded measures."""
    chosen: dict[str, Any] = {}
    for name, bound in bounds.items():
        knobs = _KNOBS[_family(name)]
        fixed = [knob for knob in knobs if getattr(encoding, knob) is not None]
        if fixed:
            raise InputError(f"{fixed[0]} is given, and the largest error of {name} is to choose it: leave one out")
        if name == "means":
            chosen["position_error"] = bound
        elif name == "opacities":
            chosen["opacity_levels"] = _within(1.0 / bound, 1, 65535)
        elif name == "covariance":
            chosen["scale_step"] = _a_step(0.4 * bound)
            chosen["quat_levels"] = _within(4.0 / bound, 8, 32767)
        else:
            step = _a_step(_AIM * bound)
            chosen[_KNOBS[_family(name)][0]] = min(step, chosen.get(_KNOBS[_family(name)][0], step))
    if any(_family(name) == "sh" for name in bounds) and source.sh_degree:
        if encoding.sh_coding == "none":
            raise InputError("SH coding none leaves out the SH bands whose error is bounded")
        if encoding.adaptive:
            raise InputError("adaptive steps bound no error of a splat: leave them out")
        if encoding.sh_coding == "codebook":
            raise InputError("an SH codebook bounds no error of a splat: leave sh_coding to the bound")
        bounded = max(int(name[2:]) for name in bounds if _family(name) == "sh")
        if encoding.sh_degree is not None and encoding.sh_degree < min(bounded, source.sh_degree):
            raise InputError(f"SH degree {encoding.sh_degree} leaves out sh{bounded}, whose error is bounded")
        chosen.update(sh_coding="scalar", adaptive=0.0, sh_degree=encoding.sh_degree or source.sh_degree)
    return replace(encoding, **chosen)


def _finer(options: EncodeOptions, ratios: Mapping[str, float]) -> EncodeOptions:
    """Return the options with steps finer by the ratios of errors to bounds; coarser for ratios below 1."""
    chosen: dict[str, Any] = {}
    for name, ratio in ratios.items():
        factor = min(max(_AIM / max(ratio, 1e-9), 1.0 / _FASTEST), _FASTEST)
        if name == "means":
            chosen["position_error"] = (options.position_error or 1.0) * factor
        elif name == "opacities":
            levels = _levels(options.opacity_levels, factor)
            chosen["opacity_levels"] = _within(levels, 1, 65535)
        elif name == "covariance":
            chosen["scale_step"] = _a_step((options.scale_step or 1.0) * factor)
            chosen["quat_levels"] = _within(_levels(options.quat_levels, factor), 8, 32767)
        else:
            knob = _KNOBS[_family(name)][0]
            before = getattr(options, knob)
            step = _a_step(before * factor)
            chosen[knob] = min(step, chosen.get(knob, step))
    return replace(options, **chosen)


def _a_step(wanted: float) -> float:
    """Return the nearest step that the encoder accepts."""
    return min(max(wanted, 1e-6), 1e3)


def _levels(levels: int | None, factor: float) -> int:
    """Return the number of levels for steps that are `factor` times as coarse."""
    count = levels or 1
    scaled = math.ceil(count / factor) if factor < 1.0 else math.floor(count / factor)
    return scaled if scaled != count else count + (1 if factor < 1.0 else 0)


def _family(name: str) -> str:
    return "sh" if name in ("sh1", "sh2", "sh3") else name


def _within(value: float, low: int, high: int) -> int:
    """Clip a value, which may be infinite for bounds near 0, to a range, and round it up."""
    return math.ceil(min(max(value, low), high))

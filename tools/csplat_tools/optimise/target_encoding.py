"""Encode to a target: `encode_to`, and the search for steps within error bounds, which does not render."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

from csplat.encoder import EncodeOptions, EncodeResult, encode_with_report
from csplat.errors import InputError
from csplat.model import SplatModel
from csplat.types import Progress
from csplat_tools.console import parse_size_bytes
from csplat_tools.optimise.candidates import Weights
from csplat_tools.optimise.search_report import Optimised, SearchReport
from csplat_tools.optimise.targets import Target
from csplat_tools.optional_packages import require_renderer
from csplat_tools.scene_files import SceneLike, load_model
from csplat_tools.views import ViewSet, find_view_set

if TYPE_CHECKING:
    from csplat_tools.optimise.pruning_order import SimplifyOptions


def encode_to(
    scene: SceneLike,
    *,
    psnr: float | None = None,
    size: int | str | None = None,
    max_psnr_drop: float | None = None,
    keep: float | None = None,
    errors: Mapping[str, float] | None = None,
    views: ViewSet | None = None,
    options: EncodeOptions | None = None,
    no_prune: bool = False,
    importance: Weights | None = None,
    simplifying: SimplifyOptions | None = None,
    progress: Callable[[str, float], None] | None = None,
) -> Optimised:
    """Encode a scene to a target, as `csplat encode` does if one is given.

    Give one of `psnr`, `size`, `max_psnr_drop` and `keep`, or `errors`, alone or together with one of the first two.
    All but `errors` alone require rendering, which takes minutes, and the packages of the render extra.

    Args:
        scene: a model, or a file in any format.
        psnr: least PSNR of renders against the source's, dB, pooled over the test views; finds the smallest such file.
        size: largest size in bytes, or as text such as "5MB"; finds the file with the best PSNR.
        max_psnr_drop: largest drop of the PSNR against the images of `views` below the source's, dB; finds the
            smallest such file.
        keep: fraction of the splats to keep, above 0, at most 1, at the precision of the preset.
        errors: the largest error of any splat, by measure: `means` in scene units, `covariance` relative,
            `opacities`, `sh0`, `sh1`, `sh2`, `sh3`.
        views: training, validation and test views; `None`: virtual ones around the scene (`find_view_set`).
        options: options of the encoder; those that are set are not changed by the search. The preset "fast" tries no
            codebooks and keeps all splats.
        no_prune: keep all splats unchanged, which takes a sixth of the time.
        importance: importance of the splats, as for the encoder.
        simplifying: options of pruning and refitting; the background is that of the views.
        progress: progress callback; `print` works.

    Returns:
        The file's bytes (`data`), the encoder's result (`result`), and the report of the search (`report`).

    Examples:
        >>> import csplat, csplat_tools
        >>> found = csplat_tools.encode_to(
        ...     "scene.ply", errors={"means": 0.001}, options=csplat.EncodeOptions(preset="fast")
        ... )
        >>> found.report.reached["means"] <= 0.001
        True
        >>> csplat.decode(found.data)
        SplatModel(1000 splats, sh_degree=3)

    Raises:
        InputError: there are no splats, an option is set that the target determines, or the target is out of reach.
        CsplatError: the scene is not valid.
        OSError: the file cannot be read.
    """
    start = time.perf_counter()
    target = Target(
        psnr, parse_size_bytes(size) if isinstance(size, str) else size, max_psnr_drop, keep, dict(errors or {})
    )
    source, encoding = load_model(scene).model, options or EncodeOptions()
    if not target.is_rendered:
        bounded = meet_bounds(source, encoding, target.max_error, importance=importance, progress=progress)
        return _bounded_result(source, target, bounded, start)
    require_renderer()
    from csplat_tools.optimise.target_search import check_target, search_target

    check_target(source, target, encoding, no_prune=no_prune)
    files = 0
    if target.max_error:
        bounded = meet_bounds(source, encoding, target.max_error, importance=importance, progress=progress)
        files, encoding = bounded.encodes, bounded.encoding
    found, report = search_target(
        source, target, views or find_view_set(source), encoding, no_prune=no_prune, importance=importance,
        simplifying=simplifying, progress=progress,
    )  # fmt: skip
    seconds = round(time.perf_counter() - start, 3)
    return Optimised(found.result, replace(report, encodes=files + report.encodes, seconds=seconds))


def _bounded_result(source: SplatModel, target: Target, bounded: BoundedFile, start: float) -> Optimised:
    """Return the result for a target of largest errors alone, without scores."""
    result = bounded.result
    report = SearchReport(
        goal=target.as_json(),
        size_bytes=len(result.data),
        splats=result.report.splat_count,
        splats_before=len(source),
        encodes=bounded.encodes,
        seconds=round(time.perf_counter() - start, 3),
        reached={name: result.report.errors.get(name, (0.0, 0.0))[0] for name in target.max_error},
    )
    return Optimised(result, report)


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


@dataclass(frozen=True, eq=False)
class BoundedFile:
    """A file whose errors are within bounds.

    Attributes:
        encoding: options of the encoder.
        result: the file.
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
) -> BoundedFile:
    """Find steps with which no splat's error exceeds the bounds.

    Args:
        source: the scene.
        encoding: the other options; steps of unbounded measures are kept.
        bounds: largest error by measure.
        importance: importance of the splats, as for the encoder.
        progress: progress callback.

    Returns:
        The file. The largest errors that it declares are within the bounds, and close to them if float32 and the
        lattices allow it.

    Raises:
        InputError: `encoding` sets a step that a bound determines, or no step is fine enough.
    """
    options = _first_options(source, encoding, bounds)
    best: tuple[EncodeOptions, EncodeResult] | None = None
    files = 0
    while True:
        files += 1
        result = encode_with_report(source, options, importance=importance, progress=progress)
        ratios = {name: result.report.errors.get(name, (0.0, 0.0))[0] / bounds[name] for name in bounds}
        if all(ratio <= 1.0 for ratio in ratios.values()):
            if best is None or len(result.data) < len(best[1].data):
                best = options, result
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
            f" {result.report.errors[worst][0]:.3g}"
        )
    return BoundedFile(*best, files)


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
        chosen.update(sh_coding="scalar", adaptive=0.0, sh_degree=encoding.sh_degree or source.sh_degree)
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
    return "sh" if name in ("sh1", "sh2", "sh3") else name


def _clip_levels(value: float, low: int, high: int) -> int:
    """Clip a value to a range, and round it up; it may be infinite for bounds near 0."""
    return math.ceil(min(max(value, low), high))

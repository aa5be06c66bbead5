"""`encode_to`: encode to a target (size, PSNR, loss, ...). The renderer is imported only if it is needed."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import TYPE_CHECKING

from csplat.encoder import EncodeOptions
from csplat.model import SplatModel
from csplat_tools.files.extras import need_renderer
from csplat_tools.files.scenes import SceneLike, load_model
from csplat_tools.files.sizes import parse_size_bytes
from csplat_tools.optimise.bounds import Bounded, Weights, meet_bounds
from csplat_tools.optimise.report import Optimised, Report
from csplat_tools.optimise.target import Target
from csplat_tools.views import ViewSet, find_view_set

if TYPE_CHECKING:
    from csplat_tools.optimise.simplify import SimplifyOptions


def encode_to(
    scene: SceneLike,
    *,
    psnr: float | None = None,
    size: int | str | None = None,
    loss: float | None = None,
    keep: float | None = None,
    errors: Mapping[str, float] | None = None,
    views: ViewSet | None = None,
    options: EncodeOptions | None = None,
    keep_all: bool = False,
    importance: Weights | None = None,
    simplifying: SimplifyOptions | None = None,
    progress: Callable[[str, float], None] | None = None,
) -> Optimised:
    """Encode a scene to a target, as `csplat encode` does if one is given.

    Give one of `psnr`, `size`, `loss` and `keep`, or `errors`, alone or together with one of the first two. All but
    `errors` alone require rendering, which takes minutes, and the packages of the render extra.

    Args:
        scene: a model, or a file in any format.
        psnr: least PSNR of the file's renders against the source's, dB, pooled over the test views; the smallest such
            file is searched.
        size: largest size in bytes, or as text such as "5MB"; the file with the best PSNR within it is searched.
        loss: dB that the PSNR against the photographs of `views` may be below the source's; the smallest such file is
            searched.
        keep: fraction of the splats to keep, above 0, at most 1, at the precision of the preset.
        errors: the largest error of any splat, by measure: `means` in scene units, `covariance` relative,
            `opacities`, `sh0`, `sh1`, `sh2`, `sh3`.
        views: training, validation and test views; `None`: virtual ones around the scene (`find_view_set`).
        options: options that are set here are not chosen. The preset "fast" tries no codebooks and keeps all splats.
        keep_all: keep every splat as it is, which takes a sixth of the time.
        importance: importance of the splats, as for the encoder.
        simplifying: options of pruning and fitting; the background is that of the views.
        progress: called with the stage and the fraction of it that is done, 0 to 1; `print` will do.

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
        InputError: there are no splats, an option is set that the target has to choose, or the target is out of reach.
        CsplatError: the scene is not valid.
        OSError: the file cannot be read.
    """
    start = time.perf_counter()
    target = Target(psnr, parse_size_bytes(size) if isinstance(size, str) else size, loss, keep, dict(errors or {}))
    source, encoding = load_model(scene).model, options or EncodeOptions()
    if not target.is_rendered:
        bounded = meet_bounds(source, encoding, target.max_error, importance=importance, progress=progress)
        return _bounded(source, target, bounded, start)
    need_renderer()
    from csplat_tools.optimise.optimiser import check, optimise

    check(source, target, encoding, keep_all=keep_all)
    files = 0
    if target.max_error:
        bounded = meet_bounds(source, encoding, target.max_error, importance=importance, progress=progress)
        files, encoding = bounded.encodes, bounded.encoding
    found, report = optimise(
        source, target, views or find_view_set(source), encoding, keep_all=keep_all, importance=importance,
        simplifying=simplifying, progress=progress,
    )  # fmt: skip
    seconds = round(time.perf_counter() - start, 3)
    return Optimised(found.result, replace(report, encodes=files + report.encodes, seconds=seconds))


def _bounded(source: SplatModel, target: Target, bounded: Bounded, start: float) -> Optimised:
    """Return the file for a target of largest errors alone, for which nothing was rendered."""
    result = bounded.result
    report = Report(
        goal=target.as_json(),
        size_bytes=len(result.data),
        splats=result.report.splat_count,
        splats_before=len(source),
        encodes=bounded.encodes,
        seconds=round(time.perf_counter() - start, 3),
        reached={name: result.report.errors.get(name, (0.0, 0.0))[0] for name in target.max_error},
    )
    return Optimised(result, report)

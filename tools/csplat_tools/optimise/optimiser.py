"""`encode_to`: the smallest file at a PSNR or a loss, the best one within a size, by every move that files have.

Moves are the precision, from which all steps follow; what is kept of SH and how it is coded; grades; how many splats
stay, the others being fitted to what the source looks like. Every kind of file is brought near the goal by a few tries
and compared by what it would cost on it; what is best there is brought onto it, and the presets' own files are asked
whether they are better. Nothing is tried that is not expected to pay.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from csplat.decoder import decode
from csplat.encoder import EncodeOptions, Importance
from csplat.errors import InputError
from csplat.model import SplatModel
from csplat_render.judge import Judge
from csplat_render.virtual import scene_frame
from csplat_tools.files.console import Progress
from csplat_tools.files.extras import need_renderer
from csplat_tools.files.scenes import SceneLike, load_model
from csplat_tools.optimise.bounds import Bounded, meet_bounds
from csplat_tools.optimise.coding import Codings
from csplat_tools.optimise.goals import goal_of
from csplat_tools.optimise.moves import Moves
from csplat_tools.optimise.removal import Removal
from csplat_tools.optimise.report import Optimised, Report
from csplat_tools.optimise.reporting import reported
from csplat_tools.optimise.sensitivity import measured_for
from csplat_tools.optimise.simplify.options import SimplifyOptions
from csplat_tools.optimise.solving import Solver
from csplat_tools.optimise.target import Target, parse_size_bytes
from csplat_tools.optimise.trials import Trial, Trials, Whole
from csplat_tools.views import VIRTUAL, ViewSet, find_view_set, with_deciders
from csplat_tools.views.timing import picture_seconds

__all__ = ["encode_to", "expected_seconds"]

Weights = NDArray[Any] | Importance
#: What a target costs, in pictures of 640x480, without and with removal: 380 to 690 and 2,800 to 3,900 of plane3,
#: donut, lego60k and fox120k. And how much less and more it may be.
_PICTURES = (520.0, 3400.0)
_SPREAD = (0.6, 1.7)
_INSIDE = (
    "virtual views decided which splats go: cameras inside of surroundings may see more of those than these do;"
    " --data, or --cameras with 40 of them, would decide by yours, --keep-all leaves all"
)


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
    """Encode a scene so that its file keeps to a target: what `csplat encode` calls where one is given.

    One of `psnr`, `size`, `loss` and `keep` is wanted, or `errors`, alone or beside one of the first two. All but
    `errors` alone render pictures, which takes minutes, and want the packages of the render extra.

    Args:
        scene: a model, or a file of either kind.
        psnr: dB of the file's renders against the source's, at least, pooled over the views that judge; the smallest
            such file is looked for.
        size: bytes at most, or text as "5MB"; the best picture within them is looked for.
        loss: dB that the PSNR against the photographs of `views` may be below the source's; the smallest such file.
        keep: share of the splats that stay, above 0, at most 1, at the precision of the preset.
        errors: the largest error of any splat, by measure: `means` in scene units, `covariance` relative,
            `opacities`, `sh0`, `sh1`, `sh2`, `sh3`.
        views: teach, decide and judge; `None`: virtual ones around the scene (`find_view_set`).
        options: knobs that are set here are not chosen. The preset "fast" tries no codebooks and keeps all splats.
        keep_all: every splat stays as it is: a sixth of the time.
        importance: how much splats matter, as for the encoder.
        simplifying: how splats are removed and fitted; its background is that of the views.
        progress: is told the stage and the share of it that is done, 0 to 1.

    Returns:
        The file's bytes (`data`), what the encoder says of it (`result`), and how it was found (`report`).

    Example:
        >>> import csplat, csplat_tools
        >>> found = csplat_tools.encode_to(
        ...     "scene.ply", errors={"means": 0.001}, options=csplat.EncodeOptions(preset="fast")
        ... )
        >>> found.report.reached["means"] <= 0.001
        True
        >>> csplat.decode(found.data)
        SplatModel(1000 splats, sh_degree=3)

    Raises:
        InputError: there are no splats, a knob is set that the target has to choose, or it is out of reach.
        CsplatError: the file is none.
        OSError: it cannot be read.
    """
    start = time.perf_counter()
    target = Target(psnr, parse_size_bytes(size) if isinstance(size, str) else size, loss, keep, dict(errors or {}))
    source, encoding = load_model(scene).model, options or EncodeOptions()
    if target.is_rendered:
        need_renderer()
        _check(source, target, encoding, keep_all=keep_all)
    files = 0
    if target.max_error:
        bounded = meet_bounds(source, encoding, target.max_error, importance=importance, progress=progress)
        if not target.is_rendered:
            return _bounded(source, target, bounded, start)
        files, encoding = bounded.encodes, bounded.encoding
    found, report = _found(
        source, target, views or find_view_set(source), encoding, keep_all=keep_all, importance=importance,
        simplifying=simplifying, progress=progress,
    )  # fmt: skip
    seconds = round(time.perf_counter() - start, 3)
    return Optimised(found.result, replace(report, encodes=files + report.encodes, seconds=seconds))


def _found(
    source: SplatModel,
    target: Target,
    views: ViewSet,
    encoding: EncodeOptions,
    *,
    keep_all: bool,
    importance: Weights | None,
    simplifying: SimplifyOptions | None,
    progress: Progress | None,
) -> tuple[Trial, Report]:
    """Look for the file by its pictures; see `encode_to`. Seconds are not in the report yet."""
    views = with_deciders(views)
    judge = views.judge(source, threads=encoding.threads)
    if views.name != VIRTUAL and _is_empty(judge):
        raise InputError("no splat shows in the views given: are these cameras of this scene?")
    inside = views.virtual and scene_frame(source).kind == "surrounding"
    removal = None
    if not _all_stay(target, encoding, keep_all=keep_all):
        how = replace(simplifying or SimplifyOptions(), background=views.background, threads=encoding.threads)
        left = None if target.keep is None else target.count(len(source))
        removal = Removal(
            source, views, how, grades=not inside, progress=progress, psnr=target.psnr, left=left
        )  # fmt: skip
    photographs = None
    if target.max_loss is not None:
        if not views.photographs:
            raise InputError("a largest loss wants photographs (--data): it is lost against them")
        photographs = views.photograph_decider(threads=encoding.threads)
    decider = views.decider(source, threads=encoding.threads)
    trials, sensitivity_views = Trials(encoding, judge, decider, photographs), 0
    if removal is not None and removal.left is not None:
        found = Moves.kept(trials, removal, removal.left)
    else:
        goal = goal_of(target, source, photographs)
        measured, sensitivity_views = measured_for(
            source, views, encoding, importance, inside=inside, progress=progress
        )
        whole = Whole(source, importance, measured, progress)
        found = Moves(Solver(trials, goal), Codings(source, encoding, measured is not None), whole, removal).best()
    photo = _photographed(source, found, views, encoding.threads) if views.photographs else {}
    report = reported(
        target, found, trials, splats_before=len(source), views_of=views.name,
        remarks=[_INSIDE] * (inside and found.splats < len(source)), encodes=len(trials.made), seconds=0.0,
        photographs=photo, sensitivity_views=sensitivity_views,
        removal_views=0 if removal is None else removal.view_count,
        reached={name: found.result.report.errors.get(name, (0.0, 0.0))[0] for name in target.max_error},
    )  # fmt: skip
    return found, report


def _bounded(source: SplatModel, target: Target, bounded: Bounded, start: float) -> Optimised:
    """The file that keeps to largest errors and to nothing else; nothing is rendered."""
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


def expected_seconds(
    source: SplatModel, encoding: EncodeOptions, target: Target, views: ViewSet, *, keep_all: bool
) -> tuple[float, float]:
    """How long a target takes here, at least and at most, for a person who may choose otherwise.

    By how long the views that judge take now: what is done costs so many pictures of them, whatever the machine.
    """
    pictures = _PICTURES[not _all_stay(target, encoding, keep_all=keep_all)]
    seconds = pictures * picture_seconds(source, views.judges, threads=encoding.threads)
    return seconds * _SPREAD[0], seconds * _SPREAD[1]


def _all_stay(target: Target, encoding: EncodeOptions, *, keep_all: bool) -> bool:
    """Whether no splat is left out: where that is asked, where errors are bounded, and where speed comes first."""
    blocked = keep_all or bool(target.max_error) or encoding.preset == "fast" or encoding.keep_extra
    return target.keep is None and blocked


def _check(source: SplatModel, target: Target, encoding: EncodeOptions, *, keep_all: bool) -> None:
    if not len(source):
        raise InputError("a scene without splats has no size or quality to choose")
    if encoding.attribute_psnr is not None and target.is_rendered and target.keep is None:
        raise InputError("attribute_psnr is what a target chooses: give one of them")
    if target.keep is not None and keep_all:
        raise InputError("a share of the splats is to stay, and all of them: give one of the two")


def _is_empty(judge: Judge) -> bool:
    """Whether all pictures that judge are of one colour each."""
    pictures = (judge.look(number).picture for number in range(len(judge.cameras)))
    return all(np.ptp(picture, axis=(0, 1)).max() == 0.0 for picture in pictures)


def _photographed(source: SplatModel, found: Trial, views: ViewSet, threads: int | None) -> dict[str, float]:
    """PSNR of file and source by the photographs that judge."""
    judge = views.photograph_judge(threads=threads)
    return {"file": judge.psnr(decode(found.result.data)), "source": judge.psnr(source)}

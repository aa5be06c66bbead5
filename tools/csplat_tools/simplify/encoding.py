"""Simplify and encode in one go: remove, adjust, quantise geometry, fit colours to what that left, quantise colours.

What a decoder will see of the geometry is known before its colours are chosen. So they are fitted to that, which mends
part of what quantisation did, and their bands are chosen then.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from csplat.decoder import decode
from csplat.encoder import EncodeOptions, EncodeResult, Importance, encode_with_report
from csplat.encoder.between import Between
from csplat.errors import InputError
from csplat.model import SplatModel
from csplat_render import Camera
from csplat_render.removal import measure_removal
from csplat_tools.rate.search import Window, meet
from csplat_tools.simplify.colours import fit
from csplat_tools.simplify.core import Session, find_judge, most_gone, prepare
from csplat_tools.simplify.judge import Judge, loss_as_psnr
from csplat_tools.simplify.options import SimplifyOptions, Target
from csplat_tools.simplify.sizing import first_count, next_count
from csplat_trainer.sensitivity import measure_sensitivity
from csplat_trainer.sensitivity_file import StoredSensitivity

__all__ = ["SimplifiedFile", "encode_simplified"]

F32 = NDArray[np.float32]
Progress = Callable[[str, float], None]
Encoded = Callable[[EncodeOptions, float], "SimplifiedFile"]

_MARGIN = 1.0  # dB above the target to which splats are removed at first, before what stays is fitted
_ROOM = (2.0, 4.0)  # dB that a fit leaves for quantisation, without and with SH, when a second number is tried
_CAREFUL = 5.0  # dB to which splats are removed the second time, where the first was too many
_QUALITIES = (30.0, 80.0)  # dB, between which the encoder's is looked for
_TRIES = 5
_NEAR = 0.15  # dB above the target that are good enough
_LOSS = (5.0, 12.0)  # dB between what each attribute keeps by itself and what all keep, without and with SH
_BYTES_PER_DB = 0.08  # share of the bytes that a decibel costs, about
_SIZED = (0.97, 1.0, 0.985)  # of the bytes that are wanted: from, to, aimed at
_SIZED_QUALITY = 45.0  # dB, where to begin
_SIZED_ROUNDS = 3
_SIZE_SLOPE = 0.04  # by what the logarithm of the bytes grows with the encoder's quality, per dB
_SAME = 0.04  # of the splats: what differs by less is not worth another fit
_FEWER = 0.7  # of the splats, where a size holds none of their files
_SHORT = 3  # steps of a fit that begins where another one ended


@dataclass(frozen=True, eq=False)
class SimplifiedFile:
    """A file, and what was done for it.

    Attributes:
        result: of the encoder; its source index is into the source.
        report: JSON-compatible.
    """

    result: EncodeResult
    report: dict[str, Any]


def encode_simplified(
    source: SplatModel,
    cameras: Sequence[Camera] | None = None,
    *,
    target: Target,
    encoding: EncodeOptions | None = None,
    options: SimplifyOptions | None = None,
    photographs: tuple[Sequence[Camera], Sequence[F32]] | None = None,
    judged_by: Sequence[Camera] | None = None,
    progress: Progress | None = None,
) -> SimplifiedFile:
    """Simplify a scene and encode it.

    Args:
        source: the scene.
        cameras: as for `simplify`.
        target: `keep`: the encoder's own options decide the rest. `psnr` and `max_loss`: of the file against the
            source or the photographs; number of splats and precision are chosen together, `encoding.quality` is not
            looked at, and the smallest of several files is returned, that of the whole scene among them. `size_bytes`:
            the best of several files within it.
        encoding: of the encoder.
        options: of the simplification.
        photographs: as for `simplify`.
        judged_by: cameras from which a PSNR against the source is taken, instead of those of `simplify`.
        progress: is told the stages.

    Raises:
        InputError: as `simplify` and the encoder; or no file reaches the target.
    """
    encoding, options = encoding or EncodeOptions(), options or SimplifyOptions()
    if not len(source):
        raise InputError("a scene without splats cannot be simplified")
    left = None if target.keep is None else target.count(len(source))
    session = prepare(source, cameras, left, options, progress)
    judge, goal = find_judge(source, cameras, target, options, session, photographs)
    if judged_by is not None:
        judge = Judge.of_source(source, judged_by, options.background, options.threads)
    if left is not None:
        gone = min(len(source) - left, len(session.order.rows))
        return _Candidate(session, gone, judge, progress).encoded(encoding, encoding.quality)
    has_sh = source.sh_degree > 0 and encoding.sh_degree != 0
    if target.size_bytes is not None:
        return _within(session, judge, target.size_bytes, encoding, has_sh=has_sh, progress=progress)
    codings = [encoding.sh_coding]
    if encoding.sh_coding == "auto" and has_sh:
        codings = ["codebook", "scalar"]  # which of them is smaller depends on the PSNR, too
    choices = [replace(encoding, sh_coding=coding) for coding in codings]
    by_source, allowed = judge, goal
    if target.max_loss is not None and photographs is not None:
        # Photographs are missed by far more than what may be lost: room is measured by the source's renders.
        by_source, allowed = session.checked, loss_as_psnr(target.max_loss, goal + target.max_loss)
    quality = min(max(allowed + _LOSS[has_sh], _QUALITIES[0]), _QUALITIES[1])
    found = [_smallest(partial(_plain, source, judge, progress), choices, goal, quality)]
    margin = _MARGIN
    for _ in range(2):
        gone = most_gone(session, by_source, allowed + margin)
        if not gone:
            break
        candidate = _Candidate(session, gone, judge, progress, allowed)
        found.append(_smallest(candidate.encoded, choices, goal, quality))
        spare = by_source.psnr(candidate.fitted) - allowed - _ROOM[has_sh]
        margin = margin - spare if spare > 0.0 else _CAREFUL
    reached = [one for one in found if one is not None]
    if not reached:
        raise InputError(f"no file reaches {goal:.2f} dB: the target is too high for this scene")
    best = min(reached, key=_size)
    tried = [{"splats": one.report["splats"], "size_bytes": _size(one), "psnr": one.report["psnr"]} for one in reached]
    return replace(best, report={**best.report, "goal": goal, "tried": tried})


def _within(
    session: Session, judge: Judge, goal: int, encoding: EncodeOptions, *, has_sh: bool, progress: Progress | None
) -> SimplifiedFile:
    """The best file within a size, of some numbers of splats, each of which says which to try next."""
    splats, order = len(session.source), session.order
    count = max(first_count(goal, splats, has_sh=has_sh), splats - len(order.rows))
    found: list[SimplifiedFile] = []
    quality = _SIZED_QUALITY
    for _ in range(_SIZED_ROUNDS):
        candidate = _Candidate(session, splats - count, judge, progress)
        file = _at_size(candidate.encoded, encoding, goal, quality)
        if file is None:
            after = int(_FEWER * count)
        else:
            found.append(file)
            quality = float(file.report["quality"])
            after = next_count(order, splats, count, float(file.report["psnr"]), judge.psnr(candidate.fitted))
        after = max(1, after, splats - len(order.rows))
        if abs(after - count) <= _SAME * splats:
            break
        quality += math.log(count / after) / _SIZE_SLOPE
        count = after
    if not found:
        raise InputError(f"no file has {goal} bytes or fewer: even few splats take more")
    best = max(found, key=lambda file: float(file.report["psnr"]))
    tried = [{"splats": one.report["splats"], "size_bytes": _size(one), "psnr": one.report["psnr"]} for one in found]
    return replace(best, report={**best.report, "goal_bytes": goal, "tried": tried})


def _at_size(encoded: Encoded, encoding: EncodeOptions, goal: int, quality: float) -> SimplifiedFile | None:
    """The finest of some files within a size; None where the coarsest is too large."""
    found: list[SimplifiedFile] = []

    def measure(place: float) -> float:
        found.append(encoded(encoding, place))
        return _size(found[-1]) / goal

    meet(measure, Window(*_SIZED), start=quality, slope=_SIZE_SLOPE, bounds=_QUALITIES, tries=_TRIES)
    return max((file for file in found if _size(file) <= goal), key=_size, default=None)


def _size(file: SimplifiedFile) -> int:
    return len(file.result.data)


class _Candidate:
    """A number of splats, encoded at several qualities. Owns the colours of the last fit, where the next one begins.

    Attributes:
        fitted: what stays, before anything is quantised.
    """

    def __init__(
        self, session: Session, gone: int, judge: Judge, progress: Progress | None, allowed: float | None = None
    ) -> None:
        self._session, self._judge, self._progress = session, judge, progress
        self._rows = session.pruned(gone)
        self._error = None if allowed is None else 10.0 ** (-allowed / 10.0) * session.views.removal.value_count
        self._pruned = session.source.select(self._rows)
        self._last: SplatModel | None = None
        options = session.options
        self.fitted = fit(
            self._pruned, session.views.used, session.wanted, replace(options, bands=False), progress=progress
        ).model
        self._weights = measure_removal(
            self.fitted, session.views.used, background=options.background, threads=options.threads, progress=progress
        ).squared_weight
        self._importance: Importance | None = None

    def encoded(self, encoding: EncodeOptions, quality: float | None) -> SimplifiedFile:
        """Encode at a quality, the preset's if it is None. The file says how good its renders are."""
        session = self._session
        report: dict[str, Any] = {"splats": len(self._rows), "splats_before": len(session.source), "quality": quality}

        def colours(seen: SplatModel) -> tuple[F32, F32]:
            start, options = seen, replace(session.options, steps=_SHORT)
            if self._last is not None:
                start = replace(seen, sh0=self._last.sh0, shN=self._last.shN)
            fitted = fit(
                start, session.views.used, session.wanted, options, error=self._error, centre=self._pruned,
                fixed=True, progress=self._progress,
            )  # fmt: skip
            self._last = fitted.model
            if fitted.stays is not None:
                report["zero_bands"] = (~fitted.stays).sum(axis=0).tolist()
            report["check_psnr"] = session.checked.psnr(fitted.model)
            return fitted.model.sh0, fitted.model.shN

        def figures(data: bytes) -> dict[str, float]:
            report["psnr"] = self._judge.psnr(decode(data))
            return {"psnr": round(report["psnr"], 3), "check_psnr": round(report["check_psnr"], 3)}

        said = {"splats": len(session.source), "views": len(session.views.used), "method": session.options.method}
        adjusted = session.options.refit and session.options.adjust
        between = Between(len(session.source), self._rows, colours, said, adjusted=adjusted, figures=figures)
        result = encode_with_report(
            self.fitted,
            replace(encoding, quality=quality),
            importance=self._by_shape() if encoding.shape_codebook_size else self._weights,
            between=between,
            progress=self._progress,
        )
        return SimplifiedFile(result, report)

    def _by_shape(self) -> Importance:
        """How much pictures depend on shapes, too."""
        if self._importance is None:
            session, options = self._session, self._session.options
            found = measure_sensitivity(
                self.fitted, session.views.used, background=options.background, threads=options.threads,
                progress=self._progress,
            )  # fmt: skip
            self._importance = replace(StoredSensitivity.of(self.fitted, found).importance(), sh=self._weights)
        return self._importance


def _plain(
    source: SplatModel, judge: Judge, progress: Progress | None, encoding: EncodeOptions, quality: float
) -> SimplifiedFile:
    """The file without simplification."""
    result = encode_with_report(source, replace(encoding, quality=quality), progress=progress)
    report = {"splats": len(source), "splats_before": len(source), "quality": quality}
    return SimplifiedFile(result, {**report, "psnr": judge.psnr(decode(result.data))})


def _smallest(encoded: Encoded, choices: Sequence[EncodeOptions], goal: float, quality: float) -> SimplifiedFile | None:
    """The smallest file that reaches a PSNR, by the choice that is best at a first quality, or else the next best."""
    first = [(choice, encoded(choice, quality)) for choice in choices]

    def cost(one: tuple[EncodeOptions, SimplifiedFile]) -> float:
        return math.log(_size(one[1])) - _BYTES_PER_DB * float(one[1].report["psnr"])

    for choice, file in sorted(first, key=cost):
        best = _at_quality(partial(encoded, choice), file, goal)
        if best is not None:
            return best
    return None


def _at_quality(encoded: Callable[[float], SimplifiedFile], file: SimplifiedFile, goal: float) -> SimplifiedFile | None:
    """The smallest file that reaches a PSNR: false position on the encoder's quality from a first file; or None."""
    low, high = _QUALITIES
    quality: float = file.report["quality"]
    best, points = None, list[tuple[float, float]]()
    for number in range(_TRIES):
        if number:
            quality = high if number == _TRIES - 1 and best is None else min(max(quality, low), high)
            file = encoded(quality)
        reached = file.report["psnr"]
        if reached >= goal:
            high = quality
            if best is None or _size(file) < _size(best):
                best = file
            if reached < goal + _NEAR:
                break
        else:
            low = quality
        points.append((quality, reached))
        quality = _next_quality(points, goal + 0.5 * _NEAR, low, high)
        if high - low < 0.1:
            break
    return best


def _next_quality(points: list[tuple[float, float]], goal: float, low: float, high: float) -> float:
    """Where a straight line through the last two points reaches the goal; a slope of 1 through one."""
    quality, reached = points[-1]
    slope = 1.0
    if len(points) > 1 and points[-2][0] != quality:
        slope = (reached - points[-2][1]) / (quality - points[-2][0])
    step = (goal - reached) / min(max(slope, 0.15), 1.5)
    return min(max(quality + step, low + 0.05 * (high - low)), high - 0.05 * (high - low))

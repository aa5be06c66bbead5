"""Simplify and encode in one go: remove, adjust, quantise geometry, fit colours to what that left, quantise colours.

What a decoder will see of the geometry is known before its colours are chosen. So they are fitted to that, which mends
part of what quantisation did, and their bands are chosen then.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from csplat.decoder import decode
from csplat.encoder import EncodeOptions, encode_with_report
from csplat.errors import InputError
from csplat.model import SplatModel
from csplat_render.judge import Judge
from csplat_tools.rate.search import Window, meet
from csplat_tools.simplify.candidate import Candidate, SimplifiedFile
from csplat_tools.simplify.core import Session, find_decider, most_gone, prepare
from csplat_tools.simplify.options import SimplifyOptions, Target
from csplat_tools.simplify.sizing import count_at_psnr, first_count, next_count
from csplat_tools.views import ViewSet

__all__ = ["SimplifiedFile", "encode_simplified"]

F32 = NDArray[np.float32]
Progress = Callable[[str, float], None]
Encoded = Callable[[EncodeOptions, float], SimplifiedFile]

_MARGIN = 1.0  # dB above the target to which splats are removed at first, before what stays is fitted
_ROUNDS = 3  # numbers of splats that are tried
_MORE = 1.15  # times the splats, where too few were left
_QUALITIES = (30.0, 80.0)  # dB, between which the encoder's is looked for
_TRIES = 5
_NEAR = 0.2  # dB above the target that are good enough
_LOSS = (5.0, 12.0)  # dB between what each attribute keeps by itself and what all keep, without and with SH
_SIZED = (0.97, 1.0, 0.985)  # of the bytes that are wanted: from, to, aimed at
_SIZED_QUALITY = 45.0  # dB, where to begin
_SIZE_SLOPE = 0.04  # by what the logarithm of the bytes grows with the encoder's quality, per dB
_SAME = 0.04  # of the splats: what differs by less is not worth another fit
_FEWER = 0.7  # of the splats, where a size holds none of their files


def encode_simplified(
    source: SplatModel,
    views: ViewSet | None = None,
    *,
    target: Target,
    encoding: EncodeOptions | None = None,
    options: SimplifyOptions | None = None,
    progress: Progress | None = None,
) -> SimplifiedFile:
    """Simplify a scene and encode it.

    Args:
        source: the scene.
        views: as for `simplify`.
        target: `keep`: the encoder's own options decide the rest. `psnr` and `max_loss`: of the file against the
            source or the photographs; number of splats and precision are chosen together, and `attribute_psnr` is not
            looked at; the smallest of several files is returned, that of the whole scene among them. `size_bytes`:
            the best of several files within it.
        encoding: of the encoder.
        options: of the simplification.
        progress: is told the stages.

    Raises:
        InputError: as `simplify` and the encoder; or no file reaches the target.
    """
    encoding, options = encoding or EncodeOptions(), options or SimplifyOptions()
    if not len(source):
        raise InputError("a scene without splats cannot be simplified")
    left = None if target.keep is None else target.count(len(source))
    if target.max_loss is not None and (views is None or not views.photographs):
        raise InputError("a loss against photographs wants photographs: name a data set")
    session = prepare(source, views, left, options, progress)
    judge, goal = find_decider(session, target)
    if left is not None:
        gone = min(len(source) - left, len(session.order.rows))
        return Candidate(session, gone, judge, progress).encoded(encoding, encoding.attribute_psnr)
    has_sh = source.sh_degree > 0 and encoding.sh_degree != 0
    if target.size_bytes is not None:
        return _within(session, judge, target.size_bytes, encoding, has_sh=has_sh, progress=progress)
    codings = [encoding.sh_coding]
    if encoding.sh_coding == "auto" and has_sh:
        codings = ["codebook", "scalar"]  # which of them is smaller depends on the PSNR, too
    choices = [replace(encoding, sh_coding=coding) for coding in codings]
    by_source, allowed, slope = judge, goal, 1.0
    if target.max_loss is not None:
        # Photographs are missed by far more than what may be lost: room is measured by the source's renders. The
        # source's own error is taken as independent of what is lost, so that the two squared errors add up.
        by_source = session.checked
        allowed = goal + target.max_loss - 10.0 * math.log10(10.0 ** (target.max_loss / 10.0) - 1.0)
        slope = 1.0 - 10.0 ** (-target.max_loss / 10.0)  # the share of the error that a file's own makes up
    quality = min(max(allowed + _LOSS[has_sh], _QUALITIES[0]), _QUALITIES[1])
    search = _Search(goal, quality, slope)
    found = [_smallest(partial(_plain, source, judge, progress), choices, search)]
    found += _simplified(session, judge, by_source, allowed, choices, search, progress)
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
    while len(found) < _ROUNDS:
        candidate = Candidate(session, splats - count, judge, progress)
        file = _at_size(candidate.encoded, encoding, goal, quality)
        if file is None:
            after = int(_FEWER * count)
        else:
            found.append(file)
            quality = float(file.report["quality"])
            after = next_count(order, splats, count, float(file.report["psnr"]), judge.psnr(candidate.fitted))
        after = max(1, after, splats - len(order.rows))
        if abs(after - count) <= (_SAME * splats if file is not None else 0):
            break
        quality += math.log(count / after) / _SIZE_SLOPE
        count = after
    if not found:
        raise InputError(f"no file has {goal} bytes or fewer: {count} splats take more")
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


def _plain(
    source: SplatModel, judge: Judge, progress: Progress | None, encoding: EncodeOptions, quality: float
) -> SimplifiedFile:
    """The file without simplification."""
    result = encode_with_report(source, replace(encoding, attribute_psnr=quality), progress=progress)
    report = {"splats": len(source), "splats_before": len(source), "quality": quality}
    return SimplifiedFile(result, {**report, "psnr": judge.psnr(decode(result.data))})


def _simplified(
    session: Session,
    judge: Judge,
    by_source: Judge,
    allowed: float,
    choices: Sequence[EncodeOptions],
    search: _Search,
    progress: Progress | None,
) -> list[SimplifiedFile]:
    """Files that reach a PSNR, of some numbers of splats, each of which says which to try next.

    Args:
        session: order of removal.
        judge, by_source: of files, and of what stays against the source's renders.
        allowed: what `by_source` is to say, dB.
        choices: how SH may be coded; after the first number of splats, only the best.
        search: what `judge` is to say, and where to begin.
        progress: is told the stages.
    """
    splats = len(session.source)
    count = splats - most_gone(session, by_source, allowed + _MARGIN)
    found: list[SimplifiedFile] = []
    for _ in range(_ROUNDS):
        if count >= splats:
            break
        candidate = Candidate(session, splats - count, judge, progress, allowed)
        file = _smallest(candidate.encoded, choices, search)
        after = count_at_psnr(session.order, splats, count, allowed, by_source.psnr(candidate.fitted))
        if file is None:
            after = max(after, int(_MORE * count) + 1)
        else:
            found.append(file)
            search = replace(search, quality=float(file.report["quality"]))
            choices = [one for one in choices if one.sh_coding == file.report["sh_coding"]]
        if abs(after - count) <= _SAME * splats:
            break
        count = after
    return found


@dataclass(frozen=True)
class _Search:
    """A PSNR that is looked for.

    Attributes:
        goal: dB.
        quality: of the encoder, to begin with.
        slope: by what the PSNR grows with the quality, about: little, where a file's own error is little of it.
    """

    goal: float
    quality: float
    slope: float


def _smallest(encoded: Encoded, choices: Sequence[EncodeOptions], search: _Search) -> SimplifiedFile | None:
    """The smallest of some files that reach a PSNR, by the choice that is best there; None where none does."""
    found: list[SimplifiedFile] = []
    for choice in choices:

        def measure(place: float, choice: EncodeOptions = choice) -> float:
            file = encoded(choice, place)
            found.append(replace(file, report={**file.report, "sh_coding": choice.sh_coding}))
            return float(file.report["psnr"])

        goal, near = search.goal, _NEAR * search.slope
        window = Window(goal, goal + near, goal + 0.4 * near)
        meet(measure, window, start=search.quality, slope=search.slope, bounds=_QUALITIES, tries=_TRIES)
    return min((file for file in found if file.report["psnr"] >= search.goal), key=_size, default=None)

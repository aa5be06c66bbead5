"""Judge one input level by level; if one fails, the levels that depend on it are skipped."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

from csplat.decoder import DecodedScene
from csplat_conformance.encoders.ending import judge_end, wrong_habits
from csplat_conformance.encoders.inputs import Input
from csplat_conformance.encoders.judge import judge_content, judge_stream
from csplat_conformance.encoders.matching import Pairs
from csplat_conformance.encoders.picturing import PictureJudge, judge_pictures
from csplat_conformance.encoders.proving import judge_errors
from csplat_conformance.encoders.trial import Trial
from csplat_conformance.encoders.verdict import Verdict, failed
from csplat_conformance.report import Outcome, Status

LEVELS = ("L1", "L2", "L3", "L4")


@dataclass(frozen=True)
class Asked:
    """The checks that are requested of an encoder.

    Attributes:
        levels: levels to report; each depends on the ones before it, which are judged but not reported.
        psnr_min: lowest PSNR that passes L4, dB.
        pictures: judge of L4; `None` if nothing can render.
        no_pictures: why nothing can render.
    """

    levels: tuple[str, ...]
    psnr_min: float
    pictures: PictureJudge | None
    no_pictures: str


def judge_input(one: Input, first: Trial, again: Trial | None, asked: Asked) -> Iterator[Outcome]:
    """Judge what became of an input.

    L4 is judged if it is requested, and if L3 is requested and proves nothing.

    Args:
        one: the input.
        first: the run that is judged.
        again: a second one; `None` if the first wrote no file.
        asked: the checks to make.
    """

    def outcome(level: str, verdict: Verdict, seconds: float = 0.0) -> Outcome:
        facts = (verdict.clauses, verdict.code, verdict.message, seconds, verdict.details)
        return Outcome(one.name, level, verdict.status, *facts)

    for level, verdict in _verdicts(one, first, again, asked):
        if level in asked.levels or (level == "L4" and verdict.status is not Status.SKIPPED):
            yield outcome(level, verdict, first.ended.seconds if level == "L1" else 0.0)


def _verdicts(one: Input, first: Trial, again: Trial | None, asked: Asked) -> Iterator[tuple[str, Verdict]]:
    def skipped(why: str) -> Iterator[tuple[str, Verdict]]:
        return ((level, Verdict(Status.SKIPPED, why)) for level in LEVELS[1:] if not one.must_refuse)

    end = judge_end(one, first)
    if end is not None:
        yield "L1", end
        yield from skipped("no file was written" if end.status in (Status.PASSED, Status.DECLINED) else "L1 failed")
        return
    data = first.out.read_bytes()
    stream, scene = judge_stream(data)
    wrong = wrong_habits(first, again) if stream.status is Status.PASSED else []
    yield "L1", failed(wrong, stream.details) if wrong else stream
    if scene is None or one.source is None:
        yield from skipped("L1 failed")
        return
    content, pairs = judge_content(one, one.source(), scene, first.index)
    yield "L2", content
    errors, alone = judge_errors(one, scene, pairs)
    yield "L3", errors
    yield "L4", _judge_pictures(one, scene, pairs, len(data), alone if "L3" in asked.levels else "", asked)


def _judge_pictures(
    one: Input, scene: DecodedScene, pairs: Pairs, size_bytes: int, alone: str, asked: Asked
) -> Verdict:
    """Judge L4.

    Args:
        one: the input.
        scene: the decoded scene.
        pairs: the source splat of each decoded splat.
        size_bytes: size of the file.
        alone: why nothing but pictures can judge it; nothing if errors are proved.
        asked: the checks to make.
    """
    if not one.renders or one.source is None:
        return Verdict(Status.SKIPPED, "pictures of this scene say nothing")
    if not (alone or "L4" in asked.levels):
        return Verdict(Status.SKIPPED)
    if asked.pictures is not None:
        return judge_pictures(one, one.source(), scene, pairs, size_bytes, asked.pictures, asked.psnr_min)
    if alone:
        return Verdict(Status.FAILED, f"{alone}: only pictures can judge it, and {asked.no_pictures}")
    return Verdict(Status.SKIPPED, asked.no_pictures)

"""From a scene and pictures to a file that was tuned to look like them: the work of `csplat finetune`."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from csplat.decoder import decode
from csplat.encoder import DecodedValues, Draft, EncodeOptions, EncodeResult, Frozen, Origin
from csplat.model import SplatModel
from csplat_render.jit import thread_count
from csplat_render.metrics import Distance
from csplat_tools.files.console import Progress, progress_bar, step_progress
from csplat_tools.files.extras import prepare_renderer
from csplat_tools.files.streams import write_array, write_bytes
from csplat_tools.training.choosing import Chosen, choose_splats, training_views
from csplat_tools.training.report import as_report, judge_models
from csplat_tools.views import ViewSet
from csplat_trainer.outputs import Outputs
from csplat_trainer.tuning import FinetuneOptions, TuningStep, Views, finetune

__all__ = [
    "BYTE_COST",
    "LEARNING_FACTOR",
    "SHAPE_ENTRIES",
    "VIEWS",
    "VIEW_SIZE",
    "Clock",
    "Tuned",
    "TuningPlan",
    "plan_tuning",
    "run_finetuning",
    "tune",
    "usually_aside",
]

I64 = NDArray[np.int64]

#: Of learning rates, by whether the scene's own renders teach instead of photographs. Those can be met almost exactly:
#: what long steps lose of that, short ones take long to find again.
LEARNING_FACTOR = {False: 1.0, True: 0.03}
#: Of bytes in the loss, which is that much smaller.
BYTE_COST = {False: 1e-4, True: 2e-5}
#: What a clustering by sensitivities and a tuning can do with: `encode`, which has neither, makes none by itself.
SHAPE_ENTRIES = 4096
#: Virtual views that teach where there are no photographs, and their size: more and larger than for other commands.
VIEWS, VIEW_SIZE = 480, (320, 240)

_RENDERS_ASIDE = 8  # one of so many renders decides, as well as those that teach,
_MOST_ASIDE = 16  # but no more than these


def usually_aside(count: int, *, cameras: str | None, data: object | None) -> int | None:
    """How many views decide which step was best: of photographs some that teach do, of few virtual views few.

    Args:
        count: virtual views that teach.
        cameras, data: as for `find_view_set`.
    """
    if data is not None:
        return 0
    return min(_MOST_ASIDE, count // _RENDERS_ASIDE) if cameras is None else None


@dataclass
class Clock:
    """Seconds by stage."""

    seconds: dict[str, float] = field(default_factory=dict)

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Time what happens inside."""
        start = time.perf_counter()
        yield
        self.seconds[name] = round(self.seconds.get(name, 0.0) + time.perf_counter() - start, 3)


def run_finetuning(
    source: SplatModel,
    views: ViewSet,
    output: str,
    encoding: EncodeOptions,
    options: FinetuneOptions,
    files: Outputs,
    *,
    keep: float | None = None,
    prune_unseen: bool | None = None,
    importance: str | None = None,
    source_index: str | None = None,
    lpips: Distance | None = None,
    quiet: bool = False,
) -> dict[str, Any]:
    """Prune, freeze, tune, write, judge.

    Args:
        source: the scene.
        views: what the file is to look like.
        output: the file to write, or `-`.
        encoding: of the encoder.
        options: of the tuning.
        files: checkpoints.
        keep, prune_unseen, importance: as for `choose_splats`.
        source_index: a .npy file to write: which splat of the scene each splat of the file is.
        lpips: computes it, if wanted.
        quiet: say nothing that is not wrong.

    Returns:
        The report, JSON-compatible; under `log` options, losses and what each look at the views found.

    Raises:
        CsplatError: an option or a file cannot be used.
        OSError: a file cannot be read or written.
    """
    clock, threads = Clock(), encoding.threads
    with thread_count(threads):
        prepare_renderer(quiet=quiet, gradients=True)
        with progress_bar(quiet=quiet) as progress:
            plan = plan_tuning(
                source, views, encoding, clock, keep=keep, prune_unseen=prune_unseen, importance=importance,
                progress=progress,
            )  # fmt: skip
        with step_progress("tuning", _state, quiet=quiet) as show:
            tuned = tune(plan, options, clock, files, threads=threads, show=show)
        result = tuned.result
        write_bytes(output, result.data)
        if source_index is not None:
            write_array(source_index, result.source_index)
        with clock.stage("judging"):
            models = {"source": source, "before tuning": decode(plan.plain.data), "file": tuned.decoded}
            judged = judge_models(source, models, views, lpips, threads)
    report = as_report(source, plan.plain, result, judged, tuned.log, clock.seconds, plan.chosen.said)
    return {**report, "log": tuned.log}


@dataclass(frozen=True, eq=False)
class TuningPlan:
    """All that is decided before values move.

    Attributes:
        views: that teach, and that decide while values move.
        chosen: the splats that the file will hold.
        frozen: the encoder's decisions.
        plain: the file of the same decisions without tuning.
    """

    views: Views
    chosen: Chosen
    frozen: Frozen
    plain: EncodeResult


@dataclass(frozen=True, eq=False)
class Tuned:
    """A tuned file.

    Attributes:
        result: of the encoder. decoded: what a decoder sees of it, which is what was tuned, bit for bit.
        log: of the tuning.
    """

    result: EncodeResult
    decoded: SplatModel
    log: dict[str, Any]


def plan_tuning(
    source: SplatModel,
    views: ViewSet,
    encoding: EncodeOptions,
    clock: Clock,
    *,
    keep: float | None = None,
    prune_unseen: bool | None = None,
    importance: str | None = None,
    progress: Progress | None = None,
) -> TuningPlan:
    """Choose the splats of the file, and freeze the encoder's decisions.

    Args:
        source: the scene.
        views: what the file is to look like.
        encoding: of the encoder.
        clock: is told the seconds of `choosing` and `encoding`.
        keep, prune_unseen, importance: as for `choose_splats`.
        progress: is told the stages.

    Raises:
        CsplatError: as `choose_splats` and the encoder.
    """
    with clock.stage("choosing"):
        looked = training_views(source, views, encoding.threads)
        chosen = choose_splats(
            source, views, keep=keep, prune_unseen=prune_unseen, importance=importance, threads=encoding.threads,
            progress=progress,
        )  # fmt: skip
    with clock.stage("encoding"):
        draft = Draft.of(
            chosen.model, encoding, importance=chosen.importance, origin=Origin(len(source), chosen.rows),
            graded=False, progress=progress,
        )  # fmt: skip
        frozen = draft.frozen(source, progress)
        plain = frozen.coded(frozen.start()).write()
    return TuningPlan(looked, chosen, frozen, plain)


def tune(
    plan: TuningPlan,
    options: FinetuneOptions,
    clock: Clock,
    files: Outputs | None = None,
    *,
    threads: int | None = None,
    show: Callable[[TuningStep], None] | None = None,
) -> Tuned:
    """Move the values until pictures look right, and encode them.

    Args:
        plan: by `plan_tuning`.
        options: of the tuning.
        clock: is told the seconds of `tuning` and `encoding`.
        files: checkpoints.
        threads: how many; `None` for all.
        show: is told where the run stands.

    Raises:
        CsplatError: as `finetune`.
        RuntimeError: the file is not what was tuned: a fault of csplat.
    """
    frozen, files = plan.frozen, files or Outputs()
    with clock.stage("tuning"):
        tuned = finetune(
            frozen, plan.views, options, progress=show, checkpoint=files.checkpoint,
            checkpoint_every=files.checkpoint_every, resume=files.resume, threads=threads,
        )  # fmt: skip
    with clock.stage("encoding"):
        said = {
            "simplified": {},  # `simplified_from` says it, where splats were taken away
            "views": len(plan.views.train),
            "steps": tuned.log["best_iteration"],
            **plan.chosen.said,
        }
        result = frozen.coded(tuned.held).write({"finetuned": said})
        decoded = decode(result.data)
    _check_identity(frozen.seen(tuned.held), frozen.source_index, result, decoded)
    return Tuned(result, decoded, tuned.log)


def _check_identity(seen: DecodedValues, source_index: I64, result: EncodeResult, decoded: SplatModel) -> None:
    """Raise a `RuntimeError` unless what was tuned is what was written, bit for bit: no file would be better."""
    places = np.empty(int(source_index.max()) + 1, np.int64)
    places[source_index] = np.arange(len(source_index))
    rows = places[result.source_index]
    for name in ("means", "quats", "scales", "opacities", "sh0", "shN"):
        if not np.array_equal(getattr(decoded, name), getattr(seen, name)[rows]):
            raise RuntimeError(f"the file holds other {name} than were tuned: a fault of csplat, please report it")


def _state(now: TuningStep) -> str:
    return (
        f"{now.iteration}/{now.iterations}: loss {now.loss:.4f}, validation {now.validation_psnr:.2f} dB"
        f" (best {now.best_psnr:.2f}), {now.seconds:.0f} s, {now.seconds_left:.0f} s left"
    )

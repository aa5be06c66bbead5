"""From a scene and pictures to a file that was tuned to look like them: the work of `csplat finetune`."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from csplat.decoder import decode
from csplat.encoder import Draft, EncodeOptions, EncodeResult, Frozen, Origin, Seen
from csplat.lint import Finding
from csplat.model import SplatModel
from csplat.ply import read_ply
from csplat_tools.files.console import Progress, note, progress_bar, step_progress
from csplat_tools.files.convert import SceneFacts
from csplat_tools.files.streams import ply_path, write_array, write_bytes
from csplat_tools.training.choosing import Chosen, choose_splats, training_views
from csplat_tools.training.report import as_report, judge_models
from csplat_tools.views import ViewSet

if TYPE_CHECKING:
    from csplat_trainer.finetune import FinetuneOptions, Moment, Views

__all__ = [
    "BYTE_COST",
    "LEARNING_FACTOR",
    "SHAPE_ENTRIES",
    "VIEWS",
    "VIEW_SIZE",
    "Begun",
    "Clock",
    "Files",
    "Scene",
    "Tuned",
    "begin",
    "run_finetuning",
    "tune",
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


@dataclass(frozen=True)
class Files:
    """What is read and written; `None`: not wanted.

    Attributes:
        source: a PLY. output: the file to write.
        importance: weights of the splats, see `choose_splats`.
        source_index: a .npy file: which splat of the PLY as read each splat of the file is.
        log: options, losses and looks as JSON. report: what came of it as JSON.
        checkpoint, checkpoint_every, resume: as for `csplat_trainer.finetune.finetune`.
        lpips: a file of weights, or `auto`.
    """

    source: str
    output: str
    importance: str | None = None
    source_index: str | None = None
    log: str | None = None
    report: str | None = None
    checkpoint: str | None = None
    checkpoint_every: int = 0
    resume: str | None = None
    lpips: str | None = None


@dataclass(frozen=True)
class Scene:
    """How the PLY is read.

    Attributes:
        facts: what it does not say.
        strict: whether what would be repaired is refused.
    """

    facts: SceneFacts
    strict: bool = False


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
    files: Files,
    scene: Scene,
    encoding: EncodeOptions,
    find_views: Callable[[SplatModel], ViewSet],
    options: FinetuneOptions,
    *,
    keep: float | None = None,
    prune_unseen: bool | None = None,
    quiet: bool = False,
) -> dict[str, Any]:
    """Read, prune, freeze, tune, write, judge.

    Args:
        files: what is read and written.
        scene: how the PLY is read.
        encoding: of the encoder.
        find_views: says from where a scene is looked at.
        options: of the tuning.
        keep, prune_unseen: as for `choose_splats`.
        quiet: say nothing that is not wrong.

    Returns:
        The report, JSON-compatible.

    Raises:
        CsplatError: a file or an option cannot be used.
        OSError: a file cannot be read or written.
    """
    from csplat_render.jit import thread_count
    from csplat_render.lpips import load_lpips
    from csplat_render.warmup import warm_up
    from csplat_trainer.report import write_log

    clock, threads = Clock(), encoding.threads
    distance = None if files.lpips is None else load_lpips(None if files.lpips == "auto" else files.lpips)
    with clock.stage("reading"):
        source = _read(files.source, scene, encoding, quiet=quiet)
        views = find_views(source)
        views.read()
        for line in () if quiet else views.notes:
            note(line)
    with thread_count(threads):
        warm_up(None if quiet else note)
        with progress_bar(quiet=quiet) as progress:
            begun = begin(
                source, views, encoding, clock, keep=keep, prune_unseen=prune_unseen, importance=files.importance,
                progress=progress,
            )  # fmt: skip
        shown = step_progress("tuning", _state, iterations=options.iterations, log_every=options.log_every, quiet=quiet)
        with shown as show:
            tuned = tune(
                begun, options, clock, checkpoint=files.checkpoint, checkpoint_every=files.checkpoint_every,
                resume=files.resume, threads=threads, show=show,
            )  # fmt: skip
        result, plain = tuned.result, begun.plain
        write_bytes(files.output, result.data)
        if files.source_index is not None:
            write_array(files.source_index, result.source_index)
        with clock.stage("judging"):
            models = {"source": source, "before tuning": decode(plain.data), "file": tuned.decoded}
            judged = judge_models(source, models, views, distance, threads)
    report = as_report(source, plain, result, judged, tuned.log, clock.seconds, begun.chosen.said)
    if files.log is not None:
        write_log(files.log, {**tuned.log, "encoding": result.report.options, "seconds_by_stage": clock.seconds})
    if files.report is not None:
        write_log(files.report, report)
    return report


@dataclass(frozen=True, eq=False)
class Begun:
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


def begin(
    source: SplatModel,
    views: ViewSet,
    encoding: EncodeOptions,
    clock: Clock,
    *,
    keep: float | None = None,
    prune_unseen: bool | None = None,
    importance: str | None = None,
    progress: Progress | None = None,
) -> Begun:
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
    return Begun(looked, chosen, frozen, plain)


def tune(
    begun: Begun,
    options: FinetuneOptions,
    clock: Clock,
    *,
    checkpoint: str | None = None,
    checkpoint_every: int = 0,
    resume: str | None = None,
    threads: int | None = None,
    show: Callable[[Moment], None] | None = None,
) -> Tuned:
    """Move the values until pictures look right, and encode them.

    Args:
        begun: by `begin`.
        options: of the tuning.
        clock: is told the seconds of `tuning` and `encoding`.
        checkpoint, checkpoint_every, resume: as for `csplat_trainer.finetune.finetune`.
        threads: how many; `None` for all.
        show: is told where the run stands.

    Raises:
        CsplatError: as `finetune`.
        RuntimeError: the file is not what was tuned: a fault of csplat.
    """
    from csplat_trainer.finetune import finetune

    frozen = begun.frozen
    with clock.stage("tuning"):
        tuned = finetune(
            frozen, begun.views, options, progress=show, checkpoint=checkpoint, checkpoint_every=checkpoint_every,
            resume=resume, threads=threads,
        )  # fmt: skip
    with clock.stage("encoding"):
        said = {
            "simplified": {},  # `simplified_from` says it, where splats were taken away
            "views": len(begun.views.train),
            "steps": tuned.log["best_iteration"],
            **begun.chosen.said,
        }
        result = frozen.coded(tuned.held).write({"finetuned": said})
        decoded = decode(result.data)
    _check_identity(frozen.seen(tuned.held), frozen.source_index, result, decoded)
    return Tuned(result, decoded, tuned.log)


def _read(path: str, scene: Scene, encoding: EncodeOptions, *, quiet: bool) -> SplatModel:
    findings: list[Finding] = []
    with ply_path(path) as local:
        model = read_ply(local, strict=scene.strict, keep_extra=encoding.keep_extra, report=findings)
    for finding in findings:
        if not quiet or finding.kind == "repair":
            note(str(finding))
    return scene.facts.applied(model)


def _check_identity(seen: Seen, source_index: I64, result: EncodeResult, decoded: SplatModel) -> None:
    """Raise a `RuntimeError` unless what was tuned is what was written, bit for bit: no file would be better."""
    places = np.empty(int(source_index.max()) + 1, np.int64)
    places[source_index] = np.arange(len(source_index))
    rows = places[result.source_index]
    for name in ("means", "quats", "scales", "opacities", "sh0", "shN"):
        if not np.array_equal(getattr(decoded, name), getattr(seen, name)[rows]):
            raise RuntimeError(f"the file holds other {name} than were tuned: a fault of csplat, please report it")


def _state(now: Moment) -> str:
    return (
        f"{now.iteration}/{now.iterations}: loss {now.loss:.4f}, validation {now.validation_psnr:.2f} dB"
        f" (best {now.best_psnr:.2f}), {now.seconds:.0f} s, {now.seconds_left:.0f} s left"
    )

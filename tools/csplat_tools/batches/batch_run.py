"""Run one command on many scenes, on this machine or on a cluster; a scene that fails does not stop the others."""

from __future__ import annotations

import os
import queue
import threading
from asyncio import CancelledError
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing, contextmanager, nullcontext, suppress
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, TypeVar
from uuid import uuid4

from csplat.disk_files import resolve_links
from csplat.errors import InputError, LimitError, missing_package
from csplat.remote_store import is_url
from csplat.system import available_memory_bytes, core_count
from csplat_tools.batches.batch_page import PAGE, write_batch_page
from csplat_tools.batches.batch_scenes import Task, find_tasks
from csplat_tools.batches.journal import JOURNAL, Journal, Record, open_journal, read_journal
from csplat_tools.batches.scene_job import (
    RENDERER_BYTES,
    CommandLineError,
    PlannedJob,
    SceneJob,
    Worker,
    WorkerLostError,
    plan_job,
    run_job,
)
from csplat_tools.scene_files import size_on_disk

_SET_BY_BATCH = ("threads", "memory", "resume")  # options that the batch passes to commands that have them
_FREE_SHARE = 0.9  # fraction of the free memory that a batch uses if `memory_bytes` is not given


@dataclass(frozen=True)
class BatchStep:
    """The progress of a batch.

    Attributes:
        iteration, iterations: number of finished scenes, and of all scenes.
        failed: number of scenes that failed so far.
        share: fraction done, 0 to 1, by the sizes of the sources, without those done by an earlier run.
        record: record of the scene that finished last.
    """

    iteration: int
    iterations: int
    failed: int
    share: float
    record: Record


@dataclass(frozen=True)
class Batch:
    """The outcome of a batch.

    Attributes:
        folder: the folder of outputs.
        records: records of all scenes, in their order.
        done_before: outputs that an earlier run made from the same files with the same command.
    """

    folder: Path
    records: tuple[Record, ...]
    done_before: frozenset[str]

    @property
    def failures(self) -> list[Record]:
        """The scenes that failed."""
        return [one for one in self.records if one.state == "failed"]

    def as_json(self) -> dict[str, Any]:
        """Return totals and records as JSON-compatible values."""
        return {
            "scenes": len(self.records),
            "done": len(self.records) - len(self.failures) - len(self.done_before),
            "done_before": len(self.done_before),
            "failed": len(self.failures),
            "records": [one.as_json() for one in self.records],
        }


def batch(
    scenes: str | os.PathLike[str],
    folder: str | os.PathLike[str],
    command: Sequence[str] = ("encode",),
    *,
    ending: str | None = None,
    match: str = "*",
    workers: int | None = None,
    memory_bytes: int | None = None,
    dask: Any = None,
    force: bool = False,
    thumbnails: bool = True,
    progress: Callable[[BatchStep], object] | None = None,
) -> Batch:
    """Run one command on many scenes, as `csplat batch` does.

    A scene is skipped if its content, the command with its options and the version of the program equal those in
    `batch.jsonl`, and the output is unchanged. Failed scenes are tried again.

    Args:
        scenes: a folder, with its subfolders; or a manifest, see `find_tasks`.
        folder: the folder for outputs, `batch.jsonl` and `index.html`; it is made if missing.
        command: a command that takes a scene and an output, with its options.
        ending: file name ending of the outputs; `None`: that of the command.
        match: shell pattern of names within a folder, such as `*.ply`.
        workers: number of processes at a time; `None`: one per core.
        memory_bytes: memory of all processes together, by the expected need of each scene. A scene that needs more
            fails, or gets this limit by `--memory` if the command has that option. `None`: most of the free memory; a
            scene that needs more runs alone.
        dask: a cluster: the address of its scheduler, or a `dask.distributed.Client`. Its machines must see the same
            files; `workers` and `memory_bytes` are ignored.
        force: outputs that were not written by a batch may be replaced.
        thumbnails: draw a small render of each scene if the extra `render` is installed.
        progress: called with a `BatchStep` for each finished scene.

    Returns:
        A record for each scene, including failed ones.

    Examples:
        >>> import csplat_tools
        >>> found = csplat_tools.batch("scenes", "encoded", ["encode", "--preset", "small"])  # doctest: +SKIP
        >>> [(one.path, one.error) for one in found.failures]  # doctest: +SKIP

    Raises:
        InputError: there are no scenes, a manifest is invalid, or another batch uses the folder.
        OSError: the folder cannot be written.
    """
    target = Path(folder)
    with closing(Worker()) as first:
        tasks, options = _prepared(first, scenes, target, command, ending, match)
        count = min(workers or core_count(), len(tasks))
        threads = max(1, core_count() // count) if "threads" in options and dask is None else None
        resumes = "resume" in options
        resolve_links(target).mkdir(parents=True, exist_ok=True)
        with open_journal(target) as journal:
            jobs = [
                replace(one, force=force, threads=threads, resumes=resumes, thumbnail=thumbnails)
                for one in _jobs(tasks, command, target, journal.records, journal.pending)
            ]
            journal.begin([one.task.output for one in jobs if _may_begin(one)])
            if dask is None:
                budget = MemoryBudget(
                    memory_bytes, int(_FREE_SHARE * available_memory_bytes()), has_option="memory" in options
                )
                work = partial(run_job, gate=budget.gate)
                ended = run_jobs(jobs, [first, *(Worker() for _ in range(count - 1))], work, budget.stop)
            else:
                ended = run_on_cluster(jobs, dask)
            before = _record_all(ended, jobs, journal, progress)
            journal.end()
            result = Batch(target, tuple(journal.records[one.output] for one in tasks), before)
            write_batch_page(result.records, target)
    return result


def plan_batch(
    scenes: str | os.PathLike[str],
    folder: str | os.PathLike[str],
    command: Sequence[str] = ("encode",),
    *,
    ending: str | None = None,
    match: str = "*",
    workers: int | None = None,
) -> list[PlannedJob]:
    """Return the work that `batch` would do for each scene, with expected time and memory; nothing is written.

    Raises:
        InputError, OSError: as for `batch`.
    """
    target = Path(folder)
    with closing(Worker()) as first:
        tasks, _ = _prepared(first, scenes, target, command, ending, match)
        jobs = _jobs(tasks, command, target, *read_journal(target))
        others = [Worker() for _ in range(min(workers or core_count(), len(jobs)) - 1)]
        with closing(run_jobs(jobs, [first, *others], plan_job)) as planned:
            found = {one.job.task.output: one for one in planned}
    return [found[one.output] for one in tasks]


def _prepared(
    worker: Worker,
    scenes: str | os.PathLike[str],
    folder: Path,
    command: Sequence[str],
    ending: str | None,
    match: str,
) -> tuple[list[Task], frozenset[str]]:
    """Find the scenes and check their command lines; return them with the command's options that the batch sets."""
    answer = _checked(worker, command)
    own_ending = answer["ending"] if ending is None else ending
    if not own_ending and ending is None:
        raise CommandLineError(f"csplat {command[0]} writes several formats: choose one with --ending, such as .spz")
    tasks = find_tasks(os.fspath(scenes), command[0], own_ending, match=match, without=folder)
    taken = {JOURNAL, PAGE} & {one.output for one in tasks}
    if taken:
        raise InputError(f"{taken.pop()} is written by the batch itself: give the scene another output in a manifest")
    has = set(_SET_BY_BATCH) & set(answer["options"])
    for options in {one.options for one in tasks if one.options}:
        has &= set(_checked(worker, (*command, *options))["options"])
    return tasks, frozenset(has)


def _checked(worker: Worker, words: Sequence[str]) -> Mapping[str, Any]:
    if not words:
        raise CommandLineError("expected a command after --, such as encode")
    try:
        answer = worker.ask("check", words=list(words))
    except WorkerLostError as error:
        raise InputError(f"no process could be started: {error}") from None
    if answer["wrong"]:
        raise CommandLineError(answer["wrong"])
    return answer


def _jobs(
    tasks: Sequence[Task], command: Sequence[str], folder: Path, records: Mapping[str, Record], pending: set[str]
) -> list[SceneJob]:
    place = str(resolve_links(folder))
    return [SceneJob(one, tuple(command), place, records.get(one.output), one.output in pending) for one in tasks]


def _may_begin(job: SceneJob) -> bool:
    """Return True if a file that appears as the output from now on belongs to this batch."""
    output = job.task.output
    known = job.pending or (job.earlier is not None and job.earlier.output_sha256)
    return not is_url(output) and bool(known or not (Path(job.folder) / output).exists())


def _record_all(
    ended: Generator[tuple[Record, bool], None, None],
    jobs: Sequence[SceneJob],
    journal: Journal,
    progress: Callable[[BatchStep], object] | None,
) -> frozenset[str]:
    """Write a line for each finished scene; return the outputs that were done before."""
    before = set()
    with closing(ended):
        for step, worked in _steps(ended, jobs):
            if worked:
                journal.add(step.record)
            else:
                before.add(step.record.output)
                journal.records[step.record.output] = step.record
            if progress is not None:
                progress(step)
    return frozenset(before)


def _steps(ended: Iterable[tuple[Record, bool]], jobs: Sequence[SceneJob]) -> Iterator[tuple[BatchStep, bool]]:
    """Yield the progress after each scene, and True unless it was done before."""
    sizes = {one.task.output: 1.0 + job_bytes(one) for one in jobs}
    whole, done, failed = sum(sizes.values()), 0.0, 0
    for number, (record, worked) in enumerate(ended, 1):
        if worked:
            done += sizes[record.output]
        else:
            whole -= sizes[record.output]
        failed += record.state == "failed"
        yield BatchStep(number, len(jobs), failed, done / whole if whole > 0.0 else 1.0, record), worked


T = TypeVar("T")


def run_jobs(
    jobs: Sequence[SceneJob],
    workers: Sequence[Worker],
    do: Callable[[SceneJob, Worker], T],
    stop: Callable[[], object] = lambda: None,
) -> Generator[T, None, None]:
    """Process jobs, the largest first, and yield the results; closing the generator ends the processes.

    Args:
        jobs: the scenes.
        workers: the processes; each has a thread of this process.
        do: called in a thread with a scene and the thread's process.
        stop: called when the generator ends.
    """
    todo: queue.SimpleQueue[SceneJob | None] = queue.SimpleQueue()
    ended: queue.SimpleQueue[T | Exception] = queue.SimpleQueue()
    for job in (*sorted(jobs, key=job_bytes, reverse=True), *[None] * len(workers)):
        todo.put(job)
    stopped = threading.Event()

    def work(worker: Worker) -> None:
        while (job := todo.get()) is not None and not stopped.is_set():
            try:
                ended.put(do(job, worker))
            except Exception as error:  # noqa: BLE001  # a defect of csplat; raised again by the generator
                ended.put(error)

    with ThreadPoolExecutor(len(workers)) as pool:
        try:
            for worker in workers:
                pool.submit(work, worker)
            for _ in jobs:
                one = ended.get()
                if isinstance(one, Exception):
                    raise one
                yield one
        finally:
            stopped.set()
            stop()
            ends = [threading.Thread(target=one.close) for one in workers]
            for thread in ends:
                thread.start()
            for thread in ends:
                thread.join()


def job_bytes(job: SceneJob) -> int:
    """Return the size of a source in bytes; 0 if it is a URL or cannot be read."""
    with suppress(OSError):
        return 0 if is_url(job.task.source) else size_on_disk(Path(job.task.source))
    return 0


class MemoryBudget:
    """Lets a scene begin when there is memory for it. Owns the number of bytes left.

    Args:
        allowed: the user's limit in bytes; `None`: not specified.
        free: limit if `allowed` is `None`; `None`: no limit.
        has_option: the command has `--memory`, and so can work with less than it would need.
    """

    def __init__(self, allowed: int | None, free: int | None = None, *, has_option: bool = False) -> None:
        self._allowed, self._has_option = allowed, has_option
        self._total = allowed if allowed is not None else free
        self._left = self._total or 0
        self._changed = threading.Condition()
        self._stopped = False

    @contextmanager
    def gate(self, need: int) -> Iterator[tuple[str, ...]]:
        """Wait for memory, reserve it, and release it at the end.

        Args:
            need: bytes to reserve.

        Yields:
            Options for the command.

        Raises:
            LimitError: the scene needs more than the user's limit.
        """
        if self._total is None:
            yield ()
            return
        too_much = self._allowed is not None and need > self._allowed
        if too_much and not self._has_option:
            raise LimitError("--memory", need, self._allowed)
        taken = min(need, self._total)
        with self._changed:
            self._changed.wait_for(lambda: self._stopped or taken <= self._left)
            self._left -= taken
        try:
            yield ("--memory", str(max(1, self._total - RENDERER_BYTES))) if too_much else ()
        finally:
            with self._changed:
                self._left += taken
                self._changed.notify_all()

    def stop(self) -> None:
        """Release all waiting threads, so that they can end."""
        with self._changed:
            self._stopped = True
            self._changed.notify_all()


_thread_state = threading.local()  # the process of each thread of a Dask worker


def run_on_cluster(jobs: Sequence[SceneJob], dask: Any) -> Generator[tuple[Record, bool], None, None]:
    """Process scenes on a cluster, and yield the results of `run_job`.

    Dask moves the scenes of a lost machine to others, a limited number of times.

    Args:
        jobs: scenes, with paths that are valid on all machines.
        dask: the address of a scheduler, or a client.

    Raises:
        InputError: Dask is not installed.
        OSError: there is no scheduler.
    """
    try:
        import distributed
    except ModuleNotFoundError as error:
        raise missing_package(error, "dask[distributed]", extra="scale") from None
    dasks: Any = distributed  # the package has no types
    with dasks.Client(dask, set_as_default=False) if isinstance(dask, str) else nullcontext(dask) as client:
        run = uuid4().hex  # Dask identifies tasks by key, which must differ from those of an earlier batch
        tasks = {client.submit(_run_on_dask, job, key=f"{job.task.output}-{run}"): job for job in jobs}
        try:
            for future in dasks.as_completed(list(tasks), loop=client.loop):
                yield _dask_result(future, tasks[future])
        finally:
            client.cancel(list(tasks))


def _run_on_dask(job: SceneJob) -> tuple[Record, bool]:
    if not hasattr(_thread_state, "worker"):
        _thread_state.worker = Worker()
    return run_job(job, _thread_state.worker)


def _dask_result(future: Any, job: SceneJob) -> tuple[Record, bool]:
    try:
        record, worked = future.result()
    except CommandLineError:
        raise
    except (Exception, CancelledError) as error:  # noqa: BLE001  # any error of a task that the cluster gave up
        words = " ".join(str(error).split()) or type(error).__name__
        return replace(job.record, code="E_CLUSTER", error=words), True
    return record, worked

"""Process one scene, here or on a machine of a cluster: inspect it, run the command unless done before, record it."""

from __future__ import annotations

import errno
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, closing, contextmanager, nullcontext
from dataclasses import dataclass, replace
from pathlib import Path, PurePosixPath
from tempfile import TemporaryDirectory
from typing import Any

from csplat import __version__
from csplat.errors import CsplatError, StoreError, missing
from csplat.remote import is_url, store_of
from csplat_tools.batches.finding import Task
from csplat_tools.batches.looking import Look, content_hash, expect
from csplat_tools.batches.records import Record
from csplat_tools.batches.workers import Worker, WorkerLostError, remove_left
from csplat_tools.files.scenes import size_of

THUMBNAILS = "thumbnails"
_PART_BYTES = 16 << 20


@dataclass(frozen=True)
class Job:
    """A scene to be processed.

    Attributes:
        task: the scene.
        command: the command with the options of all scenes, as words.
        folder: the folder of outputs, absolute.
        earlier: the record of an earlier run; `None`: there is none.
        pending: the output may have been left by a run that did not end by itself.
        force: an existing output may be replaced, whoever wrote it.
        threads: number of threads for the command; `None`: it has no such option.
        resumes: the command has `--resume`, with which it goes on from a folder OUT.work that was left.
        thumbnail: draw a small render, too.
    """

    task: Task
    command: tuple[str, ...]
    folder: str
    earlier: Record | None = None
    pending: bool = False
    force: bool = False
    threads: int | None = None
    resumes: bool = False
    thumbnail: bool = False

    @property
    def words(self) -> tuple[str, ...]:
        """The command with all options."""
        return (*self.command, *self.task.options)

    @property
    def record(self) -> Record:
        """The record of a failed scene; results are filled in when they are known."""
        before = "" if self.earlier is None else self.earlier.output_sha256
        return Record(self.task.source, self.task.output, self.words, __version__, "failed", output_sha256=before)


@dataclass(frozen=True)
class Planned:
    """The work that a batch would do for a scene.

    Attributes:
        job: the scene.
        look: the scene's file; `None`: it cannot be read.
        is_done: the output is there already, and nothing would be done.
        seconds: expected time; `None`: nothing is known of the command.
        memory_bytes: expected peak memory.
    """

    job: Job
    look: Look | None
    is_done: bool
    seconds: float | None
    memory_bytes: int


#: Reserves memory while a scene's command runs: called with a number of bytes, it yields options for the command.
Gate = Callable[[int], AbstractContextManager[tuple[str, ...]]]


def plan_job(job: Job, worker: Worker) -> Planned:
    """Inspect a scene and return what would be done, without doing it."""
    try:
        with _here(job.task.source) as source:
            found = _looked(worker, source)
            assert isinstance(found, Look)
    except (CsplatError, OSError):
        return Planned(job, None, False, 0.0, 0)
    expected = expect(job.command[0], found)
    return Planned(job, found, _is_done(job, found), expected.seconds, expected.memory_bytes)


def do_job(job: Job, worker: Worker, gate: Gate | None = None) -> tuple[Record, bool]:
    """Process a scene, unless its output is there already.

    Args:
        job: the scene.
        worker: the process that runs the command.
        gate: waits for memory; `None`: there is enough.

    Returns:
        The record of the scene, and whether anything was done.
    """
    record = job.record
    try:
        with _here(job.task.source) as source:
            found = _looked(worker, source)
            record = replace(record, sha256=found.sha256, source_bytes=found.size_bytes, splats=found.splats)
            if _is_done(job, found):
                assert job.earlier is not None
                return replace(job.earlier, path=job.task.source), False
            with (gate or _no_gate)(expect(job.command[0], found).memory_bytes) as options, _placed(job) as output:
                return _ran(job, record, worker, source, output, options), True
    except CsplatError as error:
        return replace(record, code=error.code, error=" ".join(str(error).split())), True
    except OSError as error:
        return replace(
            record, code=errno.errorcode.get(error.errno or 0, "E_OS"), error=" ".join(str(error).split())
        ), True


class SceneError(CsplatError):
    """Nothing can be done with a scene: a file cannot be fetched, read or replaced."""

    def __init__(self, message: str, code: str) -> None:
        super().__init__(message)
        self.code = code


def _ran(job: Job, record: Record, worker: Worker, source: Path, output: Path, options: tuple[str, ...]) -> Record:
    """Run the command, and return the record with its results."""
    output.parent.mkdir(parents=True, exist_ok=True)
    if output.exists() and not is_url(job.task.output) and not job.force and not _is_ours(job, output):
        raise SceneError(f"{job.task.output} is there already, and not by this batch: --force replaces it", "E_INPUT")
    threads = () if job.threads is None or "--threads" in job.words else ("--threads", str(job.threads))
    resume = ("--resume",) if job.resumes and output.with_name(f"{output.name}.work").is_dir() else ()
    words = (job.command[0], str(source), str(output), *job.words[1:], *threads, *options, *resume)
    picture = str(Path(job.folder) / THUMBNAILS / f"{job.task.output}.jpg")
    try:
        said = worker.ask(
            "run", words=[*words, "--json", "--quiet", "--force"],
            thumbnail=picture if job.thumbnail and not is_url(job.task.output) else "",
            scenes=[str(output), str(source)],
        )  # fmt: skip
    except WorkerLostError:
        if worker.pid is not None:
            remove_left(output, worker.pid)
        raise
    record = replace(
        record, seconds=round(said["seconds"], 3), memory_bytes=said["memory_bytes"], remarks=tuple(said["remarks"])
    )
    if said["status"]:
        shown = said["error"].replace(str(source), job.task.source).replace(str(output), job.task.output)
        shown = shown.removeprefix(f"{job.task.source}: ")
        return replace(record, code=said["code"], error=shown)
    return replace(
        record, state="done", output_bytes=size_of(output), output_sha256=content_hash(output),
        splats=_count(said["result"], record.splats),
    )  # fmt: skip


def _count(result: Any, before: int | None) -> int | None:
    count = result.get("splats") if isinstance(result, dict) else None
    return count if isinstance(count, int) else before


def _looked(worker: Worker, source: Path) -> Look:
    found = worker.ask("look", path=str(source))
    if "error" in found:
        raise SceneError(found["error"], found["code"])
    return Look(**found)


def _is_done(job: Job, found: Look) -> bool:
    """Return True if the command's output is there already, unchanged."""
    earlier = job.earlier
    if earlier is None or earlier.state != "done" or earlier.key != (found.sha256, job.words, __version__):
        return False
    if is_url(job.task.output):
        return True  # checking the file there would mean to download it
    return _is_ours(replace(job, pending=False), Path(job.folder) / job.task.output)


def _is_ours(job: Job, output: Path) -> bool:
    """Return True if a batch wrote the output that is there, or may have written it."""
    if job.pending:
        return True
    known = job.earlier.output_sha256 if job.earlier is not None else ""
    if not known or not output.exists():
        return False
    if job.earlier is not None and job.earlier.output_bytes not in (None, size_of(output)):
        return False
    return content_hash(output) == known


@contextmanager
def _here(source: str) -> Iterator[Path]:
    """Yield the path of a scene on this machine; a URL is downloaded for that time.

    Raises:
        CsplatError, OSError: the scene cannot be downloaded.
    """
    if not is_url(source):
        yield Path(source)
        return
    with TemporaryDirectory(prefix="csplat-") as folder:
        local = Path(folder) / (PurePosixPath(source.partition("?")[0]).name or "scene")
        with closing(store_of(source)) as store, local.open("wb") as copy:
            for start in range(0, store.size, _PART_BYTES):
                copy.writelines(store.read([(start, min(start + _PART_BYTES, store.size))]))
        yield local


@contextmanager
def _placed(job: Job) -> Iterator[Path]:
    """Yield the path that the command is to write; if the output is a URL, the file is sent there at the end."""
    if not is_url(job.task.output):
        yield Path(job.folder) / job.task.output
        return
    with TemporaryDirectory(prefix="csplat-") as folder:
        local = Path(folder) / PurePosixPath(job.task.output).name
        yield local
        if local.exists():
            _send(local, job.task.output)


def _send(local: Path, url: str) -> None:
    try:
        from fsspec.core import url_to_fs
    except ModuleNotFoundError as error:
        raise missing(error, extra="remote") from None
    try:
        files, place = url_to_fs(url)
        files.put(str(local), place)
    except Exception as error:  # noqa: BLE001  # each kind of store raises its own
        name = PurePosixPath(url.partition("?")[0]).name  # the rest may hold what is secret
        raise StoreError(f"{name} could not be sent: {type(error).__name__}") from None


def _no_gate(memory_bytes: int) -> AbstractContextManager[tuple[str, ...]]:  # noqa: ARG001  # as gates have it
    return nullcontext(())

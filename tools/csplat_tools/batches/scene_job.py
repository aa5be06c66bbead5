"""Process one scene of a batch, on this machine or a cluster: inspect it, run the command in a worker, record it.

A worker is a process, so that a crash of a command leaves the rest of the batch running.
"""

from __future__ import annotations

import errno
import hashlib
import json
import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, closing, contextmanager, nullcontext, suppress
from dataclasses import asdict, dataclass, replace
from pathlib import Path, PurePosixPath
from typing import Any
from urllib.parse import unquote

from csplat import __version__
from csplat.disk_files import parse_json, path_inside, remove_unfinished, temporary_file, temporary_folder
from csplat.encoder import EncodeOptions
from csplat.errors import CsplatError, InputError, StoreError, counted, missing_package
from csplat.file_source import open_binary, read_bytes
from csplat.formats import detect_format, open_scene
from csplat.out_of_core import OutOfCoreOptions, estimate_cost
from csplat.remote_store import is_url, open_store
from csplat.system import NEW_GROUP_FLAGS, interrupt_process
from csplat_tools.batches.batch_scenes import Task
from csplat_tools.batches.journal import Record
from csplat_tools.console import format_bytes, format_estimate, format_seconds, format_table
from csplat_tools.scene_files import FOLDER_NAMES, size_on_disk

THUMBNAILS = "thumbnails"
_PART_BYTES = 16 << 20
_STATUS_USAGE = 2  # status of a wrong command line


@dataclass(frozen=True)
class SceneJob:
    """A scene to be processed.

    Attributes:
        task: the scene.
        command: the command with the options of all scenes, as words.
        folder: the folder of outputs, absolute.
        earlier: the record of an earlier run, if any.
        pending: an interrupted run may have written the output.
        force: any existing output may be replaced.
        threads: number of threads for the command; `None`: it has no such option.
        resumes: the command has `--resume`, which continues from a folder OUT.work.
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
        """A record of failure, to be completed with results."""
        before = "" if self.earlier is None else self.earlier.output_sha256
        return Record(self.task.source, self.task.output, self.words, __version__, "failed", output_sha256=before)


@dataclass(frozen=True)
class PlannedJob:
    """The work that a batch would do for a scene.

    Attributes:
        job: the scene.
        file: the scene's file; `None`: it cannot be read.
        is_done: an earlier run made the output, and nothing would be done.
        seconds: expected time; `None` if unknown for this command.
        memory_bytes: expected peak memory.
    """

    job: SceneJob
    file: SceneFile | None
    is_done: bool
    seconds: float | None
    memory_bytes: int

    def as_json(self) -> dict[str, Any]:
        """Return the job, JSON-compatible."""
        return {
            "path": self.job.task.source,
            "output": self.job.task.output,
            "command": list(self.job.words),
            "done": self.is_done,
            "splats": None if self.file is None else self.file.splats,
            "source_bytes": None if self.file is None else self.file.size_bytes,
            "seconds": self.seconds,
            "memory_bytes": self.memory_bytes,
        }


def format_plan(planned: Sequence[PlannedJob]) -> str:
    """Format planned work as a table, with the total time."""
    rows = []
    for one in planned:
        seen = one.file
        splats = "?" if seen is None or seen.splats is None else f"{seen.splats:,}"
        size = "cannot be read" if seen is None else format_bytes(seen.size_bytes)
        seconds = "?" if one.seconds is None else format_seconds(one.seconds)
        work = ("nothing: done", "") if one.is_done else (seconds, format_bytes(one.memory_bytes))
        rows.append((one.job.task.source, one.job.task.output, splats, size, *work))
    left = [one for one in planned if not one.is_done]
    known = [one.seconds for one in left if one.seconds is not None]
    took = f"{format_estimate(sum(known))}, one after the other" if len(known) == len(left) else "the time is unknown"
    table = format_table(("scene", "output", "splats", "size", "time", "memory"), rows, left=2)
    return f"{table}\n{counted(len(left), 'scene')} to do of {len(planned)}, {took}"


#: Reserves memory while a scene's command runs: called with a number of bytes, it yields options for the command.
Gate = Callable[[int], AbstractContextManager[tuple[str, ...]]]


def plan_job(job: SceneJob, worker: Worker) -> PlannedJob:
    """Inspect a scene, and return the work that `run_job` would do."""
    try:
        with _local_source(job.task.source) as source:
            found = _inspected(worker, source)
            assert isinstance(found, SceneFile)
    except (CsplatError, OSError):
        return PlannedJob(job, None, False, 0.0, 0)
    expected = estimate_job(job.command[0], found)
    return PlannedJob(job, found, _is_done(job, found), expected.seconds, expected.memory_bytes)


def run_job(job: SceneJob, worker: Worker, gate: Gate | None = None) -> tuple[Record, bool]:
    """Process a scene unless an earlier run made its output.

    Args:
        job: the scene.
        worker: the process that runs the command.
        gate: waits for memory; `None`: no limit.

    Returns:
        The record of the scene, and False if an earlier run made the output.

    Raises:
        CommandLineError: the command's options are invalid, for any scene.
    """
    record = job.record
    try:
        with _local_source(job.task.source) as source:
            found = _inspected(worker, source)
            record = replace(record, sha256=found.sha256, source_bytes=found.size_bytes, splats=found.splats)
            if _is_done(job, found):
                assert job.earlier is not None
                return replace(job.earlier, path=job.task.source), False
            with (
                (gate or _no_gate)(estimate_job(job.command[0], found).memory_bytes) as options,
                _local_output(job) as output,
            ):
                return _ran(job, record, worker, source, output, options), True
    except CommandLineError:
        raise
    except CsplatError as error:
        return replace(record, code=error.code, error=" ".join(str(error).split())), True
    except OSError as error:
        reason = error.strerror or str(error)
        message = reason if error.filename is None else f"{error.filename}: {reason}"
        code = errno.errorcode.get(error.errno or 0, "E_OS")
        return replace(record, code=code, error=" ".join(message.split())), True


class CommandLineError(InputError):
    """The command of a batch does not exist, or its options are invalid."""

    code = "E_USAGE"


class SceneError(CsplatError):
    """A file of a scene cannot be fetched, read or replaced."""

    def __init__(self, message: str, code: str) -> None:
        super().__init__(message)
        self.code = code


def _ran(job: SceneJob, record: Record, worker: Worker, source: Path, output: Path, options: tuple[str, ...]) -> Record:
    """Run the command, and return the record with its results."""
    output.parent.mkdir(parents=True, exist_ok=True)
    if output.exists() and not is_url(job.task.output) and not job.force and not _is_ours(job, output):
        raise SceneError(f"{job.task.output} exists, and is not from this batch: --force replaces it", "E_INPUT")
    threads = () if job.threads is None or "--threads" in job.words else ("--threads", str(job.threads))
    resume = ("--resume",) if job.resumes and Path(f"{output}.work").is_dir() else ()  # the name may be too long
    words = (job.command[0], str(source), str(output), *job.words[1:], *threads, *options, *resume)
    thumbnail = str(Path(job.folder) / THUMBNAILS / f"{job.task.output}.jpg")
    try:
        answer = worker.ask(
            "run", words=[*words, "--json", "--quiet", "--force"],
            thumbnail=thumbnail if job.thumbnail and not is_url(job.task.output) else "",
            scenes=[str(output), str(source)],
        )  # fmt: skip
    except WorkerLostError:
        if worker.pid is not None:
            remove_unfinished(output, worker.pid)
        raise
    if answer["status"] == _STATUS_USAGE:
        raise CommandLineError(answer["error"])
    record = replace(
        record,
        seconds=round(answer["seconds"], 3),
        memory_bytes=answer["memory_bytes"],
        remarks=tuple(answer["remarks"]),
    )
    if answer["status"]:
        shown = answer["error"].replace(str(source), job.task.source).replace(str(output), job.task.output)
        shown = shown.removeprefix(f"{job.task.source}: ")
        return replace(record, code=answer["code"], error=shown)
    return replace(
        record, state="done", output_bytes=size_on_disk(output), output_sha256=content_hash(output),
        splats=_count(answer["result"], record.splats),
    )  # fmt: skip


def _count(result: Any, before: int | None) -> int | None:
    count = result.get("splats") if isinstance(result, dict) else None
    return count if isinstance(count, int) else before


def _inspected(worker: Worker, source: Path) -> SceneFile:
    found = worker.ask("look", path=str(source))
    if "error" in found:
        raise SceneError(found["error"], found["code"])
    return SceneFile(**found)


def _is_done(job: SceneJob, found: SceneFile) -> bool:
    """Return True if an earlier run made the output from the same inputs, and it is unchanged."""
    earlier = job.earlier
    if earlier is None or earlier.state != "done" or earlier.key != (found.sha256, job.words, __version__):
        return False
    if is_url(job.task.output):
        return True  # to check the file it would have to be downloaded
    return _is_ours(replace(job, pending=False), Path(job.folder) / job.task.output)


def _is_ours(job: SceneJob, output: Path) -> bool:
    """Return True if a batch wrote the existing output, or may have."""
    if job.pending:
        return True
    known = job.earlier.output_sha256 if job.earlier is not None else ""
    if not known or not output.exists():
        return False
    if job.earlier is not None and job.earlier.output_bytes not in (None, size_on_disk(output)):
        return False
    return content_hash(output) == known


@contextmanager
def _local_source(source: str) -> Iterator[Path]:
    """Yield the path of a scene on this machine; a URL is downloaded to a temporary file."""
    if not is_url(source):
        yield Path(source)
        return
    with temporary_folder() as folder:
        local = folder / (PurePosixPath(source.partition("?")[0]).name or "scene")
        with closing(open_store(source)) as store, open_binary(local, "w") as copy:
            for start in range(0, store.size, _PART_BYTES):
                copy.writelines(store.read([(start, min(start + _PART_BYTES, store.size))]))
        yield local


@contextmanager
def _local_output(job: SceneJob) -> Iterator[Path]:
    """Yield the path for the command's output; if the output is a URL, the file is uploaded at the end."""
    if not is_url(job.task.output):
        yield Path(job.folder) / job.task.output
        return
    with temporary_folder() as folder:
        local = folder / PurePosixPath(job.task.output).name
        yield local
        if local.exists():
            _upload(local, job.task.output)


def _upload(local: Path, url: str) -> None:
    try:
        from fsspec.core import url_to_fs
    except ModuleNotFoundError as error:
        raise missing_package(error, extra="remote") from None
    try:
        files, place = url_to_fs(url)
        files.put(str(local), place)
    except Exception as error:  # noqa: BLE001  # each kind of store raises its own
        name = PurePosixPath(url.partition("?")[0]).name  # the rest may contain secrets
        raise StoreError(f"{name} could not be uploaded: {type(error).__name__}") from None


def _no_gate(memory_bytes: int) -> AbstractContextManager[tuple[str, ...]]:  # noqa: ARG001  # signature of `Gate`
    return nullcontext(())


_FILE_SPLAT_BYTES = 16.0  # assumed bytes per splat if a file does not state its count; about those of .splat and SPZ
_UNBOUNDED = 1 << 62
#: Bytes of memory of a process in addition to its command, for the renderer that draws the thumbnail.
RENDERER_BYTES = 160_000_000
#: By command: seconds per scene, seconds per splat, bytes per scene, bytes per splat. Measured at SH degree 3 on two
#: cores with 120,000 to 1.1 million splats; bytes include a margin of 20 %. `encode` has better estimates if possible.
_COSTS = {
    "encode": (0.1, 40e-6, 120e6, 750.0),
    "decode": (0.05, 2.5e-6, 60e6, 300.0),
    "convert": (0.05, 9e-6, 140e6, 150.0),
    "extract": (0.02, 0.1e-6, 40e6, 30.0),
}
_OTHER_BYTES = (340e6, 3000.0)  # bytes per scene and per splat of other commands, which render: a cautious guess


@dataclass(frozen=True)
class SceneFile:
    """A scene's file.

    Attributes:
        sha256: hash of its content; for a folder, of its files and their names.
        size_bytes: size of the file, or of all files of a folder.
        splats: number of splats; `None` if the file does not state it.
        format: the name of its format; "" if it has none.
        encode_seconds, encode_bytes: expected time and memory of encoding it in memory; `None` if not known.
    """

    sha256: str
    size_bytes: int
    splats: int | None
    format: str
    encode_seconds: float | None = None
    encode_bytes: int | None = None

    def as_json(self) -> dict[str, Any]:
        """Return the fields as JSON-compatible values, for `SceneFile(**...)`."""
        return asdict(self)


@dataclass(frozen=True)
class JobEstimate:
    """The time and memory that a command is expected to take for a scene.

    Attributes:
        seconds: expected time on two cores with SH degree 3; `None` if unknown for this command.
        memory_bytes: expected peak memory of the process.
    """

    seconds: float | None
    memory_bytes: int


def inspect_scene(path: Path) -> SceneFile:
    """Read a scene's header and hash its content; the command will report defects.

    Raises:
        OSError: the file cannot be read.
    """
    size, content = size_on_disk(path), content_hash(path)
    try:
        name = detect_format(path).name
        with open_scene(path) as scene:
            found = estimate_cost(scene, EncodeOptions(), OutOfCoreOptions(memory_bytes=_UNBOUNDED))
    except (CsplatError, ValueError, MemoryError):  # no prediction for such a file
        return SceneFile(content, size, None, "")
    return SceneFile(content, size, found.splats, name, found.seconds, found.memory_bytes)


def estimate_job(command: str, known: SceneFile) -> JobEstimate:
    """Estimate the time and memory of a command with default options."""
    splats = known.splats if known.splats is not None else known.size_bytes / _FILE_SPLAT_BYTES
    if command == "encode" and known.encode_bytes is not None:
        return JobEstimate(known.encode_seconds, RENDERER_BYTES + known.encode_bytes)
    if command not in _COSTS:
        each, by_splat = _OTHER_BYTES
        return JobEstimate(None, round(RENDERER_BYTES + each + by_splat * splats))
    seconds, seconds_by_splat, each, by_splat = _COSTS[command]
    return JobEstimate(seconds + seconds_by_splat * splats, round(RENDERER_BYTES + each + by_splat * splats))


def content_hash(path: Path) -> str:
    """Return the SHA-256 of a file; for a folder or a scene of several files, that of their names and contents.

    Raises:
        OSError: a file cannot be read.
    """
    files = _files(path)
    if files == [path]:
        return _hashed(path)
    base = path if path.is_dir() else path.parent
    lines = [f"{_hashed(one)} {one.relative_to(base).as_posix()}\n" for one in files]
    return hashlib.sha256("".join(lines).encode()).hexdigest()


def _files(path: Path) -> list[Path]:
    """List the files of a scene, or of a folder of results."""
    folder = path.parent if path.name.lower() in FOLDER_NAMES else path
    if folder.is_dir():
        return sorted(one for one in folder.rglob("*") if one.is_file())
    return [path, *_buffer_files(path)] if path.suffix.lower() == ".gltf" else [path]


def _buffer_files(path: Path) -> Iterator[Path]:
    """Yield the buffer files that a glTF names and that exist in its folder; none if the JSON is invalid."""
    try:
        buffers = parse_json(read_bytes(path)).get("buffers", [])
        names = [unquote(one["uri"]) for one in buffers if not one.get("uri", "data:").startswith("data:")]
    except (InputError, TypeError, AttributeError):
        return
    for name in names:
        with suppress(ValueError, OSError, RuntimeError):  # not the name of a file, a loop of links
            if (inside := path_inside(path.parent, name)) and inside.is_file():
                yield path.parent / name


def _hashed(path: Path) -> str:
    with open_binary(path) as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


#: The program of a process, started by its name: `cli` is above this package and may not be imported here.
_PROGRAM = "csplat_tools.cli.batch_protocol"
_CLEANUP_SECONDS = 10.0  # time for an interrupted process to remove unfinished files before it is killed

Process = subprocess.Popen[str]


class WorkerLostError(CsplatError):
    """A process ended before it answered."""

    code = "E_WORKER"


class Worker:
    """A process that runs commands. It starts with the first request, and again after a loss.

    Requests must come from one thread; `close` may be called by another.
    """

    def __init__(self) -> None:
        self._process: Process | None = None
        self._stderr = temporary_file()
        self._lock = threading.Lock()
        self._closed = False

    def ask(self, what: str, **values: Any) -> dict[str, Any]:
        """Send a request, and return the answer of `csplat_tools.cli.batch_protocol.answer`.

        Raises:
            WorkerLostError: the process ended, or was closed. Its unfinished files remain, see `remove_unfinished`.
        """
        process = self._started()
        assert process.stdin is not None
        assert process.stdout is not None
        try:
            process.stdin.write(json.dumps({"ask": what, **values}) + "\n")
            process.stdin.flush()
            line = process.stdout.readline()
        except (BrokenPipeError, ValueError):
            line = ""
        if not line.endswith("\n"):
            raise WorkerLostError(self._lost(process))
        answer: dict[str, Any] = json.loads(line)
        return answer

    @property
    def pid(self) -> int | None:
        """Id of the current process, or the last one; it is part of the names of temporary files."""
        return None if self._process is None else self._process.pid

    def close(self) -> None:
        """End the process; it has some seconds to remove unfinished files."""
        with self._lock:
            self._closed = True
            _end(self._process)
            self._stderr.close()

    def _started(self) -> Process:
        with self._lock:
            if self._closed:
                raise WorkerLostError("closed")
            if self._process is None or self._process.poll() is not None:
                _end(self._process)
                self._process = subprocess.Popen(  # noqa: S603  # this interpreter
                    [sys.executable, "-m", _PROGRAM], stdin=subprocess.PIPE, stdout=subprocess.PIPE,
                    stderr=self._stderr, encoding="utf-8",
                    start_new_session=True,  # so that Ctrl-C reaches only the parent
                    creationflags=NEW_GROUP_FLAGS,
                )  # fmt: skip
            return self._process

    def _lost(self, process: Process) -> str:
        """Describe how a process ended, with the last line of its standard error."""
        status = process.wait()
        with self._lock:
            if self._closed:
                return "closed"
            self._stderr.seek(0)
            last_line = self._stderr.read().decode(errors="replace").strip().splitlines()[-1:]
        if status >= 0:
            return ": ".join([f"its process ended with status {status}", *last_line])
        name = signal.Signals(-status).name if -status in set(signal.Signals) else str(-status)
        return f"its process was ended by {name}" + ("; it may have run out of memory" if name == "SIGKILL" else "")


def _end(process: Process | None) -> None:
    """End a process, and close the pipes to it."""
    if process is None:
        return
    interrupt_process(process)
    try:
        process.wait(_CLEANUP_SECONDS)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()
    for pipe in (process.stdin, process.stdout):
        if pipe is not None:
            with suppress(OSError):  # unsent data
                pipe.close()

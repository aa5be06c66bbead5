# SPDX-License-Identifier: Apache-2.0
"""Run one command on many scenes, in processes of this machine or on a Dask cluster.

Nothing is recorded between runs. An output that exists, is newer than its scene and passes its checks is not made
again. Any other file in its place is kept, and the scene fails, unless `force` is given.
"""

from __future__ import annotations

import csv
import json
import multiprocessing
import os
import posixpath
import re
import signal
import subprocess
import sys
import threading
import time
from collections import Counter, deque
from collections.abc import Callable, Collection, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, BrokenExecutor, Future, ProcessPoolExecutor, wait
from contextlib import contextmanager, nullcontext, redirect_stderr, redirect_stdout, suppress
from dataclasses import asdict, dataclass, replace
from fnmatch import fnmatch
from functools import partial
from importlib.metadata import entry_points
from io import StringIO
from pathlib import Path, PurePath, PurePosixPath
from typing import Any, Literal

import csplat
from csplat.context import DEFAULT_CONTEXT, Context
from csplat.decoder import check_chunks
from csplat.disk_files import (
    FOLDER_NAMES,
    parse_json,
    read_text,
    remove_unfinished,
    resolve_links,
    size_on_disk,
    temporary_folder,
)
from csplat.errors import CsplatError, InputError, missing_package
from csplat.file_source import read_bytes
from csplat.formats import formats
from csplat.out_of_core.bucket_workers import open_client
from csplat.remote_store import is_url
from csplat.system import interrupts_held, interrupts_noted, semaphore_errors_named, split_words
from csplat_render.kernels import thread_count
from csplat_tools import html_report as html
from csplat_tools.console import format_bytes
from csplat_tools.file_streams import is_csplat, write_text

PAGE = "index.html"
_MARK = "<!-- csplat batch -->"  # in our pages; a page without it is somebody else's, and is kept
_MANIFESTS, _COLUMNS = (".jsonl", ".csv", ".txt"), ("path", "output", "options")
_ONE_LEVEL, _LEVELS = FOLDER_NAMES
_OTHER_GPU = re.compile(r"_rank[1-9]\d*\.pt$")  # gsplat's checkpoints, which are read with rank 0
#: Commands that take IN and OUT: the ending of OUT, "" if there are several; and whether they take only the .csplat
#: files of a folder (True), all other scenes (False), or both (`None`).
_COMMANDS: dict[str, tuple[str, bool | None]] = {
    "encode": (".csplat", False), "decode": (".ply", True), "convert": ("", None), "extract": (".csplat", True),
    "simplify": (".ply", None), "finetune": (".csplat", None), "train": ("", None), "render": ("", None),
    "export-html": (".html", None), "sensitivity": (".npz", None),
}  # fmt: skip
_IN_NO_BATCH = {"--dry-run", "--help", "--help-all"}  # options with which a command writes no output
_STATUS_USAGE, _STATUS_ENDED = 2, 130  # exit status: a wrong command line; a worker that ended on request
_POLL_SECONDS, _CLEANUP_SECONDS = 0.1, 1.0  # between looks for an interrupt; for a worker to remove unfinished files


class CommandLineError(InputError):
    """The command of a batch does not exist, or its options are invalid."""

    code = "E_USAGE"


@dataclass(frozen=True)
class Task:
    """A scene, its output within the folder of outputs, and options for it alone. Both may be URLs."""

    source: str
    output: str
    options: tuple[str, ...] = ()


@dataclass(frozen=True)
class SceneResult:
    """The outcome of one scene: the files of its `Task`, the error in one line, other messages of the command.

    `psnr`, dB, is that of the report of a target.
    """

    path: str
    output: str
    state: Literal["done", "done_before", "failed"] = "failed"
    error: str = ""
    remarks: tuple[str, ...] = ()
    source_bytes: int | None = None
    output_bytes: int | None = None
    splats: int | None = None
    psnr: float | None = None
    seconds: float | None = None


@dataclass(frozen=True)
class Batch:
    """The outcome of a batch. It has no page if another program's file has that name."""

    folder: Path
    command: tuple[str, ...]
    results: tuple[SceneResult, ...]
    has_page: bool = True

    def select(self, *states: str) -> list[SceneResult]:
        """Return the scenes in these states."""
        return [result for result in self.results if result.state in states]

    def as_json(self) -> dict[str, Any]:
        """Return totals and results as JSON-compatible values."""
        counts = {state: len(self.select(state)) for state in ("done", "done_before", "failed")}
        return {"scenes": len(self.results), **counts, "results": [asdict(result) for result in self.results]}


def run_batch(
    scenes: str | os.PathLike[str],
    folder: str | os.PathLike[str],
    command: Sequence[str] = ("encode",),
    *,
    ending: str | None = None,
    match: str = "*",
    force: bool = False,
    context: Context = DEFAULT_CONTEXT,
) -> Batch:
    """Run one command on many scenes, as `csplat batch` does.

    Scripts must guard their own code by `if __name__ == "__main__":`, because worker processes import it.

    Args:
        scenes: a folder, searched with its subfolders for the endings that `convert --help` lists; or a manifest: lines
            of JSON (.jsonl), or of path, output and options (.csv, .txt) with commas, semicolons or tabs between them.
        folder: the folder for outputs and the page of results; it is made if missing.
        command: the command with its options: `encode` skips .csplat files, `decode` and `extract` skip all others.
        ending: file name ending of outputs without a name; `None`: by the command.
        match: shell pattern of names within a folder, such as `*.ply`.
        force: repeat all scenes, and replace existing files.
        context: workers, which run the scenes and share the threads; progress. Workers of a Dask scheduler have to see
            the same files.

    Raises:
        CommandLineError, InputError, OSError: command, scenes, folder or scheduler cannot be used.
    """
    target, words = Path(folder).absolute(), tuple(command)
    workers, scheduler = (None, context.workers) if isinstance(context.workers, str) else (context.workers, None)
    tasks = find_tasks(Path(scenes).absolute() if scheduler else Path(scenes), words, ending, match, without=target)
    count, others = min(workers or context.thread_count, len(tasks)), set(multiprocessing.active_children())
    worker_context = Context(threads=max(1, context.thread_count // count) if scheduler is None else 1)
    make = partial(run_scene, target, words, worker_context, apart=scheduler is not None, force=force)
    ended, lost, processes = dict[str, SceneResult](), list[Task](), set(others)
    sizes = {task: path.stat().st_size for task in tasks if (path := Path(task.source)).is_file()}
    todo = deque(sorted(tasks, key=lambda task: -sizes.get(task, 0)))  # the largest first
    running: dict[Future[SceneResult], tuple[Any, Task]] = {}
    with (
        nullcontext() if scheduler is None else open_client(scheduler) as client,
        interrupts_noted(signal.SIGINT, signal.SIGTERM) as interrupts,
    ):
        new = partial(ProcessPoolExecutor, 1, multiprocessing.get_context("spawn"), _begin_worker)
        with semaphore_errors_named():
            idle = [new() for _ in range(count)] if client is None else [client.get_executor(pure=False)] * len(tasks)
        try:
            while (todo or running) and not interrupts:
                while todo and idle:
                    executor, task = idle.pop(), todo.popleft()
                    with interrupts_held():
                        running[executor.submit(make, task)] = executor, task
                    processes.update(multiprocessing.active_children())
                for future in wait(running, _POLL_SECONDS, FIRST_COMPLETED).done:
                    executor, task = running.pop(future)
                    if not future.cancelled() and isinstance(future.exception(), BrokenExecutor):
                        executor.shutdown()
                        executor, lost = new(), [*lost, task]
                    idle.append(executor)
                    ended[task.output] = _result_or_failure(future, task)
                    context.progress("scenes", len(ended) / len(tasks))
        finally:
            lost += [task for _, task in running.values()]
            _end_processes(processes - others, [target / task.output for task in lost])
            for executor in {*idle, *(executor for executor, _ in running.values())}:
                executor.shutdown(wait=client is None)
    done = Batch(Path(folder), words, tuple(ended[task.output] for task in tasks))
    page = target / PAGE
    if page.exists() and not force and _MARK.encode() not in read_bytes(page):
        return replace(done, has_page=False)
    target.mkdir(parents=True, exist_ok=True)
    write_text(str(page), make_batch_page(done))
    return done


def _result_or_failure(future: Future[SceneResult], task: Task) -> SceneResult:
    """Return the result of a task that ended; a failure if its process was killed, or for an unexpected error.

    Raises:
        CommandLineError: options of all scenes are invalid.
    """
    try:
        return future.result()
    except CommandLineError:
        raise
    except BrokenExecutor:
        error = "its process was killed, perhaps for lack of memory: try fewer --workers"
    except Exception as unexpected:  # noqa: BLE001  # a defect, or an error of a cluster or a store
        error = repr(unexpected)
    return SceneResult(task.source, task.output, error=error)


def _end_processes(processes: Collection[Any], outputs: Sequence[Path]) -> None:
    """End worker processes, and remove what they have left of unfinished outputs."""
    deadline = time.monotonic() + _CLEANUP_SECONDS
    for process in processes:
        process.terminate()
    for process in processes:
        process.join(max(0.0, deadline - time.monotonic()))
        process.kill()
        process.join()
        for output in outputs:
            remove_unfinished(output, process.pid or 0)


def _begin_worker() -> None:
    """Prepare a worker process: it ignores interrupts, and a thread ends it when its parent has ended."""

    def end_with(parent: Any) -> None:
        """Wait for the end of the parent, then ask this process to clean up, and end it after `_CLEANUP_SECONDS`."""
        parent.join()
        os.kill(os.getpid(), signal.SIGTERM)
        time.sleep(_CLEANUP_SECONDS)
        os._exit(_STATUS_ENDED)

    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent receives it, too
    threading.Thread(target=end_with, args=[multiprocessing.parent_process()], daemon=True).start()


def find_tasks(path: Path, command: Sequence[str], ending: str | None, match: str, without: Path) -> list[Task]:
    """Return the sorted scenes of a folder, except in the folder `without`, or the scenes of a manifest.

    The other arguments are as for `run_batch`.
    """
    if not command or command[0] not in _COMMANDS:
        raise CommandLineError(f"expected a command that can run in batch: {', '.join(_COMMANDS)}")
    ending = _COMMANDS[command[0]][0] or None if ending is None else ending
    if ending is None:
        raise CommandLineError(f"csplat {command[0]} writes several formats: choose one with --ending, such as .spz")
    if (ending[:1] != "." and (ending or command[0] != "render")) or "/" in ending or "\\" in ending:
        raise CommandLineError(f"--ending is {ending!r}, expected a file name ending such as .spz")
    if refused := _IN_NO_BATCH.intersection(command):
        raise CommandLineError(f"{min(refused)} writes no output, and cannot run in batch")
    path.stat()  # raises an OSError that names it
    if path.is_dir():
        scenes = [(Task(str(path / name), ""), name) for name in _find_scenes(path, command[0], match, without)]
    elif path.suffix.lower() in _MANIFESTS:
        scenes = list(_read_manifest(path))
    else:
        raise InputError(f"{path} is not a folder, expected a folder or a manifest: {', '.join(_MANIFESTS)}")
    if not scenes:
        is_inside = path.is_dir() and resolve_links(path).is_relative_to(resolve_links(without))
        inside = f" outside of {without}" if is_inside else ""
        raise InputError(f"{path} has no scenes for `csplat {command[0]}`{inside}")
    root = resolve_links(path).name if path.is_dir() else path.stem
    short = [task.output or _output_name(within, root, ending) for task, within in scenes]
    uses = Counter(short)  # outputs that would have one name keep the endings of their sources
    tasks = [
        replace(task, output=name if task.output or uses[name] == 1 else _output_name(within, root, ending, whole=True))
        for (task, within), name in zip(scenes, short, strict=True)
    ]
    for task in tasks:
        if task.output == PAGE:
            raise InputError(f"{PAGE} is the page of the batch: name another output for {task.source} in a manifest")
    output, count = Counter(task.output for task in tasks).most_common(1)[0]
    if count > 1:
        raise InputError(f"{output} is the output of {count} scenes: name their outputs in a manifest")
    return tasks


def _find_scenes(folder: Path, command: str, match: str, without: Path) -> list[str]:
    """Return the sorted relative paths, with slashes, of the scenes within a folder that suit a command.

    Hidden files and folders, and files that lead into the folder `without`, are skipped. `match` is a shell pattern of
    a path or of a name.
    """
    endings = tuple(
        end for scene_format in formats() if scene_format.open for end in scene_format.suffixes if end.startswith(".")
    )
    takes_csplat = _COMMANDS[command][1]  # None: both kinds of files
    scenes, excluded = set[Path](), resolve_links(without)
    for path in folder.rglob("*"):
        name, relative = path.name.lower(), path.relative_to(folder)
        is_scene = (name in FOLDER_NAMES or name.endswith(endings)) and takes_csplat in (None, name.endswith(".csplat"))
        is_hidden = any(part.startswith(".") for part in relative.parts)
        if is_scene and not (is_hidden or path.is_dir() or Path(os.path.realpath(path)).is_relative_to(excluded)):
            scenes.add(relative)
    names = [scene.as_posix() for scene in sorted(scenes) if not _is_part(folder, scene, scenes)]
    return [name for name in names if fnmatch(name, match) or fnmatch(PurePosixPath(name).name, match)]


def _is_part(folder: Path, name: Path, names: set[Path]) -> bool:
    """Return True for one level of a scene, another GPU's part of a checkpoint, or the initial points of a training."""
    if name.name == "input.ply" and (folder / name).with_name("point_cloud").is_dir():  # INRIA's trainer
        return True
    if (gpu := _OTHER_GPU.search(name.name)) and name.with_name(f"{name.name[: gpu.start()]}_rank0.pt") in names:
        return True
    return name.name == _ONE_LEVEL and any(above / _LEVELS in names for above in name.parents)


def _read_manifest(manifest: Path) -> Iterator[tuple[Task, str]]:
    """Yield the scenes of a manifest, with the relative paths that name outputs for which it has no name.

    Paths of scenes are relative to its folder. Empty lines, comments and rows of column names yield nothing; such a row
    sets the columns of those below.

    Raises:
        InputError: a line is invalid, or the file is not text.
    """
    lines, is_json = read_text(manifest).splitlines(), manifest.suffix.lower() == ".jsonl"
    first = next((line for line in lines if line.strip() and not line.startswith("#")), "")
    # Some spreadsheets write other separators; the first line with content shows which.
    separator = "," if "," in first else next((mark for mark in ";\t" if mark in first), ",")
    columns = list(_COLUMNS)
    for number, line in enumerate(lines, 1):
        try:
            row = [line] if is_json else next(csv.reader([line], skipinitialspace=True, delimiter=separator))
            cells = [cell.strip() for cell in row]
            folded = [cell.casefold() for cell in cells]
            is_heading = "path" in folded
            columns = folded if is_heading else columns
            if is_heading or not any(cells) or cells[0].startswith(("#", "sep=")):
                continue
            fields = parse_json(line) if is_json else dict(zip(columns, cells, strict=False))
            source, output, options = (fields.get(name) or "" for name in _COLUMNS)
            words = tuple(split_words(options) if isinstance(options, str) else map(str, options))
            if not source or (leads_out(output) and not is_url(output)):
                raise ValueError
            within = PurePosixPath(source.partition("?")[0]).name if is_url(source) or leads_out(source) else source
        except (InputError, AttributeError, TypeError, ValueError, csv.Error):
            where = f"{manifest.name}, line {number}"
            raise InputError(f"{where}: expected a path, an output inside of OUT, words as options") from None
        output = output if is_url(output) or not output else posixpath.normpath(output)
        yield Task(source if is_url(source) else str(manifest.parent / source), output, words), within


def leads_out(name: str, flavour: type[PurePath] = PurePath) -> bool:
    """Return True if a relative path leads out of its folder, read as a POSIX path or as a path of this system."""
    return any(path.anchor or ".." in path.parts for path in (PurePosixPath(name), flavour(name)))


def _output_name(within: str, root: str, ending: str, *, whole: bool = False) -> str:
    """Return the source's name with another ending; if `whole`, the ending is appended."""
    path = PurePosixPath(within)
    if path.name in FOLDER_NAMES:
        return f"{path.parent if path.parent.name else root}{ending}"
    known = [end for scene_format in formats() for end in scene_format.suffixes if path.name.lower().endswith(end)]
    stem = path.name if whole or not known else path.name[: -len(max(known, key=len))]
    return str(path.with_name(stem + ending))


def run_scene(
    folder: Path, command: Sequence[str], context: Context, task: Task, apart: bool, force: bool
) -> SceneResult:
    """Run a command on a scene, unless an earlier run has made the output. If `apart`, it runs in its own process.

    Raises:
        CommandLineError: options of all scenes are invalid.
    """
    result, is_remote = SceneResult(task.source, task.output), is_url(task.source) or is_url(task.output)
    try:
        with _local_file(task.source, Path()) as source, _local_file(task.output, folder) as output:
            result = replace(result, source_bytes=size_on_disk(source))
            if output.exists() and not force:
                splats = _check_existing(output, None if is_remote else source)
                return replace(result, state="done_before", output_bytes=size_on_disk(output), splats=splats)
            output.parent.mkdir(parents=True, exist_ok=True)
            words = [*command, *task.options, "--json", "--quiet", *(["--force"] if force else [])]
            if command[0] == "encode":
                words += [] if "--threads" in words else ["--threads", str(context.thread_count)]
                words += ["--resume"] if Path(f"{output}.work").is_dir() else []  # an earlier run was interrupted
            begun, words = time.perf_counter(), [*words, "--", str(source), str(output)]
            if apart:
                program = [sys.executable, "-m", "csplat_tools"]
                done = subprocess.run([*program, *words], capture_output=True, text=True, check=False)  # noqa: S603
                status, out, err = done.returncode, done.stdout, done.stderr
            else:
                with thread_count(context.thread_count):
                    status, out, err = _run_here(words)
            lines = [line for line in err.splitlines() if line.strip()]
            result = replace(result, seconds=round(time.perf_counter() - begun, 3), remarks=tuple(lines))
            if status:
                error = (lines or [f"status {status}"])[-1].removeprefix("error: ")
                if status == _STATUS_USAGE and not task.options:
                    raise CommandLineError(error.partition("; `csplat")[0])
                error = error.replace(str(source), task.source).replace(str(output), task.output)
                return replace(result, error=error.removeprefix(f"{task.source}: "), remarks=tuple(lines[:-1]))
            with suppress(ValueError, TypeError, KeyError):  # commands with another result
                report = json.loads(out)
                result = replace(result, splats=report["splats"], psnr=(report.get("target") or {}).get("psnr"))
            return replace(result, state="done", output_bytes=size_on_disk(output))
    except SystemExit:
        os._exit(_STATUS_ENDED)  # the pool would catch it, and go on
    except CommandLineError:
        raise
    except CsplatError as error:
        return replace(result, error=str(error))
    except OSError as error:
        name = task.source if is_remote else error.filename or task.source
        return replace(result, error=f"{name}: {error.strerror or error}")


def _run_here(words: list[str]) -> tuple[int, str, str]:
    """Run a command line in this process; return its status and what it printed on standard output and error.

    Replaces `sys.argv`, both streams and the handler of SIGTERM meanwhile.

    Raises:
        SystemExit: the process has to end, as requested by SIGTERM.
    """
    [program] = entry_points(group="console_scripts", name="csplat")
    out, err, status = StringIO(), StringIO(), 0
    arguments, handler = sys.argv, signal.signal(signal.SIGTERM, _end_worker)
    sys.argv = ["csplat", *words]
    try:
        with redirect_stdout(out), redirect_stderr(err):
            program.load()()
    except SystemExit as end:
        status = int(end.code or 0)
        if status == _STATUS_ENDED:
            raise
    finally:
        signal.signal(signal.SIGTERM, handler)
        sys.argv = arguments
    return status, out.getvalue(), err.getvalue()


def _end_worker(*_: object) -> None:
    """Handle SIGTERM in a worker: kill its processes, and raise SystemExit."""
    for process in multiprocessing.active_children():
        process.kill()
    sys.exit(_STATUS_ENDED)  # removes unfinished files


def _check_existing(output: Path, source: Path | None) -> int | None:
    """Return the number of splats of an output that need not be made again; `None` for another kind of file.

    Args:
        output: a file or folder that exists.
        source: its scene; `None`: ages cannot be compared.

    Raises:
        InputError: the output is damaged, or older than its source.
    """
    splats = None  # another kind of file, which was complete when it appeared
    try:
        if output.is_file() and is_csplat(output):
            splats = check_chunks(output).splat_count
        elif output.is_dir() or output.name.lower().endswith(
            tuple(end for scene_format in formats() for end in scene_format.suffixes)
        ):
            with csplat.open(output) as scene:
                splats = scene.count
    except (CsplatError, OSError) as error:
        raise InputError(f"the output exists, and is invalid: {error}; --force replaces it") from None
    made = output.stat().st_mtime
    if source is not None and max(path.stat().st_mtime for path in (source, *source.rglob("*"))) > made:
        raise InputError("the output exists, and is older than the scene: --force replaces it")
    return splats


@contextmanager
def _local_file(place: str, folder: Path) -> Iterator[Path]:
    """Yield the local path of a file; a file at a URL has a temporary copy.

    A file at a URL is downloaded if it exists, and uploaded at the end if the copy was made or replaced, but not if it
    was only changed in place.

    Args:
        place: a URL, or a path.
        folder: folder of a relative path.

    Raises:
        InputError: the package for URLs is not installed.
        OSError: the file cannot be transferred.
    """
    if not is_url(place):
        yield folder / place
        return
    try:
        from fsspec.core import url_to_fs
    except ModuleNotFoundError as error:
        raise missing_package(error, extra="remote") from None
    with temporary_folder() as temporary:
        files, path = url_to_fs(place)
        local = temporary / PurePosixPath(path).name
        if files.exists(path):
            files.get_file(path, str(local))
        downloaded_inode = local.stat().st_ino if local.exists() else None
        yield local
        if local.exists() and local.stat().st_ino != downloaded_inode:
            files.put_file(str(local), path)


def make_batch_page(batch: Batch) -> str:
    """Return the HTML report: totals, failed scenes, and a table of the others."""
    done, failed = batch.select("done", "done_before"), batch.select("failed")
    source_bytes = sum(result.source_bytes or 0 for result in done)
    output_bytes = sum(result.output_bytes or 0 for result in done)
    totals = {
        "command": " ".join(("csplat", *batch.command)),
        "done": f"{len(done):,} of {len(batch.results):,}",
        "bytes": f"{format_bytes(source_bytes)} -> {format_bytes(output_bytes)}",
    }
    values: dict[str, Callable[[SceneResult], float | None]] = {
        "splats": lambda result: result.splats,
        "source, kB": lambda result: (result.source_bytes or 0) / 1e3,
        "output, kB": lambda result: (result.output_bytes or 0) / 1e3,
        "PSNR, dB": lambda result: result.psnr,
        "seconds": lambda result: result.seconds,
    }
    columns = {title: of for title, of in values.items() if any(of(result) is not None for result in done)}
    heads = [html.Head("scene", kind="link"), *map(html.Head, columns)]
    rows = []
    for result in done:
        cells = [of(result) for of in columns.values()]
        rows.append([(result.output, result.path), *((_cell_text(value), value) for value in cells)])
    errors = (
        html.table(("scene", "error"), [(result.path, result.error) for result in failed], words=(1,)) if failed else ""
    )
    table = html.sortable_table(heads, rows) if rows else ""
    parts = [_MARK, html.definitions(totals), html.section("Failed", errors), html.section("Done", table)]
    return html.document(f"{batch.folder.resolve().name}: {len(batch.results):,} scenes", parts)


def _cell_text(value: float | None) -> str:
    """Return a number with at most one decimal; a dash if it is unknown, as seconds and PSNR of an earlier run are."""
    return "–" if value is None else f"{value:,.1f}".removesuffix(".0")

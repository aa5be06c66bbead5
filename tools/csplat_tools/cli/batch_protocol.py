"""A worker process of `csplat batch` that runs commands one after another: `python -m csplat_tools.cli.batch_protocol`.

A request is a line of JSON on standard input, its answer one on standard output. When the input ends so does the
process, even in the middle of a command: the parent is gone.
"""

from __future__ import annotations

import errno
import io
import json
import os
import queue
import signal
import sys
import threading
import time
import traceback
from collections.abc import Callable, Sequence
from contextlib import redirect_stderr, redirect_stdout, suppress
from pathlib import Path
from typing import Any

import typer
from typer.main import get_command

from csplat.system import interrupt_main_thread
from csplat_tools.batches.batch_page import prepare_thumbnails, write_thumbnail
from csplat_tools.batches.scene_job import inspect_scene
from csplat_tools.cli.app import app, split_program_options
from csplat_tools.cli.encode import IN_MEMORY
from csplat_tools.cli.error_lines import (
    EXIT_FAILED,
    EXIT_INTERRUPTED,
    EXIT_USAGE,
    ReportedError,
    UsageError,
    report_errors,
    usage_message,
)

_ERROR = "error: "
_REMARKS_MAX = 20
_OWN = ("force", "report", "as_json", "quiet")  # options that the batch gives itself
#: Options that a batch refuses: each names one file, which all scenes would share, or leaves no output.
_REFUSED = ("page", "source_index", "checkpoint", "resume", "dry_run")


def main() -> None:
    """Answer requests until there are none."""
    answers = os.fdopen(os.dup(sys.stdout.fileno()), "w", encoding="utf-8")
    os.dup2(sys.stderr.fileno(), sys.stdout.fileno())  # output of libraries must not be taken for an answer
    signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell's background processes ignore it
    requests: queue.SimpleQueue[str | None] = queue.SimpleQueue()
    busy = threading.Event()

    def listen() -> None:
        for line in sys.stdin:
            requests.put(line)
        requests.put(None)
        if busy.is_set():  # ends a command that waits for child processes, too
            interrupt_main_thread()

    threading.Thread(target=listen, daemon=True).start()
    with suppress(KeyboardInterrupt, BrokenPipeError):
        while (line := requests.get()) is not None:
            busy.set()
            reply = answer(json.loads(line))
            busy.clear()
            answers.write(json.dumps(reply) + "\n")
            answers.flush()


def answer(request: dict[str, Any]) -> dict[str, Any]:
    """Answer a request: `check` or `run` a command line, or `look` at a scene."""
    answers: dict[str, Callable[..., dict[str, Any]]] = {
        "check": _check,
        "look": _look,
        "run": _run,
    }
    return answers[request["ask"]](**{name: value for name, value in request.items() if name != "ask"})


def _check(words: Sequence[str]) -> dict[str, Any]:
    """Parse a command line for all scenes.

    Returns:
        `wrong`: the error in one line, or "". Without an error also `ending`: the file name ending of the command's
        outputs, "" if it may have any; `options`: names of the options that the batch may add.
    """
    name, *rest = split_program_options(words)[1]
    group: Any = get_command(app)
    command = group.get_command(typer.Context(group), name)
    if command is None or hasattr(command, "commands"):
        return {"wrong": f"{name} is not a command that can run in batch; `csplat --help` lists the commands"}
    arguments = {one.name: one for one in command.params if one.param_type_name == "argument"}
    if list(arguments) != ["source", "output"]:
        return {"wrong": f"`csplat {name}` cannot run in batch: it must take exactly IN and OUT"}
    try:
        with redirect_stdout(io.StringIO()), redirect_stderr(io.StringIO()):
            context = command.make_context(f"csplat {name}", ["IN", "OUT", *rest])
    except UsageError as error:
        return {"wrong": f"csplat {name}: {usage_message(error)}"}
    except (typer.Exit, SystemExit):
        return {"wrong": f"csplat {name}: --help and --help-all do no work"}
    given = [one for one in context.params if _is_given(context, one)]
    taken = [one for one in given if one in (*_OWN, *_REFUSED)]
    if taken:
        option = "--" + {"as_json": "json"}.get(taken[0], taken[0]).replace("_", "-")
        return {"wrong": f"csplat {name}: {option} is not for all scenes of a batch"}
    options = {one.name for one in command.params}
    if set(given) & set(IN_MEMORY):
        options -= {"memory", "resume"}
    return {"wrong": "", "ending": Path(arguments["output"].metavar or "").suffix, "options": sorted(options)}


def _is_given(context: Any, name: str) -> bool:
    source = context.get_parameter_source(name)
    return source is not None and source.name == "COMMANDLINE"


def _look(path: str) -> dict[str, Any]:
    try:
        return inspect_scene(Path(path)).as_json()
    except OSError as error:
        reason = error.strerror or type(error).__name__
        return {"error": f"{path}: {reason}", "code": _os_code(error)}


def _os_code(error: OSError) -> str:
    return errno.errorcode.get(error.errno or 0, "EIO")


def _run(words: Sequence[str], thumbnail: str = "", scenes: Sequence[str] = ()) -> dict[str, Any]:
    """Run a command line, and draw a thumbnail of the first of several scenes that can be read."""
    out, err = io.StringIO(), io.StringIO()
    _forget_peak()
    begun = time.perf_counter()
    with redirect_stdout(out), redirect_stderr(err):
        status, error, code = _invoke(words)
    seconds = time.perf_counter() - begun
    if status == EXIT_INTERRUPTED:
        raise KeyboardInterrupt
    lines = [line for line in err.getvalue().splitlines() if line.strip()]
    if status and not error:
        error = lines[-1].removeprefix(_ERROR) if lines else f"status {status}"
    if status == 0 and thumbnail and prepare_thumbnails():
        write_thumbnail(Path(thumbnail), [Path(one) for one in scenes])
    return {
        "status": status,
        "error": error,
        "code": (code or "E_FAILED") if status else "",
        "remarks": [line for line in lines if not line.startswith(_ERROR)][-_REMARKS_MAX:],
        "result": _json(out.getvalue()),
        "seconds": seconds,
        "memory_bytes": _peak(),
    }


def _invoke(words: Sequence[str]) -> tuple[int, str, str]:
    """Run a command line, and return its status, its error in one line, and the error's code; "": none."""
    group: Any = get_command(app)
    try:
        with report_errors(), group.make_context("csplat", list(words)) as context:
            group.invoke(context)
    except ReportedError as failure:
        return failure.exit_code, failure.message, failure.code
    except UsageError as failure:
        command = "csplat" if failure.ctx is None else failure.ctx.command_path  # type: ignore[attr-defined]
        return EXIT_USAGE, f"{command}: {usage_message(failure)}", "E_USAGE"
    except typer.Exit as end:
        return end.exit_code, "", ""
    except SystemExit as end:
        return end.code if isinstance(end.code, int) else EXIT_FAILED if end.code else 0, "", ""
    except Exception as failure:  # noqa: BLE001  # a defect of csplat: it is reported for this scene, and the batch goes on
        traceback.print_exc()
        return EXIT_FAILED, f"a defect of csplat: {failure!r}", "E_DEFECT"
    return 0, "", ""


def _json(text: str) -> Any:
    try:
        return json.loads(text)
    except ValueError:
        return None


def _forget_peak() -> None:
    """Reset the system's peak memory of this process; if that fails, the peak of all scenes so far is reported."""
    with suppress(OSError):
        Path("/proc/self/clear_refs").write_text("5", "ascii")


def _peak() -> int | None:
    """Return the peak memory of this process in bytes; `None` if the system does not report it."""
    with suppress(OSError, ValueError):
        for line in Path("/proc/self/status").read_text("utf-8", "replace").splitlines():
            if line.startswith("VmHWM:"):
                return int(line.split()[1]) * 1024
    return None


if __name__ == "__main__":
    main()

"""Errors of the command line: one line on standard error, and a status."""

from __future__ import annotations

import errno
import os
import re
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NoReturn

import typer

from csplat.disk_files import is_temporary, temporary_root
from csplat.errors import CsplatError, InputError, LimitError
from csplat.file_source import named_errors
from csplat_tools.console import STANDARD_OUTPUT, note

EXIT_FAILED = 1
EXIT_USAGE = 2
EXIT_INTERRUPTED = 130  # 128 + SIGINT, as in shells

#: Base class of the errors that typer raises for a command line; typer exports only one of its subclasses.
UsageError: type[Exception] = typer.BadParameter.__bases__[0]

_AGAIN = "copy or download it again"
_NEWER = "a newer csplat may know it"
_INVALID = ("the file contradicts itself", f"{_AGAIN}; `csplat verify` lists all that is wrong")
_DAMAGED = ("the file is damaged", _AGAIN)
#: By error code of the format: the defect, and the remedy. The viewer has the same in `tools/viewer/messages.mjs`.
_DEFECTS = {
    "E_MAGIC": ("not a .csplat file", "`csplat encode` makes one of a PLY"),
    "E_VERSION": ("written in another version of the format", _NEWER),
    "E_TRUNCATED": ("the file ends too early", _AGAIN),
    "E_TRAILING": ("something follows the end of the file", _AGAIN),
    "E_CRC": _DAMAGED,
    "E_CODER": _DAMAGED,
    "E_UNSUPPORTED": ("", _NEWER),
    "E_STORE": ("", "nothing was kept; try again"),
    "E_LIMIT": (
        "the scene is larger than is allowed here",
        "`csplat decode` and `csplat verify` take scenes of any size",
    ),
}
_LONG_TEXT = (
    "its metadata or cameras take more memory than is allowed here",
    "in Python `csplat.decode(file, limits=csplat.decoder.Limits(json_bytes=...))` reads them",
)
_LOST_URL = re.compile(r"([a-z][a-z0-9+]+):/+(.+)")  # a URL read as a path, which loses a slash
_OS_ADVICE = {
    errno.ENOENT: "is the name right?",
    errno.EACCES: "check its permissions",
    errno.EISDIR: "name a file",
    errno.EIO: "the disk or the connection to it failed; try again, or use a copy elsewhere",
    errno.ELOOP: "the links lead back to themselves; name another file",
    errno.ENAMETOOLONG: "choose a shorter name",
    errno.EROFS: "choose another location",
    errno.ENOSPC: "no partial file was left; free some space, or choose another location",
    errno.EFBIG: "no partial file was left; choose another location",
    errno.EDQUOT: "no partial file was left; free some space, or choose another location",
}
_EMPTY_PHRASES = re.compile(r"^Invalid value: |(?<=: )Value error, |\.$")  # in typer's messages

_IN_PYTHON = "is an argument of {} in Python now"
#: Removed options, and what replaces them. They are refused with this message for one version.
RENAMED_OPTIONS = {
    **dict.fromkeys(
        ("--max-classes", "--deflate-level", "--attribute-psnr", "--threads", "--seed"),
        _IN_PYTHON.format("csplat.EncodeOptions"),
    ),
    **dict.fromkeys(("--size", "--test-every", "--near"), _IN_PYTHON.format("csplat_tools.DataOptions")),
    **dict.fromkeys(
        ("--views", "--view-size", "--validation-count", "--split", "--background"),
        _IN_PYTHON.format("csplat_tools.find_view_set"),
    ),
    **dict.fromkeys(("--modes", "--iterations"), _IN_PYTHON.format("csplat_tools.SweepOptions")),
    **dict.fromkeys(("--amplify", "--memory"), _IN_PYTHON.format("csplat_tools.compare")),
    **dict.fromkeys(("--previews", "--preview-every", "--lpips-weights"), _IN_PYTHON.format("csplat_trainer.Outputs")),
    **dict.fromkeys(
        ("--matrices", "--no-matrices"), _IN_PYTHON.format("csplat_tools.optimise.scene_sensitivity.measure_scene")
    ),
    "--plot": _IN_PYTHON.format("csplat_tools.training.training_run.run_training"),
    "--keep-unseen": _IN_PYTHON.format("csplat_tools.training.tuning_run.run_finetuning"),
    "--prune-unseen": _IN_PYTHON.format("csplat_tools.encode_file.encode_file"),
    **dict.fromkeys(("-o", "--output"), "is gone: the output is the last argument, as in `csplat encode IN OUT`"),
    **dict.fromkeys(("--crop-box", "--crop-sphere"), "is part of --crop now: six numbers are a box, four a sphere"),
    **dict.fromkeys(("--verbose", "-v"), "is gone: --json and --junit have a result for each check"),
    "-j": "is called --jobs now",
    "--aside": "is validation_count of csplat_tools.find_view_set in Python now",
    "--axes": "is an option of `csplat convert`, and coordinate_system of scenes in Python",
    "--checkpoint-every": "is gone: checkpoints are written every 1,000 steps",
    "--clause": "is part of --filter now, as in --filter 'HDR-*'",
    "--exact": "is exact of csplat_conformance.decoder_suite.DecoderSuiteOptions in Python now",
    "--from": "is an option of encode and convert: convert the scene first",
    "--grades": "is max_classes of csplat.EncodeOptions in Python now",
    "--images": "is part of the data set's path now, as in SET/images_4",
    "--importance": "is an option of `csplat encode`, and an argument of run_finetuning in Python",
    "--keep-all": "is called --no-prune now",
    "--lambda": "is an option of `csplat finetune`, and byte_cost of FinetuneOptions in Python",
    "--lpips": "is an option of `csplat compare`, and an argument of read_setting and run_finetuning in Python",
    "--lr-factor": "is FinetuneOptions.scaled in Python now",
    "--mode": "is called --backend now: cpu, exact, fast, gpu or auto",
    "--max-loss": "is called --max-psnr-drop now",
    "--no-antialiased": "is antialiased of scenes in Python now",
    "--plots": "is gone: -o PAGE.html has the plots",
    "--preset": "is an option of `csplat encode`: encode the scene first",
    "--set": "is gone: EncodeOptions, FinetuneOptions, SimplifyOptions and TrainOptions take such settings in Python",
    "--render-cmd": "is part of --cmd now: a command with {camera} is a renderer",
    "--sh-degree": "is gone here: `csplat convert --sh-degree` writes a scene with fewer bands",
    "--source-index": "is an option of encode, finetune, verify and compare",
    "--strict": "is an argument of csplat.read in Python now; `csplat lint` lists defects",
    "--work": "is gone: the working folder is OUT.work",
}


@contextmanager
def report_errors() -> Iterator[None]:
    """Turn expected errors into one line on standard error and status 1.

    Defects of csplat itself still end in a traceback: a bug report needs it.

    Raises:
        typer.Exit: an error was printed, the command was interrupted, or standard output was closed.
    """
    try:
        yield
        with named_errors(STANDARD_OUTPUT):
            sys.stdout.flush()  # a closed pipe shows here, not when the interpreter ends
    except CsplatError as error:
        _fail(_csplat_error(error), error.code)
    except BrokenPipeError:
        _drop_stdout()
        raise typer.Exit(EXIT_FAILED) from None
    except OSError as error:
        if error.filename == STANDARD_OUTPUT:
            _drop_stdout()
        _fail(_os_error(error), errno.errorcode.get(error.errno or 0, ""))
    except MemoryError:
        _fail("out of memory", "")
    except KeyboardInterrupt:
        note("interrupted")
        raise typer.Exit(EXIT_INTERRUPTED) from None


def usage_message(error: Any) -> str:
    """Return the message of an error in a command line, in one line; for a removed option, its replacement."""
    option = getattr(error, "option_name", None) or ""
    if option in RENAMED_OPTIONS and "No such option" in error.format_message():
        return f"{option} {RENAMED_OPTIONS[option]}"
    return " ".join(_EMPTY_PHRASES.sub("", error.format_message()).split())


def refuse_command_line(error: Any) -> NoReturn:
    """Print an error in a command line, in the form of other errors, and exit with status 2."""
    message = usage_message(error)
    if message:  # empty for a command line without arguments: help is printed already
        command = error.ctx.command_path if error.ctx is not None else "csplat"
        helps = f"`{command} --help`" if error.ctx is not None else "`csplat COMMAND --help`"
        note(f"error: {command}: {message}; {helps} lists the options (E_USAGE)")
    sys.exit(EXIT_USAGE)


def _fail(message: str, code: str) -> NoReturn:
    message = " ".join(message.split())
    note(f"error: {message}" + (f" ({code})" if code and not re.search(rf"\b{code}\b", message) else ""))
    raise typer.Exit(EXIT_FAILED) from None


def _csplat_error(error: CsplatError) -> str:
    """Return the message of an error: the file, the defect in plain words, the details, and the remedy."""
    what, advice = _DEFECTS.get(error.code, ("", "") if isinstance(error, InputError) else _INVALID)
    if isinstance(error, LimitError) and error.limit == "json_bytes":
        what, advice = _LONG_TEXT
    message = str(error)
    parts = [error.path] if error.path is not None and Path(error.path).name not in message else []
    parts += [part for part in (what, message) if part]
    return ": ".join(parts) + (f"; {advice}" if advice else "")


def _os_error(error: OSError) -> str:
    reason = error.strerror or str(error) or type(error).__name__
    number = error.errno or 0
    name = None if error.filename is None else os.fsdecode(error.filename)
    if name is None:
        return reason
    if name == STANDARD_OUTPUT:
        return f"{name}: {reason}; the output is incomplete"
    if is_temporary(name):
        return f"temporary files in {temporary_root()}: {reason}; TMPDIR names another folder"
    if number == errno.ENOENT and (url := _LOST_URL.match(name)):
        return f"{url[1]}://{url[2]} is a URL, expected a file: download it first; extract and batch read URLs"
    return f"{name}: {reason}" + (f"; {_OS_ADVICE[number]}" if number in _OS_ADVICE else "")


def _drop_stdout() -> None:
    """Redirect standard output to the null device, so that the interpreter's flush at exit cannot fail."""
    try:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    except (OSError, ValueError):
        return  # standard output is not a file here

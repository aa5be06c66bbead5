"""One run of an encoder over one input: where its files lie, and what it leaves behind."""

from __future__ import annotations

import shutil
import tempfile
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

from csplat.files import atomic_writer
from csplat_conformance.encoders.inputs import Input
from csplat_conformance.process import Ended, run_program

#: Runs a command line with some places put in, within some seconds, without a process of its own.
Runner = Callable[[str, Mapping[str, str], float], Ended]

#: Places that a command line must have, and may have.
PLACES, OPTIONAL_PLACES = ("ply", "out"), ("index",)
#: From the start of a run to that of its repetition: a time stamp in seconds is another one by then.
AGAIN_SECONDS = 1.1

_NAMES = {"ply": "in.ply", "out": "out.csplat", "index": "out.npy"}


@dataclass(frozen=True)
class Trial:
    """One run.

    Attributes:
        ended: how the process ended.
        out: path where the file was to be written.
        index: path of the source index; `None` if the command line has no place for it.
        traces: what the run did in addition to writing its output, a line each.
        started: time of the start, in seconds of `time.monotonic`.
    """

    ended: Ended
    out: Path
    index: Path | None
    traces: tuple[str, ...]
    started: float

    @property
    def wrote(self) -> bool:
        """True if there is a file, and the exit status reports success."""
        return self.ended.status is None and self.ended.returncode == 0 and self.out.is_file()


def try_once(command: str, one: Input, folder: Path, seconds: float, run: Runner | None) -> Trial:
    """Run an encoder once.

    Args:
        command: its command line.
        one: the input.
        folder: folder for input and output; existing files are replaced.
        seconds: it may take.
        run: runs it in this process; without it a process is started, in an empty working directory of its own.

    Raises:
        InputError: there is no such program.
    """
    ply = one.make()
    if folder.is_dir():
        shutil.rmtree(folder)  # kept from an earlier run
    folder.mkdir(parents=True)
    places = {
        name: folder / _NAMES[name] for name in (*PLACES, *OPTIONAL_PLACES) if name in PLACES or _has(command, name)
    }
    with atomic_writer(places["ply"]) as stream:
        stream.write(ply)
    named = {name: str(path) for name, path in places.items()}
    traces: list[str] = []
    started = time.monotonic()
    if run is not None:
        ended = run(command, named, seconds)
    else:
        with tempfile.TemporaryDirectory(prefix="csplat-cwd-") as cwd:
            ended = run_program(command, named, seconds, cwd=Path(cwd))
            traces += [f"left {name} in its working directory" for name in _names(Path(cwd))]
    # A refusal that leaves its output is a status of its own.
    outputs = {_NAMES["ply"], _NAMES["out"]} | ({_NAMES["index"]} if ended.returncode == 0 else set())
    left = [name for name in _names(folder) if name not in outputs]
    traces = [*_harm(places["ply"], ply), *(f"left {name} beside the output" for name in left), *traces]
    return Trial(ended, places["out"], places.get("index"), tuple(traces), started)


def _has(command: str, name: str) -> bool:
    return f"{{{name}}}" in command


def _names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir()) if folder.is_dir() else []


def _harm(path: Path, content: bytes) -> list[str]:
    """Say what became of the input."""
    try:
        return [] if path.read_bytes() == content else ["the input was modified"]
    except OSError:
        return ["the input is gone"]

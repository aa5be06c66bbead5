"""Measure `csplat batch` on many small scenes, some of them broken, compared with a shell loop; interrupt it midway.

    python -m csplat_bench.codec.batch
    python -m csplat_bench.codec.batch --count 40 --broken 4 --splats 500

Scenes are parts of the sample, in every format that is read and written but our own. Seconds are wall time. "Again" is
the number of scenes that a run did although one before had noted them as done.
"""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

from csplat.formats import formats, write
from csplat.model import SplatModel
from csplat.ply import read_ply
from csplat_bench.common.command import JSON, MARKDOWN, run
from csplat_bench.common.report import table, tell_machine, write_json
from csplat_bench.common.scenes import find_scenes
from csplat_tools.console import note

#: Ends a batch that writes to a folder.
End = Callable[[subprocess.Popen[str], Path], None]

_PROGRAM = [sys.executable, "-m", "csplat_tools"]
_QUICK = ["--no-thumbnails"]
_LOOK = 0.02  # seconds from one look at the journal to the next


def main(
    *,
    count: Annotated[int, typer.Option(help="scenes, the broken ones among them")] = 200,
    broken: Annotated[int, typer.Option(help="broken ones")] = 10,
    splats: Annotated[int, typer.Option(help="of each scene")] = 2000,
    workers: Annotated[int, typer.Option(help="processes")] = 2,
    markdown: MARKDOWN = False,
    json: JSON = None,
) -> None:
    """Make scenes, run all, print a table."""
    machine = tell_machine()
    with tempfile.TemporaryDirectory(prefix="csplat-batch-") as folder:
        rows = _measured(Path(folder), count, broken, splats, workers)
    header = ("run", "s", "done", "done before", "failed", "again")
    print(table(header, [[str(cell) for cell in row] for row in rows], markdown=markdown))
    if json is not None:
        write_json(json, {"machine": machine, "rows": [dict(zip(header, row, strict=True)) for row in rows]})


def _measured(folder: Path, count: int, broken: int, splats: int, workers: int) -> list[tuple[Any, ...]]:
    scenes = folder / "scenes"
    make_scenes(scenes, count, broken, splats)
    rows: list[tuple[Any, ...]] = []

    def add(name: str, words: Sequence[str], out: str, end: End | None) -> None:
        rows.append((name, *_batch(scenes, folder / out, ["--workers", str(workers), *words], end)))
        note(f"{name}: {rows[-1][1]} s")

    for at_once in (1, workers):
        rows.append(_loop(scenes, folder / f"loop{at_once}", at_once))
        note(f"{rows[-1][0]}: {rows[-1][1]} s")
    add("csplat batch", [], "plain", None)
    _compare(folder / "loop1", folder / "plain")
    add("the same again", [], "plain", None)
    add("csplat batch --no-thumbnails", _QUICK, "quick", None)
    half = count // 2
    for name, out, end in (
        ("interrupted at half", "interrupted", lambda process, _: process.send_signal(signal.SIGINT)),
        ("killed at half", "killed", lambda process, _: process.kill()),
        (
            "a worker killed at half",
            "lost",
            lambda process, _: os.kill(_children(process.pid)[0], signal.SIGKILL),
        ),
    ):
        add(name, _QUICK, out, _at(half, end))
        add("... and run again", _QUICK, out, None)
        _compare(folder / "loop1", folder / out)
    return rows


def make_scenes(folder: Path, count: int, broken: int, splats: int) -> None:
    """Parts of the sample in all formats in turn, and broken files."""
    folder.mkdir()
    source = read_ply(find_scenes(["sample"])[0].path)
    kinds = [one for one in formats() if one.open is not None and one.write is not None and one.name != "csplat"]
    for number in range(count - broken):
        kind = kinds[number % len(kinds)]
        rows = np.random.default_rng(number).choice(len(source), splats, replace=False)
        write(folder / f"scene{number:04d}{kind.suffixes[0]}", source.select(np.sort(rows)), kind.name)
    whole = sorted(folder.iterdir())
    for number in range(broken):
        _break(folder, whole[number], number, source.select(slice(0, splats)))


def _break(folder: Path, whole: Path, number: int, model: SplatModel) -> None:
    """One of: a half, text, nothing, another beginning, all positions NaN."""
    ending = "".join(whole.suffixes)
    target = folder / f"broken{number:04d}"
    data = whole.read_bytes()
    match number % 5:
        case 0:
            target.with_name(target.name + ending).write_bytes(data[: len(data) // 2])
        case 1:
            target.with_name(target.name + ".spz").write_bytes(b"no scene but a line of text\n")
        case 2:
            target.with_name(target.name + ".glb").write_bytes(b"")
        case 3:
            target.with_name(target.name + ending).write_bytes(b"WRONG" + data[5:])
        case _:
            _write_nan(target.with_name(target.name + ".ply"), model)


def _write_nan(path: Path, model: SplatModel) -> None:
    write(path, replace(model, extra={}))
    data = path.read_bytes()
    head = data.index(b"end_header\n") + len(b"end_header\n")
    path.write_bytes(data[:head] + np.full((len(data) - head) // 4, np.nan, "<f4").tobytes())


def _loop(scenes: Path, out: Path, at_once: int) -> tuple[Any, ...]:
    """Encode the scenes with `csplat encode` in a shell, `at_once` at a time with `xargs -P`; return a table row."""
    out.mkdir()
    program = " ".join(_PROGRAM)
    one = f'n="$(basename "$1")"; {program} encode "$1" "{out}/${{n%%.*}}.csplat" --quiet 2>/dev/null || echo failed'
    begun = time.perf_counter()
    done = subprocess.run(
        ["sh", "-c", f"ls -d {scenes}/* | xargs -P {at_once} -I {{}} sh -c '{one}' sh {{}}"],
        capture_output=True, text=True, check=True,
    )  # fmt: skip
    seconds = time.perf_counter() - begun
    name = "a loop of csplat encode" if at_once == 1 else f"xargs -P {at_once}"
    return name, f"{seconds:.1f}", len(list(out.iterdir())), 0, done.stdout.count("failed"), 0


def _batch(scenes: Path, out: Path, words: Sequence[str], end: End | None) -> tuple[Any, ...]:
    """Run `csplat batch`, interrupted by `end` if given; return seconds and the counts of its report."""
    before = _done(out)
    begun = time.perf_counter()
    command = [*_PROGRAM, "batch", str(scenes), str(out), *words, "--json", "--quiet"]
    process = subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True,
        preexec_fn=_heed_interrupts,  # noqa: PLW1509  # it sets one signal
    )  # fmt: skip
    if end is not None:
        end(process, out)
    text, _ = process.communicate()
    seconds = f"{time.perf_counter() - begun:.1f}"
    if not text:
        return seconds, len(_done(out) - before), len(before), "-", "-"
    said = json.loads(text)
    return seconds, said["done"], said["done_before"], said["failed"], max(0, len(before) - said["done_before"])


def _heed_interrupts() -> None:
    """Restore the default handling of SIGINT: background jobs of a shell, and their children, ignore it."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)


def _at(count: int, end: End) -> End:
    """Return `end` delayed until `count` scenes are done."""

    def waiting(process: subprocess.Popen[str], out: Path) -> None:
        while len(_done(out)) < count and process.poll() is None:
            time.sleep(_LOOK)
        end(process, out)

    return waiting


def _done(out: Path) -> set[str]:
    """Outputs that the journal has as done."""
    if not (out / "batch.jsonl").exists():
        return set()
    found = set()
    for line in (out / "batch.jsonl").read_text().splitlines():
        try:
            said = json.loads(line)
        except ValueError:
            continue
        if said["state"] == "done":
            found.add(said["output"])
    return found


def _children(pid: int) -> list[int]:
    """Processes that a process started."""
    tasks = Path(f"/proc/{pid}/task").glob("*/children")
    return [int(word) for one in tasks for word in one.read_text().split()]


def _compare(wanted: Path, found: Path) -> None:
    """Check that all files are there, and no other bytes than a loop makes."""
    for one in sorted(wanted.iterdir()):
        if one.read_bytes() != (found / one.name).read_bytes():
            raise AssertionError(f"{one.name} differs")
    left = [one for one in found.rglob(".*") if one.is_file()]
    if left:
        raise AssertionError(f"left behind: {left}")
    shutil.rmtree(found / "thumbnails", ignore_errors=True)


if __name__ == "__main__":
    sys.exit(run(main))

# SPDX-License-Identifier: Apache-2.0
"""`csplat batch` on small scenes, some of them invalid, compared with a shell loop; interrupted midway and resumed.

Options: `count` scenes, of which `invalid` are not valid, of `splats` splats each; they are parts of the scene, in
every format but our own. Outputs are compared with those of the loop byte by byte.
A case is a `loop` of N processes, or a batch with `workers`, into the folder `out`; `end` is interrupt, kill, or
kill-worker: what happens to it when half of the scenes are done. A case with the `out` of an earlier one resumes it.
"""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from csplat.formats import formats, write
from csplat.model import SplatModel
from csplat.ply import read_ply
from csplat_bench.protocol import Measure, Setup
from csplat_bench.scenes import find_scene
from csplat_bench.suites import Case

_POLL_SECONDS = 0.02  # from one look at the outputs to the next

_ENDS: dict[str, Callable[[subprocess.Popen[str]], None]] = {
    "interrupt": lambda process: process.send_signal(signal.SIGINT),
    "kill": lambda process: process.kill(),
    "kill-worker": lambda process: os.kill(_children(process.pid)[0], signal.SIGKILL),
}


@contextmanager
def measure_batches(setup: Setup, name: str, _: Sequence[Case]) -> Iterator[Measure]:
    """Yield the function that runs a loop or a batch."""
    options = setup.options
    with tempfile.TemporaryDirectory(prefix="csplat-batch-") as temporary:
        folder = Path(temporary)
        source = read_ply(find_scene(name, setup.data, setup.work).path)
        make_scenes(folder / "scenes", source, options["count"], options["invalid"], options["splats"])

        def measure(case: Case) -> Mapping[str, Any]:
            if "loop" in case.settings:
                return _loop(setup.csplat, folder / "scenes", folder / "loop", case["loop"])
            out, end = folder / case["out"], case.get("end")
            values = _batch(setup.csplat, folder / "scenes", out, case["workers"], end, options["count"] // 2)
            if end is None and (folder / "loop").exists():
                compare_folders(folder / "loop", out)
            return values

        yield measure


def make_scenes(folder: Path, source: SplatModel, count: int, invalid: int, splats: int) -> None:
    """Write parts of a scene in all formats in turn, and invalid files."""
    folder.mkdir()
    kinds = [one for one in formats() if one.open is not None and one.write is not None and one.name != "csplat"]
    for number in range(count - invalid):
        kind = kinds[number % len(kinds)]
        rows = np.random.default_rng(number).choice(len(source), splats, replace=False)
        write(folder / f"scene{number:04d}{kind.suffixes[0]}", source.select(np.sort(rows)), kind.name)
    valid = sorted(folder.iterdir())
    for number in range(invalid):
        _write_invalid(folder / f"invalid{number:04d}", valid[number], source.select(slice(0, splats)), number % 5)


def _write_invalid(target: Path, valid: Path, model: SplatModel, kind: int) -> None:
    """Write half a file, text, an empty file, a file with another beginning, or a PLY whose positions are NaN."""
    suffix, data = "".join(valid.suffixes), valid.read_bytes()
    contents = {0: (suffix, data[: len(data) // 2]), 1: (".spz", b"no scene\n"), 2: (".glb", b"")}
    contents[3] = suffix, b"WRONG" + data[5:]
    if kind in contents:
        suffix, data = contents[kind]
        target.with_name(target.name + suffix).write_bytes(data)
        return
    path = target.with_name(f"{target.name}.ply")
    write(path, replace(model, extra={}))
    data = path.read_bytes()
    head = data.index(b"end_header\n") + len(b"end_header\n")
    path.write_bytes(data[:head] + np.full((len(data) - head) // 4, np.nan, "<f4").tobytes())


def _loop(csplat: Sequence[str], scenes: Path, out: Path, processes: int) -> dict[str, Any]:
    """Encode the scenes with `csplat encode`, several at a time by `xargs -P`."""
    shutil.rmtree(out, ignore_errors=True)
    out.mkdir()
    program = " ".join(csplat)
    one = f'n="$(basename "$1")"; {program} encode "$1" "{out}/${{n%%.*}}.csplat" --quiet 2>/dev/null || echo failed'
    words = ["sh", "-c", f"ls -d {scenes}/* | xargs -P {processes} -I {{}} sh -c '{one}' sh {{}}"]
    begun = time.perf_counter()
    done = subprocess.run(words, capture_output=True, text=True, check=True)
    seconds = time.perf_counter() - begun
    return {"seconds": seconds, "done": len(list(out.iterdir())), "failed": done.stdout.count("failed")}


def _batch(csplat: Sequence[str], scenes: Path, out: Path, workers: int, end: str | None, half: int) -> dict[str, Any]:
    """Run `csplat batch`; `repeated` counts scenes that it did again although their outputs existed."""
    before, begun = _done(out), time.perf_counter()
    words = [*csplat, "batch", str(scenes), str(out), "--workers", str(workers), "--json", "--quiet"]
    process = subprocess.Popen(
        words, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True,
        preexec_fn=_heed_interrupts,  # noqa: PLW1509  # it sets one signal
    )  # fmt: skip
    if end is not None:
        while len(_done(out)) < half and process.poll() is None:
            time.sleep(_POLL_SECONDS)
        _ENDS[end](process)
    text, _ = process.communicate()
    values: dict[str, Any] = {"seconds": time.perf_counter() - begun}
    if not text:
        return {**values, "done": len(_done(out) - before), "done_before": len(before)}
    report = json.loads(text)
    counts = {key: report[key] for key in ("done", "done_before", "failed")}
    return {**values, **counts, "repeated": max(0, len(before) - report["done_before"])}


def _heed_interrupts() -> None:
    """Restore the default handling of SIGINT: background jobs of a shell, and their children, ignore it."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)


def _done(out: Path) -> set[str]:
    """Return the names of the outputs, which appear when they are complete."""
    return {one.name for one in out.glob("*.csplat")}


def _children(pid: int) -> list[int]:
    return [int(child) for one in Path(f"/proc/{pid}/task").glob("*/children") for child in one.read_text().split()]


def compare_folders(expected: Path, found: Path) -> None:
    """Check that a batch wrote the same bytes as the loop, and left no temporary files.

    Raises:
        OSError: a file differs or is left over.
    """
    for one in sorted(expected.iterdir()):
        if one.read_bytes() != (found / one.name).read_bytes():
            raise OSError(f"{one.name} differs from that of the loop")
    left = [one for one in found.rglob(".*") if one.is_file()]
    if left:
        raise OSError(f"temporary files are left: {left}")

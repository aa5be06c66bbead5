"""Measure commands on scenes that do not fit the memory: seconds, and what all their processes hold at once.

    python -m csplat_bench.codec.large --scene fox120k --counts 1M,10M,100M --sh-degree 0 --memory 2GB
    python -m csplat_bench.codec.large --files lod-meta.json --memory 500MB,2GB --threads 1,2

Scenes are copies of one, side by side, each a little different in every number. Memory is the sum over the command and
its processes of what each holds alone and its share of what they have in common (PSS), looked at five times a second:
the most that was seen. Files are written anew for each line of the table, and their CRC-32 shows which are equal.
"""

from __future__ import annotations

import os
import subprocess
import sys
import time
import zlib
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Annotated

import numpy as np
import typer

from csplat import read_ply
from csplat.ply import write_scene_ply
from csplat.scene_source import SceneSource as Blocks
from csplat_bench.common.command import CACHE, JSON, listed, run
from csplat_bench.common.making import copies
from csplat_bench.common.report import Table, laid_out, tell_machine, write_json
from csplat_bench.common.scenes import MADE, find_scenes

_EVERY = 0.2  # seconds from one look at the memory to the next
_UNITS = {"k": 1_000, "M": 1_000_000}


@dataclass(frozen=True)
class Stage:
    """A command: seconds, the most memory of all its processes, and which bytes came out."""

    source: str
    command: str
    options: str
    seconds: float
    peak_bytes: int
    size_bytes: int
    crc: str


def main(
    *,
    scene: Annotated[str, typer.Option(help="what large scenes are made of")] = "fox120k",
    counts: Annotated[str, typer.Option(help="splats, separated by commas")] = "1M,3M",
    files: Annotated[str, typer.Option(help="scenes that are there, in place of those")] = "",
    sh_degree: Annotated[int, typer.Option(help="of what is made")] = 0,
    memory: Annotated[str, typer.Option(help="bounds, separated by commas")] = "2GB",
    threads: Annotated[str, typer.Option(help="numbers of processes, separated by commas")] = str(os.cpu_count()),
    stages: Annotated[str, typer.Option(help="of encode, decode, verify, prove")] = "encode,decode,verify,prove",
    json: JSON = None,
    cache: CACHE = MADE,
) -> None:
    """Measure encoding and the way back, and print a table."""
    machine = tell_machine()
    wanted = listed(stages)
    found: list[Stage] = []
    for path in map(Path, listed(files)) if files else _made(scene, counts, sh_degree, cache):
        target, back = cache / "large.csplat", cache / "large.ply"
        for bound in listed(memory):
            for count in listed(threads):
                options = ["--memory", bound, "--threads", count, "--force", "--quiet"]
                found.append(_measured("encode", [str(path), str(target), *options], path, target))
        if "decode" in wanted:
            found.append(_measured("decode", [str(target), str(back), "--force", "--quiet"], path, back))
            back.unlink()
        if "verify" in wanted:
            found.append(_measured("verify", [str(target), "--quiet"], path, target))
        for bound in listed(memory) if "prove" in wanted else ():
            words = [str(target), "--source", str(path), "--memory", bound, "--quiet"]
            found.append(_measured("verify", words, path, target))
        target.unlink()
    header = ("scene", "command", "options", "s", "peak, MB", "file, MB", "CRC-32")
    rows = [
        (one.source, one.command, one.options, f"{one.seconds:.1f}", f"{one.peak_bytes / 1e6:.0f}",
         f"{one.size_bytes / 1e6:.2f}", one.crc)
        for one in found
    ]  # fmt: skip
    print(laid_out([Table(header, rows)], markdown=False))
    if json is not None:
        write_json(json, {"machine": machine, "stages": [asdict(one) for one in found]})


def _made(name: str, counts: str, degree: int, cache: Path) -> Iterator[Path]:
    """Yield PLYs of these numbers of splats; each is removed after its measurement."""
    (scene,) = find_scenes([name], cache)
    model = read_ply(scene.path)
    model = replace(model, shN=np.ascontiguousarray(model.shN[:, : (degree + 1) ** 2 - 1]))
    for text in listed(counts):
        count = int(float(text.rstrip("kM")) * _UNITS.get(text[-1], 1))
        path = cache / f"{name}-{text}-sh{degree}.ply"
        write_scene_ply(path, Blocks(count, model.select(slice(0, 0)), partial(copies, model, count)))
        yield path
        path.unlink()


def _measured(command: str, words: Sequence[str], source: Path, result: Path) -> Stage:
    start, peak = time.perf_counter(), 0
    with subprocess.Popen([sys.executable, "-m", "csplat_tools", command, *words]) as process:
        while process.poll() is None:
            peak = max(peak, _held(process.pid))
            time.sleep(_EVERY)
    seconds = time.perf_counter() - start
    if process.returncode:
        raise ChildProcessError(f"csplat {command} ended with {process.returncode}")
    options = " ".join(word for word in words[1:] if word == "--source" or word[0].isdigit())
    return Stage(source.name, command, options, seconds, peak, result.stat().st_size, _crc(result))


def _held(root: int) -> int:
    """Bytes that a process and its descendants hold."""
    parents: dict[int, list[int]] = {}
    for entry in Path("/proc").iterdir():
        if entry.name.isdigit():
            with suppress(OSError, IndexError, ValueError):
                parent = int((entry / "stat").read_text().rsplit(")", 1)[1].split()[1])
                parents.setdefault(parent, []).append(int(entry.name))
    total, pending = 0, [root]
    while pending:
        process = pending.pop()
        pending += parents.get(process, [])
        with suppress(OSError, ValueError):
            text = Path(f"/proc/{process}/smaps_rollup").read_text("ascii", "replace")
            total += sum(int(line.split()[1]) * 1024 for line in text.splitlines() if line.startswith("Pss:"))
    return total


def _crc(path: Path) -> str:
    crc = 0
    with path.open("rb") as stream:
        while data := stream.read(1 << 20):
            crc = zlib.crc32(data, crc)
    return f"{crc:08x}"


if __name__ == "__main__":
    sys.exit(run(main))

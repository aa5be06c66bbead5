# SPDX-License-Identifier: Apache-2.0
"""Commands on scenes that do not fit the memory: seconds, the memory of all their processes, and the bytes they write.

A case's `command` is a csplat command line with `{scene}`, `{file}` (the encoded scene) and `{back}` (a decoded PLY);
`output` is the one that it writes. Without output it only reads. CRC-32 shows which files are equal.
"""

from __future__ import annotations

import shlex
import zlib
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from csplat_bench.measuring import run_program
from csplat_bench.protocol import Measure, Setup
from csplat_bench.scenes import find_scene
from csplat_bench.suites import Case


@contextmanager
def measure_commands(setup: Setup, name: str, _: Sequence[Case]) -> Iterator[Measure]:
    """Yield the function that runs a command; made scenes and files are removed afterwards."""
    scene = find_scene(name, setup.data, setup.work)
    paths = {"scene": scene.path, "file": setup.work / "large.csplat", "back": setup.work / "large.ply"}

    def measure(case: Case) -> Mapping[str, Any]:
        words = [argument.format(**paths) for argument in shlex.split(case["command"])]
        if "{file}" in case["command"] and case.get("output") != "file" and not paths["file"].exists():
            fast = ["--preset", "fast", "--quiet"]
            run_program([*setup.csplat, "encode", scene.path, paths["file"], *fast])
        force = ["--force"] if "output" in case.settings else []
        used = run_program([*setup.csplat, *words, *force, "--quiet"], sample_tree=True)
        values: dict[str, Any] = {
            "splats": scene.splat_count, "sh_degree": scene.sh_degree, "ply_bytes": scene.size_bytes,
            "seconds": used.wall, "cpu_seconds": used.cpu, "peak_bytes": used.tree_bytes,
        }  # fmt: skip
        if "output" in case.settings:
            written = paths[case["output"]]
            values |= {"size_bytes": written.stat().st_size, "crc32": _crc(written)}
        return values

    try:
        yield measure
    finally:
        for key, path in paths.items():
            if key != "scene" or path.parent == setup.work:
                path.unlink(missing_ok=True)


def _crc(path: Path) -> str:
    crc = 0
    with path.open("rb") as stream:
        while data := stream.read(1 << 20):
            crc = zlib.crc32(data, crc)
    return f"{crc:08x}"

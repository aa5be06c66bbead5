"""Measure every format that is written: bytes, what it keeps, and how fast it is written and read.

    python -m csplat_bench.codec.formats
    python -m csplat_bench.codec.formats --scenes donut,plane3 --no-peers --markdown

Seconds are processor time, of writing once and of reading the fastest of three; `psnr` is that of `csplat compare`
against the PLY. SPZ and SOG by splat-transform are listed next to ours, with the wall time of its command.
"""

from __future__ import annotations

import sys
import tempfile
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated

import typer

from csplat.formats import formats, read, write
from csplat.model import SplatModel
from csplat.ply import read_ply
from csplat_bench.common.command import CACHE, EXTRA, JSON, MARKDOWN, PEERS, SCENES, listed, run
from csplat_bench.common.measuring import timed
from csplat_bench.common.peers import find_splat_transform, judged, transform
from csplat_bench.common.report import optional, table, tell_machine, write_json
from csplat_bench.common.scenes import MADE, NPM, find_scenes
from csplat_render.scorer import Scorer
from csplat_tools.console import note
from csplat_tools.views import comparison_cameras

_SCENES = "donut,horse,plane3,lego60k"
_RUNS = 3


@dataclass(frozen=True)
class Row:
    """A file of a scene.

    Attributes:
        scene: its name.
        name: name of the format; of another program's file behind the program.
        size_bytes: size of the file.
        psnr: dB against the PLY; or why there is none.
        write_seconds, read_seconds: `None` if they are not ours.
        splats: number of splats in the scene.
    """

    scene: str
    name: str
    size_bytes: int
    psnr: float | str
    write_seconds: float | None
    read_seconds: float | None
    splats: int

    @property
    def cells(self) -> tuple[str, ...]:
        """The cells of its table row."""
        rate = None if self.read_seconds is None else self.splats / self.read_seconds / 1e6
        psnr = self.psnr if isinstance(self.psnr, str) else f"{self.psnr:.1f}"
        return (
            self.scene, self.name, f"{self.size_bytes:,}", f"{self.size_bytes / self.splats:.2f}", psnr,
            optional(self.write_seconds, "{:.2f}".format), optional(rate, "{:.1f}".format),
        )  # fmt: skip


def main(
    *,
    scenes: SCENES = _SCENES,
    extra: EXTRA = [],
    no_peers: Annotated[bool, typer.Option("--no-peers", help="leave splat-transform out")] = False,
    markdown: MARKDOWN = False,
    json: JSON = None,
    cache: CACHE = MADE,
    peers: PEERS = NPM,
) -> None:
    """Write the scenes that the command line names in every format, and print a table."""
    command, remark = (None, "left out") if no_peers else find_splat_transform(peers)
    machine = tell_machine(splat_transform=remark)
    rows: list[Row] = []
    for scene in find_scenes(listed(scenes), cache, extra):
        source = read_ply(scene.path)
        judge = Scorer.of_source(source, comparison_cameras(source))
        rows += _ours(scene.name, source, judge)
        for peer in transform(command, scene, cache) if command is not None else ():
            seconds = None if peer.timing is None else peer.timing.wall
            psnr = judged(command or [], peer, judge)
            rows.append(
                Row(scene.name, f"{peer.name}, splat-transform", peer.size_bytes, psnr, seconds, None, len(source))
            )
        note(scene.name)
    header = ("scene", "format", "bytes", "a splat", "dB", "written in s", "read, M splats/s")
    print(table(header, [row.cells for row in rows], markdown=markdown))
    if json is not None:
        write_json(json, {"machine": machine, "rows": [asdict(row) for row in rows]})


def _ours(name: str, source: SplatModel, judge: Scorer) -> list[Row]:
    found = []
    with tempfile.TemporaryDirectory(prefix="csplat-formats-") as folder:
        for one in formats():
            if one.open is None or one.write is None:
                continue
            path = Path(folder) / f"scene{one.suffixes[0]}"
            _, written = timed(write, path, source, one.name)
            runs = [timed(read, path, one.name) for _ in range(_RUNS)]
            seconds = min(timing.cpu for _, timing in runs)
            psnr = judge.psnr(runs[0][0])
            found.append(Row(name, one.name, path.stat().st_size, psnr, written.cpu, seconds, len(source)))
    return found


if __name__ == "__main__":
    sys.exit(run(main))

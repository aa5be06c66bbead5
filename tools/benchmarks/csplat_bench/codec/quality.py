"""Measure what the presets keep: bytes per splat, and `psnr` of the decoded scene against its source.

    python -m csplat_bench.codec.quality                        # the shared scenes; ten minutes
    python -m csplat_bench.codec.quality --scenes plane3 --no-peers
    python -m csplat_bench.codec.quality --extra other.ply --markdown
    python -m csplat_bench.codec.quality --no-peers --seeds 0,1,2,3,4

`psnr` is that of `csplat compare`: eight 640 by 480 views, black background, pooled. The cameras are those of the data
folder (psnr_cameras/NAME.json), else the virtual ones of the source.

With --seeds a second table compares the cameras of the data folder with those that `psnr` chooses by itself: the PSNR
by either, and by how much it differs for each seed. For the first seed, which is that of `psnr`, 1 dB is allowed.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Annotated

import typer

from csplat.decoder import decode
from csplat.encoder import EncodeOptions, encode
from csplat.model import SplatModel
from csplat.ply import read_ply
from csplat_bench.common.command import (
    CACHE,
    EXTRA,
    JSON,
    MARKDOWN,
    PEERS,
    PRESETS,
    SCENES,
    listed,
    numbers,
    preset_of,
    run,
)
from csplat_bench.common.measuring import timed
from csplat_bench.common.peers import find_splat_transform, judged, transform
from csplat_bench.common.report import table, tell_machine, write_json
from csplat_bench.common.scenes import MADE, NPM, Scene, find_scenes, given_cameras, judge_of
from csplat_render.scene_frame import scene_frame
from csplat_render.scorer import Scorer
from csplat_render.virtual_cameras import virtual_cameras
from csplat_tools.console import note

_SCENES = "fox120k,fox60k_noreg,lego60k,plane3,statue,donut,jacket,horse,angel,st-peter"
_LIMIT = 1.0  # dB: largest difference between the cameras of the data folder and those that `psnr` chooses


@dataclass(frozen=True)
class Quality:
    """A file of a scene.

    Attributes:
        name: name of the preset or format.
        bytes_per_splat: bytes per splat of the source.
        psnr: dB; or why there is none.
        differences: PSNR by virtual cameras minus this one, by seed, dB.
    """

    name: str
    bytes_per_splat: float
    psnr: float | str
    differences: tuple[float, ...] = ()

    @property
    def cell(self) -> str:
        """Both figures, as tables have them."""
        return self.psnr if isinstance(self.psnr, str) else f"{self.bytes_per_splat:.2f} at {self.psnr:.1f}"


def main(
    *,
    scenes: SCENES = _SCENES,
    extra: EXTRA = [],
    presets: PRESETS = "fast,balanced,small",
    no_peers: Annotated[bool, typer.Option("--no-peers", help="leave SPZ out")] = False,
    seeds: Annotated[str, typer.Option(help="of virtual cameras to compare with, separated by commas")] = "",
    markdown: MARKDOWN = False,
    json: JSON = None,
    cache: CACHE = MADE,
    peers: PEERS = NPM,
) -> None:
    """Measure the scenes that the command line names, and print a table or two."""
    command, remark = (None, "left out") if no_peers else find_splat_transform(peers)
    machine = tell_machine(SPZ=remark)
    chosen, measured = numbers(seeds, int), dict[Scene, tuple[str, list[Quality]]]()
    for scene in find_scenes(listed(scenes), cache, extra):
        source = read_ply(scene.path)
        found, timing = timed(_files, scene, source, listed(presets), chosen)
        if command is not None:
            peer = transform(command, scene, cache)[0]
            psnr = judged(command, peer, judge_of(scene.name, source))
            found.append(Quality(peer.name, peer.size_bytes / len(source), psnr))
        measured[scene] = scene_frame(source).kind, found
        note(f"{scene.name}: {timing.wall:.1f} s")
    columns = [*listed(presets), *(["SPZ"] if command else [])]
    rows = [
        (scene.name, f"{scene.splat_count:,}, {scene.sh_degree}", *(one.cell for one in found))
        for scene, (_, found) in measured.items()
    ]
    print(table(("B/splat at dB", "splats, SH", *columns), rows, markdown=markdown))
    if chosen:
        print(f"\n{_camera_table(measured, chosen, markdown=markdown)}")
    if json is not None:
        figures = {scene.name: [asdict(one) for one in found] for scene, (_, found) in measured.items()}
        write_json(json, {"machine": machine, "seeds": chosen, "scenes": figures})


def _files(scene: Scene, source: SplatModel, presets: Sequence[str], seeds: Sequence[int]) -> list[Quality]:
    """A file of each preset, judged."""
    judge = judge_of(scene.name, source)
    compared = seeds if given_cameras(scene.name) else ()
    others = [Scorer.of_source(source, virtual_cameras(source, seed=seed)) for seed in compared]
    found = []
    for preset in presets:
        data = encode(source, EncodeOptions(preset=preset_of(preset)))
        model = decode(data)
        psnr = judge.psnr(model)
        found.append(Quality(preset, len(data) / len(source), psnr, tuple(one.psnr(model) - psnr for one in others)))
    return found


def _camera_table(measured: dict[Scene, tuple[str, list[Quality]]], seeds: Sequence[int], *, markdown: bool) -> str:
    """Return a table of PSNR by the cameras of the data folder, and by those that `psnr` chooses."""
    rows, off = [], 0.0
    for scene, (kind, found) in measured.items():
        for one in found:
            if one.differences and not isinstance(one.psnr, str):
                differences = (f"{difference:+.2f}" for difference in one.differences)
                own = one.psnr + one.differences[0]
                rows.append((scene.name, kind, one.name, f"{one.psnr:.2f}", f"{own:.2f}", *differences))
                off = max(off, abs(one.differences[0]))
    header = ("scene", "kind", "preset", "given dB", "own dB", *(f"seed {seed}" for seed in seeds))
    limit = f"largest difference with seed {seeds[0]}: {off:.2f} dB, allowed are {_LIMIT:g} dB"
    return f"{table(header, rows, markdown=markdown)}\n{limit}"


if __name__ == "__main__":
    sys.exit(run(main))

"""Measure how fast decoders are, ours and those of others, and how much memory they take.

    python -m csplat_bench.codec.decoders                # all that can be had; a quarter of an hour, 15 GB of memory
    python -m csplat_bench.codec.decoders --scenes lego60k,donut --places native,node --presets balanced
    python -m csplat_bench.codec.decoders --no-peers --scenes '' --extra scene.ply      # ours alone, a scene of yours

Times are from bytes in memory to arrays, all checks included. All decoders hold the same scene at the same time and
take turns, so that what else the machine does hits all alike. A cell has M splats/s (median of the runs), and how many
times as fast that is as SPZ's own library at the same place with its file of version 4, all values as float32: the
library in C++ for C and Python, @adobe/spz for Node and for Chromium (median of the ratios within a turn). Peak is how
much a new process grows at most while it decodes for the first time, as a multiple of the arrays that come out; first
is how many times as long that decoding takes as later ones; both of the scene with the largest arrays. Those that
deliver anything but float32, or not all of SH, do less and are there for information.

Others get files that their owners' libraries write by default, which keep less than ours (codec/FIGURES.md). Packages
and programs are made in a folder (--peers): it requires npm; cc; git, c++, zlib and libzstd with headers; Chromium and
playwright. What cannot be had is left out, and said. Whether our decoders agree: csplat_bench.codec.decoders.agree.
"""

from __future__ import annotations

import shutil
import statistics
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated

import typer

from csplat import EncodeOptions, encode
from csplat.formats import write
from csplat.ply import read_ply, write_ply
from csplat_bench.codec.decoders.started import DECODERS, Decoder, Process, Tab, built
from csplat_bench.common.browser import open_page, serve
from csplat_bench.common.command import CACHE, EXTRA, JSON, MARKDOWN, PEERS, PRESETS, SCENES, listed, preset_of, run
from csplat_bench.common.report import optional, table, tell_machine, write_json
from csplat_bench.common.scenes import MADE, NPM, ROOT, Scene, find_scenes
from csplat_tools.console import note

_SCENES = "lego60k,fox120k,fontaine,fox-1M,donut,donut-1M"
Start = Callable[[Decoder, Path], Process | Tab]

_WARM_SPLATS = 1_000_000  # splats of the warm-up: after several decodings JavaScript is compiled
_PLACES = "native,python,node,chromium"


@dataclass(frozen=True)
class Row:
    """A decoder on a file of a scene.

    Attributes:
        scene, splats, sh_degree: name, number of splats and SH degree of the scene.
        place, decoder, delivers: `place`, `name` and `delivers` of `Decoder`.
        file, file_bytes: its suffix and size.
        first_seconds, seconds: time of the first decoding of a process or page, and of each run after many more.
        array_bytes: size of the decoded arrays.
        growth_bytes: growth of the process during the first decoding.
        ratio: speed relative to the reference.
    """

    scene: str
    splats: int
    sh_degree: int
    place: str
    decoder: str
    delivers: str
    file: str
    file_bytes: int
    first_seconds: float
    seconds: list[float]
    array_bytes: int
    growth_bytes: int | None
    ratio: float | None


def main(
    *,
    scenes: SCENES = _SCENES,
    extra: EXTRA = [],
    presets: PRESETS = "fast,balanced,small",
    places: Annotated[str, typer.Option(help="where decoders run")] = _PLACES,
    runs: Annotated[int, typer.Option(help="of each decoder on each file")] = 7,
    no_peers: Annotated[bool, typer.Option("--no-peers", help="leave decoders of others out")] = False,
    chromium: Annotated[str, typer.Option(help="the program")] = shutil.which("chromium") or "chromium",
    markdown: MARKDOWN = False,
    json: JSON = None,
    cache: CACHE = MADE,
    peers: PEERS = NPM,
) -> None:
    """Measure what the command line names, and print a table."""
    machine, rows = tell_machine(), list[Row]()
    wanted = [one for one in DECODERS if one.place in listed(places)]
    wanted = built([one for one in wanted if not (no_peers and one.driver in ("spz", "others.mjs"))], peers, chromium)
    for scene in find_scenes(listed(scenes), cache, extra):
        with tempfile.TemporaryDirectory(prefix="csplat-decoders-") as name:
            folder = Path(name)
            files = _files(scene, listed(presets), wanted, peers, folder)
            with _starting(wanted, chromium, peers, folder) as start:
                rows += measured(scene, wanted, files, runs, start)
        note(f"{scene.name}: done")
    print(_table(rows, markdown=markdown))
    if json is not None:
        write_json(json, {"machine": machine, "rows": [asdict(row) for row in rows]})


def _files(
    scene: Scene, presets: Sequence[str], wanted: Sequence[Decoder], peers: Path, folder: Path
) -> dict[str, Path]:
    """A scene in all forms that are wanted, by suffix."""
    model = read_ply(scene.path)
    for preset in presets:
        note(f"{scene.name}: {preset}")
        (folder / f"scene.{preset}.csplat").write_bytes(encode(model, EncodeOptions(preset=preset_of(preset))))
    if any(one.driver in ("spz", "others.mjs") for one in wanted):
        note(f"{scene.name}: SPZ, SPLAT, KSPLAT")
        write_ply(folder / "scene.ply", model)
        write(folder / "scene.spz", model)
        write(folder / "scene.splat", model)
        convert = ["node", str(peers / "decoders" / "convert.mjs"), str(folder / "scene")]
        subprocess.run(convert, check=True, stdout=subprocess.DEVNULL)
    return {path.name.removeprefix("scene."): path for path in folder.iterdir()}


@contextmanager
def _starting(wanted: Sequence[Decoder], chromium: str, peers: Path, folder: Path) -> Iterator[Start]:
    """Yield a function that starts a decoder on a file of a folder; run a browser and a server if one needs them."""
    if all(one.place != "chromium" for one in wanted):
        yield lambda one, path: Process(one, peers, path)
        return
    with tempfile.TemporaryDirectory(prefix="csplat-served-") as root:
        for name, target in (("tree", ROOT), ("peers", peers), ("files", folder)):
            (Path(root) / name).symlink_to(target.resolve())
        with serve(root) as address, open_page(chromium, gpu=False) as page:
            browser = page.context.browser
            yield (
                lambda one, path: (
                    Tab(one, browser, address, path.name) if one.place == "chromium" else Process(one, peers, path)
                )
            )


def measured(scene: Scene, wanted: Sequence[Decoder], files: dict[str, Path], runs: int, start: Start) -> list[Row]:
    """Let decoders take turns on the files of a scene; the first turns warm up."""
    pairs, started, firsts, growths, turns = [], list[Process | Tab](), [], [], []
    with ExitStack() as stack:
        for one in wanted:
            for suffix in one.files:
                if suffix in files:
                    try:
                        running = start(one, files[suffix])
                        stack.enter_context(running)
                        firsts.append(running.decode())
                    except OSError as error:
                        note(f"left out: {one.name} of {suffix}: {error}")
                        continue
                    growths.append(running.growth_bytes())
                    started.append(running)
                    pairs.append((one, files[suffix], suffix))
        warm_up = min(10, 1 + _WARM_SPLATS // scene.splat_count)
        for turn in range(1 - warm_up, runs + 1):
            turns.append([running.decode()[0] for running in started])
            note(f"{scene.name}: turn {turn} of {runs}" if turn > 0 else f"{scene.name}: warming up")
    columns = list(zip(*turns[warm_up:], strict=True))
    references = {
        one.place: column
        for (one, _, suffix), column in zip(pairs, columns, strict=True)
        if one.is_reference and suffix == "v4.spz"
    }
    rows = []
    for (one, path, suffix), column, first, growth in zip(pairs, columns, firsts, growths, strict=True):
        reference = references.get("native" if one.place == "python" else one.place)
        ratios = [theirs / ours for theirs, ours in zip(reference or (), column, strict=reference is not None)]
        ratio = statistics.median(ratios) if ratios else None
        facts = scene.name, scene.splat_count, scene.sh_degree, one.place, one.name, one.delivers, suffix
        rows.append(Row(*facts, path.stat().st_size, first[0], list(column), first[1], growth, ratio))
    return rows


def _table(rows: Sequence[Row], *, markdown: bool) -> str:
    scenes = {row.scene: f"{row.scene}, {row.splats:,}, SH {row.sh_degree}" for row in rows}
    lines = dict[tuple[str, ...], dict[str, Row]]()
    for row in rows:
        lines.setdefault((row.place, row.decoder, row.file, row.delivers), {})[row.scene] = row
    found = []
    for key, by_scene in lines.items():
        delivered = {row.sh_degree: f"{row.array_bytes / row.splats:.0f}" for row in by_scene.values()}
        largest = max(by_scene.values(), key=lambda row: row.array_bytes)
        peak = None if largest.growth_bytes is None else largest.growth_bytes / largest.array_bytes
        first = largest.first_seconds / statistics.median(largest.seconds)
        cells = [_cell(by_scene[name]) if name in by_scene else "-" for name in scenes]
        found.append((*key, ", ".join(delivered.values()), optional(peak, ".1f"), f"{first:.1f}", *cells))
    header = ("where", "decoder", "file", "delivers", "B/splat", "peak", "first", *scenes.values())
    return table(header, found, markdown=markdown)


def _cell(row: Row) -> str:
    return f"{row.splats / statistics.median(row.seconds) / 1e6:.3g}{optional(row.ratio, ' ({:.2f})'.format, '')}"


if __name__ == "__main__":
    sys.exit(run(main))

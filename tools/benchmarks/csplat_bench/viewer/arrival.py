"""Measure how soon a scene that comes over a slow line can be seen: kB and milliseconds, in several viewers.

    python -m csplat_bench.viewer.arrival --out pictures      # everything; a third of an hour
    python -m csplat_bench.viewer.arrival --scenes lego60k --viewers csplat,spark --runs 1
    python -m csplat_bench.viewer.arrival --mbits 2 --latency 100 --forms balanced,spz

Writes each scene in several forms, all from the same PLY: .csplat by presets, `spz` as `csplat convert` does,
`spz-default` as splat-transform does, with fewer bits for SH, `sog`, and `sog-levels`, streamed SOG of three levels. A
server with HTTP Range sends them at --mbits over all connections together, --latency after it was asked; page, modules
and renderer are in the browser before. A small picture of the canvas (320x240, in Chromium) is kept after each frame
that was drawn, and compared with the finished one: the last in this viewer, when all has come and nothing changes.

first     the first picture that is not black
25 dB     the first of this PSNR against the finished one
whole     the finished one
asked kB  all that was sent: less than the files if the viewer leaves some out, more if it asks for bytes twice

ms count from the first request for the scene, kB is what had been sent by then. Pictures are drawn by SwiftShader, a GL
on the CPU, which shares the cores with decoders and is in all times; bytes keep coming meanwhile, so that on a slower
line, or with a GPU, a first picture takes fewer of them. Medians of --runs, by turns. --out keeps the three pictures of
each on a sheet for every scene: look at them. Requires Chromium, playwright, npm. Status 1 if a viewer fails.
"""

from __future__ import annotations

import base64
import shutil
import statistics
import sys
import time
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from numpy.typing import NDArray

from csplat.errors import InputError
from csplat.formats import format_by_name
from csplat_bench.common.command import CACHE, EXTRA, JSON, MARKDOWN, PEERS, SCENES, WrongWords, listed, run
from csplat_bench.common.peers import find_splat_transform
from csplat_bench.common.report import table, tell_machine, write_json
from csplat_bench.common.scenes import MADE, NPM, Scene, find_scenes
from csplat_bench.viewer.forms import FORMS, size_of
from csplat_bench.viewer.line import SLOW, Line
from csplat_bench.viewer.stage import HEIGHT, WIDTH, looked_at, opened_page, pinhole, placed_in
from csplat_render.metrics import psnr
from csplat_tools.console import note

_GOOD = 25.0  # dB
_SMALL = (120, 160)  # rows and columns of what is looked at, as pages/arrival.mjs has them
_BLACK = 8  # no component of a black picture is larger
_STILL_SECONDS, _FRAMES = 1.5, 5  # seconds and frames for which the finished picture stays the same
_PATIENCE = 180.0  # seconds
_POLL_MS = 100

#: By the names of their pages: titles, and the forms that they open.
VIEWERS = {
    "csplat": ("csplat", ("balanced", "small")),
    "three": ("three.js", ("balanced", "small")),
    "spark": ("Spark", ("balanced", "small", "spz", "spz-default")),
    "playcanvas": ("PlayCanvas", ("balanced", "small", "sog")),
    "babylon": ("Babylon.js", ("balanced", "small")),
    "supersplat": ("SuperSplat viewer", ("sog", "sog-levels")),
}
_HEADER = ["scene", "form", "viewer", "file kB", "first kB", "ms", "25 dB kB", "ms", "whole kB", "ms", "asked kB"]
_SUPERSPLAT = {"@playcanvas/supersplat-viewer": "1"}
_BEGIN = """async ([viewer, url, camera]) => {
  window.arrival = await import('/pages/arrival.mjs');
  arrival.begin(viewer, url, camera);
}"""


@dataclass(frozen=True)
class Moment:
    """Milliseconds since the first request, and bytes sent until then."""

    ms: float
    sent_bytes: float


@dataclass(frozen=True)
class Seen:
    """The moments at which a scene could be seen in one run, as this module's docstring defines them."""

    first: Moment
    good: Moment
    whole: Moment
    asked_bytes: float


@dataclass(frozen=True)
class Watched:
    """Everything that was seen in one run.

    Attributes:
        times: seconds since the epoch, rising; each picture's.
        pictures: [N, H, W, 3] uint8, each another one than the one before; the last is the finished one.
        sent: seconds since the epoch, and bytes sent then.
        begun: seconds since the epoch, of the first request.
    """

    times: Sequence[float]
    pictures: NDArray[np.uint8]
    sent: Sequence[tuple[float, int]]
    begun: float

    @property
    def shown(self) -> tuple[int, int, int]:
        """Indices of three frames: the first that is not black, the first near the finished one, the finished one."""
        finished = self.pictures[-1].astype(np.float32) / 255.0
        first = int(np.argmax((self.pictures > _BLACK).any((1, 2, 3))))
        good = first
        while psnr(self.pictures[good].astype(np.float32) / 255.0, finished) < _GOOD:
            good += 1
        return first, good, len(self.pictures) - 1

    @property
    def seen(self) -> Seen:
        """The moments at which these frames appeared."""
        first, good, whole = (self.at(picture) for picture in self.shown)
        return Seen(first, good, whole, sum(size for _, size in self.sent))

    def at(self, picture: int) -> Moment:
        """Return when a frame was there: milliseconds since the first request, and the bytes sent by then."""
        when = self.times[picture]
        return Moment(1e3 * (when - self.begun), sum(size for moment, size in self.sent if moment <= when))


@dataclass(frozen=True)
class Arrival:
    """A scene in a form and a viewer; medians."""

    scene: str
    form: str
    viewer: str
    file_bytes: int
    seen: Seen | None
    failed: str = ""

    @property
    def cells(self) -> tuple[str, ...]:
        """The cells of its table row."""
        start = self.scene, self.form, self.viewer, _kilobytes(self.file_bytes)
        if self.seen is None:
            return *start, *("-",) * 6, self.failed
        found = []
        for one in (self.seen.first, self.seen.good, self.seen.whole):
            found += [_kilobytes(one.sent_bytes), f"{one.ms:,.0f}"]
        return *start, *found, _kilobytes(self.seen.asked_bytes)


def main(
    *,
    scenes: SCENES = "sample,lego60k,fox120k,donut",
    viewers: Annotated[str, typer.Option(help="which")] = ",".join(VIEWERS),
    forms: Annotated[str, typer.Option(help="which, of those that a viewer opens")] = ",".join(FORMS),
    mbits: Annotated[float, typer.Option(help="million bits per second", min=0.01)] = 10.0,
    latency: Annotated[float, typer.Option(help="milliseconds before each answer", min=0.0)] = 40.0,
    runs: Annotated[int, typer.Option(help="of each", min=1)] = 3,
    extra: EXTRA = [],
    markdown: MARKDOWN = False,
    out: Annotated[Path | None, typer.Option(metavar="FOLDER", help="keep the pictures")] = None,
    json: JSON = None,
    chromium: Annotated[str, typer.Option(help="the program")] = shutil.which("chromium") or "chromium",
    cache: CACHE = MADE,
    peers: PEERS = NPM,
) -> int:
    """Measure what the command line names, and print a table."""
    pairs = _pairs(listed(viewers), listed(forms))
    machine, rows, line = tell_machine(), list[Arrival](), Line(1e6 * mbits, 1e-3 * latency)
    more = _SUPERSPLAT if any(viewer == "supersplat" for viewer, _ in pairs) else None
    transform = _transform(peers) if any(FORMS[form].foreign for _, form in pairs) else []
    with opened_page(chromium, peers, more, line.serve) as (page, folder, address):
        for scene in find_scenes(listed(scenes), cache, extra):
            model, _ = looked_at(scene)
            files = _files(scene, dict.fromkeys(form for _, form in pairs), folder, transform)
            kept: dict[tuple[str, str], list[Any]] = {}
            for turn in range(runs):
                for viewer, form in pairs:
                    _, camera = placed_in(format_by_name(FORMS[form].axes_of), model)
                    url = f"{address}{files[form].relative_to(folder)}"
                    found = _watched(page, line, viewer, url, pinhole(camera, model))
                    kept.setdefault((viewer, form), []).append(found)
                    note(f"{scene.name} {form} {viewer} {turn + 1}: {found if isinstance(found, str) else 'done'}")
            for (viewer, form), each in kept.items():
                size = size_of(folder / SLOW.strip("/") / f"{scene.name}-{form}")
                rows.append(_arrival(scene.name, form, viewer, size, each))
            if out is not None:
                _keep(out, scene.name, kept)
    print(table(_HEADER, [row.cells for row in rows], markdown=markdown))
    if json is not None:
        write_json(
            json, {"machine": machine, "mbits": mbits, "latencyMs": latency, "rows": [asdict(row) for row in rows]}
        )
    return 0 if all(row.seen for row in rows) else 1


def _pairs(viewers: Sequence[str], forms: Sequence[str]) -> list[tuple[str, str]]:
    """Viewers with forms that they open.

    Raises:
        WrongWords: a name is none.
    """
    for name, known in [(name, VIEWERS) for name in viewers] + [(name, FORMS) for name in forms]:
        if name not in known:
            raise WrongWords(f"{name!r} is none of {', '.join(known)}")
    return [(viewer, form) for form in forms for viewer in viewers if form in VIEWERS[viewer][1]]


def _transform(peers: Path) -> list[str]:
    """The words that run splat-transform.

    Raises:
        InputError: it cannot be had.
    """
    command, said = find_splat_transform(peers)
    if command is None:
        raise InputError(f"splat-transform: {said}")
    note(said)
    return command


def _files(scene: Scene, forms: Iterable[str], folder: Path, transform: Sequence[str]) -> dict[str, Path]:
    """Write a scene in all forms, each into a folder of its own that comes over the line."""
    found = {}
    for form in forms:
        place = folder / SLOW.strip("/") / f"{scene.name}-{form}"
        place.mkdir(parents=True)
        found[form] = FORMS[form].write(scene, place, transform)
    return found


def _watched(page: Any, line: Line, viewer: str, url: str, camera: dict[str, Any]) -> Watched | str:
    """Let a viewer open a file, look until nothing changes any more; or say why there is nothing to be seen."""
    page.set_viewport_size({"width": WIDTH, "height": HEIGHT})
    page.goto(f"{url.partition(SLOW)[0]}/page.html")
    line.forget()
    page.evaluate(_BEGIN, [viewer, url, camera])
    end = time.monotonic() + _PATIENCE
    while True:
        page.wait_for_timeout(_POLL_MS)
        state = page.evaluate("arrival.state()")
        if state["failed"] or time.monotonic() > end:
            return str(state["failed"] or "it never came to rest")
        still = min(1e-3 * state["still"], line.quiet_seconds) >= _STILL_SECONDS and state["frames"] >= _FRAMES
        if state["whole"] and still and state["pictures"]:
            break
    times, texts = zip(*page.evaluate("arrival.pictures()"), strict=True)
    pixels = [np.frombuffer(base64.b64decode(text), np.uint8).reshape(*_SMALL, 4)[..., :3] for text in texts]
    if line.begun is None or not (pixels[-1] > _BLACK).any():
        return "its last picture is black"
    return Watched([1e-3 * at for at in times], np.stack(pixels), list(line.sent), line.begun)


def _arrival(scene: str, form: str, viewer: str, file_bytes: int, each: Sequence[Watched | str]) -> Arrival:
    """Medians of some runs; nothing if one failed."""
    names = scene, FORMS[form].title, VIEWERS[viewer][0]
    runs = [one.seen for one in each if isinstance(one, Watched)]
    if len(runs) < len(each):
        return Arrival(*names, file_bytes, None, next(one for one in each if isinstance(one, str)))

    def middle(moments: Iterable[Moment]) -> Moment:
        ms, sent = zip(*((one.ms, one.sent_bytes) for one in moments), strict=True)
        return Moment(statistics.median(ms), statistics.median(sent))

    seen = Seen(
        middle(run.first for run in runs), middle(run.good for run in runs), middle(run.whole for run in runs),
        statistics.median(run.asked_bytes for run in runs),
    )  # fmt: skip
    return Arrival(*names, file_bytes, seen)


def _keep(out: Path, scene: str, kept: dict[tuple[str, str], list[Any]]) -> None:
    """Write a sheet of the first run: a row for each viewer and form, of its first, near and finished picture."""
    from PIL import Image, ImageDraw

    out.mkdir(parents=True, exist_ok=True)
    height, width = _SMALL
    sheet = Image.new("RGB", (3 * width, height * len(kept)))
    draw = ImageDraw.Draw(sheet)
    for row, ((viewer, form), (one, *_)) in enumerate(kept.items()):
        for column, picture in enumerate(one.shown if isinstance(one, Watched) else ()):
            x, y, moment = width * column, height * row, one.at(picture)
            sheet.paste(Image.fromarray(one.pictures[picture]), (x, y))
            text = f"{viewer} {form}\n{moment.ms:.0f} ms {_kilobytes(moment.sent_bytes)} kB"
            draw.text((x + 3, y + 3), text, fill=(255, 255, 0), stroke_width=1, stroke_fill=(0, 0, 0))
    sheet.save(out / f"{scene}-arrival.png")


def _kilobytes(size: float) -> str:
    return f"{size / 1e3:,.0f}"


if __name__ == "__main__":
    sys.exit(run(main))

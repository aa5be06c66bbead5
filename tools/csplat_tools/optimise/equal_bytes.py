# SPDX-License-Identifier: Apache-2.0
"""A page that shows one scene as a PLY, as SPZ and as `.csplat` of equal bytes under one slider.

PLY and SPZ come down to the bytes of the `.csplat` file by fewer splats, which `simplify` chooses and refits as it does
for our own files. They are written, read again, and rendered by the same renderer with the same cameras.
"""

from __future__ import annotations

import itertools
import math
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, replace
from html import escape
from pathlib import Path

import numpy as np

from csplat.context import DEFAULT_CONTEXT, Context
from csplat.editing.transform import DEFAULT_AXES, convert_axes
from csplat.encoder import Target
from csplat.errors import InputError, counted
from csplat.formats import write
from csplat.goal_search import next_value
from csplat.model import SplatModel
from csplat.scene import Scene
from csplat.scene_metadata import UNSPECIFIED
from csplat_render import Camera, render
from csplat_render.camera import resized
from csplat_tools.console import format_bytes
from csplat_tools.html_report import data_uri
from csplat_tools.optimise.simplify import simplify
from csplat_tools.render_files import to_uint8
from csplat_tools.scene_files import load_scene
from csplat_tools.views import ViewSet

_WIDTH = 1280  # pixels of a picture
_NEAR = 0.97  # fraction of the bytes from which on a file counts as equally large
_TRIES = 5  # files written per format, in search of the number of splats


@dataclass(frozen=True, eq=False)
class EqualFile:
    """A file of the comparison.

    Attributes:
        title: name of the format.
        size_bytes, splats: its size, and its number of splats.
        psnr: of renders in the test views against those of the source, dB.
        picture: data URI of a render.
    """

    title: str
    size_bytes: int
    splats: int
    psnr: float
    picture: str


def equal_bytes_page(source: Scene, other: Scene, views: ViewSet, name: str, context: Context = DEFAULT_CONTEXT) -> str:
    """Return the page of a scene.

    Args:
        source, other: the scene, and the `.csplat` file made from it; both in memory.
        views: their test views.
        name: title of the page.
        context: threads and progress.

    Raises:
        InputError: a format has no room for a splat in these bytes.
        OSError: temporary files cannot be written.
    """
    made, given = other.model(), source.model()
    axes = given.metadata.coordinate_system
    # Named, so that no format tilts the scene along an up direction.
    known = replace(given.metadata, coordinate_system=DEFAULT_AXES if axes == UNSPECIFIED else axes)
    model = replace(given, metadata=known)
    scorer = views.test_scorer(model, context=context)
    cover = [score.cover or 0.0 for score in scorer.scores(made).each]
    view = views.test[int(np.argsort(cover)[len(cover) // 2])]  # neither the nearest nor the farthest
    camera = resized(view, _WIDTH, round(_WIDTH * view.H / view.W))
    shown = [
        ("PLY", *_pruned(model, "ply", other.size_bytes, context)),
        ("SPZ", *_pruned(model, "spz", other.size_bytes, context)),
        (".csplat", other.size_bytes, made),
    ]
    files = []
    for title, size, scene in shown:
        picture = render(scene, camera, background=views.test_background).rgb
        files.append(EqualFile(title, size, len(scene), scorer.psnr(scene), data_uri(to_uint8(picture))))
    return _page(name, source, camera, len(views.test), files)


def _pruned(model: SplatModel, suffix: str, most_bytes: int, context: Context) -> tuple[int, SplatModel]:
    """Return the size of a file of most splats within some bytes, pruned and refitted, and what is read from it."""
    goal, most, near = math.log(most_bytes), math.log(len(model)), -math.log(_NEAR)
    best: tuple[int, SplatModel] | None = None
    measured: list[tuple[float, float]] = []
    value: float | None = most
    with tempfile.TemporaryDirectory(prefix="csplat-equal-") as folder:
        path = Path(folder) / f"scene.{suffix}"
        while value is not None:
            kept = model
            if value < most:
                kept = simplify(model, Target(keep=math.exp(value - most)), context=context).model
            write(path, kept)
            size = path.stat().st_size
            measured.append((value, math.log(size)))
            if size <= most_bytes and (best is None or size > best[0]):
                best = size, convert_axes(load_scene(str(path)), model.metadata.coordinate_system).model()
            value = next_value(
                goal, measured, 1.0, bounds=(0.0, most), margin=near / 2, tolerance=near,
                least_step=1.0 / len(model), tries=_TRIES,
            )  # fmt: skip
    if best is None:
        raise InputError(f"a {suffix.upper()} of {most_bytes:,} bytes has no room for splats of this scene")
    return best


def _page(name: str, source: Scene, camera: Camera, view_count: int, files: Sequence[EqualFile]) -> str:
    """Return the HTML."""
    about = (
        f"Source: {counted(source.count, 'splat')}, {format_bytes(source.size_bytes)}. The PLY and the SPZ have the"
        " bytes of the .csplat file: fewer splats, which csplat simplify chose and fitted to renders of the source. All"
        " three were written, read again and rendered by csplat; dB: PSNR against the source in"
        f" {counted(view_count, 'view')}."
    )
    pictures = "".join(
        f'<img src="{file.picture}" alt="{file.title}, {file.psnr:.1f} dB" width="{camera.W}" height="{camera.H}"'
        ' draggable="false">\n'
        for file in files
    )
    labels = "".join(
        f"<li><b>{file.title}: {file.psnr:.1f}&nbsp;dB</b><br>{format_bytes(file.size_bytes).replace(' ', '&nbsp;')},"
        f" {file.splats:,}&nbsp;splats</li>"
        for file in files
    )
    sliders = "".join(
        f'<button role="slider" aria-label="Border between {left.title} and {right.title}" aria-valuemin="0"'
        ' aria-valuemax="100"></button>\n'
        for left, right in itertools.pairwise(files)
    )
    return _TEMPLATE % {
        "name": escape(name),
        "about": about,
        "pictures": pictures,
        "labels": labels,
        "sliders": sliders,
    }


_TEMPLATE = """<!doctype html>
<html lang="en">
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>%(name)s at equal bytes</title>
<link rel="icon" href="data:,">
<style>
:root { color-scheme: light dark; font: 16px/1.5 system-ui, sans-serif; }
body { margin: 0 auto; max-width: 1280px; padding: 12px; }
h1 { font-size: 1.3rem; margin: 0 0 8px; overflow-wrap: anywhere; }
#stage { position: relative; overflow: hidden; touch-action: pan-y; cursor: ew-resize; user-select: none; }
#stage img { display: block; width: 100%%; height: auto; position: absolute; top: 0; }
#stage img:first-child { position: static; }
#stage button { position: absolute; top: 0; bottom: 0; width: 44px; margin-left: -22px; padding: 0; border: 0;
  background: linear-gradient(#fff, #fff) center / 2px 100%% no-repeat; cursor: ew-resize; touch-action: pan-y; }
#stage button::after { content: '\\2194'; position: absolute; top: 50%%; left: 6px; width: 32px; line-height: 32px;
  border-radius: 16px; background: #fff; color: #000; font-size: 18px; }
#stage button:focus-visible { outline: 3px solid #4af; outline-offset: -3px; }
ul { display: grid; grid-template-columns: repeat(3, 1fr); gap: 8px; list-style: none; padding: 0; margin: 8px 0; }
li:nth-child(2) { text-align: center; }
li:nth-child(3) { text-align: right; }
@media (max-width: 600px) { :root { font-size: 14px; } }
p { max-width: 80ch; opacity: .8; }
</style>
<h1>%(name)s at equal bytes</h1>
<div id="stage">
%(pictures)s%(sliders)s</div>
<ul>
%(labels)s</ul>
<p>%(about)s</p>
<script>
const stage = document.getElementById('stage');
const pictures = [...stage.querySelectorAll('img')].slice(1);
const sliders = [...stage.querySelectorAll('button')];
const values = [100 / 3, 200 / 3];
function move(i, value) {
  values[i] = Math.min(100, Math.max(0, value));
  values[1 - i] = i ? Math.min(values[0], values[1]) : Math.max(values[0], values[1]);
  for (const [k, at] of values.entries()) {
    pictures[k].style.clipPath = `inset(0 0 0 ${at}%%)`;
    sliders[k].style.left = `${at}%%`;
    sliders[k].setAttribute('aria-valuenow', Math.round(at));
  }
}
const at = ({ clientX }) => (100 * (clientX - stage.getBoundingClientRect().left)) / stage.clientWidth;
let dragged = null;
stage.addEventListener('pointerdown', (event) => {
  const own = sliders.indexOf(event.target);
  const nearest = Math.abs(at(event) - values[0]) <= Math.abs(at(event) - values[1]) ? 0 : 1;
  dragged = own < 0 ? nearest : own;
  stage.setPointerCapture(event.pointerId);
  sliders[dragged].focus({ focusVisible: false });
  event.preventDefault();
  move(dragged, at(event));
});
stage.addEventListener('pointermove', (event) => dragged !== null && move(dragged, at(event)));
for (const type of ['pointerup', 'pointercancel']) stage.addEventListener(type, () => (dragged = null));
const STEPS = {
  ArrowLeft: -2, ArrowDown: -2, ArrowRight: 2, ArrowUp: 2, PageDown: -10, PageUp: 10, Home: -100, End: 100,
};
for (const [i, slider] of sliders.entries()) {
  slider.addEventListener('keydown', (event) => {
    if (!(event.key in STEPS)) return;
    event.preventDefault();
    move(i, values[i] + STEPS[event.key]);
  });
}
move(0, values[0]);
</script>
</html>
"""

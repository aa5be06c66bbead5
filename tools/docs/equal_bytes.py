# SPDX-License-Identifier: Apache-2.0
"""Make a page that shows one scene as a PLY, as SPZ and as `.csplat` of equal bytes under two sliders.

PLY and SPZ come down to the bytes of the `.csplat` file by fewer splats, which `simplify` chooses and refits as it does
for our own files. They are written, read again, and rendered by the same renderer with the same cameras. Takes a minute
for 10,000 splats.

Usage:
    python tools/docs/equal_bytes.py SOURCE FILE.csplat PAGE.html [--cameras FILE.json]
"""

from __future__ import annotations

import argparse
import math
import tempfile
from dataclasses import replace
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
from csplat_render import render
from csplat_render.camera import resized
from csplat_tools.console import format_bytes
from csplat_tools.file_streams import write_bytes
from csplat_tools.optimise.simplify import simplify
from csplat_tools.render_files import to_uint8
from csplat_tools.scene_files import load_scene, open_scenes
from csplat_tools.slider_page import Panel, slider_page
from csplat_tools.views import ViewSet, find_view_set

_WIDTH = 1280  # pixels of a picture
_NEAR = 0.97  # fraction of the bytes from which on a file counts as equally large
_TRIES = 5  # files written per format, in search of the number of splats


def main() -> None:
    """Run the command."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("source", type=Path, help="the scene, in any format")
    parser.add_argument("file", type=Path, help="the .csplat file made from it")
    parser.add_argument("page", type=Path, help="the page to write")
    parser.add_argument("--cameras", type=Path, help="cameras of the views; default: eight around the scene")
    options = parser.parse_args()
    with open_scenes((str(options.source), str(options.file))) as (source, other):
        views = find_view_set(source.model(), cameras=options.cameras, count=0)
        page = equal_bytes_page(source, other, views, options.source.stem)
    write_bytes(str(options.page), page.encode())


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
    panels = []
    for title, size, scene in shown:
        picture = render(scene, camera, background=views.test_background).rgb
        remark = f"{format_bytes(size)}, {counted(len(scene), 'splat')}"
        panels.append(Panel.of(f"{title}: {scorer.psnr(scene):.1f} dB", remark, to_uint8(picture)))
    about = (
        f"Source: {counted(source.count, 'splat')}, {format_bytes(source.size_bytes)}. The PLY and the SPZ have the"
        " bytes of the .csplat file: fewer splats, which csplat simplify chose and fitted to renders of the source. All"
        " three were written, read again and rendered by csplat; dB: PSNR against the source in"
        f" {counted(len(views.test), 'view')}."
    )
    return slider_page(f"{name} at equal bytes", about, [panels])


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


if __name__ == "__main__":
    main()

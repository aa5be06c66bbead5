# SPDX-License-Identifier: Apache-2.0
"""Files of csplat in the programs that formats are made for: three.js, PlayCanvas, Babylon.js, Spark.

A case has an `engine` and a `format`. The engine's own loader (of .csplat: `codec/js/engines`) reads the file in
Chromium; its image is compared with our renders, from the one of eight views in which SH shows most. A case fails if
the image is mirrored, upside down, of wrong SH or absent.

    psnr, rules_psnr    dB against our render, and against ours by the engine's known rules
    sh                  fraction of what SH changes that the engine shows
    ply_psnr            dB against the image of the PLY in the same engine
    up                  how the scene lies in the engine's world, whose y points up

Images are written to the work folder. Option `webgpu`: engines draw by WebGPU. Requires Chromium, playwright and npm.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from typing import Any

import numpy as np

from csplat.editing.transform import DEFAULT_AXES
from csplat.formats import format_by_name, read, write
from csplat.formats.format import Format
from csplat.image_opener import open_image
from csplat.model import SplatModel
from csplat.scene_metadata import UNSPECIFIED, up_of_axes
from csplat_bench.engine_stage import ENGINES, Image, chosen_view, opened_page, pinhole, placed_in, screen_render
from csplat_bench.protocol import AbsentError, Measure, Setup
from csplat_bench.scenes import find_scene
from csplat_bench.suites import Case
from csplat_render import Camera
from csplat_render.metrics import psnr
from csplat_tools.render_files import write_png

_SH_TOLERANCE = 0.3  # fraction of SH's effect; colours of clipped splats let others through
_TIMEOUT_SECONDS = 120.0
_PAUSE_SECONDS = 0.4  # from one screenshot to the next
_SAME = 3  # equal screenshots after which an image is final
_SHOW = """async ([engine, url, camera, options, patience]) => {
  const { show, version } = await import(`/pages/${engine}.mjs`);
  const late = new Promise((_, reject) => setTimeout(() => reject(new Error('it takes too long')), patience));
  const shown = show(document.querySelector('canvas'), url, camera, options)
    .then(async ({ world, whole }) => (await whole, { world, version }));
  return Promise.race([shown, late]).catch((error) => ({ failed: String(error.message ?? error) }));
}"""


@contextmanager
def measure_images(setup: Setup, name: str, _: Sequence[Case]) -> Iterator[Measure]:
    """Yield the function that lets an engine draw a file of the scene."""
    webgpu = setup.options.get("webgpu", False)
    with ExitStack() as stack:
        page, folder, address = stack.enter_context(opened_page(setup.chromium, setup.peers, webgpu=webgpu))
        scene = find_scene(name, setup.data, setup.work)
        model, _camera = chosen_view(scene)
        # All files hold what the .csplat file holds, so that they can be compared with it.
        write(folder / "scene.csplat", model, "csplat")
        model, images = read(folder / "scene.csplat"), dict[tuple[str, str], Image]()

        def measure(case: Case) -> Mapping[str, Any]:
            engine, form = case["engine"], format_by_name(case["format"])
            if form.name not in ENGINES[engine].reads:
                raise AbsentError(f"{ENGINES[engine].title} does not read {form.name}")
            path = folder / f"scene{form.suffixes[0]}"
            if form.name != "csplat":
                write(path, model, form.name)
            values, image = _draw(page, engine, f"{address}{path.name}", model, form, webgpu=webgpu)
            images[engine, form.name] = image
            twin = images.get((engine, "ply"))
            kept = setup.work / "engine_images" / f"{scene.name}-{engine}-{form.name}.png"
            kept.parent.mkdir(parents=True, exist_ok=True)
            write_png(kept, np.rint(255.0 * image).astype(np.uint8))
            return {"splats": len(model), **values, "ply_psnr": None if twin is None else psnr(image, twin)}

        yield measure


def _draw(
    page: Any, name: str, url: str, model: SplatModel, form: Format, *, webgpu: bool
) -> tuple[dict[str, Any], Image]:
    """Let an engine draw a file, and compare its image with our renders.

    Raises:
        OSError: it does not load, is mirrored or upside down, or has wrong SH.
    """
    engine = ENGINES[name]
    placed, camera = placed_in(form, model)
    ours = Camera.from_json((model.metadata.cameras or [])[0])
    page.set_viewport_size({"width": camera.W, "height": camera.H})
    page.goto(url.rpartition("/")[0] + "/page.html")
    words = [name, url, pinhole(camera, model), {"webgpu": webgpu}, 1000 * _TIMEOUT_SECONDS]
    shown = page.evaluate(_SHOW, words)
    if "failed" in shown:
        raise OSError(shown["failed"])
    image = settled_image(page)
    right, bare = engine.render(model, ours, form.degree), engine.render(model, ours, 0)
    wrong = max(psnr(image, right[:, ::-1]), psnr(image, right[::-1]))
    difference = right - bare
    sh = 1.0
    if difference.any():
        sh = float(((image - bare) * difference).sum() / (difference * difference).sum())
    values: dict[str, Any] = {
        "engine": f"{engine.title} {shown['version']}", "format": form.name, "up": up_in_world(placed, shown["world"]),
        "psnr": psnr(image, screen_render(model, ours, sh_degree=form.degree)), "rules_psnr": psnr(image, right),
        "sh": sh,
    }  # fmt: skip
    if values["rules_psnr"] <= wrong or abs(sh - 1.0) >= _SH_TOLERANCE:
        raise OSError(f"the image is mirrored, upside down or without SH: {values}")
    return values, image


def settled_image(page: Any, pause: float = _PAUSE_SECONDS) -> Image:
    """Return the image that no longer changes: loaders return before splats are sorted and shaders compiled."""
    end, last, same = time.monotonic() + _TIMEOUT_SECONDS, np.zeros((1, 1, 3), np.uint8), 0
    while same < _SAME and time.monotonic() < end:
        time.sleep(pause)
        with open_image(page.screenshot()) as shot:
            image = np.asarray(shot.convert("RGB"))
        same = same + 1 if image.any() and np.array_equal(image, last) else 0
        last = image
    return last.astype(np.float32) / 255.0


def up_in_world(placed: SplatModel, world: Sequence[float]) -> str:
    """Return how the up direction of a file's axes lies in a world whose y points up: upright, or how not."""
    axes = placed.metadata.coordinate_system
    up = up_of_axes(DEFAULT_AXES if axes == UNSPECIFIED else axes)
    if up is None:
        return "unknown"
    height = (np.reshape(world, (4, 4)).T[:3, :3] @ np.array(up))[1]
    return "upright" if height > 0.9 else "upside down" if height < -0.9 else "on its side"

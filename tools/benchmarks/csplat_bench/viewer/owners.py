"""Look at what csplat writes in the programs that other formats are made for: three.js, PlayCanvas, Babylon.js, Spark.

    python -m csplat_bench.viewer.owners --out pictures
    python -m csplat_bench.viewer.owners --scenes lego60k --engines three --formats gltf,spz
    python -m csplat_bench.viewer.owners --engines three,playcanvas,babylon --formats ply,csplat --webgpu

Writes a scene in every format, lets the engines' own loaders read it in Chromium, and compares pictures with those of
csplat's rasteriser of the PLY, from where SH shows most of eight places around the scene: dB. `by its rules` is the
same with the engine's own rules (`rules.py`) in ours; `SH` how much of what SH changes there the engine shows, 1 if
it is all. `stands` is how the engine's world, whose y is up, holds the scene; `PLY` how near the picture is to that of
the PLY in the same engine, dB. If csplat is among the formats, by `codec/js/engines`, all others are written from
what its file holds. --out keeps the pictures, and all of a scene on one sheet. Status 1 if one is mirrored, on its
head, of wrong SH or absent. Requires Chromium, playwright, npm.
"""

from __future__ import annotations

import io
import shutil
import sys
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

from csplat.editing.transform import DEFAULT_AXES
from csplat.editing.up_axis import up_of_axes
from csplat.formats import format_by_name, read, write
from csplat.formats.format import Format
from csplat.model import UNSPECIFIED, SplatModel
from csplat_bench.common.command import CACHE, EXTRA, JSON, MARKDOWN, PEERS, SCENES, listed, run
from csplat_bench.common.report import table, tell_machine, write_json
from csplat_bench.common.scenes import MADE, NPM, find_scenes
from csplat_bench.viewer.rules import DEGREE, ENGINES, Picture, drawn
from csplat_bench.viewer.stage import HEIGHT, WIDTH, looked_at, opened_page, pinhole, placed_in
from csplat_render import Camera
from csplat_render.metrics import psnr
from csplat_tools.console import note
from csplat_tools.render_files import write_png

_OURS = "ours"  # among the formats of pictures
_SH_OFF = 0.3  # kernels that are cut make room for what lies behind, in other colours
_PATIENCE = 120.0  # seconds
_PAUSE, _STILL = 0.4, 3  # seconds between pictures, and how many in a row are the same once all is drawn
_SHOW = """async ([engine, url, camera, options, patience]) => {
  const { show, version } = await import(`/pages/${engine}.mjs`);
  const late = new Promise((_, reject) => setTimeout(() => reject(new Error('it never came')), patience));
  const shown = show(document.querySelector('canvas'), url, camera, options)
    .then(async ({ world, whole }) => (await whole, { world, version }));
  return Promise.race([shown, late]).catch((error) => ({ failed: String(error.message ?? error) }));
}"""


_FORMATS = "ply,csplat,gltf,sog,compressed-ply,spz,spz4,splat"


@dataclass(frozen=True)
class Shown:
    """The picture of a file in an engine, compared with ours.

    Attributes:
        engine: its name and version.
        stands: how the scene stands in the engine's world: "upright", "on its head", "on its side"; or why there is no
            picture.
        psnr: PSNR against our picture, and against ours by the engine's rules, dB.
        wrong: the best PSNR against the latter mirrored or on its head, dB.
        sh: how far the picture lies on the way from ours without SH to ours, by these rules; 1 if there is none.
        ply: PSNR against the picture of the PLY in the same engine, dB.
    """

    scene: str
    engine: str
    format: str
    stands: str
    psnr: tuple[float, float] | None = None
    wrong: float = 0.0
    sh: float = 1.0
    ply: float | None = None

    @property
    def right(self) -> bool:
        """True if the picture is ours: neither mirrored nor on its head, and with its SH."""
        return self.psnr is not None and self.psnr[1] > self.wrong and abs(self.sh - 1.0) < _SH_OFF

    @property
    def cells(self) -> tuple[str, ...]:
        """The cells of its table row."""
        found = [] if self.psnr is None else [f"{self.psnr[0]:.1f}", f"{self.psnr[1]:.1f}", f"{self.sh:.2f}"]
        found.append("-" if self.ply is None else f"{self.ply:.1f}")
        seen = found if self.psnr else ("-",) * 4
        return self.scene, self.engine, self.format, "yes" if self.right else "NO", self.stands, *seen


def main(
    *,
    scenes: SCENES = "sample,plane3",
    engines: Annotated[str, typer.Option(help="which")] = ",".join(ENGINES),
    formats: Annotated[str, typer.Option(help="which")] = _FORMATS,
    webgpu: Annotated[bool, typer.Option("--webgpu", help="let engines draw by WebGPU; Spark cannot")] = False,
    extra: EXTRA = [],
    markdown: MARKDOWN = False,
    out: Annotated[Path | None, typer.Option(metavar="FOLDER", help="keep the pictures")] = None,
    json: JSON = None,
    chromium: Annotated[str, typer.Option(help="the program")] = shutil.which("chromium") or "chromium",
    cache: CACHE = MADE,
    peers: PEERS = NPM,
) -> int:
    """Look at what the command line names, and print a table."""
    machine, rows = tell_machine(), list[Shown]()
    wanted = [(name, ENGINES[name]) for name in listed(engines)]
    with opened_page(chromium, peers, webgpu=webgpu) as (page, folder, address):
        for scene in find_scenes(listed(scenes), cache, extra):
            model, camera = looked_at(scene)
            forms = [format_by_name(name) for name in listed(formats)]
            if any(form.name == "csplat" for form in forms):
                write(folder / f"{scene.name}.csplat", model, "csplat")
                model = read(folder / f"{scene.name}.csplat")
            pictures = {(name, _OURS): engine.drawn(model, camera, DEGREE) for name, engine in wanted}
            for form in forms:
                path = folder / f"{scene.name}{form.suffixes[0]}"
                if form.name != "csplat":
                    write(path, model, form.name)
                for name, engine in wanted:
                    if form.name in engine.reads:
                        shown, picture = _shown(page, name, f"{address}{path.name}", model, form, webgpu=webgpu)
                        twin = pictures.get((name, "ply")) if shown.psnr else None
                        like = None if twin is None else psnr(picture, twin)
                        rows.append(replace(shown, scene=scene.name, ply=like))
                        pictures[name, form.name] = picture
                        note(" ".join(rows[-1].cells))
            if out is not None:
                _keep(out, scene.name, pictures)
    header = ("scene", "engine", "format", "right", "stands", "dB", "by its rules", "SH", "PLY")
    print(table(header, [row.cells for row in rows], markdown=markdown))
    if json is not None:
        write_json(json, {"machine": machine, "rows": [asdict(row) for row in rows]})
    return 0 if all(row.right for row in rows) else 1


def _shown(page: Any, name: str, url: str, model: SplatModel, form: Format, *, webgpu: bool) -> tuple[Shown, Picture]:
    """Let an engine draw a file, and compare what comes."""
    engine = ENGINES[name]
    placed, camera = placed_in(form, model)
    ours = Camera.from_json((model.cameras or [])[0])
    page.set_viewport_size({"width": camera.W, "height": camera.H})
    page.goto(url.rpartition("/")[0] + "/page.html")
    said = page.evaluate(_SHOW, [name, url, pinhole(camera, model), {"webgpu": webgpu}, 1000 * _PATIENCE])
    shown = Shown("", f"{engine.title} {said.get('version', '')}".strip(), form.name, said.get("failed", ""))
    if shown.stands:
        return shown, np.zeros((camera.H, camera.W, 3), np.float32)
    picture = still(page)
    right = engine.drawn(model, ours, form.degree)
    wrong = max(psnr(picture, right[:, ::-1]), psnr(picture, right[::-1]))
    bare = engine.drawn(model, ours, 0)
    way = right - bare
    sh = float(((picture - bare) * way).sum() / (way * way).sum()) if way.any() else 1.0
    found = psnr(picture, drawn(model, ours, sh_degree=form.degree)), psnr(picture, right)
    return replace(shown, stands=stands(placed, said["world"]), psnr=found, wrong=wrong, sh=sh), picture


def still(page: Any, pause: float = _PAUSE) -> Picture:
    """The picture that an engine comes to rest at: loaders return before splats are sorted and shaders compiled."""
    from PIL import Image

    end, last, same = time.monotonic() + _PATIENCE, np.zeros((1, 1, 3), np.uint8), 0
    while same < _STILL and time.monotonic() < end:
        time.sleep(pause)
        picture = np.asarray(Image.open(io.BytesIO(page.screenshot())).convert("RGB"))
        same = same + 1 if picture.any() and np.array_equal(picture, last) else 0
        last = picture
    return last.astype(np.float32) / 255.0


def stands(placed: SplatModel, world: Sequence[float]) -> str:
    """Tell how the up direction of a file's axes lies in a world whose y points up."""
    axes = placed.coordinate_system
    up = up_of_axes(DEFAULT_AXES if axes == UNSPECIFIED else axes)
    if up is None:
        return "?"
    height = (np.reshape(world, (4, 4)).T[:3, :3] @ np.array(up))[1]
    return "upright" if height > 0.9 else "on its head" if height < -0.9 else "on its side"


def _keep(out: Path, scene: str, pictures: dict[tuple[str, str], Picture]) -> None:
    """Write the pictures of a scene, and all of them on a sheet: a row for each engine, ours by its rules first."""
    from PIL import Image, ImageDraw

    out.mkdir(parents=True, exist_ok=True)
    engines, forms = (list(dict.fromkeys(names)) for names in zip(*pictures, strict=True))
    sheet = Image.new("RGB", (WIDTH * len(forms), HEIGHT * len(engines)))
    for (engine, form), picture in pictures.items():
        pixels = np.rint(255.0 * picture).astype(np.uint8)
        write_png(out / f"{scene}-{engine}-{form}.png", pixels)
        image = Image.fromarray(pixels)
        ImageDraw.Draw(image).text(
            (4, 4), f"{engine} {form}", fill=(255, 255, 0), stroke_width=1, stroke_fill=(0, 0, 0)
        )
        sheet.paste(image, (WIDTH * forms.index(form), HEIGHT * engines.index(engine)))
    sheet.save(out / f"{scene}.png")


if __name__ == "__main__":
    sys.exit(run(main))

"""Train and score the benchmark scenes that papers report, whichever of them lie under a folder.

    python -m csplat_bench.datasets ROOT --out runs --lpips alex.npz
    python -m csplat_bench.datasets ROOT --scenes garden,truck --iterations 30000 --max-splats 1000000
    python -m csplat_bench.datasets ROOT --scenes fox --size 270x480 --iterations 4500 --max-splats 120000

Known are Mip-NeRF 360 (images_4 outdoors, images_2 indoors), Tanks and Temples (train, truck), Deep Blending
(drjohnson, playroom) and NeRF-synthetic; any other COLMAP, Blender or transforms.json set is scored too. Pictures wider
than 1600 pixels are scaled down to that; every 8th picture is held out if the set names no test pictures.

Each scene is trained, written as a PLY, scored on its held-out pictures, encoded with each preset, and the decoded
files are scored on the same pictures. PSNR is the mean over the pictures, as papers print it; SSIM has INRIA's window;
LPIPS is AlexNet's. A scene whose PLY lies in --out is not trained again; the PLY of another trainer may be laid there.
If other programs need the same cores, OPENBLAS_NUM_THREADS=1 keeps LPIPS from waiting for its own threads.
"""

from __future__ import annotations

import re
import sys
from pathlib import Path
from typing import Annotated, cast

import typer

from csplat.encoder import PRESETS as KNOWN_PRESETS
from csplat.errors import CsplatError, InputError
from csplat_bench.common.command import JSON, LPIPS, MARKDOWN, OUT, PRESETS, WrongWords, listed, run
from csplat_bench.common.report import describe, write_json
from csplat_bench.common.scenes import OUT as EVERYTHING
from csplat_bench.datasets.folders import choose_scenes, find_scene_folders
from csplat_bench.datasets.runs import Settings, run_scene
from csplat_bench.datasets.tables import means_table, notes, scenes_table
from csplat_render.lpips import load_lpips
from csplat_render.warmup import warm_up
from csplat_tools.console import note
from csplat_trainer.training_options import Device, TrainOptions


def main(
    root: Annotated[Path, typer.Argument(metavar="ROOT", help="folder with data sets, or one of them")],
    *,
    scenes: Annotated[str | None, typer.Option(metavar="NAMES", help="only these, separated by commas")] = None,
    iterations: Annotated[int, typer.Option(help="training steps; papers 30000")] = 7000,
    max_splats: Annotated[int, typer.Option(help="no more than this")] = 200_000,
    sh_degree: Annotated[int, typer.Option(help="of the splats")] = 3,
    seed: Annotated[int, typer.Option(help="of training")] = 0,
    device: Annotated[str, typer.Option(help="cpu, or cuda with gsplat")] = "cpu",
    size: Annotated[str | None, typer.Option(metavar="WxH", help="bring all pictures to this size")] = None,
    downscale: Annotated[float, typer.Option(help="divide the papers' width and height by this")] = 1.0,
    presets: PRESETS = "fast,balanced,small",
    lpips: LPIPS = None,
    force: Annotated[bool, typer.Option("--force", help="train again what is trained")] = False,
    rescore: Annotated[bool, typer.Option("--rescore", help="encode and score again what is scored")] = False,
    json: JSON = None,
    markdown: MARKDOWN = False,
    out: OUT = EVERYTHING / "datasets",
) -> int:
    """Find the scenes, run them one after the other, print the tables."""
    try:
        training = TrainOptions(
            iterations=iterations, max_splats=max_splats, sh_degree=sh_degree, seed=seed, device=cast(Device, device)
        )
    except InputError as error:
        raise WrongWords(str(error)) from None
    unknown = set(listed(presets)) - set(KNOWN_PRESETS)
    if unknown:
        raise WrongWords(f"--presets names {', '.join(sorted(unknown))}, wanted some of {', '.join(KNOWN_PRESETS)}")
    if downscale < 1.0 or (size is not None and downscale != 1.0):
        raise WrongWords(f"--downscale is {downscale:g}, wanted 1 or more, and no --size beside it")
    settings = Settings(training, _size(size), downscale, tuple(listed(presets)), force, rescore)
    chosen = choose_scenes(find_scene_folders(root), scenes)
    weights = None if lpips is None else load_lpips(None if lpips == "auto" else lpips)
    for one in chosen:
        note(f"found {one.title} ({one.protocol.name}, {one.kind}) in {one.path}")
    warm_up(note)
    records, failed = [], {}
    for number, one in enumerate(chosen):
        note(f"-- {number + 1} of {len(chosen)}: {one.title}")
        try:
            records.append(run_scene(one, settings, out, weights))
        except (CsplatError, OSError) as error:  # the others are run all the same
            failed[one.title] = str(error)
            note(f"error: {one.title}: {error}")
    machine, remarks = describe(), notes(records)
    if json is not None:
        write_json(json, {"machine": machine, "scenes": records, "failed": failed, "notes": remarks})
    means = means_table(records, markdown=markdown)
    parts = [scenes_table(records, markdown=markdown), f"Means\n\n{means}" if means else "", "\n".join(remarks)]
    print(
        "\n\n".join(part for part in (*parts, "\n".join(f"{name}: {text}" for name, text in machine.items())) if part)
    )
    return 1 if failed else 0


def _size(text: str | None) -> tuple[int, int] | None:
    if text is None:
        return None
    found = re.fullmatch(r"([1-9]\d{0,4})x([1-9]\d{0,4})", text)
    if found is None:
        raise WrongWords(f"--size is {text}, wanted width and height, as 640x480")
    return int(found[1]), int(found[2])


if __name__ == "__main__":
    sys.exit(run(main))

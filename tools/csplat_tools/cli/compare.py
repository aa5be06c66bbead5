# SPDX-License-Identifier: Apache-2.0
"""`csplat compare`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from csplat.context import Context
from csplat.disk_files import read_array
from csplat.errors import InputError, counted
from csplat_tools.cli import shared_options as shared
from csplat_tools.cli.command_output import Output
from csplat_tools.console import format_bytes
from csplat_tools.file_streams import STANDARD_STREAM
from csplat_tools.inspect.text_reports import format_comparison
from csplat_tools.optional_packages import require_renderer
from csplat_tools.scene_files import findings_of, load_scene, open_scenes, sample_scene
from csplat_tools.slider_page import is_page
from csplat_tools.views import Split

_NO_FOLDER = (".csplat", ".gif", ".htm", ".jpeg", ".jpg", ".json", ".pdf", ".ply", ".png", ".webp")  # endings

_INDEX_BYTES = 1 << 27  # largest size of a source index, which is read as a whole


def compare(
    a: Annotated[str, typer.Argument(metavar="A", help="The source, in any format.")],
    b: Annotated[str, typer.Argument(metavar="B", help="The scene that was made from it.")],
    cameras: shared.Cameras = None,
    data: shared.Data = None,
    background: shared.Background = None,
    split: Annotated[
        Split, typer.Option(metavar="PART", show_default=False, help="test or train images. Default: test.")
    ] = "test",
    pictures: Annotated[
        str | None,
        typer.Option(metavar="FOLDER", help="Write renders of A, B, differences; or PAGE.html, a page of them."),
    ] = None,
    lpips: Annotated[
        str | None, typer.Option(metavar="FILE.npz", help="Weights of LPIPS, or auto. Default: none.")
    ] = None,
    level: shared.Level = None,
    backend: shared.BackendOption = "cpu",
    test_every: shared.TestEvery = None,
    source_index: Annotated[
        str | None,
        typer.Option(metavar="FILE.npy", hidden=True, help="File of `encode --source-index`: pairs of splats."),
    ] = None,
    force: shared.Force = False,
    report: shared.Report = None,
    as_json: shared.Json = False,
    quiet: shared.Quiet = False,
    _all: shared.HelpAll = False,
) -> None:
    """Compare a scene with its source: sizes, errors, and renders.

    `psnr` is pooled over all pixels of eight 640x480 views around A in front
    of black, or of the given views; at most 99 dB. Compare only values for
    the same cameras and background. With --cameras or --data, views between,
    beside and beyond the cameras are scored, too, if the scenes fit in memory.
    With --data, A and B are also scored against the held-out images. Scenes
    that do not fit in memory are rendered from the disk. --level applies to B.
    --backend gpu computes PSNR on a GPU (extra gpu), which may differ in the
    third decimal. --pictures and --data require the render extra.

    Examples:
      csplat compare scene.ply scene.csplat
      csplat compare scene.ply scene.csplat --data capture --lpips auto
      csplat compare scene.ply scene.csplat --level 2 --pictures differences
      csplat compare scene.ply scene.csplat --pictures page.html
      csplat compare scene.ply other.ply --cameras test.json --json | jq .psnr
    """
    import csplat_tools

    out = Output(force, report, as_json, quiet)
    views = shared.ViewOptions(cameras, data, background, test_every)
    shared.require_one({"--split": split != "test", "--test-every": test_every}, {"--data": data})
    if pictures is not None and (pictures in ("", STANDARD_STREAM) or Path(pictures).suffix.lower() in _NO_FOLDER):
        raise typer.BadParameter(f"--pictures is {pictures!r}, expected a folder or a page, such as page.html")
    page, folder = (pictures, None) if pictures is not None and is_page(pictures) else (None, pictures)
    out.check(page, inputs=(a, b, *views.inputs, source_index, None if lpips == "auto" else lpips))
    if a == b == STANDARD_STREAM:
        raise typer.BadParameter("A and B cannot both be standard input")
    chosen, max_splats = shared.parse_level(level)
    require_renderer()
    mode, device = shared.parse_backend(backend, out)
    rows = None if source_index is None else read_array(source_index, most_bytes=_INDEX_BYTES)
    given = b if (chosen, max_splats) == (0, None) else load_scene(b, level=chosen, max_splats=max_splats)
    with open_scenes((a, given)) as (source, other), out.bar() as progress:
        context = Context(progress=progress)
        if source.in_memory is None:
            if mode == "exact":
                raise InputError("--backend exact requires both scenes in memory, and they do not fit: use cpu")
            bound = format_bytes(context.memory_limit)
            out.remark(f"A and B do not fit in {bound} of memory: they are rendered from the disk")
        for name, scene in ((a, source), (b, other)):
            out.print_findings(findings_of(scene), Path(name).name)
        model, every = sample_scene(source, progress=progress)
        view_set = views.find(model, out, a, count=0, split=split, every=every, must_fit=False)
        if mode == "exact":
            from csplat_tools.views.view_sets import total_render_seconds

            out.announce_time(
                lambda: 2 * total_render_seconds(model, view_set.test, mode=mode), "--backend cpu takes seconds"
            )
        compared = csplat_tools.compare(
            source, other, views=view_set, source_index=rows, lpips=lpips, pictures=pictures, background=views.colour,
            mode=mode, backend=device, force=out.force, context=context,
        )  # fmt: skip
    out.publish(compared.as_json(), format_comparison(compared, Path(a).name, Path(b).name))
    if folder is not None:
        out.remark(f"{counted(len(compared.quality.each), 'file')} in {folder}")

"""`csplat render`."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated, ClassVar

import typer

from csplat.errors import counted
from csplat_render.up_estimate import estimate_up
from csplat_tools.cli.command import OutputOptions, command
from csplat_tools.cli.shared_options import (
    ModeOption,
    OrientationOptions,
    SceneArgument,
    ShDegree,
    SplitOption,
    ViewOptions,
    parse_size,
)
from csplat_tools.console import note
from csplat_tools.file_streams import STANDARD_STREAM, check_name
from csplat_tools.optional_packages import prepare_renderer, require_renderer
from csplat_tools.present.scene_renders import find_cameras, render_film, render_folder
from csplat_tools.render_files import DEFAULT_FPS, MAX_FPS, is_film
from csplat_tools.scene_files import load_model

_OTHER_FILMS = (".avi", ".m4v", ".mkv", ".mov", ".mpg", ".webm")


@dataclass(frozen=True)
class _RenderViewOptions(ViewOptions):
    """Options of the views to render, which are all views of the cameras or the data set, and of their size."""

    needs: ClassVar[Mapping[str, tuple[str, ...]]] = dict.fromkeys(("images", "test_every", "split"), ("data",))

    cameras: Annotated[
        str | None, typer.Option(metavar="FILE.json", help="Cameras: a list of {K, viewmat, W, H, near, image}.")
    ] = None
    data: Annotated[str | None, typer.Option(metavar="DATA", help="Cameras of the photographs of a data set.")] = None
    background: Annotated[
        str | None,
        typer.Option(metavar="R,G,B", help="Background, 0 to 1, or black, or white. Default: as in training."),
    ] = None
    size: Annotated[
        str | None, typer.Option(metavar="WxH", help="Size of renders. Default: that of the cameras, or 640x480.")
    ] = None


@command(reads=True, needs={"up": ("orbit",), "axes": ("orbit",)})
def render(
    source: SceneArgument,
    output: Annotated[
        str, typer.Argument(metavar="OUT", help="A folder for PNG files; or NAME.mp4, .webp, .gif, .png: a film.")
    ],
    views: _RenderViewOptions,
    upright: OrientationOptions,
    out: OutputOptions,
    orbit: Annotated[
        int | None,
        typer.Option(metavar="N", min=1, help="N cameras around the scene, or along those of --cameras or --data."),
    ] = None,
    split: SplitOption = "test",
    fps: Annotated[
        float, typer.Option(metavar="RATE", min=0.1, max=MAX_FPS, help="Frames per second of a film.")
    ] = DEFAULT_FPS,
    mode: ModeOption = "standard",
    sh_degree: ShDegree = None,
    depth: Annotated[bool, typer.Option("--depth", help="Write NAME.depth.npy too, float32, scene units.")] = False,
    alpha: Annotated[bool, typer.Option("--alpha", help="Write NAME.alpha.png too.")] = False,
) -> None:
    """Render a scene to PNG files, or to a film: MP4, or an animated WebP, GIF or PNG.

    A render is named after its camera's photograph, or by a number. A film
    repeats for ever; WebP loses a little, GIF has 256 colours, PNG is lossless.
    MP4 is H.264 and requires the film extra. Cameras are relative to the scene's
    origin, or around it if it is far from 0; those of a data set are where its
    photographs were taken.
    Camera files are our own, INRIA's cameras.json, camera paths of nerfstudio,
    and transforms.json.
    An orbit shows the whole of an object; inside a room it goes where fine splats
    are visible, or along the cameras that you give. Requires the packages of the
    render extra.

    Examples:
      csplat render scene.csplat --orbit 120 turn.mp4
      csplat render scene.ply --orbit 120 turn.webp --up z
      csplat render room.ply --orbit 240 room.mp4 --data capture
      csplat render scene.csplat pictures --orbit 120
      csplat render scene.ply held-out --data capture --split test
      csplat render scene.ply views --cameras test.json --background white
      csplat render scene.ply small --orbit 8 --size 320x240 --sh-degree 0
    """
    film = is_film(output)
    if (views.cameras, orbit, views.data) == (None, None, None):
        raise typer.BadParameter("wanted cameras: --orbit 120 for a path around the scene, or --cameras, or --data")
    if output == STANDARD_STREAM or Path(output).suffix.lower() in _OTHER_FILMS:
        raise typer.BadParameter(f"OUT is {output}, wanted a folder, or a film: NAME.mp4, .webp, .gif or .png")
    if film and (depth or alpha):
        raise typer.BadParameter("--depth and --alpha want a folder, not a film")
    pixels = None if views.size is None else parse_size(views.size)
    colour = views.colour
    shots = views.data_options()
    out.check(output if film else None, inputs=(source, *views.inputs))
    if not film:
        check_name(output, ".webp", "render", source)
    require_renderer()
    read = load_model(source, sh_degree=sh_degree)
    out.print_findings(read.findings)
    model = upright.overrides().apply(read.model)
    report: list[str] = []
    cameras = find_cameras(model, views.cameras, orbit, shots, pixels, split=split, report=report)
    out.remark(*report)
    if orbit is not None:
        upright.take_estimated_up(estimate_up(model), out)
    write = partial(render_film, fps=fps) if film else partial(render_folder, depth=depth, alpha=alpha)
    with out.bar() as progress:
        rendered = write(
            model, cameras, output, background=colour, mode=mode, force=out.force,
            prepare=partial(prepare_renderer, quiet=out.quiet), progress=progress,
        )  # fmt: skip
    if rendered.ignored_count:
        note(f"{counted(rendered.ignored_count, 'splat')} with NaN or infinities, not drawn")
    out.remark(
        f"{counted(len(cameras), 'frame')} in {output}"
        if film
        else f"{counted(len(rendered.files), 'file')} in {output}"
    )
    out.publish({"files": [str(file) for file in rendered.files], "ignored_splats": rendered.ignored_count})

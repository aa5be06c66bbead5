"""`csplat render`."""

from __future__ import annotations

from typing import Annotated

import typer

from csplat_tools.console import guarded, note, progress_bar
from csplat_tools.extras import prepare_renderer
from csplat_tools.models import load_model, without_bands
from csplat_tools.parsing import parse_colour, parse_mode, parse_size
from csplat_tools.rendering import find_cameras, render_folder

__all__ = ["render"]


@guarded
def render(
    source: Annotated[str, typer.Argument(metavar="SCENE", help="A PLY or .csplat file, or - for standard input.")],
    folder: Annotated[str, typer.Option("--output", "-o", metavar="FOLDER", help="Where the pictures go.")],
    cameras: Annotated[
        str | None, typer.Option(metavar="FILE.json", help="Cameras: a list of {K, viewmat, W, H, near, image}.")
    ] = None,
    orbit: Annotated[
        int | None, typer.Option(metavar="N", min=1, help="Instead: N cameras on a circle around the scene.")
    ] = None,
    size: Annotated[
        str | None, typer.Option(metavar="WxH", help="Size of the pictures: the cameras' own, or 640x480.")
    ] = None,
    background: Annotated[
        str, typer.Option(metavar="R,G,B", help="Colour behind the scene, 0 to 1, or black, or white.")
    ] = "black",
    mode: Annotated[str, typer.Option(metavar="exact|standard|fast", help="Speed for accuracy.")] = "standard",
    sh_degree: Annotated[
        int | None, typer.Option(metavar="0..3", min=0, max=3, help="Leave out SH bands above this one.")
    ] = None,
    depth: Annotated[bool, typer.Option("--depth", help="Write NAME.depth.npy too, float32, scene units.")] = False,
    alpha: Annotated[bool, typer.Option("--alpha", help="Write NAME.alpha.png too.")] = False,
    force: Annotated[bool, typer.Option("--force", help="Replace existing files.")] = False,
    quiet: Annotated[bool, typer.Option("--quiet", "-q", help="Say nothing unless something is wrong.")] = False,
) -> None:
    """Render a scene to PNG files.

    Each picture takes the name of its camera's photograph, or a number.
    Cameras stand relative to the scene's origin. Needs the packages of the
    render extra.

    Examples:
      csplat render scene.csplat --orbit 120 -o film
      ffmpeg -i film/%04d.png -pix_fmt yuv420p film.mp4
      csplat render scene.ply --cameras test.json -o views --background white
      csplat render scene.ply --orbit 8 -o small --size 320x240 --sh-degree 0
    """
    if (cameras is None) == (orbit is None):
        raise typer.BadParameter("wanted one of --cameras and --orbit")
    pixels = None if size is None else parse_size(size)
    colour, chosen = parse_colour(background), parse_mode(mode)
    prepare_renderer(quiet=quiet)
    loaded = load_model(source)
    model = loaded.model if sh_degree is None else without_bands(loaded.model, sh_degree)
    with progress_bar(quiet=quiet) as progress:
        rendered = render_folder(
            model,
            find_cameras(model, cameras, orbit, pixels),
            folder,
            background=colour,
            mode=chosen,
            depth=depth,
            alpha=alpha,
            force=force,
            progress=progress,
        )
    if rendered.ignored_count:
        note(f"{rendered.ignored_count} splats that hold NaN or infinities are not drawn")
    if not quiet:
        note(f"{len(rendered.files)} files in {folder}")

"""`csplat render`."""

from __future__ import annotations

from functools import partial
from typing import Annotated

import typer

from csplat_tools.cli.console import guarded
from csplat_tools.cli.data_options import Images, Split, TestEvery, data_options
from csplat_tools.cli.parsing import parse_colour, parse_mode, parse_size
from csplat_tools.files.console import note, progress_bar
from csplat_tools.files.extras import need_renderer, prepare_renderer
from csplat_tools.files.scenes import load_model, without_bands
from csplat_tools.present.film import DEFAULT_FPS, MAX_FPS, is_film
from csplat_tools.present.rendering import find_cameras, render_film, render_folder

__all__ = ["render"]


@guarded
def render(
    source: Annotated[str, typer.Argument(metavar="SCENE", help="A PLY or .csplat file, or - for standard input.")],
    output: Annotated[
        str, typer.Option("--output", "-o", metavar="FOLDER|FILM", help="A folder, or NAME.webp, .gif, .png: a film.")
    ],
    cameras: Annotated[
        str | None, typer.Option(metavar="FILE.json", help="Cameras: a list of {K, viewmat, W, H, near, image}.")
    ] = None,
    orbit: Annotated[
        int | None, typer.Option(metavar="N", min=1, help="Instead: N cameras on a circle around the scene.")
    ] = None,
    data: Annotated[
        str | None, typer.Option(metavar="DATA", help="Instead: where the pictures of a data set were taken.")
    ] = None,
    split: Split = "test",
    images: Images = None,
    test_every: TestEvery = None,
    size: Annotated[
        str | None, typer.Option(metavar="WxH", help="Size of the pictures: the cameras' own, or 640x480.")
    ] = None,
    fps: Annotated[
        float, typer.Option(metavar="RATE", min=0.1, max=MAX_FPS, help="Pictures per second of a film.")
    ] = DEFAULT_FPS,
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
    """Render a scene to PNG files, or to an animated WebP, GIF or PNG.

    Each picture takes the name of its camera's photograph, or a number. A
    film repeats for ever; WebP loses a little, GIF has 256 colours, PNG loses
    nothing. Cameras stand relative to the scene's origin, those of a data set
    where its pictures were taken. Needs the packages of the render extra.

    Examples:
      csplat render scene.csplat --orbit 120 -o turn.webp
      csplat render scene.csplat --orbit 120 -o film
      ffmpeg -framerate 25 -i film/%04d.png -pix_fmt yuv420p film.mp4
      csplat render scene.ply --data capture --split test -o held-out
      csplat render scene.ply --cameras test.json -o views --background white
      csplat render scene.ply --orbit 8 -o small --size 320x240 --sh-degree 0
    """
    if (cameras is None) + (orbit is None) + (data is None) != 2:
        raise typer.BadParameter("wanted one of --cameras, --orbit and --data")
    film = is_film(output)
    if film and (depth or alpha):
        raise typer.BadParameter("--depth and --alpha want a folder, not a film")
    pixels = None if size is None else parse_size(size)
    colour, chosen = parse_colour(background), parse_mode(mode)
    shots = data_options(data, None if data is None else size, images, test_every, split=split)
    need_renderer()
    loaded = load_model(source)
    model = loaded.model if sh_degree is None else without_bands(loaded.model, sh_degree)
    views = find_cameras(model, cameras, orbit, shots, pixels, split=split)
    write = partial(render_film, fps=fps) if film else partial(render_folder, depth=depth, alpha=alpha)
    with progress_bar(quiet=quiet) as progress:
        rendered = write(
            model,
            views,
            output,
            background=colour,
            mode=chosen,
            force=force,
            prepare=partial(prepare_renderer, quiet=quiet),
            progress=progress,
        )
    if rendered.ignored_count:
        note(f"{rendered.ignored_count} splats that hold NaN or infinities are not drawn")
    if not quiet:
        note(f"{len(views)} pictures in {output}" if film else f"{len(rendered.files)} files in {output}")

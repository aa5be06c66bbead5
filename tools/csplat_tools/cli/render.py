# SPDX-License-Identifier: Apache-2.0
"""`csplat render`."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Annotated

import typer

from csplat.context import Context
from csplat.errors import counted
from csplat_render.up_estimate import estimate_up
from csplat_tools.cli import shared_options as shared
from csplat_tools.cli.command_output import Output
from csplat_tools.console import note
from csplat_tools.file_streams import STANDARD_STREAM, check_name
from csplat_tools.optional_packages import require_renderer
from csplat_tools.present.scene_renders import find_cameras, render_film, render_folder
from csplat_tools.render_files import DEFAULT_FPS, MAX_FPS, is_film
from csplat_tools.scene_files import load_scene, splats_to_frame

_NOT_WRITTEN = (".avi", ".bmp", ".exr", ".hdr", ".m4v", ".mkv", ".mov", ".mpg", ".tif", ".tiff", ".webm")


def render(
    source: shared.SceneArgument,
    output: Annotated[
        str,
        typer.Argument(metavar="OUT", help="NAME.webp, .png: image or video; NAME.mp4, .gif: video; or a folder."),
    ],
    cameras: Annotated[str | None, typer.Option(metavar="FILE.json", help="Cameras, in a format listed above.")] = None,
    data: Annotated[str | None, typer.Option(metavar="DATA", help="Cameras of a data set's test images.")] = None,
    background: shared.Background = None,
    size: Annotated[str | None, typer.Option(metavar="WxH", help="Pixels. Default: cameras', or 640x480.")] = None,
    up: Annotated[
        str | None, typer.Option(metavar="-y|X,Y,Z", help="Up, for --orbit. Default: scene's, or -y.")
    ] = None,
    orbit: Annotated[
        int | None, typer.Option(metavar="N", min=1, help="N cameras around or along. Default: none.")
    ] = None,
    level: shared.Level = None,
    backend: shared.BackendOption = "cpu",
    fps: Annotated[
        float, typer.Option(metavar="RATE", show_default=False, help="Frames per second. Default: 25.")
    ] = DEFAULT_FPS,
    depth: Annotated[
        bool, typer.Option("--depth", hidden=True, help="Write NAME.depth.npy, float32, scene units.")
    ] = False,
    alpha: Annotated[bool, typer.Option("--alpha", hidden=True, help="Write NAME.alpha.png.")] = False,
    force: shared.Force = False,
    report: shared.Report = None,
    as_json: shared.Json = False,
    quiet: shared.Quiet = False,
    _all: shared.HelpAll = False,
) -> None:
    """Render a scene to an image, to PNG files, or to a video.

    Without cameras, the first view is rendered, which viewers show, too. Files
    in a folder are named after the images of their cameras, or numbered. Camera
    files: our own list of {K, viewmat, W, H, near, image}, INRIA's
    cameras.json, camera paths of nerfstudio, and transforms.json. An orbit
    shows a whole object; with cameras it follows them. --backend gpu renders
    on a GPU (extra gpu); exact and fast are a slow and a fast mode of the
    CPU. MP4 requires the film extra, and everything the render extra.

    Examples:
      csplat render scene.csplat poster.webp --size 1200x800
      csplat render scene.csplat turn.mp4 --orbit 120
      csplat render room.csplat room.webp --orbit 240 --level 500k
      csplat render scene.ply held-out --data capture
      csplat render scene.ply views --cameras test.json --background white
    """
    out = Output(force, report, as_json, quiet)
    is_video, views = is_film(output), shared.ViewOptions(cameras, data, background)
    if cameras is None and orbit is None and data is None and Path(output).suffix.lower() in (".mp4", ".gif"):
        raise typer.BadParameter(f"{output} is a video, expected --orbit 120 for a path around the scene, or cameras")
    if output == STANDARD_STREAM or Path(output).suffix.lower() in _NOT_WRITTEN:
        raise typer.BadParameter(f"OUT is {output}, expected a folder, or a video: NAME.mp4, .webp, .gif or .png")
    if is_video and (depth or alpha):
        raise typer.BadParameter("--depth and --alpha require a folder, not a video")
    shared.check_range("--fps", fps, 0.1, MAX_FPS)
    shared.require_one({"--up": up}, {"--orbit": orbit})
    chosen, max_splats = shared.parse_level(level)
    pixels, overrides = None if size is None else shared.parse_size(size), shared.parse_overrides(up)
    out.check(output if is_video else None, inputs=(source, *views.inputs))
    if not is_video:
        check_name(output, ".webp", "render", source)
    if depth and backend in ("gpu", "auto", "software"):
        raise typer.BadParameter(f"--depth requires --backend cpu, exact or fast, found {backend}")
    require_renderer()
    mode, device = shared.parse_backend(backend, out)
    with out.bar() as progress:
        read = load_scene(source, level=chosen, max_splats=max_splats)
        out.print_findings(read.findings)
        model, notes = overrides.apply_to_model(read.model()), list[str]()
        to_frame = model if orbit is None else overrides.apply_to_model(splats_to_frame(source, read.model()))
        data_set = None if data is None else shared.open_data(data, size=pixels)
        shots = find_cameras(to_frame, cameras, orbit, data_set, pixels, report=notes)
        out.remark(*notes)
        write = partial(render_film, fps=fps) if is_video else partial(render_folder, depth=depth, alpha=alpha)
        rendered = write(
            model, shots, output, background=views.colour, mode=mode, backend=device, force=out.force,
            context=Context(progress=progress),
        )  # fmt: skip
    if orbit is not None and not out.quiet:
        axis = estimate_up(to_frame)
        if axis is not None:
            out.remark(f"{shared.describe_estimated_up(axis)}, and used (encode --up writes it into a file)")
        elif to_frame.metadata.up is None and cameras is None:
            out.remark("the scene does not state which way is up: -y is assumed; --up sets another")
    if rendered.ignored_count:
        note(f"{counted(rendered.ignored_count, 'splat')} with NaN or infinities, not drawn")
    out.remark(
        f"{'image' if len(shots) == 1 else counted(len(shots), 'frame')} in {output}"
        if is_video
        else f"{counted(len(rendered.files), 'file')} in {output}"
    )
    out.publish({"files": [str(file) for file in rendered.files], "ignored_splats": rendered.ignored_count})

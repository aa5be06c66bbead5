"""`csplat view`, `csplat export-html` and `csplat export-element`."""

from __future__ import annotations

import gzip
import sys
import webbrowser
from contextlib import ExitStack
from typing import Annotated

import typer

from csplat.decoder import decode_scene
from csplat.errors import counted
from csplat_tools.cli.command import OutputOptions, command
from csplat_tools.cli.shared_options import OrientationOptions, Preset, SceneArgument
from csplat_tools.console import format_bytes, note
from csplat_tools.file_streams import check_name, write_bytes
from csplat_tools.present import viewer_page
from csplat_tools.present.viewer_server import (
    ViewerScene,
    estimated_up_parameters,
    open_server,
    open_viewer_scene,
    page_parameters,
)

_Cameras = Annotated[
    str | None, typer.Option(metavar="FILE.json", help="Look from these cameras, see `csplat render`.")
]


@command(serves=True, reads=True)
def view(
    source: SceneArgument,
    upright: OrientationOptions,
    out: OutputOptions,
    preset: Preset = "fast",
    cameras: _Cameras = None,
    port: Annotated[int, typer.Option(metavar="PORT", min=0, max=65535, help="0 finds one that is free.")] = 0,
    host: Annotated[
        str, typer.Option(metavar="ADDRESS", help="Who can see the scene: this machine; 0.0.0.0: the network.")
    ] = "127.0.0.1",
    no_browser: Annotated[bool, typer.Option("--no-browser", help="Print the address, open nothing.")] = False,
) -> None:
    """Show a scene in the browser.

    Serves the viewer and the scene, and nothing else of this machine, until
    Ctrl-C. A PLY is encoded first, in memory. The address of the page goes
    to standard output.

    Examples:
      csplat view scene.csplat
      csplat view scene.ply --preset small --up z
      csplat view scene.csplat --no-browser --port 8000
    """
    out.check(inputs=(source, cameras))
    wishes = page_parameters(cameras, upright.overrides())
    with ExitStack() as stack:
        with out.bar() as progress:
            scene = stack.enter_context(open_viewer_scene(source, preset=preset, progress=progress))
        wishes |= _scene_wishes(scene, cameras, upright, out)
        server = open_server(scene, host=host, port=port, wishes=wishes)
        with server as opened:
            out.print_findings(scene.findings)
            out.remark(*_encoded(scene, preset))
            out.publish({"url": opened.url, "splats": scene.header.splat_count}, opened.url)
            sys.stdout.flush()
            out.remark("Ctrl-C ends this.")
            if not no_browser and not webbrowser.open(opened.url):
                note("no browser could be opened: open the address above in one")
            try:
                opened.serve_forever(poll_interval=0.1)
            except KeyboardInterrupt:
                out.remark("")  # ends the line with the terminal's ^C


@command(beside=".html", reads=True)
def export_html(
    source: SceneArgument,
    output: Annotated[str, typer.Argument(metavar="PAGE.html", help="The file to write, or -; SCENE.html by default.")],
    upright: OrientationOptions,
    out: OutputOptions,
    preset: Preset = "balanced",
    cameras: _Cameras = None,
) -> None:
    """Write one page that shows a scene, with everything inside.

    It opens from a disk, without a network, in any browser with WebGL 2,
    and can be sent to anybody. A PLY is encoded first; a .csplat file is
    checked to the last byte. `csplat export-element` is for scenes in a
    page of your own.

    Examples:
      csplat export-html scene.csplat scene.html
      csplat export-html scene.ply scene.html --preset small --force
      csplat export-html scene.csplat scene.html --cameras views.json
    """
    wishes = page_parameters(cameras, upright.overrides())
    out.check(output, inputs=(source, cameras))
    check_name(output, ".html", "export-html", source)
    with out.bar() as progress, open_viewer_scene(source, preset=preset, progress=progress) as scene:
        data = scene.read()
        decode_scene(data)
        wishes |= _scene_wishes(scene, cameras, upright, out)
        exported = viewer_page.export_page(data, scene.name, wishes)
        write_bytes(output, exported.page)
        out.print_findings(scene.findings)
        out.remark(*_encoded(scene, preset))
    out.remark(
        f"{output}: {format_bytes(len(exported.page))}, of which the scene {format_bytes(exported.scene_bytes)}"
        f" (its file and a third), page and decoder {format_bytes(exported.code_bytes)}"
    )
    sizes = {"scene_bytes": exported.scene_bytes, "code_bytes": exported.code_bytes}
    out.publish({"splats": scene.header.splat_count, "size_bytes": len(exported.page), **sizes})


@command()
def export_element(
    output: Annotated[str, typer.Argument(metavar="OUT.js", help="The file to write, or -.")], out: OutputOptions
) -> None:
    """Write the viewer as one script, for scenes in pages of your own.

    A page that loads it has the element <csplat-view>, which is to a
    .csplat file what <img> is to a picture:

      <script src="csplat-view.js" defer></script>
      <csplat-view src="scene.csplat" alt="A garden"></csplat-view>

    The script needs nothing beside it. "Only show it" in the guide to
    embedding lists attributes and events, and what a policy of the page
    (Content-Security-Policy) has to allow.

    Examples:
      csplat export-element csplat-view.js
    """
    out.check(output)
    check_name(output, ".js", "export-element")
    script = viewer_page.export_element()
    write_bytes(output, script)
    out.remark(f"{output}: {format_bytes(len(script))}, {format_bytes(len(gzip.compress(script)))} as servers send it")
    out.publish({"size_bytes": len(script)})


def _scene_wishes(
    scene: ViewerScene, cameras: str | None, upright: OrientationOptions, out: OutputOptions
) -> dict[str, str]:
    """Return the page's parameters of a scene: cameras relative to its origin, and the estimated up direction."""
    wishes = {}
    if cameras is not None:
        report: list[str] = []
        wishes = page_parameters(cameras, report=report, origin=scene.header.origin)
        out.remark(*report)
    return wishes | estimated_up_parameters(upright.take_estimated_up(scene.seems_up, out))


def _encoded(scene: ViewerScene, preset: str) -> list[str]:
    if not scene.encoded_from:
        return []
    sizes = f"{format_bytes(scene.encoded_from)} -> {format_bytes(scene.size_bytes)}"
    return [f"encoded with the preset {preset}: {sizes}, {counted(scene.header.splat_count, 'splat')}"]

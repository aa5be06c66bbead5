# SPDX-License-Identifier: Apache-2.0
"""`csplat view`, `csplat export-html` and `csplat export-element`."""

from __future__ import annotations

import gzip
import sys
import webbrowser
from contextlib import ExitStack
from typing import Annotated

import typer

from csplat.context import Context
from csplat.decoder import decode_scene
from csplat.encoder import PresetName
from csplat.errors import counted
from csplat_tools.cli import shared_options as shared
from csplat_tools.cli.command_output import Output, default_output
from csplat_tools.console import format_bytes, note
from csplat_tools.encode_file import describe_wait
from csplat_tools.file_streams import check_name, write_bytes
from csplat_tools.present import viewer_page
from csplat_tools.present.viewer_server import (
    ViewerScene,
    open_server,
    open_viewer_scene,
    page_parameters,
)

_PORT_MAX = 65_535
_Cameras = Annotated[
    str | None, typer.Option("--cameras", metavar="FILE.json", help="First views. Default: the file's.")
]
_PRESETS: tuple[PresetName, PresetName] = ("fast", "balanced")  # for `view`, for `export-html`


def view(
    source: shared.SceneArgument,
    up: shared.Up = None,
    cameras: _Cameras = None,
    port: Annotated[
        int, typer.Option(metavar="PORT", show_default=False, help="Port of the server. Default: any free one.")
    ] = 0,
    host: Annotated[
        str, typer.Option(metavar="ADDRESS", show_default=False, help="0.0.0.0: any machine. Default: this one.")
    ] = "127.0.0.1",
    no_browser: Annotated[bool, typer.Option("--no-browser", help="Print the address only.")] = False,
    force: shared.Force = False,
    report: shared.Report = None,
    as_json: shared.Json = False,
    quiet: shared.Quiet = False,
    _all: shared.HelpAll = False,
) -> None:
    """Show a scene in the browser.

    Serves the viewer and the scene, and nothing else of this machine, until
    Ctrl-C. A PLY is encoded first, in memory. The address of the page is
    printed on standard output.

    Examples:
      csplat view scene.csplat
      csplat view scene.ply --up z
      csplat view scene.csplat --no-browser --port 8000
    """
    out = Output(force, report, as_json, quiet)
    shared.check_range("--port", port, 0, _PORT_MAX)
    out.check(inputs=(source, cameras))
    wishes = page_parameters(cameras, shared.parse_overrides(up))
    with ExitStack() as stack:
        with out.bar() as progress:
            context = Context(progress=progress)
            scene = stack.enter_context(open_viewer_scene(source, preset=_PRESETS[0], context=context))
        wishes |= _scene_parameters(scene, cameras, out)
        server = open_server(scene, host=host, port=port, wishes=wishes)
        with server as opened:
            out.print_findings(scene.findings)
            out.remark(*_encoding_lines(scene, _PRESETS[0]), *describe_wait(scene.header))
            out.publish({"url": opened.url, "splats": scene.header.splat_count}, opened.url)
            sys.stdout.flush()
            out.remark("Ctrl-C ends this.")
            if not no_browser and not webbrowser.open(opened.url):
                note("no browser could be opened: open the address above in one")
            try:
                opened.serve_forever(poll_interval=0.1)
            except KeyboardInterrupt:
                out.remark("")  # ends the line with the terminal's ^C


def export_html(
    source: shared.SceneArgument,
    output: Annotated[
        str | None, typer.Argument(metavar="PAGE.html", help="The file to write, or -. Default: SCENE.html.")
    ] = None,
    up: shared.Up = None,
    cameras: _Cameras = None,
    force: shared.Force = False,
    report: shared.Report = None,
    as_json: shared.Json = False,
    quiet: shared.Quiet = False,
    _all: shared.HelpAll = False,
) -> None:
    """Write an HTML page that contains a scene and its viewer.

    The page needs no network, and opens in any browser with WebGL 2. A PLY is
    encoded first; a .csplat file is checked completely. For scenes in pages
    of your own, use `csplat export-element`.

    Examples:
      csplat export-html scene.csplat scene.html
      csplat export-html scene.csplat scene.html --cameras views.json
    """
    out, output = Output(force, report, as_json, quiet), default_output(output, source, ".html")
    wishes = page_parameters(cameras, shared.parse_overrides(up))
    out.check(output, inputs=(source, cameras))
    check_name(output, ".html", "export-html", source)
    with (
        out.bar() as progress,
        open_viewer_scene(source, preset=_PRESETS[1], context=Context(progress=progress)) as scene,
    ):
        data = scene.read()
        decode_scene(data)
        wishes |= _scene_parameters(scene, cameras, out)
        exported = viewer_page.export_page(data, scene.name, wishes)
        write_bytes(output, exported.page)
        out.print_findings(scene.findings)
        out.remark(*_encoding_lines(scene, _PRESETS[1]))
    out.remark(
        f"{output}: {format_bytes(len(exported.page))}, of which the scene {format_bytes(exported.scene_bytes)}"
        f" (its file and a third), page and decoder {format_bytes(exported.code_bytes)}",
        *describe_wait(scene.header, len(exported.page)),
    )
    sizes = {"scene_bytes": exported.scene_bytes, "code_bytes": exported.code_bytes}
    out.publish({"splats": scene.header.splat_count, "size_bytes": len(exported.page), **sizes})


def export_element(
    output: Annotated[str, typer.Argument(metavar="OUT.js", help="The file to write, or -.")],
    force: shared.Force = False,
    report: shared.Report = None,
    as_json: shared.Json = False,
    quiet: shared.Quiet = False,
    _all: shared.HelpAll = False,
) -> None:
    """Write the viewer as a script, for scenes in your own pages.

    A page that loads it has the element <csplat-view>:

      <script src="csplat-view.js" defer></script>
      <csplat-view src="scene.csplat" alt="A garden"></csplat-view>

    The script has no dependencies. The guide to embedding lists attributes
    and events, and what a page's Content-Security-Policy has to allow.

    Examples:
      csplat export-element csplat-view.js
    """
    out = Output(force, report, as_json, quiet)
    out.check(output)
    check_name(output, ".js", "export-element")
    script = viewer_page.export_element()
    write_bytes(output, script)
    out.remark(f"{output}: {format_bytes(len(script))}, {format_bytes(len(gzip.compress(script)))} as servers send it")
    out.publish({"size_bytes": len(script)})


def _scene_parameters(scene: ViewerScene, cameras: str | None, out: Output) -> dict[str, str]:
    """Return the page's parameters of a scene: cameras relative to its origin."""
    if cameras is None:
        return {}
    notes: list[str] = []
    wishes = page_parameters(cameras, report=notes, origin=scene.header.origin)
    out.remark(*notes)
    return wishes


def _encoding_lines(scene: ViewerScene, preset: str) -> list[str]:
    """Return a line on the encoding of a scene; none if it was a .csplat file."""
    if not scene.encoded_from:
        return []
    sizes = f"{format_bytes(scene.encoded_from)} -> {format_bytes(scene.size_bytes)}"
    return [f"encoded with the preset {preset}: {sizes}, {counted(scene.header.splat_count, 'splat')}"]

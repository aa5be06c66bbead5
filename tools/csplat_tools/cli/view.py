"""`csplat view` and `csplat export-html`."""

from __future__ import annotations

import sys
import webbrowser
from typing import Annotated

import typer

from csplat.decoder import decode_scene
from csplat.encoder import PRESETS
from csplat_tools.cli.console import guarded
from csplat_tools.files.console import format_bytes, note, progress_bar, say
from csplat_tools.files.streams import check_output, write_bytes
from csplat_tools.present.export import export_page
from csplat_tools.present.server import open_server
from csplat_tools.present.viewing import ViewScene, open_scene, view_wishes

__all__ = ["export_html", "view"]

_Scene = Annotated[str, typer.Argument(metavar="SCENE", help="A .csplat file or a PLY, or - for standard input.")]
_Camera = Annotated[
    str | None, typer.Option(metavar="FILE.json", help="Look from these cameras: a list of {K, viewmat, W, H, near}.")
]
_Axes = Annotated[
    str | None, typer.Option(metavar="RDF", help="Directions of +x, +y, +z, instead of the scene's: R/L, U/D, F/B.")
]


@guarded
def view(
    source: _Scene,
    preset: Annotated[
        str, typer.Option(metavar="|".join(PRESETS), help="How a PLY is encoded before it is shown.")
    ] = "fast",
    camera: _Camera = None,
    axes: _Axes = None,
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
      csplat view scene.ply --preset small --axes RFU
      csplat view scene.csplat --no-browser --port 8000
    """
    _check_preset(preset)
    wishes = view_wishes(camera, axes)
    with progress_bar() as progress, open_scene(source, preset=preset, progress=progress) as scene:
        server = open_server(scene, host=host, port=port, wishes=wishes)
        with server as opened:
            _describe(scene, preset)
            say(opened.url)
            sys.stdout.flush()
            note("Ctrl-C ends this.")
            if not no_browser and not webbrowser.open(opened.url):
                note("no browser could be opened: open the address above in one")
            try:
                opened.serve_forever(poll_interval=0.1)
            except KeyboardInterrupt:
                note("")  # behind the ^C of the terminal


@guarded
def export_html(
    source: _Scene,
    target: Annotated[str, typer.Argument(metavar="PAGE.html", help="The file to write, or - for standard output.")],
    preset: Annotated[str, typer.Option(metavar="|".join(PRESETS), help="How a PLY is encoded.")] = "balanced",
    camera: _Camera = None,
    axes: _Axes = None,
    force: Annotated[bool, typer.Option("--force", help="Replace an existing file.")] = False,
    quiet: Annotated[bool, typer.Option("--quiet", "-q", help="Say nothing unless something is wrong.")] = False,
) -> None:
    """Write one page that shows a scene, with everything inside.

    It opens from a disk, without a network, in any browser with WebGL 2,
    and can be sent to anybody. A PLY is encoded first; a .csplat file is
    checked to the last byte.

    Examples:
      csplat export-html scene.csplat scene.html
      csplat export-html scene.ply scene.html --preset small --force
      csplat export-html scene.csplat scene.html --camera views.json
    """
    _check_preset(preset)
    wishes = view_wishes(camera, axes)
    check_output(target, force=force, inputs=(source,))
    with progress_bar(quiet=quiet) as progress, open_scene(source, preset=preset, progress=progress) as scene:
        data = scene.read()
        decode_scene(data)
        exported = export_page(data, scene.name, wishes)
        write_bytes(target, exported.page)
        if quiet:
            return
        _describe(scene, preset)
    note(
        f"{target}: {format_bytes(len(exported.page))}, of which the scene {format_bytes(exported.scene_bytes)}"
        f" (its file and a third), page and decoder {format_bytes(exported.code_bytes)}"
    )


def _check_preset(preset: str) -> None:
    if preset not in PRESETS:
        raise typer.BadParameter(f"the preset is {preset!r}, wanted one of {', '.join(PRESETS)}")


def _describe(scene: ViewScene, preset: str) -> None:
    for finding in scene.findings:
        if finding.kind == "repair":
            note(str(finding))
    if scene.encoded_from:
        note(
            f"encoded with the preset {preset}: {format_bytes(scene.encoded_from)} ->"
            f" {format_bytes(scene.size_bytes)}, {scene.header.splat_count} splats"
        )

"""The commands together: what `csplat` runs."""

from __future__ import annotations

from typing import Annotated

import typer

import csplat
from csplat._spec import VERSION_MAJOR, VERSION_MINOR
from csplat_tools.commands.compare import compare
from csplat_tools.commands.conformance_encoder import conformance
from csplat_tools.commands.decode import decode
from csplat_tools.commands.encode import encode
from csplat_tools.commands.finetune import finetune
from csplat_tools.commands.info import info
from csplat_tools.commands.lint import lint
from csplat_tools.commands.render import render
from csplat_tools.commands.sensitivity import sensitivity
from csplat_tools.commands.simplify import simplify
from csplat_tools.commands.tradeoff import tradeoff
from csplat_tools.commands.train import train
from csplat_tools.commands.verify import verify
from csplat_tools.commands.view import export_html, view
from csplat_tools.console import say

__all__ = ["app"]

app = typer.Typer(
    name="csplat",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode="rich",
)


def _version(wanted: bool) -> None:
    if wanted:
        say(f"csplat {csplat.__version__}, format {VERSION_MAJOR}.{VERSION_MINOR}")
        raise typer.Exit


@app.callback()
def root(
    _version: Annotated[
        bool,
        typer.Option("--version", callback=_version, is_eager=True, help="Print the versions of program and format."),
    ] = False,
) -> None:
    """csplat: 3D Gaussian splats, compressed.

    Status 0: done. 1: refused or failed, with one line on standard error.
    2: the command line is wrong.

    Examples:
      csplat encode scene.ply scene.csplat
      csplat info scene.csplat
      csplat decode scene.csplat scene.ply
    """


app.command()(encode)
app.command()(decode)
app.command()(info)
app.command()(verify)
app.command()(lint)
app.command()(compare)
app.command()(tradeoff)
app.command()(render)
app.command()(simplify)
app.command()(sensitivity)
app.command()(train)
app.command()(finetune)
app.command()(view)
app.command("export-html")(export_html)
app.add_typer(conformance, name="conformance")

"""The `csplat` program with all its commands. A command is imported when it is used: all take half a second."""

from __future__ import annotations

import sys
from importlib import import_module
from typing import Annotated, Any

import typer
from typer.core import TyperGroup
from typer.main import get_group

from csplat_tools import VERSIONS
from csplat_tools.cli.command import UsageError, refuse_command_line, report_errors
from csplat_tools.console import print_data

#: Commands as `--help` lists them, and the modules of `csplat_tools.cli` that define them.
_MODULES = {
    "encode": "encode",
    "decode": "decode",
    "info": "info",
    "verify": "verify",
    "lint": "lint",
    "extract": "extract",
    "merge": "merge",
    "convert": "convert",
    "formats": "convert",
    "compare": "compare",
    "tradeoff": "tradeoff",
    "render": "render",
    "simplify": "simplify",
    "sensitivity": "sensitivity",
    "train": "train",
    "finetune": "finetune",
    "view": "view",
    "export-html": "view",
    "export-element": "view",
    "conformance": "conformance",
    "batch": "batch",
}


def command_function(name: str) -> Any:
    """Return what defines a command: a function, or a typer of several; `None` if there is no such command."""
    if name not in _MODULES:
        return None
    return getattr(import_module(f"csplat_tools.cli.{_MODULES[name]}"), name.replace("-", "_"))


class _Commands(TyperGroup):
    """The group of all commands, looked up in `_MODULES`. Owns those that were imported."""

    def list_commands(self, ctx: Any) -> list[str]:  # noqa: ARG002  # typer's
        return list(_MODULES)

    def get_command(self, ctx: Any, cmd_name: str) -> Any:  # noqa: ARG002  # typer's
        # An unknown name is compared with all commands, so that the error can suggest one.
        for name in {cmd_name} & _MODULES.keys() or _MODULES:
            if name not in self.commands:
                self.commands[name] = _imported(name)
        return self.commands.get(cmd_name)

    def main(self, *args: Any, **how: Any) -> Any:
        """Run a command line, and exit; typer would draw a box around the message of a wrong one."""
        if not how.get("standalone_mode", True):
            return super().main(*args, **how)
        try:
            sys.exit(report_errors(super().main)(*args, **{**how, "standalone_mode": False}))
        except UsageError as error:
            refuse_command_line(error)
        except typer.Exit as error:  # help could not be printed
            sys.exit(error.exit_code)


def _imported(name: str) -> Any:
    """Import the command of a name, or a group of commands."""
    found = command_function(name)
    alone = typer.Typer(rich_markup_mode="rich")
    if isinstance(found, typer.Typer):
        alone.add_typer(found, name=name)
    else:
        alone.command(name)(found)
    return get_group(alone).commands[name]


app = typer.Typer(
    name="csplat",
    cls=_Commands,
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    rich_markup_mode="rich",
)


def _version(wanted: bool) -> None:
    if wanted:
        print_data(VERSIONS)
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

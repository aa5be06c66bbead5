# SPDX-License-Identifier: Apache-2.0
"""The `csplat` program with all its commands. A command is imported when it is used: all take half a second."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from importlib import import_module
from typing import Annotated, Any

import typer
from typer.core import TyperGroup
from typer.main import get_group

from csplat_tools import VERSIONS
from csplat_tools.cli.command_output import TRUSTS_PATHS
from csplat_tools.cli.error_lines import UsageError, refuse_command_line, report_errors
from csplat_tools.console import print_data

#: Panels of `csplat --help`, with their commands and the modules of `csplat_tools.cli` that define them.
_PANELS = {
    "Compress": {"encode": "encode", "decode": "decode", "finetune": "finetune", "batch": "batch"},
    "Inspect": {
        "info": "info", "verify": "verify", "lint": "lint", "compare": "compare", "tradeoff": "tradeoff",
        "sensitivity": "sensitivity",
    },
    "Edit and convert": {
        "convert": "convert", "simplify": "simplify", "extract": "extract", "merge": "merge",
    },
    "Train": {"train": "train"},
    "View": {"view": "view", "render": "render", "export-html": "view", "export-element": "view"},
    "Test an implementation": {"conformance": "conformance"},
}  # fmt: skip
#: Commands that read data sets, and take `--trust-paths` anywhere among their words.
_OF_DATA_SETS = {"train", "finetune", "encode", "compare", "tradeoff", "sensitivity", "simplify", "render"}
_TRUST_PATHS = "--trust-paths"
_PANEL_OF = {name: panel for panel, commands in _PANELS.items() for name in commands}


class _Commands(TyperGroup):
    """The group of all commands, looked up in `_PANELS`. Owns the commands that were imported."""

    def list_commands(self, ctx: Any) -> list[str]:  # noqa: ARG002  # typer's
        return list(_PANEL_OF)

    def get_command(self, ctx: Any, cmd_name: str) -> Any:  # noqa: ARG002  # typer's
        # An unknown name is compared with all commands, so that the error can suggest one.
        for name in {cmd_name} & _PANEL_OF.keys() or _PANEL_OF:
            if name not in self.commands:
                self.commands[name] = _import_command(name)
        return self.commands.get(cmd_name)

    def parse_args(self, ctx: Any, args: list[str]) -> Any:
        """Move options of the program from the words of a command to the front, where typer expects them."""
        options, words = _split_program_options(args)
        return super().parse_args(ctx, [*options, *words])

    def invoke(self, ctx: Any) -> Any:
        with report_errors():
            return super().invoke(ctx)

    def main(self, *args: Any, **how: Any) -> Any:
        """Run a command line, and exit. Typer alone would draw a box around an error message."""
        if not how.get("standalone_mode", True):
            return super().main(*args, **how)
        try:
            with report_errors():  # help and versions are printed outside of `invoke`
                status = super().main(*args, **{**how, "standalone_mode": False})
        except UsageError as error:
            refuse_command_line(error)
        except typer.Exit as error:
            status = error.exit_code
        sys.exit(status)


def _split_program_options(words: Sequence[str]) -> tuple[list[str], list[str]]:
    """Return the options of the program among the words of a command, and the other words.

    Args:
        words: name of the command, its arguments and options.
    """
    if not words or words[0] not in _OF_DATA_SETS:
        return [], list(words)
    return [word for word in words if word == _TRUST_PATHS], [word for word in words if word != _TRUST_PATHS]


def _import_command(name: str) -> Any:
    """Import the command of a name, or a group of commands, as click's command."""
    panel = _PANEL_OF[name]
    definition = getattr(import_module(f"csplat_tools.cli.{_PANELS[panel][name]}"), name.replace("-", "_"))
    # An application of this command alone: other modules need not be imported to make it.
    alone = typer.Typer(rich_markup_mode="rich")
    if isinstance(definition, typer.Typer):
        alone.add_typer(definition, name=name, rich_help_panel=panel)
    else:
        alone.command(name, rich_help_panel=panel)(definition)
    command = get_group(alone).commands[name]
    _hide_flag_types(command)
    return command


def _hide_flag_types(command: Any) -> None:
    """Show no type next to flags in help: `<bool>` reads like a value that they take."""
    for subcommand in getattr(command, "commands", {}).values():
        _hide_flag_types(subcommand)
    for option in (*command.params, command.get_help_option(typer.Context(command))):
        if getattr(option, "is_flag", False):
            option.metavar = ""


app = typer.Typer(
    name="csplat",
    cls=_Commands,
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    rich_markup_mode="rich",
)


def _version(requested: bool) -> None:
    """Print the versions and exit, if requested."""
    if requested:
        print_data(VERSIONS)
        raise typer.Exit


@app.callback()
def root(
    trust_paths: Annotated[
        bool, typer.Option(_TRUST_PATHS, help="Let data sets read files outside of their folders.")
    ] = False,
    _version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Print the versions.")
    ] = False,
) -> None:
    """csplat: 3D Gaussian splats, compressed.

    Status 0: success. 1: an error, with one line on standard error.
    2: a wrong command line.

    Examples:
      csplat encode scene.ply scene.csplat
      csplat info scene.csplat
      csplat decode scene.csplat scene.ply
    """
    TRUSTS_PATHS.set(trust_paths)

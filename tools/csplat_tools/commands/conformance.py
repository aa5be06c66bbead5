"""`csplat conformance`."""

from __future__ import annotations

from typing import Annotated

import typer

from csplat_conformance.runner import Result, run_builtin, run_command
from csplat_tools.console import FAILED, guarded, note, say, say_json

__all__ = ["conformance"]

conformance = typer.Typer(no_args_is_help=True, rich_markup_mode="rich")


@conformance.callback()
def root() -> None:
    """Run the conformance suite: files, and what a decoder must make of them.

    Examples:
      csplat conformance decoder
      csplat conformance decoder --cmd 'my-decoder {input} {outdir}'
    """


@conformance.command()
@guarded
def decoder(
    command: Annotated[
        str | None, typer.Option("--cmd", metavar="COMMAND", help="Another decoder, with {input} and {outdir}.")
    ] = None,
    pattern: Annotated[
        str | None, typer.Option("--filter", metavar="PATTERN", help="Only vectors of this name.")
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Each vector's result, for programs.")] = False,
) -> None:
    """Run a decoder over the vectors: csplat's own, or the one that --cmd starts.

    Another decoder writes what it decodes into {outdir}, or exits with
    status 1 and the error code in a line of JSON; conformance/README.md says
    how.

    Examples:
      csplat conformance decoder --filter 'invalid/*'
      csplat conformance decoder --cmd 'node decode.mjs {input} {outdir}' --json
    """
    results = run_builtin(pattern) if command is None else run_command(command, pattern)
    failed = [result for result in results if not result.passed]
    if as_json:
        say_json(
            {
                "passed": len(results) - len(failed),
                "failed": len(failed),
                "vectors": [_as_json(result) for result in results],
            }
        )
    else:
        for result in results:
            if result.message:
                say(f"{'ok    ' if result.passed else 'FAILED'}  {result.name}: {result.message}")
        say(f"{len(results) - len(failed)} of {len(results)} vectors passed")
    if not results:
        note("error: no vector has such a name")
    if failed or not results:
        raise typer.Exit(FAILED)


def _as_json(result: Result) -> dict[str, object]:
    return {
        "name": result.name,
        "passed": result.passed,
        "message": result.message,
        "clauses": list(result.clauses),
    }

"""The command line, run in the process of the tests."""

from __future__ import annotations

from typer.testing import CliRunner

from csplat_tools.cli.app import app


def invoke(*words):
    """Run `csplat WORDS` and return the result, with what it printed and its exit code."""
    return CliRunner().invoke(app, [str(word) for word in words])

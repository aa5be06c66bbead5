"""Helpers of the tests of cli, which several files share."""

import sys

import numpy as np
import pytest
from typer.testing import CliRunner

from csplat import write_ply
from csplat_tools.__main__ import main
from csplat_tools.cli.app import app

PROGRAM = [sys.executable, "-m", "csplat_tools"]


def invoke(*words, **options):
    return CliRunner().invoke(app, [str(word) for word in words], **options)


def call(*words, **options):
    """Run a command that succeeds; return what it printed as data."""
    result = invoke(*words, **options)
    assert result.exit_code == 0, result.stderr
    return result.stdout


def refused(*words, status=1):
    """Run a command that is refused with one line; return the line."""
    result = invoke(*words)
    assert result.exit_code == status, (result.stdout, result.stderr, result.exception)
    assert result.exception is None or isinstance(result.exception, SystemExit)
    assert result.stderr.count("\n") == 1
    assert result.stderr.startswith("error: ")
    return result.stderr


def status_of(*words):
    """Run the program in this process; return its exit status."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "argv", ["csplat", *map(str, words)])
        try:
            main()
        except SystemExit as ended:
            return ended.code or 0
    return 0


def damaged_ply(path, make_model):
    model = make_model(50, 1)
    write_ply(path, model)
    data = bytearray(path.read_bytes())
    start = data.index(b"end_header\n") + 11
    data[start : start + 4] = np.float32(np.nan).tobytes()
    path.write_bytes(data + b"trailing")
    return path

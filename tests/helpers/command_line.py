# SPDX-License-Identifier: Apache-2.0
"""The command line in the process of the tests, batches without processes, and SIGINT in child processes."""

import signal
import sys
from concurrent.futures import Executor, Future
from dataclasses import replace
from importlib import import_module
from unittest.mock import Mock

import pytest
from typer.testing import CliRunner

from csplat.errors import InputError
from csplat_tools.__main__ import main
from csplat_tools.cli.app import app
from csplat_tools.views import find_view_set

PROGRAM = [sys.executable, "-m", "csplat_tools"]


def invoke(*words, **options):
    return CliRunner().invoke(app, [str(word) for word in words], **options)


def call(*words, status=0, **options):
    result = invoke(*words, **options)
    assert status == result.exit_code, (result.output, result.exception)
    return result


def printed(*words, **options):
    """Run a command that succeeds; return what it printed as data."""
    return call(*words, **options).stdout


def refused(*words, status=1):
    """Run a command that is refused with one line; return the line."""
    result = call(*words, status=status)
    assert result.exception is None or isinstance(result.exception, SystemExit)
    assert (1, True) == (result.stderr.count("\n"), result.stderr.startswith("error: ")), result.stderr
    return result.stderr


def hide_renderer(monkeypatch):
    """Let commands find no renderer; return the line with which they refuse."""
    message = "this installation of csplat has no compiled renderer"
    monkeypatch.setattr("csplat_tools.optional_packages.require_library", Mock(side_effect=InputError(message)))
    return f"error: {message} (E_INPUT)\n"


def status_of(*words):
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "argv", ["csplat", *map(str, words)])
        try:
            main()
        except SystemExit as ended:
            return ended.code or 0
    return 0


class _ChangedOptions:
    """A dataclass of options whose instances have other values of some fields."""

    def __init__(self, kind, values):
        self._kind, self._values = kind, values

    def __call__(self, *args, **given):
        return replace(self._kind(*args, **given), **self._values)

    def __getattr__(self, name):
        return getattr(self._kind, name)


def change_options(patch, place, **values):
    """Let commands use other values of fields of options, at a place like `csplat_tools.cli.train.TrainOptions`."""
    module, _, name = place.rpartition(".")
    patch.setattr(place, _ChangedOptions(getattr(import_module(module), name), values))


def change_views(patch, count, size):
    """Let commands place few, small virtual views if they place any."""

    def find(source, **how):
        return find_view_set(source, **{**how, "count": 0 if how["count"] == 0 else count, "size": size})

    patch.setattr("csplat_tools.cli.shared_options.find_view_set", find)


class InThisProcess(Executor):
    """An executor of `csplat batch` without a process."""

    def __init__(self, *_):
        pass

    def submit(self, function, *args):
        future, before = Future(), signal.getsignal(signal.SIGINT)
        try:
            future.set_result(function(*args))
        except Exception as error:  # noqa: BLE001  # as in a process
            future.set_exception(error)
        signal.signal(signal.SIGINT, before)  # the program has its own handler
        return future

# SPDX-License-Identifier: Apache-2.0
"""`csplat`: the program, and entry point of `python -m csplat_tools`."""

from __future__ import annotations

import os
import signal
import sys
from contextlib import suppress
from types import FrameType

from csplat_tools import VERSIONS

_OF_SIGNAL = 128  # exit status of a command that a signal interrupts: this and its number, the convention of shells


def main() -> None:
    """Run the program.

    The commands are imported here, so that an interrupt while they load is handled, too. Printing the versions does
    not load them.
    """
    if sys.argv[1:] == ["--version"]:
        with suppress(OSError):  # the code below reports a full disk
            os.write(sys.stdout.fileno(), f"{VERSIONS}\n".encode())
            return
    _open_closed_streams()
    interrupts: list[int] = []

    def interrupt(number: int, _frame: FrameType | None) -> None:
        interrupts.append(number)
        raise KeyboardInterrupt

    for number in (signal.SIGINT, signal.SIGTERM):  # both keep what a search or a training has so far
        # A shell's background ignores SIGINT, and a batch ends its workers in its own way.
        if signal.getsignal(number) in (signal.SIG_DFL, signal.default_int_handler):
            signal.signal(number, interrupt)
    try:
        from csplat_tools.cli.app import app

        _silence_libraries()
        app(prog_name="csplat")
    except Exception:
        if not interrupts:  # modules that are being imported turn an interrupt into other errors
            raise
    except KeyboardInterrupt:
        pass
    except SystemExit as end:
        if interrupts and end.code == _OF_SIGNAL + signal.SIGINT:
            sys.exit(_OF_SIGNAL + interrupts[0])
        raise
    with suppress(OSError):
        os.write(sys.stderr.fileno(), b"interrupted\n")
    sys.exit(_OF_SIGNAL + (interrupts or [signal.SIGINT])[0])


def _open_closed_streams() -> None:
    """Open standard streams that the caller has closed, so that reading or writing one is an error of its own.

    Otherwise the next file that is opened would get its number, and what is printed.
    """
    for number, name, mode, flags in ((0, "stdin", "r", os.O_WRONLY), (1, "stdout", "w", os.O_RDONLY)):
        if getattr(sys, name) is None:
            os.open(os.devnull, flags)  # gets the lowest free number
            setattr(sys, name, open(number, mode, closefd=False))  # noqa: SIM115  # stays open
    if sys.stderr is None:
        sys.stderr = open(os.devnull, "w", encoding="utf-8")  # noqa: PTH123, SIM115  # stays open


def _silence_libraries() -> None:
    """Keep log messages of libraries off standard error, and print warnings without places in source code."""
    import logging
    import warnings

    from csplat_tools.console import note

    def show(message: Warning | str, *_: object) -> None:
        note(f"warning: {message}")

    logging.getLogger().addHandler(logging.NullHandler())  # without it, unhandled messages would be printed
    warnings.filterwarnings("ignore", module=r"(?!csplat)")
    warnings.showwarning = show  # type: ignore[assignment]  # the category and the place are not printed


if __name__ == "__main__":
    main()

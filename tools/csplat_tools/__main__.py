"""`csplat`: entry point of the installed script, and of `python -m csplat_tools`."""

from __future__ import annotations

import os
import sys
from contextlib import suppress

from csplat_tools import VERSIONS

_INTERRUPTED = 130  # 128 + SIGINT, as shells have it


def main() -> None:
    """Run the program.

    The commands are imported here, not above: an interrupt while they load ends as quietly as a later one. Printing
    the versions requires none of them.
    """
    if sys.argv[1:] == ["--version"]:
        with suppress(OSError):  # a full disk is reported below
            os.write(sys.stdout.fileno(), f"{VERSIONS}\n".encode())  # data, before there is a console
            return
    try:
        from csplat_tools.cli.app import app

        app(prog_name="csplat")
    except KeyboardInterrupt:
        sys.stderr.write("interrupted\n")
        sys.exit(_INTERRUPTED)


if __name__ == "__main__":
    main()

"""`csplat`: entry point of the installed script, and of `python -m csplat_tools`."""

from __future__ import annotations

import os
import sys
from contextlib import suppress

from csplat_tools import VERSIONS

_INTERRUPTED = 130  # exit status: 128 + SIGINT, the convention of shells


def main() -> None:
    """Run the program.

    The commands are imported here, so that an interrupt while they load is handled, too. Printing the versions does
    not load them.
    """
    if sys.argv[1:] == ["--version"]:
        with suppress(OSError):  # the code below reports a full disk
            os.write(sys.stdout.fileno(), f"{VERSIONS}\n".encode())
            return
    try:
        from csplat_tools.cli.app import app

        app(prog_name="csplat")
    except KeyboardInterrupt:
        sys.stderr.write("interrupted\n")
        sys.exit(_INTERRUPTED)


if __name__ == "__main__":
    main()

# SPDX-License-Identifier: Apache-2.0
"""Entry point of the installed script `csplat`: ends silently at an interrupt while the program loads.

A module of its own, since importing any part of a package imports the package first, which takes 50 ms.
"""

# The module `signal` takes 10 ms; its functions are those of this one, which typeshed lacks.
from _signal import SIG_DFL, SIGINT, default_int_handler, getsignal, signal  # type: ignore[import-not-found]


def main() -> None:
    """Load the program, and run it."""
    if getsignal(SIGINT) is default_int_handler:  # not ignored, as in a shell's background
        signal(SIGINT, SIG_DFL)
    from csplat_tools.__main__ import main as run

    run()

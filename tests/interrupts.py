"""Programs that tests interrupt."""

import signal


def heed_interrupts():
    """Make a child process heed SIGINT, also when the tests run in the background of a shell, which ignores it."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)

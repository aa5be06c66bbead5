"""Memory that scenes share which are worked on at the same time."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager

from csplat.errors import LimitError
from csplat_tools.batches.looking import RENDERER_BYTES

__all__ = ["Budget"]


class Budget:
    """Lets a scene begin when there is memory for it. Owns how much is left.

    Args:
        allowed: bytes that were allowed; `None`: nobody said.
        free: bytes that are used where nobody said; `None`: no limit.
        has_option: the command keeps to less where it is told to, by `--memory`.
    """

    def __init__(self, allowed: int | None, free: int | None = None, *, has_option: bool = False) -> None:
        self._allowed, self._has_option = allowed, has_option
        self._total = allowed if allowed is not None else free
        self._left = self._total or 0
        self._changed = threading.Condition()
        self._stopped = False

    @contextmanager
    def gate(self, need: int) -> Iterator[tuple[str, ...]]:
        """Wait until there is so much; give it back at the end.

        Args:
            need: bytes.

        Yields:
            Options for the command.

        Raises:
            LimitError: it is more than is allowed for all.
        """
        if self._total is None:
            yield ()
            return
        too_much = self._allowed is not None and need > self._allowed
        if too_much and not self._has_option:
            raise LimitError("--memory", need, self._allowed)
        taken = min(need, self._total)
        with self._changed:
            self._changed.wait_for(lambda: self._stopped or taken <= self._left)
            self._left -= taken
        try:
            yield ("--memory", str(max(1, self._total - RENDERER_BYTES))) if too_much else ()
        finally:
            with self._changed:
                self._left += taken
                self._changed.notify_all()

    def stop(self) -> None:
        """Let go of all that wait: nothing is begun any more."""
        with self._changed:
            self._stopped = True
            self._changed.notify_all()

"""The memory budget that scenes processed at the same time share."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager

from csplat.errors import LimitError
from csplat_tools.batches.looking import RENDERER_BYTES


class Budget:
    """A gate that lets a scene begin when there is memory for it. Owns the number of bytes left.

    Args:
        allowed: bytes that the user allowed; `None`: not specified.
        free: bytes to use if `allowed` is not specified; `None`: no limit.
        has_option: the command has `--memory`, and can keep to less than it would need.
    """

    def __init__(self, allowed: int | None, free: int | None = None, *, has_option: bool = False) -> None:
        self._allowed, self._has_option = allowed, has_option
        self._total = allowed if allowed is not None else free
        self._left = self._total or 0
        self._changed = threading.Condition()
        self._stopped = False

    @contextmanager
    def gate(self, need: int) -> Iterator[tuple[str, ...]]:
        """Wait for memory, reserve it, and release it at the end.

        Args:
            need: bytes to reserve.

        Yields:
            Options for the command.

        Raises:
            LimitError: more is needed than the user allowed for all scenes together.
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
        """Release all threads that wait: no scene is to begin any more."""
        with self._changed:
            self._stopped = True
            self._changed.notify_all()

# SPDX-License-Identifier: CC0-1.0
"""Record the executed edges between lines of Python files, to guide the fuzzer and for its report."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from types import CodeType, FrameType
from typing import Any

_Trace = Callable[[FrameType, str, Any], Any]


class Edges:
    """A collector of edges: pairs of lines of one function that were executed in succession.

    It uses `sys.settrace`, which makes decoding a small file three times slower.

    Args:
        paths: Python files, or folders of them.
    """

    def __init__(self, paths: Sequence[Path]) -> None:
        self.files = [file for path in paths for file in (sorted(path.rglob("*.py")) if path.is_dir() else [path])]
        self.seen: set[tuple[CodeType, int, int]] = set()
        self._names = {str(file) for file in self.files}
        self._traced: dict[CodeType, bool] = {}

    def watch(self, run: Callable[[], Any]) -> tuple[Any, int]:
        """Call a function; return its result and the number of new edges."""
        before = len(self.seen)
        outer = sys.gettrace()
        sys.settrace(self._trace_call)
        try:
            result = run()
        finally:
            sys.settrace(outer)
        return result, len(self.seen) - before

    def lines(self) -> set[tuple[str, int]]:
        """Return the executed lines: file and number."""
        return {(code.co_filename, line) for code, _, line in self.seen}

    def all_lines(self) -> set[tuple[str, int]]:
        """Return the lines of all functions of the files."""
        found = set()
        for file in self.files:
            whole = compile(file.read_bytes(), str(file), "exec")
            for code in _functions(whole):
                # The first line is that of `def`, which runs at import.
                lines = {line for _, _, line in code.co_lines() if line is not None and line != code.co_firstlineno}
                found |= {(str(file), line) for line in lines}
        return found

    def _trace_call(self, frame: FrameType, _event: str, _value: Any) -> _Trace | None:
        code = frame.f_code
        traced = self._traced.get(code)
        if traced is None:
            traced = self._traced[code] = code.co_filename in self._names
        if not traced:
            return None
        seen, last = self.seen, 0

        def step(frame: FrameType, event: str, _value: Any) -> Any:
            nonlocal last
            if event == "line":
                line = frame.f_lineno
                seen.add((code, last, line))
                last = line
            return step

        return step


def _functions(code: CodeType) -> Iterator[CodeType]:
    """Yield the code of all functions at any depth, without class bodies, which run at import."""
    for constant in code.co_consts:
        if isinstance(constant, CodeType):
            is_class = not constant.co_flags & 0x2  # CO_NEWLOCALS, which is set for functions
            if not is_class:
                yield constant
            yield from _functions(constant)

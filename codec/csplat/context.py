# SPDX-License-Identifier: Apache-2.0
"""How work runs: threads, worker processes, memory, seed and progress, which travel together."""

from __future__ import annotations

import operator
import os
import re
from dataclasses import dataclass

from csplat.errors import InputError
from csplat.sizes import Size, parse_size
from csplat.system import core_count, default_memory_bytes
from csplat.types import Progress, null_progress

_SCHEDULER = re.compile(r"[a-z]+://[^/\s]+:\d+")
_LEAST = {"threads": 1, "workers": 1, "seed": 0}  # smallest value of each number; NumPy takes no negative seeds


@dataclass(frozen=True)
class Context:
    """How work runs. Results depend on the seed alone.

    Attributes:
        threads: number of threads; `None`: one per core.
        workers: number of processes that encode parts of a scene on disk, or the address of a Dask scheduler whose
            workers do, and access `folder` under the same path. A scene of several parts is then encoded on disk even
            if it fits in memory. `None`: as many as `threads`, for scenes that do not fit.
        memory: limit of the memory of all processes together, bytes or text such as "4GB", which is converted; `None`:
            half of the free memory.
        folder: working folder of an encoding on disk; `None`: the path of the file with the suffix `.work`.
        resume: continue an interrupted encoding if its working folder exists.
        seed: seed of random numbers.
        progress: called with the name of the stage and the fraction of it done, 0 to 1.

    Raises:
        InputError: a number is out of range.
    """

    threads: int | None = None
    workers: int | str | None = None
    memory: Size | None = None
    folder: str | os.PathLike[str] | None = None
    resume: bool = False
    seed: int = 0
    progress: Progress = null_progress

    def __post_init__(self) -> None:
        for name, least in _LEAST.items():
            value = getattr(self, name)
            if (value is None and name != "seed") or (name == "workers" and isinstance(value, str)):
                continue
            if isinstance(value, bool) or not hasattr(value, "__index__") or value < least:
                raise InputError(f"{name} is {value!r}, expected an integer of at least {least}")
            object.__setattr__(self, name, operator.index(value))  # json cannot write NumPy's numbers
        if isinstance(self.workers, str) and not _SCHEDULER.fullmatch(self.workers):
            raise InputError(f"the scheduler is {self.workers!r}, expected an address such as tcp://host:8786")
        if self.memory is not None:
            object.__setattr__(self, "memory", parse_size(self.memory))

    @property
    def thread_count(self) -> int:
        """`threads`, or the number of cores."""
        return self.threads or core_count()

    @property
    def is_bounded(self) -> bool:
        """True if memory, workers or resume is set; they apply only to encodings that may take place on disk."""
        return self.memory is not None or self.workers is not None or self.resume

    @property
    def memory_limit(self) -> int:
        """`memory`, or half of the free memory, bytes."""
        return default_memory_bytes() if self.memory is None else parse_size(self.memory)


#: All cores, half of the free memory, seed 0, no progress.
DEFAULT_CONTEXT = Context()

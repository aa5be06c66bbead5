# SPDX-License-Identifier: Apache-2.0
"""The protocol between the runner and the subjects of measurement."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from csplat.errors import InputError
from csplat_bench.suites import Case

#: Measures a case once; returns fields of its row.
Measure = Callable[[Case], Mapping[str, Any]]


class AbsentError(InputError):
    """A scene, program or package is not available here: the case is left out."""


@dataclass(frozen=True)
class Setup:
    """Places and programs that subjects use.

    Attributes:
        work: folder for made scenes, trainings and files.
        peers: folder for npm packages and programs of others.
        data: folder of scenes, cameras and data sets.
        csplat: the words that run csplat's command line.
        chromium: the browser.
        lpips: file of LPIPS weights, `auto` for the usual places; `None`: not measured.
        options: the suite's.
    """

    work: Path
    peers: Path
    data: Path
    csplat: Sequence[str]
    chromium: str = "chromium"
    lpips: str | None = None
    options: Mapping[str, Any] = field(default_factory=dict)


#: A subject of measurement: prepares a scene for some cases, yields the function that measures one of them. Its values
#: may include `splats`, on which the number of warm-ups depends.
Subject = Callable[[Setup, str, Sequence[Case]], AbstractContextManager[Measure]]

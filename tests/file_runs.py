"""Runs of `csplat train` that write files, on the photographs of trained.py. Needs the extra [render]."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest
from trained import run_here, write_photographs

from csplat_tools.training import training_run
from csplat_tools.training.training_run import tuning_after


class FileRuns:
    """Runs of `csplat train` on the photographs, each to a file, with little training and tuning.

    The first, of all splats, leaves checkpoints of training and tuning, a report and a page.
    """

    WORDS = ("--max-splats", 40, "--sh-degree", 0, "--iterations", 30, "--set", "log_every=10")
    TUNED = 30  # steps, usually 1,000

    def __init__(self, folder: Path) -> None:
        self.folder, self.data = folder, folder / "photographs"
        self.checkpoint, self.page = folder / "run.npz", folder / "page.html"
        write_photographs(self.data)
        self.report, self.messages = self.made(
            "a.csplat", "--keep", 1, "--checkpoint", self.checkpoint, "--page", self.page
        )

    def made(self, name: str, *more: object) -> tuple[dict, str]:
        """Make a file or a PLY; return the report and the messages."""
        report = self.folder / f"{name}.json"
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(
                training_run, "tuning_after", lambda **given: replace(tuning_after(**given), iterations=self.TUNED)
            )
            messages = run_here("train", self.data, "-o", self.folder / name, *self.WORDS, "--report", report, *more)
        return json.loads(report.read_text()), messages

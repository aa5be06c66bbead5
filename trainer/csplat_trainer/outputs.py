"""Files that a run reads and writes besides its data set, and its result."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from csplat.model import SplatModel


@dataclass(frozen=True)
class Outputs:
    """Files that a run writes on its way.

    Attributes:
        checkpoint: file for checkpoints (each replaces the last), or `None`.
        checkpoint_every: steps from one to the next; 0: at the end alone.
        previews: folder for early renders (photograph and render next to each other), or `None`.
        preview_every: steps from one to the next; 0: at powers of two from 100 on, and the end.
        resume: checkpoint to go on from, or `None`.
        lpips_weights: file of the weights of LPIPS-Alex; `None`: they are looked for in the usual places.
    """

    checkpoint: str | Path | None = None
    checkpoint_every: int = 0
    previews: str | Path | None = None
    preview_every: int = 0
    resume: str | Path | None = None
    lpips_weights: str | Path | None = None

    def preview_due(self, iteration: int, iterations: int) -> bool:
        """Return True if a preview is due after a step."""
        if self.previews is None:
            return False
        if iteration == iterations:
            return True
        if self.preview_every:
            return iteration % self.preview_every == 0
        return iteration % 100 == 0 and (iteration // 100).bit_count() == 1


@dataclass(frozen=True)
class TrainResult:
    """Result of a run.

    Attributes:
        model: the scene.
        log: JSON-compatible: options, entries on the way, the loss of each step, figures, times.
        metrics: scores on the test images, see `evaluate`; `None` if there are none.
    """

    model: SplatModel
    log: dict[str, Any]
    metrics: dict[str, Any] | None

"""Translate a target into the goal of a search."""

from __future__ import annotations

import math

from csplat.model import SplatModel
from csplat_render.metrics import PSNR_CAP
from csplat_render.scorer import Scorer
from csplat_tools.optimise.solving import Goal
from csplat_tools.optimise.target import Target


def goal_of(target: Target, source: SplatModel, photographs: Scorer | None) -> Goal:
    """Return the goal of the search for a target.

    Args:
        target: a PSNR, a size or a loss.
        source: the scene.
        photographs: the scorer by validation photographs, against which a loss is measured.
    """
    if target.max_loss is None or photographs is None:
        return Goal(target.psnr, target.size_bytes, max_error=target.max_error)
    reached = photographs.psnr(source)
    # The source's error against photographs is far larger than the loss: a file's own error is a small part of the sum.
    slope = 1.0 - 10.0 ** (-target.max_loss / 10.0)
    return Goal(min(loss_as_psnr(target.max_loss, reached), PSNR_CAP), None, reached - target.max_loss, slope)


def loss_as_psnr(loss: float, photo_psnr: float) -> float:
    """Return the PSNR against the source's renders at which the PSNR against photographs falls by a loss.

    The source has an error of its own against photographs; the error that a file adds is taken as independent of it,
    so that the two squared errors add up.

    Args:
        loss: dB, above 0.
        photo_psnr: PSNR of the source against photographs, dB.
    """
    return photo_psnr - 10.0 * math.log10(10.0 ** (loss / 10.0) - 1.0)

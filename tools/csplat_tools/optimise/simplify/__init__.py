"""Simplify a scene: prune splats, refit the others, and leave out SH bands."""

from __future__ import annotations

from csplat_tools.optimise.simplify.options import SimplifyOptions
from csplat_tools.optimise.simplify.simplify import Simplified, simplify

__all__ = [
    "Simplified",
    "SimplifyOptions",
    "simplify",
]

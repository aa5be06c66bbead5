"""Model only what a scene requires: fewer splats, their colours fitted anew, fewer SH bands."""

from __future__ import annotations

from csplat_tools.simplify.core import Simplified, simplify
from csplat_tools.simplify.options import METHODS, SimplifyOptions

__all__ = [
    "METHODS",
    "Simplified",
    "SimplifyOptions",
    "simplify",
]

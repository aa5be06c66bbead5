"""Reference inputs for encoders: PLY files made by recipe, and the sources that they stand for.

`ordinary/` an encoder must take; `nasty/` it may refuse, with status 1 and a line with the reason, but must not get
wrong; `broken/` it must refuse. Splats keep a distance of `apart` from one another, so that a decoded splat has one
source alone.
"""

from __future__ import annotations

from csplat_conformance.encoders.inputs.broken import broken
from csplat_conformance.encoders.inputs.making import PSNR_MIN, Input
from csplat_conformance.encoders.inputs.nasty import nasty
from csplat_conformance.encoders.inputs.nasty_values import nasty_values
from csplat_conformance.encoders.inputs.ordinary import ordinary
from csplat_conformance.encoders.inputs.pictures import pictures

__all__ = ["PSNR_MIN", "Input", "all_inputs"]


def all_inputs() -> list[Input]:
    """Return every input, in the order of a run."""
    return [*ordinary(), *pictures(), *nasty_values(), *nasty(), *broken()]

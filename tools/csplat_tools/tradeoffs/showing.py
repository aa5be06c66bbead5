"""The worst view of a file, as three small pictures."""

from __future__ import annotations

import base64
import io

import numpy as np
from numpy.typing import NDArray

from csplat_render.metrics import psnr
from csplat_tools.files.pictures import panels
from csplat_tools.tradeoffs.points import Shown

__all__ = ["AMPLIFICATION", "WorstView", "as_data_uri"]

F32 = NDArray[np.float32]
U8 = NDArray[np.uint8]

#: Of the differences that are shown.
AMPLIFICATION = 10.0

_SIDE = 640  # pixels; larger pictures are made smaller, or a report of photographs would be tens of megabytes
_WEBP = {"quality": 82, "method": 4}


class WorstView:
    """Is shown one view after the other, and keeps the one with the largest error."""

    def __init__(self) -> None:
        self._worst: Shown | None = None

    def look(self, number: int, source: F32, decoded: F32) -> None:
        """Look at a view: its number, and [H, W, 3] in 0..1 of source and decoded file."""
        score = float(psnr(source, decoded))
        if self._worst is not None and score >= self._worst.psnr:
            return
        a, b, difference = np.split(panels(source, decoded, AMPLIFICATION), 3, axis=1)
        self._worst = Shown(number, score, a, b, difference)

    def shown(self) -> Shown | None:
        """The worst view, reduced to a size for a page; `None` where none was looked at."""
        worst = self._worst
        if worst is None:
            return None
        return Shown(
            worst.view, worst.psnr, _reduced(worst.source), _reduced(worst.decoded), _reduced(worst.difference)
        )


def as_data_uri(pixels: U8) -> str:
    """A picture as text that an `img` element takes: WebP, or PNG where pillow was built without it."""
    from PIL import Image, features

    kind, options = ("WEBP", _WEBP) if features.check("webp") else ("PNG", {})
    buffer = io.BytesIO()
    Image.fromarray(np.ascontiguousarray(pixels)).save(buffer, kind, **options)
    return f"data:image/{kind.lower()};base64,{base64.b64encode(buffer.getvalue()).decode()}"


def _reduced(pixels: U8) -> U8:
    from PIL import Image

    height, width = pixels.shape[:2]
    factor = _SIDE / max(width, height)
    if factor >= 1.0:
        return np.ascontiguousarray(pixels)
    size = (max(1, round(width * factor)), max(1, round(height * factor)))
    return np.asarray(Image.fromarray(np.ascontiguousarray(pixels)).resize(size, Image.Resampling.LANCZOS))

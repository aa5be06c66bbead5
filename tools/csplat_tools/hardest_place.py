"""Find the place where a file differs most from its source, and show it: in its view, and as a piece of both."""

from __future__ import annotations

import base64
import io
from collections.abc import Mapping
from dataclasses import dataclass
from html import escape

import numpy as np

from csplat.types import F32, F64, U8
from csplat_render.metrics import psnr, squared_error
from csplat_tools.render_files import side_by_side, to_uint8

#: Factor by which the differences that are shown are amplified.
AMPLIFICATION = 10.0

#: Description of a row of pictures, for the page.
IMAGES_NOTE = (
    "The piece of a view with the largest error: where it is, the source, the file, and their difference times"
    f" {AMPLIFICATION:g}. The pictures are compressed for this page; no number is measured on them."
)

_SHARE = 4  # width and height of a view divided by those of the piece
_SIDE = 480  # largest side of an image, pixels: a page with larger photographs would have tens of megabytes
_WEBP = {"quality": 94, "method": 4}


@dataclass(frozen=True, eq=False)
class ImagePiece:
    """A piece of a view.

    Attributes:
        view: number of the view.
        psnr: PSNR of the piece, dB.
        where: [h, w, 3] uint8, the whole view of the source, with a frame around the piece.
        source, decoded, difference: [h, w, 3] uint8, the piece; the difference is amplified.
    """

    view: int
    psnr: float
    where: U8
    source: U8
    decoded: U8
    difference: U8


class HardestPlaceSearch:
    """A search through views, one after the other, for the piece with the largest error."""

    def __init__(self) -> None:
        self._error = -1.0
        self._place: tuple[int, slice, slice, F32, F32] | None = None

    def examine(self, number: int, source: F32, decoded: F32) -> None:
        """Examine a view, given by its number and the renders of source and decoded file, [H, W, 3] in 0..1."""
        errors: F64 = np.asarray(squared_error(source, decoded).sum(axis=2), np.float64)
        height, width = (max(1, side // _SHARE) for side in errors.shape)
        sums = _window_sums(errors, height, width) / (height * width)
        top, left = np.unravel_index(int(np.argmax(sums)), sums.shape)
        if sums[top, left] > self._error:
            self._error = float(sums[top, left])
            rows, columns = slice(int(top), int(top) + height), slice(int(left), int(left) + width)
            self._place = (number, rows, columns, source, decoded)

    def found(self) -> ImagePiece | None:
        """Return the piece, with images reduced to a size for a page; `None` if no view was examined."""
        if self._place is None:
            return None
        number, rows, columns, source, decoded = self._place
        a, b = source[rows, columns], decoded[rows, columns]
        pieces = [_reduced(one) for one in np.split(side_by_side(a, b, AMPLIFICATION), 3, axis=1)]
        return ImagePiece(number, float(psnr(a, b)), _framed(source, rows, columns), *pieces)


def piece_images(place: ImagePiece, name: str) -> str:
    """Return HTML that shows the images of a place side by side.

    Args:
        place: the place.
        name: name of the file.
    """
    words = {
        f"view {place.view}": place.where,
        "source": place.source,
        f"file, here {place.psnr:.1f} dB": place.decoded,
        f"difference × {AMPLIFICATION:g}": place.difference,
    }
    return image_row(words, name)


def image_row(images: Mapping[str, U8], name: str) -> str:
    """Return HTML that shows images side by side, reduced to a size for a page.

    Args:
        images: [h, w, 3] uint8, by caption.
        name: name of their subject, for the alternative text.
    """
    figures = ""
    for word, pixels in images.items():
        small = _reduced(pixels)
        figures += (
            f'<figure><img src="{_data_uri(small)}" width="{small.shape[1]}" height="{small.shape[0]}"'
            f' alt="{escape(f"{name}: {word}")}"><figcaption>{escape(word)}</figcaption></figure>'
        )
    return f'<div class="pictures">{figures}</div>'


def _window_sums(values: F64, height: int, width: int) -> F64:
    """Return the sums over all windows of a size: [H − height + 1, W − width + 1]."""
    total = np.zeros((values.shape[0] + 1, values.shape[1] + 1))
    np.cumsum(np.cumsum(values, axis=0), axis=1, out=total[1:, 1:])
    sums: F64 = total[height:, width:] - total[:-height, width:] - total[height:, :-width] + total[:-height, :-width]
    return sums


def _framed(image: F32, rows: slice, columns: slice) -> U8:
    """Return the whole view, reduced, with a frame that is visible on any background."""
    shown = _reduced(to_uint8(image)).copy()
    factor = shown.shape[0] / image.shape[0]
    top, bottom, left, right = (round(factor * at) for at in (rows.start, rows.stop, columns.start, columns.stop))
    for inset, value in ((0, 0), (1, 255), (2, 0)):
        edge = np.zeros(shown.shape[:2], bool)
        edge[top + inset : bottom - inset, left + inset : right - inset] = True
        edge[top + inset + 1 : bottom - inset - 1, left + inset + 1 : right - inset - 1] = False
        shown[edge] = value
    return shown


def _data_uri(pixels: U8) -> str:
    """Return an image as a data URI for an `img` element: WebP, or PNG if pillow was built without it."""
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

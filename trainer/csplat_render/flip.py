"""FLIP (Andersson et al. 2020), by NVIDIA's `flip-evaluator` where it is installed.

The package comes with `pip install csplat[flip]`; nothing else of csplat needs it.
"""

from __future__ import annotations

import importlib
from typing import Any

import numpy as np
from numpy.typing import NDArray

from csplat.errors import InputError


def flip(reference: NDArray[Any], image: NDArray[Any]) -> float:
    """Mean difference that a viewer notices who flips between two pictures, 0 (none) to 1.

    LDR-FLIP at the package's default distance: 0.7 m from a 0.7 m wide screen of 3840 pixels, 67
    pixels per degree. The values are taken for sRGB.

    Args:
        reference: [H, W, 3] floating, clipped to [0, 1].
        image: the same.

    Raises:
        InputError: the pictures differ in shape, or the package is not installed.
    """
    if reference.shape != image.shape or reference.ndim != 3 or reference.shape[2] != 3:
        raise InputError(
            f"FLIP of pictures of shapes {list(reference.shape)} and {list(image.shape)}, wanted [H, W, 3] twice"
        )
    try:
        package: Any = importlib.import_module("flip_evaluator")
    except ImportError as error:
        raise InputError("FLIP needs flip-evaluator: pip install 'csplat[flip]'") from error
    a, b = (np.ascontiguousarray(np.clip(picture, 0.0, 1.0), np.float32) for picture in (reference, image))
    _, mean, _ = package.evaluate(a, b, "LDR", applyMagma=False)
    return float(mean)

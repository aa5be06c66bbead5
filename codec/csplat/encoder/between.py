"""`Between`: what others do to a scene before it is encoded, and while it is."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from csplat.model import SplatModel

__all__ = ["Between"]

F32 = NDArray[np.float32]


@dataclass(frozen=True)
class Between:
    """A scene that stands for a larger one, or whose colours are chosen when its geometry is quantised.

    The encoder has no renderer. It shows the scene as far as it is quantised, and takes the colours that it is given;
    the file then says that they were fitted anew.

    Attributes:
        source_count: splats of the scene that it was made from.
        source_index: [N] int64, which of them each splat is.
        colours: is given the scene with means, rotations, scales and opacities as a decoder will see them, and the
            colours that it came with; returns sh0 [N, 3] and shN [N, K, 3] float32, in the same order.
        said: what the file's options are to say about it, JSON-compatible.
        key: under which name.
        refitted: whether the colours are others than those of the source.
        adjusted: opacities, rotations or scales are, too.
        figures: is given the file; what it returns stands in the options beside `said`: how good renders of it are.
    """

    source_count: int
    source_index: NDArray[np.int64]
    colours: Callable[[SplatModel], tuple[F32, F32]] = lambda seen: (seen.sh0, seen.shN)
    said: Mapping[str, Any] = field(default_factory=dict)
    key: str = "simplified"
    refitted: bool = True
    adjusted: bool = False
    figures: Callable[[bytes], Mapping[str, Any]] | None = None

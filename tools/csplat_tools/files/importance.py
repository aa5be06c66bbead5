"""How much splats matter, as a file says it: weights (.npy), or what `csplat sensitivity` wrote (.npz)."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

from numpy.typing import NDArray

from csplat.encoder import Importance
from csplat.model import SplatModel
from csplat_render.virtual import scene_frame
from csplat_tools.files.streams import read_array
from csplat_trainer.sensitivity_file import StoredSensitivity, read_sensitivity

__all__ = ["read_importance", "weights_of"]

_ZIP = b"PK"  # what a .npz begins with


def read_importance(path: str, model: SplatModel) -> NDArray[Any] | Importance | StoredSensitivity:
    """Read weights from a .npy file, or sensitivities from a .npz file.

    Raises:
        InputError: it is neither, or is about another scene.
        OSError: it cannot be read.
    """
    with Path(path).open("rb") as stream:
        begin = stream.read(len(_ZIP))
    return read_sensitivity(path, model) if begin == _ZIP else read_array(path)


def weights_of(found: NDArray[Any] | Importance | StoredSensitivity, model: SplatModel) -> NDArray[Any] | Importance:
    """What the encoder wants of what a file says.

    Virtual views do not stand where the cameras inside surroundings do: of what those show, they show too little to
    say how coarse it may be. So they grade no splats there.

    Args:
        found: by `read_importance`.
        model: the scene that it is about.
    """
    if not isinstance(found, StoredSensitivity):
        return found
    weights = found.importance()
    if found.source == "virtual" and scene_frame(model).kind == "surrounding":
        return replace(weights, curvatures=None)
    return weights

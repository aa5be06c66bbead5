"""Scenes of either kind, a PLY or a .csplat file, for commands that look at splats."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from csplat.decoder import SceneHeader, StatedErrors, decode_scene
from csplat.model import SplatModel
from csplat.ply import read_ply
from csplat_tools.files.streams import is_csplat, local_path, mapped_csplat

__all__ = ["LoadedModel", "load_model", "without_bands"]


@dataclass(frozen=True, eq=False)
class LoadedModel:
    """A scene, and what the file says of it.

    Attributes:
        model: the splats.
        size_bytes: of the file.
        header: of a .csplat file; `None` for a PLY.
        stated_errors: of a .csplat file that states them.
    """

    model: SplatModel
    size_bytes: int
    header: SceneHeader | None = None
    stated_errors: StatedErrors | None = None

    def as_json(self) -> dict[str, Any]:
        """Return size and counts as JSON-compatible values."""
        count = len(self.model)
        return {
            "size_bytes": self.size_bytes,
            "splats": count,
            "sh_degree": self.model.sh_degree,
            "bytes_per_splat": self.size_bytes / count if count else None,
        }


def load_model(path: str) -> LoadedModel:
    """Read a scene of either kind; which one its first bytes tell.

    Args:
        path: the file, or `-`.

    Raises:
        CsplatError: it is not valid.
        OSError: it cannot be read.
    """
    with local_path(path) as local:
        size_bytes = local.stat().st_size
        if not is_csplat(local):
            return LoadedModel(read_ply(local), size_bytes)
        with mapped_csplat(str(local)) as data:
            scene = decode_scene(data)
    return LoadedModel(scene.model, size_bytes, scene.header, scene.stated_errors)


def without_bands(model: SplatModel, sh_degree: int) -> SplatModel:
    """Leave out the SH bands above a degree."""
    if sh_degree >= model.sh_degree:
        return model
    return replace(model, shN=np.ascontiguousarray(model.shN[:, : (sh_degree + 1) ** 2 - 1]))

"""Scenes in any format, for commands that look at splats."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from csplat import formats
from csplat import scene as scenes
from csplat.decoder import Limits, SceneHeader, StatedErrors, decode_scene
from csplat.errors import LimitError
from csplat.inputs import File
from csplat.lint import Finding
from csplat.memory import available_bytes
from csplat.model import SplatModel
from csplat.scene import Scene
from csplat_tools.files.console import Progress
from csplat_tools.files.streams import is_csplat, local_path, mapped_csplat

__all__ = [
    "FOLDER_NAMES", "LoadedModel", "SceneLike", "load_model", "ply_splat_bytes", "size_of", "watched", "without_bands",
    "without_extra",
]  # fmt: skip

#: Files that stand for all that lies beside them: SOG as a folder, and with levels.
FOLDER_NAMES = ("meta.json", "lod-meta.json")


@dataclass(frozen=True, eq=False)
class LoadedModel:
    """A scene, and what the file says of it.

    Attributes:
        model: the splats.
        size_bytes: of the file; of a model that was in no file, that of its plain PLY.
        header: of a .csplat file; `None` for a PLY.
        stated_errors: of a .csplat file that states them.
        name: of the file.
        findings: what lint noticed in a PLY that was read to be encoded.
    """

    model: SplatModel
    size_bytes: int
    header: SceneHeader | None = None
    stated_errors: StatedErrors | None = None
    name: str = "scene"
    findings: tuple[Finding, ...] = ()

    def _repr_html_(self) -> str | None:
        """What a notebook shows of it: see `SplatModel`."""
        return self.model._repr_html_()  # a protocol of notebooks, and public there

    def as_json(self) -> dict[str, Any]:
        """Return size and counts as JSON-compatible values."""
        count = len(self.model)
        return {
            "size_bytes": self.size_bytes,
            "splats": count,
            "sh_degree": self.model.sh_degree,
            "bytes_per_splat": self.size_bytes / count if count else None,
        }


#: A scene, as functions of this package take it: a model, or a file in any format.
SceneLike = SplatModel | LoadedModel | File


def load_model(scene: SceneLike) -> LoadedModel:
    """Read a scene in any format (`csplat formats`); which one its content tells.

    Args:
        scene: the file: a path, an open binary file, or bytes; as a path `-` is standard input. What is a model, or
            loaded already, stays as it is.

    Examples:
        >>> import csplat_tools
        >>> scene = csplat_tools.load_model("scene.csplat")
        >>> scene.model, len(scene.header.tiles), scene.size_bytes < 20_000
        (SplatModel(1000 splats, sh_degree=3), 1, True)

    Raises:
        CsplatError: it is not valid, or no file.
        LimitError: it does not fit the memory that is free.
        OSError: it cannot be read.
    """
    if isinstance(scene, LoadedModel):
        return scene
    if isinstance(scene, SplatModel):
        return LoadedModel(scene, len(scene) * ply_splat_bytes(scene.sh_degree))
    with local_path(scene) as local:
        size_bytes, name, free = size_of(local), local.name, available_bytes()
        if not is_csplat(local):
            if size_bytes > free:
                raise LimitError("memory for all splats at once", size_bytes, free)
            return LoadedModel(formats.read(local), size_bytes, name=name)
        with mapped_csplat(str(local)) as data:
            decoded = decode_scene(data, limits=Limits(bytes=min(Limits().bytes, free)))
    return LoadedModel(decoded.model, size_bytes, decoded.header, decoded.stated_errors, name)


def size_of(path: Path) -> int:
    """Bytes of a file, or of all files of a folder."""
    if path.name.lower() in FOLDER_NAMES:
        path = path.parent
    if not path.is_dir():
        return path.stat().st_size
    return sum(one.stat().st_size for one in path.rglob("*") if one.is_file())


def ply_splat_bytes(sh_degree: int) -> int:
    """What a splat takes in a PLY of the INRIA trainer, whose columns are floats: 248 bytes at SH degree 3.

    Position and normal, opacity, scale and rotation are 14; the rest are colours.
    """
    return 4 * (14 + 3 * (sh_degree + 1) ** 2)


def without_bands(model: SplatModel, sh_degree: int) -> SplatModel:
    """Leave out the SH bands above a degree."""
    if sh_degree >= model.sh_degree:
        return model
    return replace(model, shN=np.ascontiguousarray(model.shN[:, : (sh_degree + 1) ** 2 - 1]))


def watched(scene: Scene, stage: str, progress: Progress | None) -> Scene:
    """The same scene; who goes through its blocks, to write them, tells how far it has come."""
    if progress is None:
        return scene
    told = scenes.watched(scene, stage, progress)

    def blocks() -> Iterator[SplatModel]:
        yield from told.blocks()
        progress("writing", 0.0)  # or going through it once more, which begins anew

    return replace(scene, blocks=blocks)


def without_extra(scene: Scene) -> Scene:
    """Leave out the columns that splats do not have."""
    if not scene.facts.extra:
        return scene
    return replace(
        scene,
        facts=replace(scene.facts, extra={}),
        blocks=lambda: (replace(model, extra={}) for model in scene.blocks()),
    )

"""The scene that is looked at, and from where."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass

from csplat.errors import InputError
from csplat.inputs import File
from csplat.lint import Finding
from csplat.model import SplatModel
from csplat_render.lpips import load_lpips
from csplat_render.metrics import Distance
from csplat_tools.files.convert import read_source
from csplat_tools.files.scenes import LoadedModel, load_model
from csplat_tools.views import Colour, DataOptions, ViewSet, find_view_set

__all__ = ["Setting", "read_setting"]


@dataclass(frozen=True, eq=False)
class Setting:
    """A scene, and by what its files are decided on and judged.

    Attributes:
        path: of the PLY, as it was given; `scene.ply` where none was.
        name: of the file. source: its splats. source_bytes: its size.
        findings: what lint noticed in it.
        views: all files are judged by the same ones, which none of them was chosen by.
        cameras, data, background: by which these were found, see `find_view_set`.
        distance: LPIPS, if wanted.
    """

    path: str
    name: str
    source: SplatModel
    source_bytes: int
    findings: Sequence[Finding]
    views: ViewSet
    cameras: str | None = None
    data: DataOptions | None = None
    background: Colour | None = None
    distance: Distance | None = None


def read_setting(
    scene: SplatModel | LoadedModel | File,
    *,
    cameras: str | None = None,
    data: DataOptions | None = None,
    background: Colour | None = None,
    lpips: str | None = None,
) -> Setting:
    """Read scene and views.

    Args:
        scene: a model, or a PLY; as a path `-` is standard input.
        cameras, data, background: as for `find_view_set`.
        lpips: a file of LPIPS weights, or `auto`; it is not computed if left out.

    Raises:
        CsplatError: a file is not valid, no splat is left of it, or no view judges.
        OSError: it cannot be read.
    """
    distance = None if lpips is None else load_lpips(None if lpips == "auto" else lpips)
    source = load_model(scene) if isinstance(scene, (SplatModel, LoadedModel)) else read_source(scene)
    path = os.fspath(scene) if isinstance(scene, (str, os.PathLike)) else "scene.ply"
    if not len(source.model):
        raise InputError("a scene without splats has nothing to trade")
    views = find_view_set(source.model, cameras=cameras, data=data, background=background)
    if not views.judges:
        raise InputError(f"{views.name} has no photographs that were held out")
    return Setting(
        path, source.name, source.model, source.size_bytes, source.findings, views, cameras, data, background, distance
    )

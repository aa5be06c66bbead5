"""The scene of a sweep, and its views."""

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


@dataclass(frozen=True, eq=False)
class Setting:
    """A scene, and the views by which its files are chosen and scored.

    Attributes:
        path: path of the PLY, as it was given; `scene.ply` if none was.
        name: name of the file.
        source: its splats.
        source_bytes: its size.
        findings: findings of lint in it.
        views: the views; all files are scored on the same test views, by which none was chosen.
        cameras, data, background: arguments of `find_view_set` that gave the views.
        distance: computes LPIPS; `None`: LPIPS is not computed.
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
        scene: a model, or a file; the path `-` is standard input.
        cameras, data, background: as for `find_view_set`.
        lpips: a file of LPIPS weights, or `auto`; LPIPS is not computed if left out.

    Raises:
        CsplatError: a file is not valid, the scene has no splats, or there are no test views.
        OSError: a file cannot be read.
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

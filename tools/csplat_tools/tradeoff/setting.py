"""The scene that is looked at, and from where."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from csplat.errors import InputError
from csplat.lint import Finding
from csplat.model import SplatModel
from csplat.ply import read_ply
from csplat_render.lpips import load_lpips
from csplat_render.metrics import Distance
from csplat_tools.files.streams import STANDARD_STREAM, ply_path
from csplat_tools.views import DataOptions, ViewSet, find_view_set

__all__ = ["Setting", "read_setting"]


@dataclass(frozen=True, eq=False)
class Setting:
    """A scene, and by what its files are decided on and judged.

    Attributes:
        name: of the PLY. source: its splats. source_bytes: its size.
        findings: what lint noticed in it.
        views: all files are judged by the same ones, which none of them was chosen by.
        distance: LPIPS, if wanted.
    """

    name: str
    source: SplatModel
    source_bytes: int
    findings: Sequence[Finding]
    views: ViewSet
    distance: Distance | None = None


def read_setting(
    path: str, *, cameras: str | None = None, data: DataOptions | None = None, lpips: str | None = None
) -> Setting:
    """Read scene and views.

    Args:
        path: a PLY, or `-`.
        cameras, data: as for `find_view_set`.
        lpips: a file of LPIPS weights, or `auto`; it is not computed if left out.

    Raises:
        CsplatError: a file is not valid, no splat is left of it, or no view judges.
        OSError: it cannot be read.
    """
    distance = None if lpips is None else load_lpips(None if lpips == "auto" else lpips)
    findings: list[Finding] = []
    with ply_path(path) as local:
        source = read_ply(local, report=findings)
        source_bytes = local.stat().st_size
    if not len(source):
        raise InputError("a scene without splats has nothing to trade")
    views = find_view_set(source, cameras=cameras, data=data)
    if not views.judges:
        raise InputError(f"{views.name} has no photographs that were held out")
    name = "standard input" if path == STANDARD_STREAM else Path(path).name
    return Setting(name, source, source_bytes, findings, views, distance)

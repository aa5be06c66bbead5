"""PLY of INRIA's layout and its relatives: what the project's own tools and most trainers write."""

from __future__ import annotations

from csplat.formats.format import ARRAYS, Format
from csplat.ply import open_ply, write_scene_ply

FORMAT = Format(
    name="ply",
    open=open_ply,
    open_bands=open_ply,
    write=write_scene_ply,
    splat_bytes=(68.0, 104.0, 164.0, 248.0),
    exact=frozenset(ARRAYS),
    carries=frozenset({"antialiased", "origin", "coordinate_system", "unit_metres", "flat", "extra", "metadata"}),
)

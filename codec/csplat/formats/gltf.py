"""glTF 2.0 with the extension KHR_gaussian_splatting (ratified in 2026): .glb, and .gltf with its buffers.

glTF says that y is up, that z is where a model looks, and that its right hand is at -x: LUF. What it has no place for
stands in `asset.extras.csplat`, in the lines that a PLY has as comments. An origin is the translation of the node.
"""

from __future__ import annotations

from csplat.formats.format import Format
from csplat.formats.gltf_read import AXES, open_gltf
from csplat.formats.gltf_write import write_gltf

FORMAT = Format(
    name="gltf",
    open=open_gltf,
    open_bands=open_gltf,
    write=write_gltf,
    axes=AXES,
    exact=frozenset({"means", "quats", "opacities", "sh0", "shN"}),
    splat_bytes=(60.0, 96.0, 156.0, 240.0),
    carries=frozenset({"antialiased", "origin", "coordinate_system", "unit_metres", "flat", "metadata"}),
)

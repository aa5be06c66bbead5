# SPDX-License-Identifier: Apache-2.0
"""glTF 2.0 with the extension KHR_gaussian_splatting (ratified in 2026): .glb, and .gltf with its buffers.

Splats are plain accessors, or a .csplat file, by the extension that `spec/gltf.md` specifies. Both are read alike.

glTF specifies that y is up, that models face +z, and that +x points to their left: LUF. Metadata for which glTF has no
member is stored in `asset.extras.csplat` as the comment lines of a PLY. The origin is the translation of the node.
"""

from __future__ import annotations

from dataclasses import replace

from csplat.formats.format import Format, ValueRange
from csplat.formats.gltf.gltf_document import AXES
from csplat.formats.gltf.gltf_reader import open_gltf
from csplat.formats.gltf.gltf_writer import keeps_file, write_compressed_gltf, write_gltf
from csplat.ply.columns import HUGE_LOG, LOG_OF_0, LOG_OF_LARGEST
from csplat.ply.comments import unwritten_entries

FORMAT = Format(
    name="gltf",
    open=open_gltf,
    open_bands=open_gltf,
    write=write_gltf,
    axes=AXES,
    ranges={"scales": ValueRange(LOG_OF_0, LOG_OF_LARGEST)},
    exact=frozenset({"means", "quats", "opacities", "sh0", "shN"}),
    splat_bytes=(60.0, 96.0, 156.0, 240.0),
    carries=frozenset(
        {"antialiased", "origin", "coordinate_system", "unit_metres", "flat", "colour_space", "metadata"}
    ),
    unwritten=unwritten_entries,
)
COMPRESSED_FORMAT = replace(
    FORMAT,
    name="gltf-csplat",
    write=write_compressed_gltf,
    keeps=keeps_file,
    ranges={"scales": ValueRange(-HUGE_LOG, HUGE_LOG)},
    exact=frozenset(),
    splat_bytes=(7.0, 8.0, 9.0, 10.0),
    carries=FORMAT.carries | {"extra", "cameras"},
    unwritten=lambda _metadata: (),
)

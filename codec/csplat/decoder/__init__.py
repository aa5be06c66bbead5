"""Decode `.csplat` files into arrays, checking every clause of the specification.

Written from `spec/format.md` alone: it shares only the registry's constants, the errors and `SplatModel` with the
encoder, and the classes of `csplat.packed` with the renderer.

| function | returns |
|---|---|
| `decode` | a `SplatModel` of the whole file, or of some tiles and SH bands |
| `decode_scene` | the same, with header, options, declared error bounds and the checks made |
| `iter_tiles` | the splats tile by tile, in bounded memory |
| `iter_packed` | the integers tile by tile, with codebooks as tables, for a renderer |
| `open_tiles` | metadata, and the tiles as models, which can be decoded repeatedly |
| `read_header` | header and index; the beginning of a file suffices |
| `decode_integers` | the integer arrays of spec 9.2, for conformance |
| `read_metadata`, `read_cameras`, `read_options`, `read_declared_bounds` | one chunk |

Modules, each of which builds on the previous ones: `container` (file header, frames of chunks), `index`, `entropy`
(streams), `blocks` (integers of one attribute), `reconstruct` (integers to values), `codebooks`, `tiles`, `packed`,
`tree`, `limits`, `metadata`, `decode_api`.
"""

from csplat.decoder.container import ExtraColumn, SceneHeader, Tile
from csplat.decoder.decode_api import (
    DecodedScene,
    DecodedTile,
    TileReader,
    decode,
    decode_integers,
    decode_scene,
    iter_packed,
    iter_tiles,
    open_tiles,
)
from csplat.decoder.index import read_header
from csplat.decoder.limits import Limits
from csplat.decoder.metadata import (
    DeclaredBound,
    DeclaredBounds,
    read_cameras,
    read_declared_bounds,
    read_metadata,
    read_options,
)
from csplat.decoder.tree import Node

__all__ = [
    "DeclaredBound",
    "DeclaredBounds",
    "DecodedScene",
    "DecodedTile",
    "ExtraColumn",
    "Limits",
    "Node",
    "SceneHeader",
    "Tile",
    "TileReader",
    "decode",
    "decode_integers",
    "decode_scene",
    "iter_packed",
    "iter_tiles",
    "open_tiles",
    "read_cameras",
    "read_declared_bounds",
    "read_header",
    "read_metadata",
    "read_options",
]

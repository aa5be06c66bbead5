# SPDX-License-Identifier: Apache-2.0
"""Decode `.csplat` files into arrays, checking every clause of the specification.

The package was written from `spec/format.md` alone. It shares only the registry's constants, the errors and
`SplatModel` with the encoder, and the classes of `csplat.packed` with the renderer.

| function | returns |
|---|---|
| `decode` | a `SplatModel` of the whole file, or of some tiles and SH bands |
| `decode_scene` | the same, with header, options, declared error bounds and the checks made |
| `iter_tiles` | the splats tile by tile, in bounded memory |
| `iter_packed` | the integers tile by tile, with codebooks as tables, for a renderer |
| `check_chunks` | header and index, after checking the CRC of every chunk |
| `read_header` | header and index; the beginning of a file suffices |
| `decode_integers` | the integer arrays of spec 9.2, for conformance |
| `read_metadata` | the metadata of the scene |
| `read_options`, `read_declared_bounds` | one chunk |

Modules, each of which builds on the previous ones: `container` (file header, frames of chunks), `limits`,
`resource_level`, `index`, `entropy` (streams), `blocks` (integers of an attribute), `reconstruct` (integers to values),
`codebooks`, `tiles`, `packed`, `tree`, `budget`, `metadata`, `decode_api`.
"""

from csplat.decoder.container import ExtraColumn, SceneHeader, Tile
from csplat.decoder.decode_api import (
    DecodedScene,
    DecodedTile,
    check_chunks,
    decode,
    decode_integers,
    decode_scene,
    iter_packed,
    iter_tiles,
)
from csplat.decoder.index import read_header
from csplat.decoder.limits import Limits
from csplat.decoder.metadata import (
    DeclaredBound,
    DeclaredBounds,
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
    "check_chunks",
    "decode",
    "decode_integers",
    "decode_scene",
    "iter_packed",
    "iter_tiles",
    "read_declared_bounds",
    "read_header",
    "read_metadata",
    "read_options",
]

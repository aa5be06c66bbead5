"""The decoder: a `.csplat` file, checked to the last clause, into arrays.

Written from `spec/format.md` alone; it shares with the encoder nothing but the registry's
constants, the errors and `SplatModel`.

| function | gives |
|---|---|
| `decode` | a `SplatModel`, of the whole file or of chosen tiles and SH bands |
| `decode_scene` | the same, with the header, the options, the stated errors and the checks made |
| `iter_tiles` | tile by tile, in bounded memory |
| `open_tiles` | what is known before the first tile, and the tiles as models, as often as wanted |
| `read_header` | what header and index say; a file's beginning suffices |
| `decode_integers` | the integer arrays of spec 9.2, for conformance |
| `read_metadata`, `read_cameras`, `read_options`, `read_stated_errors` | one chunk |
"""

from csplat.decoder.chunks import read_cameras, read_metadata, read_options, read_stated_errors
from csplat.decoder.header import ExtraColumn, SceneHeader, Tile
from csplat.decoder.index import read_header
from csplat.decoder.limits import Limits
from csplat.decoder.scene import Scene, decode, decode_integers, decode_scene
from csplat.decoder.stated import StatedError, StatedErrors
from csplat.decoder.tilewise import DecodedTile, Opened, iter_tiles, open_tiles

__all__ = [
    "DecodedTile",
    "ExtraColumn",
    "Limits",
    "Opened",
    "Scene",
    "SceneHeader",
    "StatedError",
    "StatedErrors",
    "Tile",
    "decode",
    "decode_integers",
    "decode_scene",
    "iter_tiles",
    "open_tiles",
    "read_cameras",
    "read_header",
    "read_metadata",
    "read_options",
    "read_stated_errors",
]

"""How much of a file a viewer fetches that leaves out SH layers."""

from __future__ import annotations

from csplat import _spec
from csplat.decoder import SceneHeader

__all__ = ["fetched_bytes"]


def fetched_bytes(header: SceneHeader, sh_degree: int) -> int:
    """Bytes that a decoder needs for a scene with the SH bands up to a degree.

    Args:
        header: of the file; its index says where everything lies.
        sh_degree: the highest band that is wanted; 0 for what the first picture takes.

    Returns:
        Header, index, the layers of all tiles up to this band and the codebooks that they need. What says something
        about the whole file, stated errors and options, is not fetched, nor are extra columns.
    """
    wanted = {id_ for id_ in _spec.LAYER_NAMES if id_ <= sh_degree}  # layer d holds band d, layer 0 everything before
    tiles = sum(layer.size for tile in header.tiles for id_, layer in tile.layers.items() if id_ in wanted)
    codebooks = sum(
        chunk.size for chunk in header.directory if chunk.type == _spec.CHUNK_CODEBOOK and chunk.layer in wanted
    )
    return _spec.HEADER_SIZE + header.index_size + tiles + codebooks

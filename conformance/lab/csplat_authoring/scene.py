# SPDX-License-Identifier: CC0-1.0
"""The declared scene of a vector: every number of the file, and the coding of each stream.

Values that a vector may set incorrectly are never derived. `builder` writes a scene as bytes, and `reference` computes
the arrays that a decoder must return.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import chain

from csplat import _spec

#: n rows of C integers.
Rows = Sequence[Sequence[int]]

_LAYER_0 = tuple(a for a, layer in _spec.ATTRIBUTE_LAYER.items() if layer == _spec.LAYER_GEOMETRY)


@dataclass(frozen=True)
class Stream:
    """The coding of a stream.

    Attributes:
        width: bytes of an element.
        transforms: registry values, as in the file.
        coder: `stored`, `deflate_stored`, `deflate_fixed` or `deflate_dynamic`.
        packed: bytes between transforms and coder, instead of the correct ones.
        coded: bytes after the coder, instead of the correct ones.
    """

    width: int = 1
    transforms: tuple[int, ...] = ()
    coder: str = "stored"
    packed: bytes | None = None
    coded: bytes | None = None


#: One byte per element, stored; two bytes per element, stored.
PLAIN, PAIRS = Stream(), Stream(2)


@dataclass(frozen=True)
class Block:
    """One attribute in one layer of one tile.

    Attributes:
        coding: registry value.
        rows: [n, C] integers: q for LEVELS, MORTON and AXIS, lattice integers for OFFSET and SIGNED, bits for RAW;
            for SPARSE, only those of the splats in the mask.
        stream_coding: coding of the stream of rows.
        exponent: exponent, for OFFSET, SIGNED and SPARSE.
        offsets: one offset per column, for OFFSET; one offset, for the summand of SHAPE.
        mask: a bit per splat, for SPARSE.
        mask_coding: coding of the mask's stream.
        bits: bits per axis, for MORTON.
        codebook: codebook id, for CODEBOOK.
        indices: [n] indices; empty in a block that is not the first of its codebook.
        index_coding: coding of the indices' stream.
        summands: [n] common summands, for scales of the kind SHAPE.
        escape: the escape block.
        tail: bytes after the block.
    """

    coding: int
    rows: Rows = ()
    stream_coding: Stream = PLAIN
    exponent: int = 0
    offsets: tuple[int, ...] = ()
    mask: tuple[int, ...] = ()
    mask_coding: Stream = PLAIN
    bits: int = 0
    codebook: int = 0
    indices: tuple[int, ...] = ()
    index_coding: Stream = PLAIN
    summands: tuple[int, ...] = ()
    escape: Block | None = None
    tail: bytes = b""


@dataclass(frozen=True)
class Tile:
    """A tile. Attributes without a block are omitted. The extent is computed from the rows of the means.

    Attributes:
        blocks: blocks by attribute (registry value).
        corner: lattice integers.
        exponent: exponent of the means.
        extras: blocks coded RAW, one per extra column; `unknown` may replace one.
        codebook_ids: ids of codebooks; None: those that the blocks use.
        level: level of detail.
        order: attributes of layer 0 in the order of their blocks.
        tails: bytes after the last block, by layer.
        unknown: layers that this version does not read, with their payloads.
    """

    blocks: dict[int, Block]
    corner: tuple[int, int, int] = (0, 0, 0)
    exponent: int = 0
    extras: tuple[Block, ...] = ()
    codebook_ids: tuple[int, ...] | None = None
    level: int = 0
    order: tuple[int, ...] = _LAYER_0
    tails: tuple[tuple[int, bytes], ...] = ()
    unknown: tuple[tuple[int, bytes], ...] = ()

    @property
    def splat_count(self) -> int:
        """Number of splats: that of the rows of the means."""
        return len(self.blocks[_spec.ATTRIBUTE_MEANS].rows)

    @property
    def layers(self) -> list[int]:
        """Layers of the tile, ascending."""
        layers = {_spec.ATTRIBUTE_LAYER[attribute] for attribute in self.blocks}
        extras = {_spec.LAYER_EXTRA + k for k in range(len(self.extras))}
        return sorted(layers | extras | {layer for layer, _ in self.unknown})


@dataclass(frozen=True)
class Attribute:
    """An attribute record (spec 4.3.1)."""

    mapping: int
    step: float = 0.0
    levels: int = 0
    chroma_shift: int = 0


@dataclass(frozen=True)
class Codebook:
    """A codebook.

    Attributes:
        id: id of the record.
        kind: registry value.
        entries: entries, rows [size, C], by layer.
        bands: first and last SH band; zeros for other kinds.
        stream_coding: coding of the entries in all chunks.
        tail: bytes after the stream of each chunk.
    """

    id: int
    kind: int
    entries: Mapping[int, Rows]
    bands: tuple[int, int] = (0, 0)
    stream_coding: Stream = PAIRS
    tail: bytes = b""

    @property
    def layers(self) -> list[int]:
        """Layers of its CODB chunks."""
        return list(self.entries)


@dataclass(frozen=True)
class Extra:
    """An extra column's record."""

    name: str
    dtype: int
    components: int = 1
    semantic: str = ""
    coding: int = _spec.CODING_RAW

    @property
    def is_known(self) -> bool:
        """True unless the column is left out of the result (ANC-3)."""
        return self.dtype in _spec.EXTRA_DTYPE_NAMES and self.coding == _spec.CODING_RAW

    @property
    def splat_bytes(self) -> int:
        """Bytes of a splat in the result."""
        return self.components * _spec.EXTRA_DTYPE_BYTES[self.dtype] if self.is_known else 0


@dataclass(frozen=True)
class DeclaredErrors:
    """The payload of a SERR chunk; records are (measure, max, rms)."""

    source_count: int
    pruned_count: int = 0
    source_sh_degree: int = 0
    flags: int = 0
    records: tuple[tuple[int, float, float], ...] = ()


@dataclass(frozen=True)
class Chunk:
    """A chunk of the whole file: a JSON text, declared errors or any payload."""

    type: bytes
    text: bytes | None = None
    stream_coding: Stream = PLAIN
    errors: DeclaredErrors | None = None
    payload: bytes = b""
    flags: int | None = None
    id: int = 0
    layer: int = 0
    tail: bytes = b""


@dataclass(frozen=True)
class Node:
    """A node record of the TREE chunk."""

    parent: int
    tile_count: int = 1
    error: float = 0.0


@dataclass(frozen=True)
class Scene:
    """The contents of a file.

    Attributes:
        attributes: records by attribute (registry value), in the order of the file.
        nodes: nodes of the TREE chunk, which exists if there are any.
        order: names of the chunks in their order; None: the order that the spec recommends.
        directory: names in the order of the directory; None: the order of the chunks.
        gap: bytes between the index and the first chunk.
        trailing: bytes after the end.
        tails: tails (IDX-9) by kind of record, or `head`.
        resource_level: registry value; None: the lowest that the contents allow.
    """

    attributes: dict[int, Attribute]
    tiles: tuple[Tile, ...] = ()
    codebooks: tuple[Codebook, ...] = ()
    extras: tuple[Extra, ...] = ()
    chunks: tuple[Chunk, ...] = ()
    nodes: tuple[Node, ...] = ()
    sh_degree: int = 0
    scene_flags: int = 0
    axes: tuple[int, int, int] = (0, 0, 0)
    unit_metres: float = 0.0
    origin: tuple[float, float, float] = (0.0, 0.0, 0.0)
    order: tuple[str, ...] | None = None
    directory: tuple[str, ...] | None = None
    gap: bytes = b""
    trailing: bytes = b""
    tails: tuple[tuple[str, bytes], ...] = ()
    resource_level: int | None = None
    kernel: int = _spec.KERNEL_ELLIPSE
    projection: int = _spec.PROJECTION_PERSPECTIVE
    antialiasing: int = _spec.ANTIALIASING_NONE
    colour_space: int = _spec.COLOUR_SPACE_SRGB_REC709_DISPLAY

    @property
    def finest(self) -> Scene:
        """The same scene with the tiles of level 0 alone."""
        return replace(self, tiles=tuple(tile for tile in self.tiles if tile.level == 0), nodes=())


def attribute_named(name: str) -> int:
    """Return the registry value of an attribute."""
    return next(value for value, known in _spec.ATTRIBUTE_NAMES.items() if known == name)


def band_of(attribute: int) -> int:
    """Return the SH band of an attribute; 0 for attributes of layer 0."""
    return _spec.ATTRIBUTE_LAYER[attribute]


def transpose(rows: Rows) -> list[int]:
    """Return the values of column 0, then those of column 1, and so on."""
    return [*chain.from_iterable(zip(*rows, strict=True))]

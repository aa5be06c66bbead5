"""Contents of header and index, as plain values."""

from __future__ import annotations

import math
from dataclasses import dataclass

from csplat import _spec


@dataclass(frozen=True, slots=True)
class ExtraColumn:
    """One further column per splat.

    Attributes:
        name: as in `SplatModel.extra`.
        dtype: NumPy name of its type, `<u2`; `None` if this version does not know it: then it is not returned.
    """

    name: str
    dtype: str | None


@dataclass(frozen=True, slots=True)
class Tile:
    """A tile record with its layer records and table ids (spec 4.3.5).

    Attributes:
        index: place of the record in the index.
        offset: byte of the file where the record begins.
        start: place of the tile's first splat in a whole decode.
        splat_count: its splats.
        exponent: its lattice of means has step × 2^exponent.
        corner: lattice integers of the box's smallest corner.
        extent: largest minus smallest lattice integer.
        max_scale: largest of its scales (natural logarithm).
        layers: layer records by layer id, those of layers that this version does not know too.
        tables: ids of the codebooks it may use.
    """

    index: int
    offset: int
    start: int
    splat_count: int
    exponent: int
    corner: tuple[int, int, int]
    extent: tuple[int, int, int]
    max_scale: float
    layers: dict[int, _spec.LayerRecord]
    tables: tuple[int, ...]

    def corners(self, step: float) -> tuple[list[float], list[float]]:
        """Corners of the box around its centres (spec 4.3.5), scene units.

        Args:
            step: step in the record of the means.
        """
        scaled = math.ldexp(step, self.exponent)
        low = [corner * scaled for corner in self.corner]
        return low, [(corner + extent) * scaled for corner, extent in zip(self.corner, self.extent, strict=True)]


@dataclass(frozen=True)
class SceneHeader:
    """A file's header and index, all of their clauses checked.

    Attributes:
        version: (major, minor).
        profile: name in the registry of profiles, `base`.
        file_size: bytes of the file.
        index_size: bytes of the index.
        splat_count: N.
        sh_degree: 0 to 3.
        antialiased: trained with the mip-splatting low-pass filter.
        flat: splats are discs, the smallest scale means nothing.
        coordinate_system: as in `SplatModel`.
        unit_metres: metres per scene unit, `None` where unknown.
        origin: the point that the means are relative to.
        attributes: attribute records in the order of their ids.
        codebooks: codebook records in the order of their ids.
        extras: extra columns.
        directory: records of all chunks that are not tiles.
        tiles: tiles in the order of their splats.
    """

    version: tuple[int, int]
    profile: str
    file_size: int
    index_size: int
    splat_count: int
    sh_degree: int
    antialiased: bool
    flat: bool
    coordinate_system: str
    unit_metres: float | None
    origin: tuple[float, float, float]
    attributes: tuple[_spec.AttributeRecord, ...]
    codebooks: tuple[_spec.CodebookRecord, ...]
    extras: tuple[ExtraColumn, ...]
    directory: tuple[_spec.DirectoryRecord, ...]
    tiles: tuple[Tile, ...]

    def attribute(self, attribute: int) -> _spec.AttributeRecord:
        """Return an attribute's record; `KeyError` for a band above the scene's degree."""
        # ATT-1: the records are opacities, scales, quats, means, sh0 and the bands, ids from 1 on.
        if not 1 <= attribute <= len(self.attributes):
            raise KeyError(attribute)
        return self.attributes[attribute - 1]

    def chunk(self, kind: bytes) -> _spec.DirectoryRecord | None:
        """Return the directory record of META, CAMS, OPTS or SERR, `None` if there is none."""
        return next((record for record in self.directory if record.type == kind), None)

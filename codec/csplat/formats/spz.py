"""SPZ of Niantic and Adobe, versions 1 to 4: positions in fixed point, all else in bytes, attribute by attribute.

Its axes are right, up, back (https://github.com/nianticlabs/spz), unless an extension names others; some converters
put scenes into it as they stand, and no file says so.

Written is version 3, which more programs read than 4. Coefficients of SH get 6 bits each, where the owner's library
keeps 5 of band 1 and 4 of the others: on three scenes 36 to 38 % more bytes and 9 to 10 dB more; a seventh bit would be
18 % more for 2 to 4 dB, an eighth 16 % for 1. Positions get the usual 12 bits of fraction, more where splats are that
fine (all that fit would be up to 9 % more bytes, for 0.3 dB at best), fewer where the scene would not fit.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from csplat.errors import InputError
from csplat.formats.format import Format
from csplat.formats.packing import all_three, smallest_three
from csplat.formats.spz_file import ANTIALIASED, AXES, MOST_BITS, Packed, read_packed, write_packed
from csplat.model import SplatModel, normalise_quats
from csplat.scene import BLOCK, Scene
from csplat.turning import in_axes
from csplat.types import F32, U8

_COLOUR = np.float32(0.15)  # what a coefficient is multiplied by, of the 256 levels
_PART = np.sqrt(np.float32(0.5)) / np.float32(511)  # step of a component of a rotation
_LARGEST_POSITION = (1 << 23) - 1
_USUAL_BITS = 12
_STEPS = 32  # of positions, in the median of the standard deviations
_SH_STEP = 4  # of 256 levels


@contextmanager
def _open(path: Path, sh_degree: int | None = None) -> Iterator[Scene]:
    with path.open("rb") as file:
        packed = read_packed(file, path.name, path.stat().st_size, any_degree=sh_degree is not None)
    degree = packed.degree if sh_degree is None else min(packed.degree, sh_degree)

    def blocks() -> Iterator[SplatModel]:
        for start in range(0, packed.count, BLOCK):
            yield decoded(packed, slice(start, start + BLOCK), degree)

    yield Scene(packed.count, decoded(packed, slice(0, 0), degree), blocks, packed.findings)


def write_spz(path: Path, scene: Scene, *, version: int) -> None:
    """Write version 3 or 4; the rest as `csplat.formats.format.Writer`."""
    scene = in_axes(scene, AXES)
    flags = ANTIALIASED if scene.facts.antialiased else 0
    packed = Packed(path.name, version, scene.count, scene.facts.sh_degree, _fraction(path, scene), flags)
    room = packed.room()
    for rows, block in scene.numbered():
        for part, codes in zip(packed.parts, _encoded(block, packed.bits), strict=True):
            part[rows] = codes
    write_packed(path, packed, room)


def decoded(packed: Packed, rows: slice, degree: int) -> SplatModel:
    """Decode some splats of a file, along its axes, with its SH up to a degree."""
    _, alphas, colours, scales, rotations, rest = (part[rows] for part in packed.parts)
    coefficients = (degree + 1) ** 2 - 1
    shN = np.subtract(rest[:, : 3 * coefficients], 128, dtype=np.float32)
    shN *= np.float32(1 / 128)
    return SplatModel(
        means=means_of(packed, rows),
        quats=(_smallest_three if packed.version > 2 else _first_three)(rotations),
        scales=np.divide(scales, 16, dtype=np.float32) - np.float32(10),
        opacities=np.divide(alphas[:, 0], 255, dtype=np.float32),
        sh0=(np.divide(colours, 255, dtype=np.float32) - np.float32(0.5)) / _COLOUR,
        shN=shN.reshape(len(rest), coefficients, 3),
        coordinate_system=packed.axes,
        antialiased=bool(packed.flags & ANTIALIASED),
    )


def means_of(packed: Packed, rows: slice) -> F32:
    """Decode the positions of some splats of a file, along its axes."""
    if packed.version == 1:
        return packed.means_half[rows].astype(np.float32)
    part = packed.parts[0][rows]
    wide = np.zeros((len(part), 3, 4), np.uint8)
    wide[..., 1:] = part.reshape(-1, 3, 3)
    means = (wide.view("<i4")[..., 0] >> 8).astype(np.float32)
    means *= np.float32(2.0**-packed.bits)
    return means


def _first_three(rotations: U8) -> F32:
    """In bytes; w follows, and is not negative."""
    quats = np.empty((len(rotations), 4), np.float32)
    quats[:, 1:] = np.divide(rotations, 127.5, dtype=np.float32) - np.float32(1)
    quats[:, 0] = np.sqrt(np.maximum(0, 1 - np.einsum("ij,ij->i", quats[:, 1:], quats[:, 1:])))
    return normalise_quats(quats)


def _smallest_three(rotations: U8) -> F32:
    """All but the largest of x y z w in ten bits each, sign and magnitude, the first of them in the highest bits."""
    words = rotations.view("<u4")[:, 0]
    fields = (words[:, None] >> np.array([20, 10, 0], np.uint32)).astype(np.int32)
    sizes = fields & 511
    xyzw = all_three(words >> np.uint32(30), np.where(fields & 512, -sizes, sizes) * _PART)
    return xyzw[:, [3, 0, 1, 2]]


def _fraction(path: Path, scene: Scene) -> int:
    """Bits for the fraction of positions: as many as the splats are fine, and no more than fit."""
    reach, scales = 0.0, np.zeros(256, np.int64)
    for block in scene.blocks():
        reach = max(reach, float(np.abs(block.means).max(initial=0.0)))
        scales += np.bincount(_scale_codes(block.scales).ravel(), minlength=256)
    if reach > _LARGEST_POSITION:
        raise InputError(f"{path.name}: positions reach {reach:,g}, and SPZ holds up to {_LARGEST_POSITION:,}")
    middle = int(np.searchsorted(np.cumsum(scales), scales.sum() / 2))
    fine = math.ceil(math.log2(_STEPS) - (middle / 16 - 10) / math.log(2))
    fitting = math.floor(math.log2(_LARGEST_POSITION / reach)) if reach > 2**-8 else MOST_BITS
    return min(max(fine, _USUAL_BITS), fitting)


def _encoded(model: SplatModel, bits: int) -> tuple[U8, ...]:
    fixed = np.rint(model.means * np.float32(2.0**bits)).astype("<i4")
    rest = np.rint(model.shN * np.float32(128 / _SH_STEP)) * np.float32(_SH_STEP) + np.float32(128)
    return (
        fixed.view(np.uint8).reshape(-1, 3, 4)[..., :3].reshape(-1, 9),
        _bytes(model.opacities[:, None] * np.float32(255)),
        _bytes(model.sh0 * (_COLOUR * np.float32(255)) + np.float32(127.5)),
        _scale_codes(model.scales),
        _three_of(model.quats),
        _bytes(rest).reshape(len(model), 3 * model.shN.shape[1]),
    )


def _scale_codes(scales: F32) -> U8:
    return _bytes(scales * np.float32(16) + np.float32(160))


def _bytes(values: F32) -> U8:
    return np.clip(np.rint(values), 0, 255).astype(np.uint8)


def _three_of(quats: F32) -> U8:
    """The inverse of `_smallest_three`."""
    largest, three = smallest_three(quats[:, [1, 2, 3, 0]])
    steps = np.rint(three / _PART)
    fields = np.minimum(np.abs(steps), 511).astype(np.uint32) | np.where(steps < 0, np.uint32(512), np.uint32(0))
    words: NDArray[np.uint32] = largest.astype("<u4") << 30 | fields[:, 0] << 20 | fields[:, 1] << 10 | fields[:, 2]
    return words[:, None].view(np.uint8)


FORMAT = Format(
    name="spz",
    open=_open,
    open_bands=_open,
    write=partial(write_spz, version=3),
    axes=AXES,
    splat_bytes=(16.5, 19.3, 23.9, 29.7),
    carries=frozenset({"antialiased"}),
)

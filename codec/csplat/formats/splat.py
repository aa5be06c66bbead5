# SPDX-License-Identifier: Apache-2.0
"""Read and write .splat of antimatter15/splat: 32 bytes per splat, without header, SH or axes.

Positions and standard deviations are floats; colours, opacities and rotations are bytes. Only the file name identifies
the format.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from csplat.disk_files import atomic_writer
from csplat.errors import InputError, counted
from csplat.file_source import map_file
from csplat.formats.common import finite_scene, round_to_bytes, sh0_from_bytes
from csplat.formats.format import Format, ValueRange
from csplat.model import SplatModel, normalise_quats
from csplat.ply.columns import LOG_OF_0
from csplat.scene import BLOCK_SPLATS, Scene
from csplat.spherical_harmonics import SH_C0
from csplat.types import F32

_ROW = np.dtype([("means", "<f4", 3), ("scales", "<f4", 3), ("colours", "u1", 4), ("quats", "u1", 4)])
_LARGEST_LOG = np.float32(88.0)  # its exponential fits in float32
_QUAT_ZERO = 128  # byte of a component of 0; 1 would be 256
_SAMPLE = 4096  # number of splats that `_doubt_rows` checks
#: Plausible largest coordinates other than 0, scene units; a quarter of random bytes is inside.
_COORDINATES = (1e-12, 1e12)
_LONGEST_QUAT = 250  # units of 1/128; four bytes of 0 have length 256
_MOST_IS_TEXT = 0.95  # minimum fraction of printable bytes in a text
_PRINTABLE = np.array([32 <= byte < 127 or byte in b"\t\n\r" for byte in range(256)])


@contextmanager
def _open(path: Path) -> Iterator[Scene]:
    """Open a file (`Format.open`); raise an `InputError` if its size is not a multiple of the size of a row."""
    data = map_file(path)
    if len(data) % _ROW.itemsize:
        raise InputError(f"{path.name} has {len(data):,} bytes, expected a multiple of {_ROW.itemsize} (.splat)")
    rows = np.frombuffer(data, _ROW)

    def blocks() -> Iterator[tuple[NDArray[Any], ...]]:
        for start in range(0, len(rows), BLOCK_SPLATS):
            yield (rows[start : start + BLOCK_SPLATS],)

    yield finite_scene(blocks, _decode_rows, _decode_rows(np.zeros((0, 3), np.float32), rows[:0]), zero_quat=_QUAT_ZERO)


def _doubt_rows(path: Path) -> str:
    """Return the reason why a file is unlikely to contain splats (`Format.doubt`): most of a sample is implausible."""
    data = map_file(path)
    if len(data) % _ROW.itemsize or not len(data):
        return ""  # the reader reports the error
    rows = np.frombuffer(data, _ROW)
    step = max(1, len(rows) // _SAMPLE)
    sample = rows[::step]
    share = np.mean(_PRINTABLE[np.frombuffer(sample.tobytes(), np.uint8)])
    if share >= _MOST_IS_TEXT:
        return f"it is text, and begins with {bytes(data[:24]).decode('ascii', 'replace')!a}"
    reach = np.abs(sample["means"]).max(axis=1)  # NaN if a coordinate is NaN
    is_placed = (reach == 0) | ((reach > _COORDINATES[0]) & (reach < _COORDINATES[1]))
    lengths = np.linalg.norm(np.subtract(sample["quats"], _QUAT_ZERO, dtype=np.float32), axis=1)
    is_rotated = lengths < _LONGEST_QUAT
    has_both_signs = (sample["scales"] < 0).any(axis=1) & (sample["scales"] > 0).any(axis=1)  # neither lengths nor logs
    finite = np.isfinite(reach)  # findings report the other rows
    good = ~finite | (is_placed & is_rotated & ~has_both_signs)
    if 2 * np.count_nonzero(~good) <= np.count_nonzero(finite):  # at most half
        return ""
    worst = int(np.argmin(good))  # the first that is implausible
    name, verb = ("means", "is at")
    if is_placed[worst]:
        name, verb = ("scales", "has scales of") if is_rotated[worst] else ("quats", "has a rotation of the bytes")
    values = ", ".join(f"{value:.3g}" for value in sample[name][worst].tolist())
    share = np.count_nonzero(~good) / np.count_nonzero(finite)
    at = worst * step * _ROW.itemsize
    return f"{share:.0%} of {counted(len(good), 'row')} are not splats; the one at byte {at:,} {verb} {values}"


def _decode_rows(scales: F32, rows: NDArray[Any]) -> SplatModel:
    """Decode rows [n], with log scales [n, 3] that were computed from them."""
    return SplatModel(
        means=rows["means"].astype(np.float32),
        quats=normalise_quats(np.subtract(rows["quats"], _QUAT_ZERO, dtype=np.float32)),
        scales=scales,
        opacities=np.divide(rows["colours"][:, 3], 255, dtype=np.float32),
        sh0=sh0_from_bytes(rows["colours"][:, :3]),
    )


def _write(path: Path, scene: Scene) -> None:
    """Write a file (`Format.write`): SH of degree 0 and no metadata."""
    with atomic_writer(path) as stream:
        if not scene.count:
            raise InputError(f"{path.name}: no splats are left to write, and an empty file is not a scene")
        for model in scene.blocks():
            rows = np.empty(len(model), _ROW)
            rows["means"] = model.means
            rows["scales"] = np.exp(np.minimum(model.scales, _LARGEST_LOG))
            rows["colours"][:, :3] = round_to_bytes((model.sh0 * np.float32(SH_C0) + np.float32(0.5)) * np.float32(255))
            rows["colours"][:, 3] = round_to_bytes(model.opacities * np.float32(255))
            rows["quats"] = round_to_bytes(_with_negative_largest(model.quats) * np.float32(128) + np.float32(128))
            stream.write(rows.tobytes())


def _with_negative_largest(quats: F32) -> F32:
    """Make the largest component of quats [N, 4] negative: bytes represent -1, not 1; some viewers do not normalise."""
    largest = np.take_along_axis(quats, np.abs(quats).argmax(axis=1)[:, None], axis=1)
    return np.where(largest > 0, -quats, quats)


FORMAT = Format(
    name="splat",
    open=_open,
    write=_write,
    doubt=_doubt_rows,
    degree=0,
    ranges={
        "scales": ValueRange(LOG_OF_0, float(_LARGEST_LOG)),
        "sh0": ValueRange(-0.5 / SH_C0, 0.5 / SH_C0, 1 / (255 * SH_C0)),
    },
    splat_bytes=(32.0,),
    exact=frozenset({"means"}),
)

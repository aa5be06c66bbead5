""".splat of antimatter15/splat: 32 bytes a splat and nothing else: no SH, no axes, no word of what it is.

Position and standard deviations are floats; colour, opacity and rotation bytes. Its name alone tells it apart.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from csplat.errors import InputError, counted
from csplat.files import atomic_writer
from csplat.formats.format import Format
from csplat.formats.rows import colours_of_bytes, finite_scene
from csplat.inputs import mapped
from csplat.model import SplatModel, normalise_quats
from csplat.ply.columns import SH_C0
from csplat.scene import BLOCK, Scene
from csplat.types import F32

_ROW = np.dtype([("means", "<f4", 3), ("scales", "<f4", 3), ("colours", "u1", 4), ("quats", "u1", 4)])
_LARGEST_LOG = np.float32(88.0)  # float32 holds its exponential
_QUAT_ZERO = 128  # byte of a component of 0; that of 1 would be 256
_SAMPLE = 4096  # splats that are looked at for a doubt
_PLACES = (1e-12, 1e12)  # largest coordinate other than 0, scene units; of any 12 bytes a quarter lies there
_LONGEST_QUAT = 250  # units of 1/128; four bytes of 0 are 256 long, and 255 in three is what clipped ones have
_MOST_IS_TEXT = 0.95  # share of printable bytes
_PRINTABLE = np.array([32 <= byte < 127 or byte in b"\t\n\r" for byte in range(256)])


@contextmanager
def _open(path: Path) -> Iterator[Scene]:
    data = mapped(path)
    if len(data) % _ROW.itemsize:
        raise InputError(f"{path.name} has {len(data):,} bytes, wanted a multiple of {_ROW.itemsize} (.splat)")
    rows = np.frombuffer(data, _ROW)

    def blocks() -> Iterator[tuple[NDArray[Any], ...]]:
        for start in range(0, len(rows), BLOCK):
            yield (rows[start : start + BLOCK],)

    yield finite_scene(blocks, _decoded, _decoded(np.zeros((0, 3), np.float32), rows[:0]), zero_quat=_QUAT_ZERO)


def _doubt(path: Path) -> str:
    """Say why a file has hardly splats in its rows: as `Format.doubt`. Half of a sample has to look like splats."""
    data = mapped(path)
    if len(data) % _ROW.itemsize or not len(data):
        return ""  # its reader says what is wrong
    rows = np.frombuffer(data, _ROW)
    step = max(1, len(rows) // _SAMPLE)
    sample = rows[::step]
    share = np.mean(_PRINTABLE[np.frombuffer(sample.tobytes(), np.uint8)])
    if share >= _MOST_IS_TEXT:
        return f"it is text, and begins with {bytes(data[:24]).decode('ascii', 'replace')!a}"
    far = np.abs(sample["means"]).max(axis=1)  # NaN where there is one
    placed = (far == 0) | ((far > _PLACES[0]) & (far < _PLACES[1]))
    lengths = np.linalg.norm(np.subtract(sample["quats"], _QUAT_ZERO, dtype=np.float32), axis=1)
    turned = lengths < _LONGEST_QUAT
    of_two_signs = (sample["scales"] < 0).any(axis=1) & (sample["scales"] > 0).any(axis=1)  # neither lengths nor logs
    finite = np.isfinite(far)  # a finding reports the others
    good = ~finite | (placed & turned & ~of_two_signs)
    if 2 * np.count_nonzero(~good) <= np.count_nonzero(finite):
        return ""
    worst = int(np.argmin(good))
    name, what = ("means", "lies at")
    if placed[worst]:
        name, what = ("scales", "has scales of") if turned[worst] else ("quats", "has a rotation of the bytes")
    said = ", ".join(f"{value:.3g}" for value in sample[name][worst].tolist())
    share = np.count_nonzero(~good) / np.count_nonzero(finite)
    at = worst * step * _ROW.itemsize
    return f"{share:.0%} of {counted(len(good), 'row')} are no splats; that at byte {at:,} {what} {said}"


def _decoded(scales: F32, rows: NDArray[Any]) -> SplatModel:
    return SplatModel(
        means=rows["means"].astype(np.float32),
        quats=normalise_quats(np.subtract(rows["quats"], _QUAT_ZERO, dtype=np.float32)),
        scales=scales,
        opacities=np.divide(rows["colours"][:, 3], 255, dtype=np.float32),
        sh0=colours_of_bytes(rows["colours"][:, :3]),
    )


def _write(path: Path, scene: Scene) -> None:
    with atomic_writer(path) as stream:
        for model in scene.blocks():
            rows = np.empty(len(model), _ROW)
            rows["means"] = model.means
            rows["scales"] = np.exp(np.minimum(model.scales, _LARGEST_LOG))
            rows["colours"][:, :3] = _bytes((model.sh0 * SH_C0 + np.float32(0.5)) * np.float32(255))
            rows["colours"][:, 3] = _bytes(model.opacities * np.float32(255))
            rows["quats"] = _bytes(_with_negative_largest(model.quats) * np.float32(128) + np.float32(128))
            stream.write(rows.tobytes())


def _with_negative_largest(quats: F32) -> F32:
    """The same rotations: -1 has a byte and 1 has none, and some viewers do not normalise."""
    largest = np.take_along_axis(quats, np.abs(quats).argmax(axis=1)[:, None], axis=1)
    return np.where(largest > 0, -quats, quats)


def _bytes(values: F32) -> NDArray[np.uint8]:
    return np.clip(np.rint(values), 0, 255).astype(np.uint8)


FORMAT = Format(
    name="splat",
    open=_open,
    write=_write,
    doubt=_doubt,
    degree=0,
    splat_bytes=(32.0,),
    exact=frozenset({"means"}),
)

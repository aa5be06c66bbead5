"""PLY files as trainers write them, and what they mean: written by hand, so that no reader is judged by itself.

The columns are those of the reference implementation of 3D Gaussian splatting: centres, base colour `f_dc`, higher
coefficients `f_rest` channel by channel, the logit of the opacity, logarithms of the standard deviations, and a
quaternion w x y z of any length.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from csplat_conformance.stated import Source

__all__ = ["Splats", "meaning", "write"]

F32 = NDArray[np.float32]

_ENDIAN = {"binary_little_endian": "<", "binary_big_endian": ">"}
_TYPE_NAMES = {"f4": "float", "f8": "double", "u1": "uchar", "i2": "short", "i4": "int", "u4": "uint"}


@dataclass
class Splats:
    """Rows of a PLY, as they stand in it.

    Attributes:
        means: [N, 3], float32 or float64.
        quats: [N, 4], w x y z, of any length.
        scales: [N, 3], natural logarithms.
        logits: [N], of the opacity.
        sh0: [N, 3].
        shN: [N, K, 3].
        extra: further columns by name.
    """

    means: NDArray[Any]
    quats: F32
    scales: F32
    logits: F32
    sh0: F32
    shN: F32
    extra: dict[str, NDArray[Any]] = field(default_factory=dict)

    def select(self, rows: NDArray[Any]) -> Splats:
        """Keep some rows."""
        return Splats(
            self.means[rows],
            self.quats[rows],
            self.scales[rows],
            self.logits[rows],
            self.sh0[rows],
            self.shN[rows],
            {name: column[rows] for name, column in self.extra.items()},
        )


def is_splat(splats: Splats) -> NDArray[np.bool_]:
    """Tell which rows are splats of the source (SRC-1): all numbers finite in binary32, logits may be infinite."""
    good = ~np.isnan(splats.logits)
    with np.errstate(over="ignore"):
        for array in (splats.means, splats.quats, splats.scales, splats.sh0, splats.shN):
            good &= np.isfinite(array.astype(np.float32)).all(axis=tuple(range(1, array.ndim)))
    return good


def meaning(splats: Splats) -> Source:
    """Return the source that the rows stand for (spec SRC-1, SRC-2): alpha of the logits, unit quaternions."""
    splats = splats.select(np.flatnonzero(is_splat(splats)))
    with np.errstate(over="ignore"):
        alpha = 1.0 / (1.0 + np.exp(-splats.logits.astype(np.float64)))  # ±Inf are alpha 1 and 0
    quats = splats.quats.astype(np.float64)
    lengths = np.sqrt(np.square(quats).sum(axis=1, keepdims=True))
    quats = np.where(lengths > 0.0, quats / np.where(lengths > 0.0, lengths, 1.0), [[1.0, 0.0, 0.0, 0.0]])
    return Source(
        means=splats.means,
        quats=quats.astype(np.float32),
        scales=splats.scales,
        opacities=alpha.astype(np.float32),
        sh0=splats.sh0,
        shN=splats.shN,
        extra=splats.extra,
    )


def write(
    splats: Splats,
    *,
    format: str = "binary_little_endian",
    normals: bool = True,
    dtype: str = "f4",
    comments: Sequence[str] = (),
    reverse: bool = False,
) -> bytes:
    """Write the bytes of a PLY.

    Args:
        splats: the rows.
        format: of the header: `ascii`, `binary_little_endian` or `binary_big_endian`.
        normals: whether there are columns nx, ny, nz, all zero, as most trainers write.
        dtype: `f4` or `f8`, of all columns but the extra ones.
        comments: lines of the header.
        reverse: columns in the opposite order: only their names count.
    """
    columns = _columns(splats, dtype, normals=normals)
    if reverse:
        columns = dict(reversed(columns.items()))
    lines = ["ply", f"format {format} 1.0", *(f"comment {line}" for line in comments)]
    lines.append(f"element vertex {len(splats.means)}")
    lines += [f"property {_TYPE_NAMES[column.dtype.str[1:]]} {name}" for name, column in columns.items()]
    head = "\n".join([*lines, "end_header\n"]).encode("ascii")
    if format == "ascii":
        rows = zip(*(column.tolist() for column in columns.values()), strict=True)
        return head + "".join(" ".join(map(_number, row)) + "\n" for row in rows).encode("ascii")
    kinds = [(name, _ENDIAN[format] + column.dtype.str[1:]) for name, column in columns.items()]
    table = np.empty(len(splats.means), kinds)
    for name, column in columns.items():
        table[name] = column
    return head + table.tobytes()


def _columns(splats: Splats, dtype: str, *, normals: bool) -> dict[str, NDArray[Any]]:
    count = len(splats.means)
    named: dict[str, NDArray[Any]] = dict(zip("xyz", splats.means.T, strict=True))
    if normals:
        named |= {name: np.zeros(count, np.float32) for name in ("nx", "ny", "nz")}
    named |= {f"f_dc_{i}": column for i, column in enumerate(splats.sh0.T)}
    # Channel by channel: all red coefficients, then all green ones.
    rest = splats.shN.transpose(0, 2, 1).reshape(count, 3 * splats.shN.shape[1])
    named |= {f"f_rest_{i}": column for i, column in enumerate(rest.T)}
    named["opacity"] = splats.logits
    named |= {f"scale_{i}": column for i, column in enumerate(splats.scales.T)}
    named |= {f"rot_{i}": column for i, column in enumerate(splats.quats.T)}
    return _as_type(named, dtype) | {name: np.asarray(column) for name, column in splats.extra.items()}


def _as_type(columns: Mapping[str, NDArray[Any]], dtype: str) -> dict[str, NDArray[Any]]:
    return {name: column.astype(f"<{dtype}") for name, column in columns.items()}


def _number(value: float) -> str:
    """Write a number so that it is read back exactly: the shortest digits of its binary64 do."""
    return repr(value)

# SPDX-License-Identifier: CC0-1.0
"""Write PLY files as trainers do, and return their sources independently of the PLY reader under test.

The columns follow the reference implementation of 3D Gaussian splatting: centres, base colour `f_dc`, higher
coefficients `f_rest` channel by channel, the logit of the opacity, logarithms of the standard deviations, and a
quaternion w x y z of any length.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from csplat_conformance.declared_bounds import Source

_ENDIAN = {"binary_little_endian": "<", "binary_big_endian": ">"}
_TYPE_NAMES = {"f4": "float", "f8": "double", "u1": "uchar", "i2": "short", "i4": "int", "u4": "uint"}


@dataclass
class PlyRows:
    """The rows of a PLY: float32, or float64 for values of a PLY with doubles.

    Attributes:
        means: [N, 3].
        quats: [N, 4], w x y z, of any length.
        scales: [N, 3], natural logarithms.
        logits: [N], logits of the opacities.
        sh0: [N, 3].
        shN: [N, K, 3].
        normals: [N, 3], unused by splats.
        extra: further columns by name.
    """

    means: NDArray[Any]
    quats: NDArray[Any]
    scales: NDArray[Any]
    logits: NDArray[Any]
    sh0: NDArray[Any]
    shN: NDArray[Any]
    normals: NDArray[Any] | None = None
    extra: dict[str, NDArray[Any]] = field(default_factory=dict)

    def select(self, rows: NDArray[Any]) -> PlyRows:
        """Return the given rows."""
        return PlyRows(
            self.means[rows],
            self.quats[rows],
            self.scales[rows],
            self.logits[rows],
            self.sh0[rows],
            self.shN[rows],
            None if self.normals is None else self.normals[rows],
            {name: column[rows] for name, column in self.extra.items()},
        )


def is_splat(splats: PlyRows) -> NDArray[np.bool_]:
    """Return a mask of the rows that are splats of the source (SRC-1): finite, except for logits and scales of 0."""
    good: NDArray[np.bool_] = ~np.isnan(splats.logits)
    with np.errstate(over="ignore"):
        flat = np.where(np.isneginf(splats.scales), 0.0, splats.scales)
        for array in (splats.means, splats.quats, flat, splats.sh0, splats.shN):
            good &= np.isfinite(array.astype(np.float32)).all(axis=tuple(range(1, array.ndim)))
    return good


def source_of_rows(splats: PlyRows) -> Source:
    """Return the source of the rows (SRC-1, SRC-2), with alpha instead of logits and with unit quaternions."""
    splats = splats.select(np.flatnonzero(is_splat(splats)))
    with np.errstate(over="ignore"):
        alpha = 1.0 / (1.0 + np.exp(-splats.logits.astype(np.float32).astype(np.float64)))  # ±Inf are alpha 1 and 0
    quats = splats.quats.astype(np.float32).astype(np.float64)
    lengths = np.sqrt(np.square(quats).sum(axis=1, keepdims=True))
    quats = np.where(lengths > 0.0, quats / np.where(lengths > 0.0, lengths, 1.0), [[1.0, 0.0, 0.0, 0.0]])
    return Source(
        means=splats.means,
        quats=quats.astype(np.float32),
        scales=splats.scales.astype(np.float32),
        opacities=alpha.astype(np.float32),
        sh0=splats.sh0.astype(np.float32),
        shN=splats.shN.astype(np.float32),
        extra=splats.extra,
    )


@dataclass(frozen=True)
class PlyLayout:
    """The layout of rows in a PLY.

    Attributes:
        format: format in the header: `ascii`, `binary_little_endian` or `binary_big_endian`.
        normals: whether to write columns nx, ny, nz, like most trainers; zero unless the rows have values.
        dtype: type of all columns except extra columns, `f4` or `f8`.
        means_dtype: type of x, y, z, if it differs.
        comments: comment lines of the header, with any characters; bytes that are not UTF-8 as surrogates.
        obj_info: `obj_info` lines of the header.
        reverse: whether to write the columns in reverse order.
        renamed: new names of columns; an empty name drops the column.
        count: number of rows in the header, if wrong on purpose.
        line_end: line ending of the header.
        lists: [N] lists of small numbers, written as a list property before all others; not in `ascii`.
        before: header lines and bytes of elements before the splats.
        after: header lines and bytes of elements after the splats; without lines, trailing bytes.
    """

    format: str = "binary_little_endian"
    normals: bool = True
    dtype: str = "f4"
    means_dtype: str | None = None
    comments: Sequence[str] = ()
    obj_info: Sequence[str] = ()
    reverse: bool = False
    renamed: Mapping[str, str] = field(default_factory=dict)
    count: int | None = None
    line_end: str = "\n"
    lists: Sequence[bytes] = ()
    before: tuple[Sequence[str], bytes] = ((), b"")
    after: tuple[Sequence[str], bytes] = ((), b"")


def write_ply(splats: PlyRows, layout: PlyLayout | None = None) -> bytes:
    """Return the bytes of a PLY."""
    layout = layout or PlyLayout()
    columns = _lay_out_columns(splats, layout)
    head = _format_header(columns, len(splats.means), layout)
    if layout.format == "ascii":
        rows = zip(*(column.tolist() for column in columns.values()), strict=True)
        body = "".join(" ".join(map(repr, row)) + "\n" for row in rows).encode("ascii")
    else:
        kinds = [(name, _ENDIAN[layout.format] + column.dtype.str[1:]) for name, column in columns.items()]
        table = np.empty(len(splats.means), kinds)
        for name, column in columns.items():
            table[name] = column
        body = table.tobytes()
        if layout.lists:
            size = table.dtype.itemsize
            rows = zip(layout.lists, range(0, len(body), size), strict=True)
            body = b"".join(bytes((len(numbers),)) + numbers + body[at : at + size] for numbers, at in rows)
    return head + layout.before[1] + body + layout.after[1]


def _format_header(columns: Mapping[str, NDArray[Any]], count: int, layout: PlyLayout) -> bytes:
    """Return the header of `count` rows up to and including the line `end_header`, with the layout's other elements."""
    lines = ["ply", f"format {layout.format} 1.0", *(f"comment {line}" for line in layout.comments)]
    lines += [f"obj_info {line}" for line in layout.obj_info]
    lines += [*layout.before[0], f"element vertex {count if layout.count is None else layout.count}"]
    lines += ["property list uchar uchar neighbours"] if layout.lists else []
    lines += [f"property {_TYPE_NAMES[column.dtype.str[1:]]} {name}" for name, column in columns.items()]
    lines += [*layout.after[0], "end_header", ""]
    return layout.line_end.join(lines).encode("utf-8", "surrogateescape")


def _lay_out_columns(splats: PlyRows, layout: PlyLayout) -> dict[str, NDArray[Any]]:
    """Return the columns of a PLY by name, [N] each, in the layout's order, types and names."""
    count = len(splats.means)
    means = splats.means.astype(f"<{layout.means_dtype or layout.dtype}")
    named: dict[str, NDArray[Any]] = {}
    if layout.normals:
        normals = np.zeros((count, 3), np.float32) if splats.normals is None else splats.normals
        named |= {f"n{axis}": column for axis, column in zip("xyz", normals.T, strict=True)}
    named |= {f"f_dc_{i}": column for i, column in enumerate(splats.sh0.T)}
    # Channel by channel: all red coefficients, then green, then blue.
    rest = splats.shN.transpose(0, 2, 1).reshape(count, 3 * splats.shN.shape[1])
    named |= {f"f_rest_{i}": column for i, column in enumerate(rest.T)}
    named["opacity"] = splats.logits
    named |= {f"scale_{i}": column for i, column in enumerate(splats.scales.T)}
    named |= {f"rot_{i}": column for i, column in enumerate(splats.quats.T)}
    columns = dict(zip("xyz", means.T, strict=True))
    columns |= {name: column.astype(f"<{layout.dtype}") for name, column in named.items()}
    columns |= {name: np.asarray(column) for name, column in splats.extra.items()}
    if layout.reverse:
        columns = dict(reversed(columns.items()))
    names = {name: layout.renamed.get(name, name) for name in columns}
    return {names[name]: column for name, column in columns.items() if names[name]}

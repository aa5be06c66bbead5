"""The rows of a PLY, and scenes as an honest encoder measures errors against."""

from __future__ import annotations

import io
import re
from dataclasses import dataclass

import numpy as np
import plyfile

import csplat
from csplat.encoder.error_bounds import ErrorSums, distance_errors, measured_sums

_HEADER = re.compile(rb"\Aply.*?end_header\r?\n", re.DOTALL)


def parsed(data):
    """The columns of the splats, as they stand in the file."""
    return plyfile.PlyData.read(io.BytesIO(data))["vertex"].data


def rows(change):
    """Return a change of a PLY: `change` is given the columns by name, to be changed in place."""

    def run(data):
        ply = plyfile.PlyData.read(io.BytesIO(data))
        columns = np.array(ply["vertex"].data)
        with np.errstate(all="ignore"):
            change(columns)
        ply["vertex"].data = columns
        out = io.BytesIO()
        ply.write(out)
        return out.getvalue()

    return run


def kept(which):
    """Return a change that leaves out rows: `which` takes the columns and returns the rows to keep."""

    def run(data):
        ply = plyfile.PlyData.read(io.BytesIO(data))
        columns = np.array(ply["vertex"].data)
        ply["vertex"].data = columns[which(columns)]
        out = io.BytesIO()
        ply.write(out)
        return out.getvalue()

    return run


def each(prefix, change):
    """Return a change of every column of floats whose name begins so."""

    def run(columns):
        for name in columns.dtype.names:
            if name.startswith(prefix) and columns.dtype[name].kind == "f":
                columns[name] = change(columns[name])

    return rows(run)


def header(change):
    """Return a change of a PLY's header and of what follows it."""

    def run(data):
        found = _HEADER.match(data)
        return data if found is None else b"".join(change(found.group(), data[found.end() :]))

    return run


def without(name):
    """Return a change that leaves out a column."""

    def run(data):
        ply = plyfile.PlyData.read(io.BytesIO(data))
        columns = ply["vertex"].data
        names = [one for one in columns.dtype.names if one != name]
        kept = np.empty(len(columns), [(one, columns.dtype[one]) for one in names])
        for one in names:
            kept[one] = columns[one]
        out = io.BytesIO()
        plyfile.PlyData([plyfile.PlyElement.describe(kept, "vertex")], byte_order="<").write(out)
        return out.getvalue()

    return run


def as_read(ply):
    """The scene as our reader has it: alpha and unit quaternions in float32."""
    return csplat.read_ply(ply)


def in_binary64(ply):
    """The scene in binary64: alpha and unit quaternions that nobody rounded."""
    return Exact.of(ply)


def true_errors(source, decoded, index):
    """Return (max, rms) by measure, a hair wider, as ours states them; origins may differ."""
    sums = measured_sums(source, decoded, index)
    absolute = [
        np.add(model.means.astype(np.float64), model.origin) if model.means_double is None else model.means_double
        for model in (source, decoded)
    ]
    most, squares = distance_errors(absolute[0][index].T, absolute[1].T)
    largest, all_squares = {**sums.largest, "means": most}, {**sums.squares, "means": squares}
    return ErrorSums(sums.count, largest, all_squares).declared()


@dataclass(frozen=True)
class Exact:
    """A scene of float64 that can be measured against; finite, and no quaternion of length 0."""

    means: np.ndarray
    quats: np.ndarray
    scales: np.ndarray
    opacities: np.ndarray
    sh0: np.ndarray
    shN: np.ndarray
    sh_degree: int
    origin: tuple[float, float, float] = (0.0, 0.0, 0.0)
    means_double: None = None

    def __len__(self):
        return len(self.means)

    @classmethod
    def of(cls, ply):
        """Read its columns by hand."""
        columns = parsed(ply.read_bytes())
        rest = sum(name.startswith("f_rest_") for name in columns.dtype.names) // 3

        def group(*names):
            return np.stack([columns[name].astype(np.float64) for name in names], axis=1)

        quats = group(*(f"rot_{i}" for i in range(4)))
        shN = [group(*(f"f_rest_{c * rest + i}" for i in range(rest))) for c in range(3)] if rest else []
        return cls(
            means=group(*"xyz"),
            quats=quats / np.linalg.norm(quats, axis=1, keepdims=True),
            scales=group(*(f"scale_{i}" for i in range(3))),
            opacities=1.0 / (1.0 + np.exp(-columns["opacity"].astype(np.float64))),
            sh0=group(*(f"f_dc_{i}" for i in range(3))),
            shN=np.stack(shN, axis=2) if rest else np.zeros((len(columns), 0, 3)),
            sh_degree=round((rest + 1) ** 0.5) - 1,
        )

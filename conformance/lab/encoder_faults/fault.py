# SPDX-License-Identifier: CC0-1.0
"""The type of a fault, ways to make one, and the scenes that declared errors are measured against."""

import contextlib
import io
import re
from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager
from dataclasses import dataclass, field, replace
from enum import StrEnum
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
import plyfile

import csplat
from csplat import ply as plys
from csplat.encoder.error_bounds import ErrorSums, distance_errors, measured_sums

PLAIN, DEGREE_2, DEGREE_3 = "ordinary/degree_1", "ordinary/degree_2", "ordinary/degree_3"
STRONG = "ordinary/strong_colours"
#: An input with many slender splats, which reveals systematic errors.
DENSE = "ordinary/surfaces"

Scene = csplat.SplatModel
Bytes = Callable[[bytes], bytes]


class Harm(StrEnum):
    """The harm that a fault does to users of the file."""

    VALIDITY = "validity"  #: a decoder refuses the file, or there is no file
    PICTURE = "picture"  #: renders are wrong
    BOUND = "bound"  #: a declared error does not hold, or is unreliable
    FACTS = "facts"  #: the file makes false statements about the source or its splats
    DETERMINISM = "determinism"  #: the same input gives different bytes
    FILES = "files"  #: files of the user are changed, left behind, or cannot be encoded
    COARSE = "coarse"  #: valid and honest, but much worse than necessary, or refused without need: deserves a warning
    HARMLESS = "harmless"  #: a choice that encoders are free to make, and that the suite must accept


@dataclass(frozen=True)
class EncoderFault:
    """A fault to plant in our encoder.

    Attributes:
        why: the author's mistaken belief.
        harm: the harm that it does.
        caught: level and clause expected to catch it. The clause is empty if no clause is violated; both are empty
            for harmless choices.
        inputs: patterns of the reference inputs that reveal it. A pattern may match nothing.
        ply: changes the bytes of the input before they are read.
        scene: changes the scene after it was read.
        keep: returns the indices of the splats to encode, in order; the others count as pruned.
        stage: context manager that patches reader and encoder.
        options: options of the encoder.
        honest: returns the scene against which the errors that the file declares are measured after encoding.
        data: changes the file.
        index: changes the map from splats of the file to splats of the source.
        end: called with input, output and the encoded bytes in place of writing the output; may end the process.
        starts: whether the fault has to run in a process of its own.
    """

    why: str
    harm: Harm
    caught: tuple[str, str] = ("", "")
    inputs: str = PLAIN
    ply: Bytes | None = None
    scene: Callable[[Scene], Scene] | None = None
    keep: Callable[[Scene], Any] | None = None
    stage: Callable[[], AbstractContextManager[object]] = contextlib.nullcontext
    options: Mapping[str, Any] = field(default_factory=dict)
    honest: Callable[[Path], Any] | None = None
    data: Bytes | None = None
    index: Callable[[Any], Any] | None = None
    end: Callable[[Path, Path, bytes], None] | None = None
    starts: bool = False

    @property
    def is_late(self) -> bool:
        """True if the fault is applied after our encoder has finished."""
        early = (self.ply, self.scene, self.keep)
        return all(change is None for change in early) and self.stage is contextlib.nullcontext


def changed(**fields: Callable[[Scene], Any]) -> Callable[[Scene], Scene]:
    """Return a change of a scene: each function maps the original scene to a new value of its field."""
    return lambda model: replace(model, **{name: make(model) for name, make in fields.items()})


def replaced(module, name, make):
    """Return a stage that replaces a function of a module by `make(function)`."""
    return lambda: mock.patch.object(module, name, make(getattr(module, name)))


def floats(values):
    return np.ascontiguousarray(values, dtype=np.float32)


# Changes of a PLY -----------------------------------------------------------------------------------
_HEADER = re.compile(rb"\Aply.*?end_header\r?\n", re.DOTALL)


def read_columns(data):
    """Return the columns of the splats, unchanged."""
    return plyfile.PlyData.read(io.BytesIO(data))["vertex"].data


def change_table(change):
    """Return a change of a PLY: `change` maps the structured array of the splats to a new one."""

    def run(data):
        ply = plyfile.PlyData.read(io.BytesIO(data))
        with np.errstate(all="ignore"):
            columns = change(np.array(ply["vertex"].data))
        elements = [plyfile.PlyElement.describe(columns, "vertex") if one.name == "vertex" else one for one in ply]
        out = io.BytesIO()
        plyfile.PlyData(elements, ply.text, ply.byte_order, ply.comments).write(out)
        return out.getvalue()

    return run


def keep_rows(which):
    """Return a change that drops rows: `which` maps the columns to the rows to keep."""
    return change_table(lambda columns: columns[which(columns)])


def change_columns(prefix, change):
    """Return a change of every column of floats whose name has the prefix."""

    def run(columns):
        for name in columns.dtype.names:
            if name.startswith(prefix) and columns.dtype[name].kind == "f":
                columns[name] = change(columns[name])
        return columns

    return change_table(run)


def drop_column(name):
    """Return a change that drops a column."""

    def run(columns):
        names = [one for one in columns.dtype.names if one != name]
        kept = np.empty(len(columns), [(one, columns.dtype[one]) for one in names])
        for one in names:
            kept[one] = columns[one]
        return kept

    return change_table(run)


def change_header(change):
    """Return a change of a PLY: `change` maps its header and its body to the parts of the new file."""

    def run(data):
        found = _HEADER.match(data)
        return data if found is None else b"".join(change(found.group(), data[found.end() :]))

    return run


# Scenes to measure errors against -------------------------------------------------------------------
def as_read(ply):
    """Read a scene with our reader: alpha and unit quaternions in float32."""
    return plys.read_ply(ply)


def in_binary64(ply):
    """Read a scene in binary64: alpha and unit quaternions are not rounded."""
    return Exact.of(ply)


def true_errors(source, decoded, index):
    """Return (max, rms) by measure, rounded up like those of our encoder; origins may differ."""
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
    """A scene in float64 to measure errors against; finite, and without quaternions of length 0."""

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
        """Read a PLY, column by column."""
        columns = read_columns(ply.read_bytes())
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

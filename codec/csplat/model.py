# SPDX-License-Identifier: Apache-2.0
"""Represent a scene of 3D Gaussian splats in memory: `SplatModel`.

All readers, writers, renderers and the codec use it. The constructor checks its data and never repairs it.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import MISSING, dataclass, field, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from csplat import _spec
from csplat.errors import InputError, counted
from csplat.plugins import load_plugins
from csplat.scene_metadata import SceneMetadata
from csplat.types import F32, F64

#: Highest spherical-harmonics degree of a model.
MAX_SH_DEGREE = 4

#: Maximum deviation of the length of a unit quaternion from 1.
QUAT_LENGTH_TOLERANCE = 1e-3

_BLOCK = 1 << 18  # values checked at a time
_NO_SH: F32 = np.zeros((0, 0, 3), np.float32)


@dataclass(frozen=True, eq=False, repr=False)
class SplatModel:
    """N splats and the metadata of their scene.

    The arrays are neither copied nor made read-only; treat them as constant.

    Attributes:
        means: [N, 3] float32, centres in scene units, relative to `origin`.
        quats: [N, 4] float32, rotations w x y z; lengths within `QUAT_LENGTH_TOLERANCE` of 1, see `normalise_quats`.
        scales: [N, 3] float32, natural logarithms of the standard deviations in scene units.
        opacities: [N] float32, alpha in [0, 1] (not logits).
        sh0: [N, 3] float32, spherical-harmonics coefficient of degree 0, red green blue.
        shN: [N, K, 3] float32, higher coefficients, K = (d + 1)**2 - 1 for degree d = 0 to 4. Default: K = 0.
        origin: offset of `means` in the source's coordinates, three float64, scene units. Scenes at geographic
            coordinates keep the precision of float32 this way.
        means_double: [N, 3] float64, centres in the source's coordinates; `means` are these minus `origin`, rounded.
            `None` if `origin` and `means` are exact.
        metadata: metadata of the scene.
        extra: additional columns by name, each [N] or [N, C] for C = 2 to 64 values of a splat, integer or floating.

    Raises:
        InputError: an array has the wrong shape or dtype, contains NaN or infinity, or is out of range; or another
            field is invalid.
    """

    means: F32
    quats: F32
    scales: F32
    opacities: F32
    sh0: F32
    shN: F32 = field(default_factory=lambda: _NO_SH)
    origin: tuple[float, float, float] = (0.0, 0.0, 0.0)
    metadata: SceneMetadata = field(default_factory=SceneMetadata)
    extra: Mapping[str, NDArray[Any]] = field(default_factory=dict)
    means_double: F64 | None = None

    def __post_init__(self) -> None:
        if not isinstance(self.means, np.ndarray):
            _check_array("means", self.means, ("N", 3))
        n = len(self.means) if self.means.ndim else 0
        if self.shN is _NO_SH:
            object.__setattr__(self, "shN", np.zeros((n, 0, 3), np.float32))
        _check_array("means", self.means, (n, 3))
        _check_array("quats", self.quats, (n, 4))
        _check_array("scales", self.scales, (n, 3))
        _check_array("opacities", self.opacities, (n,))
        _check_array("sh0", self.sh0, (n, 3))
        _check_array("shN", self.shN, (n, "K", 3))
        sh_degree_of(self.shN.shape[1])
        _check_opacities(self.opacities)
        _check_quats(self.quats)
        _check_extra(self.extra, n)
        object.__setattr__(self, "origin", _parse_origin(self.origin))
        if self.means_double is not None:
            _check_doubles(self.means, self.means_double, self.origin)
        if not isinstance(self.metadata, SceneMetadata):
            raise InputError(f"metadata is a {type(self.metadata).__name__}, expected SceneMetadata")

    def __len__(self) -> int:
        return len(self.means)

    def __repr__(self) -> str:
        return f"SplatModel({len(self)} splats, sh_degree={self.sh_degree})"

    def _repr_html_(self) -> str | None:
        """Return an interactive view for notebooks; `None`, so that they show `repr`, if empty or without the tools."""
        if not len(self):
            return None
        html = load_plugins("csplat.display").get("html")
        shown: str | None = html and html(self)
        return shown

    @property
    def sh_degree(self) -> int:
        """Spherical-harmonics degree, 0 to `MAX_SH_DEGREE`."""
        return sh_degree_of(self.shN.shape[1])

    def with_metadata(self, metadata: SceneMetadata) -> SplatModel:
        """Return the splats with other metadata, or the model itself if the metadata is its own."""
        return self if metadata is self.metadata else trusted_model(**{**vars(self), "metadata": metadata})

    def select(self, index: NDArray[Any] | slice) -> SplatModel:
        """Return the model of some splats, with the same metadata.

        Args:
            index: index of the first axis of a NumPy array: integers, a mask, or a slice, which returns views.
        """

        def rows(array: NDArray[Any]) -> NDArray[Any]:
            if isinstance(index, slice) or np.asarray(index).dtype == bool:
                return array[index]
            return np.take(array, index, axis=0)  # takes half the time of indexing

        values = {attribute.name: getattr(self, attribute.name) for attribute in fields(self)}
        values |= {name: rows(values[name]) for name in ("means", "quats", "scales", "opacities", "sh0", "shN")}
        values["extra"] = {name: rows(column) for name, column in self.extra.items()}
        values["means_double"] = None if self.means_double is None else rows(self.means_double)
        return trusted_model(**values)


def splat_dtype(column: NDArray[Any]) -> np.dtype[Any]:
    """Return the dtype of a splat in an extra column [N] or [N, C]; it has the shape [C] in the latter case."""
    return np.dtype((column.dtype, column.shape[1:]))


def trusted_model(**values: Any) -> SplatModel:
    """Make a model without the constructor's checks, which take an eighth of the time of a decode.

    The decoder uses it, because its clauses are stricter.

    Args:
        values: fields by name; fields with a default may be omitted.
    """
    required = {attribute.name for attribute in fields(SplatModel) if attribute.default is MISSING}
    assert required <= values.keys() <= {attribute.name for attribute in fields(SplatModel)}
    model: SplatModel = object.__new__(SplatModel)
    for name, value in values.items():
        object.__setattr__(model, name, value)
    return model


def check_model(caller: str, model: object) -> None:
    """Raise an `InputError`, which explains how to make a `SplatModel`, if `model` has another type."""
    if not isinstance(model, SplatModel):
        raise InputError(
            f"{caller} expects a SplatModel, not a {type(model).__name__}: read a file with csplat.read(file)"
        )


def check_sh_degree(sh_degree: int | None) -> None:
    """Raise an `InputError` unless `sh_degree` is `None` or 0 to `MAX_SH_DEGREE`."""
    if sh_degree is not None and not 0 <= sh_degree <= MAX_SH_DEGREE:
        raise InputError(f"sh_degree is {sh_degree}, expected 0 to {MAX_SH_DEGREE}")


def sh_degree_of(coefficient_count: int) -> int:
    """Return the SH degree d of K = (d + 1)**2 - 1 higher coefficients, K being the length of `shN`'s middle axis.

    Raises:
        InputError: K matches no degree up to `MAX_SH_DEGREE`.
    """
    for degree in range(MAX_SH_DEGREE + 1):
        if (degree + 1) ** 2 - 1 == coefficient_count:
            return degree
    raise InputError(f"shN has {coefficient_count} coefficients per channel, expected 0, 3, 8, 15 or 24")


def squared_lengths(quats: NDArray[Any]) -> NDArray[Any]:
    """Return the squared lengths, [N], of quaternions [N, 4], added in a fixed order."""
    w, x, y, z = quats.T
    squared: NDArray[Any] = w * w + x * x + y * y + z * z
    return squared


def normalise_quats(quats: NDArray[Any]) -> F32:
    """Normalise quaternions; a zero quaternion becomes the identity.

    Idempotent: quaternions of unit length, up to float32 rounding, are returned bit for bit.

    Args:
        quats: [N, 4] float32, w x y z, finite, of any length.

    Returns:
        [N, 4] float32, a new array.
    """
    # In float64, huge and denormal values need no special case.
    wide = quats.astype(np.float64)
    squared = squared_lengths(wide)
    zero = squared == 0.0
    length = np.sqrt(squared)
    length[zero] = 1.0
    # Four roundings of half an ulp move the squared length by at most 2**-23.
    length[np.abs(squared - 1.0) <= 2.0**-22] = 1.0
    wide /= length[:, None]
    wide[zero, 0] = 1.0
    return wide.astype(np.float32)


def _check_array(name: str, array: object, shape: tuple[int | str, ...]) -> None:
    """Raise an `InputError` unless an array is float32, finite and of the given shape; a string stands for any size."""
    expected = "[" + ", ".join(str(size) for size in shape) + "]"
    if not isinstance(array, np.ndarray):
        raise InputError(f"{name} is a {type(array).__name__}, expected a float32 array {expected}")
    fits = len(array.shape) == len(shape) and all(
        isinstance(want, str) or have == want for have, want in zip(array.shape, shape, strict=True)
    )
    if not fits:
        raise InputError(f"{name} has shape {list(array.shape)}, expected {expected}")
    if array.dtype != np.float32:
        raise InputError(f"{name} is {array.dtype}, expected float32")
    bad = _non_finite_count(array)
    if bad:
        raise InputError(f"{name} contains NaN or infinity ({counted(bad, 'value')})")


def _non_finite_count(array: F32) -> int:
    """Count NaN and infinities of an array of any shape; a single pass over memory if there are none."""
    with np.errstate(over="ignore", invalid="ignore"):
        if np.isfinite(array.sum(dtype=np.float32)):
            return 0
    # The sum of large finite values may overflow, too. Count in blocks: a mask of the whole array takes memory.
    rows = max(1, _BLOCK // max(1, math.prod(array.shape[1:])))
    return sum(int(np.count_nonzero(~np.isfinite(array[start : start + rows]))) for start in range(0, len(array), rows))


def _check_opacities(opacities: F32) -> None:
    """Raise an `InputError` unless opacities [N] are in [0, 1]."""
    if len(opacities) == 0:
        return
    low, high = float(opacities.min()), float(opacities.max())
    if low < 0.0 or high > 1.0:
        raise InputError(f"opacities range from {low:g} to {high:g}, expected alpha in [0, 1] (not logits)")


def _check_quats(quats: F32) -> None:
    """Raise an `InputError` unless quaternions [N, 4] have unit length within the tolerance."""
    with np.errstate(over="ignore"):
        squared = squared_lengths(quats)
    low, high = (1.0 - QUAT_LENGTH_TOLERANCE) ** 2, (1.0 + QUAT_LENGTH_TOLERANCE) ** 2
    bad = int(np.count_nonzero((squared < low) | (squared > high)))
    if bad:
        raise InputError(f"quats contains {bad} rows that are not of unit length: see normalise_quats")


def _check_extra(extra: Mapping[str, NDArray[Any]], n: int) -> None:
    """Raise an `InputError` unless extra columns are arrays [n] or [n, 2 to 64] of integers or floats."""
    most = _spec.EXTRA_COMPONENTS_MAX
    for name, column in extra.items():
        shape = column.shape if isinstance(column, np.ndarray) else ()
        if shape[:1] != (n,) or len(shape) > 2 or not 2 <= (*shape, 2)[1] <= most:
            remedy = f": split it into columns {name!r}, '{name}_{most}' and so on" if shape[1:] > (most,) else ""
            raise InputError(
                f"extra column {name!r} has shape {shape}, expected ({n},) or ({n}, 2) to ({n}, {most}){remedy}"
            )
        if column.dtype.kind not in "iuf":
            raise InputError(f"extra column {name!r} is {column.dtype}, expected integers or floats")


def _parse_origin(origin: Sequence[float]) -> tuple[float, float, float]:
    """Convert an origin to three floats; raise an `InputError` unless it is three finite numbers."""
    try:
        x, y, z = (float(value) for value in origin)
    except (TypeError, ValueError):
        raise InputError(f"origin is {origin!r}, expected three numbers") from None
    if not all(math.isfinite(value) for value in (x, y, z)):
        raise InputError(f"origin is {origin!r}, expected finite numbers")
    return x, y, z


def _check_doubles(means: F32, doubles: F64, origin: tuple[float, float, float]) -> None:
    """Raise an `InputError` unless `means`, [N, 3], are `doubles`, [N, 3] float64, minus `origin`, rounded."""
    fits = isinstance(doubles, np.ndarray) and doubles.dtype == np.float64 and doubles.shape == means.shape
    if not fits or not np.array_equal((doubles - np.array(origin)).astype(np.float32), means):
        raise InputError("means_double and means disagree: means are float32(means_double - origin)")

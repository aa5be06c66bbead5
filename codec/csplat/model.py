"""Hold a scene of 3D Gaussian splats in memory: `SplatModel`.

All readers, writers, renderers and the codec use it. The constructor checks and never repairs: readers convert their
data first.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import MISSING, dataclass, field, fields, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from csplat.errors import InputError
from csplat.plugins import load_plugins
from csplat.types import F32, F64

#: Highest spherical-harmonics degree of a model.
MAX_SH_DEGREE = 3

#: The basis function of SH degree 0: colour of a channel per coefficient.
SH_C0 = 0.28209479177387814

#: A quaternion counts as unit when its length lies within this of 1.
QUAT_LENGTH_TOLERANCE = 1e-3

#: The coordinate system of a scene whose source did not name one.
UNSPECIFIED = "unspecified"

_AXIS_OF_LETTER = {"R": "x", "L": "x", "U": "y", "D": "y", "F": "z", "B": "z"}
_BLOCK = 1 << 18  # values that are checked at a time if a sum was not finite
_NO_SH: F32 = np.zeros((0, 0, 3), np.float32)


@dataclass(frozen=True, eq=False, repr=False)
class SplatModel:
    """N splats and the metadata that a viewer needs.

    The arrays are not copied and not made read-only; treat them as constant.

    Attributes:
        means: [N, 3] float32, centres in scene units, relative to `origin`.
        quats: [N, 4] float32, rotations w x y z. Their lengths lie within
            `QUAT_LENGTH_TOLERANCE` of 1; `normalise_quats` makes them so.
        scales: [N, 3] float32, natural logarithms of the standard deviations (scene units).
        opacities: [N] float32, alpha in [0, 1] (no logits).
        sh0: [N, 3] float32, spherical-harmonics coefficient of degree 0, red green blue.
        shN: [N, K, 3] float32, the higher coefficients, K = (d + 1)**2 - 1 for d = 0, 1, 2, 3.
            By default none, K = 0.
        origin: what to add to `means`, three float64, scene units. A scene at geographic
            coordinates keeps its float32 precision this way.
        means_double: [N, 3] float64, the centres as the source has them, origin included, where
            `means` are these less the origin, rounded; `None` if `origin` and `means` are exact.
        coordinate_system: `"unspecified"`, or the directions of +x, +y and +z for a person who
            looks at the scene, as three letters of R/L, U/D and F/B: `"RDF"`.
        unit_metres: length of one scene unit in metres; `None` if it is not known.
        antialiased: trained with the mip-splatting low-pass filter; renders must apply it.
        flat: splats are discs (2DGS): the third, smallest scale means nothing.
        cameras: training cameras, each {K, viewmat, W, H, near, image}, viewmat world to camera
            with OpenCV axes, pixel centres at +0.5; `None` if there are none.
        metadata: free, JSON-compatible. Keys in use: `licence` (str), `comments` (list of str),
            `training` (see `csplat.training_record`), `up` (see `csplat.editing.up_axis`), `view`
            (a camera as those of `cameras`, from which the scene is shown first).
        extra: further columns by name, each [N], integer or floating.

    Raises:
        InputError: an array has another shape or dtype, holds NaN or infinity, or is out of
            range; or another field is invalid.
    """

    means: F32
    quats: F32
    scales: F32
    opacities: F32
    sh0: F32
    shN: F32 = field(default_factory=lambda: _NO_SH)
    origin: tuple[float, float, float] = (0.0, 0.0, 0.0)
    coordinate_system: str = UNSPECIFIED
    unit_metres: float | None = None
    antialiased: bool = False
    flat: bool = False
    cameras: Sequence[Mapping[str, Any]] | None = None
    metadata: Mapping[str, Any] = field(default_factory=dict)
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
        object.__setattr__(self, "origin", _checked_origin(self.origin))
        if self.means_double is not None:
            _check_doubles(self.means, self.means_double, self.origin)
        if self.coordinate_system != UNSPECIFIED:
            check_axes(self.coordinate_system)
        unit = self.unit_metres
        if unit is not None and not (math.isfinite(unit) and unit > 0):
            raise InputError(f"unit_metres is {unit}, wanted a length above 0 or None")

    def __len__(self) -> int:
        return len(self.means)

    def __repr__(self) -> str:
        return f"SplatModel({len(self)} splats, sh_degree={self.sh_degree})"

    def _repr_html_(self) -> str | None:
        """Return a scene that can be turned, for a notebook; `None`, for its `repr`, if empty or without the tools."""
        if not len(self):
            return None
        html = load_plugins("csplat.display").get("html")
        shown: str | None = html and html(self)
        return shown

    @property
    def sh_degree(self) -> int:
        """Spherical-harmonics degree, 0 to `MAX_SH_DEGREE`."""
        return sh_degree_of(self.shN.shape[1])

    def select(self, index: NDArray[Any] | slice) -> SplatModel:
        """Keep some splats, in the order of `index`; everything else stays.

        Args:
            index: an index of the first axis of a NumPy array: positions, a mask, a slice.

        Returns:
            A model of the chosen splats (views of this one's arrays for a slice).
        """
        return replace(
            self,
            means=self.means[index],
            quats=self.quats[index],
            scales=self.scales[index],
            opacities=self.opacities[index],
            sh0=self.sh0[index],
            shN=self.shN[index],
            extra={name: column[index] for name, column in self.extra.items()},
            means_double=None if self.means_double is None else self.means_double[index],
        )


def trusted_model(**values: Any) -> SplatModel:
    """Make a model without the constructor's checks, for a caller that has just checked more than they do.

    The constructor passes over every value, an eighth of the time of a decode; the decoder's clauses are stricter.

    Args:
        values: fields by name; those with a default may be left out.
    """
    required = {one.name for one in fields(SplatModel) if one.default is MISSING}
    assert required <= values.keys() <= {one.name for one in fields(SplatModel)}
    model: SplatModel = object.__new__(SplatModel)
    for name, value in values.items():
        object.__setattr__(model, name, value)
    return model


def check_model(caller: str, model: object) -> None:
    """Refuse anything but a model, with a hint how to make one.

    Raises:
        InputError: it is not a model.
    """
    if not isinstance(model, SplatModel):
        raise InputError(
            f"{caller} takes a SplatModel, not a {type(model).__name__}: csplat.read_ply(file) makes one of a PLY,"
            " csplat.decode(file) of a .csplat file"
        )


def check_sh_degree(sh_degree: int | None) -> None:
    """Refuse a highest SH band out of range.

    Raises:
        InputError: it is neither `None` nor 0 to `MAX_SH_DEGREE`.
    """
    if sh_degree is not None and not 0 <= sh_degree <= MAX_SH_DEGREE:
        raise InputError(f"sh_degree is {sh_degree}, expected 0 to {MAX_SH_DEGREE}")


def sh_degree_of(coefficient_count: int) -> int:
    """Return the spherical-harmonics degree of K higher coefficients.

    Args:
        coefficient_count: K, the length of the middle axis of `shN`.

    Returns:
        d with K = (d + 1)**2 - 1.

    Raises:
        InputError: K belongs to no degree up to `MAX_SH_DEGREE`.
    """
    for degree in range(MAX_SH_DEGREE + 1):
        if (degree + 1) ** 2 - 1 == coefficient_count:
            return degree
    raise InputError(f"shN has {coefficient_count} coefficients per channel, wanted 0, 3, 8 or 15")


def normalise_quats(quats: NDArray[Any]) -> F32:
    """Bring quaternions to unit length; a zero quaternion becomes the identity.

    Quaternions that are unit already, as nearly as float32 can represent, stay as they are, bit for
    bit: so doing it twice changes nothing. Huge and denormal ones are no special case in float64.

    Args:
        quats: [N, 4] float32, w x y z, finite, of any length.

    Returns:
        [N, 4] float32, a new array.
    """
    wide = quats.astype(np.float64)
    squared = np.einsum("ij,ij->i", wide, wide)
    zero = squared == 0.0
    length = np.sqrt(squared)
    length[zero] = 1.0
    # Four roundings of half an ulp move the squared length by at most 2**-23.
    length[np.abs(squared - 1.0) <= 2.0**-22] = 1.0
    wide /= length[:, None]
    wide[zero, 0] = 1.0
    return wide.astype(np.float32)


def _check_array(name: str, array: F32, shape: tuple[int | str, ...]) -> None:
    wanted = "[" + ", ".join(str(size) for size in shape) + "]"
    if not isinstance(array, np.ndarray):
        raise InputError(f"{name} is a {type(array).__name__}, wanted a float32 array {wanted}")
    fits = len(array.shape) == len(shape) and all(
        isinstance(want, str) or have == want for have, want in zip(array.shape, shape, strict=True)
    )
    if not fits:
        raise InputError(f"{name} has shape {list(array.shape)}, wanted {wanted}")
    if array.dtype != np.float32:
        raise InputError(f"{name} is {array.dtype}, wanted float32")
    bad = _non_finite_count(array)
    if bad:
        raise InputError(f"{name} holds {bad} values that are NaN or infinite")


def _non_finite_count(array: F32) -> int:
    """Count NaN and infinities; one pass over memory if there are none."""
    with np.errstate(over="ignore", invalid="ignore"):
        if np.isfinite(array.sum(dtype=np.float32)):
            return 0  # a NaN or an infinity would have shown in the sum
    # Large finite values can overflow the sum too: look at each, without a mask of the whole.
    rows = max(1, _BLOCK // max(1, math.prod(array.shape[1:])))
    return sum(int(np.count_nonzero(~np.isfinite(array[start : start + rows]))) for start in range(0, len(array), rows))


def _check_opacities(opacities: F32) -> None:
    if len(opacities) == 0:
        return
    low, high = float(opacities.min()), float(opacities.max())
    if low < 0.0 or high > 1.0:
        raise InputError(f"opacities reach from {low:g} to {high:g}, wanted alpha in [0, 1] (not logits)")


def _check_quats(quats: F32) -> None:
    with np.errstate(over="ignore"):
        squared = np.einsum("ij,ij->i", quats, quats)
    low, high = (1.0 - QUAT_LENGTH_TOLERANCE) ** 2, (1.0 + QUAT_LENGTH_TOLERANCE) ** 2
    bad = int(np.count_nonzero((squared < low) | (squared > high)))
    if bad:
        raise InputError(f"quats holds {bad} rows that are not unit length: see normalise_quats")


def _check_extra(extra: Mapping[str, NDArray[Any]], n: int) -> None:
    for name, column in extra.items():
        if not isinstance(column, np.ndarray) or column.shape != (n,):
            raise InputError(f"extra column {name!r} is not an array of {n} values")
        if column.dtype.kind not in "iuf":
            raise InputError(f"extra column {name!r} is {column.dtype}, wanted integers or floats")


def _checked_origin(origin: Sequence[float]) -> tuple[float, float, float]:
    try:
        x, y, z = (float(value) for value in origin)
    except (TypeError, ValueError):
        raise InputError(f"origin is {origin!r}, wanted three numbers") from None
    if not all(math.isfinite(value) for value in (x, y, z)):
        raise InputError(f"origin is {origin!r}, wanted finite numbers")
    return x, y, z


def _check_doubles(means: F32, doubles: F64, origin: tuple[float, float, float]) -> None:
    """Refuse doubles of which the means are not the rounding: changed means need other doubles or none."""
    fits = isinstance(doubles, np.ndarray) and doubles.dtype == np.float64 and doubles.shape == means.shape
    if not fits or not np.array_equal((doubles - np.array(origin)).astype(np.float32), means):
        raise InputError("means_double is not the centres of which means are the float32 less the origin")


def check_axes(letters: str) -> None:
    """Refuse letters that are not directions of +x, +y and +z.

    Raises:
        InputError: they are not three letters, one each of R/L, U/D and F/B.
    """
    axes = {_AXIS_OF_LETTER.get(letter) for letter in letters}
    if len(letters) != 3 or axes != {"x", "y", "z"}:
        raise InputError(f"the axes are {letters!r}, wanted three letters, one each of R/L, U/D and F/B, as RDF")

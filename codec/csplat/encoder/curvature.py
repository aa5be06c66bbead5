"""Squared error of renders caused by errors of a splat's values, and by rounding to the steps of a plan."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from csplat.encoder.measure import rotation_rows
from csplat.encoder.plan import Plan
from csplat.encoder.statistics import COLOUR_PER_SH0
from csplat.errors import InputError
from csplat.model import SplatModel
from csplat.types import F64

Floats = NDArray[np.floating]

#: Attributes whose steps may differ from grade to grade, and how many integers each has.
GRADED = {"opacities": 1, "scales": 3, "quats": 3, "means": 3, "sh0": 3}

_BLOCK = 1 << 14  # splats at a time
_TRIANGLE = 21  # entries of a symmetric matrix of 6 by 6
_UNIFORM = 1.0 / 12.0  # squared error of rounding, in squared steps
_ROOT2 = 2.0**0.5


@dataclass(frozen=True, eq=False)
class Curvatures:
    """Diagonals and blocks of the Gauss-Newton matrix of pictures, by splat.

    Errors e of a value add c e² to the squared error of pictures, averaged over pixels and channels.

    Attributes:
        opacities: [N], c of alpha.
        shapes: [N, 21], c of the covariance divided by its trace: upper triangles, row by row, over xx, yy, zz, √2 xy,
            √2 xz, √2 yz.
        means: [N], c of all three coordinates when each of them errs by e scene units in its own direction.
        colours: [N], c of the colour, all of whose channels err by e.
    """

    opacities: Floats
    shapes: Floats
    means: Floats
    colours: Floats

    def select(self, rows: NDArray[np.intp]) -> Curvatures:
        """The same for some of the splats."""
        return Curvatures(*(getattr(self, one.name)[rows] for one in fields(self)))

    def check(self, count: int) -> None:
        """Refuse what is not about `count` splats, negative or not finite."""
        for one in fields(self):
            array = getattr(self, one.name)
            wanted = (count, _TRIANGLE) if one.name == "shapes" else (count,)
            if array.shape != wanted or array.dtype.kind != "f":
                found = f"{array.dtype} {list(array.shape)}"
                raise InputError(f"curvatures of {one.name} are {found}, wanted floats {list(wanted)}")
            if not np.isfinite(array).all() or (one.name != "shapes" and (array < 0.0).any()):
                raise InputError(f"curvatures of {one.name} are negative or not finite")


def step_errors(model: SplatModel, curvatures: Curvatures, plan: Plan) -> F64:
    """Estimate the squared error of renders that rounding to the plan's lattices adds, in linear approximation.

    Args:
        model: the scene.
        curvatures: curvatures of its splats.
        plan: the lattices.

    Returns:
        [N, 5] float64, >= 0, by splat and attribute, in the order of `GRADED`; four times as much for twice the step.
        Not finite if a scene is so large that squares leave float64.
    """
    errors = np.empty((len(model), len(GRADED)))
    squared_levels = float(plan.opacity_levels) ** 2
    # Squared error that the RGB channels get from rounding Y, Co and Cg, in squared steps.
    seen = COLOUR_PER_SH0**2 * (1.0 + 4.0**plan.chroma_shift * (1.0 / 4.0 + 1.0 / 6.0))
    # A component of a quaternion errs by half the angle.
    angle = 2.0 / (plan.quat_levels * np.sqrt(2.0))
    with np.errstate(over="ignore", invalid="ignore"):
        steps = np.square(np.array([plan.scale_step, angle, plan.lattice.step, plan.sh0_step], np.float64))
        alpha = np.maximum(model.opacities.astype(np.float64), 0.25 / squared_levels)
        errors[:, 0] = curvatures.opacities * alpha * (4.0 / squared_levels)  # alpha = q² / M²
        errors[:, 3] = curvatures.means.astype(np.float64) * steps[2]
        errors[:, 4] = curvatures.colours * (seen * steps[3])
        for at in range(0, len(model), _BLOCK):
            part = slice(at, at + _BLOCK)
            sizes, turns = _shape_curvatures(model, curvatures, part)
            errors[part, 1], errors[part, 2] = sizes * steps[0], turns * steps[1]
        errors *= _UNIFORM
    return np.maximum(errors, 0.0, out=errors)


def _shape_curvatures(model: SplatModel, curvatures: Curvatures, part: slice) -> tuple[F64, F64]:
    """Return the summed curvatures of the three log scales and of the three angles, [n] each."""
    axes = [np.stack(axis) for axis in zip(*rotation_rows(model.quats[part].T), strict=True)]
    scales = model.scales[part].T.astype(np.float64)
    variances = np.exp(2.0 * (scales - scales.max(axis=0)))
    variances /= variances.sum(axis=0)
    triangles = curvatures.shapes[part].T.astype(np.float64)
    sizes, turns = np.zeros(scales.shape[1]), np.zeros(scales.shape[1])
    for first in range(3):
        second = (first + 1) % 3
        sizes += _form(triangles, variances[first] * _product(axes[first], axes[first]))
        turns += _form(triangles, (variances[first] - variances[second]) * _product(axes[first], axes[second]))
    return sizes, turns


def _product(a: F64, b: F64) -> F64:
    """Entries xx, yy, zz, √2 xy, √2 xz, √2 yz of a bᵀ + b aᵀ, [6, n]."""
    square = [2.0 * a[i] * b[i] for i in range(3)]
    mixed = [_ROOT2 * (a[i] * b[j] + a[j] * b[i]) for i, j in ((0, 1), (0, 2), (1, 2))]
    return np.stack(square + mixed)


def _form(triangles: F64, vectors: F64) -> F64:
    """vᵀ H v, [n], of upper triangles [21, n] and vectors [6, n]."""
    total = np.zeros(vectors.shape[1])
    for place, (i, j) in enumerate(zip(*np.triu_indices(6), strict=True)):
        total += (1.0 if i == j else 2.0) * triangles[place] * vectors[i] * vectors[j]
    return total

# SPDX-License-Identifier: Apache-2.0
"""References for the rasteriser: random and adversarial splats, the exact twin, finite differences."""

from dataclasses import dataclass
from types import SimpleNamespace

import numpy as np

from csplat_render import Camera
from csplat_render.conventions import UncheckedSplats
from csplat_render.rasteriser import Rasteriser
from csplat_render.reference_rasteriser import Decisions, render_exact

#: Groups of parameters, in the order of `UncheckedSplats`.
GROUPS = ("means", "quats", "scales", "opacities", "sh0", "shN")

# A rotated camera with an off-centre principal point, so close that some splats are out of view.
VIEW = Camera(
    [[30.0, 0.0, 12.5], [0.0, 28.0, 9.0], [0.0, 0.0, 1.0]],
    [[0.98006658, 0.0, 0.19866933, 0.05], [0.0, 1.0, 0.0, -0.03], [-0.19866933, 0.0, 0.98006658, 1.6], [0, 0, 0, 1.0]],
    25,
    19,
)

_STEP = 1e-5  # step of finite differences, whose error is about its square
_FLIPPED = 1e-4  # a larger difference of colours means that a comparison has another result


@dataclass(frozen=True, eq=False)
class Case:
    """Splats that break rasterisers, arrays of float32; gradients that exceed float32 only have to be finite."""

    arrays: dict
    view: Camera
    antialiased: bool = False
    beyond: bool = False


def difference(picture, exact):
    """Compare renders: largest and mean difference of a component, and the share of pixels with more than 1/255."""
    error = np.abs(np.asarray(picture, np.float64) - exact)
    return SimpleNamespace(most=error.max(), share=np.mean(error.max(2) > 1 / 255), mean=error.mean())


def facing(focal=40.0, near=0.2, distance=3.0, width=50, height=37):
    """Return a camera on the z axis that looks at the origin."""
    viewmat = np.eye(4)
    viewmat[2, 3] = distance
    return Camera([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]], viewmat, width, height, near=near)


def random_splats(count, degree, seed):
    rng = np.random.default_rng(seed)
    return {
        "means": rng.uniform((-1.1, -0.9, -0.6), (1.1, 0.9, 0.9), (count, 3)), "quats": rng.standard_normal((count, 4)),
        "scales": rng.uniform(-3.0, -0.8, (count, 3)), "opacities": rng.uniform(0.2, 1.0, count),
        "sh0": rng.standard_normal((count, 3)), "shN": 0.4 * rng.standard_normal((count, (degree + 1) ** 2 - 1, 3)),
    }  # fmt: skip


def random_gradients(view, seed):
    rng, size = np.random.default_rng(seed), (view.H, view.W)
    return rng.standard_normal((*size, 3)), rng.standard_normal(size), rng.standard_normal(size)


def relative_error(value, wanted):
    """Return the L2 norm of the difference relative to the expected value, or to 1e-30 if that is larger."""
    off = np.linalg.norm(np.asarray(value, np.float64) - wanted)
    return float(off / max(1e-30, float(np.linalg.norm(wanted))))


def gradients_of(splats, view, weights, **options):
    rasteriser = Rasteriser()
    picture = rasteriser.forward(splats, view, **options)
    return picture, rasteriser.backward(*weights)


def finite_differences(arrays, view, weights, **options):
    """Return the twin's render, and the slopes of the weighted sum of its values with all comparisons fixed."""
    decisions = Decisions()
    picture = render_exact(UncheckedSplats(**arrays), view, decisions=decisions, **options)

    def loss(group, index, step):
        changed = arrays[group].copy()
        changed[index] += step
        decisions.replay()
        result = render_exact(UncheckedSplats(**{**arrays, group: changed}), view, decisions=decisions, **options)
        return sum(np.sum(a * b) for a, b in zip((result.rgb, result.alpha, result.depth), weights, strict=True))

    slopes = {group: np.zeros_like(arrays[group]) for group in GROUPS}
    for group, slope in slopes.items():
        for index in np.ndindex(slope.shape):
            slope[index] = (loss(group, index, _STEP) - loss(group, index, -_STEP)) / (2.0 * _STEP)
    return picture, slopes


def gradient_errors(arrays, view, weights, reference, **options):
    """Compare gradients with those of a reference; return a number of pixels, and relative errors by parameter.

    If a comparison, such as alpha against 1/255, has another result in float32, a pixel gives one splat another
    gradient. For each such pixel the splat with the largest difference is left out.
    """
    picture, found = gradients_of(UncheckedSplats(**arrays), view, weights, **options)
    exact, wanted = reference({name: a.astype(np.float64) for name, a in arrays.items()}, view, weights, **options)
    flipped = int(np.count_nonzero(np.abs(picture.rgb - getattr(exact, "rgb", exact)).max(2) > _FLIPPED))
    errors = {}
    for group in GROUPS:
        value, target = (np.asarray(one, np.float64).reshape(len(arrays["means"]), -1)
                         for one in (getattr(found, group), wanted[group]))  # fmt: skip
        kept = np.argsort(np.square(value - target).sum(1))[: max(0, len(value) - flipped)]
        errors[group] = relative_error(value[kept], target[kept])
    return flipped, errors


def extreme_splats(count=64, degree=1, seed=0, **fields):
    """Return random splats around the origin, float32; `fields` are values common to all."""
    rng = np.random.default_rng(seed)
    arrays = {
        "means": rng.uniform(-1.0, 1.0, (count, 3)), "quats": rng.standard_normal((count, 4)),
        "scales": rng.uniform(-4.0, -1.0, (count, 3)), "opacities": rng.random(count),
        "sh0": rng.standard_normal((count, 3)), "shN": rng.standard_normal((count, (degree + 1) ** 2 - 1, 3)),
    }  # fmt: skip
    arrays.update({name: np.broadcast_to(value, arrays[name].shape) for name, value in fields.items()})
    return {name: np.array(value, np.float32) for name, value in arrays.items()}


def adversarial():
    """Yield named cases: long and thin, far and near, tiny and huge."""
    shapes = {
        "needle": (0.0, -13.8, -13.8), "disc": (0.0, 0.0, -13.8), "large needle": (4.0, -9.8, -9.8),
        "large disc": (4.0, 4.0, -9.8), "huge needle": (9.0, -4.8, -4.8),
    }  # fmt: skip
    for name, scales in shapes.items():
        yield name, Case(extreme_splats(scales=scales), facing())
        yield f"{name}, antialiased", Case(extreme_splats(scales=scales), facing(), antialiased=True)
    yield "camera inside", Case(extreme_splats(scales=(1.0, 0.5, 0.2)), facing(distance=0.0))
    for near in (1e-30, 1e-6, 0.2, 3.0):
        arrays = extreme_splats(count=80)
        arrays["means"][:40, 2] = np.float32(near) * np.linspace(0.5, 2.0, 40)
        arrays["means"][40:, 2] = np.linspace(-4.0, 4.0, 40)
        yield f"at a near plane of {near:g}", Case(arrays, facing(near=near, distance=0.0), beyond=near < 1e-20)
    for alpha in (0.0, 1.0):
        yield f"alpha {alpha:g}", Case(extreme_splats(opacities=alpha), facing())
    for scale in (-60.0, 60.0):
        yield f"log-scales {scale:g}", Case(extreme_splats(scales=scale), facing())
    mixed = extreme_splats()
    mixed["scales"][:, :2] = 60.0, -60.0
    yield "log-scales 60 and -60", Case(mixed, facing(), antialiased=True, beyond=True)
    for focal in (1e-6, 1e-2, 1e4, 1e9):
        yield f"focal length {focal:g}", Case(extreme_splats(), facing(focal=focal))
    for far in (1e-20, 1e20, 1e37):
        arrays = extreme_splats()
        arrays["means"] *= np.float32(far)
        arrays["scales"] += np.float32(np.log(far))
        yield f"{far:g} times as large", Case(arrays, facing(near=far * 1e-3, distance=3 * far), beyond=far > 1e30)

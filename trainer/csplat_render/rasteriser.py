# SPDX-License-Identifier: Apache-2.0
"""`Rasteriser`: render splats, and compute sums and gradients with respect to them, on all threads of a CPU.

The passes are written in C++, see `native`.
"""

from __future__ import annotations

import ctypes
import threading
import weakref
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from csplat.context import DEFAULT_CONTEXT, Context
from csplat.errors import InputError, LimitError
from csplat.types import F32, F64, I64, Mask
from csplat_render.camera import Camera
from csplat_render.conventions import (
    Array,
    Gradients,
    HasSplats,
    Mode,
    RenderResult,
    UncheckedSplats,
    VisibleSplats,
    checked_background,
    checked_degree,
    checked_splats,
    thresholds_of,
    view_vector,
)
from csplat_render.kernels import address, call, create, destroy, thread_count

#: Maximum number of pairs of splat and tile in one image. A pair takes 12 bytes, 20 with pruning errors, 52 with
#: gradients, 168 with derivatives.
MAX_INTERSECTIONS = 1 << 28

#: Names of the arrays that `Rasteriser.descend` changes, in the order of `UncheckedSplats`.
FITTED = ("means", "quats", "scales", "logits", "sh0", "shN")


class _Splats(ctypes.Structure):
    """`Splats` of `native/renderer.h`."""

    _fields_ = [
        *((name, ctypes.c_int64) for name in ("count", "degree", "coefficients", "logits")),
        *((name, ctypes.c_void_p) for name in ("means", "quats", "scales", "opacities", "sh0", "shN")),
    ]


class _View(ctypes.Structure):
    """`View` of `native/renderer.h`."""

    _fields_ = [
        ("camera", ctypes.c_double * 24),
        *((name, ctypes.c_double) for name in ("alpha_min", "transmittance_min")),
        ("background", ctypes.c_double * 3),
        *((name, ctypes.c_int64) for name in ("width", "height", "antialiased")),
    ]


class _Group(ctypes.Structure):
    """`Group` of `native/renderer.h`."""

    _fields_ = [*((name, ctypes.c_void_p) for name in ("values", "first", "second")), ("rate", ctypes.c_double)]


class _Step(ctypes.Structure):
    """`Step` of `native/renderer.h`."""

    _fields_ = [
        ("groups", _Group * len(FITTED)),
        *((name, ctypes.c_double) for name in ("over_root", "beta2", "opacity_weight", "scale_weight")),
        *((name, ctypes.c_void_p) for name in ("mean_sizes", "means2d")),
        ("fitted_count", ctypes.c_int64),
    ]


@dataclass(frozen=True, eq=False)
class AdamStep:
    """A step of Adam on splats, also on those that a view does not show, see `csplat_trainer.parameters.adam_step`.

    Attributes:
        values, first, second: the arrays by the names in `FITTED`, C-contiguous float32, changed in place. Means and
            shN may be absent, and are then not fitted.
        rates: learning rate of each group, divided by 1 − β1^step.
        over_root: 1 / √(1 − β2^step).
        beta2: β2.
        opacity_weight: weight of the sum of opacities, a regulariser.
        scale_weight: weight of the sum of standard deviations.
        mean_sizes: [N] float32, factor of the step of each mean; `None`: 1.
        means2d: [N] float32, written: the norms of `Gradients.means2d`; `None`: not needed.
        fitted_count: number of splats to fit, the first ones; `None`: all.
    """

    values: Mapping[str, F32]
    first: Mapping[str, F32]
    second: Mapping[str, F32]
    rates: Mapping[str, float]
    over_root: float
    beta2: float
    opacity_weight: float = 0.0
    scale_weight: float = 0.0
    mean_sizes: F32 | None = None
    means2d: F32 | None = None
    fitted_count: int | None = None

    def as_c(self, splats: UncheckedSplats) -> _Step:
        """Return the step for the library; its values have the shapes of these splats."""
        shapes = dict(zip(FITTED, (array.shape for array in vars(splats).values()), strict=True))
        assert shapes.keys() - {"means", "shN"} <= self.values.keys()
        for arrays in (self.values, self.first, self.second):
            assert all(arrays[name].shape == shapes[name] for name in FITTED if name in arrays)
            assert all(arrays[name].dtype == np.float32 for name in FITTED if name in arrays)
        for extra in (self.mean_sizes, self.means2d):
            assert extra is None or (extra.shape == shapes["logits"] and extra.dtype == np.float32)
        step = _Step()
        for group, name in zip(step.groups, FITTED, strict=True):
            if name in self.values:
                group.values, group.first, group.second = (
                    address(arrays[name]) for arrays in (self.values, self.first, self.second)
                )
                group.rate = self.rates[name]
        for name in ("over_root", "beta2", "opacity_weight", "scale_weight"):
            setattr(step, name, getattr(self, name))
        step.mean_sizes, step.means2d = address(self.mean_sizes), address(self.means2d)
        step.fitted_count = len(self.values["logits"]) if self.fitted_count is None else self.fitted_count
        return step


@dataclass(frozen=True, eq=False)
class _Projection:
    """Splats that the renderer has projected: the arrays, and the library's structures for them and the view."""

    splats: UncheckedSplats
    c_splats: _Splats
    c_view: _View
    size: tuple[int, int]
    radii: F32
    drawn: int
    intersections: int
    ignored: int


class Rasteriser:
    """A renderer of splats with gradients, which reuses its memory from one image to the next.

    Calls by several threads run one after the other.

    Args:
        mode: `standard`; or `fast`, which omits alpha below 1.5/255 and light of a transmittance below 1/255. It takes
            10 to 20 % less time, with PSNRs of 40 to 52 dB on trained scenes.
        transmittance_min: transmittance at which a pixel is finished; `None`: that of the mode.
        context: threads.

    Raises:
        InputError: the mode does not exist, or the compiled library is missing.
    """

    def __init__(
        self,
        mode: Mode = "standard",
        *,
        transmittance_min: float | None = None,
        context: Context = DEFAULT_CONTEXT,
    ) -> None:
        self._alpha_min, least = thresholds_of(mode)
        self._transmittance_min = least if transmittance_min is None else transmittance_min
        self.context = context
        self._handle = create("renderer")
        weakref.finalize(self, destroy, "renderer", self._handle).atexit = False
        self._lock = threading.RLock()
        self._last: _Projection | None = None
        self._gradients: Gradients | None = None

    def forward(
        self,
        splats: HasSplats,
        camera: Camera,
        *,
        background: ArrayLike = (0.0, 0.0, 0.0),
        antialiased: bool = False,
        sh_degree: int | None = None,
        state: F32 | None = None,
        logits: bool = False,
    ) -> RenderResult:
        """Render an image.

        Splats may be rendered in slices of depth, nearest first, that pass on a `state`. The last image then equals the
        image of all splats, bit for bit.

        Args:
            splats: the splats to render; arrays of another dtype are converted to float32.
            camera: the camera to render from.
            background: red, green, blue of the background.
            antialiased: compensate for the dilation by scaling opacities (mip-splatting).
            sh_degree: highest SH degree; `None`: the splats' own degree.
            state: [H, W, 5] float32, from `initial_state`, updated: the pixels after all slices so far. `None`: there
                are no slices.
            logits: the opacities of the splats are logits.

        Returns:
            The image, in new arrays; for a slice, the image so far and the counts of the slice.

        Raises:
            InputError: array shapes do not match, or an option is invalid.
            LimitError: there are more than `MAX_INTERSECTIONS`.
        """
        size = (camera.H, camera.W)
        if state is not None and (
            state.shape != (*size, 5) or state.dtype != np.float32 or not state.flags.c_contiguous
        ):
            raise InputError(f"the state has shape {list(state.shape)}, expected {[*size, 5]} of float32, C-contiguous")
        with self._running():
            p = self._project(splats, camera, background, antialiased=antialiased, sh_degree=sh_degree, logits=logits)
            rgb = np.empty((*size, 3), np.float32)
            transmittance, depth = np.empty(size, np.float32), np.empty(size, np.float32)
            call("render", self._handle, p.c_view, len(p.splats.means), state, rgb, transmittance, depth)
        self._last = p if state is None else None  # gradients require all splats at once
        return RenderResult(rgb, 1 - transmittance, depth, p.radii, p.drawn, p.intersections, p.ignored)

    def initial_state(self, camera: Camera) -> F32:
        """Return the `state` of an image before its first slice."""
        state = np.zeros((camera.H, camera.W, 5), np.float32)
        state[..., 0] = 1
        return state

    def find_visible(self, splats: HasSplats, camera: Camera, *, antialiased: bool = False) -> VisibleSplats:
        """Find the splats that a render would show, however many, and their depths; arguments as for `forward`."""
        with self._running():
            p = self._project(splats, camera, (0.0, 0.0, 0.0), antialiased=antialiased, limited=False)
            n = len(p.splats.means)
            near, tiles = np.empty(n, np.float32), np.empty(n, np.int32)
            call("visible", self._handle, n, near, tiles)
        return VisibleSplats(near, tiles, p.ignored)

    def backward(
        self, grad_rgb: ArrayLike, grad_alpha: ArrayLike | None = None, grad_depth: ArrayLike | None = None
    ) -> Gradients:
        """Compute the gradients of a loss with respect to the splats of the last `forward`.

        Args:
            grad_rgb: [H, W, 3], gradient with respect to the image.
            grad_alpha: [H, W], gradient with respect to alpha; `None`: 0.
            grad_depth: [H, W], gradient with respect to depth; `None`: 0.

        Raises:
            InputError: there was no `forward` of all splats, or an array does not have the shape of its image.
        """
        with self._running():
            last = self._last_projection()
            g_rgb = _checked_gradient("grad_rgb", grad_rgb, (*last.size, 3))
            g_alpha = None if grad_alpha is None else _checked_gradient("grad_alpha", grad_alpha, last.size)
            g_depth = None if grad_depth is None else _checked_gradient("grad_depth", grad_depth, last.size)
            g = self._gradients_of(last)
            call(
                "gradients", self._handle, last.c_splats, last.c_view, g_rgb, g_alpha, g_depth,
                g.means, g.quats, g.scales, g.opacities, g.sh0, g.shN, g.means2d,
            )  # fmt: skip
        return g

    def descend(self, step: AdamStep, gradient: F32) -> None:
        """Make a step along the gradient of a loss; the values of the step were rendered by the last `forward`.

        Args:
            step: the step; `values` are the arrays that were rendered, with logits.
            gradient: [H, W, 3], gradient of the loss with respect to the image.

        Raises:
            InputError: there was no `forward` of all splats, or the gradient does not have the shape of its image.
        """
        with self._running():
            last = self._last_projection()
            assert last.c_splats.logits
            self._step(last, step, None, _checked_gradient("the gradient", gradient, (*last.size, 3)))
            self._last = None

    def refit(
        self,
        splats: UncheckedSplats,
        camera: Camera,
        reference: F32,
        step: AdamStep,
        *,
        background: ArrayLike = (0.0, 0.0, 0.0),
        antialiased: bool = False,
    ) -> float:
        """Make a step along the gradient of half the squared error of a render, in one pass over the image.

        Render and reference are clipped to 0..1; the gradient passes through the clipping.

        Args:
            splats: the splats, C-contiguous float32, opacities as logits; with the arrays of the step.
            camera, background, antialiased: as for `forward`.
            reference: [H, W, 3].
            step: the step.

        Returns:
            The sum of squared errors before the step.

        Raises:
            InputError: array shapes do not match.
            LimitError: there are more than `MAX_INTERSECTIONS`.
        """
        target = _checked_gradient("the reference", reference, (camera.H, camera.W, 3))
        with self._running():
            p = self._project(splats, camera, background, antialiased=antialiased, logits=True, counts=False)
            return self._step(p, step, target, None)

    def error_gradients(
        self,
        splats: HasSplats,
        camera: Camera,
        reference: F32,
        *,
        background: ArrayLike = (0.0, 0.0, 0.0),
        antialiased: bool = False,
    ) -> tuple[float, Gradients]:
        """Compute the gradients of half the squared error of a render, in one pass over the image, as `refit` does.

        Args:
            splats, camera, background, antialiased: as for `forward`.
            reference: [H, W, 3].

        Returns:
            The sum of squared errors, and the gradients; those of means are 0.

        Raises:
            InputError: array shapes do not match.
            LimitError: there are more than `MAX_INTERSECTIONS`.
        """
        target = _checked_gradient("the reference", reference, (camera.H, camera.W, 3))
        error = np.zeros(1)
        with self._running():
            p = self._project(splats, camera, background, antialiased=antialiased, counts=False)
            g = self._gradients_of(p)
            g.means[:], g.means2d[:] = 0.0, 0.0
            call(
                "error_gradients", self._handle, p.c_splats, p.c_view, target, error,
                g.quats, g.scales, g.opacities, g.sh0, g.shN,
            )  # fmt: skip
        return float(error[0]), g

    def measure_pruning(
        self,
        splats: HasSplats,
        camera: Camera,
        errors: F64,
        seen: Mask,
        *,
        background: ArrayLike = (0.0, 0.0, 0.0),
        antialiased: bool = False,
    ) -> F32:
        """Measure the squared change of a render without each splat, and add it to sums; see `pruning_error`.

        Args:
            splats, camera, background, antialiased: as for `forward`.
            errors: [N], incremented.
            seen: [N], set for splats that are visible.

        Returns:
            [H, W, 3], the render.

        Raises:
            InputError: array shapes do not match.
            LimitError: there are more than `MAX_INTERSECTIONS`.
        """
        n = len(splats.means)
        assert errors.shape == seen.shape == (n,)
        assert errors.dtype == np.float64
        assert seen.dtype == np.bool_
        rgb = np.empty((camera.H, camera.W, 3), np.float32)
        with self._running():
            p = self._project(splats, camera, background, antialiased=antialiased, counts=False)
            call("measure_pruning", self._handle, p.c_view, n, rgb, errors, seen)
        return rgb

    def add_derivatives(
        self,
        splats: HasSplats,
        camera: Camera,
        sums: Sequence[Array | None],
        *,
        background: ArrayLike = (0.0, 0.0, 0.0),
        antialiased: bool = False,
    ) -> None:
        """Add the derivatives of a render with respect to each splat to sums.

        Args:
            splats, camera, background, antialiased: as for `forward`.
            sums: scratch and sums of `csplat_add_derivatives` in `native/sensitivity.cpp`.

        Raises:
            InputError: array shapes do not match.
            LimitError: there are more than `MAX_INTERSECTIONS`.
        """
        with self._running():
            p = self._project(splats, camera, background, antialiased=antialiased, counts=False)
            call("add_derivatives", self._handle, p.c_splats, p.c_view, *sums)

    @contextmanager
    def _running(self) -> Iterator[None]:
        """Wait for calls by other threads, and set the number of threads."""
        with self._lock, thread_count(self.context.threads):
            yield

    def _project(
        self,
        splats: HasSplats,
        camera: Camera,
        background: ArrayLike,
        *,
        antialiased: bool,
        sh_degree: int | None = None,
        logits: bool = False,
        counts: bool = True,
        limited: bool = True,
    ) -> _Projection:
        """Project the splats of a view.

        Args:
            splats, camera, background, antialiased, sh_degree, logits: as for `forward`.
            counts: compute radii, and count splats with NaN or infinity.
            limited: refuse more than `MAX_INTERSECTIONS`.

        Raises:
            InputError: array shapes do not match.
            LimitError: there are more than `MAX_INTERSECTIONS`.
        """
        self._last = None
        a = checked_splats(splats)
        n, coefficients = a.shN.shape[:2]
        degree = checked_degree(sh_degree, coefficients)
        c_splats = _Splats(n, degree, coefficients, int(logits), *(address(array) for array in vars(a).values()))
        colour = checked_background(background)
        c_view = _View(
            (ctypes.c_double * 24)(*view_vector(camera)), self._alpha_min, self._transmittance_min,
            (ctypes.c_double * 3)(*colour), camera.W, camera.H, int(antialiased),
        )  # fmt: skip
        radii = np.empty(n if counts else 0, np.float32)
        found: I64 = np.zeros(2, np.int64)
        total = call("project", self._handle, c_splats, c_view, *((radii, found) if counts else (None, None)))
        if limited and total > MAX_INTERSECTIONS:
            raise LimitError("MAX_INTERSECTIONS", total, MAX_INTERSECTIONS)
        size = (camera.H, camera.W)
        return _Projection(a, c_splats, c_view, size, radii, int(found[0]), total, int(found[1]))

    def _last_projection(self) -> _Projection:
        """Return the last `forward`; raise an `InputError` if there is none, or it was a slice."""
        if self._last is None:
            raise InputError("gradients require a forward of all splats before them")
        return self._last

    def _gradients_of(self, p: _Projection) -> Gradients:
        """Return arrays for the gradients of splats, those of the last call if they fit."""
        old = self._gradients
        if old is None or old.shN.shape != p.splats.shN.shape:
            arrays = {name: np.empty_like(array) for name, array in vars(p.splats).items()}
            old = Gradients(**arrays, means2d=np.empty_like(p.splats.opacities), radii=p.radii)
        self._gradients = replace(old, radii=p.radii)
        return self._gradients

    def _step(self, p: _Projection, step: AdamStep, *arrays: F32 | None) -> float:
        """Make a step, and return the squared error, 0 without a reference; `arrays` are those of `csplat_step`."""
        error = np.zeros(1)
        call("step", self._handle, p.c_splats, p.c_view, *arrays, step.as_c(p.splats), error)
        return float(error[0])


def _checked_gradient(name: str, gradient: ArrayLike, shape: Sequence[int]) -> F32:
    """Return a C-contiguous float32 array; raise an `InputError` for another shape."""
    array = np.ascontiguousarray(gradient, np.float32)
    if array.shape != tuple(shape):
        raise InputError(f"{name} has shape {list(array.shape)}, expected {list(shape)}")
    return array

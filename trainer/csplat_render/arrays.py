"""Inputs and outputs of the renderer: splats, renders, gradients."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

from numpy.typing import NDArray

Array = NDArray[Any]


class HasSplats(Protocol):
    """Anything that can be rendered: a `SplatModel`, a `Splats`, or any object with these arrays."""

    @property
    def means(self) -> Array: ...  # noqa: D102 - as in Splats
    @property
    def quats(self) -> Array: ...  # noqa: D102 - as in Splats
    @property
    def scales(self) -> Array: ...  # noqa: D102 - as in Splats
    @property
    def opacities(self) -> Array: ...  # noqa: D102 - as in Splats
    @property
    def sh0(self) -> Array: ...  # noqa: D102 - as in Splats
    @property
    def shN(self) -> Array: ...  # noqa: D102, N802 - as in Splats


@dataclass(frozen=True, eq=False)
class Splats:
    """The arrays of N splats, unchecked but for their shapes: rows that hold NaN are left out of pictures.

    Attributes:
        means: [N, 3], centres.
        quats: [N, 4], rotations w x y z, of any length.
        scales: [N, 3], natural logarithms of the standard deviations.
        opacities: [N], alpha.
        sh0: [N, 3].
        shN: [N, K, 3], K = 0, 3, 8 or 15.
    """

    means: Array
    quats: Array
    scales: Array
    opacities: Array
    sh0: Array
    shN: Array


@dataclass(frozen=True, eq=False)
class RenderResult:
    """A picture of splats.

    Attributes:
        rgb: [H, W, 3], not clipped: colours may exceed 1.
        alpha: [H, W], 1 − transmittance.
        depth: [H, W], sum of weight · depth, not divided by alpha.
        radii: [N] float32, 3 standard deviations of each splat along its longest axis, in pixels;
            0 for what is not drawn.
        drawn: number of splats in view.
        intersections: pairs of splat and tile; what the time depends on.
        ignored: number of splats that hold NaN or infinity.
    """

    rgb: Array
    alpha: Array
    depth: Array
    radii: Array
    drawn: int
    intersections: int
    ignored: int


@dataclass(frozen=True, eq=False)
class Seen:
    """Splats that a render shows.

    Attributes:
        near: [N] float32, depths, by which splats are sorted; 0 for splats that are not drawn.
        tiles: [N] integers, number of the render's tiles that each may touch; 0 likewise.
        ignored: number of splats that hold NaN or infinity.
    """

    near: Array
    tiles: Array
    ignored: int


@dataclass(frozen=True, eq=False)
class Gradients:
    """Gradients of a loss; the arrays are the rasteriser's and hold until its next `backward`.

    Attributes:
        means: [N, 3].
        quats: [N, 4], through the normalisation.
        scales: [N, 3], towards the logarithms.
        opacities: [N], towards alpha.
        sh0: [N, 3].
        shN: [N, K, 3]; 0 beyond the degree that was rendered.
        means2d: [N], length of the gradient towards the centre on the picture, per pixel.
        radii: [N] float32, see `RenderResult`.
    """

    means: Array
    quats: Array
    scales: Array
    opacities: Array
    sh0: Array
    shN: Array
    means2d: Array
    radii: Array

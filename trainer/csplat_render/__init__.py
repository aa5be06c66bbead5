"""Rendering of Gaussian splats on the CPU: numba rasteriser with gradients, exact reference, cameras, image metrics."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from csplat.errors import missing_package
from csplat_render.camera import Camera
from csplat_render.conventions import Mode

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

    from csplat_render.conventions import HasSplats, RenderResult

__all__ = ["Camera", "Mode", "render"]


def render(
    model: HasSplats,
    camera: Camera,
    *,
    background: ArrayLike = (0.0, 0.0, 0.0),
    mode: Mode = "standard",
    antialiased: bool | None = None,
    sh_degree: int | None = None,
    threads: int | None = None,
) -> RenderResult:
    """Render one image. For many images of one scene, or gradients, keep a `csplat_render.rasteriser.Rasteriser`.

    Args:
        model: a `SplatModel`, or anything with its six arrays. Its origin is not added: cameras
            are relative to it, as `means` are.
        camera: the camera to render from.
        background: red, green, blue behind everything.
        mode: `standard`; `fast`, which leaves out what hardly shows; or `exact`, the slow reference,
            in float64.
        antialiased: apply the mip-splatting filter; None for the model's own setting.
        sh_degree: highest degree of the spherical harmonics; None for the model's.
        threads: number of threads; None for all.

    Returns:
        `rgb` [H, W, 3] float32, not clipped; `alpha` [H, W]; `depth` [H, W], scene units; and more.

    Examples:
        >>> import csplat, csplat_render
        >>> from csplat_render.camera_paths import orbit_cameras
        >>> model = csplat.read_ply("scene.ply")
        >>> camera = orbit_cameras(model, 1, 64, 48)[0]
        >>> csplat_render.render(model, camera, mode="exact").rgb.shape
        (48, 64, 3)

    Raises:
        InputError: shapes do not fit together, an option has another value, or numba is not installed.
        LimitError: too many splats are too large: `rasteriser.MAX_INTERSECTIONS`.
    """
    # numba takes a second to import: code that needs only cameras does not wait for it.
    try:
        from csplat_render.rasteriser import Rasteriser
        from csplat_render.reference_rasteriser import render_exact
    except ModuleNotFoundError as error:
        raise missing_package(error) from None

    if antialiased is None:
        antialiased = bool(getattr(model, "antialiased", False))
    if mode == "exact":
        return render_exact(model, camera, background=background, antialiased=antialiased, sh_degree=sh_degree)
    rasteriser = Rasteriser(mode, np.float32, gradients=False, threads=threads)
    return rasteriser.forward(model, camera, background=background, antialiased=antialiased, sh_degree=sh_degree)

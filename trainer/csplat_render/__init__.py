"""Render Gaussian splats on the CPU: numba rasteriser with gradients, exact reference, cameras, image metrics."""

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
    """Render one image.

    For many images of one scene, or for gradients, use a `csplat_render.rasteriser.Rasteriser`.

    Args:
        model: a `SplatModel`, or an object with its six arrays. Cameras, like `means`, are relative to its origin.
        camera: the camera to render from.
        background: red, green, blue of the background.
        mode: `standard`; `fast`, which omits faint contributions; or `exact`, the slow reference in float64.
        antialiased: apply the mip-splatting filter; `None`: the model's own setting.
        sh_degree: highest SH degree; `None`: the model's.
        threads: number of threads; `None`: all.

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
        InputError: array shapes do not match, an option is invalid, or numba is not installed.
        LimitError: too many large splats: more than `rasteriser.MAX_INTERSECTIONS`.
    """
    # Imported lazily: numba takes a second to import, and code that uses only cameras does not need it.
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

# SPDX-License-Identifier: Apache-2.0
"""Render Gaussian splats: rasteriser with gradients, exact reference, GPU renderer, cameras, image metrics."""

from __future__ import annotations

import warnings
from typing import TYPE_CHECKING, Literal, overload

from csplat.context import DEFAULT_CONTEXT, Context
from csplat.model import SplatModel
from csplat_render.camera import Camera
from csplat_render.conventions import Backend, Mode

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

    from csplat_render.conventions import HasSplats, Render, RenderResult
    from csplat_render.gpu.device import Device
    from csplat_render.gpu.renderer import PackedFile

__all__ = ["Backend", "Camera", "Mode", "render"]


@overload
def render(
    model: HasSplats | PackedFile,
    camera: Camera | None = ...,
    *,
    background: ArrayLike = ...,
    mode: Mode = ...,
    backend: Literal["cpu"] = ...,
    antialiased: bool | None = ...,
    sh_degree: int | None = ...,
    context: Context = ...,
) -> RenderResult: ...


@overload
def render(
    model: HasSplats | PackedFile,
    camera: Camera | None = ...,
    *,
    background: ArrayLike = ...,
    mode: Mode = ...,
    backend: Backend,
    antialiased: bool | None = ...,
    sh_degree: int | None = ...,
    context: Context = ...,
) -> Render: ...


def render(
    model: HasSplats | PackedFile,
    camera: Camera | None = None,
    *,
    background: ArrayLike = (0.0, 0.0, 0.0),
    mode: Mode = "standard",
    backend: Backend = "cpu",
    antialiased: bool | None = None,
    sh_degree: int | None = None,
    context: Context = DEFAULT_CONTEXT,
) -> Render:
    """Render one image.

    For many images of one scene, or for gradients, use a `csplat_render.rasteriser.Rasteriser`; on a GPU, a
    `csplat_render.gpu.renderer.GpuRenderer`. The backends agree to 75 dB or better. Published PSNRs are measured on
    the CPU, which gives the same values on every machine.

    Args:
        model: a `SplatModel`, an object with its six arrays, or a file opened by `csplat.open`. Cameras, like `means`,
            are relative to its origin.
        camera: the camera to render from; `None`: the first view of a `SplatModel` (`csplat_render.first_view`).
        background: red, green, blue of the background.
        mode: `standard`; `fast`, which omits faint contributions; or `exact`, the slow reference in float64. A GPU has
            `standard` alone.
        backend: `cpu`; `gpu`; `auto`, a GPU if there is one, otherwise the CPU with a warning; or `software`, the
            GPU's shaders on the CPU, for tests. GPUs require the extra `gpu`.
        antialiased: apply the mip-splatting filter; `None`: the model's own setting.
        sh_degree: highest SH degree; `None`: the model's.
        context: threads.

    Returns:
        `rgb` [H, W, 3] float32, not clipped; `alpha` [H, W]; on the CPU `depth` [H, W], scene units; and more.

    Examples:
        >>> import csplat, csplat_render
        >>> from csplat_render.camera_paths import orbit_cameras
        >>> model = csplat.read("scene.ply")
        >>> camera = orbit_cameras(model, 1, 64, 48)[0]
        >>> csplat_render.render(model, camera, mode="exact").rgb.shape
        (48, 64, 3)

    Raises:
        InputError: array shapes do not match, there is neither a camera nor a first view, an option is invalid, a
            package is not installed, or there is no GPU.
        LimitError: too many large splats: more than `rasteriser.MAX_INTERSECTIONS`; or the scene exceeds the GPU's
            buffers.
    """
    # The renderers are imported lazily, because code that uses only cameras does not need them.
    if camera is None:
        from csplat_render.first_view import first_view

        camera = first_view(model)
    device = _find_device(backend)
    if device is not None:
        from csplat_render.gpu.renderer import GpuScene

        scene = GpuScene(device, [model], antialiased=antialiased, sh_degree=sh_degree)
        return scene.renderer(background, mode=mode)(camera)
    from csplat_render.gpu.renderer import PackedFile

    splats = model.read(sh_degree=sh_degree) if isinstance(model, PackedFile) else model
    from csplat_render.rasteriser import Rasteriser
    from csplat_render.reference_rasteriser import render_exact

    if antialiased is None:
        antialiased = isinstance(splats, SplatModel) and splats.metadata.antialiased
    if mode == "exact":
        return render_exact(splats, camera, background=background, antialiased=antialiased, sh_degree=sh_degree)
    rasteriser = Rasteriser(mode, context=context)
    return rasteriser.forward(splats, camera, background=background, antialiased=antialiased, sh_degree=sh_degree)


def _find_device(backend: Backend) -> Device | None:
    """Return the GPU of a backend; `None` for the CPU, after a warning if `auto` finds no GPU.

    Raises:
        InputError: there is no such backend; or no GPU, and the backend requires one.
    """
    if backend == "cpu":
        return None
    from csplat_render.gpu.device import find_device

    device, reason = find_device(backend)
    if reason:
        warnings.warn(f"{reason}: rendering on the CPU", stacklevel=3)  # names the line that called `render`
    return device

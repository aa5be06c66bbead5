# SPDX-License-Identifier: Apache-2.0
"""A stand-in for the function `rasterization` of gsplat, on the CPU."""

import torch
from torch_twin import render_torch

from csplat.spherical_harmonics import SH_C0
from csplat_render import Camera
from csplat_trainer.torch_rasteriser import CpuRasteriser, SplatTensors


def rasterization(
    means, quats, scales, opacities, colors, viewmats, Ks, width, height, near_plane, sh_degree, backgrounds,
    covars=None, **rest,
):  # fmt: skip
    """Render with the CPU rasteriser, or, with covariances, in plain torch; arguments as for gsplat."""
    camera = Camera(Ks[0].double().numpy(), viewmats[0].double().numpy(), width, height, near_plane)
    antialiased = rest["rasterize_mode"] == "antialiased"
    if covars is not None:
        upper = covars.triu()
        splats = {
            "means": means.double(),
            "quats": torch.zeros((len(means), 4)).double(),
            "scales": (upper + upper.mT - upper * torch.eye(3)).double(),
            "opacities": opacities.double(),
            "sh0": (colors.double() - 0.5) / SH_C0,
            "shN": torch.zeros((len(means), 0, 3)).double(),
        }
        image = render_torch(splats, camera, tuple(backgrounds[0].tolist()), antialiased)[0].float()
        return image[None], None, {}
    assert not rest["packed"]
    splats = SplatTensors(means, quats, scales.log(), opacities, colors[:, 0], colors[:, 1:])
    render = CpuRasteriser(antialiased=antialiased).render(splats, camera, backgrounds[0], sh_degree)
    radii = render.drawn.int()[None, :, None].expand(1, len(means), 2)
    return render.image[None], None, {"means2d": render.means2d, "radii": radii}

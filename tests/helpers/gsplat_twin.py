"""A stand-in for the function `rasterization` of gsplat, on the CPU."""

import numpy as np
import torch
from torch_twin import render_torch

from csplat.spherical_harmonics import SH_C0
from csplat_render import Camera
from csplat_trainer import torch_rasteriser


def rasterization(
    means, quats, scales, opacities, colors, viewmats, Ks, width, height, near_plane, sh_degree, backgrounds,
    covars=None, **rest,
):  # fmt: skip
    """Render with the CPU rasteriser, or, with covariances, in plain torch; arguments as for gsplat."""
    camera = Camera(Ks[0].double().numpy(), viewmats[0].double().numpy(), width, height, near_plane)
    behind, antialiased = tuple(backgrounds[0].tolist()), rest["rasterize_mode"] == "antialiased"
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
        return render_torch(splats, camera, behind, antialiased)[0].float()[None], None, {}
    assert not rest["packed"]
    means2d = torch.zeros((1, len(means), 2), requires_grad=True)
    picture = torch_rasteriser.render(
        means, quats, scales.log(), opacities, colors[:, 0], colors[:, 1:], camera, background=behind,
        antialiased=antialiased, sh_degree=sh_degree,
    )  # fmt: skip
    radii = torch.from_numpy(np.ones((1, len(means), 2), np.int32))
    return picture[None] + 0.0 * means2d.sum(), None, {"means2d": means2d, "radii": radii}

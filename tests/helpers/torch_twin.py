# SPDX-License-Identifier: Apache-2.0
"""The rasteriser's equations in plain torch, for gradients by autograd.

It evaluates every splat at every pixel in float64, for a dozen splats and some hundred pixels.
"""

import numpy as np
import torch

from csplat.spherical_harmonics import sh_basis
from csplat_render.conventions import ALPHA_CAP, ALPHA_MIN, COMPENSATION_MIN, DILATION, FOV_MARGIN, TRANSMITTANCE_MIN


def autograd_gradients(arrays, view, weights, *, background=(0.0, 0.0, 0.0), antialiased=False):
    """Return a render, and autograd's gradients of the sum of its colours, alpha and depth, each times its weights."""
    splats = {name: torch.tensor(array, requires_grad=True) for name, array in arrays.items()}
    pictures = render_torch(splats, view, background, antialiased)
    sum((picture * torch.tensor(weight)).sum() for picture, weight in zip(pictures, weights, strict=True)).backward()
    gradients = {name: np.zeros(one.shape) if one.grad is None else one.grad.numpy() for name, one in splats.items()}
    return pictures[0].detach().numpy(), gradients


def render_torch(splats, view, background, antialiased):
    """Return colours, alpha and depth; `scales` may be covariances [N, 3, 3] instead."""
    centre, covariance, opacity, colour, depth = _project(splats, view, antialiased)
    ys, xs = torch.meshgrid(torch.arange(view.H) + 0.5, torch.arange(view.W) + 0.5, indexing="ij")
    offset = torch.stack([xs, ys], -1).double() - centre[:, None, None]  # splat, row, column, xy
    power = -0.5 * torch.einsum("nhwi,nij,nhwj->nhw", offset, torch.linalg.inv(covariance), offset)
    alpha = torch.clamp(opacity[:, None, None] * torch.exp(power), max=ALPHA_CAP)
    alpha = torch.where(alpha >= ALPHA_MIN, alpha, torch.zeros_like(alpha))
    after = torch.cumprod(1.0 - alpha, 0)
    before = torch.cat([torch.ones_like(after[:1]), after[:-1]])
    seen = (after >= TRANSMITTANCE_MIN).double().cumprod(0)
    weight = seen * alpha * before
    left = 1.0 - weight.sum(0)  # equals the product of 1 − alpha over the drawn splats
    rgb = torch.einsum("nhw,nc->hwc", weight, colour) + left[..., None] * torch.tensor(background, dtype=torch.float64)
    return rgb, 1.0 - left, torch.einsum("nhw,n->hw", weight, depth)


def _project(splats, view, antialiased):
    """Return centre, covariance, opacity, colour and depth of splats beyond the near plane, nearest first."""
    R, t = torch.tensor(view.viewmat[:3, :3]), torch.tensor(view.viewmat[:3, 3])
    z = (splats["means"] @ R.T + t)[:, 2]
    order = torch.argsort(z.detach().float(), stable=True)
    order = order[z[order] > view.near]
    means, quats, scales, opacity, sh0, shN = (splats[name][order] for name in splats)
    x, y, z = (means @ R.T + t).T
    fx, fy, cx, cy = (float(value) for value in (view.K[0, 0], view.K[1, 1], view.K[0, 2], view.K[1, 2]))
    tx, ty = _clamped(x / z, fx, cx, view.W), _clamped(y / z, fy, cy, view.H)
    zero = torch.zeros_like(z)
    rows = torch.stack([fx / z, zero, -fx * tx / z], -1), torch.stack([zero, fy / z, -fy * ty / z], -1)
    jacobian = torch.stack(rows, 1)
    if scales.dim() == 2:
        spans = _rotation(quats) @ torch.diag_embed(torch.exp(scales))
        scales = spans @ spans.mT
    plane = jacobian @ R
    bare = plane @ scales @ plane.mT
    covariance = bare + DILATION * torch.eye(2).double()
    if antialiased:
        ratio = torch.linalg.det(bare) / torch.linalg.det(covariance)
        opacity = opacity * torch.sqrt(torch.clamp(ratio, min=COMPENSATION_MIN))
    direction = means - torch.tensor(view.position)
    direction = direction / direction.norm(dim=1, keepdim=True)
    coefficients = torch.cat([sh0[:, None], shN], 1)
    basis = [torch.zeros(())] * coefficients.shape[1]
    degree = int(np.sqrt(len(basis))) - 1
    sh_basis(degree, direction[:, 0], direction[:, 1], direction[:, 2], basis)
    values = torch.stack([one * torch.ones_like(z) for one in basis], 1)
    colour = torch.clamp(torch.einsum("nk,nkc->nc", values, coefficients) + 0.5, min=0.0)
    return torch.stack([fx * x / z + cx, fy * y / z + cy], 1), covariance, opacity, colour, z


def _clamped(tangent, focal, centre, size):
    margin = FOV_MARGIN * 0.5 * size / focal
    return torch.clamp(tangent, -centre / focal - margin, (size - centre) / focal + margin)


def _rotation(quats):
    """Return matrices whose columns are the splats' axes: the images of x, y, z under q v q⁻¹."""
    w, v = torch.split(quats / quats.norm(dim=1, keepdim=True), [1, 3], dim=1)
    images = []
    for axis in torch.eye(3).double():
        twice = 2.0 * torch.linalg.cross(v, axis.expand_as(v))
        images.append(axis + w * twice + torch.linalg.cross(v, twice))
    return torch.stack(images, -1)

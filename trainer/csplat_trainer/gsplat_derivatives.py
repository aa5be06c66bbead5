# SPDX-License-Identifier: Apache-2.0
# torch may be absent:
# pyright: reportMissingImports=false
"""Pruning errors and squared derivatives of renders, estimated on a GPU by backward passes.

With random signs v, E[v vᵀ] = I, so the expectation of the squared derivative of Σ v_pc C_pc by a parameter is the sum
of the squared derivatives of the pixels' channels C_pc (Hutchinson 1989, https://doi.org/10.1080/03610918908812806). A
backward pass per view returns such a sample for all parameters of all splats. Its standard deviation is √2 times the
expectation, and falls with the root of the number of views that show the splat. Products of two derivatives estimate
the entries of Gauss–Newton matrices likewise.

Removing a splat changes a pixel by α ∂C/∂α, exactly, since C is linear in each alpha; and alpha at a pixel is
proportional to the splat's opacity o. So the squared derivative by o, times o², estimates the pruning error. Alphas are
limited to less than gsplat's cap, where derivatives would be 0.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from csplat.model import SplatModel
from csplat.spherical_harmonics import sh_basis
from csplat.types import F32, Progress
from csplat_render.camera import Camera
from csplat_render.pruning_error import PruningError
from csplat_trainer.gsplat_rasteriser import GsplatRasteriser
from csplat_trainer.sensitivity import Sensitivity
from csplat_trainer.torch_parameters import memory_errors, rotations, upload
from csplat_trainer.torch_rasteriser import SplatTensors

_DRAWS = 2  # random images per view
_LARGEST_ALPHA = 0.998  # gsplat stops at 0.999
_SEED = 0  # seed of the random images
_SHORTEST = 1e-12  # least length to divide by
_TRIANGLE = torch.triu_indices(6, 6)  # indices of the upper triangle of a matrix over `_ENTRIES`
_ENTRIES = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))  # xx, yy, zz, xy, xz, yz of a covariance


def estimate_pruning(
    rasteriser: GsplatRasteriser, model: SplatModel, cameras: Sequence[Camera], background: F32
) -> PruningError:
    """Estimate `measure_pruning_error`.

    Args:
        rasteriser: renders the views, antialiased as the scene.
        model: the scene.
        cameras: the views.
        background: [3].
    """
    splats = splats_of(model, rasteriser.device)
    derivatives = _EstimatedSquares(rasteriser, splats, background, matrices=False)
    for camera in cameras:
        derivatives.add(camera)
    error = derivatives.opacity * splats.opacities.double().square()
    return PruningError(
        error.cpu().numpy(), (derivatives.views > 0).cpu().numpy(), sum(3 * camera.W * camera.H for camera in cameras)
    )


def estimate_sensitivity(
    rasteriser: GsplatRasteriser,
    model: SplatModel,
    cameras: Sequence[Camera],
    background: F32,
    progress: Progress | None = None,
) -> Sensitivity:
    """Estimate `measure_sensitivity` with the matrices of SH coefficients, without magnitudes.

    Args:
        rasteriser: renders the views, antialiased as the scene.
        model: the scene.
        cameras: the views, at least one; relative to the scene's origin.
        background: [3].
        progress: progress callback.
    """
    derivatives = _EstimatedSquares(rasteriser, splats_of(model, rasteriser.device), background, matrices=True)
    for number, camera in enumerate(cameras):
        derivatives.add(camera)
        if progress is not None:
            progress("measuring sensitivity", (number + 1) / len(cameras))
    pixels = max(1, sum(camera.W * camera.H for camera in cameras))

    def mean(sums: Tensor) -> Any:
        return np.minimum((sums.double() / pixels).cpu().numpy(), np.finfo(np.float32).max)

    diagonal = (_TRIANGLE[0] == _TRIANGLE[1]).numpy()
    shape = mean(derivatives.shape)
    return Sensitivity(
        colour=None, opacity=None, shape=None, opacity_net=None, shape_net=None,
        colour_squares=mean(derivatives.colour),
        opacity_squares=mean(derivatives.opacity),
        shape_squares=shape[:, diagonal].sum(axis=1),
        means_squares=mean(derivatives.means),
        shape_metric=shape,
        metric=mean(derivatives.basis).astype(np.float32),
        views=derivatives.views.cpu().numpy(),
        view_count=len(cameras),
        pixel_count=pixels,
    )  # fmt: skip


def splats_of(model: SplatModel, device: torch.device) -> SplatTensors:
    """Copy the splats of a scene to a device."""
    return SplatTensors(*(upload(getattr(model, name), device) for name in SplatTensors._fields))


class _EstimatedSquares:
    """Sums of estimated squares of derivatives over views, on the device.

    Attributes:
        opacity: [N], squared derivative by alpha.
        views: [N], number of views that show the splat.
        colour, means: [N], squared derivatives by a channel of the colour and by the centre. These and the following
            have no rows without `matrices`.
        shape: [N, 21], Gauss–Newton matrices of the covariance over its trace; see `Sensitivity.shape_metric`.
        basis: [N, B (B + 1) / 2], Gauss–Newton matrices of the SH coefficients of a channel.
    """

    def __init__(self, rasteriser: GsplatRasteriser, splats: SplatTensors, background: F32, *, matrices: bool) -> None:
        self._rasteriser, self._splats, self._matrices = rasteriser, splats, matrices
        self._background = upload(background, rasteriser.device)
        self._generator = torch.Generator(rasteriser.device).manual_seed(_SEED)
        count, functions = len(splats.means), 1 + splats.shN.shape[1]
        rows = count if matrices else 0
        self._degree = round(functions**0.5) - 1
        self._pairs = torch.triu_indices(functions, functions, device=rasteriser.device)
        on = rasteriser.device
        self.opacity = torch.zeros(count, device=on)
        self.colour, self.means = torch.zeros(rows, device=on), torch.zeros(rows, device=on)
        self.shape = torch.zeros((rows, 21), device=on)
        self.basis = torch.zeros((rows, functions * (functions + 1) // 2), device=on)
        self.views = torch.zeros(count, dtype=torch.int64, device=on)
        self._triangle = _TRIANGLE.to(rasteriser.device)
        self._covariances = _covariances(splats.quats, splats.scales.exp())

    @memory_errors()
    def add(self, camera: Camera) -> None:
        """Add the estimates of a view."""
        splats = self._splats
        basis = self._basis_functions(camera)
        coefficients = torch.cat([splats.sh0[:, None], splats.shN], dim=1)
        colours = (torch.einsum("nk,nkc->nc", basis, coefficients) + 0.5).clamp(min=0.0)
        alphas = splats.opacities.clamp(max=_LARGEST_ALPHA)
        inputs = [
            tensor.detach().clone().requires_grad_() for tensor in (splats.means, self._covariances, alphas, colours)
        ]
        rendered = self._rasteriser.render_covariances(
            inputs[0], inputs[1], inputs[2], inputs[3], camera, self._background
        )
        seen = torch.zeros(len(colours), dtype=torch.bool, device=colours.device)
        for draw in range(_DRAWS):
            signs = torch.randint(0, 2, rendered.shape, generator=self._generator, device=rendered.device)
            gradients = torch.autograd.grad(rendered, inputs, 2.0 * signs - 1.0, retain_graph=draw + 1 < _DRAWS)
            means, covariances, opacities, slopes = (
                torch.nan_to_num(gradient, 0.0, 0.0, 0.0) for gradient in gradients
            )
            seen |= self._add_products(means, covariances, opacities, slopes, basis)
        self.views += seen

    @torch.no_grad()
    def _add_products(
        self, means: Tensor, covariances: Tensor, opacities: Tensor, colours: Tensor, basis: Tensor
    ) -> Tensor:
        """Add the products of the derivatives of one random image, a share of 1 / `_DRAWS` of the view's estimate.

        Args:
            means, covariances, opacities, colours: derivatives, [N, 3], [N, 3, 3], [N], [N, 3].
            basis: [N, B], the SH basis in the directions of the splats.

        Returns:
            [N] bool, True for splats that the image shows.
        """
        self.opacity += opacities.square() / _DRAWS
        squares = colours.square().mean(dim=1) / _DRAWS  # each channel has its own signs
        if self._matrices:
            self.colour += squares
            self.means += means.square().sum(dim=1) / _DRAWS
            trace = self._covariances.diagonal(dim1=1, dim2=2).sum(dim=1)
            both = covariances + covariances.mT  # gsplat gives the derivative by either half alone
            # Coordinates in which the Frobenius norm is Euclidean: entries off the diagonal count √2 times.
            slopes = torch.stack(
                [0.5 * both[:, i, j] if i == j else both[:, i, j] / 2**0.5 for i, j in _ENTRIES], dim=1
            )
            slopes *= trace[:, None] / _DRAWS**0.5
            self.shape += slopes[:, self._triangle[0]] * slopes[:, self._triangle[1]]
            self.basis += basis[:, self._pairs[0]] * basis[:, self._pairs[1]] * squares[:, None]
        return squares > 0.0

    def _basis_functions(self, camera: Camera) -> Tensor:
        """Return the SH basis in the direction of each splat, [N, B]."""
        offsets = self._splats.means - upload(camera.position.astype(np.float32), self._rasteriser.device)
        x, y, z = (offsets / offsets.norm(dim=1, keepdim=True).clamp(min=_SHORTEST)).unbind(dim=1)
        basis = offsets.new_empty(((self._degree + 1) ** 2, len(offsets)))
        sh_basis(self._degree, x, y, z, basis)
        return basis.T.contiguous()


def _covariances(quats: Tensor, scales: Tensor) -> Tensor:
    """Return the covariances of splats, [N, 3, 3], from quats [N, 4] and standard deviations [N, 3]."""
    axes = rotations(quats / quats.norm(dim=1, keepdim=True).clamp(min=_SHORTEST)) * scales[:, None]
    return axes @ axes.mT

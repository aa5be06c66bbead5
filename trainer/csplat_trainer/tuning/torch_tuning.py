# SPDX-License-Identifier: Apache-2.0
# torch may be absent:
# pyright: reportMissingImports=false
"""Steps of fine-tuning in torch, with the interface of `CpuTuning`: on a GPU, and as a reference on a CPU.

Images are rendered from the values that a decoder of the file returns, bit for bit, by quantisers in torch; the encoder
decides and writes.
"""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor

from csplat.encoder import FixedQuantisation, FreeValues
from csplat.errors import InputError
from csplat.types import F32
from csplat_trainer.image_gains import ImageGain
from csplat_trainer.losses import LossValue, PendingLoss
from csplat_trainer.parameters import Parameters
from csplat_trainer.torch_losses import DeviceImages, TorchLoss, corrected, through_gain
from csplat_trainer.torch_parameters import DeviceParameters, Tensors, as_leaves, gradients_of, memory_errors, upload
from csplat_trainer.torch_quantisers import QuantisedValues, TorchQuantisers
from csplat_trainer.torch_rasteriser import SplatTensors, TorchRasteriser, TorchRender
from csplat_trainer.tuned_scene import MAX_INTEGER, RateTerm, initial_parameters, slopes_of
from csplat_trainer.tuning.tuning_options import FinetuneOptions
from csplat_trainer.tuning.tuning_views import TuningView


class TorchTuning:
    """An engine of fine-tuning in torch, on the device of its rasteriser.

    Args:
        fixed: the encoder's decisions.
        options: options of the tuning.
        background: [3].
        rasteriser: renders, with gradients; antialiased as the scene.
        parameters: state to continue from, in arrays of NumPy; `None`: the values that the encoder found.

    Attributes:
        parameters: the state of the optimisation, on the device.
    """

    def __init__(
        self,
        fixed: FixedQuantisation,
        options: FinetuneOptions,
        background: F32,
        rasteriser: TorchRasteriser,
        parameters: Parameters | None = None,
    ) -> None:
        self._fixed, self._rasteriser, self._device = fixed, rasteriser, rasteriser.device
        self.parameters = DeviceParameters(parameters or initial_parameters(fixed), self._device)
        self._quantisers = TorchQuantisers(fixed, self._device)
        self._loss, self._images = TorchLoss(options.loss, self._device), DeviceImages(self._device)
        self._background = upload(background, self._device)
        self._costs: tuple[RateTerm, dict[str, Tensor]] | None = None

    def count(self, weight: float) -> RateTerm:
        """Count the bits of the file's integers; `weight` is lambda, loss per bit and splat."""
        quantised, costs = self._quantised(), RateTerm(self._fixed, weight, {})
        columns = {
            "scales": quantised.scales,
            "quats": quantised.quats,
            "opacities": quantised.opacities[:, None],
            "sh0": quantised.sh0,
            "sizes": quantised.sizes[:, None],
            "shN": quantised.sh.flatten(1),
        }
        for name, integers in columns.items():
            if integers.shape[1]:
                slopes, bits = slopes_of(_count_integers(integers).cpu().numpy())
                costs.tables[name] = slopes
                costs.bits += bits
        return costs

    @memory_errors()
    def step(
        self, view: TuningView, gain: ImageGain | None, rates: dict[str, float], costs: RateTerm | None
    ) -> PendingLoss:
        """Make a step on a view, see `CpuTuning.step`."""
        v, alphas = self.parameters.tensors, self.parameters.device_alphas
        quantised = self._quantisers.quantise(v, alphas)
        decoded = as_leaves(quantised.splats)
        image = self._render(decoded, view).image
        rendered = image.detach()
        reference = self._images.reference(view.reference, self._background)
        value, slope = self._loss(corrected(gain, rendered), reference, self._images.mask(view.mask))
        image.backward(through_gain(gain, rendered, slope))  # type: ignore[no-untyped-call]  # untyped in torch
        gradients = gradients_of(decoded)
        gradients["logits"] = gradients.pop("opacities") * (alphas * (1.0 - alphas))
        gradients["sizes"] = torch.zeros_like(v["sizes"])
        if self._quantisers.shape_rows is not None:
            gradients["sizes"] = gradients["scales"].sum(dim=1)
        for name, rows in (
            ("quats", self._quantisers.shape_rows),
            ("scales", self._quantisers.shape_rows),
            ("shN", self._quantisers.sh_rows),
        ):
            if rows is not None:
                gradients[name] = torch.zeros_like(v[name]).index_add_(0, rows, gradients[name])
        if costs is not None:
            self._add_costs(gradients, quantised, costs)
        self.parameters.adam_step(gradients, rates)
        self._quantisers.constrain(v)
        return value

    @torch.no_grad()
    def score(self, view: TuningView, gain: ImageGain | None) -> tuple[LossValue, float]:
        """Return the loss of a view, and the squared error summed over the values that count, clipped to 0..1."""
        rendered = corrected(gain, self._render(self._quantised().splats, view).image)
        reference = self._images.reference(view.reference, self._background)
        mask = self._images.mask(view.mask)
        error = (rendered.clamp(0, 1) - reference.clamp(0, 1)).double().square()
        if mask is not None:
            error = error * mask[..., None]
        return self._loss(rendered, reference, mask)[0].read(), float(error.sum())

    def free_values(self) -> FreeValues:
        """Return a copy of the values for the encoder.

        Raises:
            InputError: the encoder quantises them differently, since some are too large.
        """
        v, alphas = self.parameters.on_cpu().values, self.parameters.alphas
        values = FreeValues(v["means"], v["quats"], v["scales"], alphas, v["sh0"], v["shN"], v["sizes"])
        expected, quantised = self._fixed.dequantise(values), self._quantised()
        for name, array in vars(expected).items():
            if not np.array_equal(array, quantised.splats[name].cpu().numpy()):
                raise InputError(f"{name} are too large to be tuned in torch: use engine native")
        return values

    def _render(self, splats: Tensors, view: TuningView) -> TorchRender:
        """Render decoded splats in a view."""
        degree = math.isqrt(1 + splats["shN"].shape[1]) - 1
        return self._rasteriser.render(SplatTensors(**splats), view.camera, self._background, degree)

    def _quantised(self) -> QuantisedValues:
        """Quantise the current values."""
        quantised: QuantisedValues = self._quantisers.quantise(self.parameters.tensors, self.parameters.device_alphas)
        return quantised

    @torch.no_grad()
    def _add_costs(self, gradients: dict[str, Tensor], quantised: QuantisedValues, costs: RateTerm) -> None:
        """Add the slopes of the rate term to gradients, as `RateTerm.add_to`, in place; tables stay on the device."""
        if self._costs is None or self._costs[0] is not costs:
            self._costs = costs, {name: upload(table, self._device) for name, table in costs.tables.items()}
        plan, tables = self._fixed.parameters, self._costs[1]
        alphas = quantised.splats["opacities"]
        per_bit = costs.weight / len(alphas)
        gradients["scales"] += per_bit / plan.scale_step * _slopes(tables["scales"], quantised.scales)
        over = _ROOT2 * plan.quat_levels
        gradients["quats"][:, 1:] += per_bit * over * _slopes(tables["quats"], quantised.quats)
        chain = 0.5 * plan.opacity_levels * alphas.sqrt() * (1.0 - alphas)
        gradients["logits"] += per_bit * chain * _slopes(tables["opacities"], quantised.opacities[:, None])[:, 0]
        gradients["sizes"] += per_bit / plan.scale_step * _slopes(tables["sizes"], quantised.sizes[:, None])[:, 0]
        self._add_colours(gradients["sh0"][:, None], quantised.sh0[:, None], tables["sh0"], per_bit / plan.sh0_step)
        if "shN" in tables:
            self._add_colours(gradients["shN"], quantised.sh, tables["shN"], per_bit / plan.sh_step)

    def _add_colours(self, gradient: Tensor, integers: Tensor, table: Tensor, factor: float) -> None:
        """Add the slopes of colours: Y = (R + 2 G + B) / 4, Co = R - B, Cg = G - (R + B) / 2, up to rounding.

        Args:
            gradient: [n, K, 3], changed in place.
            integers: [n, K, 3], Y, Co, Cg.
            table: [3 K, 2 · MAX_INTEGER + 1], slopes in bits per step.
            factor: loss per bit over the quantisation step.
        """
        slopes = factor * _slopes(table, integers.flatten(1)).reshape(integers.shape)
        chroma = 0.5**self._fixed.parameters.chroma_shift
        by_y, by_co, by_cg = slopes[..., 0], chroma * slopes[..., 1], chroma * slopes[..., 2]
        gradient[..., 0] += 0.25 * by_y + by_co - 0.5 * by_cg
        gradient[..., 1] += 0.5 * by_y + by_cg
        gradient[..., 2] += 0.25 * by_y - by_co - 0.5 * by_cg


_ROOT2 = 2.0**0.5


def _table_places(integers: Tensor) -> Tensor:
    """Return the places of integers [n, C] in flat tables [C, 2 · MAX_INTEGER + 1]."""
    size = 2 * MAX_INTEGER + 1
    columns = torch.arange(integers.shape[1], device=integers.device) * size + MAX_INTEGER
    return integers.clamp(-MAX_INTEGER, MAX_INTEGER).long() + columns


def _count_integers(integers: Tensor) -> Tensor:
    """Count the integers of each column, [C, 2 · MAX_INTEGER + 1]."""
    width, size = integers.shape[1], 2 * MAX_INTEGER + 1
    return torch.bincount(_table_places(integers).flatten(), minlength=width * size).reshape(width, size)


def _slopes(table: Tensor, integers: Tensor) -> Tensor:
    """Return the slopes of integers [n, C] by the tables [C, 2 · MAX_INTEGER + 1] of their columns, [n, C]."""
    return table.flatten()[_table_places(integers)]

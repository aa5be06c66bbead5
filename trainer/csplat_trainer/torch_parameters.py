# SPDX-License-Identifier: Apache-2.0
# torch may be absent:
# pyright: reportMissingImports=false
"""The trained parameters in tensors, and Adam on their device."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any, cast

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.optim.adam import adam

from csplat.errors import InputError
from csplat.types import F32
from csplat_trainer.parameters import GROUPS, Parameters

_BETAS, _EPSILON = (0.9, 0.999), 1e-15
_LOGIT_LIMIT = 14.0  # as in `parameters`
_SHORTEST = 1e-12  # least length to divide by

Tensors = Mapping[str, Tensor]


class DeviceParameters(Parameters):
    """The state of an optimisation in the memory of a device; arrays are tensors.

    Args:
        parameters: the state, in arrays of NumPy.
        device: the device.
    """

    def __init__(self, parameters: Parameters, device: torch.device) -> None:
        self._device = device
        copies: Any = [
            {name: upload(array, device) for name, array in part.items()}
            for part in (parameters.values, parameters.first, parameters.second)
        ]
        super().__init__(copies[0], copies[1], copies[2], parameters.step, parameters.beta2)

    @property
    def alphas(self) -> F32:
        """Opacities, [N], in an array of NumPy."""
        alphas: F32 = self.device_alphas.cpu().numpy()
        return alphas

    @property
    def device_alphas(self) -> Tensor:
        """Opacities, [N], computed in float64 and rounded once."""
        return torch.sigmoid(self.tensors["logits"].double()).float()

    @property
    def tensors(self) -> dict[str, Tensor]:
        """The values."""
        return cast("dict[str, Tensor]", self.values)

    def on_cpu(self) -> Parameters:
        """Return a copy in arrays of NumPy."""
        values, first, second = (
            {name: tensor.cpu().numpy().copy() for name, tensor in part.items()}
            for part in (self.tensors, *self._moments)
        )
        return Parameters(values, first, second, self.step, self.beta2)

    def read(self, name: str, rows: NDArray[np.int64]) -> F32:
        """Return a group's values of some splats, in an array of NumPy."""
        values: F32 = self.tensors[name][self._upload(rows)].cpu().numpy()
        return values

    def write(self, name: str, rows: NDArray[np.int64], values: F32) -> None:
        """Replace a group's values of some splats."""
        self.tensors[name][self._upload(rows)] = self._upload(values)

    def copy_rows(self, sources: NDArray[np.int64], targets: NDArray[np.int64]) -> None:
        """Copy the values of some splats to others."""
        origin, goal = self._upload(sources), self._upload(targets)
        for name in GROUPS:
            self.tensors[name][goal] = self.tensors[name][origin]

    def forget(self, rows: NDArray[np.int64]) -> None:
        """Reset Adam's moments of some splats."""
        chosen = self._upload(rows)
        for memory in self._moments:
            for name in GROUPS:
                memory[name][chosen] = 0.0

    def keep(self, rows: NDArray[np.int64]) -> None:
        """Keep some splats, in this order."""
        chosen = self._upload(rows)
        for part in (self.tensors, *self._moments):
            for name in GROUPS:
                part[name] = part[name][chosen]

    def append_copies(self, sources: NDArray[np.int64]) -> None:
        """Add copies of some splats, with zero moments."""
        chosen = self._upload(sources)
        for name in GROUPS:
            copies = self.tensors[name][chosen]
            self.tensors[name] = torch.cat([self.tensors[name], copies])
            for memory in self._moments:
                memory[name] = torch.cat([memory[name], torch.zeros_like(copies)])

    @torch.no_grad()
    def adam_step(self, gradients: Tensors, rates: Mapping[str, float]) -> None:
        """Make a step of Adam; then normalise quaternions and clip logits, as `parameters.adam_step`."""
        first, second = self._moments
        for name, gradient in gradients.items():
            value = self.tensors[name]
            if value.numel():
                count = torch.full((), float(self.step), device=self._device)
                adam(
                    [value], [gradient.contiguous()], [first[name]], [second[name]], [], [count], fused=True,
                    amsgrad=False, beta1=_BETAS[0], beta2=self.beta2, lr=rates[name], weight_decay=0.0, eps=_EPSILON,
                    maximize=False,
                )  # fmt: skip
        self.step += 1
        quats = self.tensors["quats"]
        length = quats.norm(dim=1, keepdim=True)
        quats.div_(length.clamp_(min=_SHORTEST))
        self.tensors["logits"].clamp_(-_LOGIT_LIMIT, _LOGIT_LIMIT)

    @property
    def _moments(self) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
        """Adam's running means of gradients and of their squares, on the device."""
        return cast("dict[str, Tensor]", self.first), cast("dict[str, Tensor]", self.second)

    def _upload(self, array: NDArray[Any]) -> Tensor:
        """Copy an array to the device."""
        return upload(array, self._device)


def upload(array: NDArray[Any], device: torch.device) -> Tensor:
    """Copy an array to a device."""
    return torch.from_numpy(np.array(array)).to(device)


def as_leaves(tensors: Tensors) -> dict[str, Tensor]:
    """Return tensors in the same memory, for which a backward pass sets `grad`."""
    return {name: tensor.detach().requires_grad_() for name, tensor in tensors.items()}


def gradients_of(leaves: Tensors) -> dict[str, Tensor]:
    """Return the gradients of tensors, 0 for those without influence."""
    return {name: torch.zeros_like(tensor) if tensor.grad is None else tensor.grad for name, tensor in leaves.items()}


def rotations(quats: Tensor) -> Tensor:
    """Return the rotation matrices of unit quaternions, [N, 3, 3]."""
    w, x, y, z = quats.unbind(dim=1)
    rows = [
        1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
        2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
        2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
    ]  # fmt: skip
    return torch.stack(rows, dim=1).reshape(-1, 3, 3)


@contextmanager
def memory_errors() -> Iterator[None]:
    """Turn a full GPU into an `InputError` that names the options."""
    try:
        yield
    except torch.OutOfMemoryError:
        raise InputError(
            "the memory of the GPU is full: train fewer splats (--max-splats), or smaller images (--size)"
        ) from None

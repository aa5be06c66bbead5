# SPDX-License-Identifier: Apache-2.0
# torch may be absent:
# pyright: reportMissingImports=false
"""Quantisers of a file in torch, twins of `FixedQuantisation.dequantise`, which returns the same values bit for bit.

Each function repeats the operations of `csplat.encoder.quantisation`, in the same precision and order. PyTorch on a GPU
multiplies by the reciprocal of a Python number that it is asked to divide by, so divisors are tensors. Values so large
that a tile needs a coarser lattice are not covered; `TorchTuning.free_values` finds them.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from csplat.encoder import FixedQuantisation
from csplat_trainer.torch_parameters import Tensors

_ROOT2 = float.fromhex("0x1.6A09E667F3BCDp+0")  # √2, rounded to float64


@dataclass(frozen=True, eq=False)
class QuantisedValues:
    """Integers of a file's streams, and decoded values of its splats, on a device.

    Attributes:
        scales: [S, 3] integers of the S rows of shapes.
        quats: [S, 3].
        sizes: [N], or [0] without a shape codebook.
        opacities: [N].
        sh0: [N, 3] Y, Co, Cg.
        sh: [R, K, 3] Y, Co, Cg of the R rows of SH.
        splats: the decoded splats, float32; named as in `SplatTensors`.
    """

    scales: Tensor
    quats: Tensor
    sizes: Tensor
    opacities: Tensor
    sh0: Tensor
    sh: Tensor
    splats: Tensors


class TorchQuantisers:
    """The quantisers of a file without quantisation classes.

    Args:
        fixed: the encoder's decisions.
        device: device of the values.

    Attributes:
        sh_rows: [N], row of `FreeValues.sh` of each splat; `None`: rows are splats.
        shape_rows: [N], row of `FreeValues.quats` and `scales`; likewise.
    """

    def __init__(self, fixed: FixedQuantisation, device: torch.device) -> None:
        assert fixed.encode_plan.classes is None, "fine-tuning does not use quantisation classes"
        self._device, self._plan = device, fixed.parameters
        plan, tiles = fixed.parameters, fixed.encode_plan.tiles
        steps = np.empty((len(fixed.encode_plan.model), 1))
        for tile in tiles:
            steps[tile.rows] = math.ldexp(plan.lattice.step, tile.exponent)
        self._mean_steps = self._upload(steps)
        levels = np.arange(plan.opacity_levels + 1, dtype=np.float64)
        self._alphas = self._upload((levels * levels / np.float64(plan.opacity_levels**2)).astype(np.float32))
        self._low, self._high = self._upload(fixed.low), self._upload(fixed.high)
        self._zero = None if fixed.zero is None else self._upload(fixed.zero)[:, :, None]
        book, shapes = fixed.book, fixed.shapes
        self._entries = 0 if book is None else book.size
        self.sh_rows = None if book is None else self._upload(_rows(book.index, book.size))
        coarse = fixed.sh_coarseness()
        self._coarse = None if coarse is None else self._upload(coarse)[:, None]
        self._shapes = 0 if shapes is None else shapes.size
        self.shape_rows = None if shapes is None else self._upload(_rows(shapes.index, shapes.size))
        self._own_shapes = None if shapes is None else self._upload(shapes.escaped)
        self._scale_step32 = torch.tensor(plan.scale_step, dtype=torch.float32, device=device)
        self._scale_step64 = torch.tensor(plan.scale_step, dtype=torch.float64, device=device)
        self._three = torch.tensor(3.0, device=device)

    @torch.no_grad()
    def quantise(self, values: Tensors, alphas: Tensor) -> QuantisedValues:
        """Quantise values, named as in `TunedScene.parameters`, and dequantise them."""
        plan = self._plan
        means = torch.round(values["means"].double() / self._mean_steps) * self._mean_steps
        opacities = torch.round(alphas.sqrt() * float(np.float32(plan.opacity_levels))).int()
        scales, quats = self._scale_integers(values["scales"]), self._quat_integers(values["quats"])
        sizes = torch.round(values["sizes"] / self._scale_step32).int()
        by_splat, turns = scales, quats
        if self.shape_rows is not None:
            by_splat, turns = scales[self.shape_rows] + sizes[:, None], quats[self.shape_rows]
        sh0 = self._colour_integers(values["sh0"], plan.sh0_step, None)
        sh = self._sh_integers(values["shN"])
        decoded_sh = self._lift_colours(sh, plan.sh_step)
        splats = {
            "means": means.float(),
            "quats": self._dequantise_quats(turns),
            "scales": (by_splat.double() * plan.scale_step).float(),
            "opacities": self._alphas[opacities],
            "sh0": self._lift_colours(sh0, plan.sh0_step),
            "shN": decoded_sh if self.sh_rows is None else decoded_sh[self.sh_rows],
        }
        return QuantisedValues(scales, quats, sizes, opacities, sh0, sh, splats)

    @torch.no_grad()
    def constrain(self, values: Tensors) -> None:
        """Restrict values in place, as `FixedQuantisation.constrain`."""
        torch.clamp(values["means"], self._low, self._high, out=values["means"])
        quats = values["quats"]
        quats.mul_(torch.where(quats[:, :1] < 0.0, -1.0, 1.0))
        if self._zero is not None:
            values["shN"].masked_fill_(self._zero, 0.0)
        if self._own_shapes is not None:
            values["sizes"].masked_fill_(self._own_shapes, 0.0)

    def _scale_integers(self, scales: Tensor) -> Tensor:
        """Return the integers of log-scales [S, 3]; the quotient is float32 for entries, float64 for other rows."""
        shared = torch.round(scales[: self._shapes] / self._scale_step32).int()
        own = torch.round(scales[self._shapes :].double() / self._scale_step64).int()
        return torch.cat([shared, own])

    def _quat_integers(self, quats: Tensor) -> Tensor:
        """Return the integers of x, y, z [S, 3], rounded towards 0 if w would be the root of a negative number."""
        levels = self._plan.quat_levels
        scaled = quats[:, 1:] * float(np.float32(levels * _ROOT2))
        q = torch.round(scaled).int().clamp(-levels, levels)
        beyond = q.long().square().sum(dim=1, keepdim=True) > 2 * levels * levels
        return torch.where(beyond, torch.trunc(scaled).int(), q)

    def _dequantise_quats(self, q: Tensor) -> Tensor:
        """Return quaternions [S, 4] of unit length from the integers of x, y, z [S, 3]; w is not negative."""
        levels = self._plan.quat_levels
        c, wide = 1.0 / (levels * _ROOT2), q.double()
        w = torch.sqrt(2.0 * levels * levels - wide.square().sum(dim=1, keepdim=True)) * c
        return torch.cat([w, wide * c], dim=1).float()

    def _sh_integers(self, sh: Tensor) -> Tensor:
        """Return Y, Co, Cg of rows of SH, [R, K, 3]; all but codebook entries are rounded to the coarse multiples."""
        if self.sh_rows is None:
            return self._colour_integers(sh, self._plan.sh_step, self._coarse)
        entries = self._colour_integers(sh[: self._entries], self._plan.sh_step, None)
        return torch.cat([entries, self._colour_integers(sh[self._entries :], self._plan.sh_step, self._coarse)])

    def _colour_integers(self, rgb: Tensor, step: float, coarse: Tensor | None) -> Tensor:
        """Return Y, Co, Cg [..., 3] as integers, multiples of 2**coarse if that is given; see `colour_integers`."""
        shift = self._plan.chroma_shift
        r, g, b = (rgb * float(np.float32(1.0 / step))).unbind(dim=-1)
        fraction = 0.5**shift
        co = _round_to_multiples((r - b) * fraction, coarse)
        cg = _round_to_multiples((g - (r + b) * 0.5) * fraction, coarse)
        full_co, full_cg = co << shift, cg << shift
        y = ((r + g + b).double() - (full_cg + full_co - 2 * (full_co >> 1))).float() / self._three
        y = (y.double() + (full_cg >> 1)).float()
        return torch.stack([_round_to_multiples(y, coarse), co, cg], dim=-1)

    def _lift_colours(self, columns: Tensor, step: float) -> Tensor:
        """Return decoded red, green, blue [..., 3] from Y, Co, Cg [..., 3]; see `lift_colour`."""
        shift = self._plan.chroma_shift
        y, co, cg = columns.unbind(dim=-1)
        co, cg = co << shift, cg << shift
        t = y - (cg >> 1)
        b = t - (co >> 1)
        return (torch.stack([b + co, cg + t, b], dim=-1).double() * step).float()

    def _upload(self, array: NDArray[np.generic]) -> Tensor:
        return torch.from_numpy(np.ascontiguousarray(array)).to(self._device)


def _round_to_multiples(values: Tensor, coarse: Tensor | None) -> Tensor:
    """Round values to int32 multiples of 2**coarse, which is broadcast to their shape; `None`: to integers."""
    if coarse is None:
        return torch.round(values).int()
    return torch.round(values * torch.exp2(-coarse.float())).int() << coarse


def _rows(index: NDArray[np.int32], size: int) -> NDArray[np.int64]:
    """Return the row of each splat, [N]: its entry, or, after all entries, its place among the escaped splats."""
    rows = index.astype(np.int64)
    escaped = rows == size
    rows[escaped] += np.arange(np.count_nonzero(escaped))
    return rows

"""State of fine-tuning: values in float, and their quantised form in the file that will be written.

Straight through: images are rendered from the values that a decoder will return, and their gradients are applied to the
values that were quantised, as if nothing lay between (Bengio et al. 2013, https://arxiv.org/abs/1308.3432). A
codebook's entry gets the sum of the gradients of all splats that use it.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from csplat.encoder import DecodedValues, FreeValues, Frozen
from csplat.types import F32, I64
from csplat_render.conventions import Gradients
from csplat_render.kernels import parallel_kernel
from csplat_trainer.parameters import Parameters, Splats, adam_step, sigmoid
from csplat_trainer.tuning.rate import Costs, Stored

_ALPHAS = (1e-6, 1.0 - 1e-6)  # range of the opacities that logits are computed from


class TunedScene:
    """Values of a frozen scene, Adam's memory of them, and the way from pictures' gradients to both.

    Args:
        frozen: the encoder's decisions.
        parameters: state to go on from; `None`: the values that the encoder found.

    Attributes:
        frozen: as given.
        parameters: named as in training, but `quats`, `scales`, `shN` hold the rows of `FreeValues`; and `sizes`.
    """

    def __init__(self, frozen: Frozen, parameters: Parameters | None = None) -> None:
        self.frozen = frozen
        self.parameters = parameters or Parameters.starting_at(_values(frozen.start()))
        values, book, shapes = self.parameters.values, frozen.book, frozen.shapes
        self._users = None if book is None else _users(book.index, book.size)
        self._escaped = np.zeros(0, np.int64) if book is None else book.escaped
        self._rows_gradient = np.zeros_like(values["shN"] if book else values["shN"][:0])
        self._shape_users = None if shapes is None else _users(shapes.index, shapes.size)
        self._own_shape = np.zeros(0, np.int64) if shapes is None else np.flatnonzero(shapes.escaped)

    @property
    def held(self) -> FreeValues:
        """The values as the encoder takes them; all but the opacities are the parameters' own arrays."""
        return self._held(sigmoid(self.parameters.values["logits"]))

    def _held(self, alphas: F32) -> FreeValues:
        v = self.parameters.values
        return FreeValues(v["means"], v["quats"], v["scales"], alphas, v["sh0"], v["shN"], v["sizes"])

    def seen(self) -> tuple[DecodedValues, F32]:
        """Return the values that a decoder will return, and the opacities before they were quantised."""
        held = self.held
        return self.frozen.seen(held), held.opacities

    def stored(self, seen: DecodedValues) -> Stored:
        """Return the contents of the file's streams, as a decoder will return them."""
        sh = self.frozen.seen_rows(self.parameters.values["shN"]) if self.frozen.book is not None else seen.shN
        if self.frozen.shapes is None:
            return Stored(seen.quats, seen.scales, self.parameters.values["sizes"], seen.opacities, seen.sh0, sh)
        quats, scales, sizes = self.frozen.seen_shape_rows(self._held(seen.opacities), seen)
        return Stored(quats, scales, sizes, seen.opacities, seen.sh0, sh)

    def count(self, seen: DecodedValues, weight: float) -> Costs:
        """Count what the integers of the file cost, at a weight in loss per bit and splat."""
        return Costs.counted(self.frozen, self.stored(seen), weight)

    def step(
        self, gradients: Gradients, seen: DecodedValues, alphas: F32, rates: dict[str, float], costs: Costs | None
    ) -> None:
        """Move the values against the gradients by what was seen.

        Args:
            gradients: gradients of the loss.
            seen, alphas: as `seen` returned them.
            rates: learning rate of each group.
            costs: costs of bytes, a further part of the loss.
        """
        quats, scales, sizes = self._by_shape(gradients)
        steps = {
            "means": gradients.means,
            "quats": quats,
            "scales": scales,
            "sizes": sizes,
            "logits": gradients.opacities * (alphas * (np.float32(1.0) - alphas)),
            "sh0": gradients.sh0,
            "shN": self._by_row(gradients.shN),
        }
        if costs is not None:
            costs.add_to(steps, self.stored(seen))
        adam_step(self.parameters, steps, rates)
        self.frozen.constrain(self._held(alphas))

    def _by_row(self, by_splat: F32) -> F32:
        """Gradients of the rows of SH that the file holds, of those of all splats [N, K, 3]."""
        book = self.frozen.book
        if book is None or self._users is None:
            return by_splat
        rows, (order, starts) = self._rows_gradient, self._users
        rows[: book.size] = _summed(by_splat, order, starts, book.size)
        rows[book.size :] = by_splat[self._escaped]
        return rows

    def _by_shape(self, gradients: Gradients) -> tuple[F32, F32, F32]:
        """Gradients of the rotations and scales that the file holds, and of what splats add to the latter."""
        shapes = self.frozen.shapes
        if shapes is None or self._shape_users is None:
            return gradients.quats, gradients.scales, np.zeros(0, np.float32)
        own, (order, starts) = self._own_shape, self._shape_users
        quats, scales = (
            np.concatenate([_summed(part, order, starts, shapes.size), part[own]])
            for part in (gradients.quats, gradients.scales)
        )
        return quats, scales, gradients.scales.sum(axis=1)


def _values(held: FreeValues) -> Splats:
    alpha = np.clip(held.opacities.astype(np.float64), *_ALPHAS)
    return {
        "means": held.means,
        "quats": held.quats,
        "scales": held.scales,
        "logits": np.log(alpha / (1.0 - alpha)).astype(np.float32),
        "sh0": held.sh0,
        "shN": held.sh,
        "sizes": held.sizes,
    }


def _users(index: NDArray[np.int32], size: int) -> tuple[I64, I64]:
    """Splats by the entry that they use, and where those of each entry begin, [size + 1]; escaped ones come last."""
    order = np.argsort(index, kind="stable")
    starts = np.searchsorted(index[order], np.arange(size + 1))
    return order.astype(np.int64), starts.astype(np.int64)


def _summed(values: F32, order: I64, starts: I64, size: int) -> F32:
    flat = np.empty((size, values[0].size), np.float32)
    sum_by_entry(values.reshape(len(values), -1), order, starts, flat)
    return flat.reshape(size, *values.shape[1:])


@parallel_kernel()
def sum_by_entry(lane: int, lanes: int, values: F32, order: I64, starts: I64, out: F32) -> None:
    """Sum the rows of the users of each entry, in float32 and in their order; vectorises over a row.

    Args:
        values: [N, C].
        order: [N], rows of `values` by entry.
        starts: [size + 1], index in `order` of an entry's first user.
        out: [size, C], overwritten.
    """
    for entry in range(lane, out.shape[0], lanes):
        total = out[entry]
        total[:] = np.float32(0.0)
        for at in range(starts[entry], starts[entry + 1]):
            row = values[order[at]]
            for c in range(out.shape[1]):
                total[c] += row[c]


def sum_by_entry_twin(values: F32, order: I64, starts: I64, out: F32) -> None:
    """The slow twin of `sum_by_entry`."""
    for entry in range(len(out)):
        out[entry] = values[order[starts[entry] : starts[entry + 1]]].sum(axis=0)

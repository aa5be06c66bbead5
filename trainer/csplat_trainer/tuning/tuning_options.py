# SPDX-License-Identifier: Apache-2.0
"""`FinetuneOptions`."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

from csplat.errors import InputError
from csplat_trainer.training_options import DEVICES, ENGINES, LOSSES, Device, EngineName, Loss, uses_torch


@dataclass(frozen=True)
class FinetuneOptions:
    """Options of fine-tuning. Learning rates rise for `warm_up` steps, and fall to `decay` along half a cosine.

    Attributes:
        iterations: steps at most, one image each.
        seed: seed of the order of the images; `None`: that of the context.
        device, engine: as in `TrainOptions`.
        loss: `inria`, `study` or `l1`, as in `TrainOptions`.
        lr_means: learning rate of the means, as a fraction of the median of the splats' middle standard deviation.
        lr_quats: learning rate of the rotations.
        lr_scales: learning rate of the log scales.
        lr_opacities: learning rate of the logits of opacity.
        lr_sh0: learning rate of the base colour.
        lr_shN: learning rate of the higher SH coefficients.
        lr_entries: learning rate of the codebook's entries.
        lr_exposure: as in `TrainOptions`; 0: gains and biases of images are not trained.
        lambda_: lambda, loss per bit and splat; 0: the size of the file has no influence.
        warm_up: steps of small learning rates, in which Adam estimates the magnitude of gradients.
        decay: final fraction of the learning rates. It is tiny, since otherwise values alternate between two integers.
        validate_every: steps between evaluations on the validation views.
        patience: number of evaluations without a gain that end a run early; 0: never. Evaluations count only when the
            learning rates have fallen to a quarter, since values fluctuate before, and when a target size is met.
        log_every: steps between entries of the log.

    Raises:
        InputError: a value is out of range.
    """

    iterations: int = 1_000
    seed: int | None = None
    device: Device = "cpu"
    engine: EngineName = "auto"
    loss: Loss = "inria"
    lr_means: float = 0.1
    lr_quats: float = 8e-3
    lr_scales: float = 2e-2
    lr_opacities: float = 0.1
    lr_sh0: float = 1e-2
    lr_shN: float = 2e-3
    lr_entries: float = 4e-3
    lr_exposure: float = 0.0
    lambda_: float = 1e-4
    warm_up: int = 100
    decay: float = 5e-4
    validate_every: int = 100
    patience: int = 4
    log_every: int = 100

    def __post_init__(self) -> None:
        for name, choices in (("loss", LOSSES), ("device", DEVICES), ("engine", ENGINES)):
            if getattr(self, name) not in choices:
                raise InputError(f"{name} is {getattr(self, name)!r}, expected one of {', '.join(choices)}")
        uses_torch(self.device, self.engine)
        for name, (low, high) in _RANGES.items():
            value = getattr(self, name)
            if value is not None and not (math.isfinite(value) and low <= value <= high):
                raise InputError(f"{name.rstrip('_')} is {value}, expected {low:g} to {high:g}")

    def learning_rate_factor(self, iteration: int) -> float:
        """Return the factor of the learning rates at a step."""
        done = (iteration - 1) / self.iterations
        rising = min(1.0, iteration / (self.warm_up + 1))
        return rising * (self.decay + (1.0 - self.decay) * 0.5 * (1.0 + math.cos(math.pi * done)))

    def has_calmed(self, iteration: int) -> bool:
        """Return True if evaluations without a gain count."""
        return iteration > 0.5 * self.iterations and self.learning_rate_factor(iteration) <= _CALM

    def scaled(self, factor: float) -> FinetuneOptions:
        """Return the options with all learning rates multiplied by a factor."""
        rates = {name: getattr(self, name) * factor for name in _RANGES if name.startswith("lr_")}
        return replace(self, **rates)


_CALM = 0.25  # factor of the learning rates; below it, evaluations without a gain count

_RANGES: dict[str, tuple[float, float]] = {
    "iterations": (1, 10**7),
    "seed": (0, 2**63 - 1),
    "lr_means": (0, 10),
    "lr_quats": (0, 1),
    "lr_scales": (0, 1),
    "lr_opacities": (0, 10),
    "lr_sh0": (0, 1),
    "lr_shN": (0, 1),
    "lr_entries": (0, 1),
    "lr_exposure": (0, 1),
    "lambda_": (0, 1),
    "warm_up": (0, 10**7),
    "decay": (0, 1),
    "validate_every": (1, 10**7),
    "patience": (0, 10**6),
    "log_every": (1, 10**7),
}

# SPDX-License-Identifier: Apache-2.0
"""`TrainOptions`; the files that a run reads and writes, and its result."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Literal, get_args

from csplat.errors import InputError
from csplat.model import MAX_SH_DEGREE, SplatModel

#: Strategies of adding and removing splats: `mcmc` grows to the cap and moves dead splats, with noise and
#: regularisation; `fixed` starts at the cap and moves dead splats; `gradient` clones, splits and prunes; `none` keeps
#: the initial splats.
Strategy = Literal["mcmc", "fixed", "gradient", "none"]
Loss = Literal["inria", "study", "l1"]
Init = Literal["auto", "points", "hull", "box"]
Background = Literal["auto", "black", "white", "random"]
Device = Literal["cpu", "cuda"]
EngineName = Literal["auto", "native", "torch"]
STRATEGIES: tuple[Strategy, ...] = get_args(Strategy)
LOSSES: tuple[Loss, ...] = get_args(Loss)
INITS: tuple[Init, ...] = get_args(Init)
BACKGROUNDS: tuple[Background, ...] = get_args(Background)
DEVICES: tuple[Device, ...] = get_args(Device)
ENGINES: tuple[EngineName, ...] = get_args(EngineName)


@dataclass(frozen=True)
class TrainOptions:
    """Options of training. The defaults suit thousands to a hundred thousand splats on a CPU.

    They differ from the usual options in the learning rates of means and higher SH bands (twice the rates of the first
    publication), the noise (the same in scene units) and the weight of the mean opacity (0.003 instead of 0.01): Lego
    with 10,000 splats gained 1.1 dB in 7,000 steps.

    Attributes:
        max_splats: largest number of splats.
        sh_degree: SH degree of the finished scene, 0 to 4.
        iterations: training steps, one image each.
        seed: seed of every random choice; `None`: that of the context.
        device: `cpu`, or `cuda`, a GPU with the gsplat package.
        engine: `native` (compiled, on a CPU), `torch` (slower on a CPU), or `auto`: native on a CPU, torch on a GPU.
        strategy: strategy of adding and removing splats: `mcmc`, `fixed`, `gradient` or `none`.
        init: initial positions of splats: at the data set's `points`, inside the visual `hull` of the alpha masks,
            anywhere in the scene's `box`, or (`auto`) the first of these that is possible.
        initial_splats: initial number of splats; 0: the strategy decides.
        final_share: final fraction of the splats: when the strategy has ended, splats of low importance are pruned, a
            few at a time. 1: all are kept.
        background: background colour of splats, and of images with an alpha channel. `auto`: white if most images have
            one, else black; `random`: another one at each step, evaluated on white.
        antialiased: train with the mip-splatting low-pass filter.
        loss: `inria` 0.8 L1 + 0.2 (1 − SSIM), `study` L1 + 0.2 (1 − SSIM), `l1` L1 alone.
        lpips_weight: weight of a perceptual term, LPIPS-Alex, which requires torch and the weights; 0: none.
        lr_means: initial learning rate of the means, as a fraction of the scene's extent; falls exponentially to
            `lr_means_final`.
        lr_means_final: final learning rate of the means.
        lr_quats: learning rate of the rotations.
        lr_scales: learning rate of the log scales.
        lr_opacities: learning rate of the logits of opacity.
        lr_sh0: learning rate of the base colour.
        lr_shN: learning rate of the higher SH coefficients.
        lr_exposure: learning rate of a gain and a bias per image and channel, for images of different exposure; they
            are not part of the scene. Falls exponentially to a twentieth; 0: they are not trained.
        lr_decay: the other rates fall to this fraction, along half a cosine from `refine_stop` (unless that is 1) to
            the end.
        half_size: fraction of the iterations, at the start, that train on images of half the width and height, while
            splats are few and inaccurate.
        sh_interval: steps per SH degree; 0: a fifteenth of the iterations, at most 1000.
        opacity_weight: weight of the mean opacity in the loss (mcmc and fixed).
        scale_weight: weight of the mean standard deviation in the loss (mcmc and fixed).
        noise: noise of the positions, as a multiple of their learning rate (mcmc and fixed).
        dead_opacity: splats below this opacity are moved (mcmc, fixed) or removed (gradient).
        refine_start: first step after which the strategy may act; 0: 500, at most an eighth of the iterations.
        refine_stop: fraction of the iterations after which the strategy ends.
        refine_every: steps between its actions; 0: 100, at most a fortieth of the iterations.
        growth: growth factor of mcmc per action; 0: 1.05, or a larger factor that reaches the cap halfway to
            `refine_stop`.
        grad_threshold: `gradient` densifies splats whose mean gradient on screen, in pixels of half an image, is above
            this.
        eval_every: steps between evaluations on the test views; 0: only at the end.
        eval_views: test views of an evaluation; 0: all of them.
        log_every: steps between entries of the log.

    Raises:
        InputError: a value is out of range.
    """

    max_splats: int = 20_000
    sh_degree: int = 3
    iterations: int = 7_000
    seed: int | None = None
    device: Device = "cpu"
    engine: EngineName = "auto"
    strategy: Strategy = "mcmc"
    init: Init = "auto"
    initial_splats: int = 0
    final_share: float = 1.0
    background: Background = "auto"
    antialiased: bool = False
    loss: Loss = "inria"
    lpips_weight: float = 0.0
    lr_means: float = 3.2e-4
    lr_means_final: float = 3.2e-6
    lr_quats: float = 1e-3
    lr_scales: float = 5e-3
    lr_opacities: float = 5e-2
    lr_sh0: float = 2.5e-3
    lr_shN: float = 2.5e-4
    lr_exposure: float = 0.0
    lr_decay: float = 1.0
    half_size: float = 0.0
    sh_interval: int = 0
    opacity_weight: float = 0.003
    scale_weight: float = 0.01
    noise: float = 2.5e5
    dead_opacity: float = 0.005
    refine_start: int = 0
    refine_stop: float = 0.8
    refine_every: int = 0
    growth: float = 0.0
    grad_threshold: float = 2e-4
    eval_every: int = 0
    eval_views: int = 0
    log_every: int = 100

    def __post_init__(self) -> None:
        if str(self.device) == "mps":
            raise InputError("device mps is not supported: use --device cpu")
        for name, choices in _CHOICES.items():
            if getattr(self, name) not in choices:
                raise InputError(f"{name} is {getattr(self, name)!r}, expected one of {', '.join(choices)}")
        uses_torch(self.device, self.engine)
        for name, (low, high) in _RANGES.items():
            value = getattr(self, name)
            if value is not None and not (math.isfinite(value) and low <= value <= high):
                raise InputError(f"{name.rstrip('_')} is {value}, expected {low:g} to {high:g}")
        if self.lr_means_final > self.lr_means:
            raise InputError(f"lr_means_final is {self.lr_means_final:g}, expected at most lr_means, {self.lr_means:g}")

    @property
    def sh_every(self) -> int:
        """Steps per SH degree."""
        return self.sh_interval or min(1000, max(1, self.iterations // 15))

    @property
    def refine_begin(self) -> int:
        """First step after which the strategy may act."""
        return self.refine_start or max(1, min(500, self.iterations // 8))

    @property
    def refine_period(self) -> int:
        """Steps between the actions of the strategy."""
        return self.refine_every or min(100, max(_LEAST_PERIOD, self.iterations // 40))

    @property
    def refine_end(self) -> int:
        """Last step after which the strategy may act."""
        return int(self.refine_stop * self.iterations)

    def is_half_size(self, iteration: int) -> bool:
        """Return True if a step trains on an image of half the size."""
        return iteration <= self.half_size * self.iterations

    def active_degree(self, iteration: int) -> int:
        """Return the SH degree that is trained at a step."""
        return min(self.sh_degree, iteration // self.sh_every)

    def refines_after(self, iteration: int) -> bool:
        """Return True if the strategy acts after a step."""
        due = iteration % self.refine_period == 0
        return self.strategy != "none" and due and self.refine_begin <= iteration <= self.refine_end

    def prunings_left(self, iteration: int) -> int:
        """Return the number of prunings left, including the one after this step; 0 if there is none after this step.

        The last pruning is followed by 40 % of the steps after the end of the strategy.
        """
        begin = min(self.refine_end, self.iterations - 1)
        steps = max(1, int(_PRUNING_FRACTION * (self.iterations - begin)))
        pruning_count = min(_MAX_PRUNINGS, steps)
        number, steps_since = divmod(iteration - begin, steps // pruning_count)  # of the pruning, from 1
        if self.final_share >= 1.0 or steps_since > 0 or number <= 0:
            return 0
        return max(0, pruning_count + 1 - number)

    def growth_from(self, count: int) -> float:
        """Return the growth factor per action of a run that starts with `count` splats."""
        if self.growth:
            return self.growth
        times = self.refine_end // 2 // self.refine_period - (self.refine_begin - 1) // self.refine_period
        return max(_GROWTH, math.pow(self.max_splats / max(1, count), 1.0 / max(1, times)))

    def learning_rates(self, iteration: int, extent: float) -> dict[str, float]:
        """Return the learning rate of each group of parameters at a step.

        Args:
            iteration: 1 for the first.
            extent: radius of the cameras' positions, scene units.
        """
        done = iteration / self.iterations
        means = self.lr_means
        if means > 0.0:
            means *= (self.lr_means_final / means) ** done if self.lr_means_final > 0.0 else 1.0 - done
        # Fraction of the steps after the end of the strategy, over which the rates fall along half a cosine.
        refined = max(0, iteration - self.refine_end) / max(1, self.iterations - self.refine_end)
        decay = self.lr_decay + (1.0 - self.lr_decay) * (0.5 + 0.5 * math.cos(math.pi * min(1.0, refined)))
        return {
            "means": means * extent,
            "quats": self.lr_quats * decay,
            "scales": self.lr_scales * decay,
            "logits": self.lr_opacities * decay,
            "sh0": self.lr_sh0 * decay,
            "shN": self.lr_shN * decay,
            "exposure": self.lr_exposure * _LAST_EXPOSURE**done,
        }


def uses_torch(device: Device, engine: EngineName) -> bool:
    """Return True if an engine in torch makes the steps.

    Raises:
        InputError: the engine does not run on the device.
    """
    if device != "cpu" and engine == "native":
        raise InputError(f"engine is native, expected auto or torch with device {device}")
    return device != "cpu" or engine == "torch"


_LEAST_PERIOD = 10  # steps between actions of the strategy in short trainings: Adam settles new splats in about as many
_GROWTH = 1.05  # growth factor of the MCMC paper
_MAX_PRUNINGS = 10  # largest number of prunings
_PRUNING_FRACTION = 0.6  # fraction of the steps after the end of the strategy over which prunings are spread
_LAST_EXPOSURE = 0.05  # final fraction of the learning rate of image gains

_CHOICES = {
    "device": DEVICES,
    "engine": ENGINES,
    "strategy": STRATEGIES,
    "init": INITS,
    "background": BACKGROUNDS,
    "loss": LOSSES,
}

_RANGES: dict[str, tuple[float, float]] = {
    "max_splats": (1, 2**25),
    "sh_degree": (0, MAX_SH_DEGREE),
    "iterations": (1, 10**7),
    "seed": (0, 2**63 - 1),
    "initial_splats": (0, 2**25),
    "final_share": (1e-6, 1),
    "lpips_weight": (0, 100),
    "lr_means": (0, 1),
    "lr_means_final": (0, 1),
    "lr_quats": (0, 1),
    "lr_scales": (0, 1),
    "lr_opacities": (0, 10),
    "lr_sh0": (0, 1),
    "lr_shN": (0, 1),
    "lr_exposure": (0, 1),
    "lr_decay": (1e-6, 1),
    "half_size": (0, 1),
    "sh_interval": (0, 10**7),
    "opacity_weight": (0, 100),
    "scale_weight": (0, 100),
    "noise": (0, 1e9),
    "dead_opacity": (0, 0.5),
    "refine_start": (0, 10**7),
    "refine_stop": (0, 1),
    "refine_every": (0, 10**7),
    "growth": (0, 10),
    "grad_threshold": (0, 1),
    "eval_every": (0, 10**7),
    "eval_views": (0, 10**6),
    "log_every": (1, 10**7),
}


@dataclass(frozen=True)
class Outputs:
    """Files that a run reads and writes, other than its data set.

    Attributes:
        checkpoint: file for checkpoints (each replaces the last), which SIGINT and SIGTERM write, too; or `None`.
        checkpoint_seconds: time between checkpoints, longer if writing one takes more than a twentieth of it; 0: a
            checkpoint after each step.
        preview: a PNG of an image next to its render, which is renewed during a training; or `None`.
        preview_seconds: time between its renewals.
        resume: checkpoint to continue from, or `None`.
        lpips_weights: file of the weights of LPIPS-Alex; `None`: see `csplat_render.lpips`.
    """

    checkpoint: str | Path | None = None
    checkpoint_seconds: float = 60.0
    preview: str | Path | None = None
    preview_seconds: float = 10.0
    resume: str | Path | None = None
    lpips_weights: str | Path | None = None


def save_to(outputs: Outputs, save: Callable[[str | Path], None]) -> Callable[[], None] | None:
    """Return a function that writes the checkpoint of a run by `save`; `None` if it has none."""
    return None if outputs.checkpoint is None else partial(save, outputs.checkpoint)


@dataclass(frozen=True)
class TrainResult:
    """Result of a run.

    Attributes:
        model: the scene.
        log: JSON-compatible: options, entries, the loss of each step, scores, times.
        metrics: scores on the test images, see `evaluate`; `None` if there are none.
    """

    model: SplatModel
    log: dict[str, Any]
    metrics: dict[str, Any] | None

# SPDX-License-Identifier: Apache-2.0
"""`Fitter`: the loop of training, quantisation-aware tuning and refitting, an image per step."""

from __future__ import annotations

import math
import signal
import time
from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

from numpy.random import PCG64, Generator

from csplat.errors import InputError
from csplat.system import interrupts_noted
from csplat.types import F32
from csplat_render.metrics import psnr_of_mse
from csplat_trainer.fit_checkpoint import FitCheckpoint, Kind, save_checkpoint
from csplat_trainer.image_gains import ImageGain, ImageGains
from csplat_trainer.losses import LossValue, PendingLoss
from csplat_trainer.parameters import Parameters
from csplat_trainer.tuned_scene import RateTerm

COUNT_EVERY = 50  # steps between counts of the file's integers for the rate term
_FIRST_REPORTS = (2, 10, 30)  # steps
_SAVING = 20.0  # minimum ratio of the time between checkpoints to the time that writing one takes
_MOST_PENDING = 20  # losses to be read at once; reading a loss lets a GPU wait for the next step


@dataclass(frozen=True)
class FitStep:
    """Progress of a training or a tuning.

    Attributes:
        iteration, iterations: number of steps so far, and of all steps.
        loss: mean over the steps since the last report.
        psnr: PSNR on the training images since the last report, pooled, dB.
        splat_count: current number of splats.
        sh_degree: active SH degree.
        seconds, seconds_left: time since the start, and estimated remaining time.
        size_bytes: size of the tuned file at its last evaluation; `None` in a training.
    """

    iteration: int
    iterations: int
    loss: float
    psnr: float
    splat_count: int
    sh_degree: int
    seconds: float
    seconds_left: float
    size_bytes: int | None = None


class Fit(Protocol):
    """The values that a `Fitter` fits, and their loss."""

    def step(self, view: int) -> PendingLoss:
        """Move the values against the gradient of a view's loss, and return the loss before."""
        ...

    def after_step(self) -> None:
        """Do what is due after the step: refine, validate, report."""
        ...


class Fitter:
    """The state of a descent, apart from the fitted values.

    Args:
        view_count: number of images.
        iterations: number of steps.
        seed: seed of the random generator.

    Attributes:
        iterations: as given.
        iteration: number of steps so far, including the current step.
        has_ended: set to end the run after the current step.
        rng: the random generator.
        queue: indices of the images that remain in this epoch; the last is the next.
        gains: gain and bias of each image.
        rate: the rate term of the loss, if there is one.
        log: loss of each step, seconds, and what users of the loop add; JSON-compatible.
    """

    def __init__(self, view_count: int, iterations: int, seed: int) -> None:
        self.iterations, self.iteration, self.has_ended = iterations, 0, False
        self.rng = Generator(PCG64(seed))
        self.queue: list[int] = []
        self.gains = ImageGains(view_count)
        self.rate: RateTerm | None = None
        self.log: dict[str, Any] = {"losses": [], "seconds": 0.0}
        self._window: list[LossValue] = []
        self._pending: list[PendingLoss] = []
        self._begin = time.perf_counter()
        self._steps_before, self._seconds_before = 0, 0.0  # steps and seconds of the run that a checkpoint continues

    def resume(self, checkpoint: FitCheckpoint) -> None:
        """Continue from a checkpoint.

        Raises:
            InputError: it has gains of another number of images.
        """
        view_count = len(self.gains.values)
        self.iteration = self._steps_before = checkpoint.iteration
        self.has_ended = checkpoint.has_ended
        self.rng.bit_generator.state = checkpoint.rng_state
        self.queue = [view for view in checkpoint.queue if view < view_count]
        self.gains = ImageGains(view_count, checkpoint.gains)
        self.log |= checkpoint.log
        self._seconds_before = float(self.log["seconds"])

    def save(
        self,
        path: str | Path,
        kind: Kind,
        options: dict[str, Any],
        parameters: Parameters,
        *,
        own: dict[str, Any],
        arrays: dict[str, F32] | None = None,
    ) -> None:
        """Write a checkpoint; arguments as in `FitCheckpoint`."""
        self._read_losses()
        self.log["seconds"] = self.seconds
        gains = self.gains.as_json() if self.gains.values.any() else []
        save_checkpoint(
            path,
            FitCheckpoint(
                kind, self.iteration, self.has_ended, dict(self.rng.bit_generator.state), self.queue, gains, options,
                self.log, parameters, own, arrays or {},
            ),
        )  # fmt: skip

    def run(self, fit: Fit, save: Callable[[], None] | None = None, *, every: float = 0.0) -> None:
        """Make the remaining steps, and write checkpoints: by time, at the end, and if a signal interrupts the run.

        Args:
            fit: the values to fit.
            save: writes a checkpoint of the state between two steps; `None`: there are none.
            every: time between checkpoints, seconds; longer if writing them would take more than a twentieth of it.

        Raises:
            KeyboardInterrupt, SystemExit: SIGINT or SIGTERM arrived. With checkpoints, the step was completed, and a
                checkpoint written.
        """
        wait, saved = every, time.perf_counter()
        with nullcontext(list[int]()) if save is None else interrupts_noted(signal.SIGINT, signal.SIGTERM) as signals:
            while self.iteration < self.iterations and not self.has_ended and not signals:
                self.iteration += 1
                self.step(fit)
                fit.after_step()
                now = time.perf_counter()
                if save is not None and now - saved >= wait:
                    save()
                    saved = time.perf_counter()
                    wait = max(every, _SAVING * (saved - now))
            self._read_losses()
            self.log["seconds"] = self.seconds
            if save is not None:
                save()

    def step(self, fit: Fit) -> None:
        """Make a step on the next image of the queue, which is filled in random order when it is empty."""
        if not self.queue:
            self.queue = self.rng.permutation(len(self.gains.values)).tolist()
        value = fit.step(self.queue.pop())
        self._pending.append(value)
        if isinstance(value, LossValue) or len(self._pending) == _MOST_PENDING:
            self._read_losses()

    def _read_losses(self) -> None:
        """Add the losses of the pending steps to the log and the window of `report`.

        Raises:
            InputError: a loss is not finite.
        """
        first = self.iteration - len(self._pending) + 1
        for step, pending in enumerate(self._pending, first):
            value = pending.read()
            if not math.isfinite(value.loss):
                raise InputError(f"the loss is not finite at step {step}: try smaller learning rates")
            self._window.append(value)
            self.log["losses"].append(float(f"{value.loss:.6g}"))
        self._pending.clear()

    def gain(self, view: int, rate: float) -> ImageGain | None:
        """Return the correction of an image, to be trained at a learning rate; `None` if that is 0."""
        return ImageGain(self.gains, view, rate) if rate else None

    def report_is_due(self, every: int) -> bool:
        """Return True after every Nth step, the last, and some of the first, from which times are estimated."""
        return self.is_last or self.is_due(every) or self.iteration in _FIRST_REPORTS

    def is_due(self, every: int) -> bool:
        """Return True after every Nth step; never for 0."""
        return every > 0 and self.iteration % every == 0

    @property
    def is_last(self) -> bool:
        """True after the last step."""
        return self.has_ended or self.iteration == self.iterations

    def report(
        self, splat_count: int, sh_degree: int, *, seconds_left: float | None = None, size_bytes: int | None = None
    ) -> FitStep:
        """Return the progress since the last report; arguments as in `FitStep`, `None`: estimate the time left."""
        self._read_losses()
        window, self._window = self._window, []
        loss = sum(value.loss for value in window) / len(window)
        mse = sum(value.mse for value in window) / len(window)
        return FitStep(
            self.iteration, self.iterations, loss, psnr_of_mse(mse), splat_count, sh_degree, self.seconds,
            self.seconds_left if seconds_left is None else seconds_left, size_bytes,
        )  # fmt: skip

    @property
    def seconds(self) -> float:
        """Time since the start of the run, without interruptions."""
        return self._seconds_before + time.perf_counter() - self._begin

    @property
    def seconds_left(self) -> float:
        """Estimated time of the remaining steps."""
        per_step = (self.seconds - self._seconds_before) / (self.iteration - self._steps_before)
        return per_step * (self.iterations - self.iteration)

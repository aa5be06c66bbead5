# SPDX-License-Identifier: Apache-2.0
"""`tune`: optimise the values of a fixed quantisation until renders of its file match the reference images.

For a target size, `RateController` adjusts lambda, the loss per bit and splat, to the number of bits.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Callable
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np

from csplat.context import DEFAULT_CONTEXT, Context
from csplat.encoder import FixedQuantisation, FreeValues
from csplat.errors import InputError
from csplat_render.kernels import thread_count
from csplat_render.metrics import psnr_of_mse
from csplat_trainer.device_measurements import make_rasteriser
from csplat_trainer.fit_checkpoint import check_arrays, load_checkpoint
from csplat_trainer.fitter import COUNT_EVERY, FitStep, Fitter
from csplat_trainer.image_gains import ImageGain
from csplat_trainer.losses import PendingLoss
from csplat_trainer.parameters import Parameters
from csplat_trainer.training_options import Outputs, save_to, uses_torch
from csplat_trainer.training_report import peak_memory
from csplat_trainer.tuned_scene import RateTerm
from csplat_trainer.tuning.tuning_engine import CpuTuning, TuningEngine
from csplat_trainer.tuning.tuning_options import FinetuneOptions
from csplat_trainer.tuning.tuning_views import TuningViews

_LOG_SIZE_MAX = 80.0  # largest log-size of a typical splat, the unit of moves, so that it fits float32
_MIN_GAIN = 2e-4  # smallest relative difference of the score that counts as a gain


@dataclass(frozen=True, eq=False)
class TuningResult:
    """Result of a run.

    Attributes:
        best_values: the values with the best score on the validation views; perhaps the initial values.
        log: JSON-compatible: options, losses, evaluations (`validations`), times.
    """

    best_values: FreeValues
    log: dict[str, Any]


def tune(
    fixed: FixedQuantisation,
    views: TuningViews,
    options: FinetuneOptions | None = None,
    *,
    size_bytes: int | None = None,
    outputs: Outputs | None = None,
    on_step: Callable[[FitStep], None] | None = None,
    context: Context = DEFAULT_CONTEXT,
) -> TuningResult:
    """Fine-tune a fixed quantisation.

    The same scene, views and options give the same values on the same machine, at any number of threads.

    Args:
        fixed: the encoder's decisions.
        views: training and validation views.
        options: options of the tuning.
        size_bytes: largest size of the file; lambda is adjusted to meet it, starting at `lambda_`.
        outputs: checkpoints; a run resumes from a checkpoint of the same fixed quantisation.
        on_step: called with the progress of the tuning, every `log_every` steps.
        context: threads and progress.

    Raises:
        InputError: a checkpoint is damaged, or of another scene, views or options; or a loss or a value is not finite.
    """

    def show(now: FitStep) -> None:
        context.progress("tuning", now.iteration / now.iterations)
        if on_step is not None:
            on_step(now)

    outputs = outputs or Outputs()
    tuning = _Tuning(fixed, views, options or FinetuneOptions(), outputs, show, context, size_bytes)
    if outputs.resume is not None:
        tuning.resume(outputs.resume)
    with thread_count(context.threads):
        return tuning.run()


@dataclass
class _BestValues:
    """The values of the best evaluation so far, and the number of later evaluations without a gain."""

    values: FreeValues
    score: float
    psnr: float
    iteration: int = 0
    since: int = 0


class _Tuning:
    """A tuning by a `Fitter`: the scene, its views, the best values so far.

    Args:
        fixed, views, options, outputs, context, size_bytes: as for `tune`.
        show: called with the progress, every `log_every` steps and after the last.
    """

    def __init__(
        self,
        fixed: FixedQuantisation,
        views: TuningViews,
        options: FinetuneOptions,
        outputs: Outputs,
        show: Callable[[FitStep], None],
        context: Context,
        size_bytes: int | None,
    ) -> None:
        seed = context.seed if options.seed is None else options.seed
        options = replace(options, seed=seed)
        self._views, self._options, self._outputs, self._show = views, options, outputs, show
        self._fixed, self._context = fixed, context
        self._engine = self._make_engine(None)
        log_size = np.median(np.median(fixed.encode_plan.model.scales, axis=1))
        self._typical_size = float(np.exp(np.clip(log_size, -_LOG_SIZE_MAX, _LOG_SIZE_MAX)))
        self._fitter = Fitter(len(views.train), options.iterations, seed)
        self._log = self._fitter.log
        self._log |= {"validations": [], "views": views.digest}
        self._view_numbers = {id(view): number for number, view in enumerate(views.train)}
        self._best: _BestValues | None = None
        self._controller = None if size_bytes is None else RateController(size_bytes, options.lambda_)

    def resume(self, path: str | Path) -> None:
        """Continue from a checkpoint.

        Raises:
            InputError: the file is damaged, or of a run with another scene, views or options.
        """
        fixed, start = self._fixed, self._fixed.start()
        checkpoint = load_checkpoint(path, "finetune")
        own, arrays = checkpoint.own, checkpoint.arrays
        if own.get("fixed") != fingerprint(fixed):
            raise InputError(
                f"{path} belongs to another scene, or to other options of the encoder: remove it, or repeat the"
                " options of its run"
            )
        if checkpoint.log.get("views") != self._views.digest:
            raise InputError("the checkpoint is of a run with other views")
        controller = RateController.of(own.get("controller"))
        if (controller and controller.size_bytes) != (self._controller and self._controller.size_bytes):
            raise InputError("the checkpoint is of a run with another target")
        for name, value in asdict(self._options).items():
            if name not in ("iterations", "device", "engine") and checkpoint.options.get(name) != value:
                raise InputError(f"the checkpoint is of a run with another {name}: {checkpoint.options.get(name)}")
        values = self._engine.parameters.values
        check_arrays(path, checkpoint.parameters.values, {name: tuple(array.shape) for name, array in values.items()})
        check_arrays(path, arrays, {f"best_{name}": getattr(start, name).shape for name in _FREE_VALUES})
        self._fitter.resume(checkpoint)
        self._engine = self._make_engine(checkpoint.parameters)
        tables = {name.removeprefix("rate_"): array for name, array in arrays.items() if name.startswith("rate_")}
        try:
            self._best = _BestValues(FreeValues(*(arrays[f"best_{name}"] for name in _FREE_VALUES)), **own["best"])
            self._fitter.rate = RateTerm(fixed, tables=tables, **own["rate"]) if tables else None
        except (KeyError, TypeError) as error:
            raise InputError(f"{path} is not a checkpoint of csplat finetune: {error}") from None
        self._controller = controller

    def run(self) -> TuningResult:
        """Make the remaining steps, and return the best values."""
        if self._best is None:
            self._validate()
        self._fitter.run(self, save_to(self._outputs, self._save), every=self._outputs.checkpoint_seconds)
        assert self._best is not None
        return TuningResult(self._best.values, self._full_log())

    def step(self, view: int) -> PendingLoss:
        fitter, options = self._fitter, self._options
        if self._lambda > 0.0 and (fitter.rate is None or fitter.is_due(COUNT_EVERY)):
            fitter.rate = self._engine.count(self._lambda)
            if self._controller is not None:
                self._controller.update(fitter.rate.bits, (fitter.iteration - 1) / fitter.iterations, options.lambda_)
        gain = fitter.gain(view, options.lr_exposure * options.learning_rate_factor(fitter.iteration))
        value = self._engine.step(self._views.train[view], gain, self._learning_rates(), fitter.rate)
        if fitter.iteration == 1 and not math.isfinite(value.read().loss):  # the loss of the initial values
            raise InputError("renders of the scene overflow float32: its colours are too large for tuning")
        return value

    def after_step(self) -> None:
        fitter, options = self._fitter, self._options
        if fitter.is_due(options.validate_every) or fitter.is_last:
            self._validate()
        if fitter.report_is_due(options.log_every):
            model = self._fixed.encode_plan.model
            size_bytes = self._log["validations"][-1]["size_bytes"]
            self._show(fitter.report(len(model), model.sh_degree, size_bytes=size_bytes))

    @property
    def _lambda(self) -> float:
        """Current lambda, loss per bit and splat."""
        return self._options.lambda_ if self._controller is None else self._controller.lambda_

    def _learning_rates(self) -> dict[str, float]:
        """Return the learning rates of the current step by group; means move in units of the typical splat's size."""
        options = self._options
        factor = options.learning_rate_factor(self._fitter.iteration)
        return {
            "means": options.lr_means * self._typical_size * factor,
            "quats": options.lr_quats * factor,
            "scales": options.lr_scales * factor,
            "sizes": options.lr_scales * factor,
            "logits": options.lr_opacities * factor,
            "sh0": options.lr_sh0 * factor,
            "shN": (options.lr_shN if self._fixed.book is None else options.lr_entries) * factor,
        }

    def _make_engine(self, parameters: Parameters | None) -> TuningEngine:
        """Return the requested engine, with the state of a checkpoint or, for `None`, the initial state.

        Raises:
            InputError: a package or the GPU is absent.
        """
        fixed, options, background = self._fixed, self._options, self._views.background
        if not uses_torch(options.device, options.engine):
            return CpuTuning(fixed, options, background, parameters, self._context)
        antialiased = fixed.encode_plan.model.metadata.antialiased
        rasteriser = make_rasteriser(options.device, antialiased=antialiased, context=self._context)
        from csplat_trainer.tuning.torch_tuning import TorchTuning

        return TorchTuning(fixed, options, background, rasteriser, parameters)

    def _validate(self) -> None:
        """Score on the validation views, keep the best values, and end the run if it no longer improves.

        The score is the loss plus the rate term or, with a target size, plus a penalty for its excess. The run ends
        after `patience` scores without a gain since it has calmed (`has_calmed`), without scores of files that are too
        large while lambda can still rise.

        Raises:
            InputError: a value is not finite.
        """
        values = self._engine.free_values()
        if not all(np.isfinite(array).all() for array in vars(values).values()):
            raise InputError(f"a value is not finite at step {self._fitter.iteration}: try smaller learning rates")
        loss = 0.0
        squared_error, value_count = 0.0, 0
        for view in self._views.validation:
            gain = None
            if self._options.lr_exposure and id(view) in self._view_numbers:  # also a training view
                gain = ImageGain(self._fitter.gains, self._view_numbers[id(view)], 0.0)
            value, view_error = self._engine.score(view, gain)
            loss += value.loss / len(self._views.validation)
            squared_error += view_error
            value_count += 3 * (view.camera.W * view.camera.H if view.mask is None else int(view.mask.sum()))
        costs = self._engine.count(self._options.lambda_)
        psnr = psnr_of_mse(squared_error / value_count)
        size_bytes = len(self._fixed.encode(values).write().data)
        shrinks = False  # True if the file is too large, and lambda can still rise
        if self._controller is None:
            score = loss + costs.loss
        else:
            excess = self._controller.excess(size_bytes, costs.bits)
            shrinks = excess > 0.0 and not self._controller.is_exhausted
            score = loss + _EXCESS_WEIGHT * excess
        self._log["validations"].append(
            {"iteration": self._fitter.iteration, "loss": loss, "psnr": psnr, "size_bytes": size_bytes}
        )
        if self._best is None or score < self._best.score * (1.0 - _MIN_GAIN):
            self._best = _BestValues(values, score, psnr, self._fitter.iteration)
        elif self._options.has_calmed(self._fitter.iteration) and not shrinks:
            self._best.since += 1
            self._fitter.has_ended = 0 < self._options.patience <= self._best.since

    def _save(self, path: str | Path) -> None:
        """Write a checkpoint, with the best values, the rate term and its controller; call `_validate` before."""
        assert self._best is not None
        best, rate = vars(self._best).copy(), self._fitter.rate
        arrays = {f"best_{name}": getattr(best["values"], name) for name in _FREE_VALUES}
        if rate is not None:
            arrays |= {f"rate_{name}": table for name, table in rate.tables.items()}
        del best["values"]
        own = {
            "fixed": fingerprint(self._fixed),
            "best": best,
            "rate": None if rate is None else {"weight": rate.weight, "bits": rate.bits},
            "controller": self._controller and asdict(self._controller),
        }
        self._fitter.save(
            path, "finetune", asdict(self._options), self._engine.parameters.on_cpu(), own=own, arrays=arrays
        )

    def _full_log(self) -> dict[str, Any]:
        """Return the log of the steps with facts on the run; gains and biases of images if they were trained."""
        assert self._best is not None
        return {
            "options": asdict(self._options),
            "train_views": len(self._views.train),
            "validation_views": len(self._views.validation),
            "held_out": self._views.is_held_out,
            "steps": self._fitter.iteration,
            "converged": self._fitter.has_ended,
            "lambda_": self._lambda,
            "start_psnr": self._log["validations"][0]["psnr"],
            "best_psnr": self._best.psnr,
            "best_iteration": self._best.iteration,
            "peak_memory_bytes": peak_memory(),
            **self._log,
            **({"exposures": np.round(self._fitter.gains.values, 5).tolist()} if self._options.lr_exposure else {}),
        }


_TARGET_FRACTION = 0.6  # fraction of the steps after which the size should be reached; later steps hardly move values
_SIZE_MARGIN = 0.002  # fraction of the size left free, since files grow between counts
_EXCESS_WEIGHT = 1e3  # loss per relative excess of the size: values that fit win over others
_RATE_GAIN = 40.0  # change of log(lambda) per relative excess of bits
_LOG_CHANGE_MAX = 0.5  # largest change of log(lambda) at a count
_GOAL_BITS_MIN = 0.1  # least number of bits to aim at, as a fraction of the current number
_WEIGHT_RANGE = (1e-7, 1e-2)  # range of lambda
# Smallest lambda, as a fraction of the first. Files grow while values move far, and a lambda near 0 would then rise too
# late.
_MIN_WEIGHT_FRACTION = 0.25


@dataclass
class RateController:
    """Adjusts lambda to a target size.

    Attributes:
        size_bytes: largest size of the file.
        lambda_: current lambda, loss per bit and splat.
        first_bits: bits of the integers at the start of the run; 0: not known yet.
        goal_bits: bits of the integers of a file of that size, estimated from the last file.
    """

    size_bytes: int
    lambda_: float
    first_bits: float = 0.0
    goal_bits: float = 0.0

    def __post_init__(self) -> None:
        # A lambda of 0 would remain 0 under any factor.
        self.lambda_ = min(max(self.lambda_, _WEIGHT_RANGE[0]), _WEIGHT_RANGE[1])

    @property
    def is_exhausted(self) -> bool:
        """True if lambda cannot be raised further."""
        return self.lambda_ >= _WEIGHT_RANGE[1]

    @classmethod
    def of(cls, stored: Any) -> RateController | None:
        """Return the controller of a checkpoint; `None` if its state is absent or incomplete."""
        names = {field.name for field in fields(cls)}
        if not isinstance(stored, dict) or stored.keys() != names:
            return None
        numbers = all(isinstance(value, (int, float)) and math.isfinite(value) for value in stored.values())
        return cls(**stored) if numbers else None

    def excess(self, size_bytes: int, bits: float) -> float:
        """Return the relative excess of a file over the target size, and update the target number of bits.

        Args:
            size_bytes: size of the file.
            bits: bits of its integers, by their order-0 entropy.
        """
        allowed = (1.0 - _SIZE_MARGIN) * self.size_bytes
        self.first_bits = self.first_bits or bits
        self.goal_bits = max(bits + 8.0 * (allowed - size_bytes), _GOAL_BITS_MIN * bits)
        return max(0.0, size_bytes / self.size_bytes - 1.0)

    def update(self, bits: float, done: float, first_cost: float) -> None:
        """Adjust lambda to the current and the planned number of bits.

        Args:
            bits: current bits of the integers.
            done: fraction of the steps done.
            first_cost: lambda at the start of the run.
        """
        planned_bits = self.goal_bits + (self.first_bits - self.goal_bits) * max(0.0, 1.0 - done / _TARGET_FRACTION)
        by = min(max(_RATE_GAIN * (bits / max(planned_bits, 1.0) - 1.0), -_LOG_CHANGE_MAX), _LOG_CHANGE_MAX)
        least = max(_MIN_WEIGHT_FRACTION * min(first_cost, _WEIGHT_RANGE[1]), _WEIGHT_RANGE[0])
        self.lambda_ = min(max(self.lambda_ * math.exp(by), least), _WEIGHT_RANGE[1])


_FREE_VALUES = tuple(field.name for field in fields(FreeValues))


def fingerprint(fixed: FixedQuantisation) -> str:
    """Return a digest of the encoder's decisions and of the initial values."""
    digest, start = hashlib.sha256(repr(fixed.parameters).encode()), fixed.start()
    index = () if fixed.book is None else (fixed.book.index,)
    for array in (fixed.source_index, *index, *(getattr(start, name) for name in _FREE_VALUES)):
        digest.update(np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()

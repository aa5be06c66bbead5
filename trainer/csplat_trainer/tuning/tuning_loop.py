"""`tune`: optimise the values of a fixed quantisation until renders of its file match the reference images.

For a target size, `RateController` adjusts lambda, the loss per bit and splat, to the number of bits.
"""

from __future__ import annotations

import hashlib
import json
import math
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
from numpy.random import PCG64, Generator
from numpy.typing import NDArray

from csplat.archives import read_archive
from csplat.disk_files import atomic_writer
from csplat.encoder import DecodedValues, FixedQuantisation, FreeValues
from csplat.errors import InputError
from csplat.types import F32
from csplat_render.conventions import UncheckedSplats
from csplat_render.metrics import psnr_of_mse
from csplat_render.rasteriser import Rasteriser
from csplat_trainer.image_gains import ImageGain, ImageGains
from csplat_trainer.losses import LOSS_WEIGHTS, PhotometricLoss
from csplat_trainer.parameters import GROUPS, Parameters
from csplat_trainer.training_report import peak_memory
from csplat_trainer.tuning.tuned_scene import RateTerm, TunedScene
from csplat_trainer.tuning.tuning_options import FinetuneOptions
from csplat_trainer.tuning.tuning_views import TuningView, TuningViews

_COUNT_EVERY = 50  # steps between counts of the integers
_MIN_GAIN = 2e-4  # smallest relative difference of the score that counts as a gain


@dataclass(frozen=True)
class TuningStep:
    """Progress of a run.

    Attributes:
        iteration, iterations: number of steps so far, and of all steps.
        loss: mean over the steps since the last report.
        validation_psnr: PSNR of the last evaluation on the validation views, pooled, dB.
        best_psnr: the best so far.
        size_bytes: size of the file at that evaluation.
        seconds, seconds_left: time since the start, and estimated remaining time.
    """

    iteration: int
    iterations: int
    loss: float
    validation_psnr: float
    best_psnr: float
    size_bytes: int
    seconds: float
    seconds_left: float


@dataclass(frozen=True, eq=False)
class TuningResult:
    """Result of a run.

    Attributes:
        best_values: the values with the best score on the validation views; perhaps the initial ones.
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
    progress: Callable[[TuningStep], None] | None = None,
    checkpoint: str | Path | None = None,
    checkpoint_every: int = 0,
    resume: str | Path | None = None,
    threads: int | None = None,
) -> TuningResult:
    """Fine-tune a fixed quantisation.

    The same scene, views and options give the same values on the same machine, at any number of threads.

    Args:
        fixed: the encoder's decisions.
        views: training and validation views.
        options: options of the tuning.
        size_bytes: largest size of the file; lambda is adjusted to meet it, starting at `byte_cost`.
        progress: called every `log_every` steps.
        checkpoint: file for checkpoints, each of which replaces the last; `None`: none are written.
        checkpoint_every: steps between checkpoints; 0: only at the end.
        resume: a checkpoint of the same fixed quantisation to continue from.
        threads: number of threads; `None` for all.

    Raises:
        InputError: a checkpoint is damaged, or of another scene, views or options; or a loss or a value is not finite.
    """
    run = _TuningRun(fixed, views, options or FinetuneOptions(), threads, size_bytes)
    if resume is not None:
        run.resume(load_finetune(resume, fixed))
    return run.run(progress, checkpoint, checkpoint_every)


@dataclass
class _BestValues:
    """The values of the best evaluation so far, and the number of later evaluations without a gain."""

    values: FreeValues
    score: float
    psnr: float
    iteration: int = 0
    since: int = 0


@dataclass
class _ImageBuffers:
    """Reusable loss and reference image for images of one size."""

    loss: PhotometricLoss
    reference: F32


class _TuningRun:
    """The state of a run: the scene, the renderer, the random generator, the log."""

    def __init__(
        self,
        fixed: FixedQuantisation,
        views: TuningViews,
        options: FinetuneOptions,
        threads: int | None,
        size_bytes: int | None,
    ) -> None:
        self._views, self._options = views, options
        self._scene = TunedScene(fixed)
        self._rasteriser = Rasteriser(threads=threads)
        self._antialiased = fixed.encode_plan.model.antialiased
        self._extent = float(np.exp(np.clip(np.median(np.median(fixed.encode_plan.model.scales, axis=1)), -80.0, 80.0)))
        self._rng = Generator(PCG64(options.seed))
        self._iteration, self._queue = 0, list[int]()
        self._sizes: dict[tuple[int, int], _ImageBuffers] = {}
        self._log: dict[str, Any] = {"losses": [], "validations": [], "seconds": 0.0, "views": views.digest}
        self._gains = ImageGains(len(views.train))
        self._numbers = {id(view): number for number, view in enumerate(views.train)}
        self._best: _BestValues | None = None
        self._rate_term: RateTerm | None = None
        self._controller = None if size_bytes is None else RateController(size_bytes, options.byte_cost)

    def resume(self, checkpoint: FinetuneCheckpoint) -> None:
        """Continue from a checkpoint.

        Raises:
            InputError: the checkpoint is of a run with other views or options.
        """
        if checkpoint.log["views"] != self._views.digest:
            raise InputError("the checkpoint is of a run with other views")
        controller = RateController.of(checkpoint.log.get("budget"))
        if (controller and controller.size_bytes) != (self._controller and self._controller.size_bytes):
            raise InputError("the checkpoint is of a run with another target")
        before = {**asdict(FinetuneOptions()), **checkpoint.options}  # older checkpoints lack some options
        for name, value in asdict(self._options).items():
            if name != "iterations" and before[name] != value:
                raise InputError(f"the checkpoint is of a run with another {name}: {before[name]}")
        self._scene = TunedScene(self._scene.fixed, checkpoint.parameters)
        self._rng.bit_generator.state = checkpoint.rng_state
        self._iteration = checkpoint.iteration
        self._queue = [index for index in checkpoint.queue if index < len(self._views.train)]
        self._log = checkpoint.log
        for validation in self._log["validations"]:
            validation.setdefault("size_bytes", 0)  # older checkpoints lack it without a target size
        self._gains = ImageGains(len(self._views.train), self._log.get("exposures", ()))
        self._best = _BestValues(checkpoint.best_values, *checkpoint.best)
        self._controller = controller
        if checkpoint.costs:
            self._rate_term = RateTerm(self._scene.fixed, self._byte_cost, checkpoint.costs)

    def run(
        self, progress: Callable[[TuningStep], None] | None, checkpoint: str | Path | None, checkpoint_every: int
    ) -> TuningResult:
        options = self._options
        begin, first, spent = time.perf_counter(), self._iteration, float(self._log["seconds"])
        if self._best is None:
            self._validate()
        window = list[float]()
        while self._iteration < options.iterations and not self._has_converged:
            self._iteration += 1
            window.append(self._step())
            if self._iteration % options.validate_every == 0 or self._iteration == options.iterations:
                self._validate()
            seconds = time.perf_counter() - begin
            self._log["seconds"] = spent + seconds
            if progress is not None and (
                self._iteration % options.log_every == 0 or self._iteration == options.iterations or self._has_converged
            ):
                left = seconds / (self._iteration - first) * (options.iterations - self._iteration)
                progress(self._progress(window, left))
                window = []
            if checkpoint is not None and checkpoint_every and self._iteration % checkpoint_every == 0:
                self._save(checkpoint)
        if checkpoint is not None:
            self._save(checkpoint)
        assert self._best is not None
        return TuningResult(self._best.values, self._full_log())

    @property
    def _has_converged(self) -> bool:
        """True after `patience` evaluations without a gain."""
        assert self._best is not None
        return 0 < self._options.patience <= self._best.since

    def _step(self) -> float:
        """Make a step on one image, and return its loss before the step."""
        if not self._queue:
            self._queue = self._rng.permutation(len(self._views.train)).tolist()
        number = self._queue.pop()
        view = self._views.train[number]
        seen, alphas = self._scene.dequantise()
        if self._byte_cost > 0.0 and (self._rate_term is None or self._iteration % _COUNT_EVERY == 0):
            self._rate_term = self._scene.count(seen, self._byte_cost)
            if self._controller is not None:
                done = (self._iteration - 1) / self._options.iterations
                self._controller.update(self._rate_term.bits, done, self._options.byte_cost)
        rendered = self._render(seen, view)
        buffers = self._buffers(view)
        rate = self._options.lr_exposure * self._options.learning_rate_factor(self._iteration)
        gain = ImageGain(self._gains, number, rate) if self._options.lr_exposure else None
        shown = rendered if gain is None else gain.apply(rendered)
        value, slope = buffers.loss(shown, view.image(self._views.background, buffers.reference), view.mask)
        if not math.isfinite(value.loss):
            if self._iteration == 1:  # values are still the initial ones
                raise InputError("renders of the scene overflow float32: its colours are too large for tuning")
            raise InputError(f"the loss is not finite at step {self._iteration}: try smaller learning rates")
        if gain is not None:
            slope = gain.backward(rendered, slope)
        self._scene.step(self._rasteriser.backward(slope), seen, alphas, self._rates(), self._rate_term)
        self._log["losses"].append(float(f"{value.loss:.6g}"))
        return value.loss

    @property
    def _byte_cost(self) -> float:
        """Current lambda, loss per bit and splat."""
        return self._options.byte_cost if self._controller is None else self._controller.byte_cost

    def _rates(self) -> dict[str, float]:
        options = self._options
        factor = options.learning_rate_factor(self._iteration)
        return {
            "means": options.lr_means * self._extent * factor,
            "quats": options.lr_quats * factor,
            "scales": options.lr_scales * factor,
            "sizes": options.lr_scales * factor,
            "logits": options.lr_opacities * factor,
            "sh0": options.lr_sh0 * factor,
            "shN": (options.lr_shN if self._scene.fixed.book is None else options.lr_entries) * factor,
        }

    def _render(self, seen: DecodedValues, view: TuningView) -> F32:
        splats = UncheckedSplats(seen.means, seen.quats, seen.scales, seen.opacities, seen.sh0, seen.shN)
        return self._rasteriser.forward(
            splats, view.camera, background=self._views.background, antialiased=self._antialiased
        ).rgb

    def _validate(self) -> None:
        """Score on the validation views, and keep the values with the least sum of loss and rate term."""
        if not all(np.isfinite(values).all() for values in self._scene.parameters.values.values()):
            raise InputError(f"a value is not finite at step {self._iteration}: try smaller learning rates")
        seen, _ = self._scene.dequantise()
        loss, error, count = 0.0, 0.0, 0
        for view in self._views.validation:
            buffers, rendered = self._buffers(view), self._render(seen, view)
            if self._options.lr_exposure and id(view) in self._numbers:  # also a training view
                rendered = ImageGain(self._gains, self._numbers[id(view)], 0.0).apply(rendered)
            reference = view.image(self._views.background, buffers.reference)
            loss += buffers.loss(rendered, reference, view.mask)[0].loss / len(self._views.validation)
            error += float(np.square(np.clip(rendered, 0, 1) - np.clip(reference, 0, 1)).sum(dtype=np.float64))
            count += rendered.size if view.mask is None else 3 * int(view.mask.sum())
        costs = self._scene.count(seen, self._options.byte_cost)
        psnr = psnr_of_mse(error / count)
        size_bytes = len(self._scene.fixed.encode(self._scene.free_values).write().data)
        shrinks = False
        if self._controller is None:
            score = loss + costs.loss
        else:
            excess = self._controller.excess(size_bytes, costs.bits)
            shrinks = excess > 0.0 and not self._controller.is_exhausted
            score = loss + excess
        self._log["validations"].append(
            {"iteration": self._iteration, "loss": loss, "psnr": psnr, "size_bytes": size_bytes}
        )
        if self._best is None or score < self._best.score * (1.0 - _MIN_GAIN):
            self._best = _BestValues(self._scene.free_values.copy(), score, psnr, self._iteration)
        elif self._options.has_calmed(self._iteration) and not shrinks:
            self._best.since += 1

    def _buffers(self, view: TuningView) -> _ImageBuffers:
        size = (view.camera.H, view.camera.W)
        if size not in self._sizes:
            loss = PhotometricLoss(*size, *LOSS_WEIGHTS[self._options.loss])
            self._sizes[size] = _ImageBuffers(loss, np.empty((*size, 3), np.float32))
        return self._sizes[size]

    def _progress(self, window: list[float], left: float) -> TuningStep:
        assert self._best is not None
        validation = self._log["validations"][-1]
        return TuningStep(
            self._iteration,
            self._options.iterations,
            sum(window) / max(1, len(window)),
            validation["psnr"],
            self._best.psnr,
            validation["size_bytes"],
            self._log["seconds"],
            left,
        )

    def _save(self, path: str | Path) -> None:
        assert self._best is not None
        if self._options.lr_exposure:
            self._log["exposures"] = self._gains.as_json()
        if self._controller is not None:
            self._log["budget"] = asdict(self._controller)
        best = (self._best.score, self._best.psnr, self._best.iteration, self._best.since)
        save_finetune(
            path,
            FinetuneCheckpoint(
                self._iteration,
                self._scene.parameters,
                dict(self._rng.bit_generator.state),
                self._queue,
                asdict(self._options),
                self._log,
                self._best.values,
                {} if self._rate_term is None else self._rate_term.tables,
                best,
            ),
            self._scene.fixed,
        )

    def _full_log(self) -> dict[str, Any]:
        assert self._best is not None
        return {
            "options": asdict(self._options),
            "train_views": len(self._views.train),
            "validation_views": len(self._views.validation),
            "held_out": self._views.is_held_out,
            "steps": self._iteration,
            "converged": self._has_converged,
            "byte_cost": self._byte_cost,
            "start_psnr": self._log["validations"][0]["psnr"],
            "best_psnr": self._best.psnr,
            "best_iteration": self._best.iteration,
            "peak_memory_bytes": peak_memory(),
            **self._log,
            **({"exposures": np.round(self._gains.values, 5).tolist()} if self._options.lr_exposure else {}),
        }


_TARGET_FRACTION = 0.6  # fraction of the steps after which the size should be reached; later steps hardly move values
_SIZE_MARGIN = 0.002  # fraction of the size left free, since files grow between counts
_GAIN, _MAX_CHANGE = 40.0, 0.5  # change of log(lambda) per relative excess of bits, and its limit at each count
_WEIGHT_RANGE = (1e-7, 1e-2)  # range of lambda
# Smallest lambda, as a fraction of the first. Files grow while values move far, and a lambda near 0 would then rise too
# late.
_MIN_WEIGHT_FRACTION = 0.25


@dataclass
class RateController:
    """Adjusts lambda to a target size.

    Attributes:
        size_bytes: largest size of the file.
        byte_cost: current lambda, loss per bit and splat.
        first_bits: bits of the integers at the start of the run; 0: not known yet.
        goal_bits: bits of the integers of a file of that size, estimated from the last file.
    """

    size_bytes: int
    byte_cost: float
    first_bits: float = 0.0
    goal_bits: float = 0.0

    def __post_init__(self) -> None:
        # A lambda of 0 would remain 0 under any factor.
        self.byte_cost = min(max(self.byte_cost, _WEIGHT_RANGE[0]), _WEIGHT_RANGE[1])

    @property
    def is_exhausted(self) -> bool:
        """True if lambda cannot be raised further."""
        return self.byte_cost >= _WEIGHT_RANGE[1]

    @classmethod
    def of(cls, stored: Any) -> RateController | None:
        """Return the controller of a checkpoint; `None` if its state is absent or incomplete."""
        names = {one.name for one in fields(cls)}
        if not isinstance(stored, dict) or stored.keys() != names:
            return None
        numbers = all(isinstance(one, (int, float)) and math.isfinite(one) for one in stored.values())
        return cls(**stored) if numbers else None

    def excess(self, size_bytes: int, bits: float) -> float:
        """Return the relative excess of a file over the target size, and update the target number of bits.

        Args:
            size_bytes: size of the file.
            bits: bits of its integers, by their order-0 entropy.
        """
        allowed = (1.0 - _SIZE_MARGIN) * self.size_bytes
        self.first_bits = self.first_bits or bits
        self.goal_bits = max(bits + 8.0 * (allowed - size_bytes), 0.1 * bits)
        return max(0.0, size_bytes / self.size_bytes - 1.0)

    def update(self, bits: float, done: float, first_cost: float) -> None:
        """Adjust lambda to the current and the planned number of bits.

        Args:
            bits: current bits of the integers.
            done: fraction of the steps done.
            first_cost: lambda at the start of the run.
        """
        planned_bits = self.goal_bits + (self.first_bits - self.goal_bits) * max(0.0, 1.0 - done / _TARGET_FRACTION)
        by = min(max(_GAIN * (bits / max(planned_bits, 1.0) - 1.0), -_MAX_CHANGE), _MAX_CHANGE)
        least = max(_MIN_WEIGHT_FRACTION * min(first_cost, _WEIGHT_RANGE[1]), _WEIGHT_RANGE[0])
        self.byte_cost = min(max(self.byte_cost * math.exp(by), least), _WEIGHT_RANGE[1])


_VERSION = 1
_FACTS = {
    "frozen": str, "iteration": int, "step": int, "rng_state": dict, "queue": list, "options": dict, "log": dict,
    "best": list,
}  # fmt: skip
_BEST_COUNT = 4  # length of `best` in a checkpoint
_KIND = "csplat finetune"
_FREE_VALUES = ("means", "quats", "scales", "opacities", "sh0", "sh", "sizes")
_GROUPS = (*GROUPS, "sizes")


@dataclass
class FinetuneCheckpoint:
    """A run between two steps.

    Attributes:
        iteration: number of steps so far.
        parameters: the values, with Adam's moments.
        rng_state: state of the random generator, JSON-compatible.
        queue: indices of the images that remain in this epoch.
        options: options of the run, as a dictionary.
        log: log so far.
        best_values: the best values so far.
        costs: slopes of the rate by attribute, from the last count; empty before the first.
        best: score and PSNR of the best values on the validation views, their step, number of evaluations since.
    """

    iteration: int
    parameters: Parameters
    rng_state: dict[str, Any]
    queue: list[int]
    options: dict[str, Any]
    log: dict[str, Any]
    best_values: FreeValues
    costs: dict[str, NDArray[np.float32]]
    best: tuple[float, float, int, int]


def save_finetune(path: str | Path, checkpoint: FinetuneCheckpoint, fixed: FixedQuantisation) -> None:
    """Write a checkpoint; the file gets its name only when it is complete."""
    facts = {
        "kind": _KIND,
        "version": _VERSION,
        "frozen": fingerprint(fixed),
        "iteration": checkpoint.iteration,
        "step": checkpoint.parameters.step,
        "rng_state": checkpoint.rng_state,
        "queue": checkpoint.queue,
        "options": checkpoint.options,
        "log": checkpoint.log,
        "best": list(checkpoint.best),
    }
    arrays: dict[str, NDArray[Any]] = {"facts": np.frombuffer(json.dumps(facts).encode(), np.uint8)}
    for kind in ("values", "first", "second"):
        arrays |= {f"{kind}_{name}": getattr(checkpoint.parameters, kind)[name] for name in _GROUPS}
    arrays |= {f"best_{name}": getattr(checkpoint.best_values, name) for name in _FREE_VALUES}
    arrays |= {f"costs_{name}": table for name, table in checkpoint.costs.items()}
    with atomic_writer(str(path)) as stream:
        np.savez(stream, allow_pickle=False, **arrays)


def load_finetune(path: str | Path, fixed: FixedQuantisation) -> FinetuneCheckpoint:
    """Read a checkpoint of a fixed quantisation.

    Raises:
        InputError: the file is not a checkpoint, or is of another version, scene or encoder options.
        OSError: the file cannot be read.
    """
    stored = read_archive(path, "a checkpoint of csplat finetune")
    facts = stored.facts()
    if facts.get("kind") != _KIND:
        stored.refuse("it is of another kind")
    if facts.get("version") != _VERSION:
        raise InputError(f"{path} is a checkpoint of version {facts.get('version')}, expected {_VERSION}")
    stored.check(facts, _FACTS)
    if facts["frozen"] != fingerprint(fixed):
        raise InputError(f"{path} belongs to another scene, or to other options of the encoder")
    if len(facts["best"]) != _BEST_COUNT or not all(isinstance(one, (int, float)) for one in facts["best"]):
        stored.refuse(f"its best evaluation is {facts['best']}")
    parts = [{name: stored[f"{kind}_{name}"] for name in _GROUPS} for kind in ("values", "first", "second")]
    best = FreeValues(*(stored[f"best_{name}"] for name in _FREE_VALUES))
    costs = {name.removeprefix("costs_"): array for name, array in stored.items() if name.startswith("costs_")}
    if any(table.ndim != 2 or table.dtype != np.float32 or not np.isfinite(table).all() for table in costs.values()):
        stored.refuse("its costs are not tables of float32")
    score, psnr, iteration, since = facts["best"]
    checkpoint = FinetuneCheckpoint(
        facts["iteration"],
        Parameters(parts[0], parts[1], parts[2], facts["step"]),
        facts["rng_state"],
        facts["queue"],
        facts["options"],
        facts["log"],
        best,
        costs,
        (score, psnr, iteration, since),
    )
    _check(path, checkpoint, fixed.start())
    return checkpoint


def fingerprint(fixed: FixedQuantisation) -> str:
    """Return a digest of the encoder's decisions and of the initial values."""
    digest, start = hashlib.sha256(repr(fixed.parameters).encode()), fixed.start()
    index = () if fixed.book is None else (fixed.book.index,)
    for array in (fixed.source_index, *index, *(getattr(start, name) for name in _FREE_VALUES)):
        digest.update(np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()


def _check(path: str | Path, checkpoint: FinetuneCheckpoint, start: FreeValues) -> None:
    shapes = {name: getattr(start, name).shape for name in _FREE_VALUES}
    found: dict[str, list[NDArray[Any]]] = {name: [getattr(checkpoint.best_values, name)] for name in _FREE_VALUES}
    parameters = checkpoint.parameters
    for part in (parameters.values, parameters.first, parameters.second):
        for name in _GROUPS:
            found[{"logits": "opacities", "shN": "sh"}.get(name, name)].append(part[name])
    for name, arrays in found.items():
        for array in arrays:
            if array.shape != shapes[name] or array.dtype != np.float32 or not np.isfinite(array).all():
                raise InputError(
                    f"{path}: {name} is {array.dtype} {list(array.shape)}, expected float32 {shapes[name]}"
                )

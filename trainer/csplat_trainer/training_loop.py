# SPDX-License-Identifier: Apache-2.0
"""`train`: train splats on images."""

from __future__ import annotations

import math
import os
import platform
import time
from collections.abc import Callable, Mapping
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

import csplat
from csplat.context import DEFAULT_CONTEXT, Context
from csplat.errors import InputError
from csplat.model import SplatModel
from csplat.scene_metadata import TRAINING
from csplat.types import F32, I64
from csplat_render.first_view import viewing_metadata
from csplat_render.kernels import thread_count
from csplat_render.lpips import Lpips, load_lpips
from csplat_trainer.data import DataSet, load
from csplat_trainer.device_measurements import make_rasteriser
from csplat_trainer.engine import CpuEngine, Engine
from csplat_trainer.fit_checkpoint import check_arrays, load_checkpoint
from csplat_trainer.fitter import FitStep, Fitter
from csplat_trainer.initial_splats import SceneExtent, measure_extent, place_splats
from csplat_trainer.losses import PendingLoss, PerceptualLoss
from csplat_trainer.parameters import ParameterArrays, Parameters, to_model
from csplat_trainer.posed_images import PosedImage, compose, evaluate, halve
from csplat_trainer.strategies import densify, grow, prune_least_needed, relocate, reset_opacities
from csplat_trainer.training_options import Outputs, TrainOptions, TrainResult, save_to, uses_torch
from csplat_trainer.training_report import peak_memory, save_image, side_by_side

_BLACK, _WHITE = (0.0, 0.0, 0.0), (1.0, 1.0, 1.0)
_COLOURS = {"black": _BLACK, "white": _WHITE, "random": _WHITE}  # background colours of evaluations
_RESET_EVERY = 3000  # steps between resets of the opacities, gradient strategy
_KEPT_AT_ONCE = 0.85  # fraction of the splats kept by a late pruning
_STEPS_BETWEEN = 100  # steps after each late pruning, or 1 % of the iterations
_LARGE_EXTENT = 50.0  # scene units; in larger scenes the weight of the mean standard deviation is reduced
_EXPONENT_MAX = 700.0  # largest exponent whose exponential fits float64
_DOUBLING = 2.0  # growth of a resumed scene with too few splats, until it has enough
_TIMED_IMAGES = 4  # images of timed steps
_TIMED_STEPS, _TIMED_SECONDS = (3, 50), 1.0  # least and largest number of timed steps, and their least time otherwise
_FIRST_FRACTION = 0.5  # initial number of splats of mcmc without points, as a fraction of the cap


def train(
    data: DataSet | str | os.PathLike[str],
    options: TrainOptions | None = None,
    *,
    outputs: Outputs | None = None,
    on_step: Callable[[FitStep], None] | None = None,
    context: Context = DEFAULT_CONTEXT,
) -> TrainResult:
    """Train splats on images, as `csplat train` does; requires the packages of the render extra.

    With the native engine, the same images, options and library versions give the same splats on the same machine, at
    any number of threads.

    Args:
        data: a data set, or its path for `load`: a folder, or a `transforms.json`.
        options: options of the training.
        outputs: checkpoints and a preview.
        on_step: called with the progress of the run, every `log_every` steps.
        context: threads and progress.

    Returns:
        The scene, the log, and scores on the test images.

    Examples:
        >>> import csplat, csplat_trainer
        >>> trained = csplat_trainer.train("capture", csplat_trainer.TrainOptions(max_splats=5000))  # doctest: +SKIP
        >>> csplat.write_ply("scene.ply", trained.model)  # doctest: +SKIP

    Raises:
        InputError: there are no images, an option does not fit the data, or a file is damaged or of another kind.
    """

    def show(now: FitStep) -> None:
        context.progress("training", now.iteration / now.iterations)
        if on_step is not None:
            on_step(now)

    images = data if isinstance(data, DataSet) else load(data)
    with thread_count(context.threads):
        return _Training(images, options or TrainOptions(), outputs or Outputs(), show, context).run()


def time_step(data: DataSet, options: TrainOptions, splat_count: int, *, context: Context = DEFAULT_CONTEXT) -> float:
    """Return the time of a training step of initial splats at the full SH degree, seconds: the mean of a few.

    Args:
        data: the data set, of which only a few images are read.
        options: options of the training.
        splat_count: number of splats.
        context: threads.

    Raises:
        InputError: as for `train`.
    """
    images = data.inliers
    few = replace(data, train=images[:: -(-len(images) // _TIMED_IMAGES)], test=[], val=[])
    options = replace(options, max_splats=splat_count, initial_splats=splat_count)
    with thread_count(context.threads):
        training = _Training(few, options, Outputs(), lambda _: None, context)
        training.time_step(0)  # allocates
        begin, seconds, count = time.perf_counter(), 0.0, 0
        while count < _TIMED_STEPS[0] or (count < _TIMED_STEPS[1] and seconds < _TIMED_SECONDS):
            count += 1
            training.time_step(count % len(few.train))
            seconds = time.perf_counter() - begin
    return seconds / count


class _Training:
    """A training by a `Fitter`: its images, engine and strategy.

    Args:
        data, options, outputs, context: as for `train`.
        show: called with the progress, every `log_every` steps and after the last.

    Raises:
        InputError: as for `train`; the images and the checkpoint are read here, before the first step.
    """

    def __init__(
        self,
        data: DataSet,
        options: TrainOptions,
        outputs: Outputs,
        show: Callable[[FitStep], None],
        context: Context,
    ) -> None:
        if not data.train:
            raise InputError("there are no images to train on")
        data.read()
        seed = context.seed if options.seed is None else options.seed
        options = replace(options, seed=seed)
        self._data, self._options, self._outputs, self._show = data, options, outputs, show
        self._scene = measure_extent(data.inliers)
        self._fitter = Fitter(len(data.train), options.iterations, seed)
        self._log = self._fitter.log
        self._log |= {"entries": [], "evaluations": []}
        self._halved: dict[int, PosedImage] = {}
        self._next_preview = 0.0  # seconds of the run
        arrays: Mapping[str, NDArray[Any]] = {}
        if outputs.resume is None:
            parameters = Parameters.starting_at(self._place_splats(self._scene))
            self._log["growth"] = options.growth_from(len(parameters))
        else:
            parameters, arrays = self._resume(outputs.resume)
        self._lpips = _load_lpips_weights(options, outputs)
        extent_factor = min(1.0, _LARGE_EXTENT / self._scene.extent)
        self._engine = _make_engine(
            parameters, replace(options, scale_weight=extent_factor * options.scale_weight), self._lpips, context
        )
        if self._engine.screen is not None:
            self._engine.screen.restore(arrays)
        self._colour = _COLOURS.get(options.background, data.background)
        self._background = np.array(self._colour, np.float32)

    def run(self) -> TrainResult:
        """Make the remaining steps, and evaluate the scene."""
        options, first = self._options, self._fitter.iteration
        if first and not any(map(options.prunings_left, range(first + 1, options.iterations + 1))):
            self._prune_late()
        self._fitter.run(self, save_to(self._outputs, self._save), every=self._outputs.checkpoint_seconds)
        metrics = self._evaluate(options.eval_views) if self._data.test else None
        return TrainResult(self._model(), self._full_log(metrics), metrics)

    def time_step(self, view: int) -> None:
        """Make a step on an image at the full SH degree, and wait for its end."""
        self._fitter.iteration = self._options.iterations
        self.step(view).read()

    def step(self, view: int) -> PendingLoss:
        fitter = self._fitter
        background = self._background
        if self._options.background == "random":
            background = fitter.rng.random(3, dtype=np.float32)
        rates = self._options.learning_rates(fitter.iteration, self._scene.extent)
        gain = fitter.gain(view, rates["exposure"])
        return self._engine.step(self._training_image(view), background, self._degree, rates, fitter.rng, gain)

    def after_step(self) -> None:
        fitter, options, outputs = self._fitter, self._options, self._outputs
        if options.refines_after(fitter.iteration):
            self._refine()
        if prunings_left := options.prunings_left(fitter.iteration):
            self._prune(prunings_left)
        if fitter.report_is_due(options.log_every):
            self._report()
        if fitter.is_due(options.eval_every) and not fitter.is_last and self._data.test:
            self._evaluate(options.eval_views)
        if outputs.preview is not None and (fitter.is_last or fitter.seconds >= self._next_preview):
            self._write_preview(outputs.preview)
            self._next_preview = fitter.seconds + outputs.preview_seconds

    @property
    def _degree(self) -> int:
        """SH degree of the current step."""
        return self._options.active_degree(self._fitter.iteration - 1)

    def _place_splats(self, scene: SceneExtent) -> dict[str, F32]:
        """Return the initial parameters.

        Their number is `initial_splats`, at most the cap. If that is 0, it is the cap if it does not grow, else the
        number of points or, without points, `_FIRST_FRACTION` of the cap.
        """
        options, data = self._options, self._data
        count = options.initial_splats
        if count == 0 and options.strategy in ("fixed", "none"):
            count = options.max_splats
        if count == 0:
            points = 0 if data.points is None or options.init in ("hull", "box") else len(data.points)
            count = points or max(1, int(_FIRST_FRACTION * options.max_splats))
        return place_splats(
            data.inliers,
            scene,
            min(count, options.max_splats),
            options.sh_degree,
            self._fitter.rng,
            init=options.init,
            points=data.points,
            colours=data.points_rgb,
        )

    def _resume(self, path: str | Path) -> tuple[Parameters, Mapping[str, NDArray[Any]]]:
        """Set the fitter to the state of a checkpoint; return its parameters, adapted to the options, and its arrays.

        Raises:
            InputError: the file is damaged or of another kind.
        """
        checkpoint = load_checkpoint(path)
        check_arrays(path, checkpoint.parameters.values, _expected_shapes(checkpoint.parameters.values))
        self._fitter.resume(checkpoint)
        origin = np.array(checkpoint.own.get("origin"), np.float64)
        if origin.shape != (3,) or not np.isfinite(origin).all():
            raise InputError(f"{path}: origin is {origin.tolist()}, expected three numbers")
        shift = origin - self._data.origin
        if shift.any():  # the data set has another origin, since its cameras differ
            means = checkpoint.parameters.values["means"]
            checkpoint.parameters.values["means"] = (means + shift).astype(np.float32)
        return fit_to_options(checkpoint.parameters, self._options, self._fitter.rng), checkpoint.arrays

    def _training_image(self, number: int) -> PosedImage:
        """Return a training image, in the first steps at half its size if requested; halved images are kept."""
        if not self._options.is_half_size(self._fitter.iteration):
            self._halved.clear()
            return self._data.train[number]
        if number not in self._halved:
            self._halved[number] = halve(self._data.train[number])
        return self._halved[number]

    def _refine(self) -> None:
        """Change the number and positions of splats, as the strategy requires after this step."""
        options, parameters = self._options, self._engine.parameters
        if options.strategy == "gradient":
            assert self._engine.screen is not None
            densify(
                parameters,
                self._engine.screen,
                self._scene.extent,
                options.grad_threshold,
                options.max_splats,
                options.dead_opacity,
                self._fitter.rng,
            )
            # The last reset leaves half a period to restore the opacities.
            if self._fitter.is_due(_RESET_EVERY) and self._fitter.iteration + _RESET_EVERY / 2 < options.iterations:
                reset_opacities(parameters)
            self._engine.screen.clear(len(parameters))
        else:
            relocate(parameters, options.dead_opacity, self._fitter.rng)
            if options.strategy == "mcmc":
                grow(parameters, self._log["growth"], options.max_splats, options.dead_opacity, self._fitter.rng)

    def _prune(self, prunings_left: int) -> None:
        """Make the first of a number of prunings, each of the same fraction, towards the final number of splats.

        The log keeps the number of splats before the first pruning, of which `final_share` remains.
        """
        options, parameters = self._options, self._engine.parameters
        final = options.final_share * self._log.setdefault("splats_before_thinning", len(parameters))
        count = final
        if prunings_left > 1:
            count = len(parameters) * math.pow(final / len(parameters), 1.0 / prunings_left)
        kept_count = max(1, round(count))
        if kept_count >= len(parameters):
            return
        prune_least_needed(
            parameters,
            [image.camera for image in self._data.train],
            lambda cameras: self._engine.measure_pruning(cameras, self._background),
            kept_count,
        )
        if self._engine.screen is not None:
            self._engine.screen.clear(len(parameters))

    def _prune_late(self) -> None:
        """Prune splats after the last step of a resumed run, each time followed by steps at the last learning rates."""
        count, fitter = len(self._engine.parameters), self._fitter
        final = max(1, round(self._options.final_share * self._log.get("splats_before_thinning", count)))
        if final >= count:
            return
        pruning_count = math.ceil(math.log(final / count) / math.log(_KEPT_AT_ONCE))
        begin = fitter.seconds
        for done in range(1, pruning_count + 1):
            self._prune(pruning_count - done + 1)
            for _ in range(max(_STEPS_BETWEEN, self._options.iterations // 100)):
                fitter.step(self)
            self._report((fitter.seconds - begin) / done * (pruning_count - done))

    def _report(self, seconds_left: float | None = None) -> None:
        """Add an entry to the log, and show it; arguments as for `Fitter.report`."""
        now = self._fitter.report(len(self._engine.parameters), self._degree, seconds_left=seconds_left)
        entry = asdict(now)
        del entry["iterations"], entry["seconds_left"], entry["size_bytes"]
        self._log["entries"].append(entry)
        self._show(now)

    def _evaluate(self, views: int) -> dict[str, Any]:
        """Score on `views` test images, evenly spread, or all for 0; add the scores to the log, and return them."""
        degree = self._options.active_degree(self._fitter.iteration)
        test = list(self._data.test)
        if views and views < len(test):
            test = [test[index * len(test) // views] for index in range(views)]
        metrics = evaluate(
            lambda camera: self._engine.render(camera, self._background, degree), test, self._background, self._lpips
        )
        self._log["evaluations"].append({"iteration": self._fitter.iteration, **metrics})
        return metrics

    def _write_preview(self, path: str | Path) -> None:
        """Write the first test image, or training image if there are none, next to its render."""
        image = (self._data.test or self._data.train)[0]
        size = (image.camera.H, image.camera.W, 3)
        target = compose(image, self._background, np.empty(size, np.float32))
        save_image(path, side_by_side(target, self._engine.render(image.camera, self._background, self._degree)))

    def _save(self, path: str | Path) -> None:
        """Write a checkpoint."""
        screen = self._engine.screen
        self._fitter.save(
            path, "train", asdict(self._options), self._engine.parameters.on_cpu(),
            own={"origin": self._data.origin, "size": self._data.size}, arrays={} if screen is None else screen.state(),
        )  # fmt: skip

    def _model(self) -> SplatModel:
        """Return the scene, with the training's record, up direction, first view and origin."""
        model = to_model(self._engine.parameters.on_cpu().values, antialiased=self._options.antialiased)
        entries = {TRAINING: self._data.trained_on(self._colour).as_json()}
        metadata = replace(model.metadata, entries=entries).with_up(
            self._data.up, self._data.coordinate_system, estimated=self._data.up_is_estimated
        )
        model = replace(model, metadata=metadata, origin=self._data.origin)
        return model.with_metadata(viewing_metadata(model, [image.camera for image in self._data.train]))

    def _full_log(self, metrics: dict[str, Any] | None) -> dict[str, Any]:
        """Return the log of the steps with facts on the run; gains and biases of images if they were trained."""
        return {
            "csplat": csplat.__version__,
            "machine": platform.machine(),
            "options": asdict(self._options),
            "train_views": len(self._data.train),
            "test_views": len(self._data.test),
            "splats": len(self._engine.parameters),
            "scene_extent": self._scene.extent,
            "peak_memory_bytes": peak_memory(),
            "metrics": metrics,
            **self._log,
            **({"exposures": np.round(self._fitter.gains.values, 5).tolist()} if self._options.lr_exposure else {}),
        }


def fit_to_options(parameters: Parameters, options: TrainOptions, rng: Generator) -> Parameters:
    """Adapt the parameters of a checkpoint to another number of splats and another SH degree.

    If there are too many splats, those with the least opacity times area of the two longer axes are pruned. If there
    are too few for a fixed count, splats are added as by growth. SH bands are truncated, or extended by zeros.

    Args:
        parameters: parameters of a checkpoint; changed in place.
        options: options of the continued run.
        rng: source of random choices.

    Returns:
        `parameters`.
    """
    for part in (parameters.values, parameters.first, parameters.second):
        _fit_degree(part, options.sh_degree)
    if len(parameters) > options.max_splats:
        parameters.keep(_most_visible(parameters, options.max_splats))
    elif options.strategy == "fixed":
        while 0 < len(parameters) < options.max_splats:
            grow(parameters, _DOUBLING, options.max_splats, options.dead_opacity, rng)
    return parameters


def _fit_degree(part: ParameterArrays, degree: int) -> None:
    """Truncate `shN` of values or moments to an SH degree, or extend it by zeros; the array is replaced."""
    coefficients = (degree + 1) ** 2 - 1
    old = part["shN"]
    if old.shape[1] == coefficients:
        return
    fitted = np.zeros((len(old), coefficients, 3), np.float32)
    common = min(coefficients, old.shape[1])
    fitted[:, :common] = old[:, :common]
    part["shN"] = fitted


def _most_visible(parameters: Parameters, count: int) -> I64:
    """Return the ascending indices of the `count` splats with the most opacity times area of the two longer axes."""
    longer = np.sort(parameters.values["scales"].astype(np.float64), axis=1)[:, 1:]
    weight = parameters.alphas * np.exp(np.minimum(longer.sum(axis=1), _EXPONENT_MAX))
    return np.sort(np.argsort(-weight, kind="stable")[:count])


def _expected_shapes(values: ParameterArrays) -> dict[str, tuple[int, ...]]:
    """Return the expected shapes of parameters by the number of logits and of SH coefficients."""
    sh = values["shN"].shape[1:] if "shN" in values else ()
    rows = {"means": (3,), "quats": (4,), "scales": (3,), "logits": (), "sh0": (3,), "shN": (*sh[:1], 3)}
    return {name: (len(values.get("logits", ())), *row) for name, row in rows.items()}


def _load_lpips_weights(options: TrainOptions, outputs: Outputs) -> Lpips | None:
    """Return the weights of LPIPS; `None` if they are absent and not required."""
    try:
        return load_lpips(outputs.lpips_weights)
    except InputError:
        if options.lpips_weight > 0.0 or outputs.lpips_weights is not None:
            raise
        return None


def _make_engine(parameters: Parameters, options: TrainOptions, lpips: Lpips | None, context: Context) -> Engine:
    """Return the requested engine.

    Raises:
        InputError: it does not support an option, or a package or the GPU is absent.
    """
    if not uses_torch(options.device, options.engine):
        perceptual = PerceptualLoss(lpips) if options.lpips_weight > 0.0 and lpips is not None else None
        return CpuEngine(parameters, options, perceptual, context=context)
    if options.lpips_weight > 0.0:
        raise InputError("the perceptual loss requires the native engine: omit lpips_weight with torch")
    rasteriser = make_rasteriser(options.device, antialiased=options.antialiased, context=context)
    from csplat_trainer.torch_engine import TorchEngine

    return TorchEngine(parameters, options, rasteriser)

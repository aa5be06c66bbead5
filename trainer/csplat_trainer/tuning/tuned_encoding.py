# SPDX-License-Identifier: Apache-2.0
"""`finetune`: encode a scene, tune the values of the file to views, and code them with the same decisions."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from csplat.context import DEFAULT_CONTEXT, Context
from csplat.decoder import decode
from csplat.encoder import DecodedValues, EncodeOptions, EncodePlan, EncodeResult, Importance, Origin, fix_quantisation
from csplat.errors import InputError
from csplat.model import SplatModel, check_model
from csplat.types import I64, null_progress
from csplat_render.camera import relative_to
from csplat_trainer.data import DataSet
from csplat_trainer.device_measurements import measure_importance
from csplat_trainer.fitter import FitStep
from csplat_trainer.training_options import Outputs
from csplat_trainer.tuning.tuning_loop import tune
from csplat_trainer.tuning.tuning_options import FinetuneOptions
from csplat_trainer.tuning.tuning_views import TuningView, TuningViews, split_views


@dataclass(frozen=True, eq=False)
class TunedFile:
    """A tuned file.

    Attributes:
        result: result of the encoder.
        decoded: the decoded values, which are the tuned values, bit for bit.
        plain: the file with the same decisions before tuning.
        log: JSON-compatible: options, losses, evaluations on the validation views (`validations`), times.
        seconds: time of `encoding` and `tuning`.
    """

    result: EncodeResult
    decoded: SplatModel
    plain: EncodeResult
    log: dict[str, Any]
    seconds: dict[str, float]

    @property
    def data(self) -> bytes:
        """The file."""
        return self.result.data


@dataclass
class StageTimer:
    """Seconds by stage."""

    seconds: dict[str, float] = field(default_factory=dict)

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Add the time of the context to a stage."""
        start = time.perf_counter()
        yield
        self.add(name, time.perf_counter() - start)

    def add(self, name: str, seconds: float) -> None:
        """Add a time to a stage."""
        self.seconds[name] = round(self.seconds.get(name, 0.0) + seconds, 3)


def finetune(
    model: SplatModel,
    views: TuningViews | DataSet,
    encoding: EncodeOptions | None = None,
    options: FinetuneOptions | None = None,
    *,
    size_bytes: int | None = None,
    importance: NDArray[Any] | Importance | None = None,
    source: SplatModel | None = None,
    origin: Origin | None = None,
    metadata: Mapping[str, Any] | None = None,
    outputs: Outputs | None = None,
    on_step: Callable[[FitStep], None] | None = None,
    context: Context = DEFAULT_CONTEXT,
) -> TunedFile:
    """Encode a scene, and optimise the values of the file through its quantisers; `csplat finetune` calls it.

    The same scene, views and options give the same bytes on the same machine, at any number of threads.

    Args:
        model: the splats of the file.
        views: views with images of a data set, or with renders of the scene itself (`renders_of`). Of a data set, the
            training images are used, in front of the background that the scene records.
        encoding: options of the encoder.
        options: options of the tuning.
        size_bytes: largest size of the file, as in `tune`; the file may be larger if lambda reaches its limit.
        importance: importance of the splats, as for the encoder; `None`: measured in the training views.
        source, origin: the scene that the splats were chosen from, and their indices in it, if some were pruned.
        metadata: metadata about the tuning, in addition to the steps and the number of views.
        outputs: checkpoints.
        on_step: called with the progress of the tuning, every `log_every` steps.
        context: threads, progress, and the seed of the encoder.

    Examples:
        >>> import csplat, csplat_trainer
        >>> data = csplat_trainer.load("capture")  # doctest: +SKIP
        >>> tuned = csplat_trainer.finetune(csplat.read("scene.ply"), data)  # doctest: +SKIP
        >>> len(tuned.data) < len(tuned.plain.data)  # doctest: +SKIP
        True

    Raises:
        InputError: no view shows a splat, the size is too small for one, an option does not fit the scene, or a
            checkpoint is of another run.
        RuntimeError: the file does not hold the tuned values, which is a bug of csplat.
    """
    check_model("finetune", model)
    timer, encoding, options = StageTimer(), encoding or EncodeOptions(), options or FinetuneOptions()
    silent = replace(context, progress=null_progress)
    if isinstance(views, DataSet):
        views = _views_of(views, model)
    if importance is None:
        importance = measure_importance(
            model, [view.camera for view in views.train], views.background, options.device, context=context
        )
    with timer.stage("encoding"):
        draft = EncodePlan.of(
            model, encoding, importance=importance, origin=origin, allow_classes=False, context=context
        )
        fixed = fix_quantisation(draft, source or model)
        # The tuning encodes many times, and reports its own steps.
        fixed = replace(fixed, encode_plan=replace(fixed.encode_plan, context=silent))
        coded = fixed.encode(fixed.start())
        plain = coded.write()

    def tuning_metadata(steps: int) -> dict[str, Any]:
        """Return the metadata about the tuning; after pruning, its `simplified_from` is the splat count before."""
        return {"finetuned": {"simplified": {}, "views": len(views.train), "steps": steps, **(metadata or {})}}

    if size_bytes is not None:
        size_bytes -= len(coded.write(tuning_metadata(options.iterations)).data) - len(plain.data)
        if size_bytes < 1:
            raise InputError("the target size is smaller than the metadata of the file")

    with timer.stage("tuning"):
        tuned = tune(fixed, views, options, size_bytes=size_bytes, outputs=outputs, on_step=on_step, context=context)
    with timer.stage("encoding"):
        result = fixed.encode(tuned.best_values).write(tuning_metadata(tuned.log["best_iteration"]))
        decoded = decode(result.data, context=silent)
    _check_identity(fixed.dequantise(tuned.best_values), fixed.source_index, result, decoded)
    return TunedFile(result, decoded, plain, tuned.log, timer.seconds)


def _views_of(data: DataSet, model: SplatModel) -> TuningViews:
    """Return the training images of a data set, in front of the background that the scene records, else the set's.

    Cameras become relative to the scene's origin.
    """
    record = model.metadata.training
    background = data.background if record is None else record.background
    shift = np.subtract(model.origin, data.origin)
    training = [TuningView(relative_to(shift, image.camera), image) for image in data.train]
    return split_views(training, np.array(background, np.float32))


def _check_identity(seen: DecodedValues, source_index: I64, result: EncodeResult, decoded: SplatModel) -> None:
    """Check that the file holds the tuned values, bit for bit.

    Args:
        seen: the tuned values as dequantised, by row.
        source_index: [N], index in the source of each row.
        result: the file, with the indices in the source of its splats, in its own order.
        decoded: the file's splats.

    Raises:
        RuntimeError: the file holds other values.
    """
    row_of_source = np.empty(int(source_index.max()) + 1, np.int64)  # other indices stay undefined, and unused
    row_of_source[source_index] = np.arange(len(source_index))
    rows = row_of_source[result.source_index]
    for name in ("means", "quats", "scales", "opacities", "sh0", "shN"):
        if not np.array_equal(getattr(decoded, name), getattr(seen, name)[rows]):
            raise RuntimeError(f"{name} of the file differ from the tuned ones: a bug of csplat, please report it")

"""One scene compressed in many ways, each judged on its held-out photographs."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from csplat.decoder import decode, read_header
from csplat.encoder import (
    EncodeOptions,
    EncodePlan,
    EncodeResult,
    FixedQuantisation,
    FreeValues,
    Importance,
    Origin,
    fix_quantisation,
)
from csplat.errors import InputError
from csplat.model import SplatModel
from csplat.ply import read_ply
from csplat_bench.common.captures import Capture
from csplat_bench.common.making import ARRAYS
from csplat_bench.compression.rows import Row, Scores
from csplat_bench.compression.sizes import books_of
from csplat_render.lpips import Lpips
from csplat_render.pruning_error import measure_pruning_error
from csplat_tools.inspect.file_description import bytes_by_attribute
from csplat_tools.training.tuning_inputs import TuningSubset, choose_splats, training_views
from csplat_tools.training.tuning_report import score_models
from csplat_tools.views import DataOptions, find_view_set
from csplat_trainer.tuning import FinetuneOptions, StageTimer, TuningViews, tune

#: Splats, and the seconds that it took to choose them, by stage.
Pick = tuple[TuningSubset, dict[str, float]]


@dataclass(frozen=True, eq=False)
class Tuned:
    """A tuned scene and the quantisation that it was tuned for.

    Attributes:
        chosen: its splats.
        fixed: the encoder's decisions.
        best_values: the values that were tuned.
        plain: the file before tuning. result: the file.
        log: log of the tuning.
        seconds: time by stage, without judging.
    """

    chosen: TuningSubset
    fixed: FixedQuantisation
    best_values: FreeValues
    plain: EncodeResult
    result: EncodeResult
    log: Mapping[str, Any]
    seconds: Mapping[str, float]


class Bench:
    """Compresses one scene over and over. Owns what all ways have in common, found once.

    Args:
        scene: the scene that is compressed.
        ply: path of its splats.
        encoding: options of the encoder, unless a variant overrides them.
        tuning: options of the tuning.
        lpips: weights of LPIPS; `None`: not measured.
    """

    def __init__(
        self,
        scene: Capture,
        ply: Path,
        encoding: EncodeOptions,
        tuning: FinetuneOptions,
        lpips: Lpips | None,
    ) -> None:
        self.encoding, self.tuning, self._lpips = encoding, tuning, lpips
        self.source = read_ply(ply)
        data = DataOptions(str(scene.data), scene.size)
        self.looks = find_view_set(self.source, data=data, background=scene.background, validation_count=0)
        if not (self.looks.images and self.looks.test):
            raise InputError(f"{scene.data} holds out no photographs to judge by")
        self._picks: dict[tuple[float | None, bool], Pick] = {}

    @property
    def threads(self) -> int | None:
        """Number of threads; `None` for all."""
        return self.encoding.threads

    @cached_property
    def views(self) -> TuningViews:
        """Training and validation views of the tuning."""
        return training_views(self.source, self.looks, self.threads)

    def chosen(self, keep: float | None = None, *, told: bool = True) -> Pick:
        """The splats that stay, and the seconds that it took to find them.

        Args:
            keep: share of the source's splats; `None`: all that any view shows.
            told: pass the sensitivities to the encoder; otherwise the squared shares of pixels.
        """
        if (keep, told) not in self._picks:
            self._picks[keep, told] = self._pick(keep, told=told)
        return self._picks[keep, told]

    def _pick(self, keep: float | None, *, told: bool) -> Pick:
        timer = StageTimer()
        with timer.stage("choosing"):
            chosen = choose_splats(self.source, self.looks, keep=keep, threads=self.threads)
        if told:
            return chosen, timer.seconds
        timer = StageTimer()  # it would not have measured what it is not told
        with timer.stage("choosing"):
            pruning_error = measure_pruning_error(
                chosen.model, self.looks.training, background=self.looks.background, threads=self.threads
            )
        return replace(chosen, importance=pruning_error.squared_weight), timer.seconds

    def fix_scene(
        self, model: SplatModel, rows: NDArray[np.int64], encoding: EncodeOptions,
        importance: NDArray[Any] | Importance, progress: _Stages | None = None,
    ) -> FixedQuantisation:  # fmt: skip
        """Freeze splats that are some of the source's."""
        draft = EncodePlan.of(
            model, encoding, importance=importance, origin=Origin(len(self.source), rows), allow_classes=False,
            progress=progress,
        )  # fmt: skip
        return fix_quantisation(draft, self.source, progress)

    def tuned(self, encoding: EncodeOptions, pick: Pick | None = None) -> Tuned:
        """Freeze, tune, write.

        Args:
            encoding: options of the encoder.
            pick: splats, and the seconds that they took; `None`: all that are seen.
        """
        chosen, seconds = pick or self.chosen()
        views, stages = self.views, _Stages()
        timer = StageTimer(dict(seconds))
        with timer.stage("clustering"):
            fixed = self.fix_scene(chosen.model, chosen.rows, encoding, chosen.importance, stages)
        plain = fixed.encode(fixed.start()).write()  # not a part of the work: what it would have been without
        with timer.stage("tuning"):
            run = tune(fixed, views, self.tuning, threads=self.threads)
        with timer.stage("encoding"):
            result = fixed.encode(run.best_values).write()
        return Tuned(
            chosen, fixed, run.best_values, plain, result, run.log, {**timer.seconds, "of it shapes": stages.shapes}
        )

    def row(self, tuned: Tuned) -> Row:
        """Return the row of a tuned file: sizes and scores before and after tuning."""
        before, after = decode(tuned.plain.data), decode(tuned.result.data)
        assert _same(tuned, after), "the decoded file is not what was tuned"
        scores = self.judge({"before": before, "after": after})
        colours, shapes = books_of(tuned.fixed)
        kept = len(tuned.fixed.source_index)
        described = bytes_by_attribute(tuned.result.data, read_header(tuned.result.data))
        return {
            "splats": kept,
            "before_bytes": len(tuned.plain.data),
            "after_bytes": len(tuned.result.data),
            "before": scores["before"],
            "after": scores["after"],
            "sh_entries": 0 if colours is None else colours.entries,
            "sh_escapes": None if colours is None else colours.escaped / kept,
            "shapes": 0 if shapes is None else shapes.entries,
            "shape_escapes": None if shapes is None else shapes.escaped / kept,
            "attribute_bytes": {name: size for name, size in described.items() if name != "overhead"},
            "steps": tuned.log["steps"],
            "best_step": tuned.log["best_iteration"],
            "seconds": dict(tuned.seconds),
            "encoding": tuned.result.report.options,
        }

    def judge(self, models: Mapping[str, SplatModel]) -> dict[str, Scores]:
        """Scores on the held-out photographs, by name."""
        judged = score_models(self.source, models, self.looks, self._lpips, self.threads)
        assert judged is not None
        found: dict[str, Any] = {name: dict(one) for name, one in judged.scores.items()}
        return found


class _Stages:
    """A progress callback that records how many seconds passed until the encoder finished shapes."""

    def __init__(self) -> None:
        self._begin, self.shapes = time.perf_counter(), 0.0

    def __call__(self, stage: str, done: float) -> None:
        if stage == "shapes" and done == 1.0:
            self.shapes = round(time.perf_counter() - self._begin, 3)


def _same(tuned: Tuned, decoded: SplatModel) -> bool:
    """Return True if a decoded file equals the tuned values bit for bit."""
    seen = tuned.fixed.dequantise(tuned.best_values)
    places = np.argsort(tuned.fixed.source_index)[
        np.searchsorted(np.sort(tuned.fixed.source_index), tuned.result.source_index)
    ]
    return all(np.array_equal(getattr(decoded, name), getattr(seen, name)[places]) for name in ARRAYS)

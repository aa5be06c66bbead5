"""The search for a target on an analytic scene: the one place where the model meets the search as it is today."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from types import SimpleNamespace

import numpy as np
from analytic_model import AnalyticFile, AnalyticScene, Contents, Views, psnr_of

from csplat import EncodeOptions
from csplat_tools.optimise.candidates import CandidatePool
from csplat_tools.optimise.precision_search import PrecisionSearch
from csplat_tools.optimise.pruning_order import PruningOrder, SimplifyOptions
from csplat_tools.optimise.search_report import SearchReport, make_report
from csplat_tools.optimise.sh_codings import CodingSearch
from csplat_tools.optimise.subsets import Pruner
from csplat_tools.optimise.target_search import TargetSearch, find_goal
from csplat_tools.optimise.targets import Target


@dataclass(frozen=True)
class Found:
    """The result of a search.

    Attributes:
        file: the chosen file.
        tried: every file that was made, in order.
        scored: the files that the test views were shown.
        report: the report that users get.
    """

    file: AnalyticFile
    tried: list[AnalyticFile]
    scored: list[AnalyticFile]
    report: SearchReport


def search(
    scene: AnalyticScene,
    *,
    options: EncodeOptions | None = None,
    no_prune: bool = False,
    judging: Views | None = None,
    photo_psnr: float | None = None,
    grades: bool = False,
    effort: int = 3,
    tried: list[AnalyticFile] | None = None,
    **target: object,
) -> Found:
    """Look for a file of an analytic scene.

    Args:
        scene: the scene.
        options: knobs of the encoder that the caller fixed.
        no_prune: no splat may be removed.
        judging: the test views; by default they see the same as the validation views.
        photo_psnr: PSNR of the source against photographs, dB; photographs decide a loss.
        grades: splats may be sorted by importance.
        effort: effort of the refit.
        tried: receives the files that are made, even if the search is refused.
        target: arguments of `Target`.
    """
    encoding, model, asked = options or EncodeOptions(), scene.model(), Target(**target)
    judge, validation_scorer = _Judge(scene, judging or Views()), _Judge(scene, Views())
    photographs = None if photo_psnr is None else _Judge(scene, Views(photo_psnr=photo_psnr))
    trials = CandidatePool(encoding, judge, validation_scorer, photographs, decode=lambda data: data)
    removal = None if no_prune else analytic_removal(scene, grades=grades, effort=effort)
    whole = _Splats(scene, model, refits=False, classifiable=grades)
    goal = find_goal(asked, model, photographs)
    moves = TargetSearch(PrecisionSearch(trials, goal), CodingSearch(model, encoding, grades), whole, removal)
    try:
        best = moves.best()
    finally:
        if tried is not None:
            tried += [one.result.data for one in trials.made]
    report = make_report(
        asked, best, trials, splats_before=scene.splats, views_of="virtual", remarks=(),
        encodes=len(trials.made), seconds=0.0,
    )  # fmt: skip
    made = [one.result.data for one in trials.made]
    return Found(best.result.data, made, judge.scored, report)


def analytic_removal(scene: AnalyticScene, *, grades: bool = False, effort: int = 3) -> Pruner:
    """Return the object that decides how many splats may be pruned."""
    how = SimplifyOptions(effort=effort)
    return _Removal(scene.model(), None, how, use_classes=grades, progress=None, psnr=None, scene=scene)


@dataclass(eq=False)
class _Judge:
    """Views that see the errors of the law. Remembers the files that it was shown."""

    scene: AnalyticScene
    views: Views
    cameras: tuple[int, ...] = tuple(range(8))
    scored: list[AnalyticFile] = field(default_factory=list)

    def errors(self, model):
        if isinstance(model, AnalyticFile):
            self.scored.append(model)
            error = self.scene.error_of(model.contents, self.views)
        elif isinstance(model, _Shown):
            error = self.scene.source_error(model.splats, self.scene.sh_degree, self.views, refitted=model.refitted)
        else:
            error = self.scene.source_error(len(model), model.sh_degree, self.views)
        return np.full(len(self.cameras), error)

    def pooled(self, errors):
        return float(np.mean(errors))

    def psnr(self, model):
        return float(psnr_of(self.pooled(self.errors(model))))


@dataclass(frozen=True)
class _Shown:
    """Splats before they are quantised."""

    splats: int
    refitted: bool


@dataclass(eq=False)
class _Splats:
    """Splats that a file is to hold: a `Subset`."""

    scene: AnalyticScene
    model: object
    refits: bool
    classifiable: bool

    @property
    def unquantised(self):
        return _Shown(len(self.model), self.refits)

    @property
    def rows(self):
        return np.arange(len(self.model))

    @property
    def psnr(self):
        if not self.refits:
            return np.inf
        error = self.scene.source_error(len(self.model), self.scene.sh_degree, Views(), refitted=True)
        return float(psnr_of(error))

    fitted_psnr = psnr

    def coded(self, options, *, use_classes, quick):
        use_classes = use_classes and self.classifiable and options.max_classes != 1 and self.scene.grading != 1.0
        contents = Contents(options, len(self.model), self.refits, graded=use_classes, draft=quick and self.refits)
        return SimpleNamespace(write=lambda _: _encoded(AnalyticFile(self.scene, contents)))

    def options_entry(self, candidate):  # noqa: ARG002  # the file does not record it
        return None


def _encoded(file):
    """Return a file as the encoder does."""
    options = file.scene.options_of(file.contents)
    report = SimpleNamespace(options=options, errors=file.errors, splat_count=file.contents.splats)
    return SimpleNamespace(data=file, report=report)


@dataclass(frozen=True)
class _Session:
    """The order of removal, which every number of splats shares."""

    order: PruningOrder
    splats: int
    options: SimplifyOptions
    value_count: int = 1
    view_groups: tuple[()] = ()

    def kept_rows(self, pruned_count):
        return np.arange(pruned_count, self.splats)


@dataclass(eq=False)
class _Removal(Pruner):
    """The order of removal and the refit that the law gives, in place of measured ones."""

    scene: AnalyticScene = None

    @cached_property
    def session(self):
        count = len(self.source)
        errors = self.scene.removed(np.arange(count, 0, -1), refitted=False)
        order = PruningOrder(np.arange(count - 1), np.diff(errors), ())
        return _Session(order, count, self.options)

    def refit(self, kept_count, allowed, psnr_of):  # noqa: ARG002  # as the measured one is called
        model = self.source.select(np.arange(len(self.source) - kept_count, len(self.source)))
        return _Splats(self.scene, model, refits=True, classifiable=self.use_classes)

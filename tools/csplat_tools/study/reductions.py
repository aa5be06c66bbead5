"""Reduce a scene by simple strategies: prune by opacity, take fewer SH bands, cluster; and encode the result."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from csplat.decoder import decode
from csplat.encoder import EncodeOptions, EncodePlan, EncodeResult, Origin, encode_tiles
from csplat.errors import InputError
from csplat.model import MAX_SH_DEGREE, SplatModel
from csplat.scene_source import drop_bands
from csplat.types import I64, Progress
from csplat_render.scene_frame import surface_areas
from csplat_tools.study.attribute_codebooks import Clustered, KMeans, attribute_floats, cluster_attributes, raw_bytes
from csplat_tools.views import ViewSet, find_view_set

if TYPE_CHECKING:
    from csplat_tools.study.distillation import SourceRenders


_ASIDE = 8  # every Nth virtual view is held out for validation


@dataclass(frozen=True)
class Reduction:
    """The steps of a reduction, in this order.

    Attributes:
        prune_opacity: prune splats of at most this alpha; None: keep all.
        sh_degree: leave out the SH bands above; None: keep all.
        distil: fit the remaining bands to renders of the source; otherwise they are unchanged.
        kmeans: attributes to cluster; None: no clustering.
        views: number of virtual views for distilling, to which 16 are added; one in eight is held out for validation.
        seed: seed of the virtual views.
        threads: number of threads; None for all. The result does not depend on it.

    Raises:
        InputError: a value is out of range.
    """

    prune_opacity: float | None = None
    sh_degree: int | None = None
    distil: bool = False
    kmeans: KMeans | None = None
    views: int = 160
    seed: int = 0
    threads: int | None = None

    def __post_init__(self) -> None:
        if self.prune_opacity is not None:
            check_threshold(self.prune_opacity)
        if self.sh_degree is not None and not 0 <= self.sh_degree <= MAX_SH_DEGREE:
            raise InputError(f"sh_degree is {self.sh_degree}, wanted 0 to {MAX_SH_DEGREE}")
        if self.views < 2:
            raise InputError(f"{self.views} views, wanted 2 or more: one to fit by, one to check by")
        if self.seed < 0:
            raise InputError(f"the seed of views is {self.seed}, wanted 0 or more")


@dataclass(frozen=True, eq=False)
class ReducedScene:
    """A scene after its reduction.

    Attributes:
        model: the scene.
        source_index: [N] int64, the source splat that each splat was.
        clustered: its codebooks; None if nothing was clustered.
        report: report of the steps, JSON-compatible.
    """

    model: SplatModel
    source_index: I64
    clustered: Clustered | None
    report: dict[str, Any]

    @property
    def size_bytes(self) -> int:
        """Bytes without an entropy coder: raw float32, or codebooks and indices for clustered attributes."""
        if self.clustered is not None:
            return self.clustered.size_bytes
        return raw_bytes(sum(attribute_floats(self.model.sh_degree).values()), len(self.model))


def reduce_model(
    source: SplatModel,
    reduction: Reduction,
    views: ViewSet | None = None,
    *,
    progress: Progress | None = None,
) -> ReducedScene:
    """Prune, leave out SH bands, and cluster.

    Args:
        source: the scene.
        reduction: the steps.
        views: training and validation views for distilling; None for virtual ones.
        progress: progress callback.

    Raises:
        InputError: nothing would be left; or there is nothing to distil, or too few views to do it by.
    """
    renders = find_renders(source, reduction, views)
    return reduce_with(source, reduction, renders, progress)


def reduce_with(
    source: SplatModel, reduction: Reduction, renders: SourceRenders | None, progress: Progress | None
) -> ReducedScene:
    """Reduce a scene as `reduce_model` does, with given renders of the source; `None`: bands are only left out."""
    rows = np.arange(len(source), dtype=np.int64)
    model, degree = source, target_degree(source, reduction)
    report: dict[str, Any] = {"splats": len(source)}
    if reduction.prune_opacity is not None:
        model, rows = prune_opacity(source, reduction.prune_opacity)
        report["prune_opacity"] = reduction.prune_opacity
    if degree < source.sh_degree:
        report |= {"sh_degree": degree, "sh": "distilled" if reduction.distil else "truncated"}
    model = drop_bands(model, degree) if renders is None else renders.distilled(model, degree, progress)
    if renders is not None:
        report["views"] = len(renders.cameras)
    clustered = None
    if reduction.kmeans is not None:
        clustered = cluster_attributes(model, reduction.kmeans, threads=reduction.threads, progress=progress)
        model = clustered.model
        report["kmeans"] = clustered.as_json()
    return ReducedScene(model, rows, clustered, report)


def target_degree(source: SplatModel, reduction: Reduction) -> int:
    """Return the SH degree of the result."""
    return source.sh_degree if reduction.sh_degree is None else min(reduction.sh_degree, source.sh_degree)


def find_renders(source: SplatModel, reduction: Reduction, views: ViewSet | None) -> SourceRenders | None:
    """Return the `SourceRenders` of the lower degree; None if nothing is distilled.

    Raises:
        InputError: there is nothing to distil, or there are fewer than two views.
    """
    if not reduction.distil:
        return None
    degree = target_degree(source, reduction)
    if degree >= source.sh_degree:
        raise InputError(
            f"nothing to distil: the scene has SH of degree {source.sh_degree}, wanted a lower one than that"
        )
    from csplat_tools.study.distillation import SourceRenders  # requires numba; the other strategies do not

    if views is None:
        validation_count = max(1, reduction.views // _ASIDE)
        views = find_view_set(
            source, count=reduction.views - validation_count, validation_count=validation_count, seed=reduction.seed
        )
    return SourceRenders.of_source(source, views, threads=reduction.threads)


_KEY = "reduced"


def encode_reduced(
    source: SplatModel,
    reduction: Reduction,
    encoding: EncodeOptions | None = None,
    *,
    views: ViewSet | None = None,
    progress: Progress | None = None,
) -> EncodeResult:
    """Prune, leave out SH bands, cluster, and encode.

    Args:
        source: the scene.
        reduction: the steps. If its `sh_degree` is None, that of `encoding` is used.
        encoding: options of the encoder.
        views: training and validation views for distilling; None for virtual ones.
        progress: progress callback.

    Returns:
        The file, with the source splat of each of its splats. The file declares its errors against the source;
        distilled colours have none, and the options give the PSNR of renders.

    Raises:
        InputError: as for `reduce_model` and the encoder.
    """
    encoding = encoding or EncodeOptions()
    if reduction.sh_degree is None:
        reduction = replace(reduction, sh_degree=encoding.sh_degree)
    degree = target_degree(source, reduction)
    encoding = replace(encoding, sh_degree=degree)
    renders = find_renders(source, reduction, views)
    clusters = reduction.kmeans is not None
    reduced = reduce_with(source, reduction, renders if clusters else None, progress)
    report, origin = dict(reduced.report), Origin(len(source), reduced.source_index, refitted=renders is not None)
    model = _with_bands(reduced.model, source.sh_degree) if clusters else source.select(reduced.source_index)
    plan = EncodePlan.of(model, encoding, origin=origin, progress=progress)
    if renders is not None and not clusters:
        distilled = _with_bands(renders.distilled(plan.scene, degree, progress), source.sh_degree)
        plan = plan.with_colours(distilled.sh0, distilled.shN)
    coded = encode_tiles(plan, progress=progress)
    if renders is not None or clusters:
        decoded = decode(coded.write().data)
        coded = coded.against(source, decoded) if clusters else coded
        if renders is not None:
            report |= {"views": len(renders.cameras), "check_psnr": round(renders.check_scorer.psnr(decoded), 3)}
    return coded.write({_KEY: report})


def _with_bands(model: SplatModel, sh_degree: int) -> SplatModel:
    """Return the scene with zeros in further SH bands, so that the encoder records the source's degree."""
    missing = (sh_degree + 1) ** 2 - 1 - model.shN.shape[1]
    zeros = np.zeros((len(model), missing, 3), np.float32)
    return replace(model, shN=np.concatenate([model.shN, zeros], axis=1))


def prune_opacity(model: SplatModel, tau: float) -> tuple[SplatModel, I64]:
    """Keep the splats whose alpha is larger than a threshold.

    Args:
        model: the scene; its alpha is the sigmoid of a PLY's logit, rounded once to float32.
        tau: the threshold, at least 0 and less than 1. 0 prunes fully transparent splats.

    Returns:
        The kept splats, in their order, and the index of each in the scene, [N] int64.

    Raises:
        InputError: the threshold is out of range, or nothing would be left.
    """
    check_threshold(tau)
    rows = np.flatnonzero(model.opacities.astype(np.float64) > tau)  # tau is not rounded to float32
    if len(model) and not len(rows):
        largest = float(model.opacities.max())
        raise InputError(f"no splat has an opacity above {tau:g}: the largest is {largest:g}")
    return model.select(rows), rows.astype(np.int64, copy=False)


def prune_share(model: SplatModel, keep: float, *, by_area: bool = False) -> tuple[SplatModel, I64]:
    """Keep a fraction of the splats: the most opaque ones, or those with the largest opacity × surface area.

    Args:
        model: the scene.
        keep: the fraction, above 0, at most 1; at least one splat is kept.
        by_area: multiply the opacity by the surface area.

    Returns:
        The kept splats, in their order, and the index of each in the scene, [N] int64.
    """
    keys = model.opacities.astype(np.float64)
    if by_area:
        keys *= surface_areas(model)
    gone = len(model) - max(1, round(keep * len(model)))
    rows = np.sort(np.argsort(keys, kind="stable")[gone:])
    return model.select(rows), rows


def check_threshold(tau: float) -> None:
    """Refuse an invalid opacity threshold.

    Raises:
        InputError: it is not a number of at least 0 and less than 1.
    """
    if not 0.0 <= tau < 1.0:
        raise InputError(f"the opacity to prune by is {tau:g}, wanted at least 0 and less than 1")

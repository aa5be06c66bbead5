"""Apply the strategies one after the other: prune, leave out SH bands, cluster."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from csplat.errors import InputError
from csplat.model import MAX_SH_DEGREE, SplatModel
from csplat.scene import without_bands
from csplat.types import I64, Progress
from csplat_tools.study.clustering import Clustered, KMeans, cluster_attributes
from csplat_tools.study.pruning import check_threshold, prune_opacity
from csplat_tools.study.sizes import attribute_floats, raw_bytes
from csplat_tools.views import ViewSet, find_view_set

if TYPE_CHECKING:
    from csplat_tools.study.distilling import Teacher


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
class Reduced:
    """A scene after its reduction.

    Attributes:
        model: the scene.
        source_index: [N] int64, the source splat that each splat was.
        clustered: its codebooks; None if nothing was clustered.
        said: report of the steps, JSON-compatible.
    """

    model: SplatModel
    source_index: I64
    clustered: Clustered | None
    said: dict[str, Any]

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
) -> Reduced:
    """Prune, leave out SH bands, and cluster.

    Args:
        source: the scene.
        reduction: the steps.
        views: training and validation views for distilling; None for virtual ones.
        progress: progress callback.

    Raises:
        InputError: nothing would be left; or there is nothing to distil, or too few views to do it by.
    """
    teacher = find_teacher(source, reduction, views)
    return reduced_by(source, reduction, teacher, progress)


def reduced_by(source: SplatModel, reduction: Reduction, teacher: Teacher | None, progress: Progress | None) -> Reduced:
    """Do as `reduce_model` with a given `Teacher`, which has rendered the source; None: bands are only left out."""
    rows = np.arange(len(source), dtype=np.int64)
    model, degree = source, target_degree(source, reduction)
    said: dict[str, Any] = {"splats": len(source)}
    if reduction.prune_opacity is not None:
        model, rows = prune_opacity(source, reduction.prune_opacity)
        said["prune_opacity"] = reduction.prune_opacity
    if degree < source.sh_degree:
        said |= {"sh_degree": degree, "sh": "distilled" if reduction.distil else "truncated"}
    model = without_bands(model, degree) if teacher is None else teacher.taught(model, degree, progress)
    if teacher is not None:
        said["views"] = len(teacher.cameras)
    clustered = None
    if reduction.kmeans is not None:
        clustered = cluster_attributes(model, reduction.kmeans, threads=reduction.threads, progress=progress)
        model = clustered.model
        said["kmeans"] = clustered.as_json()
    return Reduced(model, rows, clustered, said)


def target_degree(source: SplatModel, reduction: Reduction) -> int:
    """Return the SH degree of the result."""
    return source.sh_degree if reduction.sh_degree is None else min(reduction.sh_degree, source.sh_degree)


def find_teacher(source: SplatModel, reduction: Reduction, views: ViewSet | None) -> Teacher | None:
    """Return the `Teacher` of the lower degree; None if nothing is distilled.

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
    from csplat_tools.study.distilling import Teacher  # requires numba; the other strategies do not

    if views is None:
        aside = max(1, reduction.views // _ASIDE)
        views = find_view_set(source, count=reduction.views - aside, aside=aside, seed=reduction.seed)
    return Teacher.of_source(source, views, threads=reduction.threads)

"""Simple ways to reduce a scene: prune by opacity, truncate or distil SH, cluster attributes; and encode the result.

They serve comparisons with published studies. k-means and the canonical axis order are those of the encoder.

To distil SH is to refit the colours of fewer bands to renders of the source. With fixed geometry a render is linear in
the coefficients, so the fit is a ridge least-squares problem, solved by conjugate gradients. Few views overfit: 300
splats with extreme SH lost 0.7 dB on other views if degree 0 was fitted to 28 views, and gained 2.3 dB with 112.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np

from csplat.decoder import decode
from csplat.encoder import EncodeOptions, EncodePlan, EncodeResult, Origin, canonicalise_shape, cluster, encode_tiles
from csplat.errors import InputError
from csplat.model import MAX_SH_DEGREE, SplatModel, normalise_quats
from csplat.scene_source import drop_bands
from csplat.types import F32, F64, I64, U32, Progress
from csplat_render import Camera
from csplat_render.scene_frame import surface_areas
from csplat_render.scorer import Scorer, renderer
from csplat_tools.views import ViewSet, find_view_set, shrink_cameras

#: Attributes that have a codebook of their own, in the order of a model's fields.
ATTRIBUTES = ("means", "quats", "scales", "opacities", "sh0", "shN")

_HOLD_OUT_EVERY = 8  # every Nth virtual view is a validation view
_FIT_STEPS = 8  # largest number of conjugate gradient steps; more overfit the training views
_MAX_STAGES = 4
_MAX_ENTRIES = 1 << 16  # largest number of entries of a codebook
_NORM = 2000.0  # norm of the longest vector in lattice units: below 2,300 the search is exact everywhere
_GROUPED = 2048  # number of entries from which only the nearest groups of them are searched
_NEAR_GROUPS = 8  # number of groups that are searched then
_REFINEMENTS = 3  # bisections between two powers of two, to find the size that reaches an error share
_FLOAT_BYTES = 4


@dataclass(frozen=True)
class Reduction:
    """The steps of a reduction, in this order.

    Attributes:
        prune_opacity: prune splats of at most this alpha; `None`: keep all.
        sh_degree: drop the SH bands above; `None`: keep all.
        distil: fit the remaining bands to renders of the source; otherwise they are unchanged.
        kmeans: attributes to cluster; `None`: no clustering.
        views: number of virtual views for distilling, to which 16 are added; one in eight is a validation view.
        seed: seed of the virtual views.
        threads: number of threads; `None` for all. The result does not depend on it.

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
            _check_threshold(self.prune_opacity)
        if self.sh_degree is not None and not 0 <= self.sh_degree <= MAX_SH_DEGREE:
            raise InputError(f"sh_degree is {self.sh_degree}, expected 0 to {MAX_SH_DEGREE}")
        if self.views < 2:
            raise InputError(f"{self.views} views, expected at least 2: one for training, one for validation")
        if self.seed < 0:
            raise InputError(f"the seed of views is {self.seed}, expected at least 0")


@dataclass(frozen=True, eq=False)
class ReducedScene:
    """A scene after its reduction.

    Attributes:
        model: the scene.
        source_index: [N] int64, the index of each splat in the source.
        clustered: its codebooks; `None` if nothing was clustered.
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
    """Prune, drop SH bands, and cluster.

    Args:
        source: the scene.
        reduction: the steps.
        views: training and validation views for distilling; `None` for virtual ones.
        progress: progress callback.

    Raises:
        InputError: all splats would be pruned; there are no bands to distil, or too few views.
    """
    return _reduce(source, reduction, _source_renders(source, reduction, views), progress)


def _reduce(
    source: SplatModel, reduction: Reduction, renders: SourceRenders | None, progress: Progress | None
) -> ReducedScene:
    """Reduce a scene; without renders of the source, SH bands are dropped and not distilled."""
    rows = np.arange(len(source), dtype=np.int64)
    model, degree = source, _target_degree(source, reduction)
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


def _target_degree(source: SplatModel, reduction: Reduction) -> int:
    return source.sh_degree if reduction.sh_degree is None else min(reduction.sh_degree, source.sh_degree)


def _source_renders(source: SplatModel, reduction: Reduction, views: ViewSet | None) -> SourceRenders | None:
    """Return the renders to which colours are fitted; `None` if nothing is distilled."""
    if not reduction.distil:
        return None
    if _target_degree(source, reduction) >= source.sh_degree:
        raise InputError(f"the scene has SH of degree {source.sh_degree}: distilling requires a lower sh_degree")
    if views is None:
        validation_count = max(1, reduction.views // _HOLD_OUT_EVERY)
        views = find_view_set(
            source, count=reduction.views - validation_count, validation_count=validation_count, seed=reduction.seed
        )
    return SourceRenders.of_source(source, views, threads=reduction.threads)


def encode_reduced(
    source: SplatModel,
    reduction: Reduction,
    encoding: EncodeOptions | None = None,
    *,
    views: ViewSet | None = None,
    progress: Progress | None = None,
) -> EncodeResult:
    """Prune, drop SH bands, cluster, and encode.

    Args:
        source: the scene.
        reduction: the steps. If its `sh_degree` is `None`, that of `encoding` is used.
        encoding: options of the encoder.
        views: training and validation views for distilling; `None` for virtual ones.
        progress: progress callback.

    Returns:
        The file and its source index. The file declares error bounds against the source, except for distilled
        colours; for these its metadata contain the PSNR on the validation views.

    Raises:
        InputError: as for `reduce_model` and the encoder.
    """
    encoding = encoding or EncodeOptions()
    if reduction.sh_degree is None:
        reduction = replace(reduction, sh_degree=encoding.sh_degree)
    degree = _target_degree(source, reduction)
    encoding = replace(encoding, sh_degree=degree)
    renders = _source_renders(source, reduction, views)
    clusters = reduction.kmeans is not None
    reduced = _reduce(source, reduction, renders if clusters else None, progress)
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
    return coded.write({"reduced": report})


def _with_bands(model: SplatModel, sh_degree: int) -> SplatModel:
    """Append SH bands of zeros, so that the encoder records the source's degree."""
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
        InputError: the threshold is out of range, or all splats would be pruned.
    """
    _check_threshold(tau)
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


def _check_threshold(tau: float) -> None:
    if not 0.0 <= tau < 1.0:
        raise InputError(f"the opacity to prune by is {tau:g}, expected at least 0 and less than 1")


@dataclass(frozen=True, eq=False)
class SourceRenders:
    """Renders of a source, to which the colours of other scenes are fitted.

    Attributes:
        cameras: the training views.
        references: [H, W, 3], the source's render of each.
        check_scorer: scorer on the validation views.
        background: background colour.
        threads: number of threads; `None` for all. No result depends on it.
    """

    cameras: Sequence[Camera]
    references: Sequence[F32]
    check_scorer: Scorer
    background: tuple[float, float, float]
    threads: int | None

    @classmethod
    def of_source(cls, source: SplatModel, views: ViewSet, *, threads: int | None = None) -> SourceRenders:
        """Render the source in the training and validation views, reduced to a small size.

        Raises:
            InputError: there are no training or no validation views.
        """
        if not views.training:
            raise InputError("there are no training views to fit colours to")
        training, validation = shrink_cameras(views.training), shrink_cameras(views.validation)
        draw = renderer(source, views.background, threads=threads)
        references = [draw(camera).rgb for camera in training]
        check_scorer = Scorer.of_source(source, validation, views.background, threads=threads)
        return cls(training, references, check_scorer, views.background, threads)

    def distilled(self, model: SplatModel, sh_degree: int, progress: Progress | None = None) -> SplatModel:
        """Return the scene with SH up to a degree, with colours fitted to the source's renders.

        Args:
            model: the geometry, and the colours to start from, of the source's degree or less.
            sh_degree: SH degree of the result.
            progress: progress callback.

        Raises:
            InputError: `sh_degree` is larger than that of the model.
        """
        from csplat_render.refit import fit_colours  # requires numba, unlike the other strategies

        if sh_degree > model.sh_degree:
            raise InputError(f"sh_degree is {sh_degree}, expected at most {model.sh_degree}, that of the scene")
        low = drop_bands(model, sh_degree)
        found, _ = fit_colours(
            low, self.cameras, self.references, steps=_FIT_STEPS, least_gain=0.01, background=self.background,
            antialiased=low.antialiased, threads=self.threads, progress=progress,
        )  # fmt: skip
        return replace(low, sh0=np.ascontiguousarray(found[:, 0]), shN=np.ascontiguousarray(found[:, 1:]))


@dataclass(frozen=True)
class KMeans:
    """The attributes to cluster, and the sizes of their codebooks.

    Attributes:
        sizes: entries of the codebook by attribute; or a fraction below 1, for the smallest codebook found whose
            squared error is at most that fraction of the attribute's variance. Other attributes are unchanged.
        stages: codebooks per attribute, each for the residual of the one before; all of the same size.
        gauge: bring rotations and scales to the encoder's canonical form, one of 24 equal ones; otherwise only the sign
            of rotations is fixed.
        seed: seed of the clustering.

    Raises:
        InputError: an attribute is unknown, or a number is out of range.
    """

    sizes: Mapping[str, float]
    stages: int = 1
    gauge: bool = True
    seed: int = 0

    def __post_init__(self) -> None:
        if not self.sizes:
            raise InputError("k-means of no attribute")
        for name, size in self.sizes.items():
            if name not in ATTRIBUTES:
                raise InputError(f"k-means of {name!r}, expected some of {', '.join(ATTRIBUTES)}")
            whole = 1 <= size <= _MAX_ENTRIES and float(size).is_integer()
            if not (whole or 0.0 < size < 1.0):
                raise InputError(
                    f"k-means: {name} is {size:g}, expected 1 to {_MAX_ENTRIES} entries,"
                    " or a fraction of the variance below 1"
                )
        if not 1 <= self.stages <= _MAX_STAGES:
            raise InputError(f"k-means in {self.stages} stages, expected 1 to {_MAX_STAGES}")
        if self.seed < 0:
            raise InputError(f"the seed of k-means is {self.seed}, expected at least 0")


@dataclass(frozen=True)
class AttributeCodebook:
    """The codebooks of one attribute.

    Attributes:
        floats: number of values per entry.
        sizes: number of entries of each stage; empty if no codebook reached the error, and values are unchanged.
        error_share: squared error as a fraction of the attribute's variance.
    """

    floats: int
    sizes: tuple[int, ...]
    error_share: float

    def size_bytes(self, count: int) -> int:
        """Return the bytes of float32 entries, and of indices of ceil(log2 K) bits for `count` splats."""
        if not self.sizes:
            return raw_bytes(self.floats, count)
        return raw_bytes(self.floats, sum(self.sizes)) + -(-count * _index_bits(self.sizes) // 8)


@dataclass(frozen=True, eq=False)
class Clustered:
    """A scene with clustered values.

    Attributes:
        model: the scene; the order of splats is unchanged.
        books: codebooks by attribute, without those that were not clustered.
    """

    model: SplatModel
    books: dict[str, AttributeCodebook]

    @property
    def size_bytes(self) -> int:
        """Bytes of codebooks and indices, and of raw float32 for attributes without codebooks."""
        return sum(self.attribute_bytes().values())

    def attribute_bytes(self) -> dict[str, int]:
        """Return the bytes of codebooks and indices, or of raw float32, by attribute."""
        count = len(self.model)
        floats = attribute_floats(self.model.sh_degree)
        return {
            name: self.books[name].size_bytes(count) if name in self.books else raw_bytes(number, count)
            for name, number in floats.items()
        }

    def as_json(self) -> dict[str, Any]:
        """Return sizes and errors of the codebooks as JSON-compatible values."""
        return {name: {"sizes": list(book.sizes), "error_share": book.error_share} for name, book in self.books.items()}


def parse_kmeans(text: str, *, stages: int = 1, seed: int = 0) -> KMeans:
    """Parse `256`, `means=4096,quats=256`, `256,means=4096`, `0.01` or `means=0.0001,sh0=64`.

    Args:
        text: numbers for all attributes or, after NAME=, for one; a number below 1 is a fraction of the variance.
        stages, seed: as in `KMeans`.

    Raises:
        InputError: the text is invalid.
    """
    sizes: dict[str, float] = {}
    named: dict[str, float] = {}
    for word in text.split(","):
        name, equals, number = word.strip().rpartition("=")
        try:
            size = float(number)
        except ValueError:
            raise InputError(
                f"k-means {word.strip()!r}: {number!r} is not a number, expected 256 or means=256"
            ) from None
        if equals:
            if name in named:
                raise InputError(f"k-means names {name} twice")
            named[name] = size
        elif sizes:
            raise InputError("k-means has two numbers for all attributes, expected one")
        else:
            sizes = dict.fromkeys(ATTRIBUTES, size)
    return KMeans({**sizes, **named}, stages, seed=seed)


def cluster_attributes(
    model: SplatModel, how: KMeans, *, threads: int | None = None, progress: Progress | None = None
) -> Clustered:
    """Replace the values of each splat by codebook entries.

    Args:
        model: the scene.
        how: the attributes to cluster, and the sizes of their codebooks.
        threads: number of threads; `None` for all. The result does not depend on it.
        progress: progress callback.
    """
    requested = {name: how.sizes[name] for name in ATTRIBUTES if name in how.sizes}
    model = _canonicalised(model, how)
    books, changes = dict[str, AttributeCodebook](), dict[str, Any]()
    for number, (name, size) in enumerate(requested.items()):
        report = partial(_report, progress, number, len(requested))
        report(0.0)
        values: F32 = getattr(model, name)
        flat = values.reshape(len(model), -1).astype(np.float64) if values.size else np.zeros((0, 0))
        if not flat.size:
            continue  # no splats, or no bands above 0
        found, sizes = _cluster_one(flat, size, how, threads, report)
        books[name] = AttributeCodebook(flat.shape[1], sizes, _error_share(flat, found))
        if sizes:
            changes[name] = _valid(name, found.astype(np.float32)).reshape(values.shape)
    if progress is not None:
        progress("clustering", 1.0)
    return Clustered(replace(model, **changes), books)


def _report(progress: Progress | None, number: int, count: int, share: float) -> None:
    if progress is not None:
        progress("clustering", (number + share) / count)


def _canonicalised(model: SplatModel, how: KMeans) -> SplatModel:
    """Bring equal shapes to one description, so that they share codebook entries."""
    if "quats" not in how.sizes or not len(model):
        return model
    if how.gauge:
        quats, scales = canonicalise_shape(model.quats, model.scales)
        return replace(
            model, quats=normalise_quats(np.ascontiguousarray(quats.T)), scales=np.ascontiguousarray(scales.T)
        )
    return replace(model, quats=np.where(model.quats[:, :1] < 0.0, -model.quats, model.quats))


def _valid(name: str, values: F32) -> F32:
    if name == "quats":
        return normalise_quats(values)
    if name == "opacities":
        return np.clip(values, 0.0, 1.0)  # sums of stages may leave the range
    return values


def _cluster_one(
    values: F64, size: float, how: KMeans, threads: int | None, report: Callable[[float], None]
) -> tuple[F64, tuple[int, ...]]:
    """Return the clustered values and the stages' sizes.

    The sizes are empty if even one entry per two splats does not reach the error.
    """
    if size >= 1.0:
        return _stages(values, int(size), how, threads, report)
    most = min(_MAX_ENTRIES, max(1, len(values) // 2))
    count, low = 1, 0
    found = _stages(values, count, how, threads)
    while _error_share(values, found[0]) > size:
        if count == most:
            return values, ()
        low, count = count, min(most, 2 * count)
        report(min(0.9, math.log2(count) / math.log2(_MAX_ENTRIES)))
        found = _stages(values, count, how, threads)
    for _ in range(_REFINEMENTS):
        middle = (low + count) // 2
        if middle in (low, count):
            break
        tried = _stages(values, middle, how, threads)
        if _error_share(values, tried[0]) > size:
            low = middle
        else:
            count, found = middle, tried
    return found


def _stages(
    values: F64, size: int, how: KMeans, threads: int | None, report: Callable[[float], None] | None = None
) -> tuple[F64, tuple[int, ...]]:
    total, sizes = np.zeros_like(values), list[int]()
    for stage in range(how.stages):

        def show(done: int, steps: int, stage: int = stage) -> None:
            if report is not None:
                report((stage + done / steps) / how.stages)

        part, entries = _one_stage(values - total, size, how.seed + stage, threads, show)
        total += part
        sizes.append(entries)
    return total, tuple(sizes)


def _one_stage(
    values: F64, size: int, seed: int, threads: int | None, show: Callable[[int, int], None]
) -> tuple[F64, int]:
    """Return the entry assigned to each splat, and the number of entries."""
    if size >= len(values):
        index = np.unique(values, axis=0, return_inverse=True)[1].reshape(-1).astype(np.uint32)
    else:
        index = _assigned(values, size, seed, threads, show)
    count = int(index.max()) + 1
    held = np.bincount(index, minlength=count)
    sums = [np.bincount(index, column, count) for column in values.T]  # in the order of the splats
    entries = np.stack(sums, axis=1) / np.maximum(held, 1)[:, None]
    return entries[index], count


def _assigned(values: F64, size: int, seed: int, threads: int | None, show: Callable[[int, int], None]) -> U32:
    centred = values - values.mean(axis=0)
    longest = math.sqrt(float(np.max(np.einsum("nd,nd->n", centred, centred))))
    points = np.rint(centred * (_NORM / longest if longest > 0.0 else 0.0)).astype(np.int32)
    near = _NEAR_GROUPS if size >= _GROUPED else 0
    weights = np.ones(len(points), np.float32)
    return cluster(points, weights, size, seed=seed, near_groups=near, threads=threads, progress=show)[1]


def _error_share(values: F64, clustered: F64) -> float:
    """Return the squared error as a fraction of the squared distance from the mean; 0 if all values are equal."""
    spread = float(np.sum(np.square(values - values.mean(axis=0))))
    return float(np.sum(np.square(values - clustered))) / spread if spread > 0.0 else 0.0


def attribute_floats(sh_degree: int) -> dict[str, int]:
    """Return the number of values per splat of each attribute at an SH degree."""
    return {"means": 3, "quats": 4, "scales": 3, "opacities": 1, "sh0": 3, "shN": 3 * ((sh_degree + 1) ** 2 - 1)}


def raw_bytes(floats: int, rows: int) -> int:
    """Return the bytes of `rows` rows of `floats` float32 values."""
    return _FLOAT_BYTES * floats * rows


def _index_bits(sizes: Iterable[int]) -> int:
    return sum((size - 1).bit_length() for size in sizes)

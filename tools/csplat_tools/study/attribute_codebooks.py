"""Cluster attributes by k-means: each splat's value becomes the entry of a codebook, or a sum of several."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np

from csplat.encoder import canonicalise_shape, cluster
from csplat.errors import InputError
from csplat.model import SplatModel, normalise_quats
from csplat.types import F32, F64, U32, Progress

#: Attributes that have a codebook of their own, in the order of a model's fields.
ATTRIBUTES = ("means", "quats", "scales", "opacities", "sh0", "shN")

MAX_STAGES = 4
_MAX_SIZE = 1 << 16  # largest number of entries of a codebook
_NORM = 2000.0  # norm of the longest vector in lattice units: below 2,300 the search is exact everywhere
_GROUPED = 2048  # number of entries from which only the nearest groups of them are searched
_NEAR_GROUPS = 8  # number of groups that are searched then
_REFINEMENTS = 3  # bisections between two powers of two for the size that reaches an error share


@dataclass(frozen=True)
class KMeans:
    """The attributes to cluster, and the sizes of their codebooks.

    Attributes:
        sizes: by attribute, an integer from 1: entries of a codebook; or a fraction above 0 and below 1: the codebook
            is as small as possible with a squared error of that fraction of the attribute's variance. Attributes that
            are not named are unchanged.
        stages: codebooks per attribute, each for the residual of the one before; all of the same size.
        gauge: bring rotations and scales to the encoder's canonical form, one of 24 equal ones; otherwise only the sign
            of rotations is fixed.
        seed: seed of the clustering.

    Raises:
        InputError: an attribute is not known, or a number is out of range.
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
                raise InputError(f"k-means of {name!r}: wanted some of {', '.join(ATTRIBUTES)}")
            whole = 1 <= size <= _MAX_SIZE and float(size).is_integer()
            if not (whole or 0.0 < size < 1.0):
                raise InputError(
                    f"k-means: {name} is {size:g}, wanted 1 to {_MAX_SIZE} entries, or a share of the variance below 1"
                )
        if not 1 <= self.stages <= MAX_STAGES:
            raise InputError(f"k-means in {self.stages} stages, wanted 1 to {MAX_STAGES}")
        if self.seed < 0:
            raise InputError(f"the seed of k-means is {self.seed}, wanted 0 or more")


@dataclass(frozen=True)
class AttributeCodebook:
    """The codebooks of one attribute.

    Attributes:
        floats: number of values of an entry.
        sizes: number of entries of each stage; empty: no codebook reached the error, and the values are unchanged.
        error_share: squared error as a fraction of the attribute's variance.
    """

    floats: int
    sizes: tuple[int, ...]
    error_share: float

    def size_bytes(self, count: int) -> int:
        """Return the bytes of entries in float32 and of indices of ceil(log2 K) bits for `count` splats."""
        if not self.sizes:
            return raw_bytes(self.floats, count)
        return raw_bytes(self.floats, sum(self.sizes)) + -(-count * index_bits(self.sizes) // 8)


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
            raise InputError(f"k-means {word.strip()!r}: {number!r} is no number, wanted 256 or means=256") from None
        if equals:
            if name in named:
                raise InputError(f"k-means names {name} twice")
            named[name] = size
        elif sizes:
            raise InputError("k-means has two numbers for all attributes, wanted one")
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
        threads: number of threads; `None`: all processors. The result does not depend on it.
        progress: progress callback.
    """
    requested = {name: how.sizes[name] for name in ATTRIBUTES if name in how.sizes}
    model = _canonicalised(model, how)
    books, changes = dict[str, AttributeCodebook](), dict[str, Any]()
    for number, (name, size) in enumerate(requested.items()):
        tell = partial(_tell, progress, number, len(requested))
        tell(0.0)
        values: F32 = getattr(model, name)
        flat = values.reshape(len(model), -1).astype(np.float64) if values.size else np.zeros((0, 0))
        if not flat.size:
            continue  # no splats, or no bands above 0
        found, sizes = _cluster_one(flat, size, how, threads, tell)
        books[name] = AttributeCodebook(flat.shape[1], sizes, _error_share(flat, found))
        if sizes:
            changes[name] = _valid(name, found.astype(np.float32)).reshape(values.shape)
    if progress is not None:
        progress("clustering", 1.0)
    return Clustered(replace(model, **changes), books)


def _tell(progress: Progress | None, number: int, count: int, share: float) -> None:
    if progress is not None:
        progress("clustering", (number + share) / count)


def _canonicalised(model: SplatModel, how: KMeans) -> SplatModel:
    """Bring shapes to one form: different descriptions of equal shapes would need entries of their own."""
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
    values: F64, size: float, how: KMeans, threads: int | None, tell: Callable[[float], None]
) -> tuple[F64, tuple[int, ...]]:
    """Return the clustered values and the stages' sizes; no sizes if half as many entries as splats do not suffice."""

    def by(entries: int) -> tuple[F64, tuple[int, ...]]:
        return _stages(values, entries, how, threads)

    if size >= 1.0:
        return _stages(values, int(size), how, threads, tell)
    most = min(_MAX_SIZE, max(1, len(values) // 2))
    count, low = 1, 0
    found = by(count)
    while _error_share(values, found[0]) > size:
        if count == most:
            return values, ()
        low, count = count, min(most, 2 * count)
        tell(min(0.9, math.log2(count) / math.log2(_MAX_SIZE)))
        found = by(count)
    for _ in range(_REFINEMENTS):
        middle = (low + count) // 2
        if middle in (low, count):
            break
        tried = by(middle)
        if _error_share(values, tried[0]) > size:
            low = middle
        else:
            count, found = middle, tried
    return found


def _stages(
    values: F64, size: int, how: KMeans, threads: int | None, tell: Callable[[float], None] | None = None
) -> tuple[F64, tuple[int, ...]]:
    total, sizes = np.zeros_like(values), list[int]()
    for stage in range(how.stages):

        def show(done: int, steps: int, stage: int = stage) -> None:
            if tell is not None:
                tell((stage + done / steps) / how.stages)

        part, entries = _one_stage(values - total, size, how.seed + stage, threads, show)
        total += part
        sizes.append(entries)
    return total, tuple(sizes)


def _one_stage(
    values: F64, size: int, seed: int, threads: int | None, show: Callable[[int, int], None]
) -> tuple[F64, int]:
    """Return the entry of each splat's value, and the number of entries."""
    index = _distinct(values) if size >= len(values) else _assigned(values, size, seed, threads, show)
    count = int(index.max()) + 1
    held = np.bincount(index, minlength=count)
    sums = [np.bincount(index, column, count) for column in values.T]  # in the order of the splats
    entries = np.stack(sums, axis=1) / np.maximum(held, 1)[:, None]
    return entries[index], count


def _distinct(values: F64) -> U32:
    return np.unique(values, axis=0, return_inverse=True)[1].reshape(-1).astype(np.uint32)


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


_FLOAT_BYTES = 4


def attribute_floats(sh_degree: int) -> dict[str, int]:
    """Return the values per splat of each attribute at an SH degree: 14 in all at degree 0, 23 at degree 1."""
    return {"means": 3, "quats": 4, "scales": 3, "opacities": 1, "sh0": 3, "shN": 3 * ((sh_degree + 1) ** 2 - 1)}


def raw_bytes(floats: int, rows: int) -> int:
    """Return the bytes of `rows` rows of `floats` float32 values."""
    return _FLOAT_BYTES * floats * rows


def index_bits(sizes: Iterable[int]) -> int:
    """Return the bits of one splat's indices into codebooks of these sizes: ceil(log2 K) each."""
    return sum((size - 1).bit_length() for size in sizes)

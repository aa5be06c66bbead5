"""Measure the errors of a scene's splats against those of its source, if the pairs are known or can be found."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from csplat import scene as scenes
from csplat.decoder import DeclaredBounds, open_tiles
from csplat.model import SplatModel
from csplat.scene import Scene
from csplat.types import Progress, null_progress
from csplat_conformance.stated import Source, lattice_radii, match, measure_pairs, prove_by_disk
from csplat_conformance.stated.pairs import merged
from csplat_tools.files.console import finite
from csplat_tools.files.scenes import LoadedModel, OpenedScene
from csplat_tools.files.streams import is_csplat

Pairing = Literal["index", "order", "search"]

_NEAR = 0.01  # fraction of the scene's spread: splats in the same order are nearer than this, shuffled ones far off


@dataclass(frozen=True)
class AttributeErrors:
    """Errors of pairs of splats.

    Attributes:
        pairing: how the pairs are known. `index`: from a source index. `order`: both scenes hold the same number of
            splats, and the centres show that the order is the same. `search`: a source splat was found within the
            errors that the file declares, which need not be the original one.
        matched: number of splats of the other scene that have a partner; only these are measured.
        unmatched: number of those that have none.
        errors: largest and rms error by measure, in the order of the registry.
    """

    pairing: Pairing
    matched: int
    unmatched: int
    errors: dict[str, tuple[float, float]]

    def as_json(self) -> dict[str, Any]:
        """Return everything as JSON-compatible values; an error that overflowed is `null`."""
        return {
            "pairing": self.pairing,
            "matched": self.matched,
            "unmatched": self.unmatched,
            "errors": {
                name: {"max": finite(largest), "rms": finite(rms)} for name, (largest, rms) in self.errors.items()
            },
        }


def attribute_errors(
    source: LoadedModel,
    other: LoadedModel,
    source_index: NDArray[Any] | None = None,
    *,
    progress: Progress | None = None,
) -> AttributeErrors | None:
    """Measure the errors of a scene's splats against those of its source.

    Args:
        source: the scene that `other` was made from.
        other: the scene whose errors are measured.
        source_index: [N] integers, the source splat of each splat of `other`; `None`: not known.
        progress: progress callback of a search.

    Returns:
        The errors; `None` if the pairs of splats cannot be found.

    Raises:
        InputError: `source_index` is not one index of a source splat for each splat of `other`.
    """
    ours, theirs = Source.of(source.model), other.model
    if source_index is not None:
        return AttributeErrors("index", len(theirs), 0, _errors(ours, theirs, source_index))
    if _same_order(source.model, theirs):
        return AttributeErrors("order", len(theirs), 0, _errors(ours, theirs, np.arange(len(theirs))))
    stated, header = other.declared_bounds, other.header
    if header is None or stated is None or not len(theirs):
        return None
    bounds = {record.measure: record.max for record in stated.records}
    if not bounds.keys() >= {"means", "opacities", "sh0"}:
        return None
    found = match(ours, theirs, bounds, lattice_radii(theirs, header), progress=progress)
    matched = np.flatnonzero(found >= 0)
    if not len(matched):
        return None
    errors = _errors(ours, theirs.select(matched), found[matched])
    return AttributeErrors("search", len(matched), len(theirs) - len(matched), errors)


def attribute_errors_by_disk(
    source: OpenedScene,
    other: OpenedScene,
    source_index: NDArray[Any] | None = None,
    *,
    progress: Progress | None = None,
) -> AttributeErrors | None:
    """Like `attribute_errors` for scenes not in memory: without a search, and a source index only for .csplat files."""
    if source_index is not None:
        if not is_csplat(other.path):
            return None
        # For a file that declares no errors and was refitted, all errors are measured.
        nothing = DeclaredBounds(source.count, 0, source.facts.sh_degree, refitted=True, records=())
        opened = replace(open_tiles(other.path), declared_bounds=nothing)
        proof = prove_by_disk(source.scene, opened, source_index, memory_bytes=source.memory_bytes, progress=progress)
        found = {one.name: (one.measured_max or 0.0, one.measured_rms or 0.0) for one in proof.measures}
        return AttributeErrors("index", other.count, 0, found)
    if source.count != other.count or not _same_order(source.sample(progress)[0], other.sample(progress)[0]):
        return None
    parts = [
        (start, len(theirs), measure_pairs(Source.of(ours), theirs, np.arange(len(theirs))))
        for start, ours, theirs in _beside(source.scene, other.scene, progress)
    ]
    found = {name: (one.max, one.rms) for name, one in merged(parts).items()}
    return AttributeErrors("order", other.count, 0, found)


def _beside(a: Scene, b: Scene, progress: Progress | None) -> Iterator[tuple[int, SplatModel, SplatModel]]:
    """Yield splats of two scenes of equal number, some at a time, with the number of the first of them."""
    first = scenes.watched(a, "measuring splats", progress or null_progress).blocks()
    second = scenes.watched(b, "", null_progress).blocks()
    start, ours, theirs = 0, a.facts, b.facts
    while start < a.count:
        ours, theirs = ours if len(ours) else next(first), theirs if len(theirs) else next(second)
        count = min(len(ours), len(theirs))
        if count:
            yield start, ours.select(slice(0, count)), theirs.select(slice(0, count))
        ours, theirs, start = ours.select(slice(count, None)), theirs.select(slice(count, None)), start + count


def _errors(source: Source, other: SplatModel, index: NDArray[Any]) -> dict[str, tuple[float, float]]:
    return {name: (found.max, found.rms) for name, found in measure_pairs(source, other, index).items()}


def _same_order(source: SplatModel, other: SplatModel) -> bool:
    """Return True if splat i of one scene is splat i of the other: in a shuffled scene half the splats are far off."""
    if len(source) != len(other) or not len(source):
        return False
    means = source.means.astype(np.float64)
    shift = np.subtract(other.origin, source.origin)
    distances = np.linalg.norm(other.means.astype(np.float64) + shift - means, axis=1)
    spread = float(np.median(np.linalg.norm(means - np.median(means, axis=0), axis=1)))
    return float(np.median(distances)) <= _NEAR * spread

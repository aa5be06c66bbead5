# SPDX-License-Identifier: Apache-2.0
"""Simple ways to reduce a scene, for comparison: prune by opacity, truncate SH, cluster attributes."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np

from csplat import _spec
from csplat.context import DEFAULT_CONTEXT, Context
from csplat.decoder import decode
from csplat.encoder import EncodeOptions, EncodePlan, EncodeResult, Origin, canonicalise_shape, cluster, encode_tiles
from csplat.errors import InputError
from csplat.model import SplatModel, normalise_quats
from csplat.scene import drop_bands
from csplat.types import F32, F64, I64, Progress

#: Attributes that are clustered, in the order of a model's fields.
ATTRIBUTES = ("means", "quats", "scales", "opacities", "sh0", "shN")

_MAX_ENTRIES = 1 << 16  # largest number of entries of a codebook
_NORM = 2000.0  # norm of the longest vector in lattice units: below 2,300 the search is exact everywhere
_GROUPED = 2048  # number of entries from which only the nearest groups of them are searched
_NEAR_GROUPS = 8  # number of groups that are searched then


@dataclass(frozen=True)
class Reduction:
    """The steps of a reduction, in this order.

    Attributes:
        prune_opacity: prune splats of at most this alpha; `None`: keep all.
        sh_degree: drop the SH bands above; `None`: keep all.
        kmeans: entries of a codebook for each attribute; `None`: no clustering.

    Raises:
        InputError: a value is out of range.
    """

    prune_opacity: float | None = None
    sh_degree: int | None = None
    kmeans: int | None = None

    def __post_init__(self) -> None:
        if self.prune_opacity is not None:
            _check_threshold(self.prune_opacity)
        if self.sh_degree is not None and not 0 <= self.sh_degree <= _spec.SH_DEGREE_MAX:
            raise InputError(f"sh_degree is {self.sh_degree}, expected 0 to {_spec.SH_DEGREE_MAX}")
        if self.kmeans is not None and not 1 <= self.kmeans <= _MAX_ENTRIES:
            raise InputError(f"kmeans is {self.kmeans}, expected 1 to {_MAX_ENTRIES} entries")


def encode_reduced(
    source: SplatModel,
    reduction: Reduction,
    encoding: EncodeOptions | None = None,
    *,
    context: Context = DEFAULT_CONTEXT,
) -> EncodeResult:
    """Prune, drop SH bands, cluster, and encode.

    Args:
        source: the scene.
        reduction: the steps. If its `sh_degree` is `None`, that of `encoding` is used.
        encoding: options of the encoder.
        context: threads, seed and progress.

    Returns:
        The file and its source index. The file declares error bounds against the source.

    Raises:
        InputError: all splats would be pruned, or as for the encoder.
    """
    encoding = encoding or EncodeOptions()
    if reduction.sh_degree is not None:
        encoding = replace(encoding, sh_degree=reduction.sh_degree)
    degree = encoding.kept_degree(source.sh_degree)
    encoding = replace(encoding, sh_degree=degree)
    model, rows = source, np.arange(len(source), dtype=np.int64)
    report: dict[str, Any] = {"splats": len(source)}
    if reduction.prune_opacity is not None:
        model, rows = prune_opacity(source, reduction.prune_opacity)
        report["prune_opacity"] = reduction.prune_opacity
    if degree < source.sh_degree:
        report |= {"sh_degree": degree, "sh": "truncated"}
    if reduction.kmeans is not None:
        model, report["kmeans"] = cluster_attributes(drop_bands(model, degree), reduction.kmeans, context=context)
        model = _with_bands(model, source.sh_degree)
    plan = EncodePlan.of(model, encoding, origin=Origin(len(source), rows), context=context)
    tiles = encode_tiles(plan)
    if reduction.kmeans is not None:
        tiles = tiles.against(source, decode(tiles.write().data, context=context))
    return tiles.write({"reduced": report})


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


def _check_threshold(tau: float) -> None:
    if not 0.0 <= tau < 1.0:
        raise InputError(f"the opacity to prune by is {tau:g}, expected at least 0 and less than 1")


def cluster_attributes(
    model: SplatModel, entries: int, *, context: Context = DEFAULT_CONTEXT
) -> tuple[SplatModel, dict[str, Any]]:
    """Replace the values of each splat by codebook entries, attribute by attribute.

    Args:
        model: the scene.
        entries: largest number of entries of each codebook.
        context: threads, seed and progress.

    Returns:
        The scene, and by attribute the size of the codebook and the squared error as a fraction of the variance.
    """
    if len(model):  # equal shapes get one description, so that they share entries
        quats, scales = canonicalise_shape(model.quats, model.scales)
        model = replace(
            model, quats=normalise_quats(np.ascontiguousarray(quats.T)), scales=np.ascontiguousarray(scales.T)
        )
    report, changes = dict[str, Any](), dict[str, Any]()
    for number, name in enumerate(ATTRIBUTES):
        context.progress("clustering", number / len(ATTRIBUTES))
        values: F32 = getattr(model, name)
        if not values.size:
            continue  # no splats, or no bands above 0
        flat = values.reshape(len(model), -1).astype(np.float64)
        found, size = _clustered(flat, entries, replace(context, progress=partial(_report, context.progress, number)))
        report[name] = {"sizes": [size], "error_share": _error_share(flat, found)}
        changes[name] = _valid(name, found.astype(np.float32)).reshape(values.shape)
    context.progress("clustering", 1.0)
    return replace(model, **changes), report


def _report(progress: Progress, number: int, _: str, done: float) -> None:
    """Report the progress of one attribute as a part of the progress of all."""
    progress("clustering", (number + done) / len(ATTRIBUTES))


def _valid(name: str, values: F32) -> F32:
    if name == "quats":
        return normalise_quats(values)
    return np.clip(values, 0.0, 1.0) if name == "opacities" else values


def _clustered(values: F64, entries: int, context: Context) -> tuple[F64, int]:
    """Return the entry assigned to each splat, and the number of entries."""
    if entries >= len(values):
        index = np.unique(values, axis=0, return_inverse=True)[1].reshape(-1).astype(np.uint32)
    else:
        centred = values - values.mean(axis=0)
        longest = math.sqrt(float(np.max(np.einsum("nd,nd->n", centred, centred))))
        points = np.rint(centred * (_NORM / longest if longest > 0.0 else 0.0)).astype(np.int32)
        near = _NEAR_GROUPS if entries >= _GROUPED else 0
        weights = np.ones(len(points), np.float32)
        index = cluster(points, weights, entries, near_groups=near, context=context)[1]
    count = int(index.max()) + 1
    sums = [np.bincount(index, column, count) for column in values.T]  # bincount adds in splat order: reproducible
    means = np.stack(sums, axis=1) / np.maximum(np.bincount(index, minlength=count), 1)[:, None]
    return means[index], count


def _error_share(values: F64, clustered: F64) -> float:
    """Return the squared error as a fraction of the squared distance from the mean; 0 if all values are equal."""
    spread = float(np.sum(np.square(values - values.mean(axis=0))))
    return float(np.sum(np.square(values - clustered))) / spread if spread > 0.0 else 0.0

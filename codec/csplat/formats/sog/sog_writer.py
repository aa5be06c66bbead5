# SPDX-License-Identifier: Apache-2.0
"""Write SOG, version 2, deterministically; codes are rounded, not truncated."""

from __future__ import annotations

import io
import json
import math
import zipfile
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from csplat.disk_files import atomic_writer, work_folder
from csplat.encoder.kmeans import assign, cluster
from csplat.errors import InputError, missing_package
from csplat.formats.common import ClampStatistics, MovedSplats, encode_smallest_three, sorted_along_curve
from csplat.formats.format import ValueRange
from csplat.formats.sog.sog_reader import ENTRIES, LEAST_TAG
from csplat.lint import Finding
from csplat.model import SplatModel
from csplat.scene import Scene, join_blocks
from csplat.scene_metadata import SceneMetadata
from csplat.types import F32, F64, U8, U32

_LEAST_WEIGHT = 1e-3  # relative to a splat of opacity 1 and median area
_LARGEST_SIDE = 16383  # pixels, limit of WebP
_CODES = 256
_LLOYD_STEPS = 40
_BINS = 4096  # bins of the histogram from which the first codes of a codebook are chosen
_AREAS = (0.01, 100.0)  # limits of a splat's area in its weight, relative to the median
_COARSE = 0.25  # fraction of the range of a codebook beyond which values count as clamped
_DATE = (1980, 1, 1, 0, 0, 0)  # date of zip members: fixed, so the same scene gives the same bytes
_NORM = 1000  # lattice steps of a long SH vector; searches are exact up to twice that
_LONG = 0.999  # quantile of the lengths that counts as long
_LEAST_STEP = 1e-6  # smallest step of that lattice, so that SH of zeros have one
_NEAR = 4  # groups of palette entries that are searched, out of 181 for 60,000 splats
_ITERATIONS = 2  # k-means iterations; more gain 0.03 dB in three times the time
_LARGEST_PALETTE = 1 << 16
_PIXELS_AT_ONCE = 1 << 23  # pixels of all images compressed in parallel, which take 70 bytes of memory each
_SAMPLE = 1 << 20  # number of splats from which codebooks and palette are computed
_CHANNELS = {"means_l.webp": 3, "means_u.webp": 3, "quats.webp": 4, "scales.webp": 3, "sh0.webp": 4}
#: The files next to a meta.json.
IMAGE_NAMES = (*_CHANNELS, "shN_centroids.webp", "shN_labels.webp")


def write_sog(path: Path, scene: Scene) -> list[Finding]:
    """Write a zip or, if the path ends in meta.json, files next to it (`Format.write`).

    Raises:
        InputError: the scene has more splats than an image can have pixels; or Pillow is not installed.
        OSError: a file cannot be written.
    """
    is_folder = path.name.lower().endswith("meta.json")
    losses = SogLosses()
    if is_folder:
        path.parent.mkdir(exist_ok=True)
    with sorted_along_curve(scene, work_folder(path)) as ordered:
        if is_folder:
            for name, data in encode_files(ordered, losses):  # meta.json comes last
                with atomic_writer(path if name == "meta.json" else path.with_name(name)) as stream:
                    stream.write(data)
            return losses.findings(scene.metadata)
        with atomic_writer(path, seekable=True) as stream, zipfile.ZipFile(stream, "w") as archive:
            for name, data in encode_files(ordered, losses):
                archive.writestr(zipfile.ZipInfo(name, _DATE), data)
    return losses.findings(scene.metadata)


@dataclass(frozen=True)
class SogLosses:
    """Values that SOG stores badly, collected by `encode_files`."""

    clamped: ClampStatistics = field(default_factory=ClampStatistics)
    moved: MovedSplats = field(default_factory=MovedSplats)

    def findings(self, metadata: SceneMetadata) -> list[Finding]:
        """Return the findings; `metadata` is the metadata of the scene."""
        both = metadata.antialiased and metadata.flat
        lost = [Finding("lost-contents", 1, "SOG cannot hold that splats are discs and antialiased", "loss")] * both
        clamped = self.clamped.findings("the 256 codes of SOG", lambda *_: ("ply", "gltf", "csplat"))
        return [*lost, *clamped, *self.moved.findings("SOG has 16 bits for the logarithms of positions")]


def encode_files(scene: Scene, losses: SogLosses) -> Iterator[tuple[str, bytes]]:
    """Yield the name and bytes of each file of a SOG. Takes 17 bytes of memory per splat, 21 with SH."""
    count = scene.count
    width = max(1, math.ceil(math.sqrt(count) / 4)) * 4
    height = max(1, math.ceil(count / width / 4)) * 4
    if max(width, height) > _LARGEST_SIDE:
        raise InputError(f"the scene has {count:,} splats, SOG allows {_LARGEST_SIDE}² at most")
    low, high, sample = _sample(scene)
    weights_of = partial(_splat_weights, median_area=float(np.median(_log_area(sample))) if count else 0.0)
    # Square roots keep the tails of the distribution accurate, where errors are visible.
    roots = np.sqrt(weights_of(sample))
    scales, colours = _build_codebook(sample.scales, roots), _build_codebook(sample.sh0, roots)
    meta: dict[str, Any] = {"version": 2, "asset": {"generator": "csplat"}, "count": count}
    if scene.metadata.antialiased or scene.metadata.flat:
        meta["model"] = "antialiased" if scene.metadata.antialiased else "2dgs"
    meta |= {
        "means": {"mins": low.tolist(), "maxs": high.tolist(), "files": ["means_l.webp", "means_u.webp"]},
        "scales": {"codebook": _shortest_decimals(scales), "files": ["scales.webp"]},
        "quats": {"files": ["quats.webp"]},
        "sh0": {"codebook": _shortest_decimals(colours), "files": ["sh0.webp"]},
    }

    def square(table: NDArray[Any]) -> U8:
        pixels = np.zeros((height * width, 4), np.uint8)
        pixels[:, 3] = 255
        pixels[:count, : table.shape[1]] = table
        return pixels.reshape(height, width, 4)

    codes = {name: np.empty((count, channels), np.uint8) for name, channels in _CHANNELS.items()}
    steps = np.where(high > low, high - low, 1.0) / 65535
    ranges = {"scales": _range_of(scales), "sh0": _range_of(colours)}
    for rows, model in losses.clamped.watch(scene, ranges).numbered():
        quantised = np.rint((_signed_logs(model.means) - low) / steps)
        logs = low + quantised * steps
        losses.moved.add(model, np.sign(logs) * np.expm1(np.abs(logs)))
        largest, three = encode_smallest_three(model.quats)
        codes["means_l.webp"][rows], codes["means_u.webp"][rows] = quantised % 256, quantised // 256
        codes["quats.webp"][rows, :3] = np.clip(np.rint((three * np.float32(2**0.5) + 1) * np.float32(127.5)), 0, 255)
        codes["quats.webp"][rows, 3] = largest + LEAST_TAG
        codes["scales.webp"][rows] = _nearest_codes(scales, model.scales)
        codes["sh0.webp"][rows, :3] = _nearest_codes(colours, model.sh0)
        codes["sh0.webp"][rows, 3] = np.rint(model.opacities * np.float32(255))
    if scene.sh_degree and count:
        values, entries, labels = _build_palette(scene, sample, weights_of)
        codes["shN_labels.webp"] = labels[:, None].astype("<u2").view(np.uint8)
        meta["shN"] = {
            "count": len(entries) * ENTRIES,
            "bands": scene.sh_degree,
            "codebook": _shortest_decimals(values),
            "files": ["shN_centroids.webp", "shN_labels.webp"],
        }
        yield "shN_centroids.webp", _encode_webp(entries)
    with ThreadPoolExecutor(max(1, min(len(codes), _PIXELS_AT_ONCE // (width * height)))) as pool:
        yield from zip(codes, pool.map(lambda name: _encode_webp(square(codes[name])), codes), strict=True)
    yield "meta.json", json.dumps(meta, separators=(",", ":")).encode()


def _range_of(codebook: F32) -> ValueRange:
    """Return the range of a codebook [256]; rounding to its outermost codes, means of rare values, is coarse."""
    low, high = float(codebook[0]), float(codebook[-1])
    return ValueRange(low, high, 2.0 * max(float(np.diff(codebook)[[0, -1]].max()), _COARSE * (high - low)))


def _sample(scene: Scene) -> tuple[F64, F64, SplatModel]:
    """Return the bounds [3] of the logarithms of all positions, and at most `_SAMPLE` evenly spaced splats."""
    step = -(-scene.count // _SAMPLE) or 1
    low, high = np.full(3, np.inf), np.full(3, -np.inf)
    samples = []
    for rows, model in scene.numbered():
        logs = _signed_logs(model.means)
        low, high = np.minimum(low, logs.min(0)), np.maximum(high, logs.max(0))
        samples.append(model.select(np.arange(-rows.start % step, len(model), step)))
    if not samples:
        return np.zeros(3), np.zeros(3), scene.empty()
    return low, high, join_blocks(scene.empty(), samples)


def _signed_logs(means: F32) -> F64:
    """Return sign(x) log(1 + |x|) of means [N, 3], which SOG quantises."""
    logs: F64 = np.sign(means) * np.log1p(np.abs(means.astype(np.float64)))
    return logs


def _log_area(model: SplatModel) -> F64:
    """Return the logarithm of the area of each splat's largest cross-section, [N], up to a constant."""
    area: F64 = np.sort(model.scales, 1)[:, 1:].sum(1, dtype=np.float64)
    return area


def _splat_weights(model: SplatModel, median_area: float) -> F32:
    """Return weights [N] by the share of a render: opacity times area relative to the scene's median (a logarithm)."""
    area = np.exp(_log_area(model) - median_area).clip(*_AREAS)
    weights: F32 = (model.opacities * area + _LEAST_WEIGHT).astype(np.float32)
    return weights


def _shortest_decimals(values: F32) -> list[float]:
    """Return the shortest decimals that round to the same float32 values."""
    return [float(str(value)) for value in values]


def _build_codebook(columns: F32, weights: F32) -> F32:
    """Compute a codebook by Lloyd's algorithm on prefix sums of the sorted values.

    Args:
        columns: [N, C], values.
        weights: [N], weights of the rows.

    Returns:
        [256] float32, ascending.
    """
    flat = columns.ravel()
    if not len(flat):
        return np.zeros(_CODES, np.float32)
    order = np.argsort(flat, kind="stable")
    values = flat[order].astype(np.float64)
    weight = np.repeat(weights.astype(np.float64), columns.shape[1])[order]
    mass = np.concatenate([[0.0], np.cumsum(weight)])
    moment = np.concatenate([[0.0], np.cumsum(weight * values)])
    # The optimal density of codes is proportional to the cube root of the density of values (Panter and Dite, 1951).
    edges = np.linspace(values[0], values[-1], _BINS + 1)
    density = np.diff(mass[np.searchsorted(values, edges[1:-1])], prepend=0.0, append=mass[-1]) ** (1 / 3)
    share = np.concatenate([[0.0], np.cumsum(density)])
    codes = np.interp((np.arange(_CODES) + 0.5) / _CODES * share[-1], share, edges)
    for _ in range(_LLOYD_STEPS):
        ends = np.concatenate([[0], np.searchsorted(values, (codes[1:] + codes[:-1]) / 2), [len(values)]])
        inside = np.diff(mass[ends])
        np.divide(np.diff(moment[ends]), inside, out=codes, where=inside > 0)
        codes.sort()
    codebook: F32 = codes.astype(np.float32)
    first = np.flatnonzero(np.diff(values, prepend=np.nan) != 0)
    if len(first) <= _CODES:
        codebook = np.pad(values[first], (0, _CODES - len(first)), "edge").astype(np.float32)
    return codebook


def _nearest_codes(codebook: F32, columns: F32) -> U8:
    """Return the index of the nearest entry of an ascending codebook [256] for each value of `columns`."""
    codes = np.searchsorted((codebook[1:].astype(np.float64) + codebook[:-1]) / 2, columns)
    return codes.astype(np.uint8)


def _build_palette(scene: Scene, sample: SplatModel, weights_of: Callable[[SplatModel], F32]) -> tuple[F32, U8, U32]:
    """Cluster the SH vectors of all splats.

    Returns:
        The codebook of coefficients, [256]; the palette image, [height, width, 4]; and the label of each splat, [N].
    """
    coefficients = (scene.sh_degree + 1) ** 2 - 1
    lengths = np.sqrt(np.einsum("nkc,nkc->n", sample.shN, sample.shN))
    step = np.float32(max(float(np.quantile(lengths, _LONG)) / _NORM, _LEAST_STEP))
    limit = 2 * _NORM / (3 * coefficients) ** 0.5

    def points(model: SplatModel) -> NDArray[np.int16]:
        steps: F32 = np.rint((model.shN.reshape(len(model), -1) / step).clip(-limit, limit))
        return steps.astype(np.int16)

    size = min(_LARGEST_PALETTE, 1 << max(10, scene.count.bit_length() - 1))  # as in splat-transform
    entries, labels = cluster(points(sample), weights_of(sample), size, iterations=_ITERATIONS, near_groups=_NEAR)
    if len(labels) < scene.count:
        labels = np.concatenate([assign(points(model), entries, near_groups=_NEAR) for model in scene.blocks()])
    total, sums = np.zeros(len(entries)), np.zeros((3 * coefficients, len(entries)))
    for rows, model in scene.numbered():
        weights = weights_of(model)
        total += np.bincount(labels[rows], weights, len(entries))
        for index, column in enumerate(model.shN.reshape(len(model), -1).T):
            sums[index] += np.bincount(labels[rows], weights * column, len(entries))
    centres = np.divide(sums, total, out=sums, where=total > 0).T
    order = np.argsort(np.einsum("nd,nd->n", centres, centres), kind="stable")
    rank = np.empty(len(order), np.uint32)
    rank[order] = np.arange(len(order))
    columns = centres[order].astype(np.float32)
    values = _build_codebook(columns, total[order].astype(np.float32))
    height = -(-len(order) // ENTRIES)
    pixels = np.zeros((height * ENTRIES, coefficients, 4), np.uint8)
    pixels[:, :, 3] = 255
    pixels[: len(order), :, :3] = _nearest_codes(values, columns).reshape(-1, coefficients, 3)
    return values, pixels.reshape(height, ENTRIES * coefficients, 4), rank[labels]


def _encode_webp(pixels: U8) -> bytes:
    """Return a lossless WebP of pixels [H, W, 4]; raise an `InputError` if Pillow is not installed."""
    try:
        from PIL import Image
    except ModuleNotFoundError as error:
        raise missing_package(error, "Pillow") from None
    buffer = io.BytesIO()
    # More effort does not help: method 6 at quality 100 took 100 times as long for 0.05 % more bytes.
    Image.fromarray(pixels).save(buffer, "WEBP", lossless=True, exact=True, quality=75, method=2)
    return buffer.getvalue()

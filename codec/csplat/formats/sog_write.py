"""Write SOG, version 2: the same bytes for the same scene, rounded where others cut off."""

from __future__ import annotations

import io
import json
import math
import zipfile
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from csplat.encoder.kmeans import cluster
from csplat.errors import InputError, missing
from csplat.files import atomic_writer
from csplat.formats.packing import morton_order, smallest_three
from csplat.formats.sog_read import ENTRIES, LEAST_TAG
from csplat.model import F32, SplatModel
from csplat.scene import Scene

__all__ = ["write_sog"]

U8 = NDArray[np.uint8]
F64 = NDArray[np.float64]

_LEAST_WEIGHT = 1e-3
_LARGEST_SIDE = 16383  # pixels of a WebP
_CODES = 256
_LLOYD_STEPS = 40
_DATE = (1980, 1, 1, 0, 0, 0)  # of the parts of a zip: the same scene is the same bytes
_NORM = 1000  # lattice steps of a long vector of SH: searches are exact up to twice that
_NEAR = 4  # groups of palette entries that are searched: of 181 for 60,000 splats
_ITERATIONS = 2  # more gain 0.03 dB, in three times the time
_LARGEST_PALETTE = 1 << 16


def write_sog(path: Path, scene: Scene) -> None:
    """Write a zip; or beside a path that ends in meta.json, the parts of a folder.

    Raises:
        InputError: more splats than a picture has pixels; or Pillow is absent.
        OSError: it cannot be written.
    """
    if path.name.lower() == "lod-meta.json":
        raise InputError(f"{path.name} would be streamed SOG, which csplat does not write: end it in .sog")
    files = _files(scene.model())
    if path.name.lower().endswith("meta.json"):
        path.parent.mkdir(exist_ok=True)
        for name, data in files.items():  # meta.json is the last
            with atomic_writer(path if name == "meta.json" else path.with_name(name)) as stream:
                stream.write(data)
        return
    with atomic_writer(path) as stream, zipfile.ZipFile(stream, "w") as archive:
        for name, data in files.items():
            archive.writestr(zipfile.ZipInfo(name, _DATE), data)


def _files(model: SplatModel) -> dict[str, bytes]:
    """The parts by name, in their order."""
    count = len(model)
    width = max(1, math.ceil(math.sqrt(count) / 4)) * 4
    height = max(1, math.ceil(count / width / 4)) * 4
    if max(width, height) > _LARGEST_SIDE:
        raise InputError(f"{count:,} splats are more than the pictures of SOG hold")
    order = morton_order(model.means)
    model = model.select(order)
    weights = _weights(model)

    def square(*columns: NDArray[Any]) -> U8:
        pixels = np.zeros((width * height, 4), np.uint8)
        pixels[:, 3] = 255
        table = np.column_stack(columns)
        pixels[:count, : table.shape[1]] = table
        return pixels.reshape(height, width, 4)

    logs = np.sign(model.means) * np.log1p(np.abs(model.means.astype(np.float64)))
    low, high = (logs.min(0), logs.max(0)) if count else (np.zeros(3), np.zeros(3))
    places = np.rint((logs - low) * (65535 / np.where(high > low, high - low, 1.0))).astype(np.uint16)
    largest, three = smallest_three(model.quats)
    turned = np.clip(np.rint((three * np.float32(2**0.5) + 1) * np.float32(127.5)), 0, 255)
    # By their roots: of few values each tail is seen somewhere (donut has 60.6 dB, by the weights themselves 53.1).
    scales, scale_codes = _codebook(model.scales, np.sqrt(weights))
    colours, colour_codes = _codebook(model.sh0, np.sqrt(weights))
    meta: dict[str, Any] = {"version": 2, "asset": {"generator": "csplat"}, "count": count}
    if model.antialiased or model.flat:
        meta["model"] = "antialiased" if model.antialiased else "2dgs"
    meta |= {
        "means": {"mins": low.tolist(), "maxs": high.tolist(), "files": ["means_l.webp", "means_u.webp"]},
        "scales": {"codebook": _short(scales), "files": ["scales.webp"]},
        "quats": {"files": ["quats.webp"]},
        "sh0": {"codebook": _short(colours), "files": ["sh0.webp"]},
    }
    pictures = {
        "means_l.webp": square(places & 255),
        "means_u.webp": square(places >> 8),
        "quats.webp": square(turned, largest + LEAST_TAG),
        "scales.webp": square(scale_codes),
        "sh0.webp": square(colour_codes, np.rint(model.opacities * np.float32(255))),
    }
    if model.sh_degree and count:
        values, entries, labels = _palette(model.shN, weights)
        pictures["shN_centroids.webp"] = entries
        pictures["shN_labels.webp"] = square(labels & 255, labels >> 8)
        meta["shN"] = {
            "count": len(entries) * ENTRIES,
            "bands": model.sh_degree,
            "codebook": _short(values),
            "files": ["shN_centroids.webp", "shN_labels.webp"],
        }
    with ThreadPoolExecutor() as pool:
        files = dict(zip(pictures, pool.map(_webp, pictures.values()), strict=True))
    return {**files, "meta.json": json.dumps(meta, separators=(",", ":")).encode()}


def _weights(model: SplatModel) -> F32:
    """How much of a picture a splat may be: opacity times the area of its largest side."""
    sides = np.sort(model.scales, 1)[:, 1:].sum(1, dtype=np.float64)
    area = np.exp(sides - (np.median(sides) if len(sides) else 0.0)).clip(1e-2, 1e2)
    weights: F32 = (model.opacities * area + _LEAST_WEIGHT).astype(np.float32)
    return weights


def _short(values: F32) -> list[float]:
    """The shortest decimals that say the same float32."""
    return [float(str(one)) for one in values]


def _codebook(columns: F32, weights: F32) -> tuple[F32, U8]:
    """256 values that stand for all, by Lloyd's algorithm on the sorted values: exact, and cheap for any number.

    Args:
        columns: [N, C].
        weights: [N].

    Returns:
        [256] float32, ascending; and the code of each value, [N, C].
    """
    flat = columns.ravel()
    if not len(flat):
        return np.zeros(_CODES, np.float32), np.zeros(columns.shape, np.uint8)
    order = np.argsort(flat, kind="stable")
    values = flat[order].astype(np.float64)
    weight = np.repeat(weights.astype(np.float64), columns.shape[1])[order]
    mass = np.concatenate([[0.0], np.cumsum(weight)])
    moment = np.concatenate([[0.0], np.cumsum(weight * values)])
    # The best density of codes is the cube root of that of the values (Panter and Dite).
    edges = np.linspace(values[0], values[-1], 4097)
    density = np.diff(mass[np.searchsorted(values, edges[1:-1])], prepend=0.0, append=mass[-1]) ** (1 / 3)
    share = np.concatenate([[0.0], np.cumsum(density)])
    codes = np.interp((np.arange(_CODES) + 0.5) / _CODES * share[-1], share, edges)
    for _ in range(_LLOYD_STEPS):
        ends = np.concatenate([[0], np.searchsorted(values, (codes[1:] + codes[:-1]) / 2), [len(values)]])
        inside = np.diff(mass[ends])
        np.divide(np.diff(moment[ends]), inside, out=codes, where=inside > 0)
        codes.sort()
    codebook = codes.astype(np.float32)
    first = np.flatnonzero(np.diff(values, prepend=np.nan) != 0)
    if len(first) <= _CODES:
        codebook = np.pad(values[first], (0, _CODES - len(first)), "edge").astype(np.float32)
    found = np.searchsorted((codebook[1:].astype(np.float64) + codebook[:-1]) / 2, columns)
    return codebook, found.astype(np.uint8)


def _palette(shN: F32, weights: F32) -> tuple[F32, U8, NDArray[np.uint16]]:
    """Vectors of SH that stand for those of all splats.

    Returns:
        The codebook of their coefficients; the picture of the palette; the label of each splat.
    """
    count, coefficients = shN.shape[:2]
    rows = shN.reshape(count, -1)
    lengths = np.sqrt(np.einsum("nd,nd->n", rows, rows))
    step = max(float(np.quantile(lengths, 0.999)) / _NORM, 1e-6)
    limit = 2 * _NORM / rows.shape[1] ** 0.5
    points = np.rint(np.clip(rows / np.float32(step), -limit, limit)).astype(np.int16)
    size = min(_LARGEST_PALETTE, 1 << max(10, count.bit_length() - 1))  # as splat-transform has it
    entries, labels = cluster(points, weights, size, seed=0, iterations=_ITERATIONS, near_groups=_NEAR)
    total = np.bincount(labels, weights, len(entries))
    centres = np.stack([np.bincount(labels, weights * column, len(entries)) / total for column in rows.T], 1)
    order = np.argsort(np.einsum("nd,nd->n", centres, centres), kind="stable")
    rank = np.empty(len(order), np.uint16)
    rank[order] = np.arange(len(order))
    values, codes = _codebook(centres[order].astype(np.float32), total[order].astype(np.float32))
    height = -(-len(order) // ENTRIES)
    pixels = np.zeros((height * ENTRIES, coefficients, 4), np.uint8)
    pixels[:, :, 3] = 255
    pixels[: len(order), :, :3] = codes.reshape(-1, coefficients, 3)
    return values, pixels.reshape(height, ENTRIES * coefficients, 4), rank[labels]


def _webp(pixels: U8) -> bytes:
    try:
        from PIL import Image
    except ModuleNotFoundError as error:
        raise missing(error, "Pillow") from None
    buffer = io.BytesIO()
    # More effort makes files of splats no smaller: method 6 at 100 took 100 times as long for 0.05 % more bytes.
    Image.fromarray(pixels).save(buffer, "WEBP", lossless=True, exact=True, quality=75, method=2)
    return buffer.getvalue()

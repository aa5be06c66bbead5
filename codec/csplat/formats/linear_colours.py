"""Colours that are linear light, put into SH of sRGB, as all else in this project has them.

A polynomial of directions whose values go through the transfer function of sRGB (IEC 61966-2-1) is none any more: the
nearest SH of the same degree are fitted to it by least squares. Without SH they are exact but for negative light.
Splats blended in linear light look different from splats blended in sRGB, which no colours make up for.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from csplat.model import SplatModel
from csplat.ply.columns import SH_C0
from csplat.turning import sh_bands, sphere_lattice
from csplat.types import F32

_DIRECTIONS = 96  # six for each coefficient of degree 3: with 1,000 the colours of a scene differ by 0.01 of 255 steps
_ROWS = 4096  # splats whose colours are in memory at a time
#: What all functions of a band are multiplied by.
_FACTORS = (0.4886025119029199, 0.5462742152960396, 0.5900435899266435)


def srgb_of_linear(model: SplatModel) -> SplatModel:
    """Fit SH of sRGB to those of linear light."""
    fitted = [coefficients for coefficients, _, _ in _fitted(model)]
    both = np.concatenate([np.zeros((0, model.shN.shape[1] + 1, 3), np.float32), *fitted])
    return replace(model, sh0=np.ascontiguousarray(both[:, 0]), shN=np.ascontiguousarray(both[:, 1:]))


def srgb_error(model: SplatModel) -> float:
    """Measure how far `srgb_of_linear` is off: rms over splats, directions and channels, in steps of 1/255."""
    squares, count = 0.0, 0
    for _, found, wanted in _fitted(model):
        squares += float(np.square(np.clip(found, 0, 1) - np.clip(wanted, 0, 1), dtype=np.float64).sum())
        count += found.size
    return 255.0 * float(np.sqrt(squares / count)) if count else 0.0


def _fitted(model: SplatModel) -> Iterator[tuple[F32, F32, F32]]:
    """Coefficients [n, K, 3] of some splats, and their colours [n, D, 3]: as they are fitted, as they are wanted."""
    directions = sphere_lattice(_DIRECTIONS)
    bands = [factor * band for factor, band in zip(_FACTORS, sh_bands(directions), strict=True)]
    wide = np.concatenate([np.full((len(directions), 1), np.float64(SH_C0)), *bands[: model.sh_degree]], axis=1)
    inverse, basis = np.linalg.pinv(wide).astype(np.float32), wide.astype(np.float32)
    for start in range(0, len(model), _ROWS):
        rows = slice(start, start + _ROWS)
        with np.errstate(over="ignore", invalid="ignore"):  # what leaves float32, a model refuses
            linear = basis @ np.concatenate([model.sh0[rows, None], model.shN[rows]], axis=1) + np.float32(0.5)
            wanted = _srgb(np.maximum(linear, 0))
            coefficients = inverse @ (wanted - np.float32(0.5))
            fitted = basis @ coefficients + np.float32(0.5)
        yield coefficients, fitted, wanted


def _srgb(linear: F32) -> F32:
    high = np.float32(1.055) * linear ** np.float32(1 / 2.4) - np.float32(0.055)
    colours: F32 = np.where(linear <= np.float32(0.0031308), np.float32(12.92) * linear, high)
    return colours

# SPDX-License-Identifier: CC0-1.0
"""Reconstruct values in single precision as a GPU does (spec 7), and measure their distance from exact values.

Usage:
    python -m csplat_selftest.single_precision                # all valid vectors, and seeded integers
    python -m csplat_selftest.single_precision FILE.csplat... # files

The table lists the largest distance for each array and accuracy of arithmetic. WGSL and GLSL ES permit a product to be
either neighbour of the exact one, errors of 2.5 ulp for quotients and 4.5 ulp for square roots (as 1 / inverseSqrt),
and flushing of subnormal numbers to zero. Here, all errors have the same direction, which is the worst case for
products.
"""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from csplat import _spec, decoder
from csplat.types import F32
from csplat_conformance.manifest import load
from csplat_conformance.tolerance import ulps_between

Ints = NDArray[Any]

_NEAREST = 0.5
_NEIGHBOUR = 0.999
_SMALLEST = 2.0**-126
_BITS = 24  # bits of a binary32 significand
_LARGEST = float(np.finfo(np.float32).max)


@dataclass(frozen=True)
class GpuArithmetic:
    """The arithmetic of a GPU in binary32.

    Attributes:
        product: largest error of products, ulp; 0.5 is rounding to nearest.
        quotient: the same for quotients.
        root: the same for square roots.
        away: whether errors point away from zero; otherwise they point towards it.
        flush: whether subnormal operands and results become zero.
    """

    product: float = _NEAREST
    quotient: float = _NEAREST
    root: float = _NEAREST
    away: bool = True
    flush: bool = False

    def times(self, a: F32, b: float | F32) -> F32:
        """Multiply; infinite products become the largest number."""
        return self._off(self._in(a) * self._in(b), self.product)

    def over(self, a: F32, b: float) -> F32:
        """Divide by a binary32 number."""
        return self._off(self._in(a) / np.float64(b), self.quotient)

    def sqrt(self, a: F32) -> F32:
        """Take the square root."""
        return self._off(np.sqrt(self._in(a)), self.root)

    def _in(self, a: float | F32) -> NDArray[np.float64]:
        wide = np.asarray(a, np.float64)
        return np.where(np.abs(wide) < _SMALLEST, 0.0, wide) if self.flush else wide

    def _off(self, exact: NDArray[np.float64], allowed: float) -> F32:
        """Round to binary32 with the largest allowed error in ulp."""
        if allowed != _NEAREST:
            ulp = np.where(exact == 0, 0.0, np.ldexp(1.0, np.frexp(exact)[1] - _BITS))  # zero is exact
            end = exact + np.copysign(allowed * ulp, exact) * (1 if self.away else -1)
            value = np.clip(end, -_LARGEST, _LARGEST).astype(np.float32)
            beyond = np.abs(value) > np.abs(end) if self.away else np.abs(value) < np.abs(end)
            value = np.where(beyond, np.nextafter(value, exact.astype(np.float32)), value)
        else:
            value = np.clip(exact, -_LARGEST, _LARGEST).astype(np.float32)
        return np.where(np.abs(value) < _SMALLEST, np.float32(0), value) if self.flush else value


#: The columns of the table, each with its variants of arithmetic.
GPUS: Final = {
    "nearest": (GpuArithmetic(),),
    "nearest, flush": (GpuArithmetic(flush=True),),
    "root 3 ulp": tuple(GpuArithmetic(_NEIGHBOUR, 2.5, 3.0, away, flush=True) for away in (True, False)),
    "WGSL": tuple(GpuArithmetic(_NEIGHBOUR, 2.5, 4.5, away, flush=True) for away in (True, False)),
}


# Section 7 -----------------------------------------------------------------------------------------


def lattice_values(n: Ints, step: float, exponent: int, gpu: GpuArithmetic) -> F32:
    """Return n, rounded to binary32, times s, rounded once; powers of two are applied separately (7.2, 7.4).

    Args:
        n: int64, at most 2^53 in magnitude.
        step: step in the attribute's record.
        exponent: exponent of the tile or block.
        gpu: arithmetic.
    """
    mantissa, power = math.frexp(math.ldexp(step, exponent))
    parts, powers = np.frexp(n.astype(np.float32))
    product = gpu.times(parts, float(np.float32(mantissa)))
    with np.errstate(over="ignore"):
        scaled = np.ldexp(product, np.clip(powers + power, -400, 400))
    scaled = np.clip(scaled, -np.float32(_LARGEST), np.float32(_LARGEST))
    return np.where(np.abs(scaled) < _SMALLEST, np.float32(0), scaled) if gpu.flush else scaled


def opacities(q: Ints, record: _spec.AttributeRecord, gpu: GpuArithmetic, *, by_quotient: bool = True) -> F32:
    """Return q / M, or its square (7.3), by a quotient or by the factor 1 / M or 1 / M²."""
    square = record.mapping == _spec.MAPPING_SQUARE
    if by_quotient:
        alpha = gpu.over(q.astype(np.float32), record.levels)
        return gpu.times(alpha, alpha) if square else alpha
    power = 2 if square else 1
    return gpu.times((q.astype(np.int64) ** power).astype(np.float32), float(np.float32(1 / record.levels**power)))


def quats(q: Ints, levels: int, gpu: GpuArithmetic) -> F32:
    """Return w, x, y, z: √R × c and q × c, R of integers and c rounded to binary32 (7.5)."""
    c = float(np.float32(1 / (levels * math.sqrt(2))))
    w = gpu.times(gpu.sqrt(radicands(q, levels).astype(np.float32)), c)
    return np.column_stack([w, gpu.times(q.astype(np.float32), c)])


def radicands(q: Ints, levels: int) -> Ints:
    """Return the exact R of each row of q."""
    squares: Ints = (q.astype(np.int64) ** 2).sum(axis=1)
    return 2 * levels * levels - squares


# Distances -----------------------------------------------------------------------------------------


def _gpu_values(
    integers: dict[str, Ints], header: decoder.SceneHeader, gpu: GpuArithmetic
) -> Iterator[tuple[str, F32]]:
    """Yield names and values: means, scales, sh0 and the bands, opacities by quotient and by factor, w and the rest."""
    tiles = np.repeat(np.arange(len(integers["tile_splats"])), integers["tile_splats"])
    for index, record in enumerate(header.attributes):
        name = _spec.ATTRIBUTE_NAMES[record.attribute]
        n = integers[name]
        if record.attribute == _spec.ATTRIBUTE_OPACITIES:
            yield "opacities, q / M", opacities(n, record, gpu)
            yield "opacities, q × (1 / M)", opacities(n, record, gpu, by_quotient=False)
        elif record.attribute == _spec.ATTRIBUTE_QUATS:
            values = quats(n, record.levels, gpu)
            yield "quats, w", values[:, 0]
            yield "quats, x, y, z", values[:, 1:]
        else:
            out = np.empty(n.shape, np.float32)
            for exponent in np.unique(integers["exponents"][:, index]):
                chosen = (integers["exponents"][:, index] == exponent)[tiles]
                out[chosen] = lattice_values(n[chosen], record.step, int(exponent), gpu)
            yield name, out


def _exact_values(model: Any, name: str) -> F32:
    if name.startswith("quats"):
        return model.quats[:, 0] if name.endswith("w") else model.quats[:, 1:]  # type: ignore[no-any-return]
    if name.startswith("sh") and name != "sh0":
        band = int(name[2:])
        return model.shN[:, band * band - 1 : (band + 1) ** 2 - 1]  # type: ignore[no-any-return]
    return getattr(model, name.partition(",")[0])  # type: ignore[no-any-return]


def _file_values(files: Iterable[bytes]) -> Iterator[tuple[str, str, F32, F32]]:
    """Yield array name, accuracy, values and exact values of files."""
    for data in files:
        header, model = decoder.read_header(data), decoder.decode(data)
        integers = decoder.decode_integers(data, tiles=range(len(header.tiles)))  # level 0, as in the model
        for accuracy, gpus in GPUS.items():
            for gpu in gpus:
                for name, values in _gpu_values(integers, header, gpu):
                    yield name, accuracy, values, _exact_values(model, name)


def _seeded_values(seed: int = 1, count: int = 20000) -> Iterator[tuple[str, str, F32, F32]]:
    """Yield the same for random rotations of 500 levels, means of 500 steps, and all opacities of 500 levels."""
    rng = np.random.default_rng(seed)
    for levels in (3, *rng.integers(4, _spec.QUAT_LEVELS_MAX, 498).tolist(), _spec.QUAT_LEVELS_MAX):
        q = rng.integers(-levels, levels + 1, (count, 3))
        q[::2] //= 40  # w near 1
        q = q[radicands(q, levels) >= 0]
        c = 1 / (levels * math.sqrt(2))
        exact = np.column_stack([np.sqrt(radicands(q, levels)), q]) * c
        n = rng.integers(-_spec.INTEGER_MAX, _spec.INTEGER_MAX, count) >> rng.integers(0, 53, count)
        step, exponent = 1.0 + rng.random(), int(rng.integers(-90, 40))
        means = (n * math.ldexp(step, exponent)).astype(np.float32)
        wide = 2 * levels
        every = np.arange(wide + 1)
        for accuracy, gpus in GPUS.items():
            for gpu in gpus:
                yield "means", accuracy, lattice_values(n, step, exponent, gpu), means
                found = quats(q, levels, gpu)
                yield "quats, w", accuracy, found[:, 0], exact[:, 0].astype(np.float32)
                yield "quats, x, y, z", accuracy, found[:, 1:], exact[:, 1:].astype(np.float32)
                for mapping, power in ((_spec.MAPPING_LINEAR, 1), (_spec.MAPPING_SQUARE, 2)):
                    record = _spec.AttributeRecord(_spec.ATTRIBUTE_OPACITIES, mapping, 0, 0, wide, 0.0)
                    alphas = (every**power / float(wide**power)).astype(np.float32)
                    yield "opacities, q / M", accuracy, opacities(every, record, gpu), alphas
                    yield "opacities, q × (1 / M)", accuracy, opacities(every, record, gpu, by_quotient=False), alphas


def main() -> int:
    """Print the table."""
    parser = argparse.ArgumentParser(
        prog="csplat_selftest.single_precision",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("files", nargs="*", type=Path)
    files = parser.parse_args().files
    valid = (vector.data for vector in load() if not vector.error)
    sources = [_file_values(path.read_bytes() for path in files) if files else _file_values(valid)]
    farthest: dict[str, dict[str, tuple[int, float]]] = {}
    for source in sources if files else [*sources, _seeded_values()]:
        for name, accuracy, values, exact in source:
            # Subnormal values are excluded, because they may be flushed to zero.
            kept = (exact == 0) | (np.abs(exact) >= _SMALLEST)
            distances = np.abs(values[kept].astype(np.float64) - exact[kept])
            old = farthest.setdefault(name, {}).get(accuracy, (0, 0.0))
            apart = int(ulps_between(values[kept], exact[kept]).max(initial=0))
            farthest[name][accuracy] = max(old[0], apart), max(old[1], float(distances.max(initial=0.0)))
    sys.stdout.write(_table(farthest) + "\n")
    return 0


def _table(farthest: dict[str, dict[str, tuple[int, float]]]) -> str:
    lines = [f"| array | {' | '.join(GPUS)} |", "|---" * (len(GPUS) + 1) + "|"]
    for name in sorted(farthest):
        cells = []
        for ulp, distance in farthest[name].values():
            bounded = name.startswith(("quats", "opacities")) and distance > 0
            cells.append(f"{ulp} ulp" + (f", 2^{math.log2(distance):.1f}" if bounded else ""))
        lines.append(f"| {name} | {' | '.join(cells)} |")
    return "\n".join(lines)


if __name__ == "__main__":
    sys.exit(main())

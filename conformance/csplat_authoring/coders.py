"""Forward transforms (spec 6.3), written for vectors: plain, slow, the same bytes everywhere.

No compression library takes part, so that a vector never changes because a library did.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import groupby

from csplat import _spec


def to_bytes(values: Sequence[int], width: int) -> bytes:
    """Write integers little-endian, modulo 2^(8·width): what a sequence is when no byte transform follows."""
    data = bytearray(width * len(values))
    for plane in range(width):
        data[plane::width] = bytes([value >> (8 * plane) & 255 for value in values])
    return bytes(data)


def apply_transforms(values: Sequence[int], width: int, transforms: Sequence[int]) -> bytes:
    """Apply transforms in their order and return the bytes that reach the coder (spec 6.3)."""
    modulus = 1 << (8 * width)
    elements = [value % modulus for value in values]
    packed: bytes | None = None
    for transform in transforms:
        if transform == _spec.TRANSFORM_DELTA:
            before = [0, *elements[:-1]]
            elements = [(x - last) % modulus for x, last in zip(elements, before, strict=True)]
        elif transform == _spec.TRANSFORM_ZIGZAG:
            signed = [x - modulus if x >= modulus // 2 else x for x in elements]
            elements = [2 * v if v >= 0 else -2 * v - 1 for v in signed]
        elif transform == _spec.TRANSFORM_BYTE_PLANES:
            packed = bytes([x >> (8 * plane) & 255 for plane in range(width) for x in elements])
        elif transform == _spec.TRANSFORM_RUN_LENGTH:
            packed = _run_length(to_bytes(elements, width) if packed is None else packed)
    return to_bytes(elements, width) if packed is None else packed


def _run_length(data: bytes) -> bytes:
    runs: list[tuple[int, int]] = []
    for value, equal in groupby(data):
        whole, rest = divmod(len([*equal]), _spec.RUN_MAX)
        runs += [(value, _spec.RUN_MAX)] * whole + [(value, rest)] * (rest > 0)
    values = bytes(value for value, _ in runs)
    low = bytes((length - 1) & 255 for _, length in runs)
    return values + low + bytes((length - 1) >> 8 for _, length in runs)

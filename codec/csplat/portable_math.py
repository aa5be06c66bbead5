# SPDX-License-Identifier: Apache-2.0
"""Compute exponentials and logarithms with the same bits on every processor.

NumPy and the C library choose different code for different processors, with results that differ in the last bit. The
functions here consist of operations that IEEE 754 rounds correctly: sums, products, quotients, and scaling by powers of
two. Each is a ufunc call of its own, which leaves a compiler nothing to fuse. Reductions and coefficients are from
FDLIBM (e_exp.c, e_log.c), whose errors are below 1 ulp for exp, and below 2 ulp for the logarithms.

Values that reach the bytes of a file are computed by these functions instead of NumPy's, and by sums in a fixed order:
`np.sum` and `np.bincount`, but not `np.einsum` and matrix products, unless their partial sums are exact.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from csplat.types import F64, I64

_BLOCK = 1 << 13  # values per block of temporaries, 64 KiB
_LN2 = float.fromhex("0x1.62E42FEFA39EFp-1")
_LN2_HIGH = float.fromhex("0x1.62E42FEEp-1")  # 32 bits, so that products with exponents are exact
_LN2_LOW = float.fromhex("0x1.A39EF35793C76p-33")
_ONE_SCALE = 708.0  # largest magnitude of an exponent whose power is a normal number
_OVERFLOW = 746.0  # largest magnitude of an exponent that matters: the results beyond are infinite or 0
_EXP = (  # from the highest power
    float.fromhex("0x1.6376972BEA4D0p-25"),
    float.fromhex("-0x1.BBD41C5D26BF1p-20"),
    float.fromhex("0x1.1566AAF25DE2Cp-14"),
    float.fromhex("-0x1.6C16C16BEBD93p-9"),
    float.fromhex("0x1.555555555553Ep-3"),
)
_LOG = (  # from the highest power
    float.fromhex("0x1.2F112DF3E5244p-3"),
    float.fromhex("0x1.39A09D078C69Fp-3"),
    float.fromhex("0x1.7466496CB03DEp-3"),
    float.fromhex("0x1.C71C51D8E78AFp-3"),
    float.fromhex("0x1.2492494229359p-2"),
    float.fromhex("0x1.999999997FA04p-2"),
    float.fromhex("0x1.5555555555593p-1"),
)
_ROOT_HALF = 0.5**0.5
_EXPONENT_BIAS, _FRACTION_BITS = 1023, 52  # of binary64


def exp(x: NDArray[Any] | float) -> F64:
    """Return e**x in float64; 0 and infinity where that leaves float64."""
    wide, result = _flat(x)
    for at in range(0, wide.size, _BLOCK):
        _exp_block(wide[at : at + _BLOCK], result[at : at + _BLOCK])
    return result.reshape(np.shape(x))


def log(x: NDArray[Any] | float) -> F64:
    """Return the natural logarithm in float64; -infinity of 0, NaN of negative values."""
    wide, result = _flat(x)
    for at in range(0, wide.size, _BLOCK):
        exponent, rest = _log_block(wide[at : at + _BLOCK])
        result[at : at + _BLOCK] = exponent * _LN2_HIGH + (rest + exponent * _LN2_LOW)
    return result.reshape(np.shape(x))


def log2(x: NDArray[Any] | float) -> F64:
    """Return the logarithm to base 2 in float64, exact for powers of two; see `log`."""
    wide, result = _flat(x)
    for at in range(0, wide.size, _BLOCK):
        exponent, rest = _log_block(wide[at : at + _BLOCK])
        result[at : at + _BLOCK] = exponent + rest / _LN2
    return result.reshape(np.shape(x))


def ceil_log2(x: float) -> int:
    """Return the smallest integer n with 2**n >= x > 0."""
    fraction, exponent = math.frexp(x)
    return exponent - (fraction == 0.5)


def _flat(x: NDArray[Any] | float) -> tuple[F64, F64]:
    """Return the values as float64 [n], and an uninitialised array of the same shape for the results."""
    wide = np.asarray(x, np.float64).reshape(-1)
    return wide, np.empty_like(wide)


def _exp_block(x: F64, out: F64) -> None:
    """Write e**x of x [n] to `out` [n]; 0 and infinity where that leaves float64, NaN for NaN.

    With x = k ln 2 + r, |r| <= ln 2 / 2, and c = r - r² P(r²): e**x = 2**k (1 + r + r c / (2 - c)).
    """
    small = bool(np.abs(x).max() <= _ONE_SCALE)  # False if a value is NaN
    if not small:
        x = np.clip(x, -_OVERFLOW, _OVERFLOW)
    k = np.rint(x * (1.0 / _LN2))
    high = k * -_LN2_HIGH
    high += x
    low = k * _LN2_LOW
    r = high - low
    square = r * r
    c = square * _EXP[0]
    for coefficient in _EXP[1:]:
        c += coefficient
        c *= square
    np.subtract(r, c, out=c)
    np.multiply(r, c, out=out)
    np.subtract(2.0, c, out=c)
    out /= c
    out -= low
    out += high
    out += 1.0
    if small:
        bits: I64 = k.astype(np.int64)  # 2**k as the bits of a float64
        bits += _EXPONENT_BIAS
        bits <<= _FRACTION_BITS
        out *= bits.view(np.float64)
        return
    with np.errstate(over="ignore", under="ignore", invalid="ignore"):
        out[:] = np.ldexp(out, np.nan_to_num(k).astype(np.int32))


def _log_block(x: F64) -> tuple[F64, F64]:
    """Return k and log(m), both [n], of x = 2**k m, [n], with √½ <= m < √2.

    With f = m - 1 and s = f / (2 + f): log(m) = f - f²/2 + s (f²/2 + R(s²)). For 0, infinity, NaN and negative
    x, k is 0 and log(m) is -infinity, infinity, NaN and NaN.
    """
    m, exponent = np.frexp(x)
    low = m < _ROOT_HALF
    k = exponent - low.astype(np.float64)
    m *= 1.0 + low
    f = m - 1.0
    with np.errstate(divide="ignore", invalid="ignore"):
        s = f / (f + 2.0)
        special = ~((x > 0.0) & (x < np.inf))
    square = s * s
    log_m = square * _LOG[0]  # R(s²) until the loop ends
    for coefficient in _LOG[1:]:
        log_m += coefficient
        log_m *= square
    half = f * f
    half *= 0.5
    log_m += half
    log_m *= s
    log_m -= half
    log_m += f
    if special.any():
        k[special] = 0.0
        log_m[special] = np.where(x[special] == 0.0, -np.inf, np.where(x[special] > 0.0, np.inf, np.nan))
    return k, log_m

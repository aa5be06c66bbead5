# SPDX-License-Identifier: Apache-2.0
"""Code integers as bytes: Morton codes, transforms, DEFLATE, and the blocks of a tile (spec 6)."""

from __future__ import annotations

import importlib.util
import zlib
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from csplat import _spec
from csplat.errors import InputError
from csplat.portable_math import log2
from csplat.types import I64

Integers = NDArray[Any]

_FASTEST_LEVEL = 1  # DEFLATE level at which samples replace trials
_RUN_BYTES_MIN = 64  # bytes from which RUN_LENGTH is tried
_DEFLATE_BYTES_MIN = 4  # DEFLATE cannot shorten fewer bytes
_SHORT_RUN = 1.5  # mean run length, bytes, from which RUN_LENGTH is tried
_LONG_RUN = 32  # the same at the fastest level
_SAMPLE = 4096  # bytes of each of four evenly spaced samples, to which up to 3 bytes at the end may be added
_TRIAL_LEVEL = 6  # DEFLATE level of trials, which takes a twentieth of the highest level's time and rarely errs
_CLEAR = 0.95  # ratio of the sizes of trials from which the smaller remains the smaller at the highest level
_GAIN = 0.98  # maximum relative size with RUN_LENGTH; a smaller gain is not worth the decoding time
_MOSTLY = 0.9  # fraction of non-zero splats above which a mask is not worth the decoding time
_SPREAD = (  # shifts and masks that insert two zeros between bits
    (32, 0x1F00000000FFFF),
    (16, 0x1F0000FF0000FF),
    (8, 0x100F00F00F00F00F),
    (4, 0x10C30C30C30C30C3),
    (2, 0x1249249249249249),
)


@dataclass(frozen=True)
class DeflateSettings:
    """DEFLATE level and library.

    Attributes:
        level: DEFLATE level, 1 to 12 (libdeflate's scale).
        library: "libdeflate" or "zlib".
    """

    level: int = 9
    library: str = "libdeflate"

    def __post_init__(self) -> None:
        if self.library not in ("libdeflate", "zlib"):
            raise InputError(f"deflate library is {self.library!r}, expected libdeflate or zlib")
        if not 1 <= self.level <= 12:
            raise InputError(f"the level of DEFLATE is {self.level}, expected 1 to 12")


def trial_settings(deflate: DeflateSettings) -> DeflateSettings:
    """Return settings that are fast enough to compare codings, most of which are not used."""
    return replace(deflate, level=min(deflate.level, _TRIAL_LEVEL))


def deflate_library(name: str) -> str:
    """Resolve "auto" to libdeflate if its package is installed, and to zlib otherwise.

    Raises:
        InputError: libdeflate is requested by name and its package is not installed.
    """
    present = importlib.util.find_spec("deflate") is not None
    if name == "libdeflate" and not present:
        raise InputError("deflate: the package 'deflate' is not installed, use auto or zlib")
    if name == "auto":
        return "libdeflate" if present else "zlib"
    return name


def unsigned_stream(
    values: Integers, deflate: DeflateSettings, *, delta: bool = False, signed_delta: bool = False, fixed_width: int = 0
) -> bytes:
    """Write a stream of unsigned integers.

    Args:
        values: [n], n >= 1, integers from 0 to 2**56 - 1 (any unsigned dtype if differences are not coded).
        deflate: level and library of DEFLATE.
        delta: code differences of ascending values.
        signed_delta: code differences of values in any order (DELTA, then ZIGZAG).
        fixed_width: bytes per element; 0: as the largest value needs.

    Returns:
        Head and coded bytes.
    """
    width = fixed_width or _width(int(values.max()))
    if not (delta or signed_delta):
        return _make_stream(values, width, (_spec.TRANSFORM_NONE,), deflate)
    differences = np.empty(len(values), np.int64)
    differences[0] = values[0]
    np.subtract(values[1:], values[:-1], out=differences[1:], dtype=np.int64, casting="unsafe")
    if signed_delta:
        half = 1 << (8 * width - 1)
        wrapped = ((differences + half) & (2 * half - 1)) - half
        return _make_stream(_zigzag(wrapped), width, (_spec.TRANSFORM_DELTA, _spec.TRANSFORM_ZIGZAG), deflate)
    differences &= (1 << (8 * width)) - 1
    return _make_stream(differences, width, (_spec.TRANSFORM_DELTA,), deflate)


def smooth_stream(values: Integers, deflate: DeflateSettings, *, fixed_width: int = 0) -> bytes:
    """Write a stream of unsigned integers or of their differences, whichever is smaller.

    Neighbours in Morton order have similar colours and sizes in many scenes, but not in all.

    Args:
        values: [n], n >= 1, integers from 0 to 2**32 - 1.
        deflate: level and library of DEFLATE; at the lowest level, entropies replace trials.
        fixed_width: as in `unsigned_stream`.
    """
    write = partial(unsigned_stream, values, fixed_width=fixed_width)
    if deflate.level <= _FASTEST_LEVEL:
        low = values.astype(np.uint8)
        differences = np.diff(low)  # modulo 256; zigzag would not change the entropy
        return write(deflate, signed_delta=_byte_entropy(differences) < _byte_entropy(low))
    trial = trial_settings(deflate)
    plain_size = len(write(trial))
    delta_size = len(write(trial, signed_delta=True))
    streams = list[bytes]()  # both, unless one is clearly larger
    if _CLEAR * plain_size <= delta_size:
        streams.append(write(deflate))
    if _CLEAR * delta_size <= plain_size:
        streams.append(write(deflate, signed_delta=True))
    return min(streams, key=len)


def signed_stream(values: Integers, deflate: DeflateSettings) -> bytes:
    """Write a stream of signed integers of at most 32 bits, [n], n >= 1, with ZIGZAG."""
    folded = _zigzag(values)
    return _make_stream(folded, _width(int(folded.max())), (_spec.TRANSFORM_ZIGZAG,), deflate)


def levels_block(q: Integers, deflate: DeflateSettings) -> bytes:
    """Return a LEVELS block of opacities q [n], 0 to M."""
    return _block_head(_spec.ATTRIBUTE_OPACITIES, _spec.CODING_LEVELS) + unsigned_stream(q, deflate)


def morton_block(codes: I64, bits: int, deflate: DeflateSettings) -> bytes:
    """Return a MORTON block of means: codes [n], ascending, below 2**(3·bits)."""
    params = _spec.pack_morton_params(_spec.MortonParams(bits, 0, 0))
    head = _block_head(_spec.ATTRIBUTE_MEANS, _spec.CODING_MORTON)
    return head + params + unsigned_stream(codes, deflate, delta=True)


def axis_block(q: Integers, deflate: DeflateSettings) -> bytes:
    """Return an AXIS block of means q [3, n], 0 to 2**24 - 1, in any order."""
    stream = unsigned_stream(q.reshape(-1), deflate, signed_delta=True)
    return _block_head(_spec.ATTRIBUTE_MEANS, _spec.CODING_AXIS) + stream


def offset_block(attribute: int, integers: Integers, exponent: int, deflate: DeflateSettings) -> bytes:
    """Return an OFFSET block of integers [C, n], any sign, at most 2**32 - 1 apart in each column."""
    return _block_head(attribute, _spec.CODING_OFFSET) + _code_offsets(integers, exponent, deflate)


def signed_block(attribute: int, integers: Integers, exponent: int, deflate: DeflateSettings) -> bytes:
    """Return a SIGNED block of integers [C, n] of at most 32 bits."""
    head = _block_head(attribute, _spec.CODING_SIGNED) + _spec.pack_lattice_params(_spec.LatticeParams(exponent, 0))
    return head + signed_stream(np.ascontiguousarray(integers).reshape(-1), deflate)


def sparse_block(attribute: int, integers: Integers, exponent: int, deflate: DeflateSettings) -> bytes:
    """Return a SPARSE block of integers [C, n] of at most 32 bits, not all 0."""
    coded = integers.any(axis=0)  # splats with an integer other than 0
    params = _spec.SparseParams(exponent, 0, int(np.count_nonzero(coded)))
    mask = unsigned_stream(np.packbits(coded, bitorder="little"), deflate, fixed_width=1)
    head = _block_head(attribute, _spec.CODING_SPARSE) + _spec.pack_sparse_params(params)
    return head + mask + signed_stream(np.ascontiguousarray(integers[:, coded]).reshape(-1), deflate)


def signed_or_sparse_block(attribute: int, integers: Integers, exponent: int, deflate: DeflateSettings) -> bytes:
    """Return the smaller of a SIGNED and a SPARSE block of integers [C, n] of at most 32 bits, not all 0."""
    plain = signed_block(attribute, integers, exponent, deflate)
    if np.count_nonzero(integers.any(axis=0)) > _MOSTLY * integers.shape[1]:
        return plain
    sparse = sparse_block(attribute, integers, exponent, deflate)
    return sparse if len(sparse) < len(plain) else plain


def order_0_entropy(counts: NDArray[np.integer]) -> float:
    """Return the entropy, bits per symbol, of symbols with these counts, all positive."""
    shares = counts / max(1, int(counts.sum()))
    return -float((shares * log2(shares)).sum())


def codebook_block(
    attribute: int,
    codebook_id: int,
    index: Integers | None,
    escape_count: int,
    escape: bytes,
    deflate: DeflateSettings,
    summand: Integers | None = None,
) -> bytes:
    """Return a CODEBOOK block.

    Args:
        attribute: attribute id.
        codebook_id: id of the codebook.
        index: [n], entries; `None`: as in the codebook's first block.
        escape_count: number of escaped splats.
        escape: block of the escaped splats; empty if there are none.
        deflate: level and library of DEFLATE.
        summand: [n], added to all three scales, for the kind SHAPE.
    """
    params = _spec.pack_codebook_params(_spec.CodebookParams(codebook_id, 0, escape_count))
    streams = b"" if index is None else unsigned_stream(index, deflate)
    if summand is not None:
        streams += _code_offsets(summand[None], 0, deflate)
    return _block_head(attribute, _spec.CODING_CODEBOOK) + params + streams + escape


def raw_block(values: NDArray[Any], deflate: DeflateSettings) -> bytes:
    """Return a RAW block of the values [n] or [n, components] of an extra column; integers may become differences."""
    bits = np.ascontiguousarray(values.T, values.dtype.newbyteorder("<")).view(f"<u{values.itemsize}").ravel()
    write = unsigned_stream if values.dtype.kind == "f" else smooth_stream
    stream = write(bits, deflate, fixed_width=values.itemsize)
    return _block_head(_spec.ATTRIBUTE_EXTRA, _spec.CODING_RAW) + stream


def morton_codes(q: NDArray[Any]) -> NDArray[np.int64]:
    """Interleave the bits of [3, n] integers, 0 to 2**21 - 1: bit 3·b + a of a code is bit b of axis a (spec 6.4.2)."""
    codes = np.zeros(q.shape[1], np.int64)
    spread = np.empty(q.shape[1], np.int64)
    shifted = np.empty_like(spread)
    for axis in range(3):
        np.copyto(spread, q[axis], casting="unsafe")
        for shift, mask in _SPREAD:
            np.left_shift(spread, shift, out=shifted)
            np.bitwise_or(spread, shifted, out=spread)
            np.bitwise_and(spread, mask, out=spread)
        np.left_shift(spread, axis, out=spread)
        np.bitwise_or(codes, spread, out=codes)
    return codes


def _block_head(attribute: int, coding: int) -> bytes:
    """Return the head of a block, by the ids of its attribute and coding."""
    return _spec.pack_block_head(_spec.BlockHead(attribute, coding, 0))


def _code_offsets(integers: Integers, exponent: int, deflate: DeflateSettings) -> bytes:
    """Return parameters, offsets and stream of integers [C, n]: the offset of a column is its smallest integer."""
    offsets = integers.min(axis=1).astype("<i4")
    elements = integers - offsets.astype(integers.dtype)[:, None]
    stored: bytes = _spec.pack_lattice_params(_spec.LatticeParams(exponent, 0)) + offsets.tobytes()
    return stored + smooth_stream(elements.reshape(-1), deflate)


def _make_stream(values: Integers, width: int, transforms: tuple[int, ...], deflate: DeflateSettings) -> bytes:
    """Write a stream: apply BYTE_PLANES, and RUN_LENGTH if it pays, and choose the coder.

    Args:
        values: [n], n >= 1, elements after `transforms`.
        width: bytes per element.
        transforms: transforms that the caller has applied, in their order.
        deflate: level and library of DEFLATE.

    Returns:
        Head and coded bytes.
    """
    steps = [step for step in transforms if step != _spec.TRANSFORM_NONE]
    if width > 1:
        steps.append(_spec.TRANSFORM_BYTE_PLANES)
    planes = _byte_planes(values, width)
    run_length = _run_length(planes, _LONG_RUN if deflate.level <= _FASTEST_LEVEL else _SHORT_RUN)
    packed = planes
    if run_length is not None and _run_length_pays(run_length, planes, deflate):
        packed = run_length
        steps.append(_spec.TRANSFORM_RUN_LENGTH)
    coder, coded = _code(packed, deflate)
    head = _spec.StreamHead(
        width=width,
        coder=coder,
        transforms=bytes(steps).ljust(_spec.TRANSFORMS_MAX, b"\0"),
        reserved_0=0,
        count=len(values),
        packed_size=len(packed),
        coded_size=len(coded),
    )
    return _spec.pack_stream_head(head) + coded


def _width(largest: int) -> int:
    """Return the bytes, at least 1, of an unsigned integer."""
    return max(1, (largest.bit_length() + 7) // 8)


def _zigzag(values: Integers) -> Integers:
    """Fold two's complement into unsigned: 0, -1, 1, -2 become 0, 1, 2, 3."""
    bits = 8 * values.itemsize
    if values.dtype == np.int8:  # 2v leaves int8 only where the result, read as unsigned, is right
        return ((values << 1) ^ (values >> 7)).view(np.uint8)
    return ((values << 1) ^ (values >> (bits - 1))).view(f"u{values.itemsize}")


def _byte_entropy(symbols: NDArray[np.uint8]) -> float:
    """Return the order-0 entropy of bytes [n], bits per byte."""
    counts = np.bincount(symbols)
    return order_0_entropy(counts[counts > 0])


def _byte_planes(values: Integers, width: int) -> NDArray[np.uint8]:
    """Return the [width * n] bytes of [n] integers, lowest bytes first."""
    if width == 1:
        return np.ascontiguousarray(values.astype(np.uint8, copy=False))
    little = np.ascontiguousarray(values).astype(f"<u{values.itemsize}", copy=False)
    columns = little.view(np.uint8).reshape(len(values), values.itemsize)
    return np.ascontiguousarray(columns[:, :width].T).reshape(-1)


def _run_length(data: NDArray[np.uint8], least: float) -> NDArray[np.uint8] | None:
    """Return data transformed by RUN_LENGTH: values of the runs, low bytes of their lengths - 1, and high bytes.

    `None` for fewer than `_RUN_BYTES_MIN` bytes, or if the mean length of the runs is below `least`, bytes.

    DEFLATE codes long runs poorly, as a match has at most 258 bytes. For short runs it needs a distance each, and a
    Huffman code that literals and lengths share; RUN_LENGTH separates values and lengths.
    """
    if len(data) < _RUN_BYTES_MIN:
        return None
    changes = np.flatnonzero(data[1:] != data[:-1])
    if least * (len(changes) + 1) > len(data):
        return None
    starts = np.concatenate([[0], changes + 1])
    lengths = np.diff(np.append(starts, len(data)))
    pieces = (lengths + _spec.RUN_MAX - 1) // _spec.RUN_MAX
    values = np.repeat(data[starts], pieces)
    sizes = np.full(len(values), _spec.RUN_MAX, np.int64)
    sizes[np.cumsum(pieces) - 1] = lengths - (pieces - 1) * _spec.RUN_MAX
    sizes -= 1
    return np.concatenate([values, sizes.astype(np.uint8), (sizes >> 8).astype(np.uint8)])


def _run_length_pays(run_length: NDArray[np.uint8], planes: NDArray[np.uint8], deflate: DeflateSettings) -> bool:
    """Return True if a quick trial compresses the bytes with RUN_LENGTH to at most `_GAIN` of those without."""
    trial = trial_settings(deflate)
    return len(_code(run_length, trial)[1]) <= _GAIN * len(_code(planes, trial)[1])


def _code(packed: NDArray[np.uint8], deflate: DeflateSettings) -> tuple[int, bytes]:
    """Return the id of the coder with the smallest result, and the result; of equal sizes, STORED."""
    raw = packed.tobytes()
    best, coded = _spec.CODER_STORED, raw
    if len(raw) >= _DEFLATE_BYTES_MIN:
        deflated = _deflate(raw, deflate)
        if len(deflated) < len(coded):
            best, coded = _spec.CODER_DEFLATE, deflated
    return best, coded


def _deflate(raw: bytes, deflate: DeflateSettings) -> bytes:
    """Compress with the library and the level of the settings; zlib has no levels above 9."""
    if deflate.library == "zlib":
        return _zlib(raw, min(deflate.level, 9), zlib.Z_DEFAULT_STRATEGY)
    if deflate.level <= _FASTEST_LEVEL:
        return _deflate_fast(raw)
    # If only runs repeat, the accidental matches that libdeflate finds cost more than they save.
    return min(_libdeflate(raw, deflate.level), *(compress(raw) for compress in _WITHOUT_MATCHES), key=len)


def _deflate_fast(raw: bytes) -> bytes:
    """Compress with the method that is best on samples: fast matches, runs of one byte, or only Huffman codes."""
    methods: tuple[Callable[[bytes], bytes], ...] = (lambda data: _libdeflate(data, 1), *_WITHOUT_MATCHES)
    step = max(_SAMPLE, len(raw) // 4)
    sample = b"".join(raw[start : start + _SAMPLE] for start in range(0, len(raw), step))
    return min(methods, key=lambda compress: len(compress(sample)))(raw)


def _libdeflate(raw: bytes, level: int) -> bytes:
    """Compress by libdeflate, level 1 to 12; the package must be installed."""
    import deflate  # optional: some platforms have no wheel

    return bytes(deflate.deflate_compress(raw, level))


def _zlib(raw: bytes, level: int, strategy: int) -> bytes:
    """Compress by zlib to DEFLATE without a header (-15: window of 2**15 bytes), with the most memory (9)."""
    coder = zlib.compressobj(level, zlib.DEFLATED, -15, 9, strategy)
    return coder.compress(raw) + coder.flush()


#: DEFLATE with matches only for runs of one byte, and without matches.
_WITHOUT_MATCHES: tuple[Callable[[bytes], bytes], ...] = (
    lambda data: _zlib(data, 1, zlib.Z_RLE),
    lambda data: _zlib(data, 1, zlib.Z_HUFFMAN_ONLY),
)

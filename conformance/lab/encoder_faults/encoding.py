# SPDX-License-Identifier: CC0-1.0
"""Faults in converting values to integers, in bytes of the file, and in what the file declares; output by chance.

Errors are measured after the conversion, so the files declare them honestly.
"""

from __future__ import annotations

import contextlib
import os
import struct
import time
import zlib
from dataclasses import replace
from unittest import mock

import numpy as np

from csplat import _spec, ply
from csplat.context import DEFAULT_CONTEXT
from csplat.encoder import (
    container,
    encode_plan,
    entropy,
    error_bounds,
    pipeline,
    quantisation,
    sh_codebook,
    shape_codebook,
    tiling,
)
from csplat_selftest.fuzzing.damage import built_from
from encoder_faults.fault import DEGREE_3, DENSE, PLAIN, EncoderFault, Harm, changed, in_binary64, replaced

PICTURE = (Harm.PICTURE, ("L4", ""))
COARSE = (Harm.COARSE, ("L3", ""))


# Rotations and scales -------------------------------------------------------------------------------
def no_gauge(_fix):
    """Keep the axis order and make w positive; components beyond ±M are clipped later."""

    return lambda quats, scales: ((quats * np.where(quats[:, :1] < 0, np.float32(-1), np.float32(1))).T, scales.T)


def sign_of_w_lost(fix):
    """Store x, y, z of quaternions with negative w unchanged, although decoders return a positive w."""

    def run(quats, scales):
        rotation, ordered = fix(quats, scales)
        rotation[1:, quats[:, 0] < 0] *= -1
        return rotation, ordered

    return run


def sorted_alone(fix):
    """Sort the scales without exchanging the axes of the rotation."""

    return lambda quats, scales: (fix(quats, np.zeros_like(scales))[0], -np.sort(-scales, axis=1).T)


# Rounding -------------------------------------------------------------------------------------------
class OtherRounding:
    """NumPy with another `rint`."""

    def __init__(self, rint):
        self.rint = rint

    def __getattr__(self, name):
        return getattr(np, name)


def rounding(module, name, rint, where=(quantisation, shape_codebook)):
    """Return a stage that replaces `rint` of some modules while a function runs."""

    def make(function):
        def run(*args, **options):
            with contextlib.ExitStack() as stack:
                for one in where:
                    stack.enter_context(mock.patch.object(one, "np", OtherRounding(rint)))
                return function(*args, **options)

        return run

    return replaced(module, name, make)


def truncated(module, name, where=(quantisation, shape_codebook)):
    stage = rounding(module, name, np.trunc, where)
    return EncoderFault("a cast rounds", *COARSE, DEGREE_3, stage=stage, options={"sh_coding": "scalar"})


# Colours --------------------------------------------------------------------------------------------
def chroma_exchanged(integers):
    return lambda *args: integers(*args)[[0, 2, 1]]


def wrapped(bits):
    """Return a function that keeps the lowest `bits` bits of a signed integer, like a cast."""
    return lambda n: ((n + 2 ** (bits - 1)) % 2**bits) - 2 ** (bits - 1)


def wrapped_means(quantise_means):
    return lambda means, step: wrapped(16)(quantise_means(means, step))


def wrapped_opacities(levels):
    return lambda *args, **options: levels(*args, **options) & 255


BROKEN = Harm.VALIDITY
CHANCE = (Harm.DETERMINISM, ("L1", ""))


# Stages of the encoder ------------------------------------------------------------------------------
def swapped_blocks(tile_payload):
    def run(layer, parts):
        order = [0, 2, 1, *range(3, len(parts))] if layer == 0 else range(len(parts))
        return tile_payload(layer, [parts[place] for place in order])

    return run


def with_a_tail(deflate):
    return lambda raw, coding: deflate(raw, coding) + b"\0\0"


def reversed_transforms(pack):
    def run(head):
        steps = head.transforms.rstrip(b"\0")
        return pack(head._replace(transforms=steps[::-1].ljust(_spec.TRANSFORMS_MAX, b"\0")))

    return run


def payload_crc(_chunk_crc):
    return lambda _kind, payload: zlib.crc32(payload)


# Chance ---------------------------------------------------------------------------------------------
def seeded_by_chance(cluster):
    def run(*args, context=DEFAULT_CONTEXT, **options):
        return cluster(*args, context=replace(context, seed=int.from_bytes(os.urandom(4), "little")), **options)

    return run


def with_time(settings):
    return lambda *args: {**settings(*args), "encoded_ns": time.time_ns()}


# Bytes of the file: checksums are repaired unless they are the fault ---------------------------------
def serr_at(data):
    """Return the offset of the payload of the declared errors."""
    fields = built_from(data).fields.items()
    types = [entry.offset for name, entry in fields if name.startswith("directory[") and name.endswith("type")]
    (record,) = (offset for offset in types if data[offset:].startswith(_spec.CHUNK_DECLARED_ERRORS))
    return _spec.unpack_directory_record(data, record).offset + _spec.CHUNK_HEADER_SIZE


def declared(change):
    """Return a change of a file: `change` maps each record of the declared errors to a new one."""

    def run(data):
        built, at, out = built_from(data), serr_at(data), bytearray(data)
        count = _spec.unpack_declared_errors_head(data, at).record_count
        for i in range(count):
            place = at + _spec.DECLARED_ERRORS_HEAD_SIZE + i * _spec.DECLARED_ERROR_RECORD_SIZE
            record = change(_spec.unpack_declared_error_record(data, place))
            out[place : place + _spec.DECLARED_ERROR_RECORD_SIZE] = _spec.pack_declared_error_record(record)
        return replace(built, data=bytes(out)).patched({})

    return run


def head(**fields):
    """Return a change of a file: each function maps a field of the head of the declared errors to a new value."""

    def run(data):
        built, at = built_from(data), serr_at(data)
        old = _spec.unpack_declared_errors_head(data, at)
        new = old._replace(**{name: make(getattr(old, name)) for name, make in fields.items()})
        changed_data = data[:at] + _spec.pack_declared_errors_head(new) + data[at + _spec.DECLARED_ERRORS_HEAD_SIZE :]
        return replace(built, data=changed_data).patched({})

    return run


def counts(source, pruned):
    return head(source_count=lambda old: old + source, pruned_count=lambda old: old + pruned)


refitted = head(error_flags=lambda _: _spec.ERROR_FLAG_REFITTED)


def bounded(bounds):
    """Return a change of a file: it declares the given (max, rms) by measure."""

    def run(record):
        most, rms = bounds[_spec.MEASURE_NAMES[record.measure]]
        return record._replace(max=most, rms=rms)

    return declared(run)


def index_field(name, change):
    """Return a change of one field of the index, with repaired checksums."""

    def run(data):
        built = built_from(data)
        entry = built.fields[name]
        values = struct.unpack_from(entry.format, data, entry.offset)
        value = change(values if len(values) > 1 else values[0])
        return built.patched({name: value})

    return run


def swapped_layers(data):
    """Swap the records of the first two layers of the first tile, if it has two."""
    built = built_from(data)
    if "tile[0].layer[1].layer" not in built.fields:
        return data
    first, second = (built.fields[f"tile[0].layer[{i}].layer"].offset for i in (0, 1))
    size = _spec.LAYER_RECORD_SIZE
    out = bytearray(data)
    out[first : first + size], out[second : second + size] = data[second : second + size], data[first : first + size]
    return replace(built, data=bytes(out)).patched({})


def crc_from_the_start(data):
    """Compute the CRC of the index over header and index."""
    at = _spec.HEADER_SIZE + _spec.unpack_header(data).index_size - 4
    return data[:at] + zlib.crc32(data[:at]).to_bytes(4, "little") + data[at + 4 :]


def relative_offsets(data):
    """Count offsets from the end of the index."""
    built = built_from(data)
    end = _spec.HEADER_SIZE + _spec.unpack_header(data).index_size
    names = [name for name in built.fields if name.startswith(("directory[", "tile[")) and name.endswith(".offset")]
    offsets = {name: int.from_bytes(data[built.fields[name].offset :][:8], "little") - end for name in names}
    return built.patched(offsets)


MEASURES = ("means", "covariance", "opacities", "sh0", "sh1", "sh2", "sh3")
#: Other faults understate the other numbers.
UNDERSTATED = (("means", "rms"), ("opacities", "max"), ("sh2", "max"), ("sh3", "rms"))
COMPONENTS = {"sh0": 3, "sh1": 9, "sh2": 15, "sh3": 21}
L3 = ("L3", "SER-5")


def redeclared(change):
    """Return a stage in which `change` maps the declared errors by measure to those to declare instead."""
    return replaced(pipeline, "declared_errors", lambda declare: lambda errors, origin: change(declare(errors, origin)))


def scaled(only, kind, factor):
    """Return a stage that multiplies the max or the rms of some measures by a factor."""

    by = np.array([factor, 1.0] if kind == "max" else [1.0, factor])
    return redeclared(
        lambda bounds: {name: tuple((pair * by).tolist()) if name in only else pair for name, pair in bounds.items()}
    )


def in_single(_errors):
    """Compute differences and sums in float32."""

    def run(source, decoded):
        difference = decoded.astype(np.float32) - source.astype(np.float32)
        squares = np.square(difference)
        return float(np.abs(difference).max(initial=0.0)), float(np.add.accumulate(squares.reshape(-1))[-1])

    return run


def by_axis(distance):
    def run(source, decoded):
        _, squares = distance(source, decoded)
        return float(np.abs(decoded.astype(np.float64) - source).max()), squares

    return run


def not_relative(_errors):
    """Divide by the largest variance instead of ‖Σj‖."""

    def run(source_quats, source_scales, quats, scales):
        wide = np.clip(source_scales, -88, 88).astype(np.float64)
        top = wide.max(axis=0)
        ours = error_bounds.covariance_entries(quats, np.exp(2.0 * (np.clip(scales, -88, 88) - top)))
        squared = np.square(ours - error_bounds.covariance_entries(source_quats, np.exp(2.0 * (wide - top))))
        squared[3:] *= 2.0
        return float(np.sqrt(squared.sum(axis=0).max())), float(squared.sum())

    return run


def over_components(bounds):
    return {name: (most, rms / COMPONENTS.get(name, 1) ** 0.5) for name, (most, rms) in bounds.items()}


@contextlib.contextmanager
def dropped_rows_counted():
    """Count rows that the reader drops as pruned splats."""
    findings, read, pack = [], ply.read_ply, _spec.pack_declared_errors_head

    def with_dropped(head):
        count = sum(one.count for one in findings if one.id == "nonfinite-rows")
        return pack(head._replace(source_count=head.source_count + count, pruned_count=head.pruned_count + count))

    with (
        mock.patch.object(ply, "read_ply", lambda path, **options: read(path, report=findings, **options)),
        mock.patch.object(_spec, "pack_declared_errors_head", with_dropped),
    ):
        yield


def without_chunk(chunks):
    return lambda *args: [one for one in chunks(*args) if one.type != _spec.CHUNK_DECLARED_ERRORS]


def without_band_sign(model):
    changed_sign = model.shN.copy()
    changed_sign[:, :3] *= -1.0
    return changed_sign


def none_of(*names):
    return redeclared(lambda bounds: {name: pair for name, pair in bounds.items() if name not in names})


@contextlib.contextmanager
def scales_without_bound():
    with mock.patch.object(error_bounds, "SCALE_MOST", 340.0), mock.patch.object(encode_plan, "SCALE_MOST", 340.0):
        yield


def one_number_less(measure_name, kind):
    words = {"max": "the maximum of a sample is the maximum", "rms": "the mean of a sample is the mean"}
    return EncoderFault(words[kind], Harm.BOUND, L3, DEGREE_3, stage=scaled((measure_name,), kind, 0.99))


FAULTS = {
    # rotations and scales
    "gauge_not_fixed": EncoderFault("w need not be the largest, and components beyond ±M can be clipped", *PICTURE,
        DENSE, stage=replaced(shape_codebook, "canonicalise_shape", no_gauge)),
    "w_sign_lost": EncoderFault("w follows from the unit length, including its sign", *PICTURE, DENSE,
        stage=replaced(shape_codebook, "canonicalise_shape", sign_of_w_lost)),
    "scales_sorted_alone": EncoderFault("scales can be sorted independently of rotations", *PICTURE,
        "ordinary/needles_and_discs", stage=replaced(shape_codebook, "canonicalise_shape", sorted_alone)),
    # rounding
    "means_truncated": truncated(tiling, "quantise_means"),
    "quats_truncated": truncated(shape_codebook, "quat_levels"),
    "all_truncated": truncated(pipeline, "encode_tile"),
    # colours
    "chroma_exchanged": EncoderFault("Cg comes before Co", *PICTURE, DEGREE_3,
        stage=replaced(quantisation, "colour_integers", chroma_exchanged), options={"sh_coding": "scalar"}),
    # range
    "means_wrapped": EncoderFault("16 bits are enough for every centre", Harm.PICTURE, ("L2", "CNF-6"),
        "nasty/outlier", stage=replaced(tiling, "quantise_means", wrapped_means)),
    "opacities_wrapped": EncoderFault("256 levels fit into a byte, including level 256", *PICTURE,
        "ordinary/transparent_and_opaque", stage=replaced(pipeline, "opacity_levels", wrapped_opacities),
        options={"opacity_levels": 256}),
    # stages of the encoder
    "no_tile_limit": EncoderFault(
        "a tile may have any number of splats",
        BROKEN,
        ("L1", "TIL-1"),
        "ordinary/two_tiles",
        stage=replaced(tiling, "cut_tiles", lambda cut: lambda means, lattice, _: cut(means, lattice, len(means))),
        options={"means_coding": "axis"},
    ),
    "morton_signed_shift": EncoderFault(
        "bits of codes are counted from 1",
        BROKEN,
        ("L1", "MOR-2"),
        stage=replaced(
            entropy, "morton_block", lambda block: lambda codes, bits, coding: block(codes * 2, bits, coding)
        ),
    ),
    "blocks_swapped": EncoderFault(
        "rotations come before scales",
        BROKEN,
        ("L1", "TLE-2"),
        stage=replaced(pipeline, "tile_payload", swapped_blocks),
    ),
    "deflate_tail": EncoderFault(
        "trailing bytes after a DEFLATE stream are ignored",
        BROKEN,
        ("L1", "COD-2"),
        DEGREE_3,
        stage=replaced(entropy, "_deflate", with_a_tail),
    ),
    "transforms_reversed": EncoderFault(
        "transforms are listed in decoding order",
        BROKEN,
        ("L1", "STR-3"),
        stage=replaced(_spec, "pack_stream_head", reversed_transforms),
    ),
    "crc_of_payload": EncoderFault(
        "a chunk's CRC is that of its payload",
        BROKEN,
        ("L1", "CHK-1"),
        stage=replaced(container, "chunk_crc", payload_crc),
    ),
    # chance
    "seed_by_chance": EncoderFault(
        "k-means may start from any seed",
        *CHANCE,
        DEGREE_3,
        stage=replaced(sh_codebook, "cluster", seeded_by_chance),
        options={"sh_coding": "codebook", "codebook_size": 160},
    ),
    "time_in_options": EncoderFault(
        "a file records its time of creation", *CHANCE, PLAIN, stage=replaced(pipeline, "encoding_settings", with_time)
    ),
    # bytes of the file
    "index_crc_of_header": EncoderFault(
        "the CRC of the index covers the header", BROKEN, ("L1", "IDX-1"), data=crc_from_the_start
    ),
    "layers_swapped": EncoderFault("layers may have any order", BROKEN, ("L1", "TIL-2"), data=swapped_layers),
    "offsets_from_index": EncoderFault(
        "offsets are relative to the end of the index", BROKEN, ("L1", "COV-1"), data=relative_offsets
    ),
    "box_one_too_large": EncoderFault(
        "an extent is a number of cells",
        BROKEN,
        ("L1", "TIL-10"),
        data=index_field("tile[0].extent", lambda extent: tuple(value + 1 for value in extent)),
    ),
    "max_scale_linear": EncoderFault(
        "max_scale is a standard deviation",
        BROKEN,
        ("L1", "TIL-11"),
        data=index_field("tile[0].max_scale", lambda scale: float(np.float32(np.exp(scale)))),
    ),
    "reserved_used": EncoderFault(
        "reserved fields may be used freely",
        BROKEN,
        ("L1", "RES-1"),
        data=index_field("tile[0].reserved_0", lambda _: 7),
    ),
    "line_feed_at_end": EncoderFault(
        "files end in a line feed", BROKEN, ("L1", "HDR-6"), data=lambda data: data + b"\n"
    ),
    # slightly too small or too large
    **{f"{name}_{kind}_understated": one_number_less(name, kind) for name, kind in UNDERSTATED},
    "max_overstated": EncoderFault("one percent more is on the safe side", Harm.BOUND, L3, DEGREE_3,
        stage=scaled(MEASURES, "max", 1.01)),
    "rms_overstated": EncoderFault("one percent more is on the safe side", Harm.BOUND, L3, DEGREE_3,
        stage=scaled(MEASURES, "rms", 1.01)),
    "rounded_up": EncoderFault("SER-5 permits an excess of one part in ten thousand", Harm.HARMLESS, inputs=DEGREE_3,
        stage=redeclared(lambda bounds: {name: (most * 1.00009, rms * 1.00009)
                                         for name, (most, rms) in bounds.items()})),
    "binary64_errors_fine": EncoderFault(
        "errors may be computed from alpha and rotations that are not rounded, even with the finest levels",
        Harm.HARMLESS, inputs=f"{DEGREE_3},ordinary/quaternions,ordinary/transparent_and_opaque", honest=in_binary64,
        options={"opacity_levels": _spec.OPACITY_LEVELS_MAX, "quat_levels": _spec.QUAT_LEVELS_MAX, "scale_step": 1e-5}),
    # other ways to measure
    "measured_in_single": EncoderFault("float32 is accurate enough to measure errors", Harm.BOUND, L3,
        f"{DEGREE_3},ordinary/plane", stage=replaced(pipeline, "value_errors", in_single)),
    "means_by_axis": EncoderFault("max is over components, of means too", Harm.BOUND, L3,
        stage=replaced(pipeline, "distance_errors", by_axis)),
    "covariance_not_relative": EncoderFault("the error of a covariance is that of its entries", Harm.BOUND, L3,
        stage=replaced(pipeline, "covariance_errors", not_relative)),
    "covariance_not_clipped": EncoderFault("scales need no bound", Harm.BOUND, L3, "nasty/*scale*",
        stage=scales_without_bound),
    "rms_over_components": EncoderFault("a mean is over all numbers", Harm.BOUND, L3,
        stage=redeclared(over_components)),
    # statements about the source
    "pruned_invented": EncoderFault("counts do not matter", Harm.FACTS, ("L2", "SRC-1"), data=counts(3, 3)),
    "nan_rows_counted": EncoderFault("rows with NaN are pruned splats", Harm.FACTS, ("L2", "SRC-1"),
        "nasty/not_a_number", stage=dropped_rows_counted),
    "degree_of_the_file": EncoderFault("the source's SH degree is the file's", Harm.FACTS, ("L2", "SER-5"), DEGREE_3,
        options={"sh_degree": 1}, stage=none_of("sh2", "sh3"), data=head(source_sh_degree=lambda _: 1)),
    # omitted statements
    "refitted_halved": EncoderFault("any error may be declared for refitted attributes", Harm.BOUND, ("L3", "SER-5"),
        data=lambda data: refitted(declared(lambda r: r._replace(max=r.max / 2, rms=r.rms / 2))(data))),
    "refitted_claimed": EncoderFault("with REFITTED, colours may have any values", Harm.PICTURE, ("L4", ""),
        scene=changed(sh0=lambda m: m.sh0[:, ::-1].copy()), stage=none_of("sh0", "sh1"), data=refitted),
    "errors_left_out": EncoderFault("without declared errors, values may be arbitrary", Harm.PICTURE, ("L4", ""),
        DEGREE_3, scene=changed(shN=without_band_sign), stage=replaced(pipeline, "file_chunks", without_chunk)),
    "some_errors_left_out": EncoderFault("some of the errors may be omitted", Harm.PICTURE, ("L3", "SER-6"), DEGREE_3,
        scene=changed(shN=without_band_sign), stage=none_of("sh1", "sh2", "sh3")),
}  # fmt: skip

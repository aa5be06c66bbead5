"""Faults in blocks, streams, chunks and bytes of the file, and output that depends on chance."""

from __future__ import annotations

import dataclasses
import os
import struct
import time
import zlib

import numpy as np

from csplat import _spec
from csplat.encoder import container, entropy, pipeline, sh_codebook, tiling
from csplat_selftest.fuzzing.damage import built_from
from encoder_faults.fault import DEGREE_3, PLAIN, EncoderFault, Harm, replaced

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
    return lambda *args, **options: cluster(*args, **{**options, "seed": int.from_bytes(os.urandom(4), "little")})


def with_time(settings):
    return lambda *args: {**settings(*args), "encoded_ns": time.time_ns()}


# Bytes of the file: checksums are repaired unless they are the fault ---------------------------------
def serr_at(data):
    """Return the offset of the payload of the stated errors."""
    index = [
        entry
        for name, entry in built_from(data).fields.items()
        if name.startswith("directory[") and name.endswith("type")
    ]
    (record,) = (entry.offset for entry in index if data[entry.offset :].startswith(_spec.CHUNK_STATED_ERRORS))
    return _spec.unpack_directory_record(data, record).offset + _spec.CHUNK_HEADER_SIZE


def stated(change):
    """Return a change of a file: `change` maps each record of the stated errors to a new one."""

    def run(data):
        built, at, out = built_from(data), serr_at(data), bytearray(data)
        count = _spec.unpack_stated_errors_head(data, at).record_count
        for i in range(count):
            place = at + _spec.STATED_ERRORS_HEAD_SIZE + i * _spec.STATED_ERROR_RECORD_SIZE
            record = change(_spec.unpack_stated_error_record(data, place))
            out[place : place + _spec.STATED_ERROR_RECORD_SIZE] = _spec.pack_stated_error_record(record)
        return dataclasses.replace(built, data=bytes(out)).patched({})

    return run


def head(**fields):
    """Return a change of a file: each function maps a field of the head of the stated errors to a new value."""

    def run(data):
        built, at = built_from(data), serr_at(data)
        old = _spec.unpack_stated_errors_head(data, at)
        new = old._replace(**{name: make(getattr(old, name)) for name, make in fields.items()})
        packed = _spec.pack_stated_errors_head(new)
        return dataclasses.replace(built, data=data[:at] + packed + data[at + _spec.STATED_ERRORS_HEAD_SIZE :]).patched(
            {}
        )

    return run


def counts(source, pruned):
    return head(source_count=lambda old: old + source, pruned_count=lambda old: old + pruned)


refitted = head(error_flags=lambda _: _spec.ERROR_FLAG_REFITTED)


def bounded(bounds):
    """Return a change of a file: it states the given (max, rms) by measure."""

    def run(record):
        most, rms = bounds[_spec.MEASURE_NAMES[record.measure]]
        return record._replace(max=most, rms=rms)

    return stated(run)


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
    return dataclasses.replace(built, data=bytes(out)).patched({})


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


FAULTS = {
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
}

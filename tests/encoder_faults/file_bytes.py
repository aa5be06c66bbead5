"""Faults in the bytes of the file. Checksums are repaired unless they are the fault."""

from __future__ import annotations

import dataclasses
import struct
import zlib

import numpy as np

from csplat import _spec
from csplat_selftest.fuzzing.damage import built_from
from encoder_faults.fault import EncoderFault, Harm


def serr_at(data):
    """Return where the payload of the stated errors begins."""
    index = [
        entry
        for name, entry in built_from(data).fields.items()
        if name.startswith("directory[") and name.endswith("type")
    ]
    (record,) = (entry.offset for entry in index if data[entry.offset :].startswith(_spec.CHUNK_STATED_ERRORS))
    return _spec.unpack_directory_record(data, record).offset + _spec.CHUNK_HEADER_SIZE


def stated(change):
    """Return a change of every record of the stated errors."""

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
    """Return a change of the head of the stated errors; each field is made of the one that stands there."""

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
    """Return a change of the file: it states these, by measure."""

    def run(record):
        most, rms = bounds[_spec.MEASURE_NAMES[record.measure]]
        return record._replace(max=most, rms=rms)

    return stated(run)


def index_field(name, change):
    """Return a change of one field of the index; checksums are repaired."""

    def run(data):
        built = built_from(data)
        entry = built.fields[name]
        values = struct.unpack_from(entry.format, data, entry.offset)
        value = change(values if len(values) > 1 else values[0])
        return built.patched({name: value})

    return run


def swapped_layers(data):
    """Exchange the records of the first two layers of the first tile, if it has two."""
    built = built_from(data)
    if "tile[0].layer[1].layer" not in built.fields:
        return data
    first, second = (built.fields[f"tile[0].layer[{i}].layer"].offset for i in (0, 1))
    size = _spec.LAYER_RECORD_SIZE
    out = bytearray(data)
    out[first : first + size], out[second : second + size] = data[second : second + size], data[first : first + size]
    return dataclasses.replace(built, data=bytes(out)).patched({})


def crc_from_the_start(data):
    """Let the CRC of the index cover the header too."""
    at = _spec.HEADER_SIZE + _spec.unpack_header(data).index_size - 4
    return data[:at] + zlib.crc32(data[:at]).to_bytes(4, "little") + data[at + 4 :]


def relative_offsets(data):
    """Count offsets from the end of the index."""
    built = built_from(data)
    end = _spec.HEADER_SIZE + _spec.unpack_header(data).index_size
    names = [name for name in built.fields if name.startswith(("directory[", "tile[")) and name.endswith(".offset")]
    offsets = {name: int.from_bytes(data[built.fields[name].offset :][:8], "little") - end for name in names}
    return built.patched(offsets)


BROKEN = Harm.VALIDITY
FAULTS = {
    "index_crc_of_header": EncoderFault(
        "the CRC of the index begins with the header", BROKEN, ("L1", "IDX-1"), data=crc_from_the_start
    ),
    "layers_swapped": EncoderFault("layers come in any order", BROKEN, ("L1", "TIL-2"), data=swapped_layers),
    "offsets_from_index": EncoderFault(
        "offsets count from the end of the index", BROKEN, ("L1", "COV-1"), data=relative_offsets
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
        "reserved fields are free to use",
        BROKEN,
        ("L1", "RES-1"),
        data=index_field("tile[0].reserved_0", lambda _: 7),
    ),
    "line_feed_at_end": EncoderFault(
        "files end in a line feed", BROKEN, ("L1", "HDR-6"), data=lambda data: data + b"\n"
    ),
    "chroma_shift_off": EncoderFault(
        "the chroma shift counts from 1",
        Harm.PICTURE,
        ("L3", "SER-5"),
        data=index_field("attribute[4].chroma_shift", lambda shift: shift + 1),
    ),
}

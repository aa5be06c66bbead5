"""Mistakes in the bytes of the file. Checksums are made right again unless they are the mistake."""

import dataclasses
import struct
import zlib

import numpy as np

from csplat import _spec
from csplat_selftest.mutate import mapped
from wrong_encoders.mistake import Harm, Mistake


def index_field(name, change):
    """Return a change of one field of the index; checksums are repaired."""

    def run(data):
        built = mapped(data)
        entry = built.fields[name]
        values = struct.unpack_from(entry.format, data, entry.offset)
        value = change(values if len(values) > 1 else values[0])
        return built.patched({name: value})

    return run


def swapped_layers(data):
    """Exchange the records of the first two layers of the first tile, if it has two."""
    built = mapped(data)
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
    built = mapped(data)
    end = _spec.HEADER_SIZE + _spec.unpack_header(data).index_size
    names = [name for name in built.fields if name.startswith(("directory[", "tile[")) and name.endswith(".offset")]
    offsets = {name: int.from_bytes(data[built.fields[name].offset :][:8], "little") - end for name in names}
    return built.patched(offsets)


BROKEN = Harm.VALIDITY
MISTAKES = {
    "index_crc_of_header": Mistake(
        "the CRC of the index begins with the header", BROKEN, ("L1", "IDX-1"), data=crc_from_the_start
    ),
    "layers_swapped": Mistake("layers come in any order", BROKEN, ("L1", "TIL-2"), data=swapped_layers),
    "offsets_from_index": Mistake(
        "offsets count from the end of the index", BROKEN, ("L1", "COV-1"), data=relative_offsets
    ),
    "box_one_too_large": Mistake(
        "an extent is a number of cells",
        BROKEN,
        ("L1", "TIL-10"),
        data=index_field("tile[0].extent", lambda extent: tuple(value + 1 for value in extent)),
    ),
    "max_scale_linear": Mistake(
        "max_scale is a standard deviation",
        BROKEN,
        ("L1", "TIL-11"),
        data=index_field("tile[0].max_scale", lambda scale: float(np.float32(np.exp(scale)))),
    ),
    "reserved_used": Mistake(
        "reserved fields are free to use",
        BROKEN,
        ("L1", "RES-1"),
        data=index_field("tile[0].reserved_0", lambda _: 7),
    ),
    "line_feed_at_end": Mistake("files end in a line feed", BROKEN, ("L1", "HDR-6"), data=lambda data: data + b"\n"),
    "chroma_shift_off": Mistake(
        "the chroma shift counts from 1",
        Harm.PICTURE,
        ("L3", "SER-5"),
        data=index_field("attribute[4].chroma_shift", lambda shift: shift + 1),
    ),
}

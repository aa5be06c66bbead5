"""Encoders as others may write them: csplat's own with one mistake at a time, and the table of what finds it.

Usage:
    python tests/sloppy_encoder.py --table                    # every mistake, and which level and clause find it
    python tests/sloppy_encoder.py MISTAKE in.ply out.csplat  # one of them, as the conformance suite starts it

A mistake is made where a third party would make it: in the scene as it was read, in a stage of the encoder, in the
bytes that are written, or in how the program ends. Checksums are made right again unless they are the mistake.
"""

import contextlib
import dataclasses
import os
import shlex
import struct
import sys
import time
import zlib
from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np

import csplat
from csplat import _spec
from csplat.encoder import apart, blocks, coded, container, streams, tile
from csplat.model import normalise_quats
from csplat_conformance.encoders import LEVELS, EncoderChoice, run_encoder
from csplat_conformance.mutate import mapped
from csplat_conformance.process import Ended
from csplat_conformance.report import Report

DEGREE_3, PLAIN = "ordinary/degree_3", "ordinary/degree_1"


@dataclass(frozen=True)
class Mistake:
    """One mistake.

    Attributes:
        why: what the author believed.
        caught: level and clause that find it; the clause is empty where it is no clause that is broken.
        inputs: pattern of the reference inputs that show it.
        scene: changes what was read.
        stage: changes the encoder until it is left.
        options: of the encoder.
        data: changes the file.
        end: takes input and output, the encoder's bytes and how to encode, and ends the process as it pleases.
    """

    why: str
    caught: tuple[str, str]
    inputs: str = PLAIN
    scene: Callable[[csplat.SplatModel], csplat.SplatModel] | None = None
    stage: Callable[[], AbstractContextManager[object]] = contextlib.nullcontext
    options: Mapping[str, Any] = field(default_factory=dict)
    data: Callable[[bytes], bytes] | None = None
    end: Callable[[Path, Path, bytes], None] | None = None


# The scene as it was read --------------------------------------------------------------------------


def changed(**fields: Callable[[csplat.SplatModel], Any]) -> Callable[[csplat.SplatModel], csplat.SplatModel]:
    return lambda model: dataclasses.replace(model, **{name: make(model) for name, make in fields.items()})


def coefficient_major(model):
    """Read f_rest as if red, green and blue of a coefficient stood together."""
    flat = model.shN.transpose(0, 2, 1).reshape(len(model), -1)
    return np.ascontiguousarray(flat.reshape(model.shN.shape))


def not_normalised(model):
    """Take x, y, z of a quaternion of length 1.6 as they are, and w from what is left."""
    vector = 1.6 * model.quats[:, 1:].astype(np.float64)
    w = np.sqrt(np.maximum(0.0, 1.0 - np.square(vector).sum(axis=1, keepdims=True)))
    return normalise_quats(np.concatenate([w, vector], axis=1).astype(np.float32))


def logits(model):
    alpha = np.clip(model.opacities.astype(np.float64), 1e-9, 1.0 - 1e-9)
    return np.clip(np.log(alpha / (1.0 - alpha)), 0.0, 1.0).astype(np.float32)


def without_band_sign(model):
    changed_sign = model.shN.copy()
    changed_sign[:, :3] *= -1.0
    return changed_sign


def merged(model):
    """Drop exact duplicates and say nothing."""
    _, first = np.unique(model.means, axis=0, return_index=True)
    return model.select(np.sort(first))


# Stages of the encoder -----------------------------------------------------------------------------


def replaced(module, name, make):
    """Return a stage change: `make` is given the original function."""
    return lambda: mock.patch.object(module, name, make(getattr(module, name)))


def swapped_blocks(encode_tile):
    def run(*args):
        encoded = encode_tile(*args)
        layer = encoded.tile.layers[0]
        layer[1], layer[2] = layer[2], layer[1]
        return encoded

    return run


def with_zlib_header(_deflate):
    return lambda raw, _coding: zlib.compress(raw, 6)


def reversed_transforms(pack):
    def run(head):
        steps = head.transforms.rstrip(b"\0")
        return pack(head._replace(transforms=steps[::-1].ljust(_spec.TRANSFORMS_MAX, b"\0")))

    return run


def payload_crc(_crc):
    return lambda _head, payload: zlib.crc32(payload)


# Bytes of the file ---------------------------------------------------------------------------------


def index_field(name: str, change: Callable[[Any], Any]) -> Callable[[bytes], bytes]:
    """Return a change of one field of the index; checksums are repaired."""

    def run(data: bytes) -> bytes:
        built = mapped(data)
        entry = built.fields[name]
        values = struct.unpack_from(entry.format, data, entry.offset)
        value = change(values if len(values) > 1 else values[0])
        return built.patched({name: value})

    return run


def serr_at(data: bytes) -> int:
    """Return where the payload of the stated errors begins."""
    index = [
        entry for name, entry in mapped(data).fields.items() if name.startswith("directory[") and name.endswith("type")
    ]
    (record,) = (entry.offset for entry in index if data[entry.offset :].startswith(_spec.CHUNK_STATED_ERRORS))
    return _spec.unpack_directory_record(data, record).offset + _spec.CHUNK_HEADER_SIZE


def stated(change: Callable[[_spec.StatedErrorRecord], _spec.StatedErrorRecord]) -> Callable[[bytes], bytes]:
    """Return a change of every record of the stated errors."""

    def run(data: bytes) -> bytes:
        built, at, out = mapped(data), serr_at(data), bytearray(data)
        count = _spec.unpack_stated_errors_head(data, at).record_count
        for i in range(count):
            place = at + _spec.STATED_ERRORS_HEAD_SIZE + i * _spec.STATED_ERROR_RECORD_SIZE
            record = change(_spec.unpack_stated_error_record(data, place))
            out[place : place + _spec.STATED_ERROR_RECORD_SIZE] = _spec.pack_stated_error_record(record)
        return dataclasses.replace(built, data=bytes(out)).patched({})

    return run


def counts(source: int, pruned: int) -> Callable[[bytes], bytes]:
    """Return a change of the counts of the stated errors."""

    def run(data: bytes) -> bytes:
        built, at = mapped(data), serr_at(data)
        head = _spec.unpack_stated_errors_head(data, at)
        head = head._replace(source_count=head.source_count + source, pruned_count=head.pruned_count + pruned)
        new = data[:at] + _spec.pack_stated_errors_head(head) + data[at + _spec.STATED_ERRORS_HEAD_SIZE :]
        return dataclasses.replace(built, data=new).patched({})

    return run


def refitted(data: bytes) -> bytes:
    """Set the flag of the stated errors that takes the file out of their judgement."""
    at = serr_at(data)
    head = _spec.unpack_stated_errors_head(data, at)._replace(error_flags=_spec.ERROR_FLAG_REFITTED)
    new = data[:at] + _spec.pack_stated_errors_head(head) + data[at + _spec.STATED_ERRORS_HEAD_SIZE :]
    return dataclasses.replace(mapped(data), data=new).patched({})


def swapped_layers(data: bytes) -> bytes:
    """Exchange the records of the first two layers of the first tile."""
    built = mapped(data)
    first, second = (built.fields[f"tile[0].layer[{i}].layer"].offset for i in (0, 1))
    size = _spec.LAYER_RECORD_SIZE
    out = bytearray(data)
    out[first : first + size], out[second : second + size] = data[second : second + size], data[first : first + size]
    return dataclasses.replace(built, data=bytes(out)).patched({})


def crc_from_the_start(data: bytes) -> bytes:
    """Let the CRC of the index cover the header too."""
    at = _spec.HEADER_SIZE + _spec.unpack_header(data).index_size - 4
    return data[:at] + zlib.crc32(data[:at]).to_bytes(4, "little") + data[at + 4 :]


def relative_offsets(data: bytes) -> bytes:
    """Count offsets from the end of the index."""
    built = mapped(data)
    end = _spec.HEADER_SIZE + _spec.unpack_header(data).index_size
    names = [name for name in built.fields if name.startswith(("directory[", "tile[")) and name.endswith(".offset")]
    offsets = {name: int.from_bytes(data[built.fields[name].offset :][:8], "little") - end for name in names}
    return built.patched(offsets)


# Ends of the process -------------------------------------------------------------------------------


def leaves_half(_ply: Path, out: Path, data: bytes) -> None:
    out.write_bytes(data[: len(data) // 2])
    sys.stderr.write("error: the disk is full\n")
    sys.exit(1)


def half_and_proud(_ply: Path, out: Path, data: bytes) -> None:
    out.write_bytes(data[: len(data) // 2])


MISTAKES = {
    # what was read
    "channel_order": Mistake(
        "f_rest holds red, green, blue of one coefficient after the other",
        ("L3", "SER-5"),
        scene=changed(shN=coefficient_major),
    ),
    "quats_not_normalised": Mistake(
        "quaternions in a PLY are unit length", ("L3", "SER-5"), scene=changed(quats=not_normalised)
    ),
    "quats_xyzw": Mistake(
        "w is the last component", ("L3", "SER-5"), scene=changed(quats=lambda m: np.roll(m.quats, 1, axis=1))
    ),
    "last_splat_dropped": Mistake(
        "the header counts one splat too many", ("L2", "SRC-1"), scene=lambda model: model.select(slice(0, -1))
    ),
    "logit_as_alpha": Mistake("the column opacity holds alpha", ("L3", "SER-5"), scene=changed(opacities=logits)),
    "scale_not_log": Mistake(
        "scales are standard deviations", ("L3", "SER-5"), scene=changed(scales=lambda m: np.exp(m.scales))
    ),
    "band_sign": Mistake("band 1 has the other sign", ("L3", "SER-5"), scene=changed(shN=without_band_sign)),
    "rgb_for_sh0": Mistake(
        "f_dc is a colour",
        ("L3", "SER-5"),
        scene=changed(sh0=lambda m: np.float32(0.5) + np.float32(0.28209479) * m.sh0),
    ),
    "axes_guessed": Mistake(
        "every scene is right-down-forward", ("L2", "SRC-3"), scene=changed(coordinate_system=lambda _: "RDF")
    ),
    "y_and_z_swapped": Mistake(
        "z points up", ("L2", "CNF-6"), scene=changed(means=lambda m: np.ascontiguousarray(m.means[:, [0, 2, 1]]))
    ),
    "half_precision": Mistake(
        "float16 is enough, and errors are measured after it",
        ("L2", "CNF-6"),
        "nasty/far_coordinates",
        scene=changed(means=lambda m: np.clip(m.means, -65504, 65504).astype(np.float16).astype(np.float32)),
    ),
    "colours_clipped": Mistake(
        "colours lie within ±2",
        ("L3", "SER-5"),
        "ordinary/strong_colours",
        scene=changed(sh0=lambda m: np.clip(m.sh0, -2, 2)),
    ),
    "duplicates_merged": Mistake("equal splats are one", ("L2", "SRC-1"), "nasty/duplicates", scene=merged),
    # stages
    "morton_axes_reversed": Mistake(
        "bit 0 of a Morton code is that of z",
        ("L1", "TIL-10"),
        stage=replaced(tile, "morton_codes", lambda codes: lambda q: codes(q[::-1])),
    ),
    "morton_signed_shift": Mistake(
        "codes count bits from 1",
        ("L1", "MOR-2"),
        stage=replaced(
            blocks, "morton_block", lambda block: lambda codes, bits, coding: block(codes * 2, bits, coding)
        ),
    ),
    "blocks_swapped": Mistake(
        "rotations come before scales", ("L1", "TLE-2"), stage=replaced(coded, "encode_tile", swapped_blocks)
    ),
    "zlib_for_deflate": Mistake(
        "DEFLATE is what zlib.compress gives",
        ("L1", "COD-2"),
        DEGREE_3,
        stage=replaced(streams, "_deflate", with_zlib_header),
    ),
    "transforms_reversed": Mistake(
        "transforms are listed as a decoder needs them",
        ("L1", "STR-3"),
        stage=replaced(_spec, "pack_stream_head", reversed_transforms),
    ),
    "crc_of_payload": Mistake(
        "a chunk's CRC is that of its payload", ("L1", "CHK-1"), stage=replaced(container, "_crc", payload_crc)
    ),
    "no_tile_limit": Mistake(
        "a tile may have any number of splats",
        ("L1", "TIL-1"),
        "ordinary/two_tiles",
        stage=replaced(apart, "cut", lambda cut: lambda means, lattice, _: cut(means, lattice, len(means))),
        options={"means_coding": "axis"},
    ),
    # bytes
    "index_crc_of_header": Mistake(
        "the CRC of the index begins with the header", ("L1", "IDX-1"), data=crc_from_the_start
    ),
    "layers_swapped": Mistake("layers come in any order", ("L1", "TIL-2"), data=swapped_layers),
    "offsets_from_index": Mistake("offsets count from the end of the index", ("L1", "COV-1"), data=relative_offsets),
    "box_one_too_large": Mistake(
        "an extent is a number of cells",
        ("L1", "TIL-10"),
        data=index_field("tile[0].extent", lambda extent: tuple(value + 1 for value in extent)),
    ),
    "max_scale_linear": Mistake(
        "max_scale is a standard deviation",
        ("L1", "TIL-11"),
        data=index_field("tile[0].max_scale", lambda scale: float(np.float32(np.exp(scale)))),
    ),
    "reserved_used": Mistake(
        "reserved fields are free to use", ("L1", "RES-1"), data=index_field("tile[0].reserved_0", lambda _: 7)
    ),
    "chroma_shift_off": Mistake(
        "the chroma shift counts from 1",
        ("L3", "SER-5"),
        data=index_field("attribute[4].chroma_shift", lambda shift: shift + 1),
    ),
    "line_feed_at_end": Mistake("files end in a line feed", ("L1", "HDR-6"), data=lambda data: data + b"\n"),
    "max_halved": Mistake(
        "an error of rounding is half a step",
        ("L3", "SER-5"),
        data=stated(lambda r: r._replace(max=r.max / 2, rms=r.rms / 2)),
    ),
    "rms_too_generous": Mistake(
        "a bound may be generous", ("L3", "SER-5"), data=stated(lambda r: r._replace(max=r.max * 1.5))
    ),
    "pruned_invented": Mistake("counts are decoration", ("L2", "SRC-1"), data=counts(3, 3)),
    "coarse": Mistake(
        "honest errors may be of any size", ("L4", ""), options={"attribute_psnr": 16.0, "sh_coding": "none"}
    ),
    "refitted_claimed": Mistake(
        "whoever says that colours were fitted anew may write any",
        ("L4", ""),
        scene=changed(sh0=lambda m: m.sh0[:, ::-1].copy()),
        data=refitted,
    ),
    # ends
    "half_a_file": Mistake("a full disk says so", ("L1", "HDR-5"), end=half_and_proud),
    "leaves_half": Mistake("whoever fails may leave a file", ("L1", ""), end=leaves_half),
    "writes_nothing": Mistake("the output's name is not needed", ("L1", ""), end=lambda *_: None),
    "crashes": Mistake("memory is never short", ("L1", ""), end=lambda *_: os.abort()),
    "hangs": Mistake("a loop always ends", ("L1", ""), end=lambda *_: time.sleep(600)),
    "status_3": Mistake("3 is a status like any other", ("L1", ""), end=lambda *_: sys.exit(3)),
    "silent_refusal": Mistake("status 1 says enough", ("L1", ""), end=lambda *_: sys.exit(1)),
}


def encode(mistake: Mistake, ply: Path, out: Path) -> None:
    """What the sloppy program does."""
    model = csplat.read_ply(ply)
    if mistake.scene is not None:
        model = mistake.scene(model)
    with mistake.stage():
        data = csplat.encode(model, csplat.EncodeOptions(**mistake.options))
    if mistake.data is not None:
        data = mistake.data(data)
    if mistake.end is not None:
        mistake.end(ply, out, data)
    else:
        out.write_bytes(data)


def find(name: str) -> Report:
    """Run the conformance suite over a mistake; return its report. Only odd ends need a process that ends."""
    mistake = MISTAKES[name]
    command = f"{shlex.quote(sys.executable)} {shlex.quote(__file__)} {name} {{ply}} {{out}}"
    levels = LEVELS if mistake.caught[0] == LEVELS[-1] else LEVELS[:-1]
    choice = EncoderChoice(mistake.inputs, levels, 5.0 if name == "hangs" else 60.0, jobs=1)
    pictures = psnr if LEVELS[-1] in levels else None
    return run_encoder(command, choice, pictures=pictures, run=run_here if mistake.end is None else None)


def run_here(command: str, places: Mapping[str, str], _seconds: float) -> Ended:
    """Encode as `main` does with this command line, in this process."""
    encode(MISTAKES[shlex.split(command)[2]], Path(places["ply"]), Path(places["out"]))
    return Ended(None, 0, b"", b"", 0.0)


def psnr(source: csplat.SplatModel, decoded: csplat.SplatModel) -> float:
    from csplat_render.judge import Judge
    from csplat_tools.views import comparison_cameras

    return Judge.of_source(source, comparison_cameras(source)).psnr(decoded)


def main(arguments: list[str]) -> None:
    if arguments == ["--table"]:
        print(f"{'mistake':<22}  {'what the author believed':<66}  caught by")
        for name, mistake in MISTAKES.items():
            failures = find(name).failures
            first = failures[0] if failures else None
            by = f"{first.level} {first.status} {' '.join(first.clauses)}" if first else "NOT CAUGHT"
            print(f"{name:<22}  {mistake.why:<66}  {by}")
        return
    name, ply, out = arguments
    encode(MISTAKES[name], Path(ply), Path(out))


if __name__ == "__main__":
    main(sys.argv[1:])

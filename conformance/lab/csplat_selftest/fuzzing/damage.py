# SPDX-License-Identifier: CC0-1.0
"""Damage files according to their structure, for fuzzing, and repair the checksums afterwards.

A file is damaged in two steps. First, fields and bytes are overwritten in place. Then, in some cases, one chunk changes
its length or position, and the file is reassembled so that offsets and sizes are consistent.
"""

from __future__ import annotations

import random
import struct
from collections.abc import Callable, Sequence

from csplat import _spec
from csplat_authoring.builder import Built, repair
from csplat_authoring.coders import deflate_fixed, deflate_stored
from csplat_conformance.fields import Field, read_fields

_UNREPAIRED_SHARE = 0.1
_PACKED_MAX = 2000
_BOMB = deflate_fixed(bytes(100_000))
_FLOATS = (0.0, -0.0, 1.0, -1.0, 5e-324, 2.0**-1022, 1e-30, 1e30, 1.7e308, float("inf"), float("-inf"), float("nan"))


def damaged_file(rng: random.Random, bases: Sequence[Built]) -> tuple[bytes, bool]:
    """Return a damaged file and whether its checksums were repaired.

    Args:
        rng: source of all random choices.
        bases: valid files with the positions of their fields.
    """
    data, repaired, _ = damaged_from(rng, rng.choice(bases), bases)
    return data, repaired


def damaged_from(rng: random.Random, base: Built, bases: Sequence[Built]) -> tuple[bytes, bool, bool]:
    """Damage a file.

    Args:
        rng: source of all random choices.
        base: the file, with the positions of its fields.
        bases: other files, whose chunks may be inserted.

    Returns:
        The bytes, whether checksums were repaired, and whether the fields kept their positions.
    """
    data = bytearray(base.data)
    for _ in range(rng.choice((0, 1, 1, 1, 2, 3))):
        rng.choice(_IN_PLACE)(rng, base, data)
    result, in_place = bytes(data), True
    if rng.random() < 0.4:
        result, in_place = _laid_out(rng, base, data, bases), False
    if rng.random() < 0.03:
        result, in_place = result[: rng.randrange(len(result) + 1)], False
    if rng.random() < 0.01:
        result, in_place = result + rng.randbytes(rng.randrange(1, 9)), False
    if rng.random() < _UNREPAIRED_SHARE:
        return result, False, in_place
    return repair(result, base.records), True, in_place


def built_from(data: bytes) -> Built:
    """Return any valid file with the fields of header, index records and chunk headers."""
    return Built(data, *read_fields(data))


# In place ------------------------------------------------------------------------------------------


def _flip_bits(rng: random.Random, _: Built, data: bytearray) -> None:
    for _turn in range(rng.choice((1, 1, 2, 8))):
        at = rng.randrange(8 * len(data))
        data[at // 8] ^= 1 << at % 8


def _set_bytes(rng: random.Random, _: Built, data: bytearray) -> None:
    at = rng.randrange(len(data))
    for i in range(at, min(len(data), at + rng.choice((1, 1, 2, 4, 8)))):
        data[i] = rng.choice((0, 1, 0x7F, 0x80, 0xFE, 0xFF, rng.randrange(256)))


def _set_field(rng: random.Random, base: Built, data: bytearray) -> None:
    """Set one number of a structure to an extreme or to a neighbour of its value."""
    entry = rng.choice([entry for entry in base.fields.values() if not entry.format.endswith("s")])
    codes = struct.unpack_from(entry.format, data, entry.offset)
    k = rng.randrange(len(codes))
    code = entry.format.lstrip("<0123456789")[0]
    size = struct.calcsize("<" + code)
    at = entry.offset + k * size
    if code in "fd":
        data[at : at + size] = struct.pack("<" + code, _float(rng, code))
        return
    bits = 8 * size
    value = int.from_bytes(data[at : at + size], "little")
    edge = 1 << rng.randrange(bits)
    choices = (0, 1, edge, edge - 1, (1 << bits) - 1, (1 << bits - 1), (1 << bits - 1) - 1)
    value = rng.choice((*choices, value + 1, value - 1, value ^ edge, rng.getrandbits(bits)))
    data[at : at + size] = (value % (1 << bits)).to_bytes(size, "little")


def _float(rng: random.Random, code: str) -> float:
    value = rng.choice((*_FLOATS, rng.uniform(-9, 9), 2.0 ** rng.randrange(-1022, 1023)))
    return value if code == "d" or value != value or abs(value) < 1e38 else 1e38


def _copy_field(rng: random.Random, base: Built, data: bytearray) -> None:
    """Copy the bytes of one field to another of the same size."""
    source = rng.choice(list(base.fields.values()))
    targets = [entry for entry in base.fields.values() if entry.size == source.size]
    target = rng.choice(targets)
    data[target.offset : target.offset + target.size] = data[source.offset : source.offset + source.size]


def _damage_coded(rng: random.Random, base: Built, data: bytearray) -> None:
    """Overwrite part of a stream's coded bytes."""
    coded = [entry for name, entry in base.fields.items() if name.endswith(".coded") and entry.size]
    if coded:
        entry = rng.choice(coded)
        at = entry.offset + rng.randrange(entry.size)
        end = min(entry.offset + entry.size, at + rng.choice((1, 2, 4, 16)))
        data[at:end] = rng.choice((bytes(end - at), b"\xff" * (end - at), rng.randbytes(end - at)))


def _swap_records(rng: random.Random, base: Built, data: bytearray) -> None:
    """Swap two records of the index, or two structures of a chunk, of the same kind."""
    starts: dict[str, list[Field]] = {}
    for name, entry in base.fields.items():
        if entry.structure and name.rsplit(".", 1)[1] == next(iter(_offsets(entry.structure))):
            starts.setdefault(entry.structure, []).append(entry)
    kinds = [kind for kind, entries in starts.items() if len(entries) > 1]
    if kinds:
        kind = rng.choice(kinds)
        one, other = (entry.offset for entry in rng.sample(starts[kind], 2))
        size = int(getattr(_spec, f"{kind.upper()}_SIZE"))
        data[one : one + size], data[other : other + size] = data[other : other + size], data[one : one + size]


def _set_splats(rng: random.Random, base: Built, data: bytearray) -> None:
    """Change the number of splats of a tile and the sum to match, which budgets have to catch."""
    counts = [
        entry for name, entry in base.fields.items() if name.startswith("tile[") and name.endswith(".splat_count")
    ]
    if counts:
        count = rng.choice((1, 2, 3, 1000, _spec.TILE_SPLATS_MAX, _spec.TILE_SPLATS_MAX + 1, rng.getrandbits(32)))
        entry = rng.choice(counts)
        struct.pack_into("<I", data, entry.offset, count)
        total = sum(struct.unpack_from("<I", data, entry.offset)[0] for entry in counts)
        struct.pack_into("<Q", data, base.fields["index.splat_count"].offset, total)


def _offsets(structure: str) -> dict[str, int]:
    offsets: dict[str, int] = getattr(_spec, f"{structure.upper()}_OFFSETS")
    return offsets


_IN_PLACE: tuple[Callable[[random.Random, Built, bytearray], None], ...] = (
    _flip_bits,
    _set_bytes,
    _set_field,
    _set_field,
    _set_field,
    _copy_field,
    _damage_coded,
    _damage_coded,
    _swap_records,
    _set_splats,
)

# Reassembled ---------------------------------------------------------------------------------------


def _laid_out(rng: random.Random, base: Built, data: bytearray, bases: Sequence[Built]) -> bytes:
    """Change the length of a chunk or the order of chunks, and adjust offsets and sizes."""
    chunks = {name: bytes(data[offset : offset + size]) for name, (offset, size) in base.spans.items()}
    if not chunks:
        return bytes(data)
    name = rng.choice(list(chunks))
    change = rng.randrange(6)
    if change == 0:
        chunks[name] = _with_payload(chunks[name], _edit(rng, _payload(chunks[name])))
    elif change == 1:
        donor = rng.choice(bases)
        if donor.spans:
            offset, size = rng.choice(list(donor.spans.values()))
            chunks[name] = _with_payload(chunks[name], _payload(donor.data[offset : offset + size]))
    elif change == 2:
        twin = rng.choice(list(chunks))
        chunks[name], chunks[twin] = chunks[twin], chunks[name]
    elif change == 3:
        order = list(chunks)
        rng.shuffle(order)
        chunks = {key: chunks[key] for key in order}
    else:
        chunks[name] = _recode(rng, base, name, chunks[name])
    return _assemble(base, data, chunks)


def _payload(chunk: bytes) -> bytes:
    return chunk[_spec.CHUNK_HEADER_SIZE :]


def _with_payload(chunk: bytes, payload: bytes) -> bytes:
    at = _spec.CHUNK_HEADER_OFFSETS["payload_size"]
    return chunk[:at] + struct.pack("<I", len(payload)) + payload


def _edit(rng: random.Random, payload: bytes) -> bytes:
    """Remove, duplicate or insert some bytes."""
    at = rng.randrange(len(payload) + 1)
    end = min(len(payload), at + rng.choice((1, 2, 4, 20, 1000)))
    middle = rng.choice((b"", payload[at:end] * 2, rng.randbytes(rng.randrange(20)) + payload[at:end]))
    return payload[:at] + middle + payload[end:]


def _recode(rng: random.Random, base: Built, name: str, chunk: bytes) -> bytes:
    """Replace the coded bytes of a stream of the chunk, and set coder and sizes to match."""
    heads = [key for key in base.fields if key.startswith(f"{name}/") and key.endswith(".coded_size")]
    if not heads:
        return chunk
    start = base.spans[name][0]
    at = base.fields[rng.choice(heads)].offset - start - _spec.STREAM_HEAD_OFFSETS["coded_size"]
    head = _spec.unpack_stream_head(chunk, at)
    begin = at + _spec.STREAM_HEAD_SIZE
    coded = chunk[begin : begin + head.coded_size]
    width = rng.choice((head.width, head.width, 1, 2, 4))
    packed = min(_PACKED_MAX, head.packed_size if rng.random() < 0.5 else head.count * width)
    plain = rng.choice((bytes(packed), b"\xff" * packed, rng.randbytes(packed), (coded + bytes(packed))[:packed]))
    coder = rng.choice((_spec.CODER_STORED, _spec.CODER_DEFLATE))
    if coder == _spec.CODER_DEFLATE:
        coded = rng.choice((deflate_stored(plain), deflate_fixed(plain), deflate_fixed(plain + b"\0"), _BOMB))
    else:
        coded = plain
    transforms = head.transforms if rng.random() < 0.7 else bytes(sorted(rng.sample(range(1, 5), 2))).ljust(4, b"\0")
    new = head._replace(width=width, coder=coder, transforms=transforms, packed_size=packed, coded_size=len(coded))
    payload = chunk[:at] + _spec.pack_stream_head(new) + coded + chunk[begin + head.coded_size :]
    return _with_payload(payload[: _spec.CHUNK_HEADER_SIZE], payload[_spec.CHUNK_HEADER_SIZE :])


def _assemble(base: Built, data: bytearray, chunks: dict[str, bytes]) -> bytes:
    """Join header, index and chunks, and update sizes and offsets in the records."""
    first = min(offset for offset, _ in base.spans.values())
    out = bytearray(data[:first])
    for name, chunk in chunks.items():
        record = _record_of(name)
        for key, value in (("size", len(chunk)), ("offset", len(out))):
            entry = base.fields[f"{record}.{key}"]
            struct.pack_into(entry.format, out, entry.offset, value)
        out += chunk
    entry = base.fields["header.file_size"]
    struct.pack_into(entry.format, out, entry.offset, len(out))
    return bytes(out)


def _record_of(name: str) -> str:
    if name.startswith("TILE."):
        _, tile, layer = name.split(".")
        return f"tile[{tile}].layer[{layer}]"
    return f"directory[{name}]"

# SPDX-License-Identifier: Apache-2.0
"""Resource levels (spec 8.1): decoder and encoder against the pseudo-code of the specification, and limits."""

from dataclasses import replace

import numpy as np
import pytest

import csplat
from csplat import EncodeOptions, InputError, LimitError, _spec, read_header
from csplat.decoder import Limits
from csplat.decoder.container import ExtraColumn
from csplat.decoder.resource_level import check_resource_level
from csplat.encoder.container import FileNode, FileTile, IndexedCodebook, SceneFields, _resource_level, tree_chunk
from csplat.errors import FormatError
from csplat_authoring.builder import build
from csplat_authoring.samples import scene

SH, SHAPE = _spec.CODEBOOK_KIND_SH, _spec.CODEBOOK_KIND_SHAPE
FULL, MIB = _spec.TILE_SPLATS_MAX, 1 << 20
HEADER = read_header(build(scene()).data)
KINDS = ("INDEX", "CODEBOOK", "TILE", "VERSION")
TABLES = [getattr(_spec, f"RESOURCE_LEVEL_{kind}_BYTES") for kind in KINDS]
BOUNDS = {level: [table.get(level, float("inf")) for table in TABLES] for level in _spec.RESOURCE_LEVEL_NAMES}
F64, WIDE, U8 = ExtraColumn("c", "<f8"), ExtraColumn("w", "<f8", 64), ExtraColumn("d", "|u1")

#: SH degree, extra columns, codebooks (kind, bands, size), splats of the tiles, tiles of each node and its parent.
CASES = {
    "nothing": (0, [], [], [], []),
    "tile of 32 MiB": (0, [F64] * 57, [], [FULL], []),
    "tile above 32 MiB": (0, [F64] * 57 + [U8], [], [FULL], []),
    "tile of 64 MiB": (0, [F64] * 57 + [WIDE], [], [FULL], []),
    "tile above 64 MiB": (0, [F64] * 57 + [WIDE, U8], [], [FULL], []),
    "scene of 256 MiB": (4, [F64] * 21, [], [FULL] * 8, []),
    "scene above 256 MiB": (4, [F64] * 21, [], [FULL] * 8 + [1], []),
    "scene of 4 GiB": (4, [F64] * 21, [], [FULL] * 128, []),
    "scene above 4 GiB": (4, [F64] * 21, [], [FULL] * 128 + [1], []),
    "codebooks below 256 MiB": (4, [], [(SH, (1, 4), FULL)] * 14 + [(SHAPE, (0, 0), 43690)] * 3, [1], []),
    "codebooks above 256 MiB": (4, [], [(SH, (1, 4), FULL)] * 14 + [(SHAPE, (0, 0), FULL)] * 3, [1], []),
    "small root": (4, [F64] * 21, [], [FULL] * 129, [(128, 1), (1, None)]),
    "two roots of 4 GiB": (4, [F64] * 42, [], [FULL] * 130, [(128, None), (1, 2), (1, None)]),
}


def contents(degree, columns, books, counts, nodes):
    """Return a case for the decoder, for the encoder and as sizes; the last node alone is of level 1."""
    levels = [0] * len(counts)
    if nodes:
        levels[-1] = 1
    tile = HEADER.tiles[0]
    tiles = [replace(tile, splat_count=count, level=level) for count, level in zip(counts, levels, strict=True)]
    records = [_spec.CodebookRecord(i, kind, *bands, 0, 0, size) for i, (kind, bands, size) in enumerate(books)]
    header = replace(
        HEADER, sh_degree=degree, extras=tuple(columns), codebooks=tuple(records), index_size=100,
        tiles=tuple(tile for tile in tiles if not tile.level), coarse_tiles=tuple(tile for tile in tiles if tile.level),
    )  # fmt: skip
    dtypes = {"<f8": _spec.EXTRA_DTYPE_F64, "|u1": _spec.EXTRA_DTYPE_U8}
    own = [FileTile(n, 0, (0, 0, 0), (0, 0, 0), 0.0, {}, level=level) for n, level in zip(counts, levels, strict=True)]
    fields = SceneFields(
        degree, 0, b"\0\0\0", 0.0, (0.0, 0.0, 0.0), (),
        [_spec.ExtraRecord(dtypes[c.dtype], c.components, _spec.CODING_RAW, 1, 0, 0, 0, b"c", b"") for c in columns],
        [IndexedCodebook(i, *book) for i, book in enumerate(books)],
    )  # fmt: skip
    roots, at, parts = [], 0, []
    for count, parent in nodes:
        parts.append(FileNode(parent, own[at : at + count]))
        roots += tiles[at : at + count] if parent is None else []
        at += count
    if nodes:
        fields = replace(fields, chunks=[tree_chunk(parts)])
    return header, roots if nodes else tiles, fields, own


def sizes_of(spec, degree, columns, books, counts, roots):
    extra_bytes = sum(column.components * np.dtype(column.dtype).itemsize for column in columns)
    wide, plain = spec.splat_bytes(degree, extra_bytes), spec.splat_bytes(degree, 0)
    per_entry = {SHAPE: lambda _: 6, SH: lambda bands: sum(3 * (2 * b + 1) for b in range(bands[0], bands[1] + 1))}
    codebooks = sum(4 * size * per_entry[kind](bands) for kind, bands, size in books)
    version = sum(tile.splat_count for tile in roots) * (plain if any(tile.level for tile in roots) else wide)
    return [100, codebooks, max(counts, default=0) * wide, version]


def test_decoder_and_encoder_require_the_level_of_the_specification(spec):
    found = {}
    for name, case in CASES.items():
        header, roots, fields, tiles = contents(*case)
        needed = spec.required_level(sizes_of(spec, *case[:4], roots), BOUNDS)
        found[name] = _spec.RESOURCE_LEVEL_NAMES[needed]
        assert needed == _resource_level(fields, tiles, 100), name
        for level, letter in _spec.RESOURCE_LEVEL_NAMES.items():
            stated = replace(header, resource_level=letter)
            if level == needed:
                check_resource_level(stated, roots)
            else:
                with pytest.raises(FormatError) as caught:
                    check_resource_level(stated, roots)
                assert ("RSL-1" if level < needed else "RSL-2") == caught.value.clause
    assert "AABBCABBCBCAB" == "".join(found.values())


def test_the_index_counts(spec):
    for size, needed in ((MIB, "A"), (MIB + 1, "B"), (16 * MIB, "B"), (16 * MIB + 1, "C")):
        header, roots, fields, tiles = contents(*CASES["nothing"])
        check_resource_level(replace(header, index_size=size, resource_level=needed), roots)
        level = _resource_level(fields, tiles, size)
        assert needed == _spec.RESOURCE_LEVEL_NAMES[level]
        assert level == spec.required_level([size, 0, 0, 0], BOUNDS)


def test_before_tree_is_read_a_level_may_only_be_too_low():
    header, *_ = contents(*CASES["tile above 32 MiB"])
    check_resource_level(replace(header, resource_level="C"), None)
    with pytest.raises(FormatError, match="RSL-1"):
        check_resource_level(replace(header, resource_level="A"), None)


def test_a_limit_refuses_a_file_from_its_header_alone():
    data = build(scene(resource_level=_spec.RESOURCE_LEVEL_B)).data[: _spec.HEADER_SIZE]
    limits = Limits(resource_level="A")
    for read in (read_header, csplat.decode, csplat.open):
        with pytest.raises(LimitError, match=r"E_LIMIT at byte 13 \(LIM-2\): resource_level: needs B, allowed A"):
            read(data, limits=limits)
    with pytest.raises(InputError, match="expected A, B or C"):
        Limits(resource_level="D")


def test_the_encoder_states_the_lowest_level(make_model):
    assert "A" == read_header(csplat.encode(make_model(3), EncodeOptions())).resource_level

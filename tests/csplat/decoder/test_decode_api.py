# SPDX-License-Identifier: Apache-2.0
"""Whole files and parts of them; the files come from the conformance suite's writer, never from our encoder.

Also: csplat.decoder.blocks.
"""

from __future__ import annotations

import io
import itertools
import mmap
import re
import struct
import zlib
from contextlib import suppress
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from damage_cases import BUILT, RICH, SMALL, declared, flipped

from csplat import SplatModel, _spec
from csplat.context import Context
from csplat.decoder import decode, decode_integers, decode_scene, iter_tiles, read_header, read_metadata
from csplat.decoder.decode_api import ONE_THREAD
from csplat.errors import CsplatError, FormatError, InputError, LimitError, UnsupportedError
from csplat.scene_metadata import SceneMetadata
from csplat_authoring.builder import build, chunk_records, repair
from csplat_authoring.reference import expected
from csplat_authoring.samples import (
    attributes,
    axis,
    codebook_block,
    means_rows,
    morton,
    offset,
    rich_scene,
    rows_of,
    scene,
    signed,
    tile,
    with_stream_codings,
)
from csplat_authoring.scene import Chunk, Codebook, Stream

ARRAYS = ("means", "quats", "scales", "opacities", "sh0", "shN")
SH0 = _spec.ATTRIBUTE_SH0


def assert_same(one, other, rows=slice(None), coefficients=None):
    for name in ARRAYS:
        want = getattr(one, name)[rows]
        want = want[:, :coefficients] if name == "shN" else want
        assert want.shape == getattr(other, name).shape, name
        assert want.tobytes() == getattr(other, name).tobytes(), name


def assert_decodes(described):
    data = build(described).data
    wanted = expected(described, 0)
    model, integers = decode(data), decode_integers(data)
    assert_same(SimpleNamespace(**wanted.floats), model)
    assert set(wanted.integers) == set(integers)
    for name, array in wanted.integers.items():
        assert (array.dtype, array.shape) == (integers[name].dtype, integers[name].shape), name
        assert array.tobytes() == integers[name].tobytes(), name
    return model


def test_rich_and_empty_scenes_decode_as_by_the_slow_reference():
    assert_decodes(rich_scene())
    assert (0, 15, 3) == assert_decodes(scene(3, ())).shN.shape


@pytest.mark.slow
def test_every_degree_and_colour_mapping_is_decoded():
    for degree, ycocg in itertools.product(range(5), (False, True)):
        described = scene(degree, (tile(1, 3, degree), tile(2, 5, degree)))
        assert_decodes(replace(described, attributes=attributes(degree, ycocg=ycocg, chroma_shift=3 * ycocg)))


@pytest.mark.slow
@pytest.mark.parametrize("escaped", [False, True])
def test_one_codebook_may_serve_all_bands(escaped):
    entries = {band: rows_of(band, 5, 3 * (2 * band + 1), -60, 60) for band in (1, 2, 3, 4)}
    indices = {1: (0, 5 if escaped else 4, 3, 1)}
    escapes = {
        1: signed(rows_of(1, 1, 9, -900, 900), Stream(2)), 2: offset(rows_of(2, 1, 15, -9, 9)),
        3: signed(rows_of(3, 1, 21, -9, 9)), 4: offset(rows_of(4, 1, 27, -99, 9)),
    }  # fmt: skip
    blocks = {
        SH0 + band: codebook_block(4, indices.get(band, ()), one if escaped else None) for band, one in escapes.items()
    }
    described = replace(
        scene(4, (tile(1, 4, 0, blocks), tile(2, 3, 4))),
        attributes=attributes(4, ycocg=True, chroma_shift=1),
        codebooks=(Codebook(4, _spec.CODEBOOK_KIND_SH, entries, (1, 4)),),
    )
    full = assert_decodes(described)
    for degree in (0, 1, 2, 3):
        assert_same(full, decode(build(described).data, sh_degree=degree), coefficients=(degree + 1) ** 2 - 1)


@pytest.mark.slow
def test_tiles_longer_than_a_run_of_the_decoder_are_decoded():
    # The slow reference computes the first and last splats, and those around the end of the first run.
    count, entries = 17_000, {1: rows_of(0, 5, 9, -60, 60)}
    blocks, index = tile(3, count, 0).blocks, np.array(rows_of(1, count, 1, 0, 5)).ravel()
    escapes, place = rows_of(2, np.count_nonzero(index == 5), 9, -900, 900), np.cumsum(index == 5) - 1
    means = np.array(blocks[_spec.ATTRIBUTE_MEANS].rows)

    def described(rows):
        some = {name: replace(block, rows=[block.rows[row] for row in rows]) for name, block in blocks.items()}
        escaped = [escapes[place[row]] for row in rows if index[row] == 5]
        some[SH0 + 1] = codebook_block(4, tuple(index[rows].tolist()), signed(escaped, Stream(2)))
        made = scene(1, (tile(3, len(rows), 0, some), tile(2, 3, 1)))
        codebooks = (Codebook(4, _spec.CODEBOOK_KIND_SH, entries, (1, 1)),)
        return replace(made, attributes=attributes(1, ycocg=True), codebooks=codebooks)

    box = {*means.argmin(axis=0).tolist(), *means.argmax(axis=0).tolist()}  # so that the part has the same box
    rows = sorted(box | {*range(100), *range(16_300, 16_500), *range(count - 50, count)})
    data, part = build(described(range(count))).data, described(rows)
    assert_same(decode(data, tiles=[0]), assert_decodes(part).select(slice(0, len(rows))), rows)
    long, short = decode_integers(data, tiles=[0]), decode_integers(build(part).data, tiles=[0])
    assert {"means", "scales", "sh1"} <= set(long)
    for name, array in long.items():
        if len(array) == count:
            assert array[rows].tolist() == short[name].tolist(), name


@pytest.mark.slow
@pytest.mark.parametrize("coder", ["stored", "deflate_fixed", "deflate_dynamic"])
def test_every_transform_and_coder_is_decoded(coder):
    described = scene(1, (tile(1, 6, 1),))
    for how in ((), (1,), (2,), (1, 2), (1, 2, 3), (4,), (3, 4), (1, 2, 3, 4)):
        assert_decodes(with_stream_codings(described, lambda one, how=how: replace(one, transforms=how, coder=coder)))


def test_morton_codes_of_any_width_and_the_largest_corners_and_axes_are_decoded():
    for width in (2, 3, 7):
        rows = morton(means_rows(1, 9, 31), 5, Stream(width))
        assert_decodes(scene(0, (tile(1, 9, 0, {_spec.ATTRIBUTE_MEANS: rows}),)))
    rows = [[0, 0, 0], [2**24 - 1, 5, 2**24 - 1]]
    corner = (2**53 - 2**24 + 1, -(2**53), 0)
    assert_decodes(scene(0, (tile(1, 2, 0, {_spec.ATTRIBUTE_MEANS: axis(rows, Stream(3))}, corner=corner),)))


def test_the_model_passes_its_own_constructor_and_checks_are_reported():
    model = decode(RICH)
    SplatModel(**vars(model))
    assert {"title": "rich"} == model.metadata.entries
    assert [5, 0, 65535, 1, 2] == model.extra["label"].tolist()
    assert np.dtype("<u2") == model.extra["label"].dtype
    assert "all_chunk_crcs" in decode_scene(RICH).checks
    assert "all_chunk_crcs" not in decode_scene(RICH, tiles=[0]).checks
    assert 0.25 == decode_scene(RICH).declared_bounds.records[0].rms


def test_any_buffer_path_or_stream_is_decoded_with_valid_arguments(tmp_path):
    path = tmp_path / "scene.csplat"
    path.write_bytes(RICH)
    full = decode(RICH)
    with path.open("rb") as file:
        mapped = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)
        for data in (bytearray(RICH), memoryview(RICH), mapped, file, io.BytesIO(RICH), path, str(path)):
            assert_same(full, decode(data))
    for data in (5, None, memoryview(RICH)[::2], io.StringIO("text")):
        with pytest.raises(InputError):
            decode(data)
    for arguments in ({"tiles": [2]}, {"tiles": [-1]}, {"sh_degree": 5}, {"sh_degree": -1}):
        with pytest.raises(InputError):
            decode(RICH, **arguments)


@pytest.mark.slow
def test_parts_equal_the_same_parts_of_the_whole():
    full, whole = decode(RICH), decode_integers(RICH)
    places = [range(one.start, one.start + one.splat_count) for one in read_header(RICH).tiles]
    for tiles, degree in itertools.product(([0], [1], [1, 0], []), (0, 1, 2, 3)):
        rows = [row for one in tiles for row in places[one]]
        part = decode(RICH, tiles=tiles, sh_degree=degree)
        assert_same(full, part, np.array(rows, int), (min(degree, 2) + 1) ** 2 - 1)
        assert full.extra["label"][rows].tolist() == part.extra["label"].tolist()
        integers = decode_integers(RICH, tiles=tiles, sh_degree=degree)
        for name in ("opacities", "scales", "quats", "means", "sh0"):
            assert whole[name][rows].tolist() == integers[name].tolist()
        assert whole["exponents"][tiles, : integers["exponents"].shape[1]].tolist() == integers["exponents"].tolist()
    for threads in (1, 2, 7):
        assert_same(full, decode(RICH, context=Context(threads=threads)))
    for place, one in zip(places, iter_tiles(RICH), strict=True):  # CNF-4
        assert_same(full, one, place)


def test_a_damaged_layer_fails_only_when_read():
    for data, place, band in ((bytearray(RICH), 1, 2), (bytearray(build(scene(4)).data), 0, 4)):
        layer = read_header(data).tiles[place].layers[band]
        data[layer.offset + layer.size - 1] ^= 1
        with pytest.raises(FormatError, match=f"E_CRC at byte {layer.offset} \\(CHK-1\\)"):
            decode(data)
        tiles = iter_tiles(data)
        assert list(range(place)) == [next(tiles).tile.index for _ in range(place)]
        with pytest.raises(FormatError, match="CHK-1"):
            next(tiles)
        assert band - 1 == decode(data, sh_degree=band - 1).sh_degree


def test_the_header_is_read_from_the_first_bytes():
    header = read_header(RICH)
    assert header == read_header(RICH[: _spec.HEADER_SIZE + header.index_size])
    with pytest.raises(FormatError, match="E_TRUNCATED"):
        read_header(RICH[: _spec.HEADER_SIZE + header.index_size - 1])


def test_an_unknown_chunk_is_skipped_and_its_crc_checked():
    built = build(scene(0, chunks=(Chunk(b"zzzz", payload=b"anything", flags=0),)))
    assert SceneMetadata() == read_metadata(built.data)
    decode(built.data)
    offset_, size = next(span for name, span in built.spans.items() if "zzzz" in name)
    data = bytearray(built.data)
    data[offset_ + size - 6] ^= 1
    with pytest.raises(FormatError, match=r"E_CRC at byte \d+ \(CHK-1\)"):
        decode(data)
    decode(data, tiles=[0])


def refusal(data, **arguments) -> CsplatError:
    with pytest.raises((FormatError, UnsupportedError, LimitError)) as caught:
        decode(data, **arguments)
    error = caught.value
    assert error.clause
    assert 0 <= error.offset <= len(data)
    return error


def test_prefixes_and_trailing_bytes_are_refused():
    # CNF-3
    for data in (SMALL, RICH):
        assert {"E_TRUNCATED"} == {refusal(data[:size], context=ONE_THREAD).code for size in range(len(data))}
    assert "E_MAGIC" == refusal(b"ply\n").code
    for size in range(_spec.HEADER_SIZE, len(SMALL)):  # also with its size and checksums repaired
        cut = bytearray(SMALL[:size])
        cut[20:28] = size.to_bytes(8, "little")
        refusal(repair(bytes(cut)), context=ONE_THREAD)
    for extra in (b"\0", b"\n", SMALL):
        error = refusal(SMALL + extra)
        assert ("E_TRAILING", len(SMALL)) == (error.code, error.offset)


@pytest.mark.slow
def test_every_flipped_bit_is_refused():
    # CNF-3; every 73rd bit of the larger file, so that each bit position within a byte occurs. After magic and
    # version a CRC refuses (HDR-12).
    named = 8 * _spec.HEADER_OFFSETS["profile"]
    for data, stride in ((SMALL, 1), (RICH, 73)):
        for bit in range(0, 8 * len(data), stride):
            code = refusal(flipped(data, bit), context=ONE_THREAD).code
            assert code in ({"E_MAGIC", "E_VERSION"} if bit < named else {"E_CRC"}), bit


@pytest.mark.slow
def test_flipped_bits_with_all_checksums_repaired_are_refused_or_decoded():
    records = chunk_records(SMALL)
    # Every seventh bit, so that each bit position within a byte occurs.
    for bit in range(0, 8 * len(SMALL), 7):
        with suppress(CsplatError):
            assert 2 == len(decode(repair(flipped(SMALL, bit), records), context=ONE_THREAD))


def test_errors_of_version_and_crc_name_the_stored_and_expected_values():
    data = bytearray(RICH)
    data[8:12] = struct.pack("<HH", 3, 7)
    assert re.search(r"E_VERSION.*3\.7.*reads 1\.0", str(refusal(data)))
    data = bytearray(RICH)
    data[16] ^= 1
    computed = zlib.crc32(data[:28])
    stored = int.from_bytes(data[28:32], "little")
    assert f"E_CRC at byte 28 (HDR-3): found {stored:#010x}, computed {computed:#010x}" == str(refusal(data))


def test_reserved_kernels_and_profiles_are_refused_by_name():
    for field, value, name in (
        ("index.kernel", _spec.KERNEL_SURFEL, "kernel SURFEL"), ("index.kernel", _spec.KERNEL_BETA, "kernel BETA"),
        ("index.kernel", _spec.KERNEL_TRIANGLE, "kernel TRIANGLE"), ("index.kernel", 240, "kernel 240"),
        ("header.profile", _spec.PROFILE_ARCHIVE, "profile ARCHIVE"), ("header.profile", 255, "profile 255"),
    ):  # fmt: skip
        assert str(refusal(BUILT.patched({field: value}))).endswith(f"{name} is not supported")


def test_huge_counts_in_a_small_index_cost_nothing():
    sizes = {"tile": 2**32 - 1, "directory": 65535, "codebook": 65535, "extra": 64, "attribute": 255}
    for name, size in sizes.items():
        error = refusal(BUILT.patched({f"index.{name}_count": size}))
        assert ("E_INDEX", "IDX-2") == (error.code, error.clause)
    assert "EXR-4" == refusal(BUILT.patched({"index.extra_count": 65535})).clause
    assert "IDX-7" == refusal(BUILT.patched({"index.splat_count": 2**63})).clause


@pytest.mark.parametrize(("fields", "clause"), [
    ({"records": ((0, 1.0, 1.0),)}, "SER-1"),
    ({"records": ((9, 1.0, 1.0),)}, "SER-1"),
    ({"records": ((2, 1.0, 1.0), (2, 1.0, 1.0))}, "SER-1"),
    ({"records": ((1, 1.0, 1.1),)}, "SER-2"),
    ({"records": ((4, 1.0, 1.8),)}, "SER-2"),
    ({"records": ((1, float("nan"), 0.0),)}, "SER-2"),
    ({"records": ((1, float("inf"), 0.0),)}, "SER-2"),
    ({"records": ((1, 1.0, -1.0),)}, "SER-2"),
    ({"pruned_count": 1}, "SER-4"),
    ({"flags": 2}, "RES-1"),
])  # fmt: skip
def test_impossible_declared_errors_are_refused(fields, clause):
    with pytest.raises(FormatError, match=clause):
        decode(declared(**fields))

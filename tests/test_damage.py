"""Damage that no checksum was repaired for: every prefix and every flipped bit of small files is refused."""

import pytest

import csplat
from csplat import _spec
from csplat.decoder import read_header
from csplat_authoring.builder import build, chunk_records, repair
from csplat_authoring.samples import rich_scene
from csplat_conformance.manifest import VECTORS

SMALL = (VECTORS / "valid" / "worked_example.csplat").read_bytes()
RICH = build(rich_scene()).data


@pytest.mark.parametrize("data", [SMALL, RICH], ids=["small", "rich"])
def test_every_prefix_is_refused_as_truncated(data):
    # CNF-3
    for size in range(len(data)):
        with pytest.raises(csplat.FormatError) as caught:
            csplat.decode(data[:size], threads=1)
        assert "E_TRUNCATED" == caught.value.code, size
        assert caught.value.clause
        assert 0 <= caught.value.offset <= size


def test_every_prefix_with_its_size_and_checksums_repaired_is_refused():
    for size in range(_spec.HEADER_SIZE, len(SMALL)):
        cut = bytearray(SMALL[:size])
        cut[20:28] = size.to_bytes(8, "little")
        with pytest.raises(csplat.CsplatError):
            csplat.decode(repair(bytes(cut)), threads=1)


@pytest.mark.slow
@pytest.mark.parametrize(("data", "stride"), [(SMALL, 1), (RICH, 37)], ids=["small", "rich"])
def test_every_flipped_bit_is_refused(data, stride):
    # CNF-3; of the larger file every 37th bit, which reaches each place within a byte. Behind magic and version
    # it is a CRC that refuses (HDR-12).
    named = 8 * _spec.HEADER_OFFSETS["profile"]
    for bit in range(0, 8 * len(data), stride):
        damaged = bytearray(data)
        damaged[bit // 8] ^= 1 << bit % 8
        with pytest.raises(csplat.CsplatError) as caught:
            csplat.decode(bytes(damaged), threads=1)
        assert caught.value.code in ({"E_MAGIC", "E_VERSION"} if bit < named else {"E_CRC"}), bit
        assert 0 <= caught.value.offset <= len(data)


@pytest.mark.slow
def test_flipped_bits_of_a_part_are_refused_by_who_reads_that_part_alone():
    # HDR-12; every third bit, which reaches each place within a byte.
    layer = read_header(SMALL).tiles[0].layers[0]
    for bit in range(8 * layer.offset, 8 * (layer.offset + layer.size), 3):
        damaged = bytearray(SMALL)
        damaged[bit // 8] ^= 1 << bit % 8
        with pytest.raises(csplat.FormatError) as caught:
            csplat.decode(damaged, tiles=[0], sh_degree=0, threads=1)
        assert ("E_CRC", layer.offset, "CHK-1") == (caught.value.code, caught.value.offset, caught.value.clause)


@pytest.mark.slow
def test_flipped_bits_with_all_checksums_repaired_are_refused_or_decoded():
    records = chunk_records(SMALL)
    # Every seventh bit, which reaches each place within a byte.
    for bit in range(0, 8 * len(SMALL), 7):
        damaged = bytearray(SMALL)
        damaged[bit // 8] ^= 1 << bit % 8
        try:
            model = csplat.decode(repair(bytes(damaged), records), threads=1)
        except csplat.CsplatError:
            continue
        assert 2 == len(model)


@pytest.mark.parametrize("extra", [b"\0", b"\n", SMALL], ids=["zero", "line feed", "itself"])
def test_trailing_bytes_are_refused(extra):
    with pytest.raises(csplat.FormatError) as caught:
        csplat.decode(SMALL + extra)

    assert ("E_TRAILING", len(SMALL)) == (caught.value.code, caught.value.offset)


@pytest.mark.parametrize("kind", [bytes, bytearray, memoryview])
def test_any_buffer_is_decoded(kind):
    assert 2 == len(csplat.decode(kind(SMALL)))

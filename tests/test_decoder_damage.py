"""Damaged fields: whatever they hold, a typed error with code, offset and clause; prefixes and bits: test_damage.py."""

import os
import random
import struct
import zlib

import pytest

from csplat import _spec
from csplat.decoder import Limits, decode, decode_integers, read_header
from csplat.errors import CsplatError, FormatError, LimitError, UnsupportedError
from csplat_authoring.builder import build, repair
from csplat_authoring.samples import rich_scene

BUILT = build(rich_scene())
RICH = BUILT.data
SMALL_LIMITS = Limits(bytes=50_000_000, json_bytes=100_000)


def refusal(data, **arguments) -> CsplatError:
    with pytest.raises((FormatError, UnsupportedError, LimitError)) as caught:
        decode(data, **arguments)
    error = caught.value
    assert error.clause
    assert 0 <= error.offset <= len(data)
    return error


def test_short_data_that_is_no_beginning_of_a_file():
    assert "E_MAGIC" == refusal(b"ply\n").code
    assert "E_TRUNCATED" == refusal(b"").code


def test_the_version_error_names_both_versions():
    data = bytearray(RICH)
    data[8:12] = struct.pack("<HH", 3, 7)
    error = refusal(data)
    assert "E_VERSION" == error.code
    assert "3.7" in str(error)
    assert "0.2" in str(error)


def test_a_crc_error_says_what_was_found_and_computed():
    data = bytearray(RICH)
    data[16] ^= 1
    computed = zlib.crc32(data[:28])
    stored = int.from_bytes(data[28:32], "little")
    assert f"E_CRC at byte 28 (HDR-3): found {stored:#010x}, computed {computed:#010x}" == str(refusal(data))


def test_huge_counts_in_a_small_index_cost_nothing():
    for name in ("tile_count", "directory_count", "codebook_count", "extra_count", "attribute_count"):
        wide = {"tile_count": 2**32 - 1, "attribute_count": 255}.get(name, 65535)
        error = refusal(BUILT.patched({f"index.{name}": wide}))
        assert ("E_INDEX", "IDX-2") == (error.code, error.clause)


def test_a_splat_count_that_the_tiles_do_not_hold():
    assert "IDX-7" == refusal(BUILT.patched({"index.splat_count": 2**63})).clause


_EXTREMES = {
    "B": (0, 1, 2, 127, 128, 255),
    "H": (0, 1, 255, 32768, 65535),
    "I": (0, 1, 2**24, 2**31, 2**32 - 1),
    "Q": (0, 1, 2**53, 2**63, 2**64 - 1),
    "h": (-32768, -1100, -1, 1, 1100, 32767),
    "i": (-(2**31), -(2**22) - 1, -1, 1, 2**22, 2**31 - 1),
    "q": (-(2**63), -(2**53) - 1, -(2**50), -1, 1, 2**50, 2**53, 2**63 - 1),
    "f": (0.0, -0.0, -1.0, 1e-45, 3e38, float("inf"), float("nan")),
    "d": (0.0, -0.0, -1.0, 5e-324, 2.0**-1022, 1e308, float("inf"), float("nan")),
}


def extremes(field):
    """Yield what a field's bytes may become, its first component or its last at its extremes."""
    now = RICH[field.offset : field.offset + field.size]
    if field.format.endswith("s"):
        yield from (bytes(field.size), b"\xff" * field.size)
        return
    values = struct.unpack(field.format, now)
    for i in sorted({0, len(values) - 1}):
        code = field.format[-1]
        for value in _EXTREMES[code]:
            yield struct.pack(field.format, *values[:i], value, *values[i + 1 :])


@pytest.mark.slow
def test_every_field_at_its_extremes_is_refused_or_decoded_within_limits():
    # The first and the last place of each field of a structure.
    places = {}
    for name, field in BUILT.fields.items():
        if not name.endswith("crc"):
            places.setdefault((field.structure, name.rpartition(".")[2]), []).append(name)
    tried = 0
    first = {names[0] for names in places.values()}
    for name in first | {names[-1] for names in places.values()}:
        # Every other value at the last place of a field.
        for value in [*extremes(BUILT.fields[name])][:: 1 if name in first else 2]:
            check_one(BUILT.patched({name: value}))
            tried += 1
    assert tried > 600


def check_one(data: bytes) -> None:
    """Decode both ways: no error but ours, and both ways agree."""
    errors = [error_of(function, data) for function in (decode, decode_integers)]
    assert (errors[0] is None) == (errors[1] is None)
    for error in filter(None, errors):
        assert error.clause
        assert 0 <= error.offset <= len(data)


def error_of(function, data: bytes) -> FormatError | UnsupportedError | LimitError | None:
    try:
        function(data, limits=SMALL_LIMITS, threads=1)
    except (FormatError, UnsupportedError, LimitError) as error:
        return error
    return None


@pytest.mark.slow
def test_mutations_with_all_checksums_repaired():
    rng = random.Random(0)  # noqa: S311 - no secrets here
    for _ in range(int(os.environ.get("CSPLAT_MUTATIONS", "250"))):
        data = bytearray(RICH)
        for _ in range(rng.choice((1, 1, 2, 4))):
            at = rng.randrange(_spec.HEADER_SIZE, len(data) - 8)
            if rng.random() < 0.5:
                data[at] ^= 1 << rng.randrange(8)
            elif rng.random() < 0.6:
                data[at] = rng.choice((0, 1, 2, 3, 4, 5, 127, 128, 255))
            else:
                data[at : at + 4] = rng.choice((b"\xff" * 4, bytes(4), rng.randbytes(4)))
        check_one(repair(bytes(data), BUILT.records))


def test_the_header_reader_refuses_no_less_of_the_index():
    for name in ("index.sh_degree", "index.scene_flags", "index.axes"):
        with pytest.raises((FormatError, UnsupportedError)):
            read_header(BUILT.patched({name: b"\7\7\7" if name.endswith("axes") else 255}))

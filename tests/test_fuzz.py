"""The fuzzer itself: the same cases every time, and it sees what it looks for."""

import importlib.util
import signal
import time
from pathlib import Path

import pytest

from csplat import decoder
from csplat.errors import FormatError
from csplat_conformance.builder import build
from csplat_conformance.manifest import VECTORS
from csplat_conformance.mutate import mapped
from csplat_conformance.repair import repair
from csplat_conformance.samples import rich_scene

SPEC = importlib.util.spec_from_file_location("fuzz", Path(__file__).parent / "fuzz.py")
fuzz = importlib.util.module_from_spec(SPEC)
SPEC.loader.exec_module(fuzz)

BASES = [build(rich_scene())]


@pytest.fixture(autouse=True)
def alarm():
    before = signal.signal(signal.SIGALRM, fuzz.too_slow)
    yield
    signal.signal(signal.SIGALRM, before)


def test_cases_are_the_same_for_a_seed():
    first = [fuzz.case(5, number, BASES) for number in range(50)]

    assert first == [fuzz.case(5, number, BASES) for number in range(50)]
    assert first != [fuzz.case(6, number, BASES) for number in range(50)]


def test_most_mutants_have_sound_checksums():
    mutants = [fuzz.case(2, number, BASES) for number in range(300)]

    assert sum(repaired for _, repaired in mutants) > 240
    assert all(data == repair(data) for data, repaired in mutants if repaired)


def test_mutants_reach_the_streams():
    names = {fuzz.attempt(fuzz.case(1, number, BASES)[0])[0] for number in range(1500)}

    assert {"decoded", "E_STREAM", "E_CODER", "E_CODEBOOK", "E_BOX", "E_RANGE"} <= names
    assert "finding" not in names


def test_a_file_of_any_origin_is_a_base():
    base = mapped((VECTORS / "valid" / "rich.csplat").read_bytes())
    names = {fuzz.attempt(fuzz.case(1, number, [base])[0])[0] for number in range(300)}

    assert len(names) > 5
    assert "finding" not in names


@pytest.mark.parametrize("error", [KeyError("a"), MemoryError(), RecursionError(), ValueError("b"), SystemExit(0)])
def test_another_exception_is_a_finding(monkeypatch, error):
    def broken(*_args, **_options):
        raise error

    monkeypatch.setattr(decoder, "decode", broken)

    assert "finding" == fuzz.attempt(b"")[0]


def test_a_refusal_is_none(monkeypatch):
    def refuse(*_args, **_options):
        raise FormatError("E_CRC", 0, "CHK-1")

    monkeypatch.setattr(decoder, "decode", refuse)

    assert ("E_CRC", "") == fuzz.attempt(b"")


def test_a_slow_case_is_a_finding(monkeypatch):
    monkeypatch.setattr(fuzz, "SECONDS_PER_CASE", 0.05)
    monkeypatch.setattr(decoder, "decode", lambda *_args, **_options: time.sleep(2))

    assert ("finding", "slower than 0.05 s") == fuzz.attempt(b"")


def test_a_finding_is_made_smaller(monkeypatch):
    base = BASES[0].data
    at = BASES[0].fields["tile[1].level"].offset

    def broken(data, **_options):
        if data[at] == 9:
            raise KeyError("level")
        raise FormatError("E_CRC", 0, "CHK-1")

    monkeypatch.setattr(decoder, "decode", broken)
    damaged = bytearray(base)
    damaged[at] = 9
    damaged[at + 30] ^= 255
    data = repair(bytes(damaged))

    small = fuzz.minimised(data, fuzz.attempt(data)[1], BASES)

    assert [at] == [i for i in range(_spec_end(), len(base)) if small[i] != base[i] and i not in _index_crc()]


def _spec_end():
    return 64


def _index_crc():
    entry = BASES[0].fields["index.crc"]
    return range(entry.offset, entry.offset + 4)

"""The fuzzer: reproducible cases, and findings that are recognised."""

import importlib.util
import random
import re
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path
from types import SimpleNamespace

import pytest
from tables import failures

from csplat import _spec, decoder
from csplat.errors import FormatError, InputError
from csplat_authoring.builder import build, repair
from csplat_authoring.samples import rich_scene
from csplat_conformance import validator
from csplat_conformance.answers import Answer
from csplat_conformance.conformance_report import Status
from csplat_conformance.manifest import VECTORS
from csplat_selftest import decoder_processes
from csplat_selftest.fuzzing import file_targets
from csplat_selftest.fuzzing.damage import built_from, damaged_from
from csplat_selftest.fuzzing.decoder_targets import (
    DecoderTarget,
    OthersTarget,
    ValidatorTarget,
    compared,
    missing_others,
)
from csplat_selftest.fuzzing.edges import Edges
from csplat_selftest.fuzzing.file_targets import Ply, PlyTarget

pytestmark = pytest.mark.slow  # together: tests of the fuzzer

PROGRAM = Path(__file__).parent / "fuzz.py"
SPEC = importlib.util.spec_from_file_location("fuzz", PROGRAM)
fuzz = importlib.util.module_from_spec(SPEC)
SPEC.loader.exec_module(fuzz)

BASES = [build(rich_scene())]
CORPUS = Path(__file__).parent / "corpus"
needs_node = pytest.mark.skipif(
    bool(decoder_processes.missing_javascript()), reason=f"skipped: {decoder_processes.missing_javascript()}"
)


@pytest.fixture(autouse=True)
def alarm():
    before = signal.signal(signal.SIGPROF, fuzz.too_slow)
    yield
    signal.signal(signal.SIGPROF, before)


@pytest.fixture(scope="module")
def ply_target():
    target = PlyTarget()
    yield target
    target.close()


def cases(target, seed, count, corpus):
    return [fuzz.case(target, seed, number, corpus, [])[0].data for number in range(count)]


def attempt(data):
    return fuzz.attempt(DecoderTarget(), data)


def raising(error):
    def run(*_args, **_options):
        raise error

    return run


# Mutants of csplat files ---------------------------------------------------------------------------
def test_cases_are_the_same_for_a_seed():
    first = cases(DecoderTarget(), 5, 50, BASES)
    assert first == cases(DecoderTarget(), 5, 50, BASES)
    assert first != cases(DecoderTarget(), 6, 50, BASES)


def test_most_damaged_files_have_sound_checksums():
    base = BASES[0]
    damaged_files = [damaged_from(random.Random(number), base, BASES) for number in range(300)]  # noqa: S311 - no secret
    assert sum(repaired for _, repaired, _ in damaged_files) > 240
    assert all(data == repair(data, base.records) for data, repaired, _ in damaged_files if repaired)


def test_damaged_files_reach_the_streams():
    names = {attempt(data)[0] for data in cases(DecoderTarget(), 1, 250, BASES)}
    assert {"decoded", "E_STREAM", "E_CODER", "E_CODEBOOK", "E_BOX", "E_RANGE"} <= names
    assert "finding" not in names


def test_a_damaged_file_can_be_damaged_again():
    target, corpus = DecoderTarget(), list(BASES)
    for number in range(200):
        one, _ = fuzz.case(target, 3, number, BASES, corpus[1:])
        source = one.source()
        corpus += [source] if source is not None else []
    assert len(corpus) > 100
    assert "finding" not in {attempt(data)[0] for data in cases(target, 4, 100, corpus)}


def test_a_file_of_any_origin_is_a_base():
    base = built_from((VECTORS / "valid" / "rich.csplat").read_bytes())
    names = {attempt(data)[0] for data in cases(DecoderTarget(), 1, 80, [base])}
    assert len(names) > 5
    assert "finding" not in names


# What is a finding ---------------------------------------------------------------------------------
@pytest.mark.parametrize("error", [KeyError("a"), MemoryError(), RecursionError(), ValueError("b"), SystemExit(0)])
def test_another_exception_is_a_finding(monkeypatch, error):
    monkeypatch.setattr(decoder, "decode", raising(error))
    assert "finding" == attempt(b"")[0]


def test_a_warning_is_a_finding(monkeypatch):
    monkeypatch.setattr(decoder, "decode", lambda *_args, **_options: __import__("warnings").warn("odd", stacklevel=1))
    assert "UserWarning: odd" in attempt(b"")[1]


def test_a_refusal_is_no_finding(monkeypatch):
    monkeypatch.setattr(decoder, "decode", raising(FormatError("E_CRC", 0, "CHK-1")))
    assert ("E_CRC", "") == attempt(b"")


def test_a_slow_case_is_a_finding(monkeypatch):
    monkeypatch.setattr(fuzz, "SECONDS_PER_CASE", 0.05)
    monkeypatch.setattr(decoder, "decode", lambda *_args, **_options: [None for _ in iter(time.process_time, 1e9)])
    assert ("finding", "more than 0.05 s of processor time") == attempt(b"")


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
    data = repair(bytes(damaged), BASES[0].records)
    small = fuzz.minimised(DecoderTarget(), data, attempt(data)[1], BASES)
    crc = BASES[0].fields["index.crc"].offset
    sums = {*range(_spec.HEADER_SIZE), *range(crc, crc + 4)}
    assert [at] == [i for i in range(len(base)) if small[i] != base[i] and i not in sums]


# Several decoders ----------------------------------------------------------------------------------
PASSED = Answer(Status.PASSED, "", {"splat_count": 1}, {"floats.means": (12, "ab")})
REFUSED = Answer(Status.REFUSED, code="E_CRC", clause="CHK-1")


@pytest.mark.parametrize(("ours", "theirs", "name"), [
    (PASSED, PASSED, "decoded"),
    (REFUSED, REFUSED, "E_CRC"),
    (REFUSED, Answer(Status.REFUSED, code="E_BOX"), "another code"),
    (PASSED, Answer(Status.REFUSED, code="E_LIMIT"), "E_LIMIT"),
    (PASSED, REFUSED, "finding"),
    (REFUSED, PASSED, "finding"),
    (PASSED, Answer(Status.PASSED, "", {"splat_count": 2}, PASSED.arrays), "finding"),
    (PASSED, Answer(Status.PASSED, "", PASSED.header, {"floats.means": (12, "cd")}), "finding"),
    (PASSED, Answer(Status.PASSED, "", PASSED.header, {}), "finding"),
    (PASSED, Answer(Status.REFUSED, code="E_UNSUPPORTED"), "finding"),
])  # fmt: skip
def test_two_decoders_have_to_agree(ours, theirs, name):
    assert name == compared(ours, theirs, "C")[0]


@pytest.mark.skipif(bool(missing_others()), reason=f"skipped: {missing_others()}")
@pytest.mark.slow
@pytest.mark.area(name="suite")  # `make test` fuzzes the others, too
def test_all_decoders_agree_on_damaged_files():
    target = OthersTarget()
    names = {fuzz.attempt(target, data)[0] for data in cases(target, 2, 100, BASES)}
    target.close()
    assert ["JavaScript", "C"] == list(target.decoders)
    assert {"decoded", "E_INDEX", "E_STREAM"} <= names
    assert "finding" not in names


@needs_node
def test_a_javascript_process_that_ends_is_a_finding_and_starts_again():
    target = OthersTarget(languages=["JavaScript"])
    assert ("decoded", "") == fuzz.attempt(target, BASES[0].data)
    target.decoders["JavaScript"]._process.kill()
    assert "JavaScript, crashed" in fuzz.attempt(target, BASES[0].data)[1]
    assert ("decoded", "") == fuzz.attempt(target, BASES[0].data)
    target.memory_bytes = 1
    assert target.memory().startswith("JavaScript holds")
    target.close()


@needs_node
def test_a_javascript_process_that_hangs_is_a_finding(tmp_path):
    for path in decoder_processes.js_folder().glob("*.mjs"):
        shutil.copy(path, tmp_path)
    (tmp_path / "decoder.mjs").write_text(
        "export class CsplatError extends Error {}\n"
        "export const decode = () => Atomics.wait(new Int32Array(new SharedArrayBuffer(4)), 0, 0);\n"
    )
    with decoder_processes.JsDecoder(tmp_path, timeout=1.5) as hanging:
        assert Status.HUNG == hanging.ask(b"").status


def test_validator_and_decoder_agree_on_damaged_files():
    names = {fuzz.attempt(ValidatorTarget(), data) for data in cases(ValidatorTarget(), 2, 60, BASES)}
    assert {("decoded", ""), ("E_INDEX", ""), ("E_STREAM", "")} <= names
    assert "finding" not in {name for name, _ in names}


@pytest.mark.parametrize(("violations", "data"), [((), BASES[0].data[:-1]), (("CHK-1",), BASES[0].data)])
def test_a_validator_that_disagrees_is_a_finding(monkeypatch, violations, data):
    found = SimpleNamespace(violations=[SimpleNamespace(clause=clause) for clause in violations])
    monkeypatch.setattr(validator, "validate", lambda *_args, **_options: found)
    assert "finding" == fuzz.attempt(ValidatorTarget(), data)[0]


# PLY -----------------------------------------------------------------------------------------------
def test_every_seed_of_the_ply_target_is_read(ply_target):
    became = [fuzz.attempt(ply_target, seed.data) for seed in ply_target.seeds([]) if seed.lines]
    assert {("read", "")} == set(became)
    others = [seed.data for seed in ply_target.seeds([]) if not seed.lines]
    assert [("refused", "")] * 3 == [fuzz.attempt(ply_target, data) for data in others]


def test_a_ply_is_taken_apart_and_put_together_again(ply_target):
    for seed in ply_target.seeds([]):
        assert seed.data == Ply.parse(seed.data).data


def test_damaged_plies_are_read_and_refused_and_nothing_else(ply_target):
    names = [fuzz.attempt(ply_target, data)[0] for data in cases(ply_target, 1, 120, ply_target.seeds([]))]
    assert {"read", "refused"} == set(names)
    assert 12 < names.count("read") < 108


@pytest.mark.parametrize(("name", "wrong"), [("read_ply", ValueError("x")), ("lint_ply", IndexError("y"))])
def test_another_exception_of_the_reader_is_a_finding(monkeypatch, ply_target, name, wrong):
    monkeypatch.setattr(file_targets, name, raising(wrong))
    assert type(wrong).__name__ in fuzz.attempt(ply_target, ply_target.seeds([])[0].data)[1]


def test_a_reader_that_disagrees_with_lint_is_a_finding(monkeypatch, ply_target):
    monkeypatch.setattr(file_targets, "read_ply", raising(InputError("no")))
    assert "lint reports no error" in fuzz.attempt(ply_target, ply_target.seeds([])[0].data)[1]


def test_a_ply_is_made_smaller(monkeypatch, ply_target):
    def broken(path, **_options):
        if b"scale_1" in path.read_bytes():
            raise KeyError("scale_1")
        raise InputError("no")

    monkeypatch.setattr(file_targets, "read_ply", broken)
    data = ply_target.seeds([])[1].data
    small = fuzz.minimised(ply_target, data, fuzz.attempt(ply_target, data)[1], [])
    assert b"property float scale_1\nend_header\n" == small


# Coverage, program, regressions --------------------------------------------------------------------
def test_edges_are_new_once():
    edges = Edges([Path(decoder.__file__).parent])
    run = lambda: attempt(BASES[0].data)  # noqa: E731 - called twice
    assert edges.watch(run)[1] > 300
    assert 0 == edges.watch(run)[1]
    assert edges.watch(lambda: attempt(BASES[0].data[:100]))[1] > 0
    assert edges.lines() <= edges.all_lines() | {line for line in edges.lines() if "<" in line[0]}


@needs_node
@pytest.mark.slow
@pytest.mark.area(name="suite")  # `make test` runs the program unguided
def test_the_program_prints_its_tally(tmp_path):
    # The target with the longest report.
    words = [sys.executable, str(PROGRAM), "--target", "others", "--count", "12", "--jobs", "1", "--out", str(tmp_path)]
    run = subprocess.run(words, capture_output=True, text=True, check=False)
    assert (0, "") == (run.returncode, run.stderr)
    assert "others: 12 executions" in run.stdout
    assert "lines of functions" in run.stdout
    assert re.search(r"of the text of [1-9]\d modules ran", run.stdout)
    assert "0 kinds of findings" in run.stdout


def test_earlier_findings_stay_fixed(ply_target):
    targets = {"ply": ply_target, "decoder": DecoderTarget()}

    def check(path):
        assert "" == fuzz.attempt(targets[path.parent.name], path.read_bytes())[1]

    assert [] == failures(CORPUS.glob("*/*"), check)

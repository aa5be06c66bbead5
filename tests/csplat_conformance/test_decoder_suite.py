# SPDX-License-Identifier: Apache-2.0
"""The conformance runner against decoders that are correct, misbehave, or have a planted fault.

Also: csplat_conformance.adapter, csplat_conformance.answers, csplat_conformance.protocol,
csplat_conformance.tolerance.
"""

from __future__ import annotations

import contextlib
import io
import json
import re
import shlex
import sys
import xml.etree.ElementTree as ET
from dataclasses import replace
from pathlib import Path
from unittest.mock import Mock

import pytest
from tables import failures
from typer.testing import CliRunner

import csplat
from csplat.errors import FormatError, InputError
from csplat_conformance import SUITE_VERSION, adapter, decoder_suite
from csplat_conformance.answers import Answer, check_payload_consistency, compare_answer
from csplat_conformance.conformance_report import Status, to_json, to_table
from csplat_conformance.decoder_suite import DecoderSuiteOptions, parse_levels, run_builtin, run_command
from csplat_conformance.encoders import all_inputs
from csplat_conformance.manifest import VECTORS, load, select_names
from csplat_selftest.decoder_processes import missing_javascript
from csplat_tools.cli.app import app

VECTOR_LIST = load()
NAMED = {vector.name: vector for vector in VECTOR_LIST}

# Recorded answers of our decoder by the protocol, with a selectable fault; no slow imports.
FAULTY = """
import json, os, pathlib, shutil, signal, struct, sys, time

fault, source, outdir = sys.argv[1], sys.argv[2], pathlib.Path(sys.argv[3])
instead = {
    "crash": lambda: os.kill(os.getpid(), signal.SIGSEGV),
    "hang": lambda: time.sleep(60),
    "status": lambda: sys.exit(77),
    "traceback": lambda: {}["tile"],
    "silent": lambda: sys.exit(0),
    "believes json_open": lambda: "json_open." in source and sys.exit(0),
    "no code": lambda: print("it is broken") or sys.exit(1),
    "refusal": lambda: print('{"code": "E_MAGIC"}') or sys.exit(1),
}
instead.get(fault, int)()
recorded = pathlib.Path(__file__).parent / "recorded" / pathlib.Path(source).stem
status, words = json.loads(recorded.with_suffix(".json").read_text())
sys.stdout.write(words)
for path in recorded.iterdir():
    shutil.copy(path, outdir)
header, means = outdir / "header.json", outdir / "floats.means.bin"
raw = means.read_bytes() if means.exists() else b""
bits = [value for (value,) in struct.iter_unpack("<I", raw)]
change = {
    "leftovers": lambda: means.write_bytes(b"part"),
    "no header": header.unlink,
    "header": lambda: header.write_text("[]"),
    "fact": lambda: header.write_text(json.dumps(json.loads(header.read_text()) | {"splat_count": 3})),
    "missing": (outdir / "integers.means.bin").unlink,
    "extra": (outdir / "floats.colours.bin").touch,
    "unknown file": (outdir / "log.txt").touch,
    "partial": lambda: means.write_bytes(raw[:-1]),
    "longer": lambda: means.write_bytes(raw + b"0"),
    "rounding": lambda: means.write_bytes(bytes([raw[0] ^ 1]) + raw[1:]),
    "2 ulp": lambda: means.write_bytes(struct.pack(f"<{len(bits)}I", *(value + 2 for value in bits))),
    "3 ulp": lambda: means.write_bytes(struct.pack(f"<{len(bits)}I", *(value + 3 for value in bits))),
}
change.get(fault, int)()
sys.exit(status)
"""


# Answers with the right lines, or those of an expression.
CUTS = """
import json, pathlib, sys

answer, source, cuts = sys.argv[1:]
known = json.loads((pathlib.Path(__file__).parent / "cuts.json").read_text())[pathlib.Path(source).stem]
given = [known[cut] for cut in pathlib.Path(cuts).read_text().splitlines()]
lines = [tiles if isinstance(tiles, str) else " ".join(map(str, tiles)) for tiles in given]

def refuse():
    print(json.dumps({"code": "E_INDEX", "clause": "TRE-5"}))
    sys.exit(1)

def without(is_unsupported):
    return ["E_UNSUPPORTED" if is_unsupported(cut) else line for cut, line in zip(known, lines)]

for line in eval(answer):
    print(line)
"""

PAYLOADS = ("invalid/json_open", "invalid/json_surrogate", "invalid/json_beyond_budget", "invalid/error_counts")
RECORDED = ("valid/quats", "invalid/quat_radicand", *PAYLOADS)

ROOT = Path(__file__).resolve().parents[2]
ADAPTER = f"{shlex.quote(sys.executable)} -m csplat_conformance.adapter {{input}} {{outdir}}"
CUT_ADAPTER = f"{shlex.quote(sys.executable)} -m csplat_conformance.adapter --cuts {{input}} {{cuts}}"


def script(path, word):
    """Return the command line of a script that needs the standard library alone, which starts quickly."""
    return shlex.join([sys.executable, "-I", "-S", str(path), word])


JS_ADAPTER = f"node '{ROOT / 'codec' / 'js' / 'test' / 'adapter.mjs'}' {{input}} {{outdir}}"
needs_node = pytest.mark.skipif(bool(missing_javascript()), reason=f"skipped: {missing_javascript()}")


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    """A folder with the answers of our decoder: files of a vector, with its status and output as JSON next to them."""
    folder = tmp_path_factory.mktemp("decoder")
    for vector in VECTOR_LIST:
        if vector.name in RECORDED:
            outdir = folder / "recorded" / vector.name.split("/")[1]
            outdir.mkdir(parents=True)
            words = io.StringIO()
            with contextlib.redirect_stdout(words):
                status = adapter.main([str(VECTORS / vector.file), str(outdir)])
            outdir.with_suffix(".json").write_text(json.dumps([status, words.getvalue()]))
    (folder / "decoder.py").write_text(FAULTY)
    cuts = {one.name.split("/")[1]: dict(one.expect["cuts"]) for one in VECTOR_LIST if "cuts" in one.expect}
    (folder / "cuts.json").write_text(json.dumps(cuts))
    (folder / "cuts.py").write_text(CUTS)
    return folder


@pytest.fixture(scope="module")
def faulty(recorded):
    """Return a function for a run of our decoder with a fault, on vectors of some names."""

    def run(fault, pattern="valid/quats", **options):
        command = f"{script(recorded / 'decoder.py', fault)} {{input}} {{outdir}}"
        return run_command(command, DecoderSuiteOptions(pattern=pattern, **options))

    return run


@pytest.fixture(scope="module")
def faulty_cuts(recorded):
    """Return a function for the command line of a program for cuts that prints the lines of an expression."""
    return lambda lines: f"{script(recorded / 'cuts.py', lines)} {{input}} {{cuts}}"


@pytest.mark.slow
@pytest.mark.parametrize("adapter", [ADAPTER, pytest.param(JS_ADAPTER, marks=needs_node)], ids=["Python", "JavaScript"])
def test_our_decoders_pass_by_the_protocol_with_codes_clauses_and_offsets_and_names_percent_encoded(adapter):
    report = run_command(adapter, DecoderSuiteOptions(pattern="extreme/extra_names,invalid/quat_radicand", exact=True))
    assert [] == report.failures
    assert {"L1", "L2", "L3"} == set(report.levels())
    assert {"extreme/extra_names", "invalid/quat_radicand"} == {outcome.name for outcome in report.outcomes}


@pytest.mark.slow
def test_our_cuts_pass_by_the_protocol():
    report = run_command(None, DecoderSuiteOptions(pattern="valid/levels", levels=(5,)), cuts=CUT_ADAPTER)
    (one,) = report.outcomes
    assert ("valid/levels", "L5", Status.PASSED, "") == (one.name, one.level, one.status, one.message)


ALL = ("L1", "L2", "L3")
VALID_FAULTS = {
    "crash": (Status.CRASHED, ALL, "signal 11"),
    "hang": (Status.HUNG, ALL, "still running after 1.5 s"),
    "status": (Status.WRONG_STATUS, ALL, "exit status 77"),
    "traceback": (Status.WRONG_ANSWER, ALL, "KeyError: 'tile'"),
    "silent": (Status.NO_OUTPUT, ALL, "nothing was written"),
    "no code": (Status.WRONG_ANSWER, ALL, "without a line of JSON"),
    "refusal": (Status.REFUSED, ALL, "refused"),
    "no header": (Status.WRONG_ANSWER, ("L1",), "no header.json"),
    "header": (Status.WRONG_ANSWER, ALL, "header.json is not a JSON object"),
    "fact": (Status.FAILED, ("L1",), "header.splat_count is 3, expected 5"),
    "missing": (Status.WRONG_ANSWER, ("L2",), "integers.means is missing"),
    "extra": (Status.FAILED, ("L3",), "floats.colours: unexpected array"),
    "unknown file": (Status.WRONG_ANSWER, ALL, "log.txt is not a file of the protocol"),
    "partial": (Status.PARTIAL_OUTPUT, ("L3",), "floats.means has 59 bytes, expected 60"),
    "longer": (Status.FAILED, ("L3",), "floats.means has 61 bytes, expected 60"),
    "rounding": (Status.FAILED, ("L3",), "floats.means differs"),
}
BROKEN_FAULTS = {
    "none": (Status.PASSED, ""),
    "refusal": (Status.PASSED, "by QUA-2, reported E_MAGIC"),
    "leftovers": (Status.PARTIAL_OUTPUT, "refused, but left floats.means.bin"),
    "silent": (Status.FAILED, "accepted"),
    "crash": (Status.CRASHED, "signal 11"),
    "status": (Status.WRONG_STATUS, "exit status 77"),
    "no code": (Status.WRONG_ANSWER, "without a line of JSON"),
}


@pytest.mark.long
def test_a_fault_on_a_valid_or_broken_file_has_an_outcome_of_its_own(faulty):
    def check_valid(fault):
        status, levels, message = VALID_FAULTS[fault]
        found = faulty(fault, timeout=1.5 if fault == "hang" else 60).failures
        assert levels == tuple(outcome.level for outcome in found)
        assert {status} == {outcome.status for outcome in found}
        assert all(message in outcome.message and "QUA-1" in outcome.clauses for outcome in found)

    def check_broken(fault):
        status, message = BROKEN_FAULTS[fault]
        (outcome,) = faulty(fault, "invalid/quat_radicand").outcomes
        assert (status, "L1", "QUA-2") == (outcome.status, outcome.level, outcome.clauses[0])
        assert message in outcome.message

    assert [] == failures({fault: fault for fault in VALID_FAULTS}, check_valid)
    assert [] == failures({fault: fault for fault in BROKEN_FAULTS}, check_broken)


def test_an_exact_run_refuses_another_code_and_a_low_level_ignores_faults_of_higher_levels(faulty):
    report = faulty("refusal", "invalid/quat_radicand", exact=True)
    assert [Status.FAILED] == [outcome.status for outcome in report.outcomes]
    assert faulty("rounding", levels=(1,)).passed


LISTS_OF_SIZES = "without(lambda cut: len(cut.split(' box ')[0].split()) > 2)"
CUT_FAULTS = {
    "lines": (Status.PASSED, ""),
    "sys.exit(77)": (Status.WRONG_STATUS, "exit status 77"),
    "refuse()": (Status.REFUSED, "refused"),
    "[]": (Status.NO_OUTPUT, "0 cuts, expected 40, a line for each"),
    "lines[:-1]": (Status.PARTIAL_OUTPUT, "39 cuts, expected 40"),
    "[*lines, '0']": (Status.FAILED, "41 cuts, expected 40"),
    "[lines[0], 'tile 2', *lines[2:]]": (Status.WRONG_ANSWER, "line 2 is 'tile 2', expected numbers of tiles, or an e"),
    "[lines[0], '1 0', *lines[2:]]": (Status.FAILED, "the cut 'level 1' is 1 0, expected 2"),
    "[''] * len(lines)": (Status.FAILED, "the cut 'level 0' is empty, expected 0 1; 30 of the other 39 cuts are wrong"),
    "[line.replace('LIMIT', 'INPUT') for line in lines]": (Status.FAILED, "'splats 2' is E_INPUT, expected E_LIMIT"),
    "without(lambda cut: 'pixel_size' in cut)": (Status.PASSED, "the decoder offers no cut by pixel_size"),
    LISTS_OF_SIZES: (Status.FAILED, "is E_UNSUPPORTED, expected"),
    "without(lambda cut: ' box ' in cut)": (Status.PASSED, "the decoder offers no cut by box"),
    "without(str)": (Status.SKIPPED, "the decoder offers no cut by box, level, pixel_size, splats"),
}


@pytest.mark.slow
def test_a_fault_of_a_program_for_cuts_has_an_outcome_of_its_own(faulty_cuts):
    def check(fault):
        options = DecoderSuiteOptions(pattern="valid/levels", levels=(5,))
        (outcome,) = run_command(None, options, cuts=faulty_cuts(fault)).outcomes
        status, message = CUT_FAULTS[fault]
        assert ("valid/levels", "L5", status) == (outcome.name, outcome.level, outcome.status)
        assert message in outcome.message
        assert bool(message) == bool(outcome.message)
        assert "TRE-9" in outcome.clauses
        assert outcome.code == ("E_INDEX" if fault == "refuse()" else "")

    assert [] == failures({fault: fault for fault in CUT_FAULTS}, check)
    long_chain = DecoderSuiteOptions(pattern="extreme/levels_chain_of_256", levels=(5,))
    (outcome,) = run_command(None, long_chain, cuts=faulty_cuts(LISTS_OF_SIZES)).outcomes
    assert len(outcome.message) < 300


@pytest.mark.slow
def test_cuts_are_requested_of_valid_files_with_levels_alone(faulty, faulty_cuts):
    chosen = {"pattern": "valid/quats,valid/levels,invalid/level_below", "levels": (1, 5)}
    alone = run_command(None, DecoderSuiteOptions(**chosen), cuts=faulty_cuts("lines"))
    assert [("valid/levels", "L5")] == [(one.name, one.level) for one in alone.outcomes]
    complete = DecoderSuiteOptions()  # L1 to L3, of which a command for cuts shows nothing
    assert "" == run_command(None, complete, cuts=faulty_cuts("lines")).claim
    skipped = [one for one in faulty("refusal", **chosen).outcomes if one.status is Status.SKIPPED]
    assert [("valid/levels", "no command for cuts was given")] == [(one.name, one.message) for one in skipped]


def test_a_refusal_by_our_own_cuts_is_a_failure(monkeypatch):
    monkeypatch.setattr(adapter, "cuts_of", Mock(side_effect=FormatError("E_INDEX", 0, "TRE-5")))
    (failure,) = run_builtin(DecoderSuiteOptions(pattern="valid/levels", levels=(5,))).failures
    assert (Status.REFUSED, "E_INDEX") == (failure.status, failure.code)


MISTAKE = "each accepted one is an error if your decoder reads META (CHK-7)"


@pytest.mark.slow
@pytest.mark.parametrize(("fault", "failed", "notes"), [
    ("none", [], []),
    ("silent", [], ["leaves META unread (CHK-6)", "leaves SERR unread (CHK-6)"]),
    ("believes json_open", ["invalid/json_open"], [f"reads META: 1 refused, 1 accepted: {MISTAKE}: invalid/json_open"]),
])  # fmt: skip
def test_a_decoder_reads_all_payloads_of_a_chunk_type_or_none(faulty, fault, failed, notes):
    report = faulty(fault, ",".join(PAYLOADS))
    assert failed == [outcome.name for outcome in report.failures]
    assert notes == report.notes


@pytest.mark.slow
def test_a_broken_frame_must_be_refused_and_in_an_exact_run_a_broken_payload_too(faulty):
    frames = {"invalid/metadata_crc", "invalid/declared_errors_crc", "invalid/chunk_flags_differ"}
    assert frames == {outcome.name for outcome in faulty("silent", ",".join(frames)).failures}
    assert {*PAYLOADS} == {outcome.name for outcome in faulty("silent", ",".join(PAYLOADS), exact=True).failures}


def test_a_larger_budget_for_texts_does_not_show_that_they_are_left_unread():
    vectors = [vector for vector in VECTOR_LIST if vector.error and vector.error["optional"] == "META"]
    answers = {code: Answer(status, code=code) for code, status in (("", Status.PASSED), ("E_JSON", Status.REFUSED))}
    outcomes = [
        compare_answer(one, answers["" if one.error["code"] == "E_LIMIT" else "E_JSON"], (1,))[0] for one in vectors
    ]
    assert (outcomes, []) == check_payload_consistency(outcomes)


@pytest.mark.parametrize(
    "command", ["my-decoder-that-is-not-there {input} {outdir}", "decoder {input}", "", "'decoder"]
)
def test_a_command_that_cannot_be_run_is_refused_at_once(command):
    with pytest.raises(InputError):
        run_command(command, DecoderSuiteOptions(pattern="valid/quats"))
    with pytest.raises(InputError):
        run_command(None, DecoderSuiteOptions(pattern="valid/levels"), cuts=command)


@pytest.mark.parametrize(("choice", "message"), [
    ({"levels": ()}, r"the levels are \[\]"),
    ({"levels": (7,)}, r"the levels are \[7\]"),
    ({"timeout": 0}, "the timeout is 0 s"),
    ({"jobs": 0}, "the number of jobs is 0"),
    ({"by": "fast"}, "the class of decoders is 'fast'"),
    ({"resource_level": "D"}, "limit resource_level is 'D'"),
    ({"pattern": "valid/*,nothing"}, "no vector matches 'nothing'"),
    ({"pattern": "valid/*,"}, "no vector matches ''"),
    ({"clause": "M"}, "no clause of a vector matches 'M'"),
])  # fmt: skip
def test_contradictory_choices_and_patterns_that_match_nothing_are_refused(choice, message):
    with pytest.raises(InputError, match=message):
        run_builtin(DecoderSuiteOptions(**choice))


@pytest.mark.slow
def test_a_complete_run_ends_with_a_line_that_says_what_the_decoder_may_claim():
    report = run_builtin(DecoderSuiteOptions())
    words = (
        rf"conforms to csplat \d+\.\d+ as a decoder, exact, resource level C \(suite {SUITE_VERSION}, [\d,]+ checks\)"
    )
    assert re.fullmatch(words, to_table(report).splitlines()[-1])
    assert report.badge == to_json(report)["badge"]
    assert "" == replace(report, outcomes=[replace(report.outcomes[0], status=Status.FAILED)]).badge
    for part in ({"pattern": "valid/quats"}, {"clause": "HDR-1"}, {"pattern": "valid/quats", "levels": (1, 2)}):
        report = run_builtin(DecoderSuiteOptions(**part))
        assert ([], "") == (report.failures, report.badge)


def test_a_decoder_of_a_resource_level_refuses_files_of_higher_levels():
    options = DecoderSuiteOptions(pattern="*/resource_level*,valid/quats,render/*", resource_level="A")
    report = run_builtin(options)
    assert [] == report.failures
    assert 1 == len([outcome for outcome in report.outcomes if outcome.name == "extreme/resource_level_c"])
    report = run_builtin(replace(options, resource_level="B"))
    assert ["extreme/resource_level_b"] * 3 == [o.name for o in report.outcomes if o.name == "extreme/resource_level_b"]


@pytest.mark.slow
def test_vectors_are_chosen_by_clause_or_chapter_of_clauses():
    def names(clause):
        return {outcome.name for outcome in run_builtin(DecoderSuiteOptions(clause=clause, levels=(1,))).outcomes}

    def about(chapter):
        return {one.name for one in VECTOR_LIST if any(name.startswith(chapter) for name in one.clauses)}

    assert about("MOR") == names("MOR") == names("MOR-*")
    assert about("MOR") | about("COV") == names("MOR, COV")


@pytest.mark.slow
@pytest.mark.parametrize(("fault", "by", "message"), [
    ("2 ulp", "renderer", ""),
    ("3 ulp", "renderer", "floats.means: 15 of 15 values are too far"),
    ("2 ulp", "exact", "floats.means differs"),
    ("missing", "renderer", "integers.means is missing"),
    ("longer", "renderer", "61 bytes, expected 60"),
])  # fmt: skip
def test_the_class_sets_the_tolerance_of_floats(faulty, fault, by, message):
    report = faulty(fault, by=by)
    assert [message in outcome.message for outcome in report.failures] == ([True] if message else [])
    assert (["compared with the tolerances of the class renderer"] if by == "renderer" else []) == [*report.notes]


def test_patterns_of_the_guides_match_vectors():
    guides = ("conformance/IMPLEMENTERS.md", "conformance/README.md", "CONTRIBUTING.md")
    text = "\n".join((ROOT / guide).read_text(encoding="utf-8") for guide in guides)
    words = {*re.findall(r"--filter ('[^']+'|[\w/,*-]+)", text), *re.findall(r"(?:valid|extreme|invalid)/\w+\*?", text)}
    names = [vector.name for vector in VECTOR_LIST] + [one.name for one in all_inputs()]
    names += [clause for vector in VECTOR_LIST for clause in vector.clauses]

    def check(word):
        assert select_names(word.strip("'"), names, "filter")

    assert len(words) > 25
    assert [] == failures({word: word for word in words}, check)


def test_the_built_in_run_passes_a_vector_once_per_level():
    report = run_builtin(DecoderSuiteOptions(pattern="*/quat*,valid/rich"))
    names = [vector.name for vector in VECTOR_LIST if vector.name.split("/")[1].startswith(("quat", "rich"))]
    valid = [name for name in names if not name.startswith("invalid/")]
    assert [] == report.failures
    for level, passed in (("L1", names), ("L2", valid), ("L3", valid)):
        assert passed == [one.name for one in report.outcomes if one.level == level]


@pytest.mark.slow
def test_cuts_are_those_of_the_manifest():
    report = run_builtin(DecoderSuiteOptions(levels=(5,)))
    assert [] == report.failures
    assert {"L5"} == {one.level for one in report.outcomes}
    about = {vector.name for vector in VECTOR_LIST if "TRE-9" in vector.clauses and not vector.error}
    assert about <= {one.name for one in report.outcomes}


def test_a_wrong_hash_or_an_accepted_broken_file_fails_the_run(monkeypatch):
    vector = NAMED["valid/quats"]
    digest = vector.expect["floats"]["quats"]
    wrong = vector.expect | {"floats": vector.expect["floats"] | {"quats": [*digest[:2], "0" * 64]}}
    error = {"code": "E_RANGE", "clause": "QUA-2", "offset": 0, "also": [], "optional": ""}
    for change, level, message, clause in (
        ({"expect": wrong}, "L3", "floats.quats differs", "QUA-1"),
        ({"expect": {}, "error": error}, "L1", "accepted", "QUA-2"),
    ):
        monkeypatch.setattr(decoder_suite, "load", Mock(return_value=[replace(vector, **change)]))
        (failure,) = run_builtin().failures
        assert (Status.FAILED, level, message) == (failure.status, failure.level, failure.message)
        assert clause in failure.clauses


def test_differing_decoding_functions_fail_the_run(monkeypatch):
    monkeypatch.setattr(csplat.decoder, "decode_integers", csplat.decoder.decode)
    assert run_builtin(DecoderSuiteOptions(pattern="invalid/quat_radicand")).passed
    refuse = Mock(side_effect=FormatError("E_RANGE", 0, "QUA-2"))
    monkeypatch.setattr(csplat.decoder, "decode_integers", refuse)
    failure = run_builtin(DecoderSuiteOptions(pattern="valid/quats")).failures[0]
    assert "decode and decode_integers differ: accepted; E_RANGE" in failure.message


def test_a_level_includes_the_lower_levels_and_a_list_names_its_own():
    texts = {"1": (1,), "3": (1, 2, 3), "1,3": (1, 3), "L4": (1, 2, 3, 4), "5": (1, 2, 3, 4, 5), "3,1": (1, 3)}
    assert texts == {text: parse_levels(text) for text in texts}
    for text in ("0", "6", "x", "1,9", ""):
        with pytest.raises(InputError):
            parse_levels(text)
    result = invoke("--level", "9")
    assert (2, 1) == (result.exit_code, len(result.stderr.splitlines()))


def invoke(*words):
    return CliRunner().invoke(app, ["conformance", "decoder", *map(str, words)])


@pytest.mark.slow
def test_the_command_writes_table_json_and_junit(recorded, tmp_path):
    command = f"{script(recorded / 'decoder.py', 'rounding')} {{input}} {{outdir}}"
    quats, reports = ("--filter", "valid/quats"), ("--report", tmp_path / "r.json", "--junit", tmp_path / "r.xml")
    result = invoke("--cmd", command, *quats, *reports)
    assert 1 == result.exit_code
    assert "L3  FAILED  valid/quats  floats.means differs" in result.stdout
    found = json.loads((tmp_path / "r.json").read_text())
    assert (False, 1) == (found["passed"], found["levels"]["L3"]["failed"])
    suites = ET.parse(tmp_path / "r.xml").getroot()  # noqa: S314 - ours
    assert ("3", "1") == (suites.get("tests"), suites.get("failures"))
    assert "exists" in invoke(*quats, *reports).stderr
    assert 0 == invoke(*quats, *reports, "--force").exit_code
    assert invoke(*quats, "--junit", "-").stdout.startswith("<?xml")
    assert 2 == invoke(*quats, "--json", "--junit", "-").exit_code


def test_a_filter_repeats_and_combines_patterns_of_names_and_of_clauses():
    def chosen(*words):
        report = json.loads(invoke(*words, "--level", "1", "--json").stdout)
        return {outcome["name"] for outcome in report["outcomes"]}

    valid = {vector.name for vector in VECTOR_LIST if "MOR-1" in vector.clauses and vector.name.startswith("valid/")}
    repeated = ("--filter", "valid/quats,valid/one_*", "--filter", "valid/rich")
    assert {"valid/one_splat", "valid/quats", "valid/rich"} == chosen(*repeated)
    assert valid == chosen("--filter", "valid/*", "--filter", "MOR-1,LIM")
    assert "no vector is chosen" in invoke("--filter", "valid/empty,MOR-*").stderr


def test_a_command_for_cuts_alone_is_tested_at_l5_alone(faulty_cuts):
    result = invoke("--cmd", faulty_cuts("lines[::-1]"), "--filter", "valid/levels,valid/rich", "--json")
    assert 1 == result.exit_code
    assert {"L5"} == {outcome["level"] for outcome in json.loads(result.stdout)["outcomes"]}
    assert 0 == invoke("--filter", "valid/levels", "--level", "5").exit_code  # our own


def test_reports_for_one_place_are_refused_before_anything_runs(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    command = f"touch {tmp_path / 'ran'}"
    result = invoke("--cmd", command + " {input} {outdir}", "--report", "same.json", "--junit", "same.json")
    assert 1 == result.exit_code
    assert "is given for two outputs" in result.stderr
    assert [] == list(tmp_path.iterdir())

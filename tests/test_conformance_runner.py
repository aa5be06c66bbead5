"""The conformance runner against decoders that are correct, misbehave, or have a planted fault."""

import contextlib
import io
import json
import re
import sys
import xml.etree.ElementTree as ET  # only our own output is parsed
from pathlib import Path

import pytest
from tables import failures
from typer.testing import CliRunner

from csplat.errors import FormatError, InputError
from csplat_conformance import adapter
from csplat_conformance.answers import PARTS, Answer, check_payload_consistency, compare_answer
from csplat_conformance.conformance_report import Status
from csplat_conformance.decoder_suite import DecoderSuiteOptions, parse_levels, run_builtin, run_command
from csplat_conformance.encoders.encoder_inputs import all_inputs
from csplat_conformance.manifest import VECTORS, load, select_names
from csplat_selftest.decoder_processes import JsDecoder, missing_javascript
from csplat_tools.cli.app import app

ROOT = Path(__file__).resolve().parent.parent
ADAPTER = f"{sys.executable} -m csplat_conformance.adapter {{input}} {{outdir}}"
CUT_ADAPTER = f"{sys.executable} -m csplat_conformance.adapter --cuts {{input}} {{cuts}}"
JS_ADAPTER = f"node '{ROOT / 'codec' / 'js' / 'test' / 'adapter.mjs'}' {{input}} {{outdir}}"

needs_node = pytest.mark.skipif(bool(missing_javascript()), reason=f"skipped: {missing_javascript()}")
#: Tests of the suite itself: they run when it changes.
in_depth = pytest.mark.long

VECTOR_LIST = load()

# Recorded answers of our decoder by the protocol, with a selectable fault; no slow imports.
FAULTY = """
import json, os, pathlib, shutil, signal, struct, sys, time

fault, source, outdir = sys.argv[1], sys.argv[2], pathlib.Path(sys.argv[3])
if fault == "crash":
    os.kill(os.getpid(), signal.SIGSEGV)
if fault == "hang":
    time.sleep(60)
if fault == "status":
    sys.exit(77)
if fault == "traceback":
    raise KeyError("tile")
if fault == "silent" or (fault == "believes json_open" and "json_open." in source):
    sys.exit(0)
if fault == "no code":
    print("it is broken")
    sys.exit(1)
if fault == "refusal":
    print(json.dumps({"code": "E_MAGIC"}))
    sys.exit(1)
recorded = pathlib.Path(__file__).parent / "recorded" / pathlib.Path(source).stem
status, words = json.loads(recorded.with_suffix(".json").read_text())
sys.stdout.write(words)
for path in recorded.iterdir():
    shutil.copy(path, outdir)
means = outdir / "floats.means.bin"
if fault == "leftovers":
    means.write_bytes(b"part")
if fault == "no header":
    (outdir / "header.json").unlink()
if fault == "header":
    (outdir / "header.json").write_text("[]")
if fault == "fact":
    facts = json.loads((outdir / "header.json").read_text())
    (outdir / "header.json").write_text(json.dumps(facts | {"splat_count": 3}))
if fault == "missing":
    (outdir / "integers.means.bin").unlink()
if fault == "extra":
    (outdir / "floats.colours.bin").write_bytes(b"")
if fault == "unknown file":
    (outdir / "log.txt").write_text("done")
if fault == "partial":
    means.write_bytes(means.read_bytes()[:-1])
if fault == "longer":
    means.write_bytes(means.read_bytes() + b"0")
if fault == "rounding":
    raw = bytearray(means.read_bytes())
    raw[0] ^= 1
    means.write_bytes(raw)
if fault in ("2 ulp", "3 ulp"):
    bits = [value + int(fault[0]) for (value,) in struct.iter_unpack("<I", means.read_bytes())]
    means.write_bytes(struct.pack(f"<{len(bits)}I", *bits))
sys.exit(status)
"""

# The cuts of the manifest, with a selectable fault.
FAULTY_CUTS = """
import json, pathlib, sys

fault, source, cuts = sys.argv[1:]
known = json.loads((pathlib.Path(__file__).parent / "cuts.json").read_text())[pathlib.Path(source).stem]
lines = []
for cut in pathlib.Path(cuts).read_text().splitlines():
    tiles = known[cut]
    lines.append(tiles if isinstance(tiles, str) else " ".join(map(str, tiles)))
if fault == "status":
    sys.exit(77)
if fault == "refusal":
    print(json.dumps({"code": "E_INDEX", "clause": "TRE-5"}))
    sys.exit(1)
if fault == "silent":
    lines = []
if fault == "short":
    del lines[-1]
if fault == "long":
    lines.append("0")
if fault == "words":
    lines[1] = "tile 2"
if fault == "one wrong":
    lines[1] = "1 0"
if fault == "empty cuts":
    lines = [""] * len(lines)
if fault == "no error code":
    lines = ["E_INPUT" if line == "E_LIMIT" else line for line in lines]
if fault == "no sizes":
    lines = ["E_UNSUPPORTED" if "pixel_size" in cut else line for cut, line in zip(known, lines)]
if fault == "no list of sizes":
    lines = ["E_UNSUPPORTED" if len(cut.split(" box ")[0].split()) > 2 else line for cut, line in zip(known, lines)]
if fault == "no boxes":
    lines = ["E_UNSUPPORTED" if " box " in cut else line for cut, line in zip(known, lines)]
if fault == "no cuts":
    lines = ["E_UNSUPPORTED"] * len(lines)
for line in lines:
    print(line)
"""

#: Vectors whose answers are recorded.
RECORDED = (
    "valid/quats",
    *(
        f"invalid/{name}"
        for name in ("quat_radicand", "json_open", "json_surrogate", "json_beyond_budget", "error_counts")
    ),
)


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
    (folder / "cuts.py").write_text(FAULTY_CUTS)
    return folder


@pytest.fixture(scope="module")
def faulty(recorded):
    """Return a function for the command line of our decoder with a fault."""
    return lambda fault: f"{sys.executable} -I -S {recorded / 'decoder.py'} '{fault}' {{input}} {{outdir}}"


@pytest.fixture(scope="module")
def faulty_cuts(recorded):
    """Return a function for the command line of a program for cuts with a fault."""
    return lambda fault: f"{sys.executable} -I -S {recorded / 'cuts.py'} '{fault}' {{input}} {{cuts}}"


@pytest.mark.slow
def test_our_decoder_passes_by_the_protocol_with_codes_clauses_and_offsets_and_names_percent_encoded():
    report = run_command(ADAPTER, DecoderSuiteOptions(pattern="extreme/extra_names,invalid/transforms_gap", exact=True))

    assert [] == report.failures
    assert {"L1", "L2", "L3"} == set(report.levels())
    assert {"extreme", "invalid"} == {outcome.name.split("/")[0] for outcome in report.outcomes}


@pytest.mark.slow
def test_our_cuts_pass_by_the_protocol():
    report = run_command(None, DecoderSuiteOptions(pattern="valid/levels", levels=(5,)), cuts=CUT_ADAPTER)

    assert [("valid/levels", "L5", Status.PASSED, "")] == [
        (one.name, one.level, one.status, one.message) for one in report.outcomes
    ]


@needs_node
@pytest.mark.slow
def test_the_javascript_decoder_passes_by_the_protocol():
    # One vector for each kind of answer of its adapter; the next test runs all vectors, in one process.
    names = ["extreme/extra_names", "invalid/quat_radicand"]
    report = run_command(JS_ADAPTER, DecoderSuiteOptions(pattern=",".join(names), exact=True))

    assert {*names} == {outcome.name for outcome in report.outcomes}
    assert [] == report.failures


@needs_node
@pytest.mark.slow
@in_depth  # `node --test codec/js/test/conformance.test.mjs` reads every vector, too
def test_the_javascript_decoder_answers_every_vector_by_the_manifest():
    with JsDecoder() as decoder:
        judged = {
            vector.name: compare_answer(vector, decoder.ask(vector.data), tuple(PARTS), exact=True)
            for vector in VECTOR_LIST
        }

    assert [] == [one for outcomes in judged.values() for one in outcomes if one.status is not Status.PASSED]
    assert all(judged.values())


VALID_FAULTS = {
    "crash": (Status.CRASHED, ("L1", "L2", "L3"), "signal 11"),
    "hang": (Status.HUNG, ("L1", "L2", "L3"), "still running after 1.5 s"),
    "status": (Status.WRONG_STATUS, ("L1", "L2", "L3"), "exit status 77"),
    "traceback": (Status.WRONG_ANSWER, ("L1", "L2", "L3"), "KeyError: 'tile'"),
    "silent": (Status.NO_OUTPUT, ("L1", "L2", "L3"), "nothing was written"),
    "no code": (Status.WRONG_ANSWER, ("L1", "L2", "L3"), "without a line of JSON"),
    "refusal": (Status.REFUSED, ("L1", "L2", "L3"), "refused"),
    "no header": (Status.WRONG_ANSWER, ("L1",), "no header.json"),
    "header": (Status.WRONG_ANSWER, ("L1", "L2", "L3"), "header.json is not a JSON object"),
    "fact": (Status.FAILED, ("L1",), "header.splat_count is 3, expected 5"),
    "missing": (Status.WRONG_ANSWER, ("L2",), "integers.means is missing"),
    "extra": (Status.FAILED, ("L3",), "floats.colours: unexpected array"),
    "unknown file": (Status.WRONG_ANSWER, ("L1", "L2", "L3"), "log.txt is not a file of the protocol"),
    "partial": (Status.PARTIAL_OUTPUT, ("L3",), "floats.means has 59 bytes, expected 60"),
    "longer": (Status.FAILED, ("L3",), "floats.means has 61 bytes, expected 60"),
    "rounding": (Status.FAILED, ("L3",), "floats.means differs"),
}


@in_depth
def test_a_fault_on_a_valid_file_has_an_outcome_of_its_own(faulty):
    def check(fault):
        status, levels, message = VALID_FAULTS[fault]
        report = run_command(
            faulty(fault), DecoderSuiteOptions(pattern="valid/quats", timeout=1.5 if fault == "hang" else 60)
        )
        assert levels == tuple(outcome.level for outcome in report.failures)
        assert {status} == {outcome.status for outcome in report.failures}
        assert all(message in outcome.message for outcome in report.failures)
        assert all("QUA-1" in outcome.clauses for outcome in report.failures)

    assert [] == failures({fault: fault for fault in VALID_FAULTS}, check)


BROKEN_FAULTS = {
    "none": (Status.PASSED, ""),
    "refusal": (Status.PASSED, "by QUA-2, reported E_MAGIC"),
    "leftovers": (Status.PARTIAL_OUTPUT, "refused, but left floats.means.bin"),
    "silent": (Status.FAILED, "accepted"),
    "crash": (Status.CRASHED, "signal 11"),
    "status": (Status.WRONG_STATUS, "exit status 77"),
    "no code": (Status.WRONG_ANSWER, "without a line of JSON"),
}


@in_depth
def test_a_fault_on_a_broken_file_has_an_outcome_of_its_own(faulty):
    def check(fault):
        status, message = BROKEN_FAULTS[fault]
        (outcome,) = run_command(faulty(fault), DecoderSuiteOptions(pattern="invalid/quat_radicand")).outcomes
        assert (status, "L1", "QUA-2") == (outcome.status, outcome.level, outcome.clauses[0])
        assert message in outcome.message

    assert [] == failures({fault: fault for fault in BROKEN_FAULTS}, check)


def test_another_code_fails_an_exact_run(faulty):
    report = run_command(faulty("refusal"), DecoderSuiteOptions(pattern="invalid/quat_radicand", exact=True))

    assert [Status.FAILED] == [outcome.status for outcome in report.outcomes]


@in_depth
def test_a_broken_payload_may_be_accepted_by_decoders_that_leave_it_unread(faulty):
    names = ["json_open", "json_coded_garbage", "json_beyond_budget", "error_counts"]
    pattern = ",".join(f"invalid/{name}" for name in names)

    assert run_command(faulty("silent"), DecoderSuiteOptions(pattern=pattern)).passed
    assert len(names) == len(run_command(faulty("silent"), DecoderSuiteOptions(pattern=pattern, exact=True)).failures)


CUT_FAULTS = {
    "none": (Status.PASSED, ""),
    "status": (Status.WRONG_STATUS, "exit status 77"),
    "refusal": (Status.REFUSED, "refused"),
    "silent": (Status.NO_OUTPUT, "0 cuts, expected 40, a line for each"),
    "short": (Status.PARTIAL_OUTPUT, "39 cuts, expected 40"),
    "long": (Status.FAILED, "41 cuts, expected 40"),
    "words": (Status.WRONG_ANSWER, "line 2 is 'tile 2', expected numbers of tiles, or an error code"),
    "one wrong": (Status.FAILED, "the cut 'level 1' is 1 0, expected 2"),
    "empty cuts": (Status.FAILED, "the cut 'level 0' is empty, expected 0 1; 30 of the other 39 cuts are wrong, too"),
    "no error code": (Status.FAILED, "the cut 'splats 2' is E_INPUT, expected E_LIMIT"),
    "no sizes": (Status.PASSED, "the decoder offers no cut by pixel_size"),
    "no list of sizes": (Status.FAILED, "is E_UNSUPPORTED, expected"),
    "no boxes": (Status.PASSED, "the decoder offers no cut by box"),
    "no cuts": (Status.SKIPPED, "the decoder offers no cut by box, level, pixel_size, splats"),
}


def test_a_fault_of_a_program_for_cuts_has_an_outcome_of_its_own(faulty_cuts):
    def check(fault):
        options = DecoderSuiteOptions(pattern="valid/levels", levels=(5,))
        (outcome,) = run_command(None, options, cuts=faulty_cuts(fault)).outcomes
        status, message = CUT_FAULTS[fault]
        assert ("valid/levels", "L5", status) == (outcome.name, outcome.level, outcome.status)
        assert message in outcome.message
        assert bool(message) == bool(outcome.message)
        assert "TRE-9" in outcome.clauses
        assert outcome.code == ("E_INDEX" if fault == "refusal" else "")

    assert [] == failures({fault: fault for fault in CUT_FAULTS}, check)


def test_long_cuts_are_shortened_in_messages(faulty_cuts):
    options = DecoderSuiteOptions(pattern="extreme/levels_chain_of_256", levels=(5,))
    (outcome,) = run_command(None, options, cuts=faulty_cuts("no list of sizes")).outcomes

    assert Status.FAILED is outcome.status
    assert len(outcome.message) < 300


def test_cuts_are_requested_of_valid_files_with_levels_alone(faulty, faulty_cuts):
    options = DecoderSuiteOptions(pattern="valid/quats,valid/levels,invalid/level_below", levels=(1, 5))

    alone = run_command(None, options, cuts=faulty_cuts("none"))
    assert [("valid/levels", "L5")] == [(one.name, one.level) for one in alone.outcomes]
    without = run_command(faulty("refusal"), options)
    assert [("valid/levels", "no command for cuts was given")] == [
        (one.name, one.message) for one in without.outcomes if one.status is Status.SKIPPED
    ]


def test_a_refusal_by_our_own_cuts_is_a_failure(monkeypatch):
    def refuse(*_):
        raise FormatError("E_INDEX", 0, "TRE-5")

    monkeypatch.setattr(adapter, "cuts_of", refuse)
    (failure,) = run_builtin(DecoderSuiteOptions(pattern="valid/levels", levels=(5,))).failures

    assert (Status.REFUSED, "E_INDEX") == (failure.status, failure.code)


MISTAKE = "each accepted one is an error if your decoder reads META (CHK-7)"


@pytest.mark.parametrize(
    ("fault", "failed", "notes"),
    [
        ("none", [], []),
        ("silent", [], ["leaves META unread (CHK-6)", "leaves SERR unread (CHK-6)"]),
        (
            "believes json_open",
            ["invalid/json_open"],
            [f"reads META: 1 refused, 1 accepted: {MISTAKE}: invalid/json_open"],
        ),
    ],
)
def test_of_each_type_of_chunk_a_decoder_reads_every_payload_or_none(faulty, fault, failed, notes):
    names = ("json_open", "json_surrogate", "json_beyond_budget", "error_counts")
    report = run_command(faulty(fault), DecoderSuiteOptions(pattern=",".join(f"invalid/{name}" for name in names)))

    assert failed == [outcome.name for outcome in report.failures]
    assert notes == report.notes


def test_a_larger_budget_for_texts_does_not_show_that_they_are_left_unread():
    vectors = [vector for vector in VECTOR_LIST if vector.error and vector.error["optional"] == "META"]
    answers = {code: Answer(status, code=code) for code, status in (("", Status.PASSED), ("E_JSON", Status.REFUSED))}
    outcomes = [
        compare_answer(one, answers["" if one.error["code"] == "E_LIMIT" else "E_JSON"], (1,))[0] for one in vectors
    ]

    assert (outcomes, []) == check_payload_consistency(outcomes)


def test_clauses_on_payloads_have_vectors_for_each_type_that_may_be_left_unread():
    assert {"META", "CAMS", "OPTS", "SERR"} == {one.error["optional"] for one in VECTOR_LIST if one.error} - {""}


def test_a_broken_frame_of_an_unread_chunk_has_to_be_refused(faulty):
    names = ["metadata_crc", "stated_errors_crc", "chunk_flags_differ", "metadata_twice"]
    report = run_command(faulty("silent"), DecoderSuiteOptions(pattern=",".join(f"invalid/{name}" for name in names)))

    assert sorted(f"invalid/{name}" for name in names) == sorted(outcome.name for outcome in report.failures)


@pytest.mark.parametrize(
    ("text", "levels"),
    [("1", (1,)), ("3", (1, 2, 3)), ("1,3", (1, 3)), ("L4", (1, 2, 3, 4)), ("5", (1, 2, 3, 4, 5)), ("3,1", (1, 3))],
)
def test_levels_are_all_up_to_one_or_those_named(text, levels):
    assert levels == parse_levels(text)


@pytest.mark.parametrize("text", ["0", "6", "x", "1,9", ""])
def test_other_levels_are_refused(text):
    with pytest.raises(InputError):
        parse_levels(text)


@pytest.mark.parametrize(
    "command", ["my-decoder-that-is-not-there {input} {outdir}", "decoder {input}", "", "'decoder {input} {outdir}"]
)
def test_a_command_that_cannot_be_run_is_refused_at_once(command):
    with pytest.raises(InputError):
        run_command(command, DecoderSuiteOptions(pattern="valid/quats"))


@pytest.mark.parametrize("command", ["my-cuts {input}", "my-cuts {input} {outdir}"])
def test_a_command_for_cuts_that_cannot_be_run_is_refused_at_once(command):
    with pytest.raises(InputError):
        run_command(None, DecoderSuiteOptions(pattern="valid/levels"), cuts=command)


@pytest.mark.parametrize("wrong", [{"levels": ()}, {"levels": (7,)}, {"timeout": 0}, {"jobs": 0}, {"by": "fast"}])
def test_contradictory_choices_are_refused(wrong):
    with pytest.raises(InputError):
        DecoderSuiteOptions(**wrong)


def test_levels_select_the_checks(faulty):
    at_1 = run_command(faulty("rounding"), DecoderSuiteOptions(pattern="valid/quats", levels=(1,)))
    at_3 = run_command(faulty("rounding"), DecoderSuiteOptions(pattern="valid/quats", levels=(3,)))

    assert (True, False) == (at_1.passed, at_3.passed)


def test_vectors_are_chosen_by_clause():
    names = {outcome.name for outcome in run_builtin(DecoderSuiteOptions(clause="MOR-*", levels=(1,))).outcomes}

    assert {
        vector.name for vector in VECTOR_LIST if any(clause.startswith("MOR-") for clause in vector.clauses)
    } == names


def test_a_pattern_may_name_a_chapter_of_clauses():
    def names(clause):
        return [outcome.name for outcome in run_builtin(DecoderSuiteOptions(clause=clause, levels=(1,))).outcomes]

    assert names("MOR") == names("MOR-*")
    assert len(names("MOR, COV")) == len({*names("MOR-*"), *names("COV-*")})


@pytest.mark.parametrize(
    ("choice", "message"),
    [
        (DecoderSuiteOptions(pattern="valid/*,nothing"), "no vector matches 'nothing'"),
        (DecoderSuiteOptions(pattern="valid/*,"), "no vector matches ''"),
        (DecoderSuiteOptions(clause="M"), "no clause of a vector matches 'M'"),
    ],
)
def test_a_pattern_that_matches_nothing_is_named(choice, message):
    with pytest.raises(InputError, match=message):
        run_builtin(choice)


@pytest.mark.parametrize(
    ("fault", "by", "message"),
    [
        ("2 ulp", "renderer", ""),
        ("3 ulp", "renderer", "floats.means: 15 of 15 values are too far"),
        ("2 ulp", "exact", "floats.means differs"),
        ("missing", "renderer", "integers.means is missing"),
        ("longer", "renderer", "61 bytes, expected 60"),
    ],
)
def test_the_class_sets_the_tolerance_of_floats(faulty, fault, by, message):
    report = run_command(faulty(fault), DecoderSuiteOptions(pattern="valid/quats", by=by))

    assert [message in outcome.message for outcome in report.failures] == ([True] if message else [])


@pytest.mark.parametrize("by", ["renderer", "exact"])
def test_a_report_names_the_class_that_is_not_exact(by):
    report = run_builtin(DecoderSuiteOptions(pattern="valid/quats", by=by))

    assert (["compared with the tolerances of the class renderer"] if by == "renderer" else []) == [*report.notes]


# The command ---------------------------------------------------------------------------------------
def invoke(*words):
    return CliRunner().invoke(app, ["conformance", "decoder", *map(str, words)])


@pytest.mark.slow
def test_the_command_writes_table_json_and_junit(faulty, tmp_path):
    reports = ("--report", tmp_path / "r.json", "--junit", tmp_path / "r.xml")
    result = invoke("--cmd", faulty("rounding"), "--filter", "valid/quats", *reports)

    assert 1 == result.exit_code
    assert "L3  FAILED  valid/quats  floats.means differs" in result.stdout
    found = json.loads((tmp_path / "r.json").read_text())
    assert (False, 1) == (found["passed"], found["levels"]["L3"]["failed"])
    suites = ET.parse(tmp_path / "r.xml").getroot()  # noqa: S314 - ours
    assert ("3", "1") == (suites.get("tests"), suites.get("failures"))
    assert "exists" in invoke("--filter", "valid/quats", *reports).stderr
    assert 0 == invoke("--filter", "valid/quats", *reports, "--force").exit_code


def test_one_report_may_be_written_to_standard_output():
    assert json.loads(invoke("--filter", "valid/quats", "--json").stdout)["passed"]
    assert invoke("--filter", "valid/quats", "--junit", "-").stdout.startswith("<?xml")
    assert 2 == invoke("--filter", "valid/quats", "--json", "--junit", "-").exit_code


def test_a_filter_may_repeat_and_hold_several_patterns():
    result = invoke("--filter", "valid/quats,valid/one_*", "--filter", "valid/rich", "--level", "1", "--json")

    names = [outcome["name"] for outcome in json.loads(result.stdout)["outcomes"]]
    assert ["valid/one_splat", "valid/quats", "valid/rich"] == names


def test_a_vector_matches_names_and_clauses_of_a_filter():
    report = invoke("--filter", "valid/*", "--filter", "MOR-1,LIM", "--level", "1", "--json").stdout
    names = {outcome["name"] for outcome in json.loads(report)["outcomes"]}

    assert {
        vector.name for vector in VECTOR_LIST if "MOR-1" in vector.clauses and vector.name.startswith("valid/")
    } == names
    assert "no vector is chosen" in invoke("--filter", "valid/empty,MOR-*").stderr


def _recommended():
    """Options as the guides write them, in a shell's words."""
    guides = ("conformance/IMPLEMENTERS.md", "conformance/README.md", "CONTRIBUTING.md")
    text = "\n".join((ROOT / guide).read_text(encoding="utf-8") for guide in guides)
    return sorted(set(re.findall(r"--filter ('[^']+'|[\w/,*-]+)", text)))


def test_patterns_of_the_guides_match_vectors():
    """A word without quotes must mean the same to a shell."""
    names = [vector.name for vector in VECTOR_LIST] + [one.name for one in all_inputs()]
    names += [clause for vector in VECTOR_LIST for clause in vector.clauses]

    def check(word):
        assert word.startswith("'") or "*" not in word
        assert select_names(word.strip("'"), names, "filter")

    recommended = _recommended()
    assert len(recommended) > 15
    assert [] == failures({word: word for word in recommended}, check)


def test_a_command_for_cuts_alone_is_tested_at_l5_alone(faulty_cuts):
    words = ("--cmd", faulty_cuts("one wrong"), "--filter", "valid/levels*", "--json")
    result = invoke(*words)

    assert 1 == result.exit_code
    assert {"L5"} == {outcome["level"] for outcome in json.loads(result.stdout)["outcomes"]}
    assert 0 == invoke("--filter", "valid/levels", "--level", "5").exit_code  # our own


def test_an_invalid_level_is_reported_in_one_line():
    result = invoke("--level", "9")

    assert (2, 1) == (result.exit_code, len(result.stderr.splitlines()))


def test_reports_for_one_place_are_refused_before_anything_runs(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    command = f"touch {tmp_path / 'ran'}"
    result = invoke("--cmd", command + " {input} {outdir}", "--report", "same.json", "--junit", "same.json")
    assert 1 == result.exit_code
    assert "is given for two outputs" in result.stderr
    assert [] == list(tmp_path.iterdir())

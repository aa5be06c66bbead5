"""The encoder suite's runs of a program and its verdicts on the file, and their form in reports."""

import itertools
import json
import re
import shlex
import sys
import types
import xml.etree.ElementTree as ET
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from unittest import mock

import numpy as np
import pytest
from tables import failures
from typer.testing import CliRunner

import csplat
from csplat.decoder import decode_scene
from csplat.encoder import quantisation, shape_codebook
from csplat_conformance.conformance_report import ConformanceReport, Outcome, Status, to_json, to_junit, to_table
from csplat_conformance.declared_bounds import Source, measure_pairs, verify_bounds
from csplat_conformance.encoders import EncoderSuiteOptions, all_inputs, run_encoder, write_inputs
from csplat_conformance.encoders.error_checks import check_errors, find_truncation
from csplat_conformance.encoders.file_checks import check_content, pair_splats
from csplat_conformance.protocol import ProcessEnd, run_program
from csplat_tools.cli.app import app

pytestmark = pytest.mark.long

INPUTS = {one.name: one for one in all_inputs()}
COMMAND = "encoder {ply} {out} {index}"
PLAIN = "ordinary/degree_1"
FILES = EncoderSuiteOptions(PLAIN, ("L1",), jobs=1)
MAPS = EncoderSuiteOptions(PLAIN, ("L2",), jobs=1)


def invoke(*words):
    return CliRunner().invoke(app, ["conformance", "encoder", *map(str, words)])


def program(code):
    """Return a command line that runs Python code on {ply} and {out}."""
    return f"{shlex.quote(sys.executable)} -c {shlex.quote(code)} {{ply}} {{out}}"


@pytest.fixture(scope="module")
def encoded(tmp_path_factory):
    """The plain input, encoded by our encoder, and its source index."""
    folder = tmp_path_factory.mktemp("encoded")
    (folder / "in.ply").write_bytes(INPUTS[PLAIN].make())
    words = ["encode", folder / "in.ply", folder / "out.csplat", "--source-index", folder / "out.npy", "--quiet"]
    assert 0 == CliRunner().invoke(app, list(map(str, words))).exit_code
    return (folder / "out.csplat").read_bytes(), np.load(folder / "out.npy")


def running(encoded, change):
    """Return an encoder in this process: our own, then `change` on the paths `ply`, `out` and `index`."""

    def run(_command, places, _seconds):
        at = SimpleNamespace(**{name: Path(place) for name, place in places.items()})
        at.out.write_bytes(encoded[0])
        np.save(at.index, encoded[1])
        code = change(at) or 0
        return ProcessEnd(None, code, b"", b"error: no" if code else b"", 0.0)

    return run


def first(report):
    outcome = report.outcomes[0]
    return outcome.status, outcome.clauses, outcome.message


def outcome_of(encoded, change, choice=FILES):
    """Return status, clauses and message of our own encoder followed by `change`."""
    return first(run_encoder(COMMAND, choice, run=running(encoded, change)))


# Traces --------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("change", "message"), [
    (lambda at: at.ply.write_bytes(at.ply.read_bytes() + b"\n") and None, "the input was modified"),
    (lambda at: at.ply.unlink(), "the input is gone"),
    (lambda at: (at.out.parent / "x.tmp").touch(), "left x.tmp next to the output"),
    (lambda at: (at.out.parent / "cache").mkdir(), "left cache next to the output"),
])  # fmt: skip
def test_a_run_fails_if_it_has_side_effects(encoded, change, message):
    assert (Status.FAILED, (), message) == outcome_of(encoded, change)


@pytest.mark.parametrize("name", ["nasty/empty", "broken/cut"])
def test_a_refusal_leaves_nothing(encoded, name):
    def refuse(at):
        at.out.unlink()
        (at.out.parent / "x.tmp").touch()
        return 1

    message = "refused, but left out.npy next to the output; refused, but left x.tmp next to the output"
    assert (Status.FAILED, (), message) == outcome_of(encoded, refuse, EncoderSuiteOptions(name, ("L1",)))


def test_the_working_directory_stays_empty():
    writes = program("import sys; open('core', 'w'); open(sys.argv[2], 'w'); sys.exit(0)")
    refuses = program("import sys; open('log', 'w'); sys.exit('error: no')")
    assert "file is empty" in first(run_encoder(writes, FILES))[2]  # an invalid file needs no further report
    refusal = run_encoder(refuses, EncoderSuiteOptions("nasty/empty", ("L1",)))
    assert "refused, but left log in its working directory" == first(refusal)[2]
    assert not Path("core").exists()


def test_a_command_may_name_files_relative_to_the_callers_directory(tmp_path, monkeypatch):
    (tmp_path / "tools").mkdir()
    (tmp_path / "tools" / "a b.py").write_text("import os, sys; print(*sys.argv[1:], os.getcwd(), sep='|')")
    (tmp_path / "enc").write_text("#!/bin/sh\npwd\n")
    (tmp_path / "enc").chmod(0o755)
    (tmp_path / "small").touch()
    (tmp_path / "other").mkdir()
    monkeypatch.chdir(tmp_path)
    script = f"{shlex.quote(sys.executable)} 'tools/a b.py' --lib=tools/ small none.txt {{ply}}"
    script_output, program_output = (
        run_program(command, {"ply": "in.ply"}, 30.0, cwd=tmp_path / "other").stdout.decode()
        for command in (script, "./enc {ply}")
    )
    assert f"--lib={tmp_path}/tools|small|none.txt|in.ply|{tmp_path}/other\n" == script_output
    assert f"{tmp_path}/other\n" == program_output


# Repetitions ---------------------------------------------------------------------------------------
def changed_the_second_time(change):
    turns = itertools.count()
    return lambda at: change(at) if next(turns) else None


def refuse(at):
    at.out.unlink()
    return 1


def flip(place):
    def run(at):
        data = bytearray(at.out.read_bytes())
        data[place] ^= 1
        at.out.write_bytes(data)

    return run


def test_a_second_run_must_give_the_same_file_and_index(encoded):
    data, index = encoded
    size = len(data)
    cases = {
        "two runs gave different files: first at byte 150, in attribute[": flip(150),
        "in the chunk TILE.0.1": flip(-1),
        "in the chunk SERR (directory[": flip(data.rfind(b"SERR") + 30),
        f"({size:,} and {size + 5:,} bytes): first at byte {size}": (
            lambda at: at.out.write_bytes(data + b"12345") and None
        ),
        "two runs gave the same file but different source indices": lambda at: np.save(at.index, index[::-1]),
        "a second run ended differently: exit status 1, no file; its last line: error: no": refuse,
    }

    def check(case):
        expected, change = case
        status, clauses, message = outcome_of(encoded, changed_the_second_time(change))
        assert (Status.FAILED, ("CNF-10",)) == (status, clauses)
        assert expected in message

    assert [] == failures({case[0]: case for case in cases.items()}, check)


def test_processes_run_again_in_another_second(encoded, tmp_path):
    (tmp_path / "sound.csplat").write_bytes(encoded[0])
    code = f"""import sys, time
data = open({str(tmp_path / "sound.csplat")!r}, "rb").read()
open(sys.argv[2], "wb").write(data + str(int(time.time())).encode() if ".again" in sys.argv[2] else data)
"""
    report = run_encoder(program(code), EncoderSuiteOptions(PLAIN, ("L1",), keep=tmp_path / "kept"))
    assert ("CNF-10",) == first(report)[1]
    assert ["ordinary-degree_1", "ordinary-degree_1.again"] == sorted(
        path.name for path in (tmp_path / "kept").iterdir()
    )


def test_files_are_kept_in_folders_emptied_before_each_run(encoded, tmp_path):
    choice = EncoderSuiteOptions(PLAIN, ("L1",), keep=tmp_path)
    assert "left tmp next" in outcome_of(encoded, lambda at: (at.out.parent / "tmp").write_text("") and None, choice)[2]
    assert run_encoder(COMMAND, choice, run=running(encoded, lambda _: None)).passed
    assert ["in.ply", "out.csplat", "out.npy"] == sorted(path.name for path in tmp_path.glob("*/*"))


# The source index ----------------------------------------------------------------------------------
@pytest.mark.parametrize(("change", "message"), [
    (lambda index: index + 1, "splat "),
    (np.argsort, "numbers of the index are wrong"),
    (lambda index: index[:-1], "expected integers of shape [216]"),
    (lambda index: index.astype(np.float64), "the source index is float64"),
    (lambda index: index[:, None], "shape [216, 1]"),
    (lambda index: np.where(np.arange(216) == 5, index[6], index), "splats 5 and 6 both have the source index"),
    (lambda index: np.where(np.arange(216) == 5, -1, index), "the source index of splat 5 is -1, expected 0 to"),
    (lambda index: np.where(np.arange(216) == 5, 2**40, index), "is 1099511627776, expected 0 to 215"),
])  # fmt: skip
def test_a_wrong_index_is_reported(encoded, change, message):
    status, clauses, found = outcome_of(encoded, lambda at: np.save(at.index, change(encoded[1])), MAPS)
    assert (Status.FAILED, ("SRC-4",)) == (status, clauses)
    assert message in found


def test_an_index_may_have_any_integer_type_and_wrong_numbers_are_named(encoded):
    wrong = encoded[1].copy()
    wrong[[3, 7]] = wrong[[7, 3]]
    message = (
        f"the source index of splat 3 is {wrong[3]}, but the nearest source splat is {wrong[7]}"
        " (2 of 216 numbers of the index are wrong)"
    )
    for dtype in ("<u1", ">i8", "<u8"):
        assert (
            Status.PASSED is outcome_of(encoded, lambda at, t=dtype: np.save(at.index, encoded[1].astype(t)), MAPS)[0]
        )
        assert message == outcome_of(encoded, lambda at, t=dtype: np.save(at.index, wrong.astype(t)), MAPS)[2]


def npy(text):
    """A file of version 1.0 whose header is some text."""
    return b"\x93NUMPY\1\0" + len(text).to_bytes(2, "little") + text


@pytest.mark.parametrize(("write", "message"), [
    (lambda path: path.unlink(), "no source index was written"),
    (lambda path: path.write_bytes(b"\x93NUMPY"), "is not a NumPy array file"),
    (lambda path: path.write_bytes(b""), "is not a NumPy array file"),
    (lambda path: path.write_bytes(b"PK\3\4" * 9), "is not a NumPy array file"),
    (lambda path: np.save(path, np.array([None] * 216)), "is not a NumPy array file"),
    (lambda path: path.write_bytes(npy(b"{'descr': '<u4', 'shape': (216,),")), "is not a NumPy array file"),
    (lambda path: path.write_bytes(npy(b"{[]: 1}")), "is not a NumPy array file"),
])  # fmt: skip
def test_an_index_is_an_npy_file(encoded, write, message):
    _, clauses, found = outcome_of(encoded, lambda at: write(at.index) and None, MAPS)
    assert ("SRC-4",) == clauses
    assert message in found


def test_errors_are_proved_by_the_encoders_own_index(monkeypatch):
    # Centres are equal: only the encoder knows the pairs.
    ran = []
    monkeypatch.setattr(
        "csplat_conformance.encoders.error_checks.verify_bounds",
        lambda *args: ran.append(args[-1]) or verify_bounds(*args),
    )
    one = INPUTS["nasty/duplicates"]
    means = one.source().means
    result = csplat.encode(one.source().to_model((0.0, 0.0, 0.0)))
    pairs = pair_splats(means.astype(np.float64), csplat.decode(result).means.astype(np.float64), one.separation)
    exchanged = pairs.source_index.copy()
    same = np.flatnonzero((means[exchanged] == means[exchanged[0]]).all(axis=1))
    exchanged[same] = np.roll(exchanged[same], 1)
    run = running((result, exchanged), lambda _: None)
    assert run_encoder(COMMAND, EncoderSuiteOptions(one.name, ("L3",)), run=run).passed
    np.testing.assert_array_equal(exchanged, ran[0])


# Refusals ------------------------------------------------------------------------------------------
def test_declined_unusual_inputs_are_counted():
    unusual = ("nasty/empty", "nasty/outlier", "broken/cut")
    declined = {INPUTS[name].make() for name in unusual}

    def run(_command, places, _seconds):
        refuses = Path(places["ply"]).read_bytes() in declined
        Path(places["out"]).write_bytes(b"csplat?") if not refuses else None
        return ProcessEnd(None, int(refuses), b"error: unusual\n", b"", 0.0)  # on standard output: the error is empty

    report = run_encoder("x {ply} {out}", EncoderSuiteOptions(",".join(unusual), ("L1",)), run=run)
    assert report.passed
    assert ["warning: nasty: 2 of 2 declined"] == list(report.notes)
    assert {"checks": 3, "passed": 1, "warned": 0, "declined": 2, "not proved": 0, "failed": 0, "skipped": 0} == (
        report.levels()["L1"]
    )
    assert {"refused: error: unusual"} == {one.message for one in report.outcomes}
    some = run_encoder("x {ply} {out}", EncoderSuiteOptions("nasty/empty*", ("L1",)), run=run)
    assert ["nasty: 1 of 2 declined"] == list(some.notes)
    assert (Status.DECLINED, (), "refused: error: unusual") == first(some)


# Inputs as files -----------------------------------------------------------------------------------
def test_inputs_are_written_as_files_with_a_list(tmp_path):
    listed = write_inputs(tmp_path)["inputs"]
    assert listed == json.loads((tmp_path / "inputs.json").read_text())["inputs"]
    assert list(INPUTS) == [entry["name"] for entry in listed]
    for entry in listed:
        one = INPUTS[entry["name"]]
        assert one.make() == (tmp_path / entry["file"]).read_bytes()
        assert one.why == entry["why"]
        assert ("must" if one.must_refuse else "may" if one.may_refuse else "no") == entry["refusal"]
        assert one.must_refuse == (entry["expected"] is None)
    by_name = {entry["name"]: entry["expected"] for entry in listed}
    for name, facts in {
        "nasty/not_a_number": {"splats": 61, "rows": 64, "renders": False, "psnr_min": None},
        "ordinary/extra_columns": {"sh_degree": 1, "extra_columns": ["confidence", "object_id", "red"], "psnr_min": 30},
    }.items():
        assert facts.items() <= by_name[name].items()


def test_the_command_writes_inputs_and_runs_nothing(tmp_path):
    result = invoke("--write-inputs", tmp_path / "new", "--filter", "ordinary/degree_*,broken/cut")
    assert (0, f"6 inputs in {tmp_path / 'new'}\n") == (result.exit_code, result.stdout)
    files = {path.relative_to(tmp_path / "new").as_posix() for path in (tmp_path / "new").rglob("*.*")}
    assert {*(f"ordinary/degree_{d}.ply" for d in range(5)), "broken/cut.ply", "inputs.json"} == files
    assert "is not empty" in invoke("--write-inputs", tmp_path / "new").stderr
    assert 0 == invoke("--write-inputs", tmp_path / "new", "--force", "--filter", "broken/*").exit_code


@pytest.mark.parametrize("words", [("--cmd", "x {ply} {out}"), ("--level", 2), ("--keep", "y"), ("--jobs", 2)])
def test_writing_inputs_accepts_no_option_of_a_run(tmp_path, words):
    result = invoke("--write-inputs", tmp_path / "new", *words)
    assert 2 == result.exit_code
    assert not (tmp_path / "new").exists()


L3 = ("L1", "L2", "L3")


def model_of(name, folder):
    (folder / "in.ply").write_bytes(INPUTS[name].make())
    return csplat.read_ply(folder / "in.ply")


@pytest.fixture(scope="module")
def plain(tmp_path_factory):
    """The plain input, after reading."""
    return model_of(PLAIN, tmp_path_factory.mktemp("plain"))


def judged(name, model, change=lambda scene: scene, **options):
    """L2 and L3 of our encoder's file, and the reasons why only pictures can judge the rest."""
    scene = change(decode_scene(csplat.encode(model, csplat.EncodeOptions(**options))))
    content, pairs = check_content(INPUTS[name], INPUTS[name].source(), scene, None)
    return content, *check_errors(INPUTS[name], scene, pairs)


def stating(**changes):
    """Return a change of the errors that a scene states."""
    return lambda scene: replace(
        scene,
        declared_bounds=replace(
            scene.declared_bounds, **{key: make(scene.declared_bounds) for key, make in changes.items()}
        ),
    )


def without(*names):
    return lambda stated: tuple(record for record in stated.records if record.measure not in names)


def silent(scene):
    return replace(scene, declared_bounds=None)


REFITTED = stating(refitted=lambda _: True, records=without("sh0", "sh1"))


# Facts ---------------------------------------------------------------------------------------------
@pytest.mark.parametrize(("fact", "message"), [
    ({"coordinate_system": "RDF"}, "axes is RDF"),
    ({"unit_metres": 1.0}, "unit_metres is 1.0"),
    ({"antialiased": True}, "antialiased is True"),
    ({"extra": {"id": np.zeros(216, "<u4")}}, "the source has no extra column 'id'"),
])  # fmt: skip
def test_facts_that_differ_from_the_source_break_their_clause(plain, fact, message):
    content, *_ = judged(PLAIN, replace(plain, **fact), keep_extra=True)
    assert (Status.FAILED, ("SRC-3",)) == (content.status, content.clauses)
    assert message in content.message


def test_centres_in_doubles_are_compared_in_doubles():
    # Four million units away binary32 is a quarter of a unit off, more than splats are apart.
    one = INPUTS[PLAIN]
    near = one.source()
    far = replace(near, means=near.means.astype(np.float64) + np.array([4e6, -4e6, 0.1]))
    model = replace(csplat.decode(csplat.encode(near.to_model((0.0, 0.0, 0.0)))), origin=(4e6, -4e6, 0.1), extra={})
    scene = decode_scene(csplat.encode(model))
    content, pairs = check_content(replace(one, source=lambda: far), far, scene, None)
    assert (Status.PASSED, 0) == (content.status, pairs.missing)


def test_splats_without_a_near_source_are_named(plain):
    moved = plain.means.copy()
    moved[:3, 0] += 7.0
    moved[5] = moved[6]
    content, errors, _ = judged(PLAIN, replace(plain, means=moved))
    assert (Status.FAILED, ("CNF-6", "SER-5")) == (content.status, content.clauses)
    far, near, _ = content.message.split("; ")
    assert re.fullmatch(r"3 splats of the file, the first splat \d+, are not within 0.03 of a splat of the source", far)
    assert re.fullmatch(
        r"splat \d+ of the file is near a splat of the source that another splat already represents", near
    )
    assert Status.SKIPPED is errors.status


# Stated errors -------------------------------------------------------------------------------------
def test_errors_are_not_proved_if_they_are_not_stated_or_attributes_are_refitted(plain):
    _, errors, alone = judged(PLAIN, plain, silent)
    assert (Status.NOT_PROVED, "the file states no errors") == (errors.status, errors.message)
    assert alone == errors.message
    _, errors, alone = judged(PLAIN, plain, REFITTED)
    assert (Status.NOT_PROVED, "sh0, sh1: refitted, no error is stated") == (errors.status, errors.message)
    assert "sh0, sh1 refitted" == alone
    assert errors.details["means"]["holds"]


def test_stated_errors_hold_for_refitted_attributes_too(plain):
    halved = stating(
        refitted=lambda _: True,
        records=lambda stated: tuple(replace(one, max=one.max / 2, rms=one.rms / 2) for one in stated.records),
    )
    _, errors, _ = judged(PLAIN, plain, halved)
    assert (Status.FAILED, ("SER-5",)) == (errors.status, errors.clauses)
    assert errors.message.startswith("means: max ")
    assert ", source splat " in errors.message
    assert errors.message.endswith("; and 8 more")
    assert {"splat", "tile", "source_splat", "found"} == set(errors.details["sh1"]["worst"])


def test_a_measure_that_is_missing_breaks_its_clause(plain):
    _, errors, _ = judged(PLAIN, plain, stating(records=without("sh1")))
    assert (Status.FAILED, ("SER-6",), "the file states no error of sh1") == (
        errors.status,
        errors.clauses,
        errors.message,
    )


def test_an_empty_scene_has_no_errors(tmp_path):
    _, errors, alone = judged("nasty/empty", model_of("nasty/empty", tmp_path), silent)
    assert (Status.PASSED, "") == (errors.status, alone)


# Coarse --------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("fields", "message"), [
    ({"opacities": lambda m: 1 / (1 + np.exp(-m.opacities))}, "opacities: an error of 0.49"),
    ({"scales": lambda m: np.exp(m.scales)}, "covariance: an error of "),
    ({"sh0": lambda m: np.clip(m.sh0, -0.5, 0.5)}, "sh0: an error of 0."),
    ({"shN": lambda m: 0 * m.shN}, "sh1: an error of 0."),
])  # fmt: skip
def test_large_errors_that_are_stated_cause_a_warning(plain, fields, message):
    wrong = replace(plain, **{name: np.asarray(make(plain), np.float32) for name, make in fields.items()})
    _, errors, _ = judged(PLAIN, wrong, honest(plain), attribute_psnr=60.0)
    assert Status.WARNED is errors.status
    for words in (message, "beyond", "source splat"):
        assert words in errors.message


def honest(model):
    """Let a scene state its true errors."""
    source = Source.of(model)

    def change(scene):
        means = scene.model.means.astype(np.float64)
        pairs = pair_splats(source.means.astype(np.float64), means, INPUTS[PLAIN].separation)
        true = measure_pairs(source, scene.model, pairs.source_index)
        return stating(
            records=lambda stated: tuple(
                replace(one, max=true[one.measure].max, rms=true[one.measure].rms) for one in stated.records
            )
        )(scene)

    return change


def test_a_coarse_file_causes_a_warning(plain):
    _, errors, _ = judged(PLAIN, plain, attribute_psnr=14.0, sh_coding="none")
    assert Status.WARNED is errors.status
    assert "is coarse: splat " in errors.message


def test_leaving_much_out_causes_a_warning():
    one = INPUTS["ordinary/degree_0"]
    source = one.source()
    for kept, status in ((100, Status.WARNED), (200, Status.PASSED)):
        model = source.to_model((0.0, 0.0, 0.0)).select(np.arange(kept))
        scene = stating(source_count=lambda _: 216, pruned_count=lambda _, kept=kept: 216 - kept)(
            decode_scene(csplat.encode(model))
        )
        content, _ = check_content(one, source, scene, None)
        assert status is content.status
        assert str(216 - kept) in content.message


# Cut -----------------------------------------------------------------------------------------------
@contextmanager
def rounding(rint):
    """Make our encoder round in another way."""
    numpy = types.ModuleType("numpy")
    vars(numpy).update(vars(np), rint=rint)
    with mock.patch.object(quantisation, "np", numpy), mock.patch.object(shape_codebook, "np", numpy):
        yield


@pytest.mark.parametrize("cut", [np.floor, np.trunc])
@pytest.mark.parametrize("name", ["ordinary/degree_3", "ordinary/quaternions"])
def test_cut_values_are_distinguished_from_rounded_values(tmp_path, name, cut):
    one, model = INPUTS[name], model_of(name, tmp_path)
    with rounding(lambda values, out=None: cut(values, out=out)):
        scene = decode_scene(csplat.encode(model, csplat.EncodeOptions(sh_coding="scalar", threads=1)))
    _, pairs = check_content(one, one.source(), scene, None)
    every = frozenset(("means", "covariance", "opacities", "sh0", "sh1", "sh2", "sh3"))
    lines = find_truncation(one.source(), scene.model, scene.header, pairs.source_index, every)
    assert ["means", "opacities", "scales", "quats", "sh0"] == [line.partition(":")[0] for line in lines][:5]
    assert all(line.endswith("truncated instead of rounded?") for line in lines), lines
    assert [] == find_truncation(one.source(), scene.model, scene.header, pairs.source_index, frozenset())


@pytest.mark.parametrize("name", ["ordinary/strong_colours", "ordinary/needles_and_discs"])
def test_coarse_steps_are_not_cuts(tmp_path, name):
    model = model_of(name, tmp_path)
    for preset, psnr in (("fast", 20.0), ("balanced", 30.0), ("small", 20.0), ("small", 90.0)):
        _, errors, _ = judged(name, model, preset=preset, attribute_psnr=psnr)
        assert "truncated" not in errors.message


# Pictures ------------------------------------------------------------------------------------------
@pytest.fixture
def altered(monkeypatch, plain):
    """Run the suite over our file with altered statements."""
    data = csplat.encode(plain)

    def run(_command, places, _seconds):
        Path(places["out"]).write_bytes(data)
        return ProcessEnd(None, 0, b"", b"", 0.0)

    def report(change, levels=L3, render_score=None, name=PLAIN, **fields):
        one = replace(INPUTS[name], **fields)
        monkeypatch.setattr(
            "csplat_conformance.encoders.file_checks.decode_scene", lambda data: change(decode_scene(data))
        )
        monkeypatch.setattr("csplat_conformance.encoders.encoder_suite.all_inputs", lambda: [one])
        return run_encoder("x {ply} {out}", EncoderSuiteOptions(name, levels), run=run, render_score=render_score,
            no_render_reason="no numba")  # fmt: skip

    return report


def statuses(report):
    return [(one.level, one.status) for one in report.outcomes]


@pytest.mark.parametrize(("change", "why"), [(silent, "the file states no errors"), (REFITTED, "sh0, sh1 refitted")])
def test_pictures_judge_at_any_level_where_errors_prove_nothing(altered, change, why):
    seen = altered(change, render_score=lambda *_: 41.0)
    assert seen.passed
    assert [("L1", Status.PASSED), ("L2", Status.PASSED), ("L3", Status.NOT_PROVED), ("L4", Status.PASSED)] == (
        statuses(seen)
    )
    assert ("L4", Status.FAILED) == statuses(altered(change, render_score=lambda *_: 11.0))[-1]
    blind = altered(change)
    assert ("L4", Status.FAILED) == statuses(blind)[-1]
    assert f"{why}: only renders can check it, and no numba" == blind.outcomes[-1].message


def test_pictures_are_requested_where_they_are_needed_at_the_level_of_errors(altered):
    def same(scene):
        return scene

    assert ["L1", "L2"] == [level for level, _ in statuses(altered(silent, ("L1", "L2")))]
    assert ("L3", Status.NOT_PROVED) == statuses(altered(silent, renders=False))[-1]
    assert ("L4", Status.SKIPPED) == statuses(altered(silent, ("L3", "L4"), lambda *_: 9.0, renders=False))[-1]
    assert ("L3", Status.PASSED) == statuses(altered(same))[-1]
    assert ("L4", Status.SKIPPED) == statuses(altered(same, ("L4",)))[-1]
    assert ("L4", Status.FAILED) == statuses(altered(same, ("L4",), lambda *_: float("nan")))[-1]


def test_sizes_and_figures_of_others_stand_next_to_the_picture(altered, monkeypatch):
    def outcome(figures, psnr=41.2, **fields):
        monkeypatch.setattr("csplat_conformance.encoders.render_checks.peer_figures", lambda _: figures)
        return altered(lambda scene: scene, ("L4",), lambda *_: psnr, **fields).outcomes[0]

    ours, spz = {"bytes": 4800, "psnr": 40.9}, {"bytes": 7900, "psnr": 39.1}
    whole = outcome({"csplat": ours, "spz": spz})
    size = whole.details["bytes"]
    assert f"41.20 dB in {size:,} bytes (csplat 40.90 in 4,800, SPZ 39.10 in 7,900)" == whole.message
    assert {"psnr": 41.2, "wanted": 30.0, "bytes": size, "beside": {"csplat": ours, "spz": spz}} == whole.details
    assert f"41.20 dB in {size:,} bytes (SPZ in 7,900)" == outcome({"spz": {"bytes": 7900}}).message
    assert f"41.20 dB in {size:,} bytes" == outcome({}).message
    assert (
        f"25.00 dB, expected at least 26, in {size:,} bytes (csplat 40.90 in 4,800); with the source's means 25.0,"
        " shapes 25.0, opacities 25.0, colours 25.0"
    ) == outcome({"csplat": ours}, 25.0, psnr_min=26.0).message


def test_a_scene_that_cannot_be_drawn_fails_alone(altered):
    def far(scene):
        return replace(scene, model=replace(scene.model, origin=(1e300, 0.0, 0.0)))

    report = altered(far, ("L1", "L2", "L3", "L4"), lambda *_: 40.0)
    assert [Status.FAILED] == [one.status for one in report.outcomes if one.level == "L4"]


# Reports -------------------------------------------------------------------------------------------
REPORT = ConformanceReport(
    "encoder",
    "x",
    [
        Outcome("a", "L3", Status.PASSED),
        Outcome("b", "L3", Status.WARNED, message="coarse <"),
        Outcome("c", "L3", Status.NOT_PROVED, message="fitted anew"),
        Outcome("d", "L1", Status.DECLINED, message="refused: no"),
    ],
    ("warning: nasty: 1 of 1 declined",),
    (Status.WARNED, Status.DECLINED, Status.NOT_PROVED),
)


def test_warnings_refusals_and_unproved_errors_are_counted_but_are_no_failures():
    assert REPORT.passed
    for line in ("L3  warned      b  coarse <", "L3  not proved  c  fitted anew", *REPORT.notes):
        assert line in to_table(REPORT)
    counts = {"checks": 3, "passed": 1, "warned": 1, "declined": 0, "not proved": 1, "failed": 0, "skipped": 0}
    assert counts == to_json(REPORT)["levels"]["L3"]
    decoder = ConformanceReport("decoder", "x", REPORT.outcomes[:1])
    assert ["checks", "passed", "failed", "skipped"] == list(decoder.levels()["L3"])


def test_junit_contains_warnings_and_refusals():
    root = ET.fromstring(to_junit(REPORT))  # noqa: S314 - our own text
    assert {"tests": "4", "failures": "0", "errors": "0", "skipped": "2"}.items() <= root.attrib.items()
    cases = {case.get("name"): case for case in root.iter("testcase")}
    assert "warning: coarse <" == cases["b"].find("system-out").text
    assert "not proved: fitted anew" == cases["c"].find("skipped").get("message")
    assert "declined: refused: no" == cases["d"].find("skipped").get("message")
    assert "warning: nasty: 1 of 1 declined" in {one.get("value") for one in root.iter("property")}

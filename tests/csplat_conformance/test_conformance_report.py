"""Tests of csplat_conformance.conformance_report."""

import itertools
import re
import xml.etree.ElementTree as ET
from dataclasses import replace

import numpy as np
import pytest
from encoder_runs_cases import (
    INPUTS,
    MAPS,
    PLAIN,
    judged,
    model_of,
    outcome_of,
    refuse,
)
from tables import failures

import csplat
from csplat.decoder import decode_scene
from csplat_conformance.conformance_report import ConformanceReport, Outcome, Status, to_json, to_junit, to_table
from csplat_conformance.declared_bounds import Source, measure_pairs
from csplat_conformance.encoders.file_checks import check_content, pair_splats


@pytest.mark.parametrize(("change", "message"), [
    (lambda at: at.ply.write_bytes(at.ply.read_bytes() + b"\n") and None, "the input was modified"),
    (lambda at: at.ply.unlink(), "the input is gone"),
    (lambda at: (at.out.parent / "x.tmp").touch(), "left x.tmp next to the output"),
    (lambda at: (at.out.parent / "cache").mkdir(), "left cache next to the output"),
])  # fmt: skip
def test_a_run_fails_if_it_has_side_effects(encoded, change, message):
    assert (Status.FAILED, (), message) == outcome_of(encoded, change)


def changed_the_second_time(change):
    turns = itertools.count()
    return lambda at: change(at) if next(turns) else None


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


def test_a_scene_that_cannot_be_drawn_fails_alone(altered):
    def far(scene):
        return replace(scene, model=replace(scene.model, origin=(1e300, 0.0, 0.0)))

    report = altered(far, ("L1", "L2", "L3", "L4"), lambda *_: 40.0)
    assert [Status.FAILED] == [one.status for one in report.outcomes if one.level == "L4"]


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

# SPDX-License-Identifier: Apache-2.0
"""Tests of csplat_conformance.conformance_report."""

import xml.etree.ElementTree as ET

from csplat_conformance.conformance_report import ConformanceReport, Outcome, Status, to_json, to_junit, to_table

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
    counts = {"checks": 3, "passed": 1, "warned": 1, "declined": 0, "not_proved": 1, "failed": 0, "skipped": 0}
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

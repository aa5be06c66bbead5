# SPDX-License-Identifier: Apache-2.0
"""`csplat info`: every byte is accounted for, as text and JSON.

Also: csplat_tools.cli.error_lines, csplat_tools.cli.info, csplat_tools.inspect.text_reports.
"""

import json
import os
import sys
from contextlib import suppress
from pathlib import Path

import pytest
from command_line import printed, refused, status_of

from csplat_conformance.manifest import VECTORS

pytestmark = pytest.mark.usefixtures("no_first_view")


@pytest.mark.slow
@pytest.mark.parametrize("name", ["info", "verify", "lint", "decode"])
def test_the_report_is_what_json_prints(tmp_path, csplat_file, ply, name):
    words = (ply,) if name == "lint" else (csplat_file, tmp_path / "back.ply") if name == "decode" else (csplat_file,)
    report = ("--report", tmp_path / "report.json")
    assert json.loads(printed(name, *words, "--json", *report)) == json.loads(report[1].read_text())
    assert "exists: --force replaces it" in refused(name, *words, *report)


def test_values_that_this_version_does_not_know_are_printed():
    path = VECTORS / "valid" / "additions.csplat"
    assert "colour space 128, projection 129 (unknown), antialiasing 200 (unknown)" in printed("info", path)
    report = json.loads(printed("info", path, "--json"))
    assert ["129", "200", "128"] == [report[name] for name in ("projection", "antialiasing", "colour_space")]


def test_a_full_standard_output_is_one_line_and_a_closed_pipe_no_traceback(csplat_file, monkeypatch, capsys):
    def written_to(output, *words):
        monkeypatch.setattr(sys, "stdout", output)
        status = status_of(*words)
        monkeypatch.undo()
        return status, capsys.readouterr().err

    line = "error: standard output: No space left on device; the output is incomplete (ENOSPC)\n"
    for words in (("info", csplat_file), ("--version",)):
        full = Path("/dev/full").open("w", encoding="utf-8")  # noqa: SIM115  # what closes it fails as well
        assert (1, line) == written_to(full, *words)
        with suppress(OSError):
            full.close()
    assert refused("decode", csplat_file, "/dev/full").startswith("error: /dev/full: No space left")
    near, far = os.pipe()
    os.close(near)
    with os.fdopen(far, "w") as pipe:
        assert (1, "") == written_to(pipe, "info", csplat_file, "--json")
        pipe.write("what the interpreter flushes when it ends")


def test_a_url_instead_of_a_file_is_reported(tmp_path):
    url = "https://example.com/a/b.ply"
    for words in (("info", url), ("lint", url), ("encode", url, tmp_path / "c.csplat")):
        assert refused(*words).startswith(f"error: {url} is a URL, expected a file: download it first")


def test_info_accounts_for_every_byte_and_prints_text(tmp_path, csplat_file):
    described = json.loads(printed("info", csplat_file, "--json"))
    attributes = sum(one["size_bytes"] for one in described["attributes"].values())
    assert attributes + sum(described["overhead"].values()) == csplat_file.stat().st_size == described["size_bytes"]
    assert ["opacities", "scales", "quats", "means", "sh0", "sh1", "sh2"] == list(described["attributes"])
    assert ["geometry", "sh1", "sh2"] == list(described["layers"])
    assert described["source"]["splats"] == 200
    assert described["options"]["asked"]["preset"] == "balanced"
    assert "splats       200, SH degree 2" in printed("info", csplat_file)
    data = csplat_file.read_bytes()
    for wrong, code in ((data[:1], "wrong is"), (data[:-1], "E_TRUNCATED"), (data + b"x", "E_TRAILING")):
        (tmp_path / "wrong").write_bytes(wrong)
        assert code in refused("info", tmp_path / "wrong")


def test_a_file_with_too_much_metadata_is_not_called_a_large_scene():
    line = refused("info", VECTORS / "invalid" / "json_values_beyond_budget.csplat")
    assert "its metadata or cameras take more memory than is allowed here" in line
    assert "Limits(json_bytes=...)" in line

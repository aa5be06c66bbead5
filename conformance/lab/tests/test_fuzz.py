# SPDX-License-Identifier: CC0-1.0
"""The fuzzer: each target runs, and files on which something went wrong once stay harmless."""

import subprocess
import sys
from pathlib import Path

import pytest

from csplat_selftest.fuzzing.decoder_targets import missing_others

LAB = Path(__file__).resolve().parents[1]


def fuzz(*words):
    return subprocess.run([sys.executable, LAB / "fuzz.py", *words], capture_output=True, text=True, check=False)


@pytest.mark.skipif(bool(missing_others()), reason=f"skipped: {missing_others()}")
def test_the_decoders_agree_on_damaged_files(tmp_path):
    run = fuzz("--target", "others", "--count", "12", "--jobs", "1", "--out", str(tmp_path))
    assert (0, "") == (run.returncode, run.stderr)
    assert "others: 12 executions" in run.stdout
    assert "0 kinds of findings" in run.stdout


def test_damage_above_level_0_which_decode_leaves_unread_is_no_finding(tmp_path):
    run = fuzz("--target", "decoder", "--count", "500", "--jobs", "1", "--plain", "--out", str(tmp_path))
    assert (0, "") == (run.returncode, run.stderr)
    assert "0 kinds of findings" in run.stdout


def test_earlier_findings_stay_harmless(tmp_path):
    run = fuzz("--target", "ply", "--replay", str(LAB / "corpus" / "ply"), "--out", str(tmp_path))
    assert (0, "") == (run.returncode, run.stderr), run.stdout

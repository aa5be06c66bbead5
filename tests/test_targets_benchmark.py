"""`csplat_bench.targets`: two builds at equal PSNR, files that others beat, and what continues where it stopped."""

import json
import math

import pytest

pytest.importorskip("numba", reason="the benchmark renders: pip install 'csplat[render]'")

from csplat_bench.common.command import run as command
from csplat_bench.targets import __main__ as targets
from csplat_bench.targets.tables import Ratio, at_equal_psnr, dominated, kind_of, tables

pytestmark = pytest.mark.area(name="benchmarks")


def row(size, psnr, *, all_splats=True, seconds=1.0):
    return {"bytes": size, "psnr": psnr, "seconds": seconds, "all_splats": all_splats}


BEFORE = {"38 dB, every splat": row(4000, 38.0), "42 dB, every splat": row(8000, 42.0)}


@pytest.mark.parametrize(
    ("name", "kind"),
    [
        ("38 dB, every splat", "dB, every splat"),
        ("38 dB", "dB"),
        ("keep 0.7", "keep"),
        ("4 B/splat", "B/splat"),
        ("small", "small"),
    ],
)
def test_rows_are_of_one_kind_where_nothing_but_a_number_differs(name, kind):
    assert kind == kind_of(name)


def test_the_same_file_takes_all_of_its_bytes():
    assert Ratio(1.0) == at_equal_psnr(BEFORE, BEFORE, "38 dB, every splat")


def test_interpolates_the_logarithm_of_the_bytes_between_neighbouring_targets():
    now = {"38 dB, every splat": row(2000, 37.0), "42 dB, every splat": row(8000, 41.0), "38 dB": row(1, 38.0)}
    assert Ratio(pytest.approx(2000 * 4**0.25 / 4000)) == at_equal_psnr(BEFORE, now, "38 dB, every splat")


def test_takes_a_share_of_the_bytes_per_decibel_where_one_side_is_missing():
    now = {"38 dB, every splat": row(4000, 39.0), "42 dB, every splat": row(8000, 44.0)}
    guessed = Ratio(pytest.approx(math.exp(-0.045)), guessed=True)
    assert guessed == at_equal_psnr(BEFORE, now, "38 dB, every splat")
    better = Ratio(pytest.approx(math.exp(0.09)), guessed=True)
    assert better == at_equal_psnr({"small": row(1000, 40.0)}, {"small": row(1000, 38.0)}, "small")


def test_says_nothing_of_what_was_not_made_twice():
    assert at_equal_psnr(BEFORE, {}, "38 dB, every splat") is None
    assert at_equal_psnr(BEFORE, {"38 dB, every splat": {"error": "no"}}, "38 dB, every splat") is None


def test_a_file_is_beaten_by_one_that_is_smaller_and_better():
    rows = {"small": row(1000, 40.0), "38 dB, every splat": row(980, 40.2), "fast": row(500, 39.0)}
    assert {"small": "38 dB, every splat"} == dominated(rows)


@pytest.mark.parametrize("other", [row(995, 40.2), row(980, 40.05)])
def test_a_file_is_not_beaten_by_a_hair(other):
    assert {} == dominated({"small": row(1000, 40.0), "other": other})


def test_a_file_of_every_splat_is_beaten_by_such_files_alone():
    fewer = row(500, 41.0, all_splats=False)
    assert {} == dominated({"small": row(1000, 40.0), "38 dB": fewer})
    whole = {"38 dB": row(1000, 40.0, all_splats=False), "small": row(500, 41.0), "fast": row(400, 40.5)}
    assert {"38 dB": "fast"} == dominated(whole)


def test_what_was_not_made_beats_nothing():
    assert {} == dominated({"small": row(1000, 40.0), "38 dB": {"error": "out of reach", "seconds": 1.0}})


def known(now):
    builds = {"before": {"rows": BEFORE}, "now": {"rows": now}}
    return {"plane3": {"splats": 100, "builds": builds}}


def test_tables_state_bytes_psnr_and_seconds_of_both_builds_and_their_means():
    now = {"38 dB, every splat": row(2000, 38.0, seconds=4.0), "42 dB, every splat": row(8000, 42.0)}
    lines = [" ".join(line.split()) for line in tables(known(now), markdown=False).splitlines()]
    assert "scene 38 42" in lines
    assert "plane3 4.0 → 2.0 at 38.00, 0.500 8.0 → 8.0 at 42.00, 1.000" in lines
    assert "plane3 1 → 4 1 → 1" in lines
    assert "dB, every splat 2 0.707 1.0 2.0 2.00" in lines
    assert "all targets 2 0.707 1.0 2.0 2.00" in lines
    assert "None of 4 results of searches is beaten by another file of its scene and build." in lines


def test_tables_mark_what_no_two_files_say():
    now = {"38 dB, every splat": row(4000, 39.0)}
    text = tables(known(now), markdown=True)
    assert "| 4.0 → 4.0 at 39.00, ≈ 0.956 |" in text
    assert "≈ by 4.5 % of the bytes per dB" in text


def test_tables_state_what_is_beaten_and_what_was_not_made():
    now = {
        "small": row(3000, 38.0),
        "keep 0.7": row(2500, 38.0),
        "34 dB, every splat": row(2000, 38.0),
        "fast": row(1000, 39.0),
        "38 dB, every splat": {"error": "out of reach"},
    }
    text = tables(known(now), markdown=True)
    assert "| plane3 | now | 34 dB, every splat | 2.0 | 38.00 | fast | 1.0 | 39.00 |" in text
    for chosen in ("small", "keep 0.7"):  # by whoever asked for them
        assert f"| {chosen} |" not in text.split("| beaten |")[1]
    assert "| plane3 | now | 38 dB, every splat | out of reach |" in text
    assert "| plane3 | - → 2.0 at 38.00 | 4.0 → - | 8.0 → - |" in text
    assert not tables({}, markdown=True)


def run(kept, *words):
    return command(targets.main, ["--scenes", "sample", "--kept", str(kept), *words])


def test_makes_what_is_missing_and_keeps_each_row(tmp_path, capsys):
    """The scene that ships, by presets alone; then nothing is left to do."""
    run(tmp_path, "--psnr", "", "--build", "before")
    rows = json.loads((tmp_path / "sample.json").read_text())["builds"]["before"]["rows"]
    assert ["fast", "balanced", "small"] == list(rows)
    assert all(one["all_splats"] and one["bytes"] > 0 and one["psnr"] > 20.0 for one in rows.values())
    capsys.readouterr()
    run(tmp_path, "--psnr", "", "--build", "before")
    assert not capsys.readouterr().err


def test_a_program_that_is_missing_ends_it_at_once(tmp_path, capsys):
    assert 1 == run(tmp_path, "--csplat", str(tmp_path / "absent"))
    assert "no such program" in capsys.readouterr().err


def test_a_file_that_cannot_be_made_is_a_row(tmp_path):
    program = tmp_path / "fails"
    program.write_text("#!/bin/sh\necho 'error: too small' >&2\nexit 1\n")
    program.chmod(0o755)
    run(tmp_path, "--psnr", "", "--sizes", "4", "--csplat", str(program))
    rows = json.loads((tmp_path / "sample.json").read_text())["builds"]["now"]["rows"]
    assert "error: too small" == rows["4 B/splat, every splat"]["error"]

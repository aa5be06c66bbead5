# SPDX-License-Identifier: Apache-2.0
"""The encoder suite: our encoder at every preset, faulty encoders, refusals, inputs, and the command.

Also: csplat_conformance.encoders.surface_scenes.
"""

import json
import tempfile
from functools import cache
from importlib.resources import files
from pathlib import Path

import numpy as np
import plyfile
import pytest
from encoder_runs_cases import ENCODABLE, INPUTS, L3, program
from tables import failures

import csplat
from csplat.encoder import PRESETS
from csplat.errors import InputError
from csplat_conformance import encoders
from csplat_conformance.conformance_report import Status
from csplat_conformance.declared_bounds import Source
from csplat_conformance.encoders import EncoderSuiteOptions, run_encoder
from csplat_conformance.protocol import ProcessEnd, run_program
from csplat_tools.encode_file import encode_file
from encoder_faults.run import psnr

PLACES = "{ply} {out} {index}"
DEGREE_5 = "nasty/degree_5"  # ours refuses it, and nothing else that can be encoded


@cache
def made_of(ply, preset):
    """Return the bytes of `csplat encode` for a PLY and of its source index, or the reason for a refusal."""
    with tempfile.TemporaryDirectory() as folder:
        source, out, index = (Path(folder) / name for name in ("in.ply", "out.csplat", "out.npy"))
        source.write_bytes(ply)
        try:
            encode_file(str(source), str(out), csplat.EncodeOptions(preset), source_index=str(index))
        except InputError as error:
            return f"error: {error}\n"
        return out.read_bytes(), index.read_bytes()


#: Bytes of a PLY that is encoded only once: the other inputs show whether a second run gives the same.
LARGE = 20_000


def encoder_here(preset="balanced"):
    """Our encoder in this process, by the function of its command; `tests/run.sh` starts the command."""

    def run(_command, places, _seconds):
        ply = Path(places["ply"]).read_bytes()
        made = (made_of if len(ply) > LARGE else made_of.__wrapped__)(ply, preset)
        if isinstance(made, str):
            return ProcessEnd(None, 1, b"", made.encode(), 0.0)
        for name, data in zip(("out", "index"), made, strict=True):
            Path(places[name]).write_bytes(data)
        return ProcessEnd(None, 0, b"", b"", 0.0)

    return run


#: Inputs whose SH, tiles, columns or ranges reach other code of the encoder with another preset.
PRESET_DEPENDENT = (
    "ordinary/degree_3", "ordinary/glossy", "ordinary/strong_colours", "ordinary/one_splat", "ordinary/extra_columns",
    "nasty/far_doubles", "nasty/huge_colours", "nasty/empty_degree_3", "nasty/duplicates",
)  # fmt: skip


@pytest.mark.slow
def test_our_encoder_passes_on_every_input():
    # CNF-5, CNF-6, SRC-3
    names = [name for name in INPUTS if name != "ordinary/surfaces"]  # another 3,644 splats like those of "glossy"
    report = run_encoder(PLACES, EncoderSuiteOptions(",".join(names), L3, jobs=1), run=encoder_here())
    assert [] == report.failures
    assert len(report.outcomes) >= 150
    assert {Status.PASSED} == {one.status for one in report.outcomes if one.name != DEGREE_5}


@pytest.mark.long
@pytest.mark.parametrize("preset", [preset for preset in PRESETS if preset != csplat.EncodeOptions().preset])
def test_our_encoder_passes_at_other_presets(preset):
    choice = EncoderSuiteOptions(",".join(PRESET_DEPENDENT), L3, jobs=1)
    report = run_encoder(PLACES, choice, run=encoder_here(preset))
    assert [] == report.failures
    assert {*PRESET_DEPENDENT} == {one.name for one in report.outcomes if one.status is Status.PASSED}


@pytest.mark.slow
@pytest.mark.parametrize(("preset", "decibels", "names"), [
    ("fast", 34, "ordinary/degree_3"),
    ("balanced", 34, "ordinary/degree_3,ordinary/needles_and_discs,nasty/infinite_scales"),
    ("small", 31, "ordinary/degree_3"),
])  # fmt: skip
def test_our_encoder_keeps_the_picture(preset, decibels, names):
    choice = EncoderSuiteOptions(names, ("L4",), psnr_min=decibels, jobs=1)
    report = run_encoder(PLACES, choice, render_score=psnr, run=encoder_here(preset))
    assert [] == report.failures
    assert {*names.split(",")} == {one.name for one in report.outcomes}


def test_refusing_everything_passes_only_where_that_is_allowed():
    refuses = program("import sys; sys.exit('error: not today')")
    report = run_encoder(refuses, EncoderSuiteOptions("*/empty,broken/nothing"))
    assert report.passed
    assert {"nasty/empty", "broken/nothing"} == {one.name for one in report.outcomes}
    assert "refused: error: not today" in {one.message for one in report.outcomes}
    ordinary = run_encoder(refuses, EncoderSuiteOptions("ordinary/one_splat"))
    assert [Status.REFUSED] == [one.status for one in ordinary.failures]


def test_a_traceback_is_a_crash():
    (failure,) = run_encoder(program("raise ValueError('oh')"), EncoderSuiteOptions("nasty/empty")).failures
    assert (Status.CRASHED, "a traceback; its last line: ValueError: oh") == (failure.status, failure.message)


def test_a_remaining_child_process_is_ended():
    lingering = program("import subprocess, sys; subprocess.Popen(['sleep', '600']); sys.exit('no')")
    ended = run_program(lingering, {"ply": "a", "out": "b"}, 30.0)
    assert (None, 1) == (ended.status, ended.returncode)


def written(folder, name):
    path = folder / "in.ply"
    path.write_bytes(INPUTS[name].make())
    return path


def test_broken_inputs_are_broken_and_must_not_be_accepted(tmp_path):
    def take(_command, places, _seconds):
        Path(places["out"]).write_bytes(b"csplat?")
        return ProcessEnd(None, 0, b"", b"", 0.0)

    def check(name):
        assert INPUTS[name].must_refuse
        with pytest.raises(InputError):
            csplat.read(written(tmp_path, name))

    report = run_encoder(PLACES, EncoderSuiteOptions("broken/*"), run=take)
    assert {"accepted an input without splats"} == {one.message for one in report.failures}
    names = {one.name: one.name for one in report.failures}
    assert {name for name in INPUTS if name.startswith("broken/")} == {*names}
    assert [] == failures(names, check)


@pytest.mark.long
def test_an_input_equals_its_scene(tmp_path):
    # Written there by hand, read here by our reader: the two share no code.
    def check(one):
        found = Source.of(csplat.read(written(tmp_path, one.name), keep_extra=True))
        wanted = one.source()
        for array in ("means", "opacities", "sh0", "shN"):
            np.testing.assert_array_equal(getattr(found, array), getattr(wanted, array), array)
        np.testing.assert_array_equal(found.scales, np.where(np.isneginf(wanted.scales), -88, wanted.scales))
        np.testing.assert_allclose(found.quats, wanted.quats, atol=1e-7)
        assert [(key, column.tobytes()) for key, column in sorted(wanted.extra.items())] == [
            (key, column.tobytes()) for key, column in sorted(found.extra.items())
        ]

    assert [] == failures([one for name, one in ENCODABLE.items() if name != DEGREE_5], check)


def test_our_encoder_refuses_degree_5(tmp_path):
    path, source = written(tmp_path, DEGREE_5), ENCODABLE[DEGREE_5].source()
    assert (5, (64, 35, 3)) == (source.sh_degree, source.shN.shape)
    blue = plyfile.PlyData.read(path)["vertex"].data["f_rest_71"]  # after 70 of red and green
    np.testing.assert_array_equal(blue, source.shN[:, 1, 2])
    with pytest.raises(InputError, match="SH degree 5, expected at most 4: --sh-degree 4"):
        csplat.read(path)


def test_figures_for_comparison_are_of_the_inputs_and_of_this_encoder(tmp_path):
    # Written by `python -m csplat_bench figures`
    figures = json.loads((files(encoders) / "figures.json").read_text("utf-8"))
    assert set(ENCODABLE) - {DEGREE_5} == set(figures)
    for name, by in figures.items():
        assert {"csplat"} <= set(by) <= {"csplat", "spz"}, name
        assert all((numbers["psnr"] is not None) == ENCODABLE[name].renders for numbers in by.values()), name
    for name in ("ordinary/degree_3", "nasty/far_doubles"):
        size = len(csplat.encode(csplat.read(written(tmp_path, name))))
        assert size == pytest.approx(figures[name]["csplat"]["bytes"], rel=0.01)

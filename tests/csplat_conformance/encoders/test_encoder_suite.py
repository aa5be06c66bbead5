"""The encoder suite: our encoder at every preset, faulty encoders, refusals, inputs, and the command."""

import json
import shlex
import sys
import tempfile
from functools import cache
from importlib.resources import files
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import plyfile
import pytest
from tables import failures

import csplat
from csplat.encoder import PRESETS
from csplat.errors import InputError
from csplat_conformance import encoders
from csplat_conformance.conformance_report import Status
from csplat_conformance.declared_bounds import Source
from csplat_conformance.encoders import EncoderSuiteOptions, all_inputs, run_encoder
from csplat_conformance.protocol import ProcessEnd, run_program
from csplat_tools.encode_file import encode_file
from encoder_faults.run import psnr

INPUTS = {one.name: one for one in all_inputs()}
ENCODABLE = {name: one for name, one in INPUTS.items() if one.source is not None}
PLACES = "{ply} {out} {index}"
INTEGRITY = ("L1", "L2", "L3")
HAS_RENDERER = find_spec("numba") is not None
DEGREE_5 = "nasty/degree_5"  # ours refuses it, and nothing else that can be encoded


def program(code):
    """Return a command line that runs Python code on {ply} and {out}; the standard library alone starts quickly."""
    return f"{shlex.quote(sys.executable)} -I -S -c {shlex.quote(code)} {{ply}} {{out}}"


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
    report = run_encoder(PLACES, EncoderSuiteOptions(",".join(names), INTEGRITY, jobs=1), run=encoder_here())
    assert [] == report.failures
    assert len(report.outcomes) >= 150
    taken = [one for one in report.outcomes if one.name != DEGREE_5]
    assert all(one.status is Status.PASSED for one in taken)  # ours refuses nothing else that it can encode


@pytest.mark.long
@pytest.mark.parametrize("preset", [preset for preset in PRESETS if preset != csplat.EncodeOptions().preset])
def test_our_encoder_passes_at_other_presets(preset):
    # CNF-5, CNF-6, SRC-3
    choice = EncoderSuiteOptions(",".join(PRESET_DEPENDENT), INTEGRITY, jobs=1)
    report = run_encoder(PLACES, choice, run=encoder_here(preset))
    assert [] == report.failures
    assert {*PRESET_DEPENDENT} == {one.name for one in report.outcomes if one.status is Status.PASSED}


@pytest.mark.slow
@pytest.mark.skipif(not HAS_RENDERER, reason="pictures require the extra [render]")
@pytest.mark.parametrize(("preset", "decibels"), [("fast", 34), ("balanced", 34), ("small", 31)])
def test_our_encoder_keeps_the_picture(preset, decibels):
    names = {"ordinary/degree_3"} | ({"ordinary/needles_and_discs"} if preset == "balanced" else set())
    choice = EncoderSuiteOptions(",".join(names), ("L4",), psnr_min=decibels, jobs=1)
    report = run_encoder(PLACES, choice, render_score=psnr, run=encoder_here(preset))
    assert [] == report.failures
    assert names == {one.name for one in report.outcomes}


def test_refusing_everything_passes_only_where_that_is_allowed():
    refuses = program("import sys; sys.exit('error: not today')")
    report = run_encoder(refuses, EncoderSuiteOptions("*/empty,broken/nothing"))
    assert report.passed
    assert {"nasty/empty", "broken/nothing"} == {one.name for one in report.outcomes}
    assert "refused: error: not today" in {one.message for one in report.outcomes}
    ordinary = run_encoder(refuses, EncoderSuiteOptions("ordinary/one_splat"))
    assert [Status.REFUSED] == [one.status for one in ordinary.failures]


def test_a_traceback_is_a_crash():
    report = run_encoder(program("raise ValueError('oh')"), EncoderSuiteOptions("nasty/empty"))
    assert [(Status.CRASHED, "a traceback; its last line: ValueError: oh")] == [
        (one.status, one.message) for one in report.failures
    ]


def test_broken_inputs_must_not_be_accepted():
    def take(_command, places, _seconds):
        Path(places["out"]).write_bytes(b"csplat?")
        return ProcessEnd(None, 0, b"", b"", 0.0)

    report = run_encoder(PLACES, EncoderSuiteOptions("broken/*"), run=take)
    assert {name for name in INPUTS if name.startswith("broken/")} == {one.name for one in report.failures}
    assert {"accepted an input without splats"} == {one.message for one in report.outcomes}


def test_a_remaining_child_process_is_ended():
    lingering = program("import subprocess, sys; subprocess.Popen(['sleep', '600']); sys.exit('no')")
    ended = run_program(lingering, {"ply": "a", "out": "b"}, 30.0)
    assert (None, 1) == (ended.status, ended.returncode)


@pytest.mark.long
def test_an_input_equals_its_scene(tmp_path):
    # Written there by hand, read here by our reader: the two share no code.
    def check(one):
        path = written(tmp_path, one.name)
        found, wanted = Source.of(csplat.read_ply(path, keep_extra=True)), one.source()
        for array in ("means", "opacities", "sh0", "shN"):
            np.testing.assert_array_equal(getattr(found, array), getattr(wanted, array), array)
        np.testing.assert_array_equal(found.scales, np.where(np.isneginf(wanted.scales), -88, wanted.scales))
        np.testing.assert_allclose(found.quats, wanted.quats, atol=1e-7)
        assert {key: column.tobytes() for key, column in wanted.extra.items()} == {
            key: column.tobytes() for key, column in found.extra.items()
        }

    assert [] == failures([one for name, one in ENCODABLE.items() if name != DEGREE_5], check)


def test_our_encoder_refuses_degree_5(tmp_path):
    one = ENCODABLE[DEGREE_5]
    (tmp_path / "in.ply").write_bytes(one.make())
    rows = plyfile.PlyData.read(tmp_path / "in.ply")["vertex"].data
    source = one.source()
    assert (5, (64, 35, 3)) == (source.sh_degree, source.shN.shape)
    np.testing.assert_array_equal(rows["f_rest_71"], source.shN[:, 1, 2])  # blue comes after 70 of red and green
    with pytest.raises(InputError, match="SH degree 5, expected at most 4: --sh-degree 4"):
        csplat.read_ply(tmp_path / "in.ply")


def test_broken_inputs_are_broken(tmp_path):
    def check(one):
        with pytest.raises(InputError):
            csplat.read_ply(written(tmp_path, one.name))

    assert [] == failures([one for one in INPUTS.values() if one.must_refuse], check)


def test_figures_for_comparison_are_of_the_inputs_and_of_this_encoder(tmp_path):
    # Written by `python -m csplat_bench figures`
    figures = json.loads((files(encoders) / "figures.json").read_text("utf-8"))
    assert set(ENCODABLE) - {DEGREE_5} == set(figures)
    for name, by in figures.items():
        assert {"csplat"} <= set(by) <= {"csplat", "spz"}, name
        assert all((numbers["psnr"] is not None) == ENCODABLE[name].renders for numbers in by.values()), name
    for name in ("ordinary/degree_3", "nasty/far_doubles"):
        size = len(csplat.encode(csplat.read_ply(written(tmp_path, name))))
        assert size == pytest.approx(figures[name]["csplat"]["bytes"], rel=0.01)


def written(folder, name):
    path = folder / "in.ply"
    path.write_bytes(INPUTS[name].make())
    return path

"""The encoder suite: its inputs, ours through it at every preset, and sloppy encoders that it must catch."""

import contextlib
import doctest
import json
import re
import shlex
import sys
import xml.etree.ElementTree as ET
from importlib.resources import files
from importlib.util import find_spec, module_from_spec, spec_from_file_location
from pathlib import Path

import numpy as np
import plyfile
import pytest
from typer.testing import CliRunner

import csplat
import csplat_conformance.report as report_module
from csplat import lint
from csplat.encoder import PRESETS
from csplat.errors import InputError
from csplat.ply import lint_ply
from csplat_conformance import encoders
from csplat_conformance.encoders import EncoderChoice, all_inputs, run_encoder
from csplat_conformance.encoders.judge import judge_stream
from csplat_conformance.encoders.matching import pair
from csplat_conformance.process import Ended, run_program
from csplat_conformance.report import Status
from csplat_conformance.stated import Source
from csplat_tools.cli.app import app

ROOT = Path(__file__).resolve().parent.parent
INPUTS = {one.name: one for one in all_inputs()}
ENCODABLE = {name: one for name, one in INPUTS.items() if one.source is not None}
OURS = f"{shlex.quote(sys.executable)} -m csplat_tools encode {{ply}} {{out}} --quiet"
INTEGRITY = ("L1", "L2", "L3")
HAS_RENDERER = find_spec("numba") is not None
PICTURES = ("ordinary/surfaces", "ordinary/glossy")
DEGREE_4 = "nasty/degree_4"  # ours refuses it, and nothing else that can be encoded


def load_sloppy():
    spec = spec_from_file_location("sloppy_encoder", ROOT / "tests" / "sloppy_encoder.py")
    module = module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module


sloppy = load_sloppy()


def invoke(*words):
    return CliRunner().invoke(app, ["conformance", "encoder", *map(str, words)])


def program(code):
    """A command line that runs some Python on {ply} and {out}."""
    return f"{shlex.quote(sys.executable)} -c {shlex.quote(code)} {{ply}} {{out}}"


# Inputs --------------------------------------------------------------------------------------------


def test_inputs_have_names_of_their_own_and_say_why():
    assert len(all_inputs()) == len(INPUTS)
    assert {"ordinary", "nasty", "broken"} == {name.split("/")[0] for name in INPUTS}
    assert all(one.why for one in INPUTS.values())


def test_ordinary_inputs_must_be_taken_and_broken_ones_refused():
    for name, one in INPUTS.items():
        assert name.startswith("broken/") == one.must_refuse
        assert name.startswith("nasty/") == one.may_refuse


@pytest.mark.parametrize("name", [name for name in ENCODABLE if name != DEGREE_4])
def test_an_input_is_the_scene_that_it_says(tmp_path, name):
    # Written by hand there, read by our reader here: the two know nothing of each other.
    one = ENCODABLE[name]
    (tmp_path / "in.ply").write_bytes(one.make())
    found, wanted = Source.of(csplat.read_ply(tmp_path / "in.ply", keep_extra=True)), one.source()

    for array in ("means", "scales", "opacities", "sh0", "shN"):
        np.testing.assert_array_equal(getattr(found, array), getattr(wanted, array), array)
    np.testing.assert_allclose(found.quats, wanted.quats, atol=1e-7)
    assert {key: column.tobytes() for key, column in wanted.extra.items()} == {
        key: column.tobytes() for key, column in found.extra.items()
    }


def test_degree_4_is_nothing_that_our_reader_says(tmp_path):
    one = ENCODABLE[DEGREE_4]
    (tmp_path / "in.ply").write_bytes(one.make())
    rows = plyfile.PlyData.read(tmp_path / "in.ply")["vertex"].data
    source = one.source()

    assert (4, (64, 24, 3)) == (source.sh_degree, source.shN.shape)
    np.testing.assert_array_equal(rows["f_rest_49"], source.shN[:, 1, 2])  # blue comes after 48 of red and green
    with pytest.raises(InputError, match="SH degree 4"):
        csplat.read_ply(tmp_path / "in.ply")


def test_far_doubles_are_what_no_origin_brings_into_single_precision(tmp_path):
    model = csplat.read_ply(written(tmp_path, "nasty/far_doubles"))
    means = ENCODABLE["nasty/far_doubles"].source().means

    assert np.float64 == means.dtype
    assert model.means_double is not None
    for origin in (means[0], np.median(means, axis=0), np.round(means.mean(axis=0))):
        near = means - origin
        assert (near != near.astype(np.float32)).any()


@pytest.mark.parametrize(
    ("name", "left_out"),
    [("nasty/not_a_number", 3), ("nasty/infinities", 4), ("nasty/infinite_scales", 4), ("nasty/beyond_float", 2)],
)
def test_rows_that_are_no_splats_are_not_in_the_source(name, left_out):
    # SRC-1
    assert 64 - left_out == len(ENCODABLE[name].source())
    assert {64} == {len(ENCODABLE[name].source()) for name in ("nasty/nan_normals", "nasty/nan_extra")}


def test_inputs_show_what_lint_knows(tmp_path):
    found = set()
    for one in INPUTS.values():
        (tmp_path / "in.ply").write_bytes(one.make())
        with contextlib.suppress(InputError):
            found |= {finding.id for finding in lint_ply(tmp_path / "in.ply")}
    known = set(re.findall(r"^\| `([a-z0-9-]+)` \|", lint.__doc__, re.MULTILINE))

    # Discs (2DGS) have a third scale that no column says, and a source cannot either.
    assert {"flat-scales"} == known - found


@pytest.mark.parametrize("name", [name for name in ENCODABLE if name != "ordinary/two_tiles"])
def test_different_splats_keep_their_distance(name):
    one = ENCODABLE[name]
    means = np.unique(one.source().means.astype(np.float64), axis=0)
    distances = np.sqrt(sum(np.square(np.subtract.outer(column, column)) for column in means.T))
    np.fill_diagonal(distances, np.inf)

    assert distances.min(initial=np.inf) >= one.apart * (1 - 1e-5)  # the lattice of float32


@pytest.mark.parametrize("name", ["ordinary/degree_3", "nasty/duplicates", "broken/cut"])
def test_an_input_is_the_same_every_time(name):
    assert INPUTS[name].make() == {one.name: one for one in all_inputs()}[name].make()


@pytest.mark.parametrize("name", [name for name, one in INPUTS.items() if one.must_refuse])
def test_broken_inputs_are_broken(tmp_path, name):
    path = written(tmp_path, name)

    with pytest.raises(InputError):
        csplat.read_ply(path)


# Pairs and errors ----------------------------------------------------------------------------------


def test_pairs_are_found_however_the_file_is_ordered():
    source = ENCODABLE["ordinary/two_tiles"].source().means.astype(np.float64)
    order = np.random.default_rng(1).permutation(len(source))[:60_000]
    moved = source[order] + np.random.default_rng(2).uniform(-0.01, 0.01, (60_000, 3))
    found = pair(source, moved, 0.06)

    np.testing.assert_array_equal(order, found.source_index)
    assert (0, 0, len(source) - 60_000) == (found.strays, found.surplus, found.missing)


def test_strays_and_surplus_are_told_apart():
    source = np.array([[0.0, 0, 0], [1, 0, 0], [5, 0, 0]])
    decoded = np.array([[0.1, 0, 0], [0.9, 0, 0], [1.1, 0, 0], [3, 0, 0]])
    found = pair(source, decoded, 1.0)

    assert (1, 1, 1) == (found.strays, found.surplus, found.missing)


def test_duplicates_are_paired_one_by_one():
    source = np.zeros((3, 3))
    assert {0, 1, 2} == set(pair(source, source + 0.01, 1.0).source_index)
    assert 1 == pair(source, np.zeros((4, 3)), 1.0).surplus
    assert 2 == pair(source, np.zeros((1, 3)), 1.0).missing


def test_any_centre_can_be_paired():
    wild = np.array([[np.inf, 0, 0], [-1e300, 1e300, 0], [0, 0, 0]])

    assert 2 == pair(np.zeros((1, 3)), wild, 1e-6).strays
    assert 3 == pair(np.zeros((0, 3)), wild, 1.0).strays
    assert 5 == pair(np.zeros((5, 3)), np.zeros((0, 3)), 1.0).missing


# Ours ----------------------------------------------------------------------------------------------


def run_here(command, places, _seconds):
    """Our command in this process, most of whose time is otherwise starting; `tests/run.sh` starts it."""
    words = [word.format(**places) for word in shlex.split(command)]
    result = CliRunner().invoke(app, words[words.index("csplat_tools") + 1 :])
    return Ended(None, result.exit_code, result.stdout_bytes, result.stderr_bytes, 0.0)


@pytest.mark.parametrize("preset", PRESETS)
def test_our_encoder_passes_at_every_preset(preset):
    # CNF-5, CNF-6
    report = run_encoder(f"{OURS} --preset {preset}", EncoderChoice(None, INTEGRITY, jobs=1), run=run_here)

    assert [] == report.failures
    assert len(report.outcomes) >= 150
    taken = [one for one in report.outcomes if one.name != DEGREE_4]
    assert all(one.status is Status.PASSED for one in taken)  # ours refuses nothing else that it can encode


@pytest.mark.skipif(not HAS_RENDERER, reason="pictures want the extra [render]")
@pytest.mark.parametrize(("preset", "decibels"), [("fast", 34), ("balanced", 34), ("small", 31)])
def test_our_encoder_keeps_the_picture(preset, decibels):
    command = f"{OURS} --preset {preset}"
    names = ["ordinary/degree_3", "ordinary/needles_and_discs", *PICTURES]
    choice = EncoderChoice(",".join(names), ("L4",), psnr_min=decibels, jobs=1)
    report = run_encoder(command, choice, pictures=sloppy.psnr, run=run_here)

    assert names == [one.name for one in report.outcomes]
    assert [] == report.failures


@pytest.mark.skipif(not HAS_RENDERER, reason="pictures want the extra [render]")
def test_what_harms_pictures_shows_in_those_of_surfaces():
    from csplat_bench.codec.inputs import MISTAKES
    from csplat_render.judge import Judge
    from csplat_tools.views import comparison_cameras

    sources = [ENCODABLE[name].source().model((0.0, 0.0, 0.0)) for name in PICTURES]
    judges = [Judge.of_source(source, comparison_cameras(source)) for source in sources]
    # SH within ±1 harm the second alone, colours within ±1 the first; what is not seen is no harm.
    unseen = {
        name
        for name, change in MISTAKES.items()
        if all(
            judge.psnr(change(source)) > INPUTS[one].psnr_min - 1.0
            for judge, source, one in zip(judges, sources, PICTURES, strict=True)
        )
    }

    assert {"16 alphas", "means in float16"} == unseen


def test_another_quality_moves_what_is_wanted_of_all_pictures():
    assert (30.0, 28.0, 32.0) == tuple(
        INPUTS[f"ordinary/{name}"].psnr_wanted(30.0) for name in ("degree_3", "needles_and_discs", "surfaces")
    )
    assert (25.0, 27.0) == tuple(INPUTS[f"ordinary/{name}"].psnr_wanted(25.0) for name in ("degree_3", "glossy"))


def test_figures_beside_ones_own_are_those_of_the_inputs():
    # Written by `python -m csplat_bench.codec.inputs --write`
    figures = json.loads((files(encoders) / "figures.json").read_text("utf-8"))

    assert set(ENCODABLE) - {DEGREE_4} == set(figures)
    for name, by in figures.items():
        assert {"csplat"} <= set(by) <= {"csplat", "spz"}, name
        assert all((numbers["psnr"] is not None) == ENCODABLE[name].renders for numbers in by.values()), name


@pytest.mark.parametrize("name", ["ordinary/degree_3", "ordinary/glossy", "nasty/far_doubles"])
def test_figures_of_ours_are_of_this_encoder(tmp_path, name):
    figures = json.loads((files(encoders) / "figures.json").read_text("utf-8"))
    size = len(csplat.encode(csplat.read_ply(written(tmp_path, name))))

    assert size == pytest.approx(figures[name]["csplat"]["bytes"], rel=0.01)


# Sloppy encoders -----------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def reports():
    """What the suite says of each mistake."""
    return {name: sloppy.find(name) for name, mistake in sloppy.MISTAKES.items() if mistake.caught[0] != "L4"}


@pytest.mark.parametrize("name", [name for name, one in sloppy.MISTAKES.items() if one.caught[0] != "L4"])
def test_a_sloppy_encoder_is_caught(reports, name):
    level, clause = sloppy.MISTAKES[name].caught
    failures = reports[name].failures

    assert not reports[name].passed
    assert level == failures[0].level
    assert clause in failures[0].clauses if clause else failures[0].clauses == ()


@pytest.mark.skipif(not HAS_RENDERER, reason="pictures want the extra [render]")
@pytest.mark.parametrize("name", [name for name, one in sloppy.MISTAKES.items() if one.caught[0] == "L4"])
def test_what_only_pictures_show_is_caught(name):
    failures = sloppy.find(name).failures

    assert "L4" == failures[-1].level
    assert "dB, wanted 30 at least" in failures[-1].message


@pytest.mark.parametrize(
    ("name", "status"),
    [
        ("half_a_file", Status.PARTIAL_OUTPUT),
        ("leaves_half", Status.PARTIAL_OUTPUT),
        ("writes_nothing", Status.NO_OUTPUT),
        ("crashes", Status.CRASHED),
        ("hangs", Status.HUNG),
        ("status_3", Status.WRONG_STATUS),
        ("silent_refusal", Status.WRONG_ANSWER),
        ("max_halved", Status.FAILED),
    ],
)
def test_ends_are_told_apart(reports, name, status):
    assert status is reports[name].failures[0].status


def test_our_encoder_without_a_mistake_passes_what_catches_them(tmp_path):
    # The mistakes are what fails, not the way of making them.
    data = csplat.encode(csplat.read_ply(written(tmp_path, "ordinary/degree_1")))
    for change in (sloppy.stated(lambda record: record), sloppy.counts(0, 0)):
        assert data == change(data)


def written(folder, name):
    path = folder / "in.ply"
    path.write_bytes(INPUTS[name].make())
    return path


# Refusals ------------------------------------------------------------------------------------------


def test_who_refuses_everything_passes_only_where_that_is_allowed():
    refuses = program("import sys; sys.exit('error: not today')")
    report = run_encoder(refuses, EncoderChoice("[nb][ar]*/[ncdo]*"))
    ordinary = run_encoder(refuses, EncoderChoice("ordinary/one_splat"))

    assert report.passed
    assert "refused: error: not today" in {one.message for one in report.outcomes}
    assert [Status.REFUSED] == [one.status for one in ordinary.failures]


def test_a_traceback_is_a_crash():
    report = run_encoder(program("raise ValueError('oh')"), EncoderChoice("nasty/empty"))

    assert [(Status.CRASHED, "a traceback; its last line: ValueError: oh")] == [
        (one.status, one.message) for one in report.failures
    ]


def test_broken_inputs_must_not_be_taken(tmp_path):
    sound = tmp_path / "sound.csplat"
    sound.write_bytes(csplat.encode(ENCODABLE["ordinary/one_splat"].source().model((0.0, 0.0, 0.0))))
    copies = program(f"import shutil, sys; shutil.copy({str(sound)!r}, sys.argv[2])")
    report = run_encoder(copies, EncoderChoice("broken/*"))

    messages = [one.message for one in report.failures]
    assert ["accepted, though there are no splats in it"] * len(report.outcomes) == messages


def test_a_child_that_is_left_behind_is_ended():
    lingering = program("import subprocess, sys; subprocess.Popen(['sleep', '600']); sys.exit('no')")
    ended = run_program(lingering, {"ply": "a", "out": "b"}, 30.0)

    assert (None, 1) == (ended.status, ended.returncode)
    assert ended.seconds < 20


def test_a_file_that_the_validator_passes_and_the_decoder_refuses_is_a_failure(monkeypatch):
    def refuse(_data):
        raise InputError("no")

    monkeypatch.setattr("csplat_conformance.encoders.judge.decode_scene", refuse)
    verdict, scene = judge_stream(csplat.encode(ENCODABLE["ordinary/one_splat"].source().model((0.0, 0.0, 0.0))))

    assert (Status.FAILED, None) == (verdict.status, scene)
    assert "csplat's decoder refuses it" in verdict.message


# The command ---------------------------------------------------------------------------------------


def test_reports_are_written_for_people_programs_and_ci(tmp_path):
    result = invoke(
        "--filter", "*/one_splat", "--level", 3, "--report", tmp_path / "r.json", "--junit", tmp_path / "r.xml",
        "--keep", tmp_path / "kept",
    )  # fmt: skip

    assert 0 == result.exit_code, result.output
    assert "all         3       3       0        0" in result.stdout
    report = json.loads((tmp_path / "r.json").read_text())
    assert ("encoder", True) == (report["suite"], report["passed"])
    assert ["L1", "L2", "L3"] == [one["level"] for one in report["outcomes"]]
    assert 0.0 == report["outcomes"][2]["details"]["means"]["stated_max"]
    root = ET.fromstring((tmp_path / "r.xml").read_text())  # noqa: S314 - our own file
    assert {"tests": "3", "failures": "0"}.items() <= root.attrib.items()
    assert ["ordinary-one_splat.csplat", "ordinary-one_splat.ply"] == sorted(
        path.name for path in (tmp_path / "kept").iterdir()
    )
    assert 1 == invoke("--filter", "*/one_splat", "--level", 1, "--report", tmp_path / "r.json").exit_code
    assert 1 == invoke("--filter", "*/one_splat", "--level", 1, "--keep", tmp_path / "kept").exit_code


def test_failures_are_shown_with_their_clause():
    command = f"{shlex.quote(sys.executable)} {ROOT / 'tests' / 'sloppy_encoder.py'} max_scale_linear {{ply}} {{out}}"
    result = invoke("--cmd", command, "--filter", "ordinary/degree_1", "--level", "1", "--junit", "-")

    assert 1 == result.exit_code
    (case,) = ET.fromstring(result.stdout).iter("testcase")  # noqa: S314 - our own text
    assert "TIL-11 E_BOX" in case[0].attrib["message"]


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("--filter", "nothing"), "no input matches 'nothing'"),
        (("--filter", "*/degree_0", "--filter", "nothing"), "no input matches 'nothing'"),
        (("--cmd", "true {ply}"), "lacks {out}"),
        (("--cmd", "true '{ply} {out}"), "cannot be used"),
        (("--cmd", "true {ply} {out} {what}"), "cannot be used"),
        (("--cmd", "/no/such/encoder {ply} {out}", "--filter", "broken/cut"), "No such file"),
        (("--level", "5"), "level '5'"),
    ],
)
def test_wrong_words_are_one_line(words, message):
    result = invoke(*words)

    assert 1 == result.exit_code
    assert message in result.stderr
    assert 1 == len(result.stderr.strip().splitlines())


def test_without_a_renderer_pictures_are_skipped_loudly(monkeypatch):
    def absent(**_):
        raise InputError("this needs numba: pip install 'csplat[render]'")

    monkeypatch.setattr("csplat_tools.cli.conformance.prepare_renderer", absent)
    result = invoke("--filter", "*/degree_0")

    assert 0 == result.exit_code
    assert "L4 SKIPPED: this needs numba" in result.stdout
    assert "L4  skipped  ordinary/degree_0  this needs numba" in result.stdout


def test_the_report_explains_itself():
    assert 0 == doctest.testmod(report_module).failed


def test_the_encoder_suite_loads_neither_encoder_nor_renderer():
    code = "import sys, csplat_conformance.encoders; print(*sorted(sys.modules))"
    ended = run_program(f"{shlex.quote(sys.executable)} -c {shlex.quote(code)}", {}, 60.0)
    loaded = ended.stdout.decode().split()

    assert not [
        name for name in loaded if name.startswith(("csplat.encoder", "csplat.ply", "csplat_tools", "numba", "torch"))
    ]

"""Wrong encoders: each has one mistake, and the suite has to say so; what an encoder is free to do passes."""

import dataclasses
from collections import Counter
from functools import cache
from importlib.util import find_spec

import numpy as np
import pytest
from typer.testing import CliRunner
from wrong_encoders import finding, serr
from wrong_encoders.encoding import encode as encode_wrongly
from wrong_encoders.mistake import Harm, Mistake
from wrong_encoders.mistakes import MISTAKES

import csplat
from csplat.encoder import encode_with_report
from csplat_conformance.encoders import all_inputs
from csplat_conformance.report import Status
from csplat_tools.cli.app import app

pytestmark = pytest.mark.usefixtures("small_views")

INPUTS = {one.name: one for one in all_inputs()}
ENCODABLE = {name: one for name, one in INPUTS.items() if one.source is not None}
HAS_RENDERER = find_spec("numba") is not None


def invoke(*words):
    return CliRunner().invoke(app, ["conformance", "encoder", *map(str, words)])


@pytest.fixture(scope="module")
def report_of():
    """What the suite says of a mistake."""
    return cache(finding.find)


def test_there_are_wrong_encoders_of_every_harm():
    harms = Counter(one.harm for one in MISTAKES.values())

    assert set(Harm) == set(harms)
    assert len(MISTAKES) - harms[Harm.HARMLESS] >= 55


def test_mistakes_are_made(tmp_path):
    # One that changes nothing would go unnoticed for no fault of the suite.
    ply, out, index = tmp_path / "in.ply", tmp_path / "out", tmp_path / "index.npy"
    known = {}
    for name, mistake in MISTAKES.items():
        only_options = dataclasses.replace(mistake, options={}) == Mistake(
            mistake.why, mistake.harm, mistake.caught, mistake.inputs
        )
        large = mistake.inputs == "ordinary/two_tiles"
        if mistake.harm is Harm.HARMLESS or mistake.end is not None or only_options or large:
            continue
        names = [one for one in finding.inputs_of(mistake) if one in ENCODABLE]
        for one in names:
            written(tmp_path, one)
            key = one, tuple(mistake.options.items())
            if key not in known:
                model = csplat.read_ply(ply, keep_extra=True)
                known[key] = encode_with_report(model, csplat.EncodeOptions(**mistake.options))
            ours = known[key]
            encode_wrongly(mistake, ply, out, index)
            if ours.data != out.read_bytes() or ours.source_index.tobytes() != np.load(index).tobytes():
                break
        else:
            assert not names, name


@pytest.mark.parametrize("name", [name for name, one in MISTAKES.items() if one.harm is not Harm.HARMLESS])
def test_a_wrong_encoder_is_caught(report_of, name):
    level, clause = MISTAKES[name].caught
    if level == "L4" and not HAS_RENDERER:
        pytest.skip("pictures want the extra [render]")
    sign = finding.first_sign(report_of(name))

    assert sign is not None, "not caught"
    assert (sign.status is Status.WARNED) == (MISTAKES[name].harm is Harm.COARSE)
    assert level == sign.level
    assert not clause or clause in sign.clauses
    if level == "L4":
        assert " dB, wanted " in sign.message


@pytest.mark.parametrize("name", [name for name, one in MISTAKES.items() if one.harm is Harm.HARMLESS])
def test_what_encoders_are_free_to_do_passes(report_of, name):
    report = report_of(name)

    assert report.passed
    assert finding.first_sign(report) is None


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
def test_ends_are_told_apart(report_of, name, status):
    assert status is report_of(name).failures[0].status


def test_our_encoder_without_a_mistake_passes_what_catches_them(tmp_path):
    # The mistakes are what fails, not the way of making them.
    data = csplat.encode(csplat.read_ply(written(tmp_path, "ordinary/degree_1")))
    for change in (serr.stated(lambda record: record), serr.counts(0, 0)):
        assert data == change(data)


def written(folder, name):
    path = folder / "in.ply"
    path.write_bytes(INPUTS[name].make())
    return path

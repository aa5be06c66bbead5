"""Wrong encoders: each has one mistake, and the suite has to say so; what an encoder is free to do passes."""

from collections import Counter
from functools import cache
from importlib.util import find_spec

import numpy as np
import pytest
from tables import failures
from wrong_encoders import finding, serr
from wrong_encoders.encoding import encode as encode_wrongly
from wrong_encoders.encoding import honest
from wrong_encoders.mistake import Harm, Mistake
from wrong_encoders.mistakes import GROUPS, MISTAKES

import csplat
from csplat_conformance.conformance_report import Status
from csplat_conformance.encoders import all_inputs

pytestmark = pytest.mark.usefixtures("small_views")

INPUTS = {one.name: one for one in all_inputs()}
ENCODABLE = {name: one for name, one in INPUTS.items() if one.source is not None}
HAS_RENDERER = find_spec("numba") is not None


#: Tests of the suite itself: they run when it changes.
in_depth = pytest.mark.area(name="suite")

#: Some of every level and harm, which `make test` tries; the others are tried when the suite changes.
REPRESENTATIVES = (
    # L1
    "half_a_file",
    "writes_nothing",
    "input_appended",
    "temporary_left",
    "time_in_options",
    "blocks_swapped",
    "max_scale_linear",
    # L2
    "last_splat_dropped",
    "y_and_z_swapped",
    "axes_guessed",
    "index_inverse",
    "pruned_most",
    # L3
    "quats_xyzw",
    "sh2_max_understated",
    "max_overstated",
    "alpha_of_three",
    # L4
    "coarse",
    # freedoms
    "talks",
    "rounded_up",
    "pruned_counted",
)


@pytest.fixture(scope="module")
def report_of():
    """Return a function that gives the suite's finding about a mistake."""
    return cache(finding.find)


def test_there_are_wrong_encoders_of_every_harm():
    harms = Counter(one.harm for one in MISTAKES.values())

    assert set(Harm) == set(harms) == {MISTAKES[name].harm for name in REPRESENTATIVES}
    assert {"", "L1", "L2", "L3", "L4"} == {MISTAKES[name].caught[0] for name in REPRESENTATIVES}
    assert len(MISTAKES) - harms[Harm.HARMLESS] >= 55


def test_every_mistake_finds_the_functions_that_it_replaces():
    def check(mistake):
        with mistake.stage():
            csplat.EncodeOptions(**mistake.options)

    assert [] == failures(MISTAKES, check)


@in_depth
@pytest.mark.slow
def test_mistakes_are_made(tmp_path):
    # One that changes nothing would go unnoticed for no fault of the suite.
    def check(mistake):
        names = [one for one in finding.inputs_of(mistake) if one in ENCODABLE]
        assert not names or any(differs(tmp_path, mistake, one) for one in names)

    def is_looked_at(mistake):
        changes = {
            name: getattr(mistake, name) for name in ("ply", "scene", "keep", "stage", "data", "index", "honest")
        }
        only_options = all(changes[name] == getattr(NOTHING, name) for name in changes)
        return mistake.harm is not Harm.HARMLESS and mistake.end is None and not only_options

    large = "ordinary/two_tiles"
    assert [] == failures(
        {name: one for name, one in MISTAKES.items() if is_looked_at(one) and one.inputs != large}, check
    )


NOTHING = Mistake("nothing", Harm.HARMLESS)


def differs(folder, mistake, name):
    """Return True if file or index differ from ours."""
    out, index = folder / "out", folder / "index.npy"
    data, source_index = honest(written(folder, name).read_bytes(), tuple(mistake.options.items()))
    encode_wrongly(mistake, folder / "in.ply", out, index)
    return data != out.read_bytes() or source_index.tobytes() != np.load(index).tobytes()


def check_report(name, report):
    """Assert that the suite reports a mistake as expected."""
    mistake = MISTAKES[name]
    level, clause = mistake.caught
    sign = finding.first_sign(report)
    if mistake.harm is Harm.HARMLESS:
        assert report.passed
        assert sign is None
        return
    assert sign is not None, "not caught"
    assert (sign.status is Status.WARNED) == (mistake.harm is Harm.COARSE)
    assert level == sign.level
    assert not clause or clause in sign.clauses
    assert level != "L4" or " dB, wanted " in sign.message


def reported(report_of, names):
    """Return the mistakes that the suite reports differently."""
    renderable = [name for name in names if HAS_RENDERER or MISTAKES[name].caught[0] != "L4"]
    return failures({name: name for name in renderable}, lambda name: check_report(name, report_of(name)))


@pytest.mark.slow
def test_wrong_encoders_of_every_level_are_caught_and_freedoms_are_left(report_of):
    assert [] == reported(report_of, REPRESENTATIVES)


@in_depth
@pytest.mark.slow
@pytest.mark.parametrize("group", GROUPS)
def test_every_wrong_encoder_is_caught_and_every_freedom_is_left(report_of, group):
    assert [] == reported(report_of, GROUPS[group])


ENDS = {
    "half_a_file": Status.PARTIAL_OUTPUT,
    "leaves_half": Status.PARTIAL_OUTPUT,
    "writes_nothing": Status.NO_OUTPUT,
    "status_3": Status.WRONG_STATUS,
    "silent_refusal": Status.WRONG_ANSWER,
    "max_halved": Status.FAILED,
}


def test_ends_are_told_apart(report_of):
    assert ENDS == {name: report_of(name).failures[0].status for name in ENDS}


@in_depth
@pytest.mark.slow
@pytest.mark.parametrize(("name", "status"), [("crashes", Status.CRASHED), ("hangs", Status.HUNG)])
def test_ends_of_processes_are_told_apart(report_of, name, status):
    assert status is report_of(name).failures[0].status


def test_our_encoder_without_a_mistake_passes_what_catches_them(tmp_path):
    # The mistakes are what fails, not the way of making them.
    data, _ = honest(written(tmp_path, "ordinary/degree_1").read_bytes())
    for change in (serr.stated(lambda record: record), serr.counts(0, 0)):
        assert data == change(data)


def written(folder, name):
    path = folder / "in.ply"
    path.write_bytes(INPUTS[name].make())
    return path

# SPDX-License-Identifier: CC0-1.0
"""Faulty encoders: the suite reports each one at the level and with the clause that it declares."""

from collections import Counter
from functools import cache

import numpy as np
import pytest
from tables import failures

import csplat
from csplat_conformance.conformance_report import Status
from csplat_conformance.encoders import all_inputs
from encoder_faults import encoding, run
from encoder_faults.fault import EncoderFault, Harm
from encoder_faults.run import FAULTS, GROUPS, honest
from encoder_faults.run import encode as encode_wrongly

INPUTS = {one.name: one for one in all_inputs()}
ENCODABLE = {name: one for name, one in INPUTS.items() if one.source is not None}


@pytest.fixture(scope="module")
def report_of():
    """Return a function for the suite's finding about a fault."""
    return cache(run.find)


def test_there_are_faults_of_every_harm_and_level():
    harms = Counter(one.harm for one in FAULTS.values())
    assert set(Harm) == set(harms)
    assert {"", "L1", "L2", "L3", "L4"} == {one.caught[0] for one in FAULTS.values()}
    assert len(FAULTS) - harms[Harm.HARMLESS] >= 55


def test_every_fault_finds_the_functions_that_it_replaces():
    def check(fault):
        with fault.stage():
            csplat.EncodeOptions(**fault.options)

    assert [] == failures(FAULTS, check)


@pytest.mark.slow
def test_faults_change_file_or_index(tmp_path):
    # A fault without an effect could not be found by any suite.
    def check(fault):
        names = [one for one in run.inputs_of(fault) if one in ENCODABLE]
        assert not names or any(differs(tmp_path, fault, one) for one in names)

    def is_looked_at(fault):
        changes = {name: getattr(fault, name) for name in ("ply", "scene", "keep", "stage", "data", "index", "honest")}
        only_options = all(changes[name] == getattr(NOTHING, name) for name in changes)
        return fault.harm is not Harm.HARMLESS and fault.end is None and not only_options

    large = "ordinary/two_tiles"
    assert [] == failures(
        {name: one for name, one in FAULTS.items() if is_looked_at(one) and one.inputs != large}, check
    )


NOTHING = EncoderFault("nothing", Harm.HARMLESS)


def differs(folder, fault, name):
    """Return True if file or index differ from ours."""
    out, index = folder / "out", folder / "index.npy"
    data, source_index = honest(written(folder, name).read_bytes(), tuple(fault.options.items()))
    encode_wrongly(fault, folder / "in.ply", out, index)
    return data != out.read_bytes() or source_index.tobytes() != np.load(index).tobytes()


def check_report(name, report):
    """Assert that the suite reports a fault as expected."""
    fault = FAULTS[name]
    level, clause = fault.caught
    sign = run.first_sign(report)
    if fault.harm is Harm.HARMLESS:
        assert report.passed
        assert sign is None
        return
    assert sign is not None, "not caught"
    assert (sign.status is Status.WARNED) == (fault.harm is Harm.COARSE)
    assert level == sign.level
    assert not clause or clause in sign.clauses
    assert level != "L4" or " dB, expected " in sign.message


@pytest.mark.slow
@pytest.mark.parametrize("group", GROUPS)
def test_every_fault_is_caught_and_every_freedom_is_left(report_of, group):
    assert [] == failures({name: name for name in GROUPS[group]}, lambda name: check_report(name, report_of(name)))


@pytest.mark.slow
@pytest.mark.parametrize(("name", "status"), [
    ("half_a_file", Status.PARTIAL_OUTPUT), ("leaves_half", Status.PARTIAL_OUTPUT),
    ("writes_nothing", Status.NO_OUTPUT), ("status_3", Status.WRONG_STATUS), ("silent_refusal", Status.WRONG_ANSWER),
    ("max_overstated", Status.FAILED), ("crashes", Status.CRASHED), ("hangs", Status.HUNG),
])  # fmt: skip
def test_ends_of_a_run_are_distinguished(report_of, name, status):
    assert status is report_of(name).failures[0].status


def test_our_encoder_without_a_fault_passes_the_same_checks(tmp_path):
    # The failures come from the faults and not from the method of planting them.
    data, _ = honest(written(tmp_path, "ordinary/degree_1").read_bytes())
    for change in (encoding.declared(lambda record: record), encoding.counts(0, 0)):
        assert data == change(data)


def written(folder, name):
    path = folder / "in.ply"
    path.write_bytes(INPUTS[name].make())
    return path

# SPDX-License-Identifier: CC0-1.0
"""Decoders with a planted fault: a vector that names the clause fails, and the decoder is right again afterwards."""

from contextlib import ExitStack
from dataclasses import replace
from unittest import mock

import pytest
from tables import failures

from csplat import _spec
from csplat.decoder import decode_api
from csplat.decoder.container import open_chunk
from csplat_conformance import adapter
from csplat_conformance.conformance_report import Status
from csplat_conformance.manifest import load
from csplat_conformance.tolerance import EXACT, RENDERER
from csplat_selftest.decoder_faults import (
    DecoderFault,
    ModuleEdit,
    all_faults,
    edited,
    edited_module,
    find,
    off_by,
    single_precision,
    table,
)
from csplat_selftest.decoder_processes import missing_javascript
from csplat_selftest.single_precision import GPUS

needs_node = pytest.mark.skipif(bool(missing_javascript()), reason=f"skipped: {missing_javascript()}")

VECTOR_LIST = load()
PYTHON = [fault for fault in all_faults() if fault.language == "Python"]
JAVASCRIPT = [fault for fault in all_faults() if fault.language == "JavaScript"]


def covering(*clauses):
    return [vector for vector in VECTOR_LIST if {*clauses} & {*vector.clauses}]


def named(name):
    return next(vector for vector in VECTOR_LIST if vector.name == name)


#: Clauses of one fault in frames, texts, streams, codings, values and floats each.
REPRESENTATIVES = ("HDR-6", "CHK-1", "JSN-1", "STR-3", "CBK-3", "TIL-7", "CNF-8")


def failing(faults):
    """Return the faults that no vector of their clause reveals, or that leave the decoder changed."""
    rich = named("valid/rich")
    before = adapter.answer(rich.data)

    def check(fault):
        finding = find(fault, covering(fault.clause))
        assert finding.vectors
        assert fault.clause in finding.clauses
        assert before.arrays == adapter.answer(rich.data).arrays

    assert Status.PASSED is before.status
    return failures({f"{fault.clause} {fault.name}": fault for fault in faults}, check)


def test_a_wrong_decoder_fails_a_vector_that_names_the_clause_and_is_right_again_afterwards():
    first = {fault.clause: fault for fault in reversed(PYTHON)}
    assert [] == failing([first[clause] for clause in REPRESENTATIVES])


@pytest.mark.slow
def test_every_wrong_decoder_fails_a_vector_that_names_the_clause_and_is_right_again_afterwards():
    assert [] == failing(PYTHON)


def test_every_fault_finds_what_it_replaces():
    def check(fault):
        if fault.language == "JavaScript":
            edited_module(fault.plant)
        else:
            with ExitStack() as stack:
                fault.plant(stack)

    faults = {f"{fault.language} {fault.clause} {fault.name}": fault for fault in all_faults()}
    assert [] == failures(faults, check)
    with pytest.raises(ValueError, match="expected once"):
        edited_module(ModuleEdit("container.mjs", {"another text": ""}))
    with ExitStack() as stack, pytest.raises(ValueError, match="expected once"):
        edited("read_sparse", {"another text": ""})(stack)


@pytest.mark.parametrize("gpu", [gpu for gpus in GPUS.values() for gpu in gpus], ids=str)
def test_a_decoder_in_single_precision_is_a_renderer_and_not_exact(gpu):
    vectors = covering("CNF-7", "CNF-8", "QUA-2", "LEV-1")
    decoder = DecoderFault("none", "", "CNF-7", single_precision(gpu), RENDERER)
    assert [] == list(find(decoder, vectors).failed)
    assert "CNF-7" in find(replace(decoder, by=EXACT), vectors).clauses


@pytest.mark.parametrize(("ulps", "by", "failed"), [(2, RENDERER, False), (3, RENDERER, True), (2, EXACT, True)])
def test_a_renderer_may_be_off_by_2_ulp_and_an_exact_decoder_by_none(ulps, by, failed):
    finding = find(DecoderFault("off", "", "CNF-7", off_by(ulps), by), [named("extreme/means_cancelling")])
    assert (["extreme/means_cancelling"] if failed else []) == finding.vectors
    assert {"L3"} >= {outcome.level for outcome in finding.failed}


def test_a_decoder_that_leaves_ancillary_payloads_unread_passes_every_vector_on_chunks():
    # CHK-6: frame and CRC of these chunks are checked all the same.
    def frames(view, header, kind=_spec.CHUNK_DECLARED_ERRORS, *_):
        if record := header.chunk(kind):
            open_chunk(view, record, record.type, record.flags, "CHK-6")

    def apply(stack):
        for name in ("json_chunk", "bounds_chunk"):
            stack.enter_context(mock.patch.object(decode_api, name, frames))

    about_chunks = [one for one in VECTOR_LIST if {"CHK", "JSN", "SER"} & {name[:3] for name in one.clauses}]

    assert [] == list(find(DecoderFault("none", "", "CHK-6", apply), about_chunks).failed)


@needs_node
def test_a_wrong_javascript_decoder_is_caught():
    (fault,) = [fault for fault in JAVASCRIPT if fault.name == "quats, sign of w"]
    assert "QUA-2" in find(fault, [named("valid/quats")]).clauses


@needs_node
@pytest.mark.slow
def test_every_wrong_javascript_decoder_fails_a_vector_that_names_the_clause():
    def check(fault):
        assert fault.clause in find(fault, covering(fault.clause)).clauses

    assert [] == failures({f"{fault.clause} {fault.name}": fault for fault in JAVASCRIPT}, check)


def test_the_table_names_fault_vectors_and_clauses():
    fault = next(fault for fault in PYTHON if fault.clause == "HDR-6")
    row = table([find(fault, [named("invalid/trailing")])]).splitlines()[-1]
    assert "| Python | trailing bytes | trailing bytes are accepted | 1 | `invalid/trailing` | HDR-6 |" == row

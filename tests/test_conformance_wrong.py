"""Decoders that are wrong on purpose: the suite notices each, and names the clause."""

from contextlib import ExitStack
from dataclasses import replace
from unittest import mock

import pytest

from csplat import _spec
from csplat.decoder import job
from csplat.decoder.container import open_chunk
from csplat_conformance import adapter, wrong
from csplat_conformance.manifest import load
from csplat_conformance.mistakes import reworded
from csplat_conformance.near import EXACT, RENDERER
from csplat_conformance.node import missing_javascript
from csplat_conformance.report import Status
from csplat_conformance.single import GPUS
from csplat_conformance.wrong import MISTAKES
from csplat_conformance.wrong_js import EDITS, catch_edit, edited
from csplat_conformance.wrong_single import off_by, single_precision

needs_javascript = pytest.mark.skipif(bool(missing_javascript()), reason=f"skipped: {missing_javascript()}")


@pytest.mark.parametrize("mistake", MISTAKES, ids=lambda mistake: mistake.name)
def test_a_wrong_decoder_fails_a_vector_that_names_the_clause(mistake):
    vectors = [vector for vector in load() if mistake.clause in vector.clauses]
    caught = wrong.catch(mistake, vectors)

    assert caught.vectors
    assert mistake.clause in caught.clauses


@pytest.mark.parametrize("mistake", MISTAKES, ids=lambda mistake: mistake.name)
def test_the_decoder_is_right_again_afterwards(mistake):
    vector = next(vector for vector in load() if vector.name == "valid/rich")
    before = adapter.answer(vector.data)
    wrong.catch(mistake, [vector])

    assert Status.PASSED == before.status
    assert before.arrays == adapter.answer(vector.data).arrays


def test_a_right_decoder_is_not_caught():
    nothing = wrong.Mistake("none", "", "CHK-1", lambda _: None)

    assert [] == list(wrong.catch(nothing).failed)


@pytest.mark.parametrize("gpu", [gpu for gpus in GPUS.values() for gpu in gpus], ids=str)
def test_a_decoder_in_single_precision_is_a_renderer_and_not_exact(gpu):
    vectors = [vector for vector in load() if {"CNF-7", "CNF-8", "QUA-2", "LEV-1"} & {*vector.clauses}]
    decoder = wrong.Mistake("none", "", "CNF-7", single_precision(gpu), RENDERER)

    assert [] == list(wrong.catch(decoder, vectors).failed)
    assert "CNF-7" in wrong.catch(replace(decoder, by=EXACT), vectors).clauses


@pytest.mark.parametrize(("ulps", "by", "failed"), [(2, RENDERER, False), (3, RENDERER, True), (2, EXACT, True)])
def test_a_renderer_may_be_off_by_2_ulp_and_an_exact_decoder_by_none(ulps, by, failed):
    vectors = [vector for vector in load() if vector.name == "extreme/means_cancelling"]
    caught = wrong.catch(wrong.Mistake("off", "", "CNF-7", off_by(ulps), by), vectors)

    assert (["extreme/means_cancelling"] if failed else []) == caught.vectors
    assert {"L3"} >= {outcome.level for outcome in caught.failed}


def test_a_decoder_that_leaves_ancillary_payloads_unread_passes_every_vector():
    # CHK-6: frame and CRC of these chunks are looked at all the same.
    def frames(view, header, kind=_spec.CHUNK_STATED_ERRORS, *_):
        if record := header.chunk(kind):
            open_chunk(view, record, record.type, record.flags, "CHK-6")

    def apply(stack):
        for name in ("read_json", "read_serr"):
            stack.enter_context(mock.patch.object(job, name, frames))

    assert [] == list(wrong.catch(wrong.Mistake("none", "", "CHK-6", apply)).failed)


@needs_javascript
@pytest.mark.parametrize("edit", EDITS, ids=lambda edit: edit.name)
def test_a_wrong_javascript_decoder_fails_a_vector_that_names_the_clause(edit):
    vectors = [vector for vector in load() if edit.clause in vector.clauses]

    assert edit.clause in catch_edit(edit, vectors).clauses


def test_an_edit_that_finds_nothing_to_change_is_an_error():
    with pytest.raises(ValueError, match="wanted once"):
        edited(EDITS[0], "another text")


def test_clauses_that_0_2_added_or_changed_have_wrong_decoders_of_their_own():
    wanted = """HDR-2 HDR-12 ATT-10 LAT-1 LAT-3 LAT-4 SPA-1 SPA-2 SPA-3 CHK-1 CHK-2 CBK-2 CBK-4 CBK-7 COD-5 COD-6 COD-7
    COD-8 EXR-2 JSN-1 CNF-7 CNF-8"""

    assert set() == {*wanted.split()} - {mistake.clause for mistake in MISTAKES}


def test_words_that_a_function_lacks_are_an_error():
    with ExitStack() as stack, pytest.raises(ValueError, match="wanted once"):
        reworded("read_sparse", {"another text": ""})(stack)


def test_there_are_ten_mistakes_and_more():
    assert len(MISTAKES) >= 20
    assert len({mistake.name for mistake in MISTAKES}) == len(MISTAKES)


def test_the_table_names_mistake_vectors_and_clauses():
    mistake = next(mistake for mistake in MISTAKES if mistake.clause == "HDR-6")
    vectors = [vector for vector in load() if vector.name == "invalid/trailing"]

    row = wrong.table([wrong.catch(mistake, vectors)]).splitlines()[-1]
    assert "| Python | trailing bytes | bytes behind the file are accepted | 1 | `invalid/trailing` | HDR-6 |" == row

"""Decoders that are wrong on purpose: the suite notices each, and names the clause."""

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
from csplat_conformance.single_precision import GPUS
from csplat_conformance.tolerance import EXACT, RENDERER
from csplat_selftest import wrong
from csplat_selftest.decoder_processes import js_folder, missing_javascript
from csplat_selftest.mistakes import reworded
from csplat_selftest.wrong import MISTAKES
from csplat_selftest.wrong_js import EDITS, catch_edit, edited
from csplat_selftest.wrong_single import off_by, single_precision

needs_javascript = pytest.mark.skipif(bool(missing_javascript()), reason=f"skipped: {missing_javascript()}")


VECTOR_LIST = load()
#: Tests of the suite itself: they run when it changes.
in_depth = pytest.mark.area(name="suite")


def covering(*clauses):
    return [vector for vector in VECTOR_LIST if {*clauses} & {*vector.clauses}]


def named(name):
    return next(vector for vector in VECTOR_LIST if vector.name == name)


#: Clauses of one mistake in frames, texts, streams, codings, values and floats each.
REPRESENTATIVES = ("HDR-6", "CHK-1", "JSN-1", "STR-3", "CBK-3", "TIL-7", "CNF-8")


def failing(mistakes):
    """Return the mistakes that no vector of their clause shows, or that leave the decoder wrong."""
    rich = named("valid/rich")
    before = adapter.answer(rich.data)

    def check(mistake):
        caught = wrong.catch(mistake, covering(mistake.clause))
        assert caught.vectors
        assert mistake.clause in caught.clauses
        assert before.arrays == adapter.answer(rich.data).arrays

    assert Status.PASSED is before.status
    return failures({f"{mistake.clause} {mistake.name}": mistake for mistake in mistakes}, check)


def test_a_wrong_decoder_fails_a_vector_that_names_the_clause_and_is_right_again_afterwards():
    first = {mistake.clause: mistake for mistake in reversed(MISTAKES)}

    assert [] == failing([first[clause] for clause in REPRESENTATIVES])


@in_depth
@pytest.mark.slow
def test_every_wrong_decoder_fails_a_vector_that_names_the_clause_and_is_right_again_afterwards():
    assert [] == failing(MISTAKES)


def test_every_mistake_finds_the_functions_that_it_replaces():
    def check(mistake):
        with ExitStack() as stack:
            mistake.apply(stack)

    assert [] == failures({f"{mistake.clause} {mistake.name}": mistake for mistake in MISTAKES}, check)


def test_a_right_decoder_is_not_caught():
    # The built-in run, in test_conformance.py, asks it about every vector.
    nothing = wrong.Mistake("none", "", "CHK-1", lambda _: None)

    assert [] == list(wrong.catch(nothing, covering("CHK-1", "HDR-2", "QUA-2")).failed)


@in_depth
@pytest.mark.parametrize("gpu", [gpu for gpus in GPUS.values() for gpu in gpus], ids=str)
def test_a_decoder_in_single_precision_is_a_renderer_and_not_exact(gpu):
    vectors = covering("CNF-7", "CNF-8", "QUA-2", "LEV-1")
    decoder = wrong.Mistake("none", "", "CNF-7", single_precision(gpu), RENDERER)

    assert [] == list(wrong.catch(decoder, vectors).failed)
    assert "CNF-7" in wrong.catch(replace(decoder, by=EXACT), vectors).clauses


@pytest.mark.parametrize(("ulps", "by", "failed"), [(2, RENDERER, False), (3, RENDERER, True), (2, EXACT, True)])
def test_a_renderer_may_be_off_by_2_ulp_and_an_exact_decoder_by_none(ulps, by, failed):
    caught = wrong.catch(wrong.Mistake("off", "", "CNF-7", off_by(ulps), by), [named("extreme/means_cancelling")])

    assert (["extreme/means_cancelling"] if failed else []) == caught.vectors
    assert {"L3"} >= {outcome.level for outcome in caught.failed}


@in_depth
def test_a_decoder_that_leaves_ancillary_payloads_unread_passes_every_vector_on_chunks():
    # CHK-6: frame and CRC of these chunks are looked at all the same.
    def frames(view, header, kind=_spec.CHUNK_STATED_ERRORS, *_):
        if record := header.chunk(kind):
            open_chunk(view, record, record.type, record.flags, "CHK-6")

    def apply(stack):
        for name in ("read_json", "read_serr"):
            stack.enter_context(mock.patch.object(decode_api, name, frames))

    about_chunks = [one for one in VECTOR_LIST if {"CHK", "JSN", "SER"} & {name[:3] for name in one.clauses}]

    assert [] == list(wrong.catch(wrong.Mistake("none", "", "CHK-6", apply), about_chunks).failed)


@needs_javascript
def test_a_wrong_javascript_decoder_is_caught():
    (edit,) = [edit for edit in EDITS if edit.name == "quats, sign of w"]

    assert "QUA-2" in catch_edit(edit, [named("valid/quats")]).clauses


@needs_javascript
@in_depth
@pytest.mark.slow
def test_every_wrong_javascript_decoder_fails_a_vector_that_names_the_clause():
    def check(edit):
        assert edit.clause in catch_edit(edit, covering(edit.clause)).clauses

    assert [] == failures({f"{edit.clause} {edit.name}": edit for edit in EDITS}, check)


def test_every_edit_finds_what_it_changes():
    def check(edit):
        edited(edit, (js_folder() / edit.file).read_text(encoding="utf-8"))

    assert [] == failures({f"{edit.clause} {edit.name}": edit for edit in EDITS}, check)


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

    row = wrong.table([wrong.catch(mistake, [named("invalid/trailing")])]).splitlines()[-1]
    assert "| Python | trailing bytes | bytes behind the file are accepted | 1 | `invalid/trailing` | HDR-6 |" == row

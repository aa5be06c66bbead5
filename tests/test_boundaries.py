"""The rules of the registry about fields, against what decoders and validator check: those are written by hand."""

import pytest

import csplat
from csplat import _spec
from csplat_conformance._rules import CHOICES, RANGES
from csplat_conformance.boundaries import cases, held
from csplat_conformance.builder import build
from csplat_conformance.node import JsDecoder, missing_javascript
from csplat_conformance.recipes import sound_recipes
from csplat_conformance.report import Status
from csplat_conformance.validator import validate

CASES = list(cases())
IDS = [f"{case.rule.structure}.{case.rule.field} {case.rule.of} {case.suffix}" for case in CASES]
by_case = pytest.mark.parametrize("case", CASES, ids=IDS)


@pytest.fixture(scope="module")
def valid():
    """The valid vectors, with the places of their fields."""
    return [build(recipe.scene) for recipe in sound_recipes() if recipe.scene is not None]


@pytest.fixture(scope="module")
def javascript():
    if missing_javascript():
        pytest.skip(missing_javascript())
    with JsDecoder() as decoder:
        yield decoder


@by_case
def test_the_decoder_refuses_what_lies_beyond(case):
    with pytest.raises(csplat.CsplatError) as caught:
        csplat.decode(case.data(), threads=1)

    error = caught.value
    assert (case.rule.code, case.rule.clause, case.offset) == (error.code, error.clause, error.offset)


@by_case
def test_the_javascript_decoder_refuses_what_lies_beyond(case, javascript):
    answer = javascript.ask(case.data())

    assert answer.status == Status.REFUSED
    assert (case.rule.code, case.rule.clause, case.offset) == (answer.code, answer.clause, answer.offset)


@by_case
def test_the_validator_finds_what_lies_beyond(case):
    found = {(one.clause, one.code) for one in validate(case.data()).violations}

    assert (case.rule.clause, case.rule.code) in found


@pytest.mark.parametrize("rule", RANGES, ids=lambda rule: f"{rule.structure}.{rule.field} {rule.of}")
def test_valid_vectors_hold_both_ends_of_each_range(rule, valid):
    assert {rule.low, rule.high} <= {value for built in valid for value in held(built, rule)}


@pytest.mark.parametrize("rule", CHOICES, ids=lambda rule: f"{rule.structure}.{rule.field}")
def test_valid_vectors_hold_each_value_of_an_enum_and_no_other(rule, valid):
    values = {value for built in valid for value in held(built, rule)}
    if (rule.structure, rule.field) in {("extra_record", "dtype"), ("layer_record", "layer")}:
        values = {value for value in values if value < _spec.ANCILLARY_ID_MIN}
    assert set(rule.used) == values

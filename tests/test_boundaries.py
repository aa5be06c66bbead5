"""The rules of the registry about fields, against what decoders and validator check: those are written by hand."""

from dataclasses import replace
from functools import cache

import pytest
from tables import failures

import csplat
from csplat import _spec
from csplat_conformance._rules import CHOICES, RANGES
from csplat_conformance.boundaries import cases, held
from csplat_conformance.builder import build
from csplat_conformance.manifest import VECTORS
from csplat_conformance.mutate import mapped
from csplat_conformance.node import JsDecoder, missing_javascript
from csplat_conformance.recipes import sound_recipes
from csplat_conformance.report import Status
from csplat_conformance.validator import validate


@pytest.fixture(scope="module")
def beyond():
    """Each case and its file, by name."""
    return {named(case.rule) + f" {case.suffix}": (case, case.data()) for case in cases()}


def named(rule):
    return f"{rule.structure}.{rule.field} {getattr(rule, 'of', '')}".rstrip()


#: Vectors with so many entries that only their index is read.
OF_MANY = {"extreme/codebook_of_65536", "extreme/codebooks_of_many_splats"}


@pytest.fixture(scope="module")
def valid():
    """A function: the valid vectors, each with the places of the fields of one structure."""
    builts = [
        mapped((VECTORS / f"{recipe.name}.csplat").read_bytes()) if recipe.name in OF_MANY else build(recipe.scene)
        for recipe in sound_recipes()
        if recipe.scene is not None
    ]

    @cache
    def of(structure):
        def is_read(name, field):
            return field.structure == structure or name.endswith(".coding")  # which tells streams apart

        return [
            replace(built, fields={name: one for name, one in built.fields.items() if is_read(name, one)})
            for built in builts
        ]

    return of


@pytest.fixture(scope="module")
def javascript():
    if missing_javascript():
        pytest.skip(missing_javascript())
    with JsDecoder() as decoder:
        yield decoder


def test_the_decoder_refuses_what_lies_beyond(beyond):
    def check(pair):
        case, data = pair
        with pytest.raises(csplat.CsplatError) as caught:
            csplat.decode(data, threads=1)
        error = caught.value
        assert (case.rule.code, case.rule.clause, case.offset) == (error.code, error.clause, error.offset)

    assert [] == failures(beyond, check)


def test_the_javascript_decoder_refuses_what_lies_beyond(beyond, javascript):
    def check(pair):
        case, data = pair
        answer = javascript.ask(data)
        assert Status.REFUSED == answer.status
        assert (case.rule.code, case.rule.clause, case.offset) == (answer.code, answer.clause, answer.offset)

    assert [] == failures(beyond, check)


@pytest.mark.slow
def test_the_validator_finds_what_lies_beyond(beyond):
    def check(pair):
        case, data = pair
        assert (case.rule.clause, case.rule.code) in {(one.clause, one.code) for one in validate(data).violations}

    assert [] == failures(beyond, check)


@pytest.mark.slow
def test_valid_vectors_hold_both_ends_of_each_range(valid):
    def check(rule):
        missing = {rule.low, rule.high}
        for built in valid(rule.structure):
            missing -= held(built, rule) if missing else set()
        assert set() == missing

    assert [] == failures({named(rule): rule for rule in RANGES}, check)


@pytest.mark.slow
def test_valid_vectors_hold_each_value_of_an_enum_and_no_other(valid):
    def check(rule):
        values = {value for built in valid(rule.structure) for value in held(built, rule)}
        if (rule.structure, rule.field) in {("extra_record", "dtype"), ("layer_record", "layer")}:
            values = {value for value in values if value < _spec.ANCILLARY_ID_MIN}
        assert set(rule.used) == values

    assert [] == failures({named(rule): rule for rule in CHOICES}, check)

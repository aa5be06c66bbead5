"""The rules of the registry about fields, against what decoders and validator check: those are written by hand."""

from dataclasses import replace

import pytest
from tables import failures

import csplat
from csplat import _spec
from csplat_authoring._rules import CHOICES, RANGES
from csplat_authoring.boundaries import cases, held
from csplat_authoring.builder import build
from csplat_authoring.recipes import sound_recipes
from csplat_conformance.conformance_report import Status
from csplat_conformance.manifest import VECTORS, load
from csplat_conformance.validator import validate
from csplat_selftest.decoder_processes import JsDecoder, missing_javascript
from csplat_selftest.fuzzing.damage import built_from


@pytest.fixture(scope="module")
def beyond():
    """Cases and their files, by name.

    Vectors are run by all decoders and the validator anyway: for a mask the first bit and the last. Of the bits
    between them in reserved fields every third is here, in flags all.
    """
    vectors = {vector.data: vector.error for vector in load() if vector.error}
    found = {}
    for number, case in enumerate(cases()):
        if case.rule.field.startswith("reserved_") and number % 3:
            continue
        data, rule = case.data(), case.rule
        wanted = {"code": rule.code, "clause": rule.clause, "offset": case.offset}
        if not wanted.items() <= (vectors.get(data) or {}).items():
            found[f"{named(rule)} {case.suffix}"] = case, data
    return found


FULL_TILE = "extreme/tile_of_65536"


def named(rule):
    return f"{rule.structure}.{rule.field} {getattr(rule, 'of', '')}".rstrip()


#: Vectors with too many splats or entries to read more than their index.
OF_MANY = {"extreme/codebook_of_65536", "extreme/codebooks_of_many_splats", FULL_TILE}


@pytest.fixture(scope="module")
def valid():
    """A function: the valid vectors that have fields of a structure, each with the places of these."""
    builts = [
        built_from((VECTORS / f"{recipe.name}.csplat").read_bytes()) if recipe.name in OF_MANY else build(recipe.scene)
        for recipe in sound_recipes()
        if recipe.scene is not None
    ]
    found = {}
    for built in builts:
        by_structure = {}
        for name, field in built.fields.items():
            by_structure.setdefault(field.structure, {})[name] = field
        # A block's coding determines the meaning of its streams.
        codings = {name: field for name, field in built.fields.items() if name.endswith(".coding")}
        for structure, fields in by_structure.items():
            found.setdefault(structure, []).append(replace(built, fields=codings | fields))
    return found.__getitem__


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


@pytest.mark.slow
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


@pytest.mark.area(name="vectors")
def test_valid_vectors_hold_both_ends_of_each_range(valid):
    (full,) = [recipe.scene.tiles[0].blocks for recipe in sound_recipes() if recipe.name == FULL_TILE]
    in_streams = {"sparse_params.present_count": {sum(full[_spec.ATTRIBUTE_SH0 + 1].mask)}}

    def check(rule):
        missing = {rule.low, rule.high} - in_streams.get(named(rule), set())
        for built in valid(rule.structure):
            missing -= held(built, rule) if missing else set()
        assert set() == missing

    assert [] == failures({named(rule): rule for rule in RANGES}, check)


@pytest.mark.area(name="vectors")
def test_valid_vectors_hold_each_value_of_an_enum_and_no_other(valid):
    def check(rule):
        values = {value for built in valid(rule.structure) for value in held(built, rule)}
        if (rule.structure, rule.field) in {("extra_record", "dtype"), ("layer_record", "layer")}:
            values = {value for value in values if value < _spec.ANCILLARY_ID_MIN}
        assert set(rule.used) == values

    assert [] == failures({named(rule): rule for rule in CHOICES}, check)

"""The conformance vectors against our own decoder, and the recipes against the vectors."""

import dataclasses
import hashlib
from dataclasses import replace

import pytest
from tables import differing, failures

import csplat
from csplat import _spec
from csplat.decoder import Limits, iter_tiles
from csplat_authoring._rules import CHOICES, RANGES
from csplat_authoring.boundaries import cases, held
from csplat_authoring.builder import build, repair
from csplat_authoring.recipes import sound_recipes
from csplat_authoring.samples import rich_scene
from csplat_conformance import decoder_suite, manifest
from csplat_conformance.conformance_report import Status
from csplat_conformance.decoder_suite import DecoderSuiteOptions
from csplat_conformance.manifest import VECTORS, load, summarise
from csplat_conformance.validator import validate
from csplat_selftest.decoder_processes import JsDecoder, missing_javascript
from csplat_selftest.fuzzing.damage import built_from

VECTOR_LIST = load()
VALID = [vector for vector in VECTOR_LIST if not vector.error]
INVALID = [vector for vector in VECTOR_LIST if vector.error]
FLOATS = ("means", "quats", "scales", "opacities", "sh0", "shN")


def named(name):
    return next(vector for vector in VECTOR_LIST if vector.name == name)


def refusal(decode, vector):
    """Return code, clause and offset of the error that refuses a vector."""
    with pytest.raises(csplat.CsplatError) as caught:
        decode(vector.data)
    return caught.value.code, caught.value.clause, caught.value.offset


def test_integers_are_those_of_the_manifest():
    def check(vector):
        assert [] == differing(vector.expect["integers"], summarise(csplat.decode_integers(vector.data)))

    assert [] == failures(VALID, check)


def test_floats_are_those_of_the_manifest_bit_for_bit():
    def check(vector):
        model = csplat.decode(vector.data)
        floats = summarise({name: getattr(model, name) for name in FLOATS})
        assert [] == differing(vector.expect["floats"], floats)
        assert [] == differing(vector.expect["extra"], summarise(model.extra))

    assert [] == failures(VALID, check)


def test_refusals_name_code_clause_and_offset_of_the_defect():
    def check(vector):
        wanted = vector.error["code"], vector.error["clause"], vector.error["offset"]
        assert wanted == refusal(csplat.decode, vector)

    assert [] == failures(INVALID, check)


def test_integers_are_refused_with_the_same_code():
    def check(vector):
        assert vector.error["code"] == refusal(csplat.decode_integers, vector)[0]

    assert [] == failures(INVALID, check)


def test_the_built_in_run_passes_every_vector_once_per_level():
    # The vectors named from a to c; a step of the gate, `csplat conformance decoder`, runs all of them.
    report = decoder_suite.run_builtin(DecoderSuiteOptions(pattern="*/[a-c]*"))
    valid, invalid = (
        [one.name for one in vectors if one.name.split("/")[1][0] in "abc"] for vectors in (VALID, INVALID)
    )
    assert sorted(valid + invalid) == sorted(one.name for one in report.outcomes if one.level == "L1")
    assert valid == [one.name for one in report.outcomes if one.level == "L2"]
    assert valid == [one.name for one in report.outcomes if one.level == "L3"]
    assert min(len(valid), len(invalid)) > 20
    assert [] == report.failures


def test_the_built_in_run_accepts_a_pattern():
    assert {vector.name for vector in VALID if vector.name.startswith("valid/codebook")} == {
        outcome.name for outcome in decoder_suite.run_builtin(DecoderSuiteOptions(pattern="valid/codebook*")).outcomes
    }


def test_files_are_those_that_the_manifest_names():
    found = {
        path.relative_to(VECTORS).as_posix(): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in VECTORS.rglob("*.csplat")
    }
    assert {vector.file: vector.sha256 for vector in VECTOR_LIST} == found


def test_every_error_code_of_files_has_a_vector():
    from csplat import _spec

    codes = {vector.error["code"] for vector in INVALID}
    assert set(_spec.ERROR_NAMES) - {_spec.ERROR_INPUT} == codes


def test_vectors_stay_well_below_five_megabytes():
    assert sum(path.stat().st_size for path in VECTORS.rglob("*") if path.is_file()) < 1_600_000


def test_repair_leaves_a_valid_file_unchanged():
    for vector in VALID:
        assert vector.data == repair(vector.data)


def test_a_file_beyond_the_splat_budget_is_refused_before_its_tiles_are_read():
    # LIM-1
    built = build(rich_scene())
    damaged = built.patched({"TILE.0.0/head.block_count": 0})
    with pytest.raises(csplat.LimitError) as caught:
        csplat.decode(damaged, limits=Limits(splats=4))
    assert (csplat.LimitError, "E_LIMIT", "LIM-1") == (type(caught.value), caught.value.code, caught.value.clause)


def test_a_file_beyond_the_byte_budget_is_refused():
    # LIM-1
    data = named("extreme/tile_of_65536").data
    with pytest.raises(csplat.LimitError):
        csplat.decode(data, limits=Limits(bytes=1_000_000))


def test_every_decoding_function_checks_the_whole_file():
    ways = (
        lambda data: csplat.decode(data, threads=1),
        lambda data: csplat.decode(data, threads=2),
        lambda data: csplat.decode_integers(data, threads=1),
        lambda data: list(iter_tiles(data)),
    )
    names = ("index_crc", "chunk_crc", "metadata_crc", "stated_errors_crc", "unknown_chunk_crc")

    def check(vector):
        assert [vector.error["code"]] * len(ways) == [refusal(decode, vector)[0] for decode in ways]

    assert [] == failures([named(f"invalid/{name}") for name in names], check)


def test_a_wrong_hash_fails_the_run(monkeypatch):
    vector = named("valid/quats")
    digest = vector.expect["floats"]["quats"]
    wrong = vector.expect | {"floats": vector.expect["floats"] | {"quats": [*digest[:2], "0" * 64]}}
    monkeypatch.setattr(decoder_suite, "load", lambda: [dataclasses.replace(vector, expect=wrong)])
    (failure,) = decoder_suite.run_builtin().failures
    assert ("L3", Status.FAILED, "floats.quats differs") == (failure.level, failure.status, failure.message)


def test_an_accepted_broken_file_fails_the_run(monkeypatch):
    vector = named("valid/quats")
    error = {"code": "E_RANGE", "clause": "QUA-2", "offset": 0, "also": [], "optional": ""}
    monkeypatch.setattr(decoder_suite, "load", lambda: [dataclasses.replace(vector, expect={}, error=error)])
    (failure,) = decoder_suite.run_builtin().failures
    assert (Status.FAILED, "accepted", "QUA-2") == (failure.status, failure.message, failure.clauses[0])


def test_differing_decoding_functions_fail_the_run(monkeypatch):
    monkeypatch.setattr(csplat.decoder, "decode_integers", csplat.decoder.decode)
    report = decoder_suite.run_builtin(DecoderSuiteOptions(pattern="invalid/quat_radicand"))
    assert report.passed

    def refuse(*_args, **_options):
        raise csplat.FormatError("E_RANGE", 0, "QUA-2")

    monkeypatch.setattr(csplat.decoder, "decode_integers", refuse)
    failure = decoder_suite.run_builtin(DecoderSuiteOptions(pattern="valid/quats")).failures[0]
    assert "decode and decode_integers differ: accepted; E_RANGE" in failure.message


def test_a_manifest_entry_round_trips():
    text = manifest.to_json(VECTOR_LIST)
    assert text == (VECTORS / "manifest.json").read_text(encoding="utf-8")


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
            found[f"{title(rule)} {case.suffix}"] = case, data
    return found


FULL_TILE = "extreme/tile_of_65536"


def title(rule):
    return f"{rule.structure}.{rule.field} {getattr(rule, 'of', '')}".rstrip()


#: Vectors with too many splats or entries to read more than their index.
OF_MANY = {"extreme/codebook_of_65536", "extreme/codebooks_of_many_splats", FULL_TILE}


@pytest.fixture(scope="module")
def valid():
    """Return a function for the valid vectors with fields of a structure, and the places of these fields."""
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


def test_the_decoder_refuses_values_beyond_a_range(beyond):
    def check(pair):
        case, data = pair
        with pytest.raises(csplat.CsplatError) as caught:
            csplat.decode(data, threads=1)
        error = caught.value
        assert (case.rule.code, case.rule.clause, case.offset) == (error.code, error.clause, error.offset)

    assert [] == failures(beyond, check)


@pytest.mark.slow
def test_the_javascript_decoder_refuses_values_beyond_a_range(beyond, javascript):
    def check(pair):
        case, data = pair
        answer = javascript.ask(data)
        assert Status.REFUSED == answer.status
        assert (case.rule.code, case.rule.clause, case.offset) == (answer.code, answer.clause, answer.offset)

    assert [] == failures(beyond, check)


@pytest.mark.slow
def test_the_validator_finds_values_beyond_a_range(beyond):
    def check(pair):
        case, data = pair
        assert (case.rule.clause, case.rule.code) in {(one.clause, one.code) for one in validate(data).violations}

    assert [] == failures(beyond, check)


@pytest.mark.area(name="vectors")
def test_valid_vectors_hold_both_ends_of_each_range(valid):
    (full,) = [recipe.scene.tiles[0].blocks for recipe in sound_recipes() if recipe.name == FULL_TILE]
    in_streams = {"sparse_params.present_count": {sum(full[_spec.ATTRIBUTE_SH0 + 1].mask)}}

    def check(rule):
        missing = {rule.low, rule.high} - in_streams.get(title(rule), set())
        for built in valid(rule.structure):
            missing -= held(built, rule) if missing else set()
        assert set() == missing

    assert [] == failures({title(rule): rule for rule in RANGES}, check)


@pytest.mark.area(name="vectors")
def test_valid_vectors_hold_each_value_of_an_enum_and_no_other(valid):
    def check(rule):
        values = {value for built in valid(rule.structure) for value in held(built, rule)}
        if (rule.structure, rule.field) in {("extra_record", "dtype"), ("layer_record", "layer")}:
            values = {value for value in values if value < _spec.ANCILLARY_ID_MIN}
        assert set(rule.used) == values

    assert [] == failures({title(rule): rule for rule in CHOICES}, check)

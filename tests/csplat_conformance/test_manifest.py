# SPDX-License-Identifier: Apache-2.0
"""The conformance vectors, their manifest, the documents for implementers, and our own decoder against them."""

from __future__ import annotations

import hashlib
import json
import re
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import jsonschema
import numpy as np
import pytest
from tables import differing, failures

import csplat
from csplat import _spec
from csplat.context import Context
from csplat.decoder import Limits, iter_tiles
from csplat_authoring._rules import CHOICES, RANGES
from csplat_authoring.boundaries import cases, held
from csplat_authoring.builder import build
from csplat_authoring.clauses import DOCUMENTS, UNCOVERED, clause_ids, clause_map, specification
from csplat_authoring.recipes import sound_recipes
from csplat_authoring.samples import rich_scene
from csplat_authoring.worked_example import worked_example
from csplat_conformance.declared_bounds import Source
from csplat_conformance.encoders.reference_ply import PlyRows, source_of_rows
from csplat_conformance.manifest import VECTORS, load, summarise, to_json
from csplat_conformance.validator import validate
from csplat_selftest.decoder_processes import JsDecoder, missing_javascript
from csplat_selftest.fuzzing.damage import built_from

ROOT = Path(__file__).resolve().parents[2]
FORMAT, ENCODERS = (path.read_text(encoding="utf-8") for path in DOCUMENTS)
#: The normative sections from 3 on.
BODY = FORMAT.split("## 3 Terms")[1].split("## 10 Versioning")[0] + ENCODERS.split("## E Guidance")[0]
VECTOR_LIST = load()
NAMED = {vector.name: vector for vector in VECTOR_LIST}
VALID = [vector for vector in VECTOR_LIST if not vector.error]
INVALID = [vector for vector in VECTOR_LIST if vector.error]
SCENES = {recipe.name: recipe.scene for recipe in sound_recipes() if recipe.scene is not None}
FLOATS = ("means", "quats", "scales", "opacities", "sh0", "shN")


def refusal(decode, vector):
    """Return code, clause and offset of the error that refuses a vector."""
    with pytest.raises(csplat.CsplatError) as caught:
        decode(vector.data)
    return caught.value.code, caught.value.clause, caught.value.offset


@pytest.mark.slow
def test_integers_and_floats_are_those_of_the_manifest_bit_for_bit():
    def check(vector):
        assert [] == differing(vector.expect["integers"], summarise(csplat.decode_integers(vector.data)))
        model = csplat.decode(vector.data)
        floats = summarise({name: getattr(model, name) for name in FLOATS})
        assert [] == differing(vector.expect["floats"], floats)
        assert [] == differing(vector.expect["extra"], summarise(model.extra))

    assert [] == failures(VALID, check)


def decode_all(data):
    """Decode floats and integers; only the latter are decoded at all levels of detail (CHK-8)."""
    csplat.decode(data)
    csplat.decode_integers(data)


@pytest.mark.slow
def test_refusals_name_code_clause_and_offset_of_the_defect():
    def check(vector):
        wanted = vector.error["code"], vector.error["clause"], vector.error["offset"]
        assert wanted == refusal(decode_all, vector)
        assert wanted[0] == refusal(csplat.decode_integers, vector)[0]

    assert [] == failures(INVALID, check)


def test_payloads_of_coarser_tiles_are_left_unread_by_a_decode_to_floats():
    # CHK-8
    for name in ("invalid/coarse_tile_box", "invalid/coarse_tile_stream"):
        assert 5 == len(csplat.decode(NAMED[name].data))


def test_a_file_beyond_a_budget_is_refused_before_its_tiles_are_read():
    # LIM-1
    damaged = build(rich_scene()).patched({"TILE.0.0/head.block_count": 0})
    large = NAMED[FULL_TILE].data
    for data, limits in ((damaged, Limits(splats=4)), (large, Limits(bytes=1_000_000))):
        with pytest.raises(csplat.LimitError) as caught:
            csplat.decode(data, limits=limits)
        assert ("E_LIMIT", "LIM-1") == (caught.value.code, caught.value.clause)


def test_every_decoding_function_checks_the_whole_file():
    ways = (
        lambda data: csplat.decode(data, context=Context(threads=1)),
        lambda data: csplat.decode(data, context=Context(threads=2)),
        lambda data: csplat.decode_integers(data, context=Context(threads=1)),
        lambda data: list(iter_tiles(data)),
    )
    names = ("index_crc", "chunk_crc", "metadata_crc", "declared_errors_crc", "unknown_chunk_crc")

    def check(vector):
        assert [vector.error["code"]] * len(ways) == [refusal(decode, vector)[0] for decode in ways]

    assert [] == failures([NAMED[f"invalid/{name}"] for name in names], check)


def test_files_with_levels_or_several_tiles_have_cuts_in_boxes_and_no_others_have_any():
    several = {name for name, scene in SCENES.items() if scene.nodes or len(scene.tiles) > 1}
    texts = {vector.name: [text for text, _ in vector.expect.get("cuts", ())] for vector in VALID}
    assert several == {name for name, cuts in texts.items() if any(" box " in text for text in cuts)}
    of_levels = {name for name in several if SCENES[name].nodes}
    assert of_levels == {name for name, cuts in texts.items() if any(" box " not in text for text in cuts)}


def test_a_manifest_round_trips():
    assert to_json(VECTOR_LIST) == (VECTORS / "manifest.json").read_text(encoding="utf-8")


@pytest.fixture(scope="module")
def beyond():
    """Cases and their files, by name.

    Vectors are run by all decoders and the validator anyway: for a mask the first bit and the last. Of the bits
    between them in reserved fields every third is here, in flags all.
    """
    vectors = {vector.data: vector.error for vector in INVALID}
    found = {}
    for number, case in enumerate(cases()):
        if case.rule.field.startswith("reserved_") and number % 3:
            continue
        data, rule = case.data(), case.rule
        wanted = {"code": rule.code, "clause": rule.clause, "offset": case.offset}
        if not wanted.items() <= (vectors.get(data) or {}).items():
            found[f"{title(rule)} {case.suffix}"] = case, data
    return found


def title(rule):
    return f"{rule.structure}.{rule.field} {getattr(rule, 'of', '')}".rstrip()


FULL_TILE = "extreme/tile_of_65536"
#: Vectors with too many splats or entries to read more than their index.
OF_MANY = {"extreme/codebook_of_65536", "extreme/codebooks_of_many_splats", FULL_TILE}


@pytest.fixture(scope="module")
def valid():
    """Return a function for the valid vectors with fields of a structure, and the places of these fields."""
    found = {}
    for name, made in SCENES.items():
        built = built_from((VECTORS / f"{name}.csplat").read_bytes()) if name in OF_MANY else build(made)
        by_structure = {}
        for place, field in built.fields.items():
            by_structure.setdefault(field.structure, {})[place] = field
        # A block's coding determines the meaning of its streams.
        codings = {place: field for place, field in built.fields.items() if place.endswith(".coding")}
        for structure, fields in by_structure.items():
            found.setdefault(structure, []).append(replace(built, fields=codings | fields))
    return found.__getitem__


@pytest.fixture(params=["Python", "JavaScript"])
def error_of(request):
    """Return a function for the error of a decoder."""

    def python(data):
        with pytest.raises(csplat.CsplatError) as caught:
            csplat.decode(data, context=Context(threads=1))
        return caught.value

    if request.param == "Python":
        yield python
    elif missing_javascript():
        pytest.skip(f"skipped: {missing_javascript()}")
    else:
        with JsDecoder() as decoder:
            yield decoder.ask


@pytest.mark.slow
def test_decoders_refuse_values_beyond_a_range(beyond, error_of):
    def check(pair):
        (case, data), rule = pair, pair[0].rule
        error = error_of(data)
        assert (rule.code, rule.clause, case.offset) == (error.code, error.clause, error.offset)

    assert [] == failures(beyond, check)


@pytest.mark.slow
def test_the_validator_finds_values_beyond_a_range(beyond):
    def check(pair):
        case, data = pair
        assert (case.rule.clause, case.rule.code) in {(one.clause, one.code) for one in validate(data).violations}

    assert [] == failures(beyond, check)


@pytest.mark.long
def test_valid_vectors_hold_both_ends_of_each_range(valid):
    full = SCENES[FULL_TILE].tiles[0].blocks
    in_streams = {"sparse_params.present_count": {sum(full[_spec.ATTRIBUTE_SH0 + 1].mask)}}

    def check(rule):
        missing = {rule.low, rule.high} - in_streams.get(title(rule), set())
        for built in valid(rule.structure):
            missing -= held(built, rule) if missing else set()
        assert set() == missing

    assert [] == failures({title(rule): rule for rule in RANGES}, check)


@pytest.mark.slow
def test_valid_vectors_hold_each_value_of_an_enum_and_no_other(valid):
    def check(rule):
        values = {value for built in valid(rule.structure) for value in held(built, rule)}
        ancillary = {"dtype", "layer", "projection", "antialiasing", "colour_space"}  # ANC-2 to ANC-4
        if rule.field in ancillary:
            values = {value for value in values if value < _spec.ANCILLARY_ID_MIN}
        if rule.field == "layer":  # those of the extra columns follow that of the first
            assert set(range(_spec.LAYER_EXTRA, _spec.LAYER_EXTRA + _spec.EXTRA_COLUMNS_MAX)) <= values
            values = {value for value in values if value <= _spec.LAYER_EXTRA}
        assert set(rule.used) == values

    assert [] == failures({title(rule): rule for rule in CHOICES}, check)


SCHEMA = json.loads((VECTORS / "manifest.schema.json").read_text(encoding="utf-8"))
MANIFEST = json.loads((VECTORS / "manifest.json").read_text(encoding="utf-8"))
ENTRIES = {entry["name"]: entry for entry in MANIFEST["vectors"]}


@pytest.mark.long
def test_the_manifest_is_valid_by_its_schema():
    jsonschema.Draft202012Validator.check_schema(SCHEMA)
    jsonschema.Draft202012Validator(SCHEMA).validate(MANIFEST)


@pytest.mark.parametrize(("name", "change"), [
    ("valid/quats", {"sha256": "0"}),
    ("valid/quats", {"expect": {}}),
    ("valid/quats", {"clauses": []}),
    ("valid/quats", {"note": "more"}),
    ("valid/quats", {"name": "other/quats"}),
    ("valid/quats", {"error": {"code": "E_CRC"}}),
    ("invalid/index_crc", {"error": {}}),
    ("invalid/index_crc", {"expect": {"header": {}}}),
    ("render/ellipsoids", {"views": [{"psnr": 40}]}),
    *(("valid/levels", {"expect": ENTRIES["valid/levels"]["expect"] | {"cuts": [cut]}})
      for cut in (["level one", [0]], ["level 1", [-1]], ["level 1", [0, 0]])),
])  # fmt: skip
def test_the_schema_refuses_invalid_manifests(name, change):
    with pytest.raises(jsonschema.ValidationError):
        jsonschema.Draft202012Validator(SCHEMA).validate(MANIFEST | {"vectors": [ENTRIES[name] | change]})


def test_files_and_pictures_are_those_of_the_manifest():
    entries = MANIFEST["vectors"]
    listed = {entry["file"]: entry["sha256"] for entry in entries}
    listed |= {view["picture"]: view["sha256"] for entry in entries for view in entry.get("views", ())}
    found = [path for path in VECTORS.rglob("*") if path.is_file() and not path.name.startswith("manifest")]
    assert listed == {
        path.relative_to(VECTORS).as_posix(): hashlib.sha256(path.read_bytes()).hexdigest() for path in found
    }


def clauses_with_codes():
    """Yield clause and error code of each requirement that names one: the last code before the id."""
    for match in re.finditer(r"\[([A-Z]{3}-\d+)\]", BODY):
        sentence = re.split(r"\n\n|\]", BODY[: match.start()])[-1]
        codes = re.findall(r"\((E_[A-Z]+)", sentence)
        if codes:
            yield match[1], set(codes)


UNBREAKABLE = {
    "AXI-1": "the width that STR-2 allows ensures it",
    "CBK-6": "its refusals name QUA-1, QUA-2 or LAT-4",
    "CBK-7": "its refusals name QUA-1, QUA-2 or LAT-5",
}


def test_every_code_and_every_clause_that_can_be_broken_is_broken_by_a_vector():
    found = {(vector.error["clause"], vector.error["code"]) for vector in INVALID}
    assert set(_spec.ERROR_NAMES) - {_spec.ERROR_INPUT} == {code for _, code in found}
    codes_by_clause = dict(clauses_with_codes())
    assert len(codes_by_clause) > 80
    unbroken = {clause for clause, codes in codes_by_clause.items() if not {(clause, code) for code in codes} & found}
    assert set() == unbroken - {*UNBREAKABLE}
    assert set() == {*UNBREAKABLE} & {clause for clause, _ in found}, "no excuse is needed"


#: The attribute and block of all data in the scenes of the vectors.
BLOCKS = [
    pair
    for scene in SCENES.values()
    for tile in scene.tiles
    for pair in [*tile.blocks.items(), *((_spec.ATTRIBUTE_EXTRA, block) for block in tile.extras)]
]


def streams(block):
    """Yield the coding of each stream of a block."""
    if block.indices:
        yield block.index_coding
    if block.coding != _spec.CODING_CODEBOOK or block.summands:
        yield block.stream_coding
    if block.coding == _spec.CODING_SPARSE:
        assert block.mask_coding.width == 1


def ids(names, legal):
    return {value for value, name in names.items() if name in legal}


def test_every_attribute_occurs_in_each_legal_coding_mapping_and_with_escapes():
    codings, mappings = _spec.ATTRIBUTE_CODINGS.items(), _spec.ATTRIBUTE_MAPPINGS.items()
    legal = {(a, c) for a, names in codings for c in ids(_spec.CODING_NAMES, names)}
    assert legal == {(attribute, block.coding) for attribute, block in BLOCKS}
    legal = {(a, m) for a, names in mappings for m in ids(_spec.MAPPING_NAMES, names)}
    assert legal == {(a, record.mapping) for scene in SCENES.values() for a, record in scene.attributes.items()}
    assert {a for a, names in codings if "codebook" in names} == {a for a, block in BLOCKS if block.escape}


def test_every_coding_has_streams_of_every_width_and_every_coder_meets_every_list_of_transforms():
    codings = ((c, most) for c, most in _spec.CODING_WIDTH_MAX.items() if c in _spec.CODING_NAMES)
    legal = {(coding, width) for coding, most in codings for width in range(1, most + 1)}
    legal -= {(_spec.CODING_RAW, width) for width in (3, 5, 6, 7)}  # no type has them
    assert set() == legal - {(block.coding, how.width) for _, block in BLOCKS for how in streams(block)}
    for coder in ("stored", "deflate_stored", "deflate_fixed", "deflate_dynamic"):
        assert 16 == len({how.transforms for _, block in BLOCKS for how in streams(block) if how.coder == coder})


def test_every_kind_type_flag_direction_measure_and_degree_occurs():
    scenes = SCENES.values()
    assert set(_spec.CODEBOOK_KIND_NAMES) == {book.kind for scene in scenes for book in scene.codebooks}
    dtypes = {extra.dtype for scene in scenes for extra in scene.extras}
    assert set(_spec.EXTRA_DTYPE_NAMES) == {dtype for dtype in dtypes if dtype < _spec.ANCILLARY_ID_MIN}
    assert set(_spec.DIRECTION_NAMES) == {axis for scene in scenes for axis in scene.axes}
    assert {0, 1, 2, 3, 4} == {scene.sh_degree for scene in scenes}
    assert set(_spec.CHUNK_NAMES) - {b"TILE", b"CODB", b"TREE"} <= {chunk.type for s in scenes for chunk in s.chunks}
    measures = {m for s in scenes for chunk in s.chunks if chunk.errors for m, _, _ in chunk.errors.records}
    assert set(_spec.MEASURE_NAMES) == measures
    known = {
        "kernel": _spec.KERNEL_NAMES, "projection": _spec.PROJECTION_NAMES,
        "antialiasing": _spec.ANTIALIASING_NAMES, "colour_space": _spec.COLOUR_SPACE_NAMES,
    }  # fmt: skip
    for name, values in known.items():
        assert set(values) == {getattr(scene, name) for scene in scenes} & set(range(_spec.ANCILLARY_ID_MIN))
    for bit in _spec.SCENE_FLAG_NAMES:
        assert {True, False} == {bool(scene.scene_flags & bit) for scene in scenes}


GUIDE = (ROOT / "spec" / "encoders.md").read_text(encoding="utf-8").replace("−", "-")
LEVELS, ALPHAS, MEAN_STEP, SCALE_STEP, SH0_STEP = 127, 63, 0.01, 1 / 16, 1 / 64


@pytest.fixture(scope="module")
def row():
    """Return a function for the numbers in the row of the example with a given beginning, a list for each splat."""
    part = GUIDE.split("### E.7 An example of declared errors")[1].split("So SERR declares")[0]
    rows = [re.split(" {2,}", line) for line in part.split("```text")[1].splitlines()]
    table = {cells[0]: [re.findall(r"-?\d+(?:\.\d+)?", cell) for cell in cells[1:]] for cells in rows}

    def numbers(name):
        return [[float(number) for number in cell] for cell in table[name]]

    return numbers


@pytest.fixture(scope="module")
def source(row) -> Source:
    columns = {
        "means": row("x, y, z"),
        "quats": row("rot_0 … rot_3"),
        "scales": row("scale_0 … scale_2"),
        "logits": [value for (value,) in row("opacity")],
        "sh0": row("f_dc_0 … f_dc_2"),
    }
    arrays = {name: np.array(values, np.float32) for name, values in columns.items()}
    return source_of_rows(PlyRows(**arrays, shN=np.zeros((2, 0, 3), np.float32)))


@pytest.fixture(scope="module")
def file(spec, row):
    """Decode the integers of the guide's example with the functions of the guide."""
    colours = [spec.rgb_from_ycocg(*map(int, one), 0) for one in row("sh0, integers Y, Co, Cg")]

    def lattice(rows, step):
        return np.array([[spec.lattice_value(int(n), step, 0) for n in one] for one in rows], np.float32)

    return SimpleNamespace(
        origin=np.zeros(3),
        means=lattice(row("means, integers"), MEAN_STEP),
        scales=lattice(row("scales, integers"), SCALE_STEP),
        quats=np.array([spec.quat(*map(int, one), LEVELS) for one in row("quats, integers")]),
        opacities=[spec.opacity_square(int(q), ALPHAS) for (q,) in row("opacities, integer")],
        sh0=lattice(colours, SH0_STEP),
    )


def near(expected, found):
    np.testing.assert_allclose(np.array(found, np.float64), np.array(expected), rtol=0, atol=6e-8)


def test_the_values_and_the_code_of_the_guide_give_the_declared_errors(row, source, file):
    near(row("quaternion of the source"), source.quats)
    near(row("alpha of the source"), source.opacities[:, None])
    near(row("decoded quaternion"), file.quats)
    near(row("decoded alpha"), [[alpha] for alpha in file.opacities])
    near(row("decoded sh0"), file.sh0)
    code = re.search(r"### E.7 An example of declared errors.*?```python\n(.*?)```", GUIDE, re.DOTALL)[1]
    names = {"source": source, "file": file}
    exec(code, names)  # noqa: S102 - the text is the project's own
    for j in range(2):
        for name, values in names["errors"](j, j):
            near(row(f"error of {name}")[j], values)
    part = GUIDE.split("So SERR declares")[1].split("## ")[0]
    table = dict(re.findall(r"^(\w+) +([\d.]+ +[\d.]+)$", part, re.MULTILINE))
    for name, pair in names["declared"]([0, 1]).items():
        near([float(number) for number in table[name].split()], pair)


def test_every_must_ends_in_a_clause_id():
    # An error could not cite a paragraph that has a requirement and no id.
    body = re.sub(r"```.*?```", "", BODY, flags=re.DOTALL)
    sentences = re.findall(r"[^.\n|][^|]*?MUST(?: NOT)?\b[^|]*?(?:\[[A-Z]{3}-\d+\]|\n\n)", body)
    assert [] == [sentence for sentence in sentences if not sentence.endswith("]")]


def test_every_clause_has_one_id_and_is_covered_by_a_vector_or_excused():
    covered = {clause for vector in VECTOR_LIST for clause in vector.clauses}
    assert sorted(clause_ids(specification())) == sorted([*covered, *UNCOVERED])


def test_an_excuse_that_points_at_a_test_finds_the_clause_there():
    def check(clause):
        for name in re.findall(r"`(test_\w+\.py)`", UNCOVERED[clause]):
            (path,) = (ROOT / "tests").rglob(name)
            assert clause in path.read_text(encoding="utf-8")

    assert [] == failures({clause: clause for clause in UNCOVERED}, check)


def test_example_and_map_of_clauses_equal_the_output_of_the_recipes():
    assert worked_example() == (ROOT / "spec" / "example.md").read_text(encoding="utf-8")
    assert clause_map(specification(), VECTOR_LIST) == (ROOT / "conformance" / "CLAUSES.md").read_text(encoding="utf-8")

"""The manifest by its schema; which features and clauses the vectors reach."""

import fnmatch
import hashlib
import json
import re
import subprocess
import sys
from pathlib import Path

import jsonschema
import pytest

from csplat import _spec
from csplat_authoring.clauses import clause_ids
from csplat_authoring.recipes import sound_recipes
from csplat_conformance.manifest import VECTORS

ROOT = Path(__file__).resolve().parent.parent
TEXT = (ROOT / "spec" / "format.md").read_text(encoding="utf-8")
SCHEMA = json.loads((VECTORS / "manifest.schema.json").read_text(encoding="utf-8"))
MANIFEST = json.loads((VECTORS / "manifest.json").read_text(encoding="utf-8"))
SCENES = [recipe.scene for recipe in sound_recipes() if recipe.scene is not None]

# Clauses that name an error code and cannot be broken by a file alone, or only together with another.
UNBREAKABLE = {
    "AXI-1": "the width that STR-2 allows ensures it",
    "CBK-6": "its refusals name QUA-1, QUA-2 or LAT-4",
    "CBK-7": "its refusals name QUA-1, QUA-2 or LAT-5",
}


def named(name):
    return next(entry for entry in MANIFEST["vectors"] if entry["name"] == name)


@pytest.mark.slow
@pytest.mark.area(name="vectors")
def test_the_manifest_is_valid_by_its_schema():
    jsonschema.Draft202012Validator.check_schema(SCHEMA)
    jsonschema.Draft202012Validator(SCHEMA).validate(MANIFEST)


@pytest.mark.parametrize(
    ("name", "change"),
    [
        ("valid/quats", {"sha256": "0"}),
        ("valid/quats", {"expect": {}}),
        ("valid/quats", {"clauses": []}),
        ("valid/quats", {"note": "more"}),
        ("valid/quats", {"name": "other/quats"}),
        ("valid/quats", {"error": {"code": "E_CRC"}}),
        ("invalid/index_crc", {"error": {}}),
        ("invalid/index_crc", {"expect": {"header": {}}}),
        ("render/ellipsoids", {"views": [{"psnr": 40}]}),
    ],
)
def test_the_schema_refuses_what_a_manifest_must_not_hold(name, change):
    wrong = MANIFEST | {"vectors": [named(name) | change]}

    with pytest.raises(jsonschema.ValidationError):
        jsonschema.Draft202012Validator(SCHEMA).validate(wrong)


def test_files_and_pictures_are_those_of_the_manifest():
    listed = {entry["file"]: entry["sha256"] for entry in MANIFEST["vectors"]}
    listed |= {view["picture"]: view["sha256"] for entry in MANIFEST["vectors"] for view in entry.get("views", ())}
    found = [path for path in VECTORS.rglob("*") if path.is_file() and not path.name.startswith("manifest")]

    assert listed == {
        path.relative_to(VECTORS).as_posix(): hashlib.sha256(path.read_bytes()).hexdigest() for path in found
    }


# Clauses -------------------------------------------------------------------------------------------


def clauses_with_codes():
    """Yield clause and error code of each requirement that names one: the last code before the id."""
    body = TEXT.split("## 3 Terms")[1].split("## A Worked example")[0]
    for match in re.finditer(r"\[([A-Z]{3}-\d+)\]", body):
        sentence = re.split(r"\n\n|\]", body[: match.start()])[-1]
        codes = re.findall(r"\((E_[A-Z]+)", sentence)
        if codes:
            yield match[1], set(codes)


def test_most_clauses_name_an_error_code():
    assert len(dict(clauses_with_codes())) > 80


def test_every_clause_that_can_be_broken_is_broken_by_a_vector():
    found = {(entry["error"]["clause"], entry["error"]["code"]) for entry in MANIFEST["vectors"] if entry["error"]}
    unbroken = {clause for clause, codes in clauses_with_codes() if not {(clause, code) for code in codes} & found}

    assert set() == unbroken - {*UNBREAKABLE}
    assert set() == {*UNBREAKABLE} & {clause for clause, _ in found}, "no excuse is needed"


# The guide -----------------------------------------------------------------------------------------


GUIDE = (ROOT / "conformance" / "IMPLEMENTERS.md").read_text(encoding="utf-8")


def test_the_guide_names_vectors_that_exist():
    names = {*re.findall(r"`((?:valid|extreme|invalid)/[a-z0-9_]+)`", GUIDE)}

    assert names
    assert set() == names - {entry["name"] for entry in MANIFEST["vectors"]}


def test_patterns_of_the_guide_find_vectors():
    patterns = {*re.findall(r"'?((?:valid|extreme)/[a-z0-9_]*\*)'?", GUIDE)}
    names = [entry["name"] for entry in MANIFEST["vectors"]]

    assert patterns
    assert [] == [pattern for pattern in sorted(patterns) if not fnmatch.filter(names, pattern)]


def test_the_guide_walks_through_every_chapter_of_clauses():
    chapters = {clause.split("-")[0] for clause in clause_ids(TEXT)}
    # Not steps of a decoder: general rules, and groups that their neighbours' steps include.
    elsewhere = {
        "NUM",
        "RES",
        "ORD",
        "ATT",
        "TLE",
        "CDB",
        "STR",
        "TRF",
        "BLK",
        "LEV",
        "AXI",
        "LAT",
        "RAW",
        "MEA",
        "QUA",
    }

    assert [] == [chapter for chapter in chapters - elsewhere if chapter not in GUIDE]


def test_every_level_and_status_is_explained():
    from csplat_conformance.conformance_report import Status

    words = {str(status) for status in Status} - {"skipped"}
    assert [] == [word for word in words if word not in GUIDE]
    assert all(f"L{level}" in GUIDE for level in (1, 2, 3, 4))


# Features ------------------------------------------------------------------------------------------


def blocks(scene):
    """Yield attribute and block of everything in a scene, escapes too."""
    for tile in scene.tiles:
        yield from tile.blocks.items()
        yield from ((_spec.ATTRIBUTE_EXTRA, block) for block in tile.extras)


def streams(block):
    """Yield how each stream of a block is coded."""
    if block.indices:
        yield block.index_coding
    if block.coding != _spec.CODING_CODEBOOK or block.summands:
        yield block.stream_coding
    if block.coding == _spec.CODING_SPARSE:
        assert block.mask_coding.width == 1


def ids(names, legal):
    return {value for value, name in names.items() if name in legal}


def test_every_attribute_is_coded_in_every_way_it_may():
    legal = {(a, c) for a, names in _spec.ATTRIBUTE_CODINGS.items() for c in ids(_spec.CODING_NAMES, names)}

    assert legal == {(attribute, block.coding) for scene in SCENES for attribute, block in blocks(scene)}


def test_every_coding_has_streams_of_every_width():
    legal = {
        (c, w) for c, most in _spec.CODING_WIDTH_MAX.items() if c in _spec.CODING_NAMES for w in range(1, most + 1)
    }
    legal -= {(_spec.CODING_RAW, width) for width in (3, 5, 6, 7)}  # no type has them

    found = {(b.coding, how.width) for scene in SCENES for _, b in blocks(scene) for how in streams(b)}
    assert set() == legal - found


@pytest.mark.parametrize("coder", ["stored", "deflate_stored", "deflate_fixed", "deflate_dynamic"])
def test_every_list_of_transforms_meets_every_coder(coder):
    found = {how.transforms for s in SCENES for _, b in blocks(s) for how in streams(b) if how.coder == coder}

    assert 16 == len(found)


def test_every_mapping_kind_type_flag_direction_measure_and_degree_occurs():
    mappings = {(a, m) for a, names in _spec.ATTRIBUTE_MAPPINGS.items() for m in ids(_spec.MAPPING_NAMES, names)}

    assert mappings == {(a, record.mapping) for scene in SCENES for a, record in scene.attributes.items()}
    assert set(_spec.CODEBOOK_KIND_NAMES) == {book.kind for scene in SCENES for book in scene.codebooks}
    dtypes = {extra.dtype for scene in SCENES for extra in scene.extras}
    assert set(_spec.EXTRA_DTYPE_NAMES) == {dtype for dtype in dtypes if dtype < _spec.ANCILLARY_ID_MIN}
    assert set(_spec.DIRECTION_NAMES) == {axis for scene in SCENES for axis in scene.axes}
    assert {0, 1, 2, 3} == {scene.sh_degree for scene in SCENES}
    assert set(_spec.CHUNK_NAMES) - {b"TILE", b"CODB"} <= {chunk.type for scene in SCENES for chunk in scene.chunks}
    measures = {m for s in SCENES for chunk in s.chunks if chunk.errors for m, _, _ in chunk.errors.records}
    assert set(_spec.MEASURE_NAMES) == measures
    for bit in _spec.SCENE_FLAG_NAMES:
        assert {True, False} == {bool(scene.scene_flags & bit) for scene in SCENES}


def test_every_attribute_that_a_codebook_may_serve_has_escapes():
    escaped = {attribute for scene in SCENES for attribute, block in blocks(scene) if block.escape}

    assert {a for a, names in _spec.ATTRIBUTE_CODINGS.items() if "codebook" in names} == escaped


@pytest.mark.area(name="vectors")
def test_vectors_and_annexes_are_those_of_the_recipes():
    words = [sys.executable, "-m", "csplat_authoring", "--check"]
    done = subprocess.run(words, capture_output=True, text=True, check=False)
    assert (0, "") == (done.returncode, done.stdout + done.stderr)

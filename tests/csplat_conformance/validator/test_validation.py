# SPDX-License-Identifier: Apache-2.0
"""The strict validator: every violation by its clause, of vectors, of damaged files, and of files with many defects.

Also: csplat_conformance.validator.ancillary_chunks, csplat_conformance.validator.index,
csplat_conformance.validator.resource_level, csplat_conformance.validator.streams, csplat_conformance.validator.tiles,
csplat_conformance.validator.tree, csplat_conformance.validator.values.
"""

import json
import random
import subprocess
import sys
from dataclasses import replace

import pytest
from checked import flipped
from tables import failures
from validator_cases import INVALID, SMALL, SPLATS_MAX, VECTOR_LIST

import csplat
from csplat import _spec
from csplat.context import Context
from csplat_authoring.builder import build, repair
from csplat_authoring.recipes import sound_recipes
from csplat_authoring.samples import attributes, rich_scene, scene, tile
from csplat_authoring.scene import Attribute, Chunk, DeclaredErrors, Node
from csplat_conformance.validator import validate
from csplat_conformance.validator.ancillary_chunks import JsonError, parse_json
from csplat_selftest.fuzzing.damage import damaged_file

VALID = [vector for vector in VECTOR_LIST if not vector.error]
RICH = build(rich_scene())


#: Vectors whose defect the validator reports at a better offset than the manifest: rms itself, not the max before it.
AT_RMS = ("declared_error_record_rms_below", "declared_error_record_rms_above", "error_rms_nan", "error_rms_infinite")


def clauses_of(data, **options):
    return {one.clause for one in validate(data, **options).violations}


@pytest.fixture(scope="module")
def sound():
    """Return the validator's result for each valid vector, by name."""
    return {vector.name: validate(vector.data) for vector in VALID}


@pytest.mark.slow
def test_valid_vectors_have_no_violations(sound):
    def check(vector):
        found, header = sound[vector.name], vector.expect["header"]
        assert ((), ()) == (found.violations, found.unread)
        assert (header["splat_count"], header["tile_count"]) == (found.splat_count, found.tile_count)

    assert [] == failures(VALID, check)


@pytest.mark.slow
def test_invalid_vectors_violate_their_clause_at_their_offset():
    def check(vector):
        offset = vector.error["offset"]
        if vector.name.removeprefix("invalid/") in AT_RMS:
            offset += RICH.fields["SERR/record[means].rms"].offset - RICH.fields["SERR/record[means].max"].offset
        violations = validate(vector.data, splats_max=SPLATS_MAX).violations
        found = {(one.clause, one.code, one.offset) for one in violations}
        assert (vector.error["clause"], vector.error["code"], offset) in found
        assert len(violations) <= 9  # consequences must not bury the defect

    assert [] == failures(INVALID, check)


@pytest.mark.slow
def test_recommendations_that_are_not_followed_are_remarked(sound):
    remarked = {
        "valid/chunks_reversed": "recommended order",
        "valid/levels_in_reverse": "recommended order",
        "extreme/deflate_unused_bits": "unused bits after the final block",
        "extreme/json_deep_again": "camera 0 has no K, viewmat, W, H",
    }
    for name, found in sound.items():
        assert [True] * (name in remarked) == [remarked[name] in remark for remark in found.remarks], name


def test_all_defects_of_a_file_are_reported_at_their_fields():
    changes = {
        "header.profile": 9,
        "header.resource_level": 9,
        "header.reserved_0": 1,
        "index.scene_flags": 0x08,
        "index.unit_metres": -1.0,
        "attribute[means].levels": 3,
        "codebook[2].reserved_0": 1,
        "directory[META].reserved_0": 1,
        "tile[0].level": 1,
        "tile[0].max_scale": 7.5,
        "META/header.reserved_0": 1,
        "SERR/head.error_flags": 0x40,
        "CODB.7.2/head.reserved_0": 1,
        "TILE.0.0/head.layer": 1,
        "TILE.0.0/opacities.stream.reserved_0": 1,
        "TILE.0.0/sh0.params.reserved_0": 1,
    }
    elsewhere = {"tile[1].extent": (1, 2, 3), "attribute[sh1].chroma_shift": 17, "tile[1].layer[0].crc": 99}
    violations = validate(RICH.patched(changes | elsewhere)).violations
    found = {one.field: one.offset for one in violations}
    assert {name: RICH.fields[name].offset for name in changes}.items() <= found.items()
    assert {"tile[1].corner", "TILE.1.0"} <= set(found)  # the box's first field (TIL-10), and the chunk (CHK-1)
    assert sorted(one.offset for one in violations) == [one.offset for one in violations]
    assert all(one.message and "\n" not in str(one) for one in violations)


def test_bytes_of_unknown_structure_are_listed_as_unread():
    found = validate(RICH.patched({"TILE.0.0/scales.coding": 99}))
    unread = f"TILE.0.0 from byte {RICH.fields['TILE.0.0/scales.coding'].offset + 3} on"
    assert ["BLK-1", unread] == [*(one.clause for one in found.violations), *(one.field for one in found.unread)]


#: Two nodes of two tiles each, their parents, and the root.
TREE = scene(
    tiles=[tile(seed, 3 + seed, level=level) for seed, level in enumerate((0, 0, 0, 0, 1, 1, 2))],
    nodes=(Node(2, 2), Node(3, 2), Node(4, 1, 0.5), Node(4, 1, 0.25), Node(_spec.NO_PARENT, 1, 0.5)),
)


def tree_violations(**changes):
    """Return clauses and fields of the violations in TREE after changes: `n0_parent` is `node[0].parent`."""
    fields = {f"TREE/node[{name[1]}].{name[3:]}": value for name, value in changes.items()}
    return [(one.clause, one.field) for one in validate(build(TREE).patched(fields)).violations]


def test_all_defects_of_a_tree_but_not_their_consequences_are_reported():
    found = tree_violations(n0_parent=1, n1_error=-1.0, n2_error=0.75, n3_parent=9, n4_error=float("inf"))
    expected = {0: "TRE-5 parent", 1: "TRE-8 error", 3: "TRE-5 parent", 4: "TRE-8 error"}
    assert [(text.split()[0], f"TREE/node[{node}].{text.split()[1]}") for node, text in expected.items()] == found
    cases = {
        "another parent": ({"n0_parent": 3}, ["TRE-6"]),  # node 2 had no other child
        "no such parent": ({"n0_parent": 7}, ["TRE-5"]),  # node 2 may be the one that was meant
        "one child fewer": ({"n2_parent": _spec.NO_PARENT}, ["TRE-7"]),
        "infinite error": ({"n3_error": float("inf")}, ["TRE-8"]),  # the error of the root may be right
        "a tile fewer": ({"n0_tile_count": 1}, ["TRE-3"]),  # levels and splats of all nodes are unknown
        "a tile more": ({"n1_tile_count": 3}, ["TRE-3", "TRE-4"]),
        "a tile more, and a parent of a lower number": ({"n4_tile_count": 2, "n4_parent": 0}, ["TRE-3", "TRE-5"]),
    }

    def check(case):
        changes, clauses = case
        assert sorted(clauses) == sorted(clause for clause, _ in tree_violations(**changes))

    assert [] == failures(cases, check)


def test_tiles_of_all_levels_are_checked_but_no_more_nodes_than_there_are_tiles():
    changes = {f"TILE.{i}.0/opacities.stream.count": 99 for i in (0, 4, 6)}
    assert {*changes} == {one.field for one in validate(build(TREE).patched(changes)).violations}
    found = validate(build(replace(TREE, nodes=TREE.nodes + (Node(_spec.NO_PARENT, 1, 1.0),) * 50)).data)
    assert ["TRE-3"] == [one.clause for one in found.violations]
    assert ["there are more nodes than tiles"] == [one.reason for one in found.unread]


def test_splats_of_level_0_and_texts_beyond_the_budget_are_not_read():
    for data, count in ((build(TREE).data, 18), (RICH.data, 5)):
        assert set() == clauses_of(data, splats_max=count)
        assert {"LIM-1"} == clauses_of(data, splats_max=count - 1)
    assert set() == clauses_of(RICH.data, json_bytes_max=256)
    assert all("STR-8" in clauses_of(RICH.data, json_bytes_max=most) for most in (3, 255))


def declared(*records, pruned=0, degree=0):
    errors = DeclaredErrors(2 + pruned, pruned, degree, 0, records)
    return build(scene(chunks=(Chunk(_spec.CHUNK_DECLARED_ERRORS, errors=errors),))).data


def test_impossible_declared_errors_are_found():
    means, opacities, sh2 = _spec.MEASURE_MEANS, _spec.MEASURE_OPACITIES, _spec.MEASURE_SH2
    assert set() == clauses_of(declared((means, 0.5, 0.5 / 2**0.5), (opacities, 1.0, 1.0)))
    assert "SER-5" in clauses_of(declared((means, 0.5, 0.3)))  # one of two splats alone gives 0.35
    assert "SER-5" in clauses_of(declared((opacities, 1.5, 1.5)))
    assert "SER-5" in clauses_of(declared((sh2, 0.5, 0.5)))  # neither has such a band
    assert set() == clauses_of(declared((sh2, 0.5, 0.5), degree=2))


def test_json_texts_are_parsed():
    for text, value in {
        b' {"a" : [1, -0.5e+2, true, null, "\\u00e9\\n\xc3\xa9"]}\r\n': {"a": [1.0, -50.0, True, None, "é\né"]},
        b'{"\\ud83d\\ude00":"\xf0\x9f\x98\x80"}': {"😀": "😀"},
        b"[" * 64 + b"]" * 64: json.loads("[" * 64 + "]" * 64),
        b"0": 0.0,
        b'""': "",
    }.items():
        assert value == parse_json(text)


@pytest.mark.parametrize(
    "text",
    [
        b"", b"{", b'{"a"}', b"{a:1}", b"[1,]", b"[1 2]", b"+1", b".5", b"1.", b"0x1", b"tru", b"truefalse", b'"\\x"',
        b'"\\u12"', b"'a'", b"1e400", b"[" * 65 + b"]" * 65, b"\xff", b"\xc0\x80", b"{}\0", b'"\x7f\x1f"', b"\xc2\xa01",
        b'"\\udc00\\ud800"', b'{"a":1,"\\u0061":2}',
    ],
)  # fmt: skip
def test_invalid_json_texts_are_refused(text):
    with pytest.raises(JsonError):
        parse_json(text)


@pytest.mark.slow
@pytest.mark.parametrize("built", [SMALL, RICH], ids=["small", "rich"])
def test_prefixes_are_found(built):
    # All prefixes of the small file, as many of the rich: the decoder's tests read all of these, too.
    steps, last = len(SMALL.data) - 1, len(built.data) - 1
    found = [clauses_of(built.data[: i * last // steps]) for i in range(steps + 1)]
    assert all(found)
    assert {"HDR-5", "HDR-11"} == set().union(*found)


@pytest.mark.slow
def test_every_flipped_bit_of_a_small_file_is_found():
    # Every seventh bit, so that each bit position within a byte occurs.
    for bit in range(0, 8 * len(SMALL.data), 7):
        (damaged,) = flipped(SMALL.data, [bit // 8], lambda _, mask=1 << bit % 8: mask)
        assert not validate(damaged).conforms, bit


@pytest.mark.slow
def test_the_validator_agrees_with_the_decoder_on_damaged_files():
    small = {vector.name for vector in VALID if vector.name.startswith("valid/") and len(vector.data) < 3000}
    bases = [build(recipe.scene) for recipe in sound_recipes() if recipe.name in small]
    for number in range(120):
        data, _ = damaged_file(random.Random(f"validator {number}"), bases)  # noqa: S311 - repeatable, no secret
        found = {(one.clause, one.code) for one in validate(data).violations if one.clause != "SER-5"}
        error = error_of(data)
        if error is None or error[0] == "LIM-1":
            assert error or set() == found, number
        else:
            assert error in found, number


def error_of(data):
    """Return the clause and code of the decoder's error, or None. Only integers are decoded at all levels (CHK-8)."""
    try:
        csplat.decode(data, context=Context(threads=1))
        csplat.decode_integers(data, context=Context(threads=1))
    except csplat.CsplatError as error:
        return error.clause, error.code
    return None


def test_no_content_of_any_buffer_raises():
    for seed in range(20):
        rng = random.Random(seed)  # noqa: S311 - repeatable, no secret
        data = bytearray(RICH.data)
        for _ in range(30):
            at = rng.randrange(_spec.HEADER_SIZE, len(data))
            data[at : at + 8] = rng.randbytes(8)
        validate(repair(bytes(data), RICH.records))
        validate(_spec.MAGIC + rng.randbytes(300))
        validate(rng.randbytes(seed))
    assert all(validate(kind(SMALL.data)).conforms for kind in (bytes, bytearray, memoryview))


def test_huge_counts_of_levels_do_not_overflow():
    # A count of levels beyond ATT-4 whose square exceeds 64 bits.
    made = attributes() | {3: Attribute(_spec.MAPPING_UNIT_W, levels=2**32 - 1)}
    assert {"ATT-4"} == clauses_of(build(scene(attributes=made)).data)


def test_overlapping_chunks_are_read_once():
    # Otherwise an index could make a validator read the same megabytes a million times.
    twins = build(scene(tiles=[tile(1), tile(2)]))
    found = validate(twins.patched({"tile[1].layer[0].offset": twins.spans["TILE.0.0"][0]}))
    assert ["TILE.1.0"] == [one.field for one in found.unread]


@pytest.mark.slow
def test_validator_and_encoder_suite_import_no_decoder_encoder_or_renderer():
    code = "import sys, csplat_conformance.{}; print(*sorted(sys.modules))"
    by_validator, by_suite = (
        subprocess.check_output([sys.executable, "-c", code.format(name)], text=True).split()
        for name in ("validator", "encoders")
    )
    loaded = {".".join(name.split(".")[:2]) for name in by_validator if name.startswith("csplat")}
    # `csplat.file_source` releases memory that was read, `csplat.types` names array types: neither knows the format.
    allowed = {"csplat", "csplat._spec", "csplat.file_source", "csplat.types", "csplat_conformance"}
    assert allowed | {"csplat_conformance.tolerance", "csplat_conformance.validator"} == loaded
    unwanted = ("csplat.encoder", "csplat.ply", "csplat_tools", "torch")
    assert [] == [name for name in by_suite if name.startswith(unwanted)]

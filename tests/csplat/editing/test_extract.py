# SPDX-License-Identifier: Apache-2.0
"""Editing without decoding: parts of a file as files of their own, and several files as one.

Also: csplat.editing.merge.
"""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from checked import cloud
from damage_cases import flipped
from editing_cases import STEPS, box_of, extract, merge
from models import with_facts
from tables import failures

import csplat
import csplat_conformance
from csplat import EncodeOptions, FormatError, InputError, _spec, decode, encode, read_header
from csplat.decoder import read_declared_bounds, read_metadata, read_options
from csplat.decoder.tiles import codebook_references
from csplat.ply import read_ply
from csplat_conformance.validator import validate

VECTORS = Path(csplat_conformance.__file__).parent / "vectors" / "valid"
ARRAYS = ("means", "quats", "scales", "opacities", "sh0", "shN")
ALL = (-1e6, -1e6, -1e6, 1e6, 1e6, 1e6)


@pytest.fixture(scope="module")
def sample(sample_path):
    return read_ply(sample_path).select(slice(0, None, 9))


@pytest.fixture(scope="module")
def data(sample):
    return encode(sample, EncodeOptions(tile_splats=120))


def test_a_part_and_a_whole_keep_ways_of_drawing_that_are_unknown():
    data = (VECTORS / "ancillary_hints_private.csplat").read_bytes()
    _, part = extract(data, ALL)
    _, whole = merge(part, data)
    for one in (data, part, whole):
        header = read_header(one)
        assert (255, 192, 255, False) == (
            header.projection, header.antialiasing, header.colour_space, header.antialiased
        )  # fmt: skip


@pytest.mark.slow
def test_a_part_has_the_tiles_that_touch_the_box_bit_for_bit(data):
    header = read_header(data)
    low, high = box_of(header.tiles[2], header)
    part, cut = extract(data, (*high, *low))
    assert 2 in part.tiles
    assert 1 <= len(part.tiles) < len(header.tiles)
    whole, found = decode(data, tiles=part.tiles), decode(cut)
    assert part.splat_count == len(found)
    assert_joined([whole], found)
    for index, tile in enumerate(header.tiles):
        least, most = box_of(tile, header)
        touches = all(least[k] <= high[k] and most[k] >= low[k] for k in range(3))
        assert touches == (index in part.tiles)
    assert () == validate(cut).violations
    assert len(cut) < 0.9 * len(data)


def test_a_part_keeps_the_metadata_but_no_declared_errors(data):
    part = extract(data, ALL)[1]
    assert read_metadata(data) == read_metadata(part)
    assert decode(data).metadata.cameras == decode(part).metadata.cameras
    assert read_declared_bounds(data) is not None
    assert read_declared_bounds(part) is None
    assert read_options(part) is None
    before, after = read_header(data), read_header(part)
    for name in ("origin", "coordinate_system", "antialiased", "flat", "unit_metres", "sh_degree", "codebooks"):
        assert getattr(before, name) == getattr(after, name)
    assert part == extract(part, ALL)[1]


@pytest.mark.slow
@pytest.mark.parametrize("name", [
    "rich", "combined_codebooks", "combined_tiles", "ancillary_extras", "chunks_reversed", "codebook_sh_1_4_escape",
    "empty",
])  # fmt: skip
def test_a_part_of_all_tiles_and_two_merged_copies_of_a_vector_decode_to_the_same(name):
    path = VECTORS / f"{name}.csplat"
    whole = decode(path)
    if name != "empty":
        _, part = extract(path.read_bytes(), [-1e300] * 3 + [1e300] * 3)
        assert () == validate(part).violations
        assert_joined([whole], decode(part))
        assert whole.extra.keys() == decode(part).extra.keys()
    done, twice = merge(path, path.read_bytes())
    assert not done.why
    assert () == validate(twice).violations
    assert_joined([whole] * 2, decode(twice))


MEANS = np.random.default_rng(5).normal(size=(300, 3)).astype(np.float32) * 10
SCENES = {
    "ordinary": cloud(MEANS),
    "on a grid": cloud(np.round(MEANS)),
    "far from the origin": cloud(MEANS, origin=(500_000.1, -4_649_776.3, 1e12)),
    "an outlier": cloud([*MEANS, (3e7, -2e6, 1e5)]),
    "huge": cloud(MEANS * np.float32(3e36)),
    "subnormal": cloud(MEANS * np.float32(1e-41)),
    "around zero": cloud(np.where(np.abs(MEANS) < 9, 0, MEANS) * np.float32(-1)),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", SCENES)
def test_a_box_that_touches_a_decoded_centre_returns_its_splat(name):
    data = encode(SCENES[name], EncodeOptions(tile_splats=64))
    means = decode(data).means.astype(np.float64)
    header = read_header(data)
    ends = np.cumsum([tile.splat_count for tile in header.tiles])
    with csplat.open(data) as file:
        for tile, (low, high) in enumerate(file.boxes):
            own = means[ends[tile] - header.tiles[tile].splat_count : ends[tile]]
            assert (own.min(axis=0) == low).all()
            assert (own.max(axis=0) == high).all()
        for axis in range(3):
            for row, end in ((means[:, axis].argmax(), math.inf), (means[:, axis].argmin(), -math.inf)):
                tile = int(np.searchsorted(ends, row, side="right"))
                box = [-math.inf] * 3 + [math.inf] * 3
                box[axis], box[axis + 3] = means[row, axis], end  # corners in any order
                found = [one.tile.index for one in file.tiles(box)]
                for tiles in (found, file.cut(box=box), extract(data, box)[0].tiles, file.cut(box=[*means[row]] * 2)):
                    assert tile in tiles, (axis, end)
                box[axis] = math.nextafter(means[row, axis], end)
                with pytest.raises(InputError, match="no tile touches the box"):
                    file.cut(box=box)


def test_a_box_that_nothing_touches_is_refused(data):
    for box, message in (
        ([1000] * 6, "no tile touches the box 1000, 1000"),
        ([0, 0, 0, 1, 1, math.nan], "six numbers"),
    ):
        with pytest.raises(InputError, match=message):
            extract(data, box)


def assert_joined(parts, whole):
    """Assert that `whole` is the splats of `parts` one after the other, bit for bit."""
    for name in ARRAYS:
        expected = np.concatenate([getattr(part, name) for part in parts])
        np.testing.assert_array_equal(expected.view(np.uint32), getattr(whole, name).view(np.uint32))
    for name in whole.extra:
        np.testing.assert_array_equal(np.concatenate([part.extra[name] for part in parts]), whole.extra[name])


@pytest.fixture(scope="module")
def halves(sample):
    """Encode two files with the same steps and separate codebooks of SH and of shapes."""
    options = EncodeOptions(
        preset="fast", sh_coding="codebook", codebook_size=64, escape_fraction=0.05, shape_codebook_size=64,
        shape_escape_fraction=0.05, tile_splats=170, keep_extra=True, **STEPS,
    )  # fmt: skip
    model = replace(sample, extra={"id": np.arange(len(sample), dtype=np.uint32)})
    return [encode(model.select(half), options) for half in np.array_split(np.argsort(sample.means[:, 0]), 2)]


@pytest.mark.slow
def test_copied_bytes_are_checked(data, halves):
    def damaged(file):
        record = read_header(file).tiles[0].layers[0]
        return flipped(file, 8 * (record.offset + record.size - 1))

    with pytest.raises(FormatError, match="E_CRC"):
        extract(damaged(data), ALL)
    with pytest.raises(FormatError, match="E_CRC"):
        merge(halves[0], damaged(halves[1]))


def test_files_of_the_same_steps_are_copied_with_the_codebooks_of_each(sample, halves):
    done, data = merge(*halves)
    assert ("", len(sample)) == (done.why, done.splat_count)
    assert () == validate(data).violations
    assert_joined([decode(one) for one in halves], decode(data))
    header = read_header(data)
    kinds = [book.kind for one in halves for book in read_header(one).codebooks]
    assert len(set(kinds)) == 2
    assert sorted(kinds) == sorted(book.kind for book in header.codebooks)
    assert done.tile_count == len(header.tiles) == sum(len(read_header(one).tiles) for one in halves)
    assert data == merge(*halves)[1]
    assert None is not read_declared_bounds(halves[0])
    assert (None, None) == (read_declared_bounds(data), read_options(data))
    done, data = merge(*halves, options=EncodeOptions(preset="fast", keep_extra=True), codebooks_max=3)
    assert "they have 4 codebooks together, a file has at most 3" == done.why
    assert len(sample) == len(decode(data))


@pytest.mark.slow
def test_parts_of_a_file_share_their_codebooks_again(sample):
    whole = encode(sample, EncodeOptions(preset="balanced", tile_splats=120))
    middle = float(np.median(sample.means[:, 0]))
    parts = [extract(whole, box)[1] for box in ((*ALL[:3], middle, *ALL[4:]), (middle, *ALL[1:]))]
    done, data = merge(*parts)
    assert not done.why
    assert read_header(whole).codebooks == read_header(data).codebooks != ()
    assert read_metadata(whole) == read_metadata(data)
    assert decode(whole).metadata.cameras == decode(data).metadata.cameras
    assert_joined([decode(part) for part in parts], decode(data))


def test_references_to_codebooks_are_found_without_decoding():
    assert [] == failures({path.stem: path for path in VECTORS.glob("*.csplat")}, check_references)


def check_references(path):
    data = path.read_bytes()
    header = read_header(data)
    found = set()
    for tile in header.tiles:
        for layer in tile.layers.values():
            if layer.layer <= _spec.SH_DEGREE_MAX:
                for at, id in codebook_references(memoryview(data), header, layer):
                    assert id == int.from_bytes(data[at : at + 2], "little")
                    assert id in tile.codebook_ids
                    found.add(id)
    # If a stream is skipped wrongly, its end is not the end of the chunk: E_STREAM.
    if "codebook" in path.stem and header.codebooks:
        assert found


def test_merging_fills_in_metadata_and_drops_contradictions(make_model):
    options = EncodeOptions(preset="fast", **STEPS)
    models = [make_model(40, 1), make_model(50, 1, coordinate_system="RDF", unit_metres=2.0)]
    models[0] = with_facts(models[0], entries={"licence": "CC0-1.0", "only": 1, "up": [0, -1, 0]})
    models[1] = with_facts(models[1], entries={"licence": "CC0-1.0", "up": [0, -0.8, 0.6]}, cameras=[])
    done, data = merge(*(encode(model, options) for model in models))
    assert not done.why
    header = read_header(data)
    assert ("RDF", 2.0) == (header.coordinate_system, header.unit_metres)
    assert {"licence": "CC0-1.0"} == read_metadata(data).entries
    starts = ("file 1 without axes: RDF is", "file 1 without a unit: 2 m is", "metadata left out, ")
    assert all(note.startswith(start) for note, start in zip(done.notes, starts, strict=True))
    assert "only, up" in done.notes[2]


@pytest.mark.slow
@pytest.mark.parametrize(("degree", "fields", "options", "reason"), [
    (1, {}, {"scale_step": 0.1}, "different steps of scales"),
    (3, {}, {}, "file 2 has SH of degree 3, file 1 of 1"),
    (1, {"origin": (100.0, 0.0, 0.0)}, {}, "different origins"),
    (1, {"extra": {"id": np.arange(50, dtype=np.int32)}}, {}, "different extra columns"),
])  # fmt: skip
def test_files_that_cannot_be_copied_are_re_encoded_with_a_reason(make_model, degree, fields, options, reason):
    common = {"preset": "fast", "keep_extra": True, **STEPS}
    first = encode(make_model(40, 1), EncodeOptions(**common))
    files = [first, encode(make_model(50, degree, **fields), EncodeOptions(**common | options))]
    done, data = merge(*files, options=EncodeOptions(preset="small", position_step=1e-4))
    assert reason in done.why
    assert () == validate(data).violations
    model = decode(data)
    assert 90 == len(model) == done.splat_count
    assert (degree, ("id",) if "extra" in fields else ()) == (model.sh_degree, done.dropped)
    sources = [decode(one) for one in files]
    wanted = np.concatenate([one.means.astype(np.float64) + one.origin for one in sources])
    found = model.means.astype(np.float64) + model.origin
    distance = np.linalg.norm(wanted[:, None] - found, axis=2)
    assert max(distance.min(axis=1).max(), distance.min(axis=0).max()) < 1e-3


@pytest.mark.slow
def test_scenes_that_contradict_each_other_or_have_no_partner_are_refused(make_model, tmp_path):
    def check(case):
        fields, message = case
        for name, its in zip("ab", fields, strict=True):
            (tmp_path / name).write_bytes(encode(make_model(5, 0, **its), EncodeOptions(preset="fast", **STEPS)))
        for files, expected in (("ab", message), ("bba", "cannot be merged")):
            with pytest.raises(InputError, match=expected):
                csplat.merge([tmp_path / one for one in files], tmp_path / "out.csplat")

    assert [] == failures({case[1]: case for case in CONTRADICTIONS}, check)
    for files in ("scene.csplat", [], ["scene.csplat"], b"x"):
        with pytest.raises(InputError, match="two files or more"):
            csplat.merge(files, tmp_path / "out.csplat")
    assert not (tmp_path / "out.csplat").exists()


CONTRADICTIONS = [
    (({"coordinate_system": "RDF"}, {"coordinate_system": "RUB"}), "axes cannot be merged: RDF in .*a, RUB in .*b"),
    (({}, {"coordinate_system": "RUB"}), "none, for which RDF is assumed, in .*a, RUB in .*b: turn one with"),
    (({"coordinate_system": "LUF"}, {}), "axes cannot be merged: LUF in .*a, none, for which RDF is assumed, in .*b"),
    (({"entries": {"up": [0, 0, 1]}}, {"entries": {"up": [0, 1, 0]}}), "up direct.*: 0,0,1 in .*a, 0,1,0 in .*b"),
    (({"coordinate_system": "RDF"}, {"entries": {"up": [0, 1, 0]}}), "up directions cannot be merged: 0,-1,0 in .*a"),
    (({"unit_metres": 1.0}, {"unit_metres": 0.01}), "units cannot be merged: 1.0 in .*a, 0.01 in .*b"),
    (({"antialiased": True}, {}), "antialiasing cannot be merged: yes in .*a, no in .*b"),
    (({}, {"flat": True}), "flatness cannot be merged: no in .*a, yes in .*b"),
    (({"colour_space": "130"}, {}), "colour spaces cannot be merged: 130 in .*a, 0 in .*b"),
]

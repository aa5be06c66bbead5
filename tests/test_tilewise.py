"""Scenes that are decoded tile by tile."""

import io
from dataclasses import fields
from functools import partial

import numpy as np
import pytest
from tables import failures
from typer.testing import CliRunner

import csplat
from csplat import file_source, formats
from csplat.decoder import Limits, decode, decode_api, open_tiles, read_header
from csplat.errors import CsplatError, LimitError
from csplat.ply import write_ply
from csplat_conformance.manifest import load
from csplat_tools import scene_files
from csplat_tools.cli.app import app
from csplat_tools.convert_file import decode_file

VECTORS = load()
#: Vectors of several tiles or with extra columns, and some others; none with many splats.
VALID = [
    vector
    for number, vector in enumerate(vector for vector in VECTORS if not vector.error)
    if vector.expect["header"]["splat_count"] < 10_000
    and (vector.expect["header"]["tile_count"] != 1 or vector.expect["extra"] or number % 4 == 0)
]
#: Two of each clause, and not the one that is too large to lie in memory at once, which tiles need not.
INVALID = [
    *{
        (vector.error["clause"], turn): vector
        for turn, order in enumerate((VECTORS, VECTORS[::-1]))
        for vector in order
        if vector.error and vector.name != "invalid/arrays_beyond_budget"
    }.values()
]


def ply_of(model):
    buffer = io.BytesIO()
    write_ply(buffer, model)
    return buffer.getvalue()


def answer(make):
    """Return the result, or the error's text if the input is refused: a PLY cannot hold some names of columns."""
    try:
        return make()
    except csplat.InputError as error:
        return str(error)


def assert_same(expected, found):
    for field in fields(expected):
        ours, theirs = getattr(expected, field.name), getattr(found, field.name)
        if isinstance(ours, np.ndarray):
            assert (ours.dtype, ours.shape, ours.tobytes()) == (theirs.dtype, theirs.shape, theirs.tobytes())
        elif field.name == "extra":
            assert {name: column.tobytes() for name, column in ours.items()} == {
                name: column.tobytes() for name, column in theirs.items()
            }
        else:
            assert ours == theirs


@pytest.fixture
def many_tiles(make_model, tmp_path):
    """A file of eleven tiles, and where it lies."""
    data = csplat.encode(make_model(2000, 2), csplat.EncodeOptions(tile_splats=200))
    path = tmp_path / "scene.csplat"
    path.write_bytes(data)
    assert len(read_header(data).tiles) > 8
    return path


@pytest.mark.slow
def test_a_scene_and_its_ply_are_those_of_a_decode_at_once(tmp_path):
    path, ply = tmp_path / "scene.csplat", tmp_path / "scene.ply"

    def check(vector):
        path.write_bytes(vector.data)
        expected = decode(vector.data, threads=1)
        with formats.open_scene(path) as scene:
            assert len(expected) == scene.count
            assert_same(expected, scene.model())
        wanted = answer(lambda: ply_of(expected))
        found = answer(lambda: (decode_file(str(path), str(ply)), ply.read_bytes()))
        assert (wanted if isinstance(wanted, str) else ((len(expected), expected.sh_degree), wanted)) == found

    assert [] == failures(VALID, check)


@pytest.mark.slow
def test_what_a_decode_refuses_is_refused_in_the_same_words_and_leaves_no_ply(tmp_path):
    path = tmp_path / "scene.csplat"

    def check(vector):
        path.write_bytes(vector.data)
        with pytest.raises(CsplatError) as expected:
            decode(vector.data, threads=1)
        with pytest.raises(CsplatError) as found:
            decode_file(str(path), str(tmp_path / "scene.ply"))
        assert str(expected.value) == str(found.value)
        assert ["scene.csplat"] == [one.name for one in tmp_path.iterdir()]

    assert [] == failures({vector.name: vector for vector in INVALID}, check)


@pytest.mark.parametrize("threads", [1, 2, 7])
def test_threads_and_letting_go_of_the_file_change_nothing(many_tiles, threads, monkeypatch):
    monkeypatch.setattr(decode_api, "PageReleaser", partial(file_source.PageReleaser, step_bytes=1))
    expected = decode(many_tiles)
    opened = open_tiles(many_tiles, threads=threads)
    for _ in range(2):
        models = list(opened.models())
        assert [tile.splat_count for tile in opened.header.tiles] == [len(model) for model in models]
        for name in ("means", "quats", "scales", "opacities", "sh0", "shN"):
            together = np.concatenate([getattr(model, name) for model in models])
            assert getattr(expected, name).tobytes() == together.tobytes()


@pytest.mark.parametrize("threads", [1, 3])
def test_the_first_damaged_tile_is_told_and_those_before_it_come(many_tiles, threads):
    data = bytearray(many_tiles.read_bytes())
    tiles = read_header(data).tiles
    for place in (4, 6):
        layer = tiles[place].layers[0]
        data[layer.offset + layer.size - 1] ^= 1
    models = open_tiles(bytes(data), threads=threads).models()
    assert [tile.splat_count for tile in tiles[:4]] == [len(next(models)) for _ in range(4)]
    with pytest.raises(CsplatError, match=f"E_CRC at byte {tiles[4].layers[0].offset} "):
        next(models)


@pytest.mark.slow
def test_nothing_of_a_damaged_file_goes_to_standard_output(many_tiles):
    data = bytearray(many_tiles.read_bytes())
    whole = CliRunner().invoke(app, ["decode", str(many_tiles), "-", "--quiet"])
    assert ply_of(decode(bytes(data))) == whole.stdout_bytes
    data[-1] ^= 1
    many_tiles.write_bytes(data)
    found = CliRunner().invoke(app, ["decode", str(many_tiles), "-", "--quiet"])
    assert (1, b"") == (found.exit_code, found.stdout_bytes)


def test_a_caller_bounds_the_splats_and_a_tile_the_bytes(many_tiles):
    with pytest.raises(LimitError, match="splats"):
        open_tiles(many_tiles, limits=Limits(splats=1999))
    tile = max(one.splat_count for one in read_header(many_tiles.read_bytes()).tiles)
    limits = Limits(bytes=tile * 4 * (11 + 27))
    assert 2000 == sum(map(len, open_tiles(many_tiles, limits=limits).models()))
    with pytest.raises(LimitError, match="bytes"):
        decode(many_tiles, limits=limits)


def test_progress_goes_from_nothing_to_all(many_tiles, tmp_path):
    told = []
    decode_file(str(many_tiles), str(tmp_path / "scene.ply"), progress=lambda stage, done: told.append((stage, done)))
    shares = [done for stage, done in told if stage == "decoding"]
    assert shares == sorted(shares)
    assert (0.0, 1.0) == (shares[0], shares[-1])


@pytest.mark.parametrize("suffix", [".csplat", ".ply"])
def test_who_wants_all_splats_at_once_is_refused_before_the_memory_is_full(many_tiles, tmp_path, monkeypatch, suffix):
    decode_file(str(many_tiles), str(tmp_path / "scene.ply"))
    monkeypatch.setattr(scene_files, "available_memory_bytes", lambda: 4000)
    with pytest.raises(LimitError, match="allowed 4000"):
        scene_files.load_model(many_tiles.with_suffix(suffix))

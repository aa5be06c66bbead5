"""The up direction: read from a scene, set by the caller, and kept."""

import math

import pytest

from csplat import decode, encode, read_ply, write_ply
from csplat.editing.up_axis import unit_up, up_of, with_up
from csplat.errors import InputError

TILTED = (0.0, -0.99503719, 0.09950372)  # 0, -1, 0.1


@pytest.mark.parametrize(
    ("values", "up"),
    [
        ((0, 0, 2), (0, 0, 1)),
        ([0.0, -1.0, 0.1], (0, -0.995037, 0.099504)),
        ((1e300, -1e300, 0), (0.707107, -0.707107, 0)),
        ((5e-324, 0, 0), (1, 0, 0)),
    ],
)
def test_a_direction_gets_unit_length_and_keeps_it(values, up):
    assert up == unit_up(values) == unit_up(unit_up(values))


@pytest.mark.parametrize(
    "values",
    [None, "xyz", (0, 0, 0), (1, 2), (1, 2, 3, 4), (math.nan, 0, 1), (math.inf, 0, 1), (True, 0, 0), "z", [[1]]],
)
def test_refuses_what_is_no_direction(values):
    with pytest.raises(InputError, match="wanted three finite numbers"):
        unit_up(values)


def test_up_of_the_metadata_comes_before_the_axes():
    assert (0, 0, 1) == up_of({}, "RFU")
    assert (0, -1, 0) == up_of({}, "RDF")
    assert (1, 0, 0) == up_of({"up": [1, 0, 0]}, "RFU")
    assert (0, 0, 1) == up_of({"up": "there"}, "RFU")
    assert up_of({}) is None
    assert up_of({"up": [0, 0, 0]}) is None


def test_a_scene_that_is_told_another_up_does_not_contradict_itself(make_model):
    model = make_model(coordinate_system="RDF", metadata={"up": [0.0, -1.0, 0.0]})
    leaning, lying = with_up(model, TILTED), with_up(model, (0, 0, 1))
    assert ("RDF", [0.0, -0.995037, 0.099504]) == (leaning.coordinate_system, leaning.metadata["up"])
    assert ("unspecified", [0.0, 0.0, 1.0]) == (lying.coordinate_system, lying.metadata["up"])
    turned = with_up(model, coordinate_system="RFU")
    assert ("RFU", {}) == (turned.coordinate_system, turned.metadata)


def test_up_goes_through_files(tmp_path, make_model):
    write_ply(tmp_path / "a.ply", make_model(metadata={"up": [0, -1, 0.1]}))
    assert b"\ncomment csplat up 0.0 -0.995037 0.099504\n" in (tmp_path / "a.ply").read_bytes()
    first = decode(encode(read_ply(tmp_path / "a.ply")))
    write_ply(tmp_path / "b.ply", first)
    again = decode(encode(read_ply(tmp_path / "b.ply")))
    assert {"up": [0.0, -0.995037, 0.099504]} == first.metadata == again.metadata


def test_an_up_that_nobody_understands_is_not_written(tmp_path, make_model):
    write_ply(tmp_path / "a.ply", make_model(metadata={"up": "there"}))
    assert {} == read_ply(tmp_path / "a.ply").metadata


@pytest.mark.parametrize("words", ["", "0 0 0", "1 2", "nan 0 1", "x y z"])
def test_refuses_a_comment_that_it_cannot_read(tmp_path, make_model, words):
    write_ply(tmp_path / "a.ply", make_model(metadata={"up": [0, 0, 1]}))
    data = (tmp_path / "a.ply").read_bytes()
    (tmp_path / "b.ply").write_bytes(data.replace(b"csplat up 0.0 0.0 1.0", f"csplat up {words}".encode()))
    with pytest.raises(InputError, match="csplat up"):
        read_ply(tmp_path / "b.ply")

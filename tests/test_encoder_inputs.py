"""The inputs of the encoder suite: what they stand for, and that they are what they say."""

import contextlib
import json
import re
from importlib.resources import files

import numpy as np
import plyfile
import pytest
from tables import failures

import csplat
from csplat import lint
from csplat.errors import InputError
from csplat.ply import lint_ply
from csplat_conformance import encoders
from csplat_conformance.declared_bounds import Source
from csplat_conformance.encoders import all_inputs

INPUTS = {one.name: one for one in all_inputs()}
ENCODABLE = {name: one for name, one in INPUTS.items() if one.source is not None}
DEGREE_4 = "nasty/degree_4"  # ours refuses it, and nothing else that can be encoded


# Inputs --------------------------------------------------------------------------------------------


def test_inputs_have_names_of_their_own_and_say_why():
    assert len(all_inputs()) == len(INPUTS)
    assert {"ordinary", "nasty", "broken"} == {name.split("/")[0] for name in INPUTS}
    assert all(one.why for one in INPUTS.values())


def test_ordinary_inputs_must_be_taken_and_broken_ones_refused():
    for name, one in INPUTS.items():
        assert name.startswith("broken/") == one.must_refuse
        assert name.startswith("nasty/") == one.may_refuse


@pytest.mark.area(name="suite")
def test_an_input_is_the_scene_that_it_says(tmp_path):
    # Written by hand there, read by our reader here: the two know nothing of each other.
    def check(one):
        path = written(tmp_path, one.name)
        found, wanted = Source.of(csplat.read_ply(path, keep_extra=True)), one.source()
        for array in ("means", "scales", "opacities", "sh0", "shN"):
            np.testing.assert_array_equal(getattr(found, array), getattr(wanted, array), array)
        np.testing.assert_allclose(found.quats, wanted.quats, atol=1e-7)
        assert {key: column.tobytes() for key, column in wanted.extra.items()} == {
            key: column.tobytes() for key, column in found.extra.items()
        }

    assert [] == failures([one for name, one in ENCODABLE.items() if name != DEGREE_4], check)


def test_degree_4_is_nothing_that_our_reader_says(tmp_path):
    one = ENCODABLE[DEGREE_4]
    (tmp_path / "in.ply").write_bytes(one.make())
    rows = plyfile.PlyData.read(tmp_path / "in.ply")["vertex"].data
    source = one.source()

    assert (4, (64, 24, 3)) == (source.sh_degree, source.shN.shape)
    np.testing.assert_array_equal(rows["f_rest_49"], source.shN[:, 1, 2])  # blue comes after 48 of red and green
    with pytest.raises(InputError, match="SH degree 4"):
        csplat.read_ply(tmp_path / "in.ply")


def test_far_doubles_are_what_no_origin_brings_into_single_precision(tmp_path):
    model = csplat.read_ply(written(tmp_path, "nasty/far_doubles"))
    means = ENCODABLE["nasty/far_doubles"].source().means

    assert np.float64 == means.dtype
    assert model.means_double is not None
    for origin in (means[0], np.median(means, axis=0), np.round(means.mean(axis=0))):
        near = means - origin
        assert (near != near.astype(np.float32)).any()


@pytest.mark.parametrize(
    ("name", "left_out"),
    [("nasty/not_a_number", 3), ("nasty/infinities", 4), ("nasty/infinite_scales", 4), ("nasty/beyond_float", 2)],
)
def test_rows_that_are_no_splats_are_not_in_the_source(name, left_out):
    # SRC-1
    assert 64 - left_out == len(ENCODABLE[name].source())
    assert {64} == {len(ENCODABLE[name].source()) for name in ("nasty/nan_normals", "nasty/nan_extra")}


#: Findings on PLY of programs that write something of their own: encoders need not read it.
OTHER_PROGRAMS = [
    "alias-columns",
    "ambiguous-columns",
    "colour-columns",
    "colour-space",
    "colours-are-rgb",
    "filter-3d",
    "half-floats",
    "integer-columns",
    "opacities-are-alphas",
    "rgb-colours",
    "scales-are-linear",
    "second-columns",
    "sh-bands",
    "sharp-elements",
    "unusual-header",
    "unusual-rows",
    "vertical-axis",
]
#: Findings on glTF, .splat, .ksplat, SOG and checkpoints.
OTHER_FORMATS = [
    "linear-colours",
    "log-scales",
    "logit-opacities",
    "negative-scales",
    "other-scenes",
    "out-of-range-opacities",
    "ranks",
    "short-buffer",
    "spz-axes",
    "unclear-scales",
    "zero-rows",
    "zip-names",
]


@pytest.mark.area(name="suite")
def test_inputs_show_what_lint_knows(tmp_path):
    found = set()
    for one in INPUTS.values():
        (tmp_path / "in.ply").write_bytes(one.make())
        with contextlib.suppress(InputError):
            found |= {finding.id for finding in lint_ply(tmp_path / "in.ply")}
    known = set(re.findall(r"^\| `([a-z0-9-]+)` \|", lint.__doc__, re.MULTILINE))

    # Discs (2DGS) have a third scale for which there is no column, and no place in a source.
    assert {"flat-scales", *OTHER_PROGRAMS, *OTHER_FORMATS} == known - found


@pytest.mark.area(name="suite")
def test_different_splats_keep_their_distance():
    def check(one):
        means = np.unique(one.source().means.astype(np.float64), axis=0)  # sorted by x
        least = one.separation * (1 - 1e-5)  # the lattice of float32
        for step in range(1, len(means)):
            away = means[step:] - means[:-step]
            if away[:, 0].min() >= least:
                break
            assert np.linalg.norm(away, axis=1).min() >= least

    assert [] == failures([one for name, one in ENCODABLE.items() if name != "ordinary/two_tiles"], check)


@pytest.mark.parametrize("name", ["ordinary/degree_3", "nasty/duplicates", "broken/cut"])
def test_an_input_is_the_same_every_time(name):
    assert INPUTS[name].make() == {one.name: one for one in all_inputs()}[name].make()


def test_broken_inputs_are_broken(tmp_path):
    def check(one):
        with pytest.raises(InputError):
            csplat.read_ply(written(tmp_path, one.name))

    assert [] == failures([one for one in INPUTS.values() if one.must_refuse], check)


def test_another_quality_moves_what_is_wanted_of_all_pictures():
    assert (30.0, 28.0, 32.0) == tuple(
        INPUTS[f"ordinary/{name}"].psnr_required(30.0) for name in ("degree_3", "needles_and_discs", "surfaces")
    )
    assert (25.0, 27.0) == tuple(INPUTS[f"ordinary/{name}"].psnr_required(25.0) for name in ("degree_3", "glossy"))


def test_figures_beside_ones_own_are_those_of_the_inputs():
    # Written by `python -m csplat_bench.codec.inputs --write`
    figures = json.loads((files(encoders) / "figures.json").read_text("utf-8"))

    assert set(ENCODABLE) - {DEGREE_4} == set(figures)
    for name, by in figures.items():
        assert {"csplat"} <= set(by) <= {"csplat", "spz"}, name
        assert all((numbers["psnr"] is not None) == ENCODABLE[name].renders for numbers in by.values()), name


@pytest.mark.parametrize("name", ["ordinary/degree_3", "ordinary/glossy", "nasty/far_doubles"])
def test_figures_of_ours_are_of_this_encoder(tmp_path, name):
    figures = json.loads((files(encoders) / "figures.json").read_text("utf-8"))
    size = len(csplat.encode(csplat.read_ply(written(tmp_path, name))))

    assert size == pytest.approx(figures[name]["csplat"]["bytes"], rel=0.01)


def written(folder, name):
    path = folder / "in.ply"
    path.write_bytes(INPUTS[name].make())
    return path

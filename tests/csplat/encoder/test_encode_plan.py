"""Plans of files, tiles of a scene, and streams read back by the definition of the transforms in the spec."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from csplat import EncodeOptions, decode, encode
from csplat.decoder import decode_scene, read_options
from csplat.encoder import EncodePlan, Origin, encode_tiles, encode_with_report
from csplat.errors import InputError
from csplat_conformance.declared_bounds import Source, verify_bounds
from csplat_tools.inspect.file_description import describe_file

ROOT = Path(__file__).resolve().parents[3]
GEOMETRY = ("means", "quats", "scales", "opacities")
COLOURS = ("sh0", "shN")


def test_colours_and_an_origin_of_other_splats_are_refused(make_model):
    model = make_model(4, 1)
    with pytest.raises(InputError):
        EncodePlan.of(model).with_colours(model.sh0[:-1], model.shN)
    with pytest.raises(InputError, match="origin has 5 splats, expected 4"):
        EncodePlan.of(model, origin=Origin(9, np.arange(5)))


def test_a_file_is_written_twice_with_the_same_splats(make_model):
    model = make_model(200, 2)
    coded = encode_tiles(EncodePlan.of(model, EncodeOptions(tile_splats=70)))
    first = coded.write()
    second = coded.write({"fitted": {"psnr": 41.5}})
    assert first.data == coded.write().data
    assert {"fitted": {"psnr": 41.5}, **read_options(first.data)} == read_options(second.data)
    one, other = decode(first.data), decode(second.data)
    for name in (*GEOMETRY, *COLOURS):
        assert np.array_equal(getattr(one, name), getattr(other, name)), name
    assert np.array_equal(first.source_index, second.source_index)


def test_a_file_with_adjusted_shapes_declares_only_errors_of_means(make_model):
    source, rows = make_model(400, 3), np.arange(100, 300)
    adjusted = replace(source, scales=source.scales + np.float32(0.1)).select(rows)
    result = encode_with_report(adjusted, origin=Origin(len(source), rows, refitted=True, adjusted=True))
    scene = decode_scene(result.data)

    def holds(source, index=None):
        return verify_bounds(Source.of(source), scene.model, scene.header, scene.declared_bounds, index).holds

    assert ["means"] == [record.measure for record in scene.declared_bounds.records]
    assert holds(source, result.source_index)
    assert holds(source)
    assert not holds(replace(source, means=source.means + np.float32(0.1)))


def sparse_model(source, share):
    """Return the model with bands 2 and 3 of some splats set to zero."""
    shN = 0.1 * source.shN
    shN[np.random.default_rng(0).random(len(source)) < share, 3:] = 0.0
    return replace(source, shN=shN.astype(np.float32))


@pytest.mark.slow
def test_absent_bands_are_decoded_as_zeros(make_model):
    model, scalar = sparse_model(make_model(400, 3), 0.9), {"sh_coding": "scalar"}
    for options in ({}, {"tile_splats": 50}, {"deflate_level": 1}, {"adaptive": 0.5}):
        result = encode_with_report(model, EncodeOptions(**scalar, **options), importance=np.ones(400))
        decoded, expected = decode(result.data), model.shN[result.source_index]
        np.testing.assert_allclose(expected, decoded.shN, atol=0.2)
        assert not decoded.shN[~expected[:, 3:].any(axis=(1, 2)), 3:].any()
        assert {"sparse"} == codings_of_band_2(result.data)
    assert {"signed"} == codings_of_band_2(encode(make_model(400, 3), EncodeOptions(**scalar)))


def codings_of_band_2(data):
    return set(describe_file(data).as_json()["attributes"]["sh2"]["codings"])


@pytest.mark.slow
def test_absent_bands_cost_almost_nothing(make_model):
    big, sizes, scalar = make_model(6_000, 3), {}, EncodeOptions(sh_coding="scalar")
    for share in (0.0, 0.95, 1.0):
        sizes[share] = len(encode(sparse_model(big, share), scalar))
    full = sizes[0.0] - sizes[1.0]
    # One twentieth of the values, and for each of two bands a mask of at most half a bit per splat.
    assert sizes[0.95] - sizes[1.0] < 0.05 * full + 2 * 6_000 * 0.5 / 8


def test_other_packages_import_no_modules_of_the_encoder():
    places = [ROOT / "trainer", ROOT / "tools" / "csplat_tools", ROOT / "conformance" / "csplat_conformance"]
    uses = re.compile(r"^\s*(?:from|import) csplat\.encoder\..*", re.MULTILINE)
    files = [path for place in places for path in sorted(place.rglob("*.py"))]
    assert {} == {str(path): lines for path in files if (lines := uses.findall(path.read_text("utf-8")))}

"""Scenes at the extremes: from PLY to file, back, and to pictures. Figures and words stand in codec/EXTREMES.md.

Every condition goes through all stages once (`chains`). Presets and qualities are crossed for two conditions, learning
is tried on two; all others, and the million splats, are in the area `extremes`.
"""

import numpy as np
import pytest
from extremes import (
    CONDITIONS,
    COPIES,
    COUNT,
    DRAWN,
    FAR,
    NAMES,
    PRESETS,
    encoded,
    guide_figures,
    guide_rows,
    judge,
    scene,
)

pytest.importorskip("numba", reason="pictures need numba: pip install 'csplat[render]'")
pytest.importorskip("scipy", reason="training needs scipy: pip install 'csplat[render]'")

# Importing it needs what is looked for above.
from checked import measure_errors
from extremes_chain import LEARNT, assert_finite, chain_of

from csplat import decode, read_ply, write_ply
from csplat.decoder import read_declared_bounds, read_header
from csplat.errors import LimitError
from csplat_conformance.declared_bounds import Source, verify_bounds
from csplat_render import render
from csplat_render.camera import intrinsics, look_at
from csplat_render.virtual_cameras import virtual_cameras

pytestmark = [pytest.mark.extremes, pytest.mark.slow]

ARRAYS = ("means", "quats", "scales", "opacities", "sh0", "shN")
QUALITIES = {10.0: 12.0, 120.0: 44.0}  # dB that are asked of each attribute, and that the pictures keep at least
THROUGHOUT = ("needles", "half the rows NaN")  # with every preset and quality in the usual tests
LONG = pytest.mark.area(name="extremes")
MOST = [pytest.param(name, marks=() if name in THROUGHOUT else LONG) for name in DRAWN]


@pytest.fixture(scope="module")
def chains(once):
    """Every condition after all stages."""
    return once("extremes", lambda: {name: chain_of(name) for name in NAMES})


def assert_each(chains, check):
    """Call a check with the name and the chain of each condition; fail with the names of conditions that fail."""
    failures = {}
    for name, chain in chains.items():
        try:
            check(name, chain)
        except AssertionError as error:
            failures[name] = str(error)
    assert {} == failures


def assert_proved(name, result):
    """The stated errors hold, rms and counts too."""
    source, decoded = scene(name)[0], decode(result.data)
    stated = read_declared_bounds(result.data)
    proof = verify_bounds(Source.of(source), decoded, read_header(result.data), stated, result.source_index)
    assert ((), True) == (proof.failures, proof.rms_verified)
    return decoded


def assert_picture_is_finite(picture):
    for name in ("rgb", "alpha", "depth"):
        assert np.isfinite(getattr(picture, name)).all(), name
    assert 0.0 <= picture.alpha.min() <= picture.alpha.max() <= 1.0


# each condition


def test_a_reader_repairs_what_is_safe_and_strict_refuses_it(chains):
    def check(name, chain):
        repairs = CONDITIONS[name].repairs
        assert repairs == tuple(one.id for one in chain.findings if one.kind == "repair")
        assert repairs == chain.linted
        assert (repairs[0] in chain.refusal) if repairs else (chain.refusal == "")
        wanted = COUNT - CONDITIONS[name].dropped
        assert {"one splat": 1, "a million identical": COPIES}.get(name, wanted) == len(chain.source)

    assert_each(chains, check)


def test_decoded_scenes_lie_within_the_stated_errors(chains):
    def check(_, chain):
        assert ((), True) == (chain.proof.failures, chain.proof.rms_verified)
        assert list(range(len(chain.source))) == sorted(chain.result.source_index.tolist())
        assert chain.source.origin == chain.decoded.origin

    assert_each(chains, check)


def test_the_stated_maxima_are_proved_without_an_index_too(chains):
    def check(name, chain):
        data = chain.result.data
        if name in DRAWN:
            assert (
                ()
                == verify_bounds(
                    Source.of(chain.source), chain.decoded, read_header(data), read_declared_bounds(data)
                ).failures
            )

    assert_each(chains, check)


def test_decoded_scenes_survive_a_ply(chains, tmp_path):
    def check(_, chain):
        decoded = chain.decoded
        write_ply(tmp_path / "back.ply", decoded)
        again = read_ply(tmp_path / "back.ply", strict=True)
        assert decoded.origin == again.origin
        for array in ("means", "scales", "sh0", "shN"):
            np.testing.assert_array_equal(getattr(decoded, array), getattr(again, array), array)
        np.testing.assert_allclose(decoded.quats, again.quats, atol=1e-6)
        np.testing.assert_allclose(decoded.opacities, again.opacities, atol=1e-6)

    assert_each(chains, check)


def test_pictures_of_source_and_file_are_finite(chains):
    def check(_, chain):
        for picture in chain.pictures:
            assert_picture_is_finite(picture)

    assert_each(chains, check)


def test_a_little_learning_leaves_splats_finite_and_brings_the_loss_down(chains):
    def check(name, chain):
        if name not in LEARNT:
            return
        learnt = chain.learnt
        assert len(chain.source) // 2 == len(learnt.half)
        assert_finite(learnt.half)
        assert COUNT == len(learnt.trained)
        assert_finite(learnt.trained)
        assert np.mean(learnt.losses[-10:]) < 0.98 * np.mean(learnt.losses[:10])
        if name == "exploded":
            assert "colours are too large to be tuned" in learnt.tuned
        else:
            assert_finite(learnt.tuned)

    assert_each(chains, check)


def test_identical_splats_come_back_identical(chains):
    chain = chains["a million identical"]
    assert len(chain.result.data) < 3_000
    for array in ARRAYS:
        values = getattr(chain.decoded, array)
        assert (values == values[0]).all(), array
    assert (0.0, 0.0) == measure_errors(chain.source, chain.decoded, np.arange(COPIES))["means"]


def test_lint_names_exploded_splats_and_no_others(chains):
    noted = {name: [one.count for one in chains[name].findings if one.id == "huge-values"] for name in NAMES}
    assert {name: [8] if name == "exploded" else [] for name in NAMES} == noted


# presets and qualities


@pytest.mark.parametrize("preset", PRESETS)
@pytest.mark.parametrize("name", [*MOST, pytest.param("a million identical", marks=LONG)])
def test_each_preset_lies_within_the_stated_errors(name, preset):
    if (name, preset) == ("a million identical", "small"):
        pytest.skip("a scene of SH degree 0 takes the same path as with balanced")
    result = encoded(name, preset)
    decoded = assert_proved(name, result)
    assert list(range(len(scene(name)[0]))) == sorted(result.source_index.tolist())
    assert scene(name)[0].origin == decoded.origin


@pytest.mark.parametrize("quality", QUALITIES)
@pytest.mark.parametrize("preset", PRESETS)
@pytest.mark.parametrize("name", MOST)
def test_the_ends_of_quality_hold_what_they_state(name, preset, quality):
    decoded = assert_proved(name, encoded(name, preset, quality))
    if preset == "balanced" and name != "exploded":  # any step moves the edges of its infinitely bright splats
        assert judge(name, (160, 120)).psnr(decoded) >= QUALITIES[quality]


@LONG
@pytest.mark.parametrize(
    ("name", "preset"),
    [(name, preset) for name in DRAWN for preset in PRESETS],
)
def test_pictures_are_as_good_as_the_guide_says(name, preset):
    size, psnr = guide_figures()[name][PRESETS.index(preset)]
    result = encoded(name, preset)
    assert judge(name).psnr(decode(result.data)) >= psnr - 0.5
    assert len(result.data) / len(result.source_index) <= 1.02 * size + 0.05


# one by one


def test_an_origin_keeps_what_float32_loses_ten_kilometres_away():
    def lost(name):
        model = scene(name)[0]
        return np.abs(model.means.astype(np.float64) + model.origin - true).max()

    true = scene("10 km away, origin")[0].means.astype(np.float64) + FAR
    assert (FAR, FAR, FAR) == scene("10 km away, origin")[0].origin
    assert 2e-4 < lost("10 km away") <= 2.0**-11  # half of what float32 tells apart there
    assert lost("10 km away, doubles") <= 2.0**-23
    # The errors that a file states do not hold what was lost before it was made.
    errors = [encoded(name, "balanced", 120.0).report.errors["means"][0] for name in NAMES[:2]]
    assert (0.0, True) == (errors[0], 0.0 < errors[1] < 1e-4)


def test_an_origin_is_told_from_coordinates_in_doubles(tmp_path):
    model = scene("10 km away, doubles")[0]
    assert all(abs(value - FAR) < 1.0 for value in model.origin)
    decoded = decode(encoded("10 km away, doubles", "balanced").data)
    write_ply(tmp_path / "absolute.ply", decoded, absolute=True)
    again = read_ply(tmp_path / "absolute.ply")
    assert decoded.origin == again.origin
    np.testing.assert_allclose(decoded.means, again.means, rtol=0, atol=1e-6)


def test_pictures_lose_little_ten_kilometres_away():
    """Float32 coordinates cost 45 dB at worst, an origin nothing, as the same camera moved along shows."""
    K = intrinsics(160, 120, 60.0)
    near, far = (
        render(scene(name)[0], look_at(np.array([0.0, -1.0, 3.0]) + at, np.full(3, at), (0, -1, 0), K, 160, 120)).rgb
        for name, at in (("10 km away, origin", 0.0), ("10 km away", FAR))
    )
    assert 45.0 <= -10.0 * np.log10(np.square(near - far).mean()) < 80.0


@LONG
def test_a_million_identical_splats_are_a_few_kilobytes():
    source = scene("a million identical")[0]
    for preset in PRESETS:
        data = encoded("a million identical", preset).data
        assert len(data) < 6_000
        decoded = decode(data)
        for array in ARRAYS:
            values = getattr(decoded, array)
            assert (values == values[0]).all(), array
        assert measure_errors(source, decoded, np.arange(len(source)))["means"] == (0.0, 0.0)


@LONG
def test_a_million_identical_splats_are_drawn_small_and_refused_large():
    source = scene("a million identical")[0]
    K = intrinsics(48, 36, 60.0)
    # So far away that one tile holds them all: what is seen is the pile's colour.
    eye = source.means[0] + np.array([0.0, 0.0, 12.0])
    camera = look_at(eye, source.means[0], (0, -1, 0), K, 48, 36)
    pictures = [render(model, camera) for model in (source, decode(encoded("a million identical", "fast").data))]
    for picture in pictures:
        assert_picture_is_finite(picture)
        assert picture.alpha.max() > 0.999
    assert np.square(np.clip(pictures[0].rgb, 0, 1) - np.clip(pictures[1].rgb, 0, 1)).mean() < 1e-3
    with pytest.raises(LimitError, match="MAX_INTERSECTIONS"):
        render(source, virtual_cameras(source, 1)[0])


def test_transparent_scenes_stay_transparent():
    result = encoded("all transparent", "small", 120.0)
    model = decode(result.data)
    np.testing.assert_array_equal(model.opacities == 0.0, result.source_index % 2 == 1)
    assert model.opacities.max() < 1 / 255
    picture = render(model, virtual_cameras(model, 1, 64, 48)[0], background=(0.25, 0.5, 0.75))
    np.testing.assert_array_equal(picture.rgb, np.broadcast_to(np.float32([0.25, 0.5, 0.75]), (48, 64, 3)))


@pytest.mark.parametrize("preset", PRESETS)
def test_exploded_splats_harm_no_others(preset):
    """Values that no lattice holds get tiles of their own; the rest errs as much as without them."""
    source, result = scene("exploded")[0], encoded("exploded", preset)
    assert any(note.startswith("sh0: huge values coarsen 1 of") for note in result.report.notes)
    decoded = decode(result.data)
    rest = (result.source_index < 40) | (result.source_index >= 48)
    assert COUNT - 8 == np.count_nonzero(rest)
    errors = measure_errors(source, decoded.select(rest), result.source_index[rest])
    steps = result.report.options
    assert errors["sh0"][0] <= 2.0 * steps["sh0_step"]
    assert errors["sh1"][0] <= 2.0 * steps["sh_step"]
    scales = np.sort(decoded.scales[rest], axis=1) - np.sort(source.scales[result.source_index[rest]], axis=1)
    assert np.abs(scales).max() <= 0.51 * steps["scale_step"]


def test_the_guide_names_every_condition():
    assert list(DRAWN) == list(guide_figures())
    assert sorted(2 * NAMES) == sorted(row[0] for row in guide_rows() if len(row) == 4)

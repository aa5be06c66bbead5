# SPDX-License-Identifier: Apache-2.0
"""Extreme scenes: read, encoded, decoded, rendered, simplified, learnt; tools/docs/results/extremes.md has the results.

Every condition goes through all stages once (`chains`). Presets and qualities are crossed for two conditions, and two
go through learning; the others, the quality that learning reaches, and the million splats take minutes.
"""

import json
import re
from dataclasses import replace

import extremes
import numpy as np
import pytest
from checked import measure_errors
from command_line import change_views
from extremes import CONDITIONS, COUNT, DRAWN, FEW, NAMES, PRESETS, QUICK, assert_finite, encoded, scene, scorer
from tables import failures
from typer.testing import CliRunner

from csplat import EncodeOptions, decode, encode, write_ply
from csplat.encode_api import encode_with_report
from csplat.encoder import Target
from csplat.errors import InputError, LimitError
from csplat.ply import read_ply
from csplat_render import render
from csplat_render.camera import intrinsics, look_at
from csplat_render.virtual_cameras import virtual_cameras
from csplat_tools.cli.app import app
from csplat_tools.optimise.simplify import simplify
from csplat_trainer.parameters import Parameters, from_model
from csplat_trainer.sensitivity import measure_sensitivity
from csplat_trainer.sensitivity_file import StoredSensitivity
from csplat_trainer.training_loop import fit_to_options, train

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("small_views")]
QUALITIES = {None: None, 10.0: 12.0, 120.0: 44.0}  # attribute_psnr, and the least PSNR of renders, dB
LONG = pytest.mark.long
CROSSED = [pytest.param(name, marks=() if name in ("needles", "half the rows NaN") else LONG) for name in NAMES]


@pytest.fixture(scope="module")
def chains(once):
    return once("extremes", lambda: {name: extremes.chain_of(name) for name in NAMES})


def assert_each(chains, check):
    """Call `check(name, chain)` for each condition; fail with the names of those that fail."""
    assert [] == failures({name: (name, chain) for name, chain in chains.items()}, lambda case: check(*case))


def assert_render_is_finite(result):
    for name in ("rgb", "alpha", "depth"):
        assert np.isfinite(getattr(result, name)).all(), name
    assert 0.0 <= result.alpha.min() <= result.alpha.max() <= 1.0


@LONG
def test_reading_repairs_defects_and_strict_reading_refuses_them(chains):
    def check(name, chain):
        repairs = CONDITIONS[name].repairs
        assert repairs == tuple(finding.id for finding in chain.findings if finding.kind == "repair") == chain.linted
        assert (repairs[0] in chain.refusal) if repairs else (chain.refusal == "")
        count = {"one splat": 1, "a million identical": extremes.COPIES}.get(name, COUNT - CONDITIONS[name].dropped)
        assert count == len(chain.source)
        huge = [finding.count for finding in chain.findings if finding.id == "huge-values"]
        assert ([8] if name == "exploded" else []) == huge

    assert_each(chains, check)


def test_decoded_scenes_are_finite_within_the_declared_bounds_and_survive_a_ply(chains, tmp_path):
    def check(_, chain):
        decoded = chain.decoded
        extremes.assert_bounds_hold(chain.source, chain.result, decoded)
        for result in chain.renders:
            assert_render_is_finite(result)
        write_ply(tmp_path / "back.ply", decoded)
        again = read_ply(tmp_path / "back.ply", strict=True)
        assert decoded.origin == again.origin
        for array in extremes.ARRAYS:
            atol = 1e-6 if array in ("quats", "opacities") else 0
            np.testing.assert_allclose(getattr(decoded, array), getattr(again, array), rtol=0, atol=atol, err_msg=array)

    assert_each(chains, check)


@pytest.mark.parametrize("name", extremes.TRAINED)
def test_a_little_learning_keeps_splats_finite_and_lowers_the_loss(chains, name):
    learnt = chains[name].learnt
    assert (COUNT // 2, COUNT) == (len(learnt.half), len(learnt.trained))
    assert_finite(learnt.half)
    assert_finite(learnt.trained)
    assert np.mean(learnt.losses[-10:]) < 0.98 * np.mean(learnt.losses[:10])
    if name == "exploded":
        assert "colours are too large for tuning" in learnt.tuned
    else:
        assert_finite(learnt.tuned)


def test_identical_splats_decode_identically(chains):
    chain = chains["a million identical"]
    assert len(chain.result.data) < 3_000
    for array in extremes.ARRAYS:
        values = getattr(chain.decoded, array)
        assert (values == values[0]).all(), array
    assert (0.0, 0.0) == measure_errors(chain.source, chain.decoded, np.arange(extremes.COPIES))["means"]


@pytest.mark.parametrize("preset", PRESETS)
@pytest.mark.parametrize("name", CROSSED)
def test_each_preset_and_quality_is_within_the_declared_bounds(name, preset):
    for quality, least in QUALITIES.items() if name in DRAWN else ((None, None),):
        result = encoded(name, preset, quality)
        decoded = decode(result.data)
        extremes.assert_bounds_hold(scene(name), result, decoded)
        if least and preset == "balanced" and name != "exploded":  # steps move the edges of infinitely bright splats
            assert scorer(name, extremes.SMALL).psnr(decoded) >= least


def test_an_origin_preserves_precision_ten_kilometres_away():
    true = scene("10 km away, origin").means.astype(np.float64) + extremes.FAR
    lost = {name: np.abs(scene(name).means.astype(np.float64) + scene(name).origin - true).max() for name in NAMES[:3]}
    assert (extremes.FAR, extremes.FAR, extremes.FAR) == scene("10 km away, origin").origin
    assert 2e-4 < lost["10 km away"] <= 2.0**-11  # half of float32's resolution there
    assert lost["10 km away, doubles"] <= 2.0**-23
    # Declared errors do not include what was lost before encoding.
    errors = [encoded(name, "balanced", 120.0).report.errors["means"][0] for name in NAMES[:2]]
    assert (0.0, True) == (errors[0], 0.0 < errors[1] < 1e-4)
    # Renders with float32 coordinates keep 45 dB or more of those with an origin, from the same relative camera.
    K = intrinsics(160, 120, 60.0)
    near, far = (
        render(scene(name), look_at(np.array([0.0, -1.0, 3.0]) + at, np.full(3, at), (0, -1, 0), K, 160, 120)).rgb
        for name, at in (("10 km away, origin", 0.0), ("10 km away", extremes.FAR))
    )
    assert 45.0 <= -10.0 * np.log10(np.square(near - far).mean()) < 80.0


@LONG
def test_a_million_identical_splats_are_rendered_in_one_tile_and_refused_in_many(tmp_path):
    source = scene("a million identical")
    # Far enough away for one tile to contain them all; the colour is that of the pile.
    eye = source.means[0] + np.array([0.0, 0.0, 12.0])
    camera = look_at(eye, source.means[0], (0, -1, 0), intrinsics(48, 36, 60.0), 48, 36)
    renders = [render(model, camera) for model in (source, decode(encoded("a million identical", "fast").data))]
    for result in renders:
        assert_render_is_finite(result)
        assert result.alpha.max() > 0.999
    assert np.square(np.clip(renders[0].rgb, 0, 1) - np.clip(renders[1].rgb, 0, 1)).mean() < 1e-3
    with pytest.raises(LimitError, match="MAX_INTERSECTIONS"):
        render(source, virtual_cameras(source, 1)[0])
    ply, file = extremes.write_scene(tmp_path, "a million identical"), tmp_path / "scene.csplat"
    run("encode", ply, file, "--preset", "fast")
    assert file.stat().st_size < 6_000
    run("verify", file, "--source", ply)
    assert "MAX_INTERSECTIONS" in refused("render", file, "--orbit", 1, tmp_path / "pictures")
    run("decode", file, tmp_path / "back.ply", "--limit-splats", 999_999, status=1)
    assert ["scene.csplat", "scene.ply"] == names_in(tmp_path)


def test_transparent_scenes_stay_transparent():
    result = encoded("all transparent", "small", 120.0)
    model = decode(result.data)
    np.testing.assert_array_equal(model.opacities == 0.0, result.source_index % 2 == 1)
    assert model.opacities.max() < 1 / 255
    result = render(model, virtual_cameras(model, 1, 64, 48)[0], background=(0.25, 0.5, 0.75))
    np.testing.assert_array_equal(result.rgb, np.broadcast_to(np.float32([0.25, 0.5, 0.75]), (48, 64, 3)))


@pytest.mark.parametrize("preset", PRESETS)
def test_exploded_splats_do_not_affect_others(preset):
    """Values outside every lattice get their own tiles; errors of the other splats stay as they are without them."""
    source, result = scene("exploded"), encoded("exploded", preset)
    assert any(note.startswith("sh0: huge values coarsen 1 of") for note in result.report.notes)
    decoded, steps = decode(result.data), result.report.options
    rest = (result.source_index < 40) | (result.source_index >= 48)
    assert COUNT - 8 == np.count_nonzero(rest)
    errors = measure_errors(source, decoded.select(rest), result.source_index[rest])
    assert errors["sh0"][0] <= 2.0 * steps["sh0_step"]
    assert errors["sh1"][0] <= 2.0 * steps["sh_step"]
    scales = np.sort(decoded.scales[rest], axis=1) - np.sort(source.scales[result.source_index[rest]], axis=1)
    assert np.abs(scales).max() <= 0.51 * steps["scale_step"]


# Commands
def run(*words, status=0):
    """Run a command. Warnings of NumPy are errors, and exceptions other than ours are raised."""
    done = CliRunner().invoke(app, [str(word) for word in words], catch_exceptions=False)
    assert status == done.exit_code, done.stderr
    assert not re.search("Traceback|Warning", done.stderr)
    return done


def refused(*words):
    """Run a command that fails with one line besides remarks and progress; return that line."""
    (error,) = [line for line in run(*words, status=1).stderr.splitlines() if line.startswith("error: ")]
    return error


def names_in(folder):
    return sorted(path.name for path in folder.iterdir())


@pytest.mark.parametrize("name", [pytest.param(name, marks=() if "NaN" in name else LONG) for name in DRAWN])
def test_the_whole_chain(name, tmp_path):
    ply, file, back = extremes.write_scene(tmp_path, name), tmp_path / "scene.csplat", tmp_path / "back.ply"
    condition, pictures = CONDITIONS[name], tmp_path / "pictures"
    done = run("encode", ply, file, "--source-index", tmp_path / "index.npy")
    assert condition.repairs == tuple(re.findall(r"^repair: ([a-z-]+):", done.stderr, re.MULTILINE))
    assert ("huge values coarsen" in done.stderr) == (name == "exploded")
    done = run("verify", file, "--source", ply, "--source-index", tmp_path / "index.npy", "--json")
    assert json.loads(done.stdout)["verification"]["rms_and_counts_verified"]
    run("decode", file, back)
    assert len(condition.make()["means"]) - condition.dropped == len(read_ply(back, strict=True))
    assert json.loads(run("info", file, "--json").stdout)["size_bytes"] == file.stat().st_size
    run("render", file, "--orbit", 2, "--size", "64x48", pictures, "--depth")
    assert ["0000.depth.npy", "0000.png", "0001.depth.npy", "0001.png"] == names_in(pictures)
    assert np.isfinite(np.load(pictures / "0000.depth.npy")).all()
    with pytest.MonkeyPatch.context() as patch:
        change_views(patch, 3, (40, 30))
        done = run("simplify", ply, tmp_path / "half.ply", "--keep", 0.5, "--effort", 1, "--json")
    assert json.loads(done.stdout)["splats"] == len(read_ply(tmp_path / "half.ply", strict=True))


def test_a_splat_with_huge_and_small_scales_has_declared_bounds(tmp_path):
    """A lattice that contains a log scale of -3e38 rounds one of -1000 to 0."""
    columns = CONDITIONS["exploded"].make()
    columns["scales"][50] = [-3e38, -1000.0, -1000.0]
    ply, file = extremes.write_columns(tmp_path / "scene.ply", columns), tmp_path / "scene.csplat"
    assert "huge values coarsen" in run("encode", ply, file).stderr
    run("verify", file, "--source", ply)


def test_a_scene_without_splats_gives_an_empty_file_and_one_of_nan_is_refused(tmp_path):
    columns = CONDITIONS["needles"].make()
    ply, file = tmp_path / "scene.ply", tmp_path / "scene.csplat"
    extremes.write_columns(ply, {name: array[:0] for name, array in columns.items()})
    assert json.loads(run("encode", ply, file, "--json").stdout)["bytes_per_splat"] is None
    run("verify", file, "--source", ply)
    run("decode", file, tmp_path / "back.ply")
    assert 0 == len(read_ply(tmp_path / "back.ply"))
    assert "without splats cannot be simplified" in refused("simplify", ply, tmp_path / "half.ply", "--keep", 0.5)
    run("render", file, "--orbit", 1, "--size", "32x24", tmp_path / "pictures")
    columns["means"][:] = np.nan
    extremes.write_columns(ply, columns)
    assert "300 splats with NaN or infinity: none is left" in refused("encode", ply, tmp_path / "none.csplat")
    assert ["back.ply", "pictures", "scene.csplat", "scene.ply"] == names_in(tmp_path)


# Simplification and importance
@LONG
@pytest.mark.parametrize("name", NAMES)
def test_half_the_splats_keep_the_psnr_of_the_results(name):
    found = extremes.half(name)
    assert max(1, len(extremes.small_scene(name)) // 2) == len(found.model)
    assert_finite(found.model)
    assert scorer(name, extremes.SMALL).psnr(found.model) >= extremes.EXPECTED[name]["half_psnr"] - 0.3
    assert found.report["check_psnr"] >= found.report["check_psnr_pruned"] - 1.0


@LONG
def test_a_refit_misled_by_saturated_colours_is_refused():
    """The loss of the refit includes colours above 1, which images clip."""
    found = simplify(extremes.small_scene("saturated SH"), Target(keep=0.97), options=FEW)
    assert found.report["check_psnr"] >= found.report["check_psnr_pruned"] - 1.0
    assert found.report["refit_refused"]


@LONG
def test_measured_importances_serve_the_object_in_front_of_a_giant_background():
    """Ranked by opacity and size, the background would own the codebook."""
    source = extremes.small_scene("giant background")
    found = measure_sensitivity(source, virtual_cameras(source, 32, 160, 120))
    importance = StoredSensitivity.of(source, found).importance()
    guessed = encoded("giant background", "balanced").data
    measured = encode_with_report(source, importance=importance).data
    scalar = encode(source, EncodeOptions(sh_coding="scalar"))
    assert len(measured) < 1.02 * len(guessed)
    assert len(scalar) < 1.28 * len(guessed)
    found = [scorer("giant background").psnr(decode(data)) for data in (guessed, measured, scalar)]
    assert [31.1, 42.2] == pytest.approx([found[0], found[2]], abs=0.7)
    assert found[1] == pytest.approx(34.6, abs=2.5)  # clusters of 300 splats depend on rounding of the weights


@LONG
def test_a_pile_of_identical_splats_requires_a_finer_quality():
    """Errors of alpha add up."""
    source, views = extremes.small_scene("a million identical"), scorer("a million identical", extremes.SMALL)
    expected = ("small", None, 22.3), ("balanced", None, 30.0), ("fast", None, 35.1), ("balanced", 70.0, 37.9)
    for preset, quality, psnr in expected:
        data = encode(source, EncodeOptions(preset=preset, attribute_psnr=quality))
        assert views.psnr(decode(data)) == pytest.approx(psnr, abs=0.5)


# Training and tuning
@LONG
@pytest.mark.parametrize("name", NAMES)
def test_training_from_centres_lowers_the_loss(name):
    result = extremes.trained(name)
    losses = result.log["losses"]
    assert_finite(result.model)
    assert COUNT == len(result.model)
    # Points without colours start with those of the images, which are nearly final if all splats are alike.
    assert np.mean(losses[-10:]) < max(0.92 * np.mean(losses[:10]), 0.03)
    assert "all transparent" != name or result.metrics["psnr_mean"] > 40.0


@LONG
@pytest.mark.parametrize("name", ["giant background", "float32 limits", "exploded", "a million identical"])
def test_splitting_and_cloning_keep_splats_finite(name):
    """The gradient strategy samples the halves of a split from its shape, however large."""
    options = replace(QUICK, strategy="gradient", init="points", max_splats=2 * COUNT, grad_threshold=0.0)
    result = train(extremes.images(name, extremes.small_scene(name).means[:COUNT]), options)
    assert_finite(result.model)
    assert len(result.model) > COUNT


@LONG
@pytest.mark.parametrize("name", ["10 km away", "giant background", "all transparent", "half the rows NaN"])
def test_training_from_random_points_does_not_raise_the_loss(name):
    result = train(extremes.images(name), QUICK)
    assert_finite(result.model)
    assert result.log["losses"][-1] <= result.log["losses"][0]


def test_splats_that_start_in_one_place_get_sizes_that_fill_the_scene():
    data = extremes.images("a million identical", extremes.small_scene("a million identical").means[:COUNT])
    scales = train(data, replace(QUICK, iterations=1, init="points")).model.scales
    assert (-4.0, 1.0) < (scales.min(), scales.max()) < (1.0, 1.0)


def test_resuming_with_fewer_splats_keeps_the_most_visible():
    model = extremes.small_scene("exploded")
    parameters = Parameters.starting_at(from_model(model, 1))
    left = fit_to_options(parameters, replace(QUICK, max_splats=40), np.random.default_rng(0))
    largest = {tuple(row) for row in model.means[[44, 46]].tolist()}
    assert 40 == len(left)
    assert largest <= {tuple(row) for row in left.values["means"].tolist()}


def test_points_that_are_not_finite_are_refused_by_training():
    points = np.zeros((4, 3), np.float32)
    points[1, 2], points[3, 0] = np.nan, np.inf
    with pytest.raises(InputError, match="2 of the data set's 4 points are NaN or infinite"):
        train(extremes.images("needles", points), replace(QUICK, init="points"))


@LONG
@pytest.mark.parametrize("name", [name for name in NAMES if name != "exploded"])
def test_a_tuned_file_is_no_worse_than_before(name):
    *decoded, result, views = extremes.tuned(name)
    assert_finite(decoded[1])
    before, after = map(views.psnr, decoded)
    gain = 1.0 if name in ("a million identical", "half the rows NaN", "10 km away") else -0.5
    assert after >= before + gain  # the best step is chosen by SSIM and L1
    assert after == pytest.approx(min(result.log["best_psnr"], 99.0), abs=0.01)


def test_splats_wider_than_float32_are_tuned():
    source = extremes.small_scene("needles").select(slice(40))
    source = replace(source, scales=np.full_like(source.scales, 100.0))  # standard deviation e^100
    cameras = virtual_cameras(source, 6, 32, 24)
    fixed, result, _ = extremes.tune_on_renders(source, cameras, 2, replace(extremes.SHORT, iterations=20))
    assert_finite(decode(fixed.encode(result.best_values).write().data))

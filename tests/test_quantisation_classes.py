"""Quantisation classes: splats sorted by importance, steps by class, files that both decoders read."""

import hashlib
import shutil
import subprocess
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from checked import encoded

import csplat
from csplat.encoder import EncodeOptions, EncodePlan, Importance, encode_tiles, encode_with_report, fix_quantisation
from csplat.encoder.coding_parameters import choose_parameters
from csplat.encoder.encode_plan import trial_rows
from csplat.encoder.error_bounds import covariance_entries
from csplat.encoder.quantisation import opacity_levels, quantise_colour, quat_levels
from csplat.encoder.quantisation_classes import choose_classes
from csplat.encoder.shape_codebook import quantise_shape
from csplat.encoder.splat_importance import CLASSED_ATTRIBUTES, GaussNewtonBlocks, apply_weight_floor, rounding_errors
from csplat.encoder.tiling import cut_scene
from csplat.errors import InputError
from csplat.model import normalise_quats
from csplat_trainer.tuning.tuned_scene import TunedScene, cost_slopes

ROOT = Path(__file__).resolve().parent.parent
COUNT = 5_000  # splats; enough for several classes


def unequal(model, seed=0, spread=3.0):
    """Return blocks that differ from splat to splat by orders of magnitude."""
    rng = np.random.default_rng(seed)
    size = rng.lognormal(0.0, spread, len(model))
    roots = rng.normal(size=(len(model), 6, 3))
    rows, columns = np.triu_indices(6)
    matrices = (roots @ roots.transpose(0, 2, 1))[:, rows, columns]
    return GaussNewtonBlocks(size, matrices * size[:, None], 1e3 * size, size)


def important(model, **changes):
    return Importance(np.ones(len(model)), blocks=replace(unequal(model), **changes))


@pytest.fixture
def model(make_model):
    return make_model(COUNT, 0)


# Errors.
def test_blocks_of_shapes_agree_with_the_covariance(make_model):
    model = make_model(50, 0)
    plan = choose_parameters(model, EncodeOptions(scale_step=1.0, quat_levels=100), importance_given=True)
    curvatures = unequal(model)
    found = rounding_errors(model, curvatures, plan)
    rows, columns = np.triu_indices(6)
    matrices = np.zeros((50, 6, 6))
    matrices[:, rows, columns] = matrices[:, columns, rows] = curvatures.shapes

    def lost(quats, scales):
        """Return the cost of a small change of shape, from the covariance relative to the trace before the change."""
        variances = np.exp(2.0 * model.scales.T.astype(np.float64))
        before = covariance_entries(model.quats.T, variances) / variances.sum(axis=0)
        after = covariance_entries(quats.T, np.exp(2.0 * scales.T.astype(np.float64))) / variances.sum(axis=0)
        vectors = (after - before).T * np.sqrt([1, 1, 1, 2, 2, 2])
        return np.einsum("ni,nij,nj->n", vectors, matrices, vectors)

    small = 1e-4
    sizes = sum(lost(model.quats, model.scales + small * np.eye(3)[axis]) for axis in range(3)) / small**2
    np.testing.assert_allclose(found[:, 1], sizes / 12.0, rtol=2e-3)
    turns = np.zeros(50)
    for axis in range(3):
        turn = np.r_[1.0, small / 2.0 * np.eye(3)[axis]]
        turns += lost(_multiplied(model.quats.astype(np.float64), turn), model.scales) / small**2
    angle = 2.0 / (plan.quat_levels * np.sqrt(2.0))
    np.testing.assert_allclose(found[:, 2], turns * angle**2 / 12.0, rtol=2e-3)


def _multiplied(q, turn):
    """Return q · turn, a rotation in the splat's own axes."""
    w, v = q[:, :1], q[:, 1:]
    a, b = turn[0], turn[1:]
    return np.concatenate([w * a - (v @ b)[:, None], w * b + a * v + np.cross(v, b)], axis=1)


def test_twice_the_step_gives_four_times_the_error(model):
    curvatures = unequal(model)
    fine, coarse = (
        rounding_errors(model, curvatures, choose_parameters(model, EncodeOptions(**options), importance_given=True))
        for options in (
            {"position_step": 0.01, "scale_step": 0.01, "sh0_step": 0.01, "quat_levels": 200, "opacity_levels": 200},
            {"position_step": 0.02, "scale_step": 0.02, "sh0_step": 0.02, "quat_levels": 100, "opacity_levels": 100},
        )
    )
    bright = model.opacities > 0.01
    np.testing.assert_allclose(coarse[bright], 4.0 * fine[bright], rtol=1e-5)


@pytest.mark.slow
def test_the_error_of_rounding_is_predicted():
    pytest.importorskip("numba", reason="pictures require the extra [render]")
    from captures import cameras, shell

    from csplat_render import render
    from csplat_tools.optimise.scene_sensitivity import measure_importance

    scene, views = shell(0), cameras(12)
    options = EncodeOptions(attribute_psnr=58)
    importance = measure_importance(scene, views, (0.0, 0.0, 0.0), threads=None)
    plan = choose_parameters(scene, options, importance_given=True)
    foretold = rounding_errors(scene, importance.blocks, plan).sum()
    decoded = csplat.decode(encode_with_report(scene, options).data)
    lost = np.mean([np.mean(np.square(render(decoded, view).rgb - render(scene, view).rgb)) for view in views])
    assert foretold / 1.6 < lost < 1.6 * foretold


# Files.
def test_classes_have_steps_of_their_own(model):
    plain, _ = encoded(model)
    graded, _ = encoded(model, important(model))
    classes = graded.report.options["classes"]
    assert sum(classes["splats"]) == COUNT
    assert len(classes["splats"]) == graded.report.tile_count > plain.report.tile_count == 1
    for name in CLASSED_ATTRIBUTES:
        assert min(classes[name]) == (1 if name in ("opacities", "quats") else 0)
    assert any(max(classes[name]) > 1 for name in CLASSED_ATTRIBUTES)
    assert graded.report.notes == ()


@pytest.mark.parametrize("name", ["means", "opacities", "scales", "sh0"])
def test_important_splats_have_smaller_errors(model, name):
    importance = important(model)
    result, decoded = encoded(model, importance, attribute_psnr=45)
    source = model if name != "scales" else replace(model, scales=np.sort(model.scales, axis=1))
    if name == "scales":
        decoded = replace(decoded, scales=np.sort(decoded.scales, axis=1))
    errors = np.abs(getattr(decoded, name) - getattr(source, name)[result.source_index]).reshape(COUNT, -1).mean(axis=1)
    order = np.argsort(importance.blocks.means[result.source_index])
    assert errors[order[-COUNT // 10 :]].mean() < 0.75 * errors[order[: COUNT // 10]].mean()


def test_explicit_options_apply_to_all_classes(model):
    result, _ = encoded(model, important(model), scale_step=0.01, opacity_levels=100, position_bits=12)
    said = result.report.options
    assert (said["scale_step"], said["opacity_levels"]) == (float(np.float32(0.01)), 100)
    assert set(said["classes"]["scales"]) == set(said["classes"]["means"]) == {0}
    assert set(said["classes"]["opacities"]) == {1}
    assert max(said["classes"]["sh0"]) > 0


@pytest.mark.slow
@pytest.mark.parametrize("options", [{"max_classes": 1}, {"shape_codebook_size": 16}])
def test_one_class_equals_an_encoding_without_blocks(model, options):
    with_them, without = important(model), Importance(np.ones(COUNT))
    assert encoded(model, with_them, **options)[0].data == encoded(model, without, **options)[0].data


def test_small_scenes_have_one_class(make_model):
    few = make_model(200, 1)
    assert "classes" not in encoded(few, important(few))[0].report.options


def test_blocks_of_zeros_give_one_class(model):
    nothing = GaussNewtonBlocks(np.zeros(COUNT), np.zeros((COUNT, 21)), np.zeros(COUNT), np.zeros(COUNT))
    result, _ = encoded(model, Importance(np.ones(COUNT), blocks=nothing))
    assert "classes" not in result.report.options


def test_classes_may_be_disallowed(model):
    fixed = fix_quantisation(EncodePlan.of(model, importance=important(model), allow_classes=False))
    assert fixed.encode_plan.classes is None
    assert fixed.encode_plan.options.max_classes is None


def test_outliers_get_tiles_of_their_own(model):
    sh0 = model.sh0.copy()
    sh0[5] = 3e12
    exploded = replace(model, sh0=sh0)
    result, decoded = encoded(exploded, important(exploded))
    place = np.argsort(result.source_index)
    errors = np.abs(decoded.sh0[place] - sh0).max(axis=1)
    assert np.delete(errors, 5).max() < 5.0  # the step of the coarsest class, not that of 3e12


def test_the_scene_of_a_plan_equals_the_decoded_one(model):
    draft = EncodePlan.of(model, importance=important(model))
    result = encode_tiles(draft).write()
    decoded = csplat.decode(result.data)
    for name in ("means", "quats", "scales", "opacities"):
        np.testing.assert_array_equal(getattr(draft.scene, name)[result.source_index], getattr(decoded, name))


def test_fixed_values_of_several_classes_equal_the_decoded_ones(model):
    fixed = fix_quantisation(EncodePlan.of(model, importance=important(model)))
    values = fixed.start()
    result = fixed.encode(values).write()
    decoded, seen = csplat.decode(result.data), fixed.dequantise(values)
    order = np.argsort(fixed.source_index)[result.source_index]
    for name in ("means", "quats", "scales", "opacities", "sh0", "shN"):
        np.testing.assert_array_equal(getattr(seen, name)[order], getattr(decoded, name))


def test_costs_count_the_encoded_integers_of_each_class(make_model):
    # The encoder counts integers divided by the multiple of their class.
    model = make_model(8_000, 0)  # counts of fewer splats differ by more than a thousandth
    fixed = fix_quantisation(EncodePlan.of(model, EncodeOptions(sh_coding="none"), importance=important(model)))
    scene, plan, tiles = TunedScene(fixed), fixed.parameters, fixed.encode_plan.tiles
    values, bits = scene.free_values, 0.0
    classes = list(dict.fromkeys(tile.factors for tile in tiles))
    assert len(classes) > 1
    for factors in classes:
        rows = np.concatenate([tile.rows for tile in tiles if tile.factors == factors])
        shape = quantise_shape(values.quats[rows], values.scales[rows], plan, None, factors)
        alpha = opacity_levels(values.opacities[rows], plan.opacity_levels, square=True, multiple=factors.opacities)
        colour = quantise_colour(
            np.ascontiguousarray(values.sh0[rows].T), plan.sh0_step, plan.chroma_shift, factors.sh0
        )[0]
        for columns in (shape.scales, shape.quats // factors.quats, alpha[None] // factors.opacities, colour):
            bits += cost_slopes([columns.T])[1]
    assert scene.count(scene.dequantise()[0], 1.0).bits == pytest.approx(bits, rel=1e-3)


def test_trial_rows_cover_all_classes(model):
    parameters, classes = choose_classes(
        model, unequal(model), choose_parameters(model, EncodeOptions(), importance_given=True), EncodeOptions()
    )
    tiles = cut_scene(model, parameters, classes)
    found = classes.index[trial_rows(model, tiles, classes)]
    assert set(found) == set(classes.index)
    np.testing.assert_allclose(np.bincount(found) / len(found), np.bincount(classes.index) / COUNT, atol=0.05)
    assert set(trial_rows(model, tiles, None)) == set(tiles[len(tiles) // 2].rows)


def test_one_splat_does_not_change_the_steps_of_others(model):
    one = unequal(model).means.copy()
    one[7] *= 1e20
    alone, together = important(model, means=one), important(model)
    without, with_it = encoded(model, together)[0].report.options, encoded(model, alone)[0].report.options
    for name in ("scale_step", "sh0_step", "position_step"):
        assert 0.5 < with_it[name] / without[name] < 2.0, name


@pytest.mark.parametrize("factor", [1e-30, 1e22, 1e37])
def test_scenes_of_any_extent_are_encoded(model, factor):
    scaled = replace(model, means=(model.means * np.float32(factor)).astype(np.float32))
    encoded(scaled, important(scaled))


def test_steps_of_any_size_are_accepted(model):
    result, _ = encoded(model, important(model), position_step=1e200)
    assert result.report.options["position_step"] == 1e200


def test_the_preset_fast_has_one_class_by_default(model):
    assert "classes" not in encoded(model, important(model), preset="fast")[0].report.options
    assert "classes" in encoded(model, important(model), preset="fast", max_classes=2)[0].report.options


@pytest.mark.parametrize(("field", "value"), [
    ("means", np.ones(3)),
    ("means", np.full(COUNT, -1.0)),
    ("opacities", np.full(COUNT, np.nan)),
    ("colours", np.ones(COUNT, np.int64)),
    ("shapes", np.ones((COUNT, 6))),
])  # fmt: skip
def test_invalid_blocks_are_refused(model, field, value):
    with pytest.raises(InputError, match=f"Gauss-Newton blocks of {field}"):
        encode_with_report(model, importance=important(model, **{field: value}))


def test_the_number_of_threads_does_not_change_the_bytes(model):
    one, two = (encode_with_report(model, EncodeOptions(threads=n), importance=important(model)) for n in (1, 2))
    assert one.data == two.data
    assert "classes" in one.report.options


def test_the_javascript_decoder_agrees(model, tmp_path):
    node = shutil.which("node")
    if node is None:
        pytest.skip("node is not installed")
    result, decoded = encoded(model, important(model))
    path = tmp_path / "graded.csplat"
    path.write_bytes(result.data)
    script = f"""
import {{ readFileSync }} from 'node:fs';
import {{ createHash }} from 'node:crypto';
import {{ decode }} from {str((ROOT / "codec/js/decoder.mjs").as_uri())!r};
const scene = await decode(new Uint8Array(readFileSync({str(path)!r})));
const hash = createHash('sha256');
for (const name of ['means', 'quats', 'scales', 'opacities', 'sh0'])
  hash.update(new Uint8Array(scene[name].buffer, scene[name].byteOffset, scene[name].byteLength));
console.log(hash.digest('hex'));
"""
    seen = subprocess.run([node, "--input-type=module", "-e", script], capture_output=True, text=True, check=True)
    digest = hashlib.sha256()
    for name in ("means", "quats", "scales", "opacities", "sh0"):
        digest.update(np.ascontiguousarray(getattr(decoded, name)).tobytes())
    assert seen.stdout.strip() == digest.hexdigest()


# Classes and integers.
def test_tiles_have_the_step_factors_of_their_class(model):
    plan = choose_parameters(model, EncodeOptions(), importance_given=True)
    finer, classes = choose_classes(model, unequal(model), plan, EncodeOptions())
    tiles = cut_scene(model, finer, classes)
    assert sorted(np.concatenate([tile.rows for tile in tiles])) == list(range(COUNT))
    for tile in tiles:
        assert len(set(classes.index[tile.rows])) == 1
        assert tile.factors == classes.factors[classes.index[tile.rows[0]]]
        assert tile.exponent >= tile.factors.means
    assert min(one.means for one in classes.factors) == min(one.sh0 for one in classes.factors) == 0
    weights = unequal(model).means
    first, last = (weights[classes.index == index].mean() for index in (0, classes.index.max()))
    assert first > last


@pytest.mark.parametrize("multiple", [2, 3, 7])
def test_coarse_opacities_are_multiples_or_ends(multiple):
    alpha = np.linspace(0, 1, 999, dtype=np.float32)
    q = opacity_levels(alpha, 50, square=True, multiple=multiple)
    assert (q[0], q[-1]) == (0, 50)
    assert set(q) <= {*range(0, 51, multiple), 50}
    assert np.abs(q - 50 * np.sqrt(alpha)).max() <= multiple
    assert (np.diff(q) >= 0).all()


@pytest.mark.parametrize(("levels", "multiple"), [(12, 4), (50, 7), (255, 30)])
def test_coarse_rotations_are_multiples_within_bounds(levels, multiple):
    rng = np.random.default_rng(0)
    rotation = np.abs(normalise_quats(rng.normal(size=(20_000, 4)).astype(np.float32)))
    rotation = np.sort(rotation, axis=1)[:, ::-1].T.copy()
    rotation[:, 0] = 0.5
    q = quat_levels(rotation, levels, multiple)
    assert not (q % multiple).any()
    assert np.abs(q).max() <= levels
    assert ((q.astype(np.int64) ** 2).sum(axis=0) <= 2 * levels**2).all()
    assert np.abs(q - rotation[1:] * levels * 2**0.5).max() <= multiple


def test_measured_weights_have_a_floor(model):
    measured = np.zeros((COUNT, 2))
    measured[:10] = 1.0
    floored = apply_weight_floor(measured, model)
    assert (floored >= measured).all()
    assert floored[10:].min() > 0.0
    np.testing.assert_allclose(floored[10:, 0], apply_weight_floor(measured[:, 0], model)[10:])
    assert floored[10:].mean() < 0.6 * measured.mean()


@pytest.mark.slow
@pytest.mark.parametrize("most", [None, 2])
def test_the_command_notes_that_weights_give_one_class(model, tmp_path, most):
    from command_line import change_options, invoke

    csplat.write_ply(tmp_path / "scene.ply", model)
    np.save(tmp_path / "weights.npy", np.ones(COUNT, np.float32))
    with pytest.MonkeyPatch.context() as patch:
        change_options(patch, "csplat_tools.cli.encode.EncodeOptions", max_classes=most)
        words = ("encode", tmp_path / "scene.ply", tmp_path / "a.csplat", "--importance", tmp_path / "weights.npy")
        done = invoke(*words, "-q")
    assert done.exit_code == 0
    assert ("in one quantisation class" in done.stderr) == (most is not None)

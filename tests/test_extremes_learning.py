"""Scenes at the extremes: simplified, trained on, tuned. Figures and words stand in codec/EXTREMES.md.

The usual tests refuse what cannot be learnt from, and see that a little learning survives (test_extremes.py); how good
it gets is in the area `extremes`.
"""

from dataclasses import replace

import numpy as np
import pytest
from extremes import COUNT, NAMES, encoded, guide_rows, judge

pytest.importorskip("numba", reason="learning needs numba: pip install 'csplat[render]'")
pytest.importorskip("scipy", reason="training needs scipy: pip install 'csplat[render]'")

# Importing it needs what is looked for above.
from captures import views_of
from extremes_learnt import (
    BLACK,
    COARSE,
    FEW,
    QUICK,
    SHORT,
    before_and_after,
    half,
    learnt_from,
    photographs,
    small_judge,
    trained,
    tuned,
)

from csplat import EncodeOptions, decode, encode
from csplat.decoder import read_declared_bounds, read_header
from csplat.encoder import EncodePlan, encode_with_report, fix_quantisation
from csplat.errors import InputError
from csplat_conformance.declared_bounds import Source, verify_bounds
from csplat_render.virtual_cameras import virtual_cameras
from csplat_tools.optimise.pruning import simplify
from csplat_tools.optimise.target_encoding import encode_to
from csplat_tools.views import find_view_set
from csplat_trainer.data.colmap import read_points
from csplat_trainer.parameters import Parameters, from_model
from csplat_trainer.sensitivity import measure_sensitivity
from csplat_trainer.sensitivity_file import StoredSensitivity
from csplat_trainer.training_checkpoint import fit_to_options
from csplat_trainer.training_loop import train
from csplat_trainer.tuning import renders_of, split_views, tune

pytestmark = [
    pytest.mark.extremes,
    pytest.mark.slow,
    pytest.mark.usefixtures("small_views"),
]
LONG = pytest.mark.area(name="extremes")

ARRAYS = ("means", "quats", "scales", "opacities", "sh0", "shN")


def assert_finite(model):
    for name in ARRAYS:
        assert np.isfinite(getattr(model, name)).all(), name


def told(name, column):
    """Return a cell about a condition in the guide's second table."""
    return next(row[column] for row in guide_rows() if row[0] == name and len(row) == 4 and "→" in row[2])


# simplification


@LONG
@pytest.mark.parametrize("name", NAMES)
def test_half_the_splats_keep_what_the_guide_says(name):
    source, found = learnt_from(name), half(name)
    assert max(1, len(source) // 2) == len(found.model)
    assert_finite(found.model)
    assert small_judge(name).psnr(found.model) >= float(told(name, 1)) - 0.3
    assert found.report["check_psnr"] >= found.report["check_psnr_pruned"] - 1.0


@LONG
@pytest.mark.parametrize("name", NAMES)
def test_a_simplified_file_states_what_holds(name):
    source = learnt_from(name)
    views, options = find_view_set(source, count=10, size=(60, 45)), FEW
    result = encode_to(source, keep=0.5, views=views, simplifying=options).result
    decoded = decode(result.data)
    assert max(1, len(source) // 2) == len(decoded)
    proof = verify_bounds(
        Source.of(source), decoded, read_header(result.data), read_declared_bounds(result.data), result.source_index
    )
    assert () == proof.failures
    assert_finite(decoded)


@LONG
@pytest.mark.parametrize(
    ("name", "most"), [("all transparent", 0.1), ("saturated SH", 1.0), ("a million identical", 0.25)]
)
def test_a_target_psnr_is_reached(name, most):
    source = learnt_from(name)
    found = simplify(source, psnr=33.0, views=views_of(virtual_cameras(source, 16, 60, 45)), options=FEW)
    assert found.report["validation_psnr"] >= 33.0
    assert len(found.model) <= most * len(source)


@LONG
def test_a_fit_that_saturated_colours_mislead_is_refused():
    """The fit counts colours beyond 1 as they are, pictures do not show them."""
    found = simplify(learnt_from("saturated SH"), keep=0.97, options=FEW)
    assert found.report["check_psnr"] >= found.report["check_psnr_pruned"] - 1.0
    assert found.report["refit_refused"]


@LONG
def test_measured_importances_serve_what_stands_before_a_giant_background():
    """By opacity and size the background owns the codebook."""
    source = learnt_from("giant background")
    found = measure_sensitivity(source, virtual_cameras(source, 32, 160, 120))
    importance = StoredSensitivity.of(source, found).importance()
    guessed = encoded("giant background", "balanced").data
    measured = encode_with_report(source, importance=importance).data
    scalar = encode(source, EncodeOptions(sh_coding="scalar"))
    assert len(measured) < 1.02 * len(guessed)
    assert len(scalar) < 1.26 * len(guessed)
    found = [judge("giant background").psnr(decode(data)) for data in (guessed, measured, scalar)]
    assert [found[0], found[2]] == pytest.approx([28.7, 41.0], abs=0.7)
    assert found[1] == pytest.approx(40.4, abs=2.5)  # the clusters of 300 splats depend on the last digit of a weight


@LONG
def test_a_pile_of_identical_splats_wants_a_finer_quality():
    """Compare with the guide's figures: errors of alpha add up in a pile of identical splats."""
    source, judged = learnt_from("a million identical"), small_judge("a million identical")
    told = ("small", None, 22.3), ("balanced", None, 30.0), ("fast", None, 35.1), ("balanced", 70.0, 37.9)
    for preset, quality, psnr in told:
        found = judged.psnr(decode(encode(source, EncodeOptions(preset=preset, attribute_psnr=quality))))
        assert found == pytest.approx(psnr, abs=0.5)


# training


@LONG
@pytest.mark.parametrize("name", NAMES)
def test_training_begins_at_centres_and_brings_the_loss_down(name):
    result = trained(name)
    losses = result.log["losses"]
    assert_finite(result.model)
    assert COUNT == len(result.model)
    # Points without colours start with the photographs' colours, nearly the final ones if all splats are alike.
    assert np.mean(losses[-10:]) < max(0.92 * np.mean(losses[:10]), 0.03)


@LONG
@pytest.mark.parametrize("name", ["giant background", "float32 limits", "exploded", "a million identical"])
def test_splitting_and_cloning_keep_splats_finite(name):
    """The gradient strategy draws the halves of a split from its shape, however large."""
    options = replace(QUICK, strategy="gradient", init="points", max_splats=2 * COUNT, grad_threshold=0.0)
    result = train(photographs(name, learnt_from(name).means[:COUNT]), options)
    assert_finite(result.model)
    assert len(result.model) > COUNT


@LONG
@pytest.mark.parametrize("name", ["10 km away", "giant background", "all transparent", "half the rows NaN"])
def test_training_begins_in_a_box(name):
    result = train(photographs(name), QUICK)
    assert_finite(result.model)
    assert result.log["losses"][-1] <= result.log["losses"][0]


@LONG
def test_training_learns_transparency():
    assert trained("all transparent").metrics["psnr_mean"] > 40.0


def test_splats_that_start_in_one_place_are_as_large_as_if_they_filled_the_scene():
    data = photographs("a million identical", learnt_from("a million identical").means[:COUNT])
    scales = train(data, replace(QUICK, iterations=1, init="points")).model.scales
    assert (-4.0, 1.0) < (scales.min(), scales.max()) < (1.0, 1.0)


def test_a_checkpoint_of_exploded_splats_goes_on_with_those_most_visible():
    model = learnt_from("exploded")
    parameters = Parameters.starting_at(from_model(model, 1))
    left = fit_to_options(parameters, replace(QUICK, max_splats=40), np.random.default_rng(0))
    largest = {tuple(row) for row in model.means[[44, 46]].tolist()}
    assert 40 == len(left)
    assert largest <= {tuple(row) for row in left.values["means"].tolist()}


def test_points_that_are_not_finite_are_refused_and_left_out_of_files(tmp_path):
    points = np.zeros((4, 3), np.float32)
    points[1, 2], points[3, 0] = np.nan, np.inf
    with pytest.raises(InputError, match="2 of the data set's 4 points are NaN or infinite"):
        train(photographs("needles", points), replace(QUICK, init="points"))
    rows = ("1 nan 0 0 9 9 9 0", "2 1e300 0 0 9 9 9 0", "3 1 2 3 255 0 0 0", "4 0 -inf 0 9 9 9 0")
    (tmp_path / "points3D.txt").write_text("\n".join(rows))
    kept, colours = read_points(tmp_path / "points3D.txt")
    assert ([[1.0, 2.0, 3.0]], [[1.0, 0.0, 0.0]]) == (kept.tolist(), colours.tolist())


# fine-tuning


@LONG
@pytest.mark.parametrize("name", [name for name in NAMES if name != "exploded"])
def test_a_tuned_file_is_no_worse_than_before(name):
    _, result, aside = tuned(name)
    decoded = before_and_after(name)
    assert_finite(decoded[1])
    before, after = (aside.psnr(model) for model in decoded)
    assert after >= before - 0.5  # SSIM and L1 decide which step is best
    assert after == pytest.approx(min(result.log["best_psnr"], 99.0), abs=0.01)
    if name in ("a million identical", "half the rows NaN", "10 km away"):
        assert after >= before + 1.0


def test_splats_wider_than_float32_are_tuned():
    """Their standard deviation is e^100."""
    source = learnt_from("needles").select(slice(40))
    source = replace(source, scales=np.full_like(source.scales, 100.0))
    views = split_views(renders_of(source, virtual_cameras(source, 6, 32, 24), BLACK, None), BLACK, validation_count=2)
    fixed = fix_quantisation(EncodePlan.of(source, COARSE))
    result = tune(fixed, views, replace(SHORT, iterations=20))
    assert_finite(decode(fixed.encode(result.best_values).write().data))

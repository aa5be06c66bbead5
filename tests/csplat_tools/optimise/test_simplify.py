"""Simplification: views, pruning order, refits, SH bands, and the command."""

import json
from dataclasses import replace

import captures
import numpy as np
import pytest
from captures import views_of
from command_line import call, change_options, change_views

from csplat.encoder import Target
from csplat.errors import InputError
from csplat.ply import read_ply, write_ply
from csplat_render.camera_files import save_cameras
from csplat_render.pruning_error import measure_pruning_error
from csplat_render.scene_frame import sample_cloud, scene_frame
from csplat_render.scorer import renderer
from csplat_render.virtual_cameras import is_clear
from csplat_tools.cli.shared_options import parse_decibels
from csplat_tools.optimise.pruning import Pruner
from csplat_tools.optimise.simplify import SimplifyOptions, simplify
from csplat_tools.views import (
    camera_sequence,
    extra_test_cameras,
    find_view_set,
    shrink_cameras,
)
from csplat_tools.views.sufficient_views import find_sufficient_views
from csplat_trainer.posed_images import PosedImage, image_scorer
from csplat_trainer.pruning import MeasuredViews, PruningOrder, pruning_keys, total_error

pytest.importorskip("numba", reason="simplification requires the extra [render]")


pytestmark = pytest.mark.usefixtures("small_views")
SMALL = SimplifyOptions(views=12, view_size=(48, 36), effort=1)


def render_all(model, seen_from):
    draw = renderer(model, (0.0, 0.0, 0.0))
    return [draw(camera).rgb for camera in seen_from]


@pytest.fixture(scope="module")
def source():
    return captures.shell_with_hidden_splats()


@pytest.fixture(scope="module")
def given(source):
    """Views of a user, for tests that do not depend on virtual views, which take long to place."""
    return views_of(camera_sequence(source, 12, (48, 36), seed=3))


@pytest.mark.slow
def test_cameras_of_a_long_object_are_outside(source):
    long = replace(source, means=source.means * np.float32([1.0, 12.0, 1.0]))
    frame, sample = scene_frame(long), sample_cloud(long, 20_000, np.random.default_rng(0))
    cameras = [*camera_sequence(long, 40, (40, 30)), *extra_test_cameras(long)["nearer"]]
    assert frame.kind == "object"
    assert all(is_clear(frame, sample, camera) for camera in cameras)


def test_cameras_of_the_user_are_shrunk_and_every_eighth_is_a_validation_view(source):
    own = camera_sequence(source, 17, (200, 100))
    small = shrink_cameras(own, (48, 36))
    assert {(camera.W, camera.H) for camera in small} == {(59, 29)}
    assert small[0].K[0, 0] == pytest.approx(own[0].K[0, 0] * 59 / 200)
    views = views_of(own)
    assert (len(views.training), len(views.validation)) == (15, 2)
    with pytest.raises(InputError, match="at least 2"):
        find_sufficient_views(source, views_of(own[:1]))


@pytest.mark.slow
def test_views_are_added_until_others_agree(source):
    views = find_view_set(source, count=100, size=(24, 18))
    many = find_sufficient_views(source, views, size=(24, 18))
    assert len(many.used) in (40, 80, 100)
    positions = {tuple(camera.position) for camera in many.used}
    assert not positions & {tuple(camera.position) for camera in many.check.cameras}
    assert len(many.check.cameras) == 16


def test_transparent_splats_are_pruned_first_and_unseen_ones_kept(source):
    found = find_sufficient_views(source, views_of(camera_sequence(source, 9, (48, 36))))
    total = total_error(found.batches)
    keys = pruning_keys(source.opacities, total)
    assert (keys[:10] == -1.0).all()
    unseen = ~total.seen & (source.opacities > 0.01)
    assert np.isinf(keys[unseen]).all()
    assert (pruning_keys(source.opacities, total, keep_unseen=False)[unseen] < 0.0).all()
    order = PruningOrder(source, found.batches)
    assert len(source) // 2 == len(order.kept(len(source) // 2))
    assert set(order.rows[:10]) == set(range(10))
    assert [126, 91, 8] == order.rounds  # each keeps 72 %


def test_rounds_alternate_between_groups_of_views(source):
    # Each round measures one group of views again; the other keeps its last errors until its turn.
    parts = [camera_sequence(source, 4, (48, 36), seed=seed) for seed in (1, 2)]
    view_groups = [MeasuredViews(cameras, measure_pruning_error(source, cameras)) for cameras in parts]
    order = PruningOrder(source, list(view_groups))
    order.extend(kept_count=len(source) - 200)
    first, second = order.rounds
    rows = order.kept(len(source) - first)
    keys = pruning_keys(source.opacities, total_error(view_groups))
    np.testing.assert_array_equal(order.errors[:first], np.sort(np.maximum(keys, 0.0))[:first])
    again = measure_pruning_error(source.select(rows), parts[0]).error + view_groups[1].pruning_error.error[rows]
    places = np.searchsorted(rows, order.rows[first:])
    np.testing.assert_allclose(order.errors[first:], again[places], rtol=1e-9)
    assert 200 == first + second


@pytest.mark.slow
def test_a_refit_improves_validation_views(source):
    shell = source.select(slice(10, 300))
    shell = replace(shell, scales=shell.scales + np.float32(0.7), shN=shell.shN[:, :0])
    views = views_of(camera_sequence(shell, 40, (48, 36), seed=3))
    report = simplify(shell, Target(keep=0.5), views=views, options=SMALL).report
    assert report["check_psnr"] > report["check_psnr_pruned"] + 1.0


def test_a_refit_that_overfits_is_discarded(source, given, monkeypatch):
    def dark(model, *_arguments, **_options):
        return replace(model, sh0=model.sh0 - np.float32(1.0))

    monkeypatch.setattr("csplat_tools.optimise.pruning.refit_splats", dark)
    result = simplify(source, Target(keep=0.6), views=given, options=SMALL)
    assert result.report["refit_refused"]
    assert result.report["check_psnr"] == result.report["check_psnr_pruned"]
    np.testing.assert_array_equal(source.sh0[result.source_index], result.model.sh0)


@pytest.mark.slow
@pytest.mark.parametrize(("goal", "refit"), [(35.0, False), (28.0, True)])
def test_a_target_psnr_is_reached(source, given, goal, refit):
    result = simplify(source, Target(psnr=goal), views=given, options=replace(SMALL, refit=refit))
    assert result.report["validation_psnr"] >= goal
    assert given.validation_scorer(source).psnr(result.model) == pytest.approx(result.report["validation_psnr"])
    assert len(result.model) < len(source)


def test_the_source_is_kept_with_a_remark_if_no_pruned_scene_reaches_the_target(source, given, monkeypatch):
    def select_black(pruner, count):
        refit = one_refit(pruner, count)
        return refit if count == len(source) else replace(refit, model=replace(refit.model, sh0=refit.model.sh0 - 10.0))

    one_refit = Pruner.refit
    monkeypatch.setattr(Pruner, "refit", select_black)
    result = simplify(source, Target(psnr=35.0), views=given, options=replace(SMALL, refit=False))
    np.testing.assert_array_equal(source.sh0, result.model.sh0)
    (remark,) = result.notes
    assert "all splats are kept, unchanged" in remark


@pytest.mark.slow
def test_a_larger_psnr_drop_prunes_more_splats(source):
    cameras = camera_sequence(source, 16, (48, 36), seed=5)
    rng = np.random.default_rng(1)
    noisy = [np.clip(p + 0.05 * rng.standard_normal(p.shape), 0, 1) for p in render_all(source, cameras)]
    pictures = [PosedImage(c, np.rint(255.0 * p).astype(np.uint8)) for c, p in zip(cameras, noisy, strict=True)]
    views = views_of(cameras, pictures)
    judge = image_scorer(views.images_of(views.validation), views.background)
    sizes = []
    for loss in (0.05, 1.0):
        result = simplify(source, Target(max_psnr_drop=loss), views=views, options=replace(SMALL, refit=False))
        assert judge.psnr(result.model) >= judge.psnr(source) - loss
        sizes.append(len(result.model))
    assert sizes[0] > sizes[1]


def test_the_requested_number_is_kept(source, given):
    options = replace(SMALL, refit=False)
    for keep, count in ((1.0, 450), (0.998, 449), (0.98, 441), (0.5, 225)):
        result = simplify(source, Target(keep=keep), views=given, options=options)
        assert count == len(result.model) == result.report["splats"]
        np.testing.assert_array_equal(source.means[result.source_index], result.model.means)
        np.testing.assert_array_equal(source.shN[result.source_index], result.model.shN)
    removed = result.report["removed"]
    assert (10, 225) == (removed["invisible"], sum(removed.values()))
    json.dumps(result.report, allow_nan=False)


@pytest.mark.slow
def test_the_result_does_not_depend_on_threads(source, given):
    one, two = (
        simplify(source, Target(keep=0.5), views=given, options=replace(SMALL, threads=threads)) for threads in (1, 2)
    )
    np.testing.assert_array_equal(one.source_index, two.source_index)
    for name in ("opacities", "scales", "sh0", "shN"):
        np.testing.assert_array_equal(getattr(one.model, name), getattr(two.model, name))


def test_other_targets_and_options_out_of_range_are_refused(source):
    for target, message in (
        ({"size_bytes": 1000}, "is no target of simplify, expected keep or psnr or max_psnr_drop"),
        ({"psnr": 40.0, "max_error": {"means": 1.0}}, "is no target of simplify"),
        ({"max_psnr_drop": 0.3}, "name a data set"),
    ):
        with pytest.raises(InputError, match=message):
            simplify(source, Target(**target), options=SMALL)
    with pytest.raises(InputError, match="without splats"):
        simplify(source.select(slice(0, 0)), Target(keep=0.5))
    for wrong in ({"effort": 0}, {"effort": 10}, {"views": 0}, {"view_size": (0, 1)}):
        with pytest.raises(InputError, match="expected"):
            SimplifyOptions(**wrong)
    assert SimplifyOptions(view_size=(1, 1)).view_size == (1, 1)


@pytest.mark.slow
def test_the_command_writes_a_smaller_ply_and_a_report(source, tmp_path, monkeypatch):
    change_views(monkeypatch, 8, (48, 36))
    change_options(monkeypatch, "csplat_tools.optimise.simplify.SimplifyOptions", refit=False)
    scene, out, report = tmp_path / "scene.ply", tmp_path / "out.ply", tmp_path / "report.json"
    write_ply(scene, source)
    words = ("simplify", scene, out, "--keep", "0.5")
    assert "450 -> 225 splats" in call(*words, "--report", report).stderr
    assert {*map(bytes, read_ply(out).means)} < {*map(bytes, read_ply(scene).means)}
    assert json.loads(report.read_text())["splats"] == 225
    assert "--force replaces it" in call(*words, status=1).stderr


@pytest.mark.slow
def test_the_command_uses_cameras_prints_json_and_announces_the_time(source, tmp_path, monkeypatch):
    monkeypatch.setattr("csplat_tools.views.view_sets.render_seconds", lambda _, cameras, **__: cameras[0].W / 800)
    scene, cameras = tmp_path / "scene.ply", tmp_path / "cameras.json"
    write_ply(scene, source)
    save_cameras(cameras, camera_sequence(source, 10, (48, 36)))
    change_views(monkeypatch, 24, (48, 36))
    change_options(monkeypatch, "csplat_tools.optimise.simplify.SimplifyOptions", refit=False)
    words = ("simplify", scene, tmp_path / "out.ply", "--target-psnr", "30", "--cameras", cameras)
    result = call(*words, "--json")
    assert "this takes about 1 to 2 minutes here" in result.stderr
    report = json.loads(result.stdout)
    assert report["validation_psnr"] >= 30.0
    assert {"cameras": "cameras.json", "views": 10} == report["test_views"]
    assert report["views"]["used"] >= 10  # ten cameras are all test views; training views are virtual


def test_invalid_words_write_nothing(source, tmp_path):
    scene, cameras, out = tmp_path / "scene.ply", tmp_path / "cameras.json", tmp_path / "out.ply"
    write_ply(scene, source)
    save_cameras(cameras, camera_sequence(source, 4, (32, 24)))
    before = cameras.read_bytes()
    for status, words in (
        (1, ("--keep", "0.5", "--report", out)),
        (1, ("--keep", "0.5", "--cameras", cameras, "--report", cameras, "--force")),
        (2, ()),
        (2, ("--keep", "0.5", "--target-psnr", "40")),
        (2, ("--keep", "2")),
        (2, ("--max-psnr-drop", "x")),
    ):
        call("simplify", scene, out, *words, status=status)
    assert before == cameras.read_bytes()
    assert {scene, cameras} == set(tmp_path.iterdir())
    assert [0.3, 0.3, 0.3] == [parse_decibels(text, "--x") for text in ("0.3", "0.3dB", " 0.3 DB ")]

# SPDX-License-Identifier: Apache-2.0
"""Simplification: views, pruning order, refits, SH bands, and the command.

Also: csplat_tools.cli.simplify, csplat_tools.views.sufficient_views.
"""

import json
import re
from dataclasses import asdict, replace

import captures
import numpy as np
import pytest
from captures import views_of
from command_line import call, change_options, change_views

from csplat import Context, InputError, SearchInterrupted, Target, write_ply
from csplat.goal_search import next_value
from csplat.ply import read_ply
from csplat_render.camera_files import save_cameras
from csplat_render.pruning_error import measure_pruning_error
from csplat_render.scene_frame import sample_cloud, scene_frame, surface_areas
from csplat_render.scorer import Scorer, renderer
from csplat_render.virtual_cameras import is_clear
from csplat_tools.cli.shared_options import parse_decibels
from csplat_tools.optimise.pruning import Pruner
from csplat_tools.optimise.simplify import SimplifyOptions, simplify
from csplat_tools.views import camera_sequence, extra_test_cameras, find_view_set, shrink_cameras
from csplat_tools.views.sufficient_views import find_sufficient_views
from csplat_trainer.posed_images import PosedImage, image_scorer
from csplat_trainer.pruning import MeasuredViews, PruningOrder, pruning_keys, total_error

pytestmark = pytest.mark.usefixtures("small_views")
SMALL = SimplifyOptions(views=12, view_size=(48, 36), effort=1)


@pytest.fixture(scope="module")
def source():
    return captures.shell_with_hidden_splats()


@pytest.fixture(scope="module")
def given(source):
    """Views of a user, which are placed sooner than virtual ones."""
    return views_of(camera_sequence(source, 12, (48, 36), seed=3))


@pytest.mark.slow
def test_virtual_cameras_are_outside_and_added_until_others_agree_and_own_ones_are_shrunk(source):
    long = replace(source, means=source.means * np.float32([1.0, 12.0, 1.0]))
    frame, sample = scene_frame(long), sample_cloud(long, 20_000, np.random.default_rng(0))
    assert frame.kind == "object"
    for camera in (*camera_sequence(long, 40, (40, 30)), *extra_test_cameras(long)["nearer"]):
        assert is_clear(frame, sample, camera)
    many = find_sufficient_views(source, find_view_set(source, count=100, size=(24, 18)), size=(24, 18))
    assert len(many.used) in (40, 80, 100)
    used, check = ({tuple(camera.position) for camera in views} for views in (many.used, many.check.cameras))
    assert not used & check
    assert len(many.check.cameras) == 16
    own = camera_sequence(source, 17, (200, 100))
    small, views = shrink_cameras(own, (48, 36)), views_of(own)
    assert {(camera.W, camera.H) for camera in small} == {(59, 29)}
    assert small[0].K[0, 0] == pytest.approx(own[0].K[0, 0] * 59 / 200)
    assert (len(views.training), len(views.validation)) == (15, 2)  # every eighth
    with pytest.raises(InputError, match="at least 2"):
        find_sufficient_views(source, views_of(own[:1]))


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
    values = 3 * 48 * 36 * 8
    np.testing.assert_array_equal(order.errors[:first], np.sort(np.maximum(keys, 0.0))[:first] / values)
    again = measure_pruning_error(source.select(rows), parts[0]).error + view_groups[1].pruning_error.error[rows]
    places = np.searchsorted(rows, order.rows[first:])
    np.testing.assert_allclose(order.errors[first:], again[places] / values, rtol=1e-9)
    assert 200 == first + second


def test_an_order_continues_with_the_errors_of_refitted_splats(source):
    cameras = camera_sequence(source, 8, (48, 36))
    order = PruningOrder(
        source, [MeasuredViews.of(source, part, (0.0, 0.0, 0.0)) for part in (cameras[::2], cameras[1::2])]
    )
    order.extend(kept_count=100)
    first, rows = order.rows[:100], order.kept(len(source) - 100)
    refitted = source.select(rows)
    refitted = replace(refitted, opacities=refitted.opacities[::-1].copy())
    order.continue_with(refitted)
    assert 100 == len(order.rows) == len(order.errors) == sum(order.rounds)
    kept = order.kept(len(source) - 140)
    np.testing.assert_array_equal(first, order.rows[:100])
    measured = measure_pruning_error(refitted, cameras)
    least = np.argsort(pruning_keys(refitted.opacities, measured), kind="stable")[:40]
    np.testing.assert_array_equal(rows[least], order.rows[100:])
    np.testing.assert_array_equal(np.delete(rows, least), kept)
    later = order.view_count
    order.kept(len(source) - 200)
    assert later + 4 == order.view_count  # the groups take turns again


@pytest.mark.slow
def test_a_refit_improves_validation_views_at_any_number_of_threads(source):
    shell = source.select(slice(10, 300))
    shell = replace(shell, scales=shell.scales + np.float32(0.7), shN=shell.shN[:, :0])
    views = views_of(camera_sequence(shell, 40, (48, 36), seed=3))
    contexts = (Context(threads=threads) for threads in (1, 2))
    one, two = (simplify(shell, Target(keep=0.5), views=views, options=SMALL, context=how) for how in contexts)
    assert one.report["check_psnr"] > one.report["check_psnr_pruned"] + 1.0
    np.testing.assert_array_equal(one.source_index, two.source_index)
    np.testing.assert_equal(asdict(one.model), asdict(two.model))


@pytest.mark.slow
def test_exact_errors_prune_better_than_opacity(source):
    views = views_of(camera_sequence(source, 32, (48, 36), seed=3))
    pruned = [simplify(source, Target(keep=0.8), views=views, options=replace(SMALL, refit=False)).model]
    for weights in (1.0, surface_areas(source)):
        order = np.argsort(source.opacities * weights, kind="stable")
        pruned.append(source.select(np.sort(order[-round(0.8 * len(source)) :])))
    judge = Scorer.of_source(source, camera_sequence(source, 6, (64, 48), seed=9), (0, 0, 0))
    by_error, *by_opacity = map(judge.psnr, pruned)
    assert by_error > max(by_opacity) + 3.0


@pytest.mark.slow
def test_a_target_psnr_is_reached(source, given):
    for goal, refit in ((35.0, False), (28.0, True)):
        result = simplify(source, Target(psnr=goal), views=given, options=replace(SMALL, refit=refit))
        assert result.report["validation_psnr"] >= goal
        assert given.validation_scorer(source).psnr(result.model) == pytest.approx(result.report["validation_psnr"])
        assert len(result.model) < len(source)


def test_a_refit_that_overfits_and_pruning_that_misses_the_target_are_discarded(source, given, monkeypatch):
    one_refit = Pruner.refit

    def darker(model, *_arguments, **_options):
        return replace(model, sh0=model.sh0 - np.float32(10.0))

    def refit_darker(pruner, count, part=2.0):
        refit = one_refit(pruner, count, part)
        return refit if count == len(source) else replace(refit, model=darker(refit.model))

    with monkeypatch.context() as patch:
        patch.setattr("csplat_tools.optimise.pruning.refit_splats", darker)
        result = simplify(source, Target(keep=0.6), views=given, options=SMALL)
    assert result.report["refit_refused"]
    assert result.report["check_psnr"] == result.report["check_psnr_pruned"]
    assert result.model.sh0.min() > source.sh0.min() - 1e-3  # merged splats have averages
    monkeypatch.setattr(Pruner, "refit", refit_darker)
    result = simplify(source, Target(psnr=35.0), views=given, options=replace(SMALL, refit=False))
    np.testing.assert_array_equal(source.sh0, result.model.sh0)
    (remark,) = result.notes
    assert "all splats are kept, unchanged" in remark


@pytest.mark.slow
def test_a_larger_psnr_drop_prunes_more_splats(source):
    cameras, draw = camera_sequence(source, 16, (48, 36), seed=5), renderer(source, (0.0, 0.0, 0.0))
    noise = 0.05 * np.random.default_rng(1).standard_normal((16, *draw(cameras[0]).rgb.shape))
    pixels = [np.clip(draw(one).rgb + own, 0, 1) for one, own in zip(cameras, noise, strict=True)]
    pictures = [
        PosedImage(one, np.rint(255.0 * own).astype(np.uint8)) for one, own in zip(cameras, pixels, strict=True)
    ]
    views, options = views_of(cameras, pictures), replace(SMALL, refit=False)
    judge = image_scorer(views.images_of(views.validation), views.background)
    few, many = (simplify(source, Target(max_psnr_drop=loss), views=views, options=options) for loss in (1.0, 0.05))
    assert judge.psnr(few.model) >= judge.psnr(source) - 1.0
    assert judge.psnr(many.model) >= judge.psnr(source) - 0.05
    assert len(few.model) < len(many.model)


def interrupt_when(patch, condition):
    """Let Ctrl-C interrupt a search before its next refit, when the log errors so far and their goal satisfy this."""

    def interrupted(goal, measured, *arguments, **options):
        if condition(goal, [error for _, error in measured]):
            raise KeyboardInterrupt
        return next_value(goal, measured, *arguments, **options)

    patch.setattr("csplat_tools.optimise.simplify.next_value", interrupted)


@pytest.mark.slow
def test_an_interrupted_search_has_the_fewest_splats_so_far_or_says_what_is_near(source, given, monkeypatch):
    for condition, so_far in (
        (lambda _, errors: not errors, "nothing was refitted"), (lambda _, errors: errors, "splats have"),
        (lambda goal, errors: any(error <= goal for error in errors), None),
    ):  # fmt: skip
        interrupt_when(monkeypatch, condition)
        with pytest.raises(KeyboardInterrupt) as caught:
            simplify(source, Target(psnr=30.0), views=given, options=replace(SMALL, refit=False))
        assert caught.type is SearchInterrupted
        best = caught.value.best
        assert (so_far is None) == (best is not None)
        assert so_far is None or "reaches 30.00 dB so far; " in str(caught.value)
        assert so_far is None or so_far in str(caught.value)
    assert best.report["interrupted"]
    assert 30.0 <= best.report["validation_psnr"] == pytest.approx(given.validation_scorer(source).psnr(best.model))


@pytest.mark.slow
def test_the_command_writes_the_result_of_an_interrupted_search(source, scene, tmp_path, monkeypatch):
    change_views(monkeypatch, 24, (48, 36))
    change_options(monkeypatch, "csplat_tools.optimise.simplify.SimplifyOptions", refit=False)
    out, report = tmp_path / "out.ply", tmp_path / "report.json"
    for condition, is_written in (
        (lambda _, errors: not errors, False), (lambda goal, errors: any(error <= goal for error in errors), True),
    ):  # fmt: skip
        interrupt_when(monkeypatch, condition)
        stopped = call("simplify", scene, out, "--target-psnr", 30, "--report", report, status=130)
        assert "interrupted: " in stopped.stderr.splitlines()[-1]
        assert is_written == out.exists() == report.exists()
    assert json.loads(report.read_text())["interrupted"]
    assert len(read_ply(out).means) == json.loads(report.read_text())["splats"] < len(source)


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


def test_other_targets_and_options_out_of_range_are_refused(source):
    for scene, target, message in (
        (source, {"size": 1000}, "is no target of simplify, expected keep or psnr or max_psnr_drop"),
        (source, {"psnr": 40.0, "max_error": {"means": 1.0}}, "is no target of simplify"),
        (source, {"max_psnr_drop": 0.3}, "name a data set"), (source.select(slice(0)), {"keep": 0.5}, "without splats"),
    ):  # fmt: skip
        with pytest.raises(InputError, match=message):
            simplify(scene, Target(**target), options=SMALL)
    for wrong in ({"effort": 0}, {"effort": 10}, {"views": 0}, {"view_size": (0, 1)}):
        with pytest.raises(InputError, match="expected"):
            SimplifyOptions(**wrong)
    assert SimplifyOptions(view_size=(1, 1)).view_size == (1, 1)


@pytest.fixture
def scene(source, tmp_path):
    write_ply(tmp_path / "scene.ply", source)
    return tmp_path / "scene.ply"


@pytest.mark.slow
def test_the_command_uses_cameras_prints_json_and_announces_the_time(source, scene, tmp_path, monkeypatch):
    monkeypatch.setattr("csplat_tools.optimise.search_plan.render_seconds", lambda *_, **__: 1.0)
    save_cameras(tmp_path / "cameras.json", camera_sequence(source, 10, (48, 36)))
    change_views(monkeypatch, 24, (48, 36))
    change_options(monkeypatch, "csplat_tools.optimise.simplify.SimplifyOptions", refit=False)
    words = ("simplify", scene, tmp_path / "out.ply", "--target-psnr", "30", "--cameras", tmp_path / "cameras.json")
    result = call(*words, "--json")
    assert re.search(r"this takes about \d+ to \d+ minutes here; --effort 1", result.stderr)
    report = json.loads(result.stdout)
    assert report["validation_psnr"] >= 30.0
    assert {"cameras": "cameras.json", "views": 10} == report["test_views"]
    assert report["views"]["used"] >= 10  # ten cameras are all test views; training views are virtual


@pytest.mark.slow
def test_the_command_writes_a_ply_and_a_report_or_nothing(source, scene, tmp_path, monkeypatch):
    change_views(monkeypatch, 8, (48, 36))
    change_options(monkeypatch, "csplat_tools.optimise.simplify.SimplifyOptions", refit=False)
    cameras, out = tmp_path / "cameras.json", tmp_path / "out.ply"
    save_cameras(cameras, camera_sequence(source, 4, (32, 24)))
    before = cameras.read_bytes()
    for status, words in (
        (1, ("--keep", 0.5, "--report", out)), (2, ("--keep", 0.5, "--target-psnr", 40)), (2, ("--keep", 2)), (2, ()),
        (1, ("--keep", 0.5, "--cameras", cameras, "--report", cameras, "--force")), (2, ("--max-psnr-drop", "x")),
    ):  # fmt: skip
        call("simplify", scene, out, *words, status=status)
    assert before == cameras.read_bytes()
    assert {scene, cameras} == set(tmp_path.iterdir())
    assert [0.3, 0.3, 0.3] == [parse_decibels(text, "--x") for text in ("0.3", "0.3dB", " 0.3 DB ")]
    words = ("simplify", scene, out, "--keep", "0.5")
    assert "450 -> 225 splats" in call(*words, "--report", tmp_path / "report.json").stderr
    assert {*map(bytes, read_ply(out).means)} < {*map(bytes, read_ply(scene).means)}
    assert json.loads((tmp_path / "report.json").read_text())["splats"] == 225
    assert "--force replaces it" in call(*words, status=1).stderr

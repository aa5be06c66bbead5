# SPDX-License-Identifier: Apache-2.0
"""Targets: options, the command, and on real scenes the files of three searches, refits, measurements and reports.

test_target_search.py tests the logic of the search on analytic scenes.

Also: csplat_tools.optimise.candidates, csplat_tools.optimise.pruning, csplat_tools.scene_sensitivity,
csplat_tools.optimise.search_report.
"""

import json
import math
from dataclasses import replace
from types import SimpleNamespace

import extremes
import numpy as np
import pytest
from analytic_search import AnalyticScene, analytic_removal
from captures import around, cameras, crowded, found_within, judged_by, photographed, shell, views_of
from checked import cloud, measure_errors
from command_line import call, change_options, change_views, invoke
from tables import failures

from csplat import Context, EncodeOptions, InputError, SearchInterrupted, decode, decode_scene, encode, write_ply
from csplat.encode_api import encode_with_report
from csplat.encoder import Importance, SearchReport, Target, meet_bounds
from csplat.sizes import parse_size
from csplat_conformance.declared_bounds import Source, verify_bounds
from csplat_render.camera import intrinsics, look_at, resized
from csplat_render.camera_files import save_cameras
from csplat_render.scene_frame import scene_frame
from csplat_render.scorer import Scorer
from csplat_tools.cli.command_output import Output
from csplat_tools.cli.shared_options import parse_max_error
from csplat_tools.optimise.candidates import CandidatePool, Coding, WholeScene, complete_importance
from csplat_tools.optimise.search_report import format_search, psnr_spread
from csplat_tools.optimise.simplify import SimplifyOptions
from csplat_tools.scene_sensitivity import measure_importance
from csplat_tools.views import BLACK, comparison_cameras, extra_test_cameras, with_validation_views
from csplat_tools.views.view_sets import pose_key, render_seconds

pytestmark = pytest.mark.usefixtures("small_views")


@pytest.fixture(scope="module")
def scene():
    return shell(8)


@pytest.fixture(scope="module")
def many():
    return crowded()


def search(*given, **how):
    """Search without extra test cameras, which are only reported and take a second to place."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("csplat_tools.optimise.target_search.extra_test_cameras", lambda _: {})
        return found_within(*given, **how)


def test_the_spread_is_over_views_and_the_psnr_of_extra_views_is_reported():
    assert 0.0 == psnr_spread(np.full(8, 1e-4))
    assert 10 * math.log10(4) / 2 == pytest.approx(psnr_spread(np.array([1e-4, 4e-4])))
    assert math.isnan(psnr_spread(np.array([1e-4])))
    for psnr, note in ((39.5, "39.50 beside"), (37.0, "beside: up to 3.0 dB less")):
        report = SearchReport(
            {"psnr": 40.0}, 1, 1, 1, 1, 1.0, psnr=40.0, validation_psnr=40.1, elsewhere={"beside": psnr}
        )
        assert 1 == sum(note in line for line in format_search(report))


@pytest.mark.slow
def test_a_psnr_is_reached_with_fewer_splats(many, search_at_psnr):
    found, views = search_at_psnr, with_validation_views(judged_by(cameras(40)))
    decoded, report = decode_scene(found.data), found.report.search
    assert 30.0 <= report.validation_psnr <= 31.1  # the PSNR of such small files jumps
    assert report.psnr == pytest.approx(views.test_scorer(many).psnr(decoded.model), abs=1e-4)
    validation_psnr = views.validation_scorer(many).psnr(decoded.model)
    assert report.validation_psnr == pytest.approx(validation_psnr, abs=1e-4)
    assert (len(found.data), len(decoded.model)) == (report.size_bytes, report.splats)
    assert report.splats < 600
    assert 900 == found.report.options["simplified"]["splats"] == decoded.declared_bounds.source_count
    assert len(np.unique(found.source_index)) == len(decoded.model)
    # No candidate reaches it with fewer bytes.
    assert report.size_bytes == min(one["size_bytes"] for one in report.tried if one["validation_psnr"] >= 30.0)
    assert [report.chosen] == [one for one in report.tried if one["psnr"] is not None]  # test views choose nothing
    measured, declared = measure_errors(many, decoded.model, found.source_index), found.report.errors
    assert [] == [name for name in declared if measured[name][0] > declared[name][0]]
    assert ({"psnr": 30.0}, 10) == (report.goal, report.views)
    assert len(report.tried) == report.encodes
    assert report.worst_psnr <= report.psnr
    assert {"between", "beside", "beyond"} == set(report.elsewhere)  # the path of the cameras
    assert report.pruning_views > 0
    json.dumps(report.as_json(), allow_nan=False)


@pytest.mark.slow
@pytest.mark.parametrize("no_prune", [True, False])
def test_a_size_that_no_file_needs_gives_the_finest_file_at_once(many, no_prune):
    found = search(many, judged_by(cameras(40)), size=10**6, no_prune=no_prune).report.search
    assert (1, 0, 0) == (found.encodes, found.pruning_views, found.sensitivity_views)
    assert (900, 80.0) == (found.splats, found.chosen["attribute_psnr"])
    assert found.psnr > 50.0
    kept = f"{found.size_bytes / 1000:.1f} kB hold all splats at the finest precision"
    assert f"the target is larger than this scene can use: {kept}" == found.why[-1]
    assert found.size_bytes < 60 * 900


@pytest.mark.slow
def test_a_size_or_a_psnr_drop_against_images_is_met_with_fewer_splats(many, search_at_size, search_at_loss):
    decoded, report, photographs = decode(search_at_loss.data), search_at_loss.report.search, photographed(many)
    scorer = with_validation_views(photographs).image_validation_scorer()
    assert report.images["source"] < 28.0
    assert report.images["file"] == pytest.approx(photographs.image_test_scorer().psnr(decoded))
    assert report.images["file"] >= report.images["source"] - 1.0  # the validation images decide
    assert scorer.psnr(many) - 0.5 <= scorer.psnr(decoded) <= scorer.psnr(many) - 0.3
    assert 0.9 * 1500 <= len(search_at_size.data) <= 1500
    assert search_at_size.report.search.psnr > 24.0
    for found in (report, search_at_size.report.search):
        assert found.splats < 900
        assert [found.chosen] == [one for one in found.tried if one["psnr"] is not None]  # test views choose nothing


@pytest.mark.slow
def test_bounds_in_addition_to_a_psnr_hold_without_pruning(scene):
    found = search(scene, psnr=18.0, max_error={"means": 1e-3, "sh1": 1e-2})
    for name, most in (("means", 1e-3), ("sh1", 1e-2)):  # although 18 dB need no SH
        assert most >= found.report.errors[name][0] == found.report.search.reached[name]
    assert found.report.search.psnr >= 18.0
    assert 300 == found.report.search.splats


LARGE = [pytest.param(name, marks=pytest.mark.long) for name in ("exploded", "all transparent", "float32 limits")]


@pytest.mark.slow
@pytest.mark.parametrize("name", ["one splat", *LARGE])
def test_extreme_scenes_meet_a_psnr(name):
    source = extremes.scene(name)
    views = judged_by(cameras(40)) if name == "one splat" else around(source)
    decoded = decode(found_within(source, views, psnr=17.0).data)
    assert with_validation_views(views).validation_scorer(source).psnr(decoded) >= 17.0
    assert views.test_scorer(source).psnr(decoded) >= 16.8  # the validation views decide
    assert len(decoded) >= 1


@pytest.mark.slow
def test_a_share_of_the_splats_is_refitted_and_verified_at_any_number_of_threads(scene):
    shapes = np.arange(300) % 8
    alike = replace(scene, quats=scene.quats[shapes], scales=scene.scales[shapes])
    options, contexts = EncodeOptions(shape_codebook_size=64), (Context(threads=threads) for threads in (2, 1))
    kept, other = (search(alike, None, options, keep=0.6, context=context) for context in contexts)
    assert kept.data == other.data
    decoded, index = decode_scene(kept.data), kept.source_index
    assert 180 == kept.report.search.splats == len(decoded.model) == len(np.unique(index))
    distances = np.linalg.norm(decoded.model.means.astype(np.float64) - alike.means[index], axis=1)
    assert distances.max() <= kept.report.errors["means"][0]
    assert verify_bounds(Source.of(alike), decoded.model, decoded.header, decoded.declared_bounds, index).holds
    assert decoded.declared_bounds.refitted
    assert 0 < kept.report.options["shape_codebook_size"] <= 60
    bare = Scorer.of_source(alike, judged_by(cameras(40)).test, BLACK).psnr(alike.select(index))
    assert kept.report.search.psnr > bare + 3.0


@pytest.mark.slow
def test_a_refit_through_the_quantisers_improves_test_views(scene):
    # Of coarse geometry and fine colours.
    coarse = EncodeOptions(opacity_levels=8, scale_step=0.3, quat_levels=8, sh0_step=0.005, sh_step=0.005)
    bare, views = replace(scene, shN=scene.shN[:, :0]), with_validation_views(judged_by(cameras(40)))
    removal = SimplifyOptions(effort=2, view_size=(960, 720)).pruner(bare, views, use_classes=False)
    part, judge = removal.refit(300), views.test_scorer(bare)
    quick, fitted = (part.encode(coarse, use_classes=False, draft=draft).write().data for draft in (True, False))
    assert judge.psnr(decode(fitted)) > judge.psnr(decode(quick)) + 0.2


class ErrorsInTurn:
    """A scorer that returns errors of a few views, first for the splats before a refit, then for those after it."""

    def __init__(self, *errors):
        self._errors = iter(errors)

    def errors(self, _model):
        return np.array(next(self._errors))


@pytest.mark.slow
def test_a_refit_through_the_quantisers_is_kept_if_most_held_out_views_gain(scene):
    views = with_validation_views(judged_by(cameras(40)))
    before, coarse = [2.0, 2.0, 2.0, 2.0], EncodeOptions(opacity_levels=8, scale_step=0.3)

    def encoded(after):
        pruner = SimplifyOptions(effort=1).pruner(scene, views)
        part = pruner.refit(200)
        pruner.check_scorer = ErrorsInTurn(before, after)
        return part.encode(coarse, use_classes=False, draft=False).write().data

    half_gain, one_loses, most_lose = (encoded(after) for after in ([1, 1, 3, 9], [1, 1, 1, 99], [1, 3, 3, 3]))
    assert half_gain == one_loses != most_lose


@pytest.mark.slow
def test_the_error_of_the_first_draft_is_measured_and_corrects_others(scene):
    scorer = with_validation_views(judged_by(cameras(40))).validation_scorer(scene)
    pool, whole = CandidatePool(EncodeOptions(), scorer), WholeScene(scene, None, None, Context())
    pool.error(replace(scene, opacities=0.99 * scene.opacities), exact=True)  # an error with another ratio
    first, second = (pool.make(whole, Coding(use_classes=False), quality, draft=True) for quality in (30.0, 31.0))
    assert first.is_exact
    assert not second.is_exact
    estimated = second.error
    pool.measure(second)
    assert estimated == pytest.approx(second.error, rel=0.05)


def test_a_refit_predicts_the_error_of_others():
    removal = analytic_removal(AnalyticScene())
    counts, errors = removal.errors(1.0, (6000, 1e-4))
    rows = [int(np.flatnonzero(counts == count)[0]) for count in (5000, 6000)]
    assert [3.375e-4, 1e-4] == pytest.approx(errors[rows].tolist())  # 1.5 times the pruned splats, cubed


@pytest.mark.slow
def test_test_views_are_neither_validation_nor_training_views(many):
    for given in (around(many), judged_by(cameras(40)), photographed(many)):
        views = with_validation_views(given)
        scorers = [views.test_scorer(many), views.validation_scorer(many)]
        scorers += [views.image_validation_scorer()] if given.images else []
        test, *validation = ({pose_key(camera) for camera in one.cameras} for one in scorers)
        assert test == {pose_key(camera) for camera in given.test}
        assert all(validation)
        assert not test & set.union(*validation)
        assert not test.union(*validation) & {pose_key(camera) for camera in views.training}


def test_options_and_views_that_contradict_a_target_are_refused(scene):
    away = look_at((40.0, 0.0, 0.0), (80.0, 0.0, 0.0), (0, 0, 1), intrinsics(48, 40, 60.0), 48, 40)
    views, psnr, empty = judged_by(cameras(8)), {"psnr": 30.0}, scene.select(np.zeros(0, np.int64))
    for source, seen, options, target, message in (
        (empty, views, None, psnr, "without splats"),
        (scene, views, EncodeOptions(attribute_psnr=40.0), psnr, "chosen by the target"),
        (scene, views, None, {"keep": 0.5, "no_prune": True}, "excludes prune=False"),
        (scene, replace(views_of(cameras(12)), test=[away]), None, psnr, "cameras belong to the scene"),
        (scene, None, None, {"max_psnr_drop": 0.5}, "requires images"),
    ):
        with pytest.raises(InputError, match=message):
            search(source, seen, options, **target)


@pytest.mark.slow
def test_virtual_views_in_surroundings_cause_a_warning():
    source, far = shell(3).select(np.arange(100)), np.where(np.arange(100) % 3, 1.0, 9.0)[:, None]
    source = replace(source, means=(source.means * far).astype(np.float32))
    assert scene_frame(source).kind == "surrounding"
    views = replace(judged_by(cameras(40)), virtual=True)
    views = replace(views, training=[resized(camera, 24, 20) for camera in views.training])
    fewer = search(source, views, keep=0.8, refit=False).report.search
    assert "cameras inside of the surroundings" in fewer.why[-1]
    assert "--no-prune" in fewer.why[-1]
    kept = search(source, views, psnr=22.0, no_prune=True).report.search
    assert (100, 0, 0) == (kept.splats, kept.pruning_views, kept.sensitivity_views)
    assert not any("surroundings" in line for line in kept.why)


@pytest.fixture(scope="module")
def unequal():
    """An object of 9,000 mostly small splats."""
    rng = np.random.default_rng(3)
    means = rng.standard_normal((9000, 3))
    means /= np.linalg.norm(means, axis=1, keepdims=True)
    sizes, opacities = np.exp(rng.normal(-4.0, 0.8, 9000)), rng.uniform(0.05, 0.95, 9000).astype(np.float32)
    return cloud(means, sizes, opacities=opacities, sh0=(np.sin(3.0 * means) + 0.5).astype(np.float32))


@pytest.fixture(scope="module")
def measured(unequal):
    """Importance of the splats, measured in twelve views."""
    return measure_importance(unequal, cameras(12), BLACK)


@pytest.mark.slow
def test_quantisation_classes_reduce_the_size_also_with_a_given_importance(unequal, measured):
    judge, whole = Scorer.of_source(unequal, cameras(6), BLACK), WholeScene(unequal, None, measured)
    classes, plain = (
        whole.encode(EncodeOptions(attribute_psnr=psnr), use_classes=use_classes, draft=False).write()
        for psnr, use_classes in ((48.0, True), (47.0, False))
    )
    assert len(classes.report.options["classes"]["splats"]) > 1
    assert "classes" not in plain.report.options
    assert judge.psnr(decode(classes.data)) >= judge.psnr(decode(plain.data))
    assert len(classes.data) < 0.97 * len(plain.data)
    few, weights = unequal.select(np.arange(5000)), np.linspace(1.0, 2.0, 5000)
    report = search(few, None, None, psnr=34.0, no_prune=True, importance=weights).report.search
    assert {1, 2} == {one["classes"] for one in report.tried}
    assert 26 == report.sensitivity_views


@pytest.mark.slow
def test_sensitivity_is_measured_if_it_has_an_effect(scene, unequal, measured):
    # An importance with Gauss-Newton blocks is used unchanged, also in surroundings; one without keeps its weights.
    plain, views, weights = EncodeOptions(), views_of(cameras(12)), np.linspace(1.0, 2.0, 300)
    count, bare = len(views.training), replace(scene, shN=scene.shN[:, :0])

    def check(case):
        inside, source, options, importance, *expected = case
        found, used = complete_importance(source, views, options, importance, inside=inside)
        assert expected == [found is not None, used]

    cases = {
        "SH": (False, scene, plain, None, True, count),
        "small, without SH": (False, bare, plain, None, False, 0),
        "SH that is left out": (False, scene, EncodeOptions(sh_degree=0), None, True, count),
        "SH that is left out, inside": (True, scene, EncodeOptions(sh_degree=0), None, True, count),
        "preset fast": (False, scene, EncodeOptions("fast"), None, False, 0),
        "inside": (True, scene, plain, None, False, 0),
        "curvatures": (False, unequal, plain, measured, True, 0),
        "curvatures inside": (True, unequal, plain, measured, True, 0),
        "one class": (False, unequal, EncodeOptions(max_classes=1), measured, False, 0),
        "weights alone": (False, scene, plain, Importance(np.ones(300)), True, count),
        "weights inside": (True, unequal, plain, replace(measured, blocks=None), False, 0),
    }
    assert [] == failures(cases, check)
    np.testing.assert_array_equal(weights, complete_importance(scene, views, plain, weights, inside=False)[0].sh)


def test_the_time_of_a_render_excludes_the_first(scene):
    views, drawn, now = comparison_cameras(scene), [], [0.0]

    def draw(camera):
        drawn.append(camera.W)
        now[0] += camera.W * camera.H / 1e6

    source = SimpleNamespace(renderer=lambda *_, **__: draw)
    for mode in ({}, {"mode": "exact"}):
        assert pytest.approx(0.0192) == render_seconds(source, views, **mode, clock=lambda: now[0])
    assert [160, 160, 160, 20] == drawn


@pytest.mark.slow
def test_extra_test_cameras_are_nearer_and_farther(scene):
    # Nearer by 0.6, or by less if they would be within the scene.
    centre, extra, shares = scene_frame(scene).centre, extra_test_cameras(scene), []
    for seen in zip(*(extra[kind] for kind in ("nearer", "beside", "farther")), strict=True):
        near, usual, far = (camera.position - centre for camera in seen)
        shares.append(float(np.linalg.norm(near) / np.linalg.norm(usual)))
        np.testing.assert_allclose([near, far], [shares[-1] * usual, 2.0 * usual], atol=1e-9)
        np.testing.assert_array_equal(seen[0].viewmat[:3, :3], seen[2].viewmat[:3, :3])
    assert 0.599 < min(shares) < 0.601
    assert max(shares) <= 1.0 + 1e-9


def test_sizes_and_bounds_are_parsed_or_refused():
    sizes = {"5MB": 5_000_000, "1.5 MiB": 1_572_864, "300kB": 300_000, "300KiB": 307_200, "123456": 123_456}
    assert sizes == {text: parse_size(text) for text in sizes}
    for text in ("", "MB", "5 apples", "-3MB", "0", "1e30GB", "5 M B"):
        with pytest.raises(InputError, match="a size is"):
            parse_size(text)
    assert {"means": 0.001, "opacities": 0.01} == parse_max_error("means=0.001,opacities=1e-2", None)
    assert {"means": 0.002} == parse_max_error("means=1mm", 0.5)
    assert {"means": 0.0, "sh4": 0.0}.items() <= parse_max_error("0", None).items()
    for text, unit, message in (
        ("means=1mm", None, "--unit-metres"), ("means", 1, "is not an error bound"), ("weight=1", 1, "not a measure"),
        ("means=", 1, "is not an error bound"), ("means=1,means=2", 1, "twice"),
        ("sh0=1mm", 1, "not a length"), ("means=1parsec", 1, "expected one of"),
    ):  # fmt: skip
        with pytest.raises(InputError, match=message):
            Target(max_error=parse_max_error(text, unit))


@pytest.mark.slow
def test_a_bound_of_the_means_holds_for_outliers_or_is_refused(scene):
    away = (scene.means[:20] * 3000.0).astype(np.float32)
    far = replace(scene, means=np.concatenate([away, scene.means[20:]]))
    coarse = encode_with_report(far, EncodeOptions(position_step=1e-4)).report.errors["means"][0]
    bounded, finer = (meet_bounds(far, EncodeOptions(), Target(max_error={"means": most}))[0] for most in (1e-4, 1e-6))
    assert bounded.report.errors["means"][0] <= 1e-4 < coarse
    assert any("tiles" in note for note in finer.report.notes)
    for fixed, measure, message in (
        ({"position_step": 0.1}, "means", "position_step is determined"), ({"adaptive": 0.5}, "sh1", "error"),
        ({"sh_coding": "none"}, "sh1", "error"), ({"sh_coding": "codebook"}, "sh1", "codebook excludes a bound"),
    ):  # fmt: skip
        with pytest.raises(InputError, match=message):
            meet_bounds(scene, EncodeOptions(**fixed), Target(max_error={measure: 0.1}))


@pytest.fixture
def ply(tmp_path, scene):
    write_ply(tmp_path / "scene.ply", scene)
    return tmp_path / "scene.ply"


@pytest.mark.slow
def test_the_command_meets_a_size_with_reasons_and_its_share_is_verified(tmp_path, ply, monkeypatch):
    out, index = tmp_path / "scene.csplat", tmp_path / "index.npy"
    with monkeypatch.context() as patch:
        change_views(patch, 16, (48, 36))
        said = call("encode", ply, out, "--target-size", "5kB", "--no-prune").stderr
    assert 4850 <= out.stat().st_size <= 5000
    assert all(text in said for text in ("target: 5.0 kB", "chosen: SH degree", "measured on the file itself"))
    save_cameras(tmp_path / "cameras.json", cameras(40))
    words = ("encode", ply, out, "--keep", 0.5, "--effort", 1, "--cameras", tmp_path / "cameras.json", "--force")
    report = json.loads(call(*words, "--source-index", index, "--json").stdout)
    assert 150 == report["splats"] == report["target"]["splats"]
    assert {"keep": 0.5} == report["target"]["goal"]
    assert report["target"]["size_bytes"] == report["size_bytes"] == out.stat().st_size
    call("verify", out, "--source", ply, "--source-index", index)
    call("verify", out, "--source", ply)
    assert "150 pruned" in call("info", out).stdout


class CtrlC:
    """A progress callback that interrupts the search once, when its candidates satisfy a condition."""

    def __init__(self, patch, condition):
        self.condition, self.pools = condition, []
        patch.setattr("csplat_tools.optimise.target_search.CandidatePool", self.make_pool)

    def make_pool(self, *arguments):
        self.pools.append(CandidatePool(*arguments))
        return self.pools[-1]

    def __call__(self, *_):
        if self.pools and self.condition(self.pools[-1].made):
            self.condition = lambda _: False
            raise KeyboardInterrupt


@pytest.mark.slow
def test_an_interrupted_search_has_the_best_file_so_far_or_says_what_is_near(scene, tmp_path, monkeypatch):
    monkeypatch.setattr("csplat_tools.optimise.target_search.extra_test_cameras", lambda _: {})
    change_options(monkeypatch, "csplat_tools.optimise.simplify.SimplifyOptions", view_size=(960, 720))  # fewer steps
    out, views = tmp_path / "scene.csplat", judged_by(cameras(40))

    def interrupted(condition, levels=None, **target):
        context = Context(progress=CtrlC(monkeypatch, condition))
        with pytest.raises(KeyboardInterrupt) as caught:
            encode(scene, out=out, target=Target(**target), views=views, levels=levels, context=context)
        assert caught.type is SearchInterrupted
        return caught.value

    def is_met(made):
        return any(file.validation_psnr >= 24.0 for file in made)

    for prune in (False, True):
        stopped = interrupted(is_met, psnr=24.0, prune=prune, effort=1)
        report = stopped.best.report.search
        met = [file for file in report.tried if file["validation_psnr"] >= 24.0]
        assert [min(met, key=lambda file: file["size_bytes"])["size_bytes"]] == [len(out.read_bytes())]
        assert (out.read_bytes(), True) == (stopped.best.data, report.interrupted)
        assert report.psnr == pytest.approx(views.test_scorer(scene).psnr(decode(out)), abs=1e-4)
        out.unlink()
    for condition, target, texts in (
        (lambda made: not made, {"psnr": 24.0}, ("no file was made", "--no-prune or --effort 1")),
        (lambda made: len(made) == 2, {"psnr": 50.0}, ("no file reaches 50.00 dB; the best found has", " kB; ")),
        (lambda made: len(made) == 2, {"size": 200, "prune": False}, ("at most 200 bytes; the smallest", " dB; --eff")),
        (is_met, {"psnr": 24.0, "levels": 1}, ("no file with levels of detail was made; ",)),
    ):  # fmt: skip
        stopped = interrupted(condition, effort=1, **target)
        assert (None, False) == (stopped.best, out.exists())
        assert [] == [text for text in texts if text not in str(stopped)]


@pytest.mark.slow
def test_the_command_writes_the_best_file_of_an_interrupted_search_and_its_report(tmp_path, ply, monkeypatch):
    out, report = tmp_path / "scene.csplat", tmp_path / "report.json"
    save_cameras(tmp_path / "cameras.json", cameras(40))
    words = ("encode", ply, out, "--target-size", "5kB", "--cameras", tmp_path / "cameras.json", "--no-prune")

    def is_met(made):
        return any(file.size_bytes <= 5000 for file in made)

    for condition, tried in ((lambda made: not made, 0), (is_met, 1)):
        change_options(monkeypatch, "csplat_tools.cli.encode.Context", progress=CtrlC(monkeypatch, condition))
        stopped = call(*words, "--report", report, status=130)
        assert (tried > 0, tried > 0) == (out.exists(), report.exists())
        assert "interrupted: " in stopped.stderr.splitlines()[-1]
    target = json.loads(report.read_text())["target"]
    assert (True, out.stat().st_size) == (target["interrupted"], target["size_bytes"])
    assert out.stat().st_size <= 5000
    call("verify", out)


def test_only_long_work_is_announced(capsys):
    for quiet, seconds, announced in ((False, 170.0, True), (False, 5.0, False), (True, 170.0, False)):
        Output(quiet=quiet).announce_time(lambda seconds=seconds: seconds, "a preset takes seconds")
        assert announced == ("this takes about 2 to 5 minutes here; a preset takes" in capsys.readouterr().err)


@pytest.mark.slow
def test_the_command_refuses_options_without_effect(tmp_path, ply):
    def check(case):
        done = invoke("encode", ply, tmp_path / "scene.csplat", *case[0].split())
        assert (1 if "unit" in case[1] else 2, False) == (done.exit_code, (tmp_path / "scene.csplat").exists())
        assert case[1] in " ".join(done.stderr.replace("│", " ").split())

    excluding = (
        "--target-size 5kB --attribute-psnr 40", "--keep 0.5 --no-prune", "--keep 0.5 --importance w.npy",
        "--target-psnr 30 --target-size 5kB",
    )  # fmt: skip
    cases = [
        ("--target-size many", "a size is"), ("--target-psnr 120", "at most 99"),
        ("--target-size 10 --no-prune", "no file"), ("--max-error means=1mm", "--unit-metres"),
        ("--keep 0.5 --max-error means=1", "no bounds"),
        ("--effort 12 --target-size 5kB", "the effort is 12, expected 1 to 5"),
        ("--effort 2", "--effort requires --target-psnr or"), ("--no-prune", "--no-prune requires --target-psnr or"),
        ("--max-error means=1 --data d", "--data requires --target-psnr or"),
        ("--max-psnr-drop 1 --cameras c.json", "--max-psnr-drop requires --data"),
        ("--background white --max-error means=1", "--background requires"),
        *((words, ": give one of them") for words in excluding),
    ]  # fmt: skip
    assert [] == failures(dict(zip((words for words, _ in cases), cases, strict=True)), check)

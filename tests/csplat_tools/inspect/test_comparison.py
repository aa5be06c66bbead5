# SPDX-License-Identifier: Apache-2.0
"""`csplat compare`: pairs of splats, scores of renders, and the definition of `psnr`.

Also: csplat_render.scorer, csplat_tools.cli.compare.
"""

import json
import re
import sys
from dataclasses import replace

import numpy as np
import pytest
from checked import cloud
from command_line import call
from models import with_facts
from PIL import Image

from csplat import EncodeOptions, InputError, encode, encode_with_report, write_ply
from csplat.model import normalise_quats
from csplat_render import render
from csplat_render.camera import intrinsics, look_at
from csplat_render.camera_files import save_cameras
from csplat_render.scorer import ReferenceImage, Scorer
from csplat_tools.inspect.comparison import attribute_errors, compare
from csplat_tools.scene_files import load_scene
from csplat_tools.views import comparison_cameras, find_view_set


@pytest.fixture(scope="module")
def scene():
    """A ball of splats that covers a view from afar, so that no nearer views are tried."""
    rng = np.random.default_rng(0)
    means = rng.standard_normal((400, 3))
    means /= np.linalg.norm(means, axis=1, keepdims=True)
    fields = {"scales": rng.normal(-2.7, 0.3, (400, 3)), "opacities": rng.random(400), "sh0": rng.normal(size=(400, 3))}
    fields["shN"] = rng.normal(size=(400, 3, 3))
    fields["quats"] = normalise_quats(rng.standard_normal((400, 4)))
    return cloud(means, **{name: values.astype(np.float32) for name, values in fields.items()})


@pytest.fixture
def cameras():
    """Two small views of the scene, and one of empty space."""
    K, up, centre = intrinsics(64, 48, 60.0), (0.0, -1.0, 0.0), (0.0, 0.0, 0.0)
    return [
        look_at((0.0, 0.0, -4.0), centre, up, K, 64, 48),
        look_at((4.0, 1.0, 0.0), centre, up, K, 64, 48, image="side.png"),
        look_at((0.0, 0.0, 50.0), (0.0, 0.0, 90.0), up, K, 64, 48),
    ]


@pytest.fixture
def camera_file(cameras, tmp_path):
    save_cameras(tmp_path / "cameras.json", cameras)
    return tmp_path / "cameras.json"


def compare_models(source, other, cameras, **words):
    return Scorer.of_source(source, cameras).scores(other, **words)


def errors_of(source, other, index=None):
    return attribute_errors(load_scene(source), load_scene(other), index)


def test_splats_are_paired_by_a_source_index_their_order_or_declared_errors(scene, tmp_path):
    order = np.random.default_rng(1).permutation(len(scene))
    errors = errors_of(scene, scene.select(order), order)
    assert ("index", len(scene), 0) == (errors.pairing, errors.matched, errors.unmatched)
    assert {(0.0, 0.0)} == set(errors.errors.values())
    with pytest.raises(InputError, match="source index"):
        errors_of(scene, scene, np.arange(3))
    for other in (scene.select(order), scene.select(slice(0, 300))):
        assert errors_of(scene, other) is None  # a PLY has no bounds to search within
    errors = errors_of(scene, replace(scene, means=scene.means + np.float32(0.001)))
    assert "order" == errors.pairing
    assert errors.errors["means"][1] == pytest.approx(0.001 * 3**0.5, rel=1e-3)
    result, path = encode_with_report(scene, EncodeOptions(preset="balanced")), tmp_path / "scene.csplat"
    path.write_bytes(result.data)
    models = load_scene(scene), load_scene(str(path))
    found, known = (attribute_errors(*models, index) for index in (None, result.source_index))
    assert ("search", len(scene), 0) == (found.pairing, found.matched, found.unmatched)
    assert known.errors["means"] == pytest.approx(found.errors["means"])


def test_splats_are_not_paired_by_an_order_that_differs_within_far_clusters(tmp_path):
    rng = np.random.default_rng(2)
    near = cloud(rng.standard_normal((600, 3)), 0.02, sh0=rng.standard_normal((600, 3)).astype(np.float32))
    for count, distance in ((2, 1e3), (3, 100.0), (30, 1e4)):
        place = np.arange(600) * count // 600
        far = replace(near, means=(near.means + (distance * rng.standard_normal((count, 3)))[place]).astype(np.float32))
        assert "order" == errors_of(far, far).pairing
        inside = far.select(np.lexsort((rng.random(600), place)))
        half = far.select(np.concatenate([np.arange(360), 360 + rng.permutation(240)]))
        assert (None, None) == (errors_of(far, inside), errors_of(far, half))
        path = tmp_path / f"{count}.csplat"
        encode(far, out=path)
        scene, errors = load_scene(str(path)), errors_of(far, str(path))
        assert ("search", 600) == (errors.pairing, errors.matched)
        assert all(errors.errors[one.measure][0] <= 1.001 * one.max for one in scene.declared_bounds.records)


def test_a_scene_compared_with_itself_scores_99_wherever_its_origin(scene, cameras):
    compared = compare_models(scene, scene, cameras)
    assert (99.0, 99.0, 99.0, None) == (compared.psnr, compared.psnr_mean, compared.psnr_worst, compared.lpips)
    assert compared.ssim == pytest.approx(1.0)
    assert 0.1 < compared.cover < 1.0
    shift = (10.0, -20.0, 5.0)
    moved = replace(scene, means=scene.means - np.float32(shift), origin=shift)
    assert compare_models(scene, moved, cameras).psnr > 90.0


def test_psnr_is_pooled_over_clipped_errors_of_all_views(scene, cameras):
    other = replace(scene, sh0=scene.sh0 + np.float32(0.3))
    compared, squares = compare_models(scene, other, cameras), []
    for camera in cameras:
        a, b = (np.clip(render(model, camera).rgb.astype(np.float64), 0.0, 1.0) for model in (scene, other))
        squares.append(np.square(a - b))
    own = [99.0 if not errors.any() else -10.0 * np.log10(errors.mean()) for errors in squares]
    expected = (-10.0 * np.log10(np.mean(squares)), np.mean(own), min(own))
    assert (compared.psnr, compared.psnr_mean, compared.psnr_worst) == pytest.approx(expected, abs=1e-6)
    assert compared.worst_view == int(np.argmin(own))
    assert (99.0, 0.0) == (compared.each[2].psnr, compared.each[2].cover)
    assert compared.psnr_covered < compared.psnr
    scorer = Scorer.of_source(scene, cameras)
    assert scorer.errors(other).tolist() == pytest.approx([view.mse for view in compared.each], rel=1e-12)
    assert scorer.psnr(other) == pytest.approx(compared.psnr, rel=1e-12)
    again = Scorer.of_source(scene, cameras, kept_bytes=0)  # references beyond the memory are rendered again
    assert not any(isinstance(reference, ReferenceImage) for reference in again.references)
    assert compared == again.scores(other)


def test_views_and_progress_are_passed_to_callbacks(scene, cameras):
    shown, seen = [], []
    calls = {"on_view": lambda number, a, b: shown.append((number, a.shape, b.shape))}
    compare_models(scene, scene, cameras, progress=lambda *now: seen.append(now), **calls)
    assert [(n, (48, 64, 3), (48, 64, 3)) for n in range(3)] == shown
    assert ("comparing", 1.0) == seen[-1]
    with pytest.raises(InputError, match="at least one camera"):
        compare_models(scene, scene, [])
    virtual = comparison_cameras(scene)  # which only depend on the source
    assert [(640, 480)] * 8 == [(camera.W, camera.H) for camera in virtual]
    again = comparison_cameras(with_facts(scene, cameras=[camera.as_json() for camera in virtual[:1]]))
    assert all(np.array_equal(a.viewmat, b.viewmat) for a, b in zip(virtual, again, strict=True))


def test_json_has_psnr_at_the_top_and_renders_are_written_side_by_side(scene, camera_file, tmp_path):
    write_ply(tmp_path / "a.ply", scene)
    (tmp_path / "b.csplat").write_bytes(encode(scene, EncodeOptions(preset="small")))
    words = ("compare", tmp_path / "a.ply", tmp_path / "b.csplat", "--cameras", camera_file)
    result = json.loads(call(*words, "--json").stdout)
    assert 20.0 < result["psnr"] < 99.0
    assert ["cameras.json", "standard", [0.0] * 3] == [result[key] for key in ("cameras", "mode", "background")]
    assert result["ratio"] == pytest.approx(result["a"]["size_bytes"] / result["b"]["size_bytes"])
    assert result["attributes"]["errors"]["means"]["rms"] > 0.0
    assert (3, True) == (len(result["views"]), result["seconds"] > 0.0)
    pictures = ("--pictures", tmp_path / "out")
    assert {"between", "beside", "beyond"} == result["elsewhere"].keys()
    assert min(result["elsewhere"].values()) > 15.0
    text = call(*words, *pictures).stdout
    assert "psnr_worst" in text
    assert f"{result['elsewhere']['beside']:.2f} dB" in text
    assert ["0000.png", "0002.png", "side.png"] == sorted(path.name for path in (tmp_path / "out").iterdir())
    with Image.open(tmp_path / "out" / "side.png") as picture:
        assert (3 * 64, 48) == picture.size
    assert "--force replaces it" in call(*words, *pictures, status=1).stderr


def test_a_page_shows_source_file_and_difference_of_each_view(scene, camera_file, tmp_path):
    (tmp_path / "b.csplat").write_bytes(encode(scene, EncodeOptions(preset="small")))
    views = find_view_set(scene, cameras=str(camera_file), count=0)
    page = tmp_path / "page.html"
    compared = compare(scene, str(tmp_path / "b.csplat"), views=views, pictures=page)
    text = page.read_text("utf-8")
    assert (9, 6) == (text.count("<img "), text.count('role="slider"'))
    assert [f"file, {one.psnr:.1f} dB" for one in compared.quality.each] == re.findall(r"<b>(file, [^<]*)", text)
    with pytest.raises(InputError, match=r"page\.html exists"):
        compare(scene, scene, views=views, pictures=page)


def test_scores_need_neither_pillow_nor_matplotlib(scene, camera_file, tmp_path, monkeypatch):
    write_ply(tmp_path / "a.ply", scene)
    words = ("compare", tmp_path / "a.ply", tmp_path / "a.ply", "--cameras", camera_file)
    for package in ("PIL", "matplotlib"):
        monkeypatch.setitem(sys.modules, package, None)
    call(*words)
    assert "this needs pillow, of the extra render" in call(*words, "--pictures", tmp_path / "out", status=1).stderr
    assert "this needs pillow" in call(*words[:3], "--data", tmp_path, status=1).stderr

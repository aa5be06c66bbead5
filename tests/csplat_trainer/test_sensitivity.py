"""Sensitivity of splats and the error of pruning each, against exact twins; files and the command; fitted colours."""

import json
from dataclasses import replace
from functools import partial
from types import SimpleNamespace

import numpy as np
import pytest
from checked import covariances, quaternion_of
from command_line import call, change_views, invoke
from sensitivity_cases import cameras, scene, small_scene, views

from csplat.encoder import EncodeOptions, Target
from csplat.errors import InputError
from csplat.out_of_core import OutOfCoreOptions
from csplat.ply import write_ply
from csplat_bench.colour_refit import ColourOperator, fit_colours
from csplat_render import render
from csplat_render.contributions import Contributions
from csplat_render.reference_rasteriser import Decisions, render_exact
from csplat_render.scene_frame import scene_frame
from csplat_tools.encode_file import encode_file
from csplat_tools.importance_file import encoder_importance
from csplat_trainer.sensitivity import measure_sensitivity
from csplat_trainer.sensitivity_file import read_sensitivity, write_sensitivity

pytest.importorskip("numba", reason="rendering needs numba: pip install 'csplat[render]'")


pytestmark = pytest.mark.usefixtures("small_views")
STEP = 1e-5


def loose(model):
    """Return mutable float64 arrays of a model."""
    fields = ("means", "quats", "scales", "opacities", "sh0", "shN")
    return SimpleNamespace(**{name: getattr(model, name).astype(np.float64) for name in fields})


def derivatives(model, camera, change):
    """Return d render / d parameter, [H, W, 3], by central differences with all comparisons fixed."""
    decisions = Decisions()
    render_exact(loose(model), camera, antialiased=model.antialiased, decisions=decisions)
    pictures = []
    for step in (STEP, -STEP):
        moved = loose(model)
        change(moved, step)
        decisions.replay()
        pictures.append(render_exact(moved, camera, antialiased=model.antialiased, decisions=decisions).rgb)
    return (pictures[0] - pictures[1]) / (2 * STEP)


def bend(splats, row, i, j, step):
    """Add a step, relative to the trace, to an entry of the covariance and its mirror entry."""
    (covariance,) = covariances(splats.quats[row][None], splats.scales[row][None])
    trace = np.trace(covariance)
    change = np.zeros((3, 3))
    change[i, j] = change[j, i] = step * trace
    values, axes = np.linalg.eigh(covariance + change)
    axes[:, 0] *= np.linalg.det(axes)
    splats.scales[row] = 0.5 * np.log(values)
    splats.quats[row] = quaternion_of(axes)


ENTRIES = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))


@pytest.mark.long
@pytest.mark.parametrize("antialiased", [False, True])
def test_shape_and_opacity_agree_with_finite_differences(antialiased):
    model, views = small_scene(3, antialiased=antialiased), cameras()
    found = measure_sensitivity(model, views, dtype=np.float64)
    pixels = sum(view.W * view.H for view in views)
    close = partial(np.testing.assert_allclose, rtol=2e-5)
    for row in range(len(model)):
        sizes, net, squares = np.zeros(6), np.zeros(6), 0.0
        for view in views:
            for e, (i, j) in enumerate(ENTRIES):
                slope = derivatives(model, view, lambda s, step, i=i, j=j, row=row: bend(s, row, i, j, step))
                sizes[e] += np.abs(slope).sum()
                net[e] += abs(slope.sum())
                squares += (slope**2).sum() / (1 if i == j else 2)  # two mirror entries share an off-diagonal change
        close(sizes.max() / pixels, found.shape[row])
        close(net.max() / pixels, found.shape_net[row])
        close(squares / pixels, found.shape_squares[row])

        def fade(splats, step, row=row):
            splats.opacities[row] += step

        slopes = [derivatives(model, view, fade) for view in views]
        close(sum(np.abs(s).sum() for s in slopes) / pixels, found.opacity[row])
        close(sum(abs(s.sum()) for s in slopes) / pixels, found.opacity_net[row])
        close(sum((s**2).sum() for s in slopes) / pixels, found.opacity_squares[row])


@pytest.mark.long
@pytest.mark.parametrize("antialiased", [False, True])
def test_the_matrix_of_a_shape_predicts_the_error_of_a_small_change(antialiased):
    model, view = small_scene(antialiased=antialiased), cameras(1)
    found = measure_sensitivity(model, view, dtype=np.float64)
    rows, columns = np.triu_indices(6)
    roots = np.array([1, 1, 1, 2**0.5, 2**0.5, 2**0.5])
    for row, direction in enumerate(np.random.default_rng(3).normal(size=(len(model), 6))):

        def change(splats, step, row=row, direction=direction):
            for (i, j), part in zip(ENTRIES, direction, strict=True):
                bend(splats, row, i, j, step * part)

        slope = derivatives(model, view[0], change)
        matrix = np.zeros((6, 6))
        matrix[rows, columns] = matrix[columns, rows] = found.shape_metric[row]
        expected = (slope**2).sum() / (view[0].W * view[0].H)
        np.testing.assert_allclose(expected, (direction * roots) @ matrix @ (direction * roots), rtol=1e-4)


@pytest.mark.long
def test_colour_agrees_with_finite_differences():
    model, views = small_scene(3), cameras()
    found = measure_sensitivity(model, views, dtype=np.float64, metric=True)
    pixels = sum(view.W * view.H for view in views)
    diagonal = np.equal(*np.triu_indices(9))
    for row in range(len(model)):
        largest, squares = 0.0, np.zeros(9)
        for k in range(9):
            for channel in range(3):

                def change(splats, step, row=row, k=k, channel=channel):
                    target = splats.sh0[row] if k == 0 else splats.shN[row, k - 1]
                    target[channel] += step

                slopes = [derivatives(model, view, change) for view in views]
                largest = max(largest, sum(abs(slope.sum()) for slope in slopes))
                squares[k] = max(squares[k], sum((slope**2).sum() for slope in slopes))
        np.testing.assert_allclose(largest / pixels, found.colour[row], rtol=1e-5)
        np.testing.assert_allclose(squares / pixels, found.metric[row][diagonal], rtol=1e-4)
    # The squares of a band's basis functions add up to the same value in every direction.
    sums = found.metric[:, diagonal].sum(axis=1) * 4 * np.pi / 9
    np.testing.assert_allclose(found.colour_squares, sums, rtol=1e-5)


@pytest.mark.long
def test_means_agree_roughly_with_finite_differences():
    model, views = small_scene(degree=0), cameras()
    found = measure_sensitivity(model, views, dtype=np.float64)
    pixels = sum(view.W * view.H for view in views)
    for row in range(len(model)):
        squares = 0.0
        for axis in range(3):

            def change(splats, step, row=row, axis=axis):
                splats.means[row, axis] += step

            squares += sum((derivatives(model, view, change) ** 2).sum() for view in views)
        # The sensitivity ignores the change of size.
        np.testing.assert_allclose(squares / pixels, found.means_squares[row], rtol=0.2)


def test_nothing_cancels_within_a_view():
    found = measure_sensitivity(small_scene(40), cameras())
    assert (found.shape >= found.shape_net * (1 - 1e-6)).all()
    assert (found.shape > 1.5 * found.shape_net).any()


def test_the_number_of_threads_does_not_change_the_result():
    model, views = small_scene(300, 3), cameras(3)
    one, two = (measure_sensitivity(model, views, metric=True, threads=threads) for threads in (1, 2))
    for name in ("colour", "opacity", "shape", "shape_net", "shape_metric", "means_squares", "metric", "views"):
        np.testing.assert_array_equal(getattr(one, name), getattr(two, name), name)


def test_unseen_splats_have_no_sensitivity():
    model = small_scene(10)
    away = np.where(np.arange(10)[:, None] < 3, np.float32(100.0), model.means)
    found = measure_sensitivity(replace(model, means=away), cameras())
    assert [False] * 3 + [True] * 7 == found.seen.tolist()
    assert 0.3 == pytest.approx(found.unseen_share)
    assert 0.0 == max(found.colour[:3].max(), found.shape[:3].max(), found.opacity[:3].max())


@pytest.fixture
def stored(tmp_path):
    model = small_scene(30, 2)
    found = measure_sensitivity(model, cameras(), metric=True)
    path = tmp_path / "scene.npz"
    with path.open("wb") as stream:
        write_sensitivity(stream, model, found, "cameras")
    return path, model, found


def test_virtual_views_in_surroundings_give_no_blocks(stored):
    path, model, _ = stored
    read = read_sensitivity(path, model)
    angles = np.linspace(0.0, 20.0 * np.pi, len(model))[:, None]
    ring = 500.0 * np.concatenate([np.cos(angles), np.sin(angles), 0.0 * angles], axis=1)
    near = np.arange(len(model))[:, None] % 2 == 1
    scales = np.repeat(np.where(near, np.float32(-5.0), np.float32(3.0)), 3, axis=1)
    inside = replace(model, means=np.where(near, model.means, ring).astype(np.float32), scales=scales)
    assert scene_frame(inside).kind == "surrounding"
    virtual = replace(read, source="virtual")
    assert encoder_importance(virtual, inside).blocks is None
    assert encoder_importance(read, inside).blocks is not None
    assert encoder_importance(virtual, model).blocks is not None


@pytest.fixture
def camera_file(tmp_path):
    path = tmp_path / "cameras.json"
    path.write_text(json.dumps([camera.to_json() for camera in cameras(3)]))
    return path


@pytest.mark.slow
def test_encode_uses_the_file_of_the_command(tmp_path, camera_file):
    model = small_scene(400, 1)
    model = replace(model, means=np.where(np.arange(400)[:, None] < 40, np.float32(100.0), model.means))
    ply, npz, out, index = (tmp_path / name for name in ("s.ply", "s.npz", "s.csplat", "s.npy"))
    write_ply(ply, model)
    facts = json.loads(call("sensitivity", ply, npz, "--cameras", camera_file, "--json", "--quiet").stdout)
    assert (400, 3, "cameras") == (facts["splats"], facts["views"], facts["source"])
    assert 40 <= facts["unseen"] < 400
    call("sensitivity", ply, npz, "--cameras", camera_file, status=1)  # not without --force
    encoded = encode_file(str(ply), str(out), EncodeOptions(), importance=npz, prune_unseen=True, source_index=index)
    assert 400 - facts["unseen"] == encoded.report.splat_count
    assert set(range(400)) - set(np.load(index).tolist()) >= set(range(40))
    call("verify", out, "--source", ply, "--source-index", index)


@pytest.fixture
def seen_in_part(tmp_path):
    """A PLY of opaque splats that a few views see only in part."""
    model = small_scene(400, 0)
    means = model.means / np.linalg.norm(model.means, axis=1, keepdims=True)
    write_ply(tmp_path / "part.ply", replace(model, means=means, opacities=np.full(400, 0.999, np.float32)))
    return tmp_path / "part.ply"


@pytest.mark.slow
def test_the_command_places_virtual_views_and_announces_the_time(tmp_path, seen_in_part, monkeypatch):
    monkeypatch.setattr("csplat_tools.views.view_sets.render_seconds", lambda *_, **__: 1.0)
    change_views(monkeypatch, 20, (48, 36))
    done = invoke("sensitivity", seen_in_part, tmp_path / "s.npz")
    assert 0 == done.exit_code, done.stderr
    assert "20 virtual views" in done.stderr
    assert "this takes about 2 to 4 minutes here" in done.stderr  # 36 renders: 16 more check


def test_invalid_options_are_refused(tmp_path, sample_path, camera_file):
    out = tmp_path / "out.npz"
    assert 2 == invoke("sensitivity", sample_path, out, "--cameras", camera_file, "--data", tmp_path).exit_code
    assert 2 == invoke("sensitivity", sample_path, "-").exit_code
    np.save(tmp_path / "w.npy", np.ones(3))
    done = invoke("encode", sample_path, tmp_path / "o.csplat", "--importance", tmp_path / "w.npy", "-q")
    assert 1 == done.exit_code
    assert 1 == len(done.stderr.splitlines())


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"prune_unseen": True}, "requires a file of `csplat sensitivity`"),
        ({"prune_unseen": True, "out_of_core": OutOfCoreOptions(always=True)}, "requires a file of"),
        ({"importance": "w.npy", "prune_unseen": True, "target": Target(psnr=30.0)}, "prune_unseen and a target"),
        ({"importance": "w.npy", "out_of_core": OutOfCoreOptions(resume=True)}, "larger than memory"),
    ],
)
def test_contradictory_arguments_are_refused_before_the_scene_is_read(tmp_path, arguments, message):
    with pytest.raises(InputError, match=message):
        encode_file(str(tmp_path / "missing.ply"), str(tmp_path / "out.csplat"), EncodeOptions(), **arguments)


def test_cameras_without_splats_in_view_are_refused(tmp_path, camera_file):
    model = small_scene(20, 1)
    write_ply(tmp_path / "s.ply", replace(model, means=model.means + np.float32(1000.0)))
    done = call("sensitivity", tmp_path / "s.ply", tmp_path / "s.npz", "--cameras", camera_file, "-q", status=1)
    assert "no view shows any splat" in done.stderr
    assert not (tmp_path / "s.npz").exists()


def coefficients(model):
    return np.concatenate([model.sh0[:, None], model.shN], axis=1)


def test_the_operator_is_symmetric():
    model = scene(count=80)
    operator = ColourOperator(model, views(2))
    rng = np.random.default_rng(3)
    x = rng.standard_normal((80, 16, 3)).astype(np.float32)
    y = rng.standard_normal((80, 16, 3)).astype(np.float32)
    images = [np.zeros_like(x), np.zeros_like(x)]
    length = operator.normal(x, images[0])
    operator.normal(y, images[1])
    assert np.sum(x * images[0], dtype=np.float64) == pytest.approx(length, rel=1e-4)
    across = np.sum(y * images[0], dtype=np.float64)
    assert across == pytest.approx(np.sum(x * images[1], dtype=np.float64), rel=1e-3, abs=1e-3 * length)


def test_gradient_and_diagonal_agree_with_finite_differences():
    model = replace(scene(count=40), sh0=np.full((40, 3), 1.5, np.float32))  # bright: nothing is clamped
    wanted = [np.full((30, 40, 3), 0.4, np.float32)] * 2
    operator, x = ColourOperator(model, views(2)), coefficients(model)
    gradient, diagonal = np.zeros_like(x), np.zeros(x.shape[:2], np.float32)
    before = operator.error(x, wanted, gradient, diagonal)
    row = int(np.argmax(np.abs(gradient[:, 2, 1])))
    for step in (0.1, -0.1):
        moved = x.copy()
        moved[row, 2, 1] += step
        after = operator.error(moved, wanted, np.zeros_like(x))
        expected = 2.0 * step * gradient[row, 2, 1] + step**2 * diagonal[row, 2]
        assert after - before == pytest.approx(expected, rel=2e-3, abs=1e-3)


def test_fitting_recovers_the_colours_of_renders():
    model = scene(count=25, degree=1)
    model = replace(model, sh0=model.sh0 * np.float32(0.2) + np.float32(1.0), shN=model.shN * np.float32(0.3))
    cameras = views(12)
    wanted = [render(model, camera).rgb for camera in cameras]
    wrong = replace(model, sh0=model.sh0 + np.float32(0.2), shN=np.zeros_like(model.shN))
    x, errors = fit_colours(wrong, cameras, wanted, steps=40, ridge=1e-5, least_gain=0.0)
    assert errors[-1] < 1e-3 * errors[0]
    fitted = replace(model, sh0=np.ascontiguousarray(x[:, 0]), shN=np.ascontiguousarray(x[:, 1:]))
    true = sum(float(np.sum((render(fitted, c).rgb - w) ** 2)) for c, w in zip(cameras, wanted, strict=True))
    assert true < 2e-3 * errors[0]


def test_colours_of_unseen_splats_are_kept():
    model, cameras = scene(count=40), views(2)
    means = model.means.copy()
    means[5] = 50.0
    model = replace(model, means=means)
    wanted = [np.full((30, 40, 3), 0.5, np.float32)] * 2
    x, _ = fit_colours(model, cameras, wanted)
    np.testing.assert_array_equal(coefficients(model)[5], x[5])
    assert np.abs(x - coefficients(model)).max() > 0.01


def test_views_beyond_the_cache_give_the_same_colours():
    model, cameras = scene(count=60), views(3)
    wanted = [np.full((30, 40, 3), 0.5, np.float32)] * 3
    kept, _ = fit_colours(model, cameras, wanted, steps=3)
    anew, _ = fit_colours(model, cameras, wanted, steps=3, cache_bytes=0)
    np.testing.assert_array_equal(kept, anew)


@pytest.mark.parametrize("opacity", [0.05, 0.3, 0.97])
def test_trimming_splats_without_weight_changes_no_bit(opacity):
    model = scene(count=400)
    model = replace(model, opacities=np.full(400, opacity, np.float32), scales=model.scales + np.float32(0.5))
    drawing, x = Contributions(), coefficients(model)
    whole = drawing.project_view(model, views(1, (70, 50))[0])
    active, black, wanted = np.ones((len(whole.rows), 3), bool), np.zeros(3, np.float32), np.float32(0.5)
    reference = np.full((50, 70, 3), wanted, np.float32)

    def answer(view, mask):
        sums = np.zeros_like(x), np.zeros(x.shape[:2], np.float32)
        rgb = drawing.backproject(view, x, mask, *sums, offset=0.5, background=black, reference=reference)
        return rgb, *sums

    first = answer(whole, active)
    less, left = drawing.trim(whole)
    assert len(less.ids) < len(whole.ids)
    for expected, actual in zip(first, answer(less, active[left]), strict=True):
        np.testing.assert_array_equal(expected, actual)


def test_a_fit_of_huge_colours_is_finite():
    model = scene(count=40)
    model = replace(model, sh0=np.full((40, 3), 1e30, np.float32))
    x, _ = fit_colours(model, views(2), [np.full((30, 40, 3), 0.5, np.float32)] * 2)
    assert np.isfinite(x).all()


def test_a_wrong_number_of_references_is_refused():
    with pytest.raises(InputError, match="2 cameras and 1 reference images"):
        fit_colours(scene(), views(2), [np.zeros((30, 40, 3), np.float32)])

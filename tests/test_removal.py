"""The error of pruning each splat, against its twin, and colours fitted to renders."""

from dataclasses import dataclass, replace

import numpy as np
import pytest

pytest.importorskip("numba", reason="the renderer requires the extra [render]")

from oracle import adversarial, extreme_splats, facing

from csplat.errors import InputError
from csplat.model import SplatModel, sh_degree_of
from csplat.ply import read_ply
from csplat_render import render
from csplat_render.camera import intrinsics, look_at
from csplat_render.camera_files import load_cameras
from csplat_render.contributions import Contributions
from csplat_render.conventions import UncheckedSplats
from csplat_render.pruning_error import measure_pruning_error, pruning_error_exact
from csplat_render.refit import ColourOperator, fit_colours
from csplat_render.virtual_cameras import virtual_cameras


def views(count=3, width=40, height=30, distance=4.0):
    K = intrinsics(width, height, 60.0)
    angles = np.arange(count) * 2.2
    eyes = [(distance * np.sin(a), 0.7, distance * np.cos(a)) for a in angles]
    return [look_at(eye, (0.0, 0.0, 0.0), (0.0, -1.0, 0.0), K, width, height) for eye in eyes]


def scene(count=60, degree=3, seed=0):
    rng = np.random.default_rng(seed)
    quats = rng.standard_normal((count, 4))
    return SplatModel(
        means=rng.uniform(-1.0, 1.0, (count, 3)).astype(np.float32),
        quats=(quats / np.linalg.norm(quats, axis=1, keepdims=True)).astype(np.float32),
        scales=rng.uniform(-3.5, -1.0, (count, 3)).astype(np.float32),
        opacities=rng.uniform(0.05, 1.0, count).astype(np.float32),
        sh0=rng.standard_normal((count, 3)).astype(np.float32),
        shN=(0.3 * rng.standard_normal((count, (degree + 1) ** 2 - 1, 3))).astype(np.float32),
    )


def relative(found, expected):
    return np.abs(found - expected) / np.maximum(expected, 1e-12)


# Pruning errors.
@pytest.mark.area(name="rasteriser")
@pytest.mark.parametrize("antialiased", [False, True])
def test_pruning_errors_agree_with_removing_splats_one_by_one(antialiased):
    model = replace(scene(30), antialiased=antialiased)
    behind = (0.2, 0.5, 0.9)
    expected = pruning_error_exact(model, views(2), np.arange(30), background=behind, transmittance_min=0.0)
    wide = measure_pruning_error(model, views(2), background=behind, dtype=np.float64, transmittance_min=0.0)
    assert relative(wide.error, expected).max() < 1e-9
    narrow = measure_pruning_error(model, views(2), background=behind, transmittance_min=0.0)
    assert relative(narrow.error, expected)[expected > 1e-6].max() < 1e-4
    assert expected.max() > 1.0


@pytest.mark.parametrize("name", ["plane3", "lego60k", "fox60k_noreg"])
def test_pruning_errors_agree_on_shared_scenes(data_dir, name):
    path = data_dir / "ply" / f"{name}.ply"
    if not path.exists():
        pytest.skip(f"{name} is absent")
    camera = load_cameras(data_dir / "psnr_cameras" / f"{name}.json")[1]
    assert_pruning_errors_agree(read_ply(path), replace(camera, K=np.diag([0.1, 0.1, 1.0]) @ camera.K, W=64, H=48))


@pytest.mark.slow
def test_pruning_errors_agree_on_the_sample(sample_path):
    source = read_ply(sample_path)
    assert_pruning_errors_agree(source, virtual_cameras(source, 1, 64, 48)[0])


def assert_pruning_errors_agree(source, camera):
    model = source.select(slice(0, None, max(1, len(source) // 500)))
    found = measure_pruning_error(model, [camera], transmittance_min=0.0)
    rows = np.argsort(-found.error)[:120:40]
    expected = pruning_error_exact(model, [camera], rows, transmittance_min=0.0)
    off = relative(found.error[rows], expected).max()
    print(f"{off:.1e} off taking splats away one by one")
    assert off < 1e-4


@pytest.mark.slow
def test_only_finished_pixels_are_left_out():
    model = scene(count=60)
    model = replace(model, opacities=np.full(60, 0.97, np.float32), scales=model.scales + np.float32(1.0))
    exact = pruning_error_exact(model, views(1), np.arange(60))
    found = measure_pruning_error(model, views(1)).error
    assert abs(found.sum() / exact.sum() - 1.0) < 2e-2
    assert np.corrcoef(found, exact)[0, 1] > 0.999


def test_renders_of_the_measurement_equal_those_of_the_renderer():
    model, seen = scene(count=200), []
    behind = (0.1, 0.2, 0.3)
    measure_pruning_error(model, views(2), background=behind, on_render=lambda _n, picture: seen.append(picture))
    for camera, picture in zip(views(2), seen, strict=True):
        np.testing.assert_allclose(picture, render(model, camera, background=behind).rgb, atol=2e-5)


@pytest.mark.area(name="rasteriser")
def test_error_and_product_predict_the_change_against_other_references():
    model = scene(count=30)
    wanted = [render(scene(count=30, seed=1), camera, mode="exact").rgb for camera in views(2)]
    found = measure_pruning_error(model, views(2), references=wanted, dtype=np.float64)

    def error(rows):
        pictures = [render(model.select(rows), camera, mode="exact").rgb for camera in views(2)]
        return sum(float(np.sum((a - b) ** 2)) for a, b in zip(pictures, wanted, strict=True))

    whole = error(np.arange(30))
    row = int(np.argmax(found.error))
    gain = error(np.delete(np.arange(30), row)) - whole
    assert gain == pytest.approx(found.error[row] + 2.0 * found.product[row], rel=2e-3)


@pytest.mark.area(name="rasteriser")
def test_bands_and_weights_of_a_single_splat_are_exact():
    model = scene(count=1)
    camera = views(1)[0]
    found = measure_pruning_error(model, [camera], dtype=np.float64)
    alpha = render(model, camera, mode="exact").alpha
    assert found.squared_weight[0] == pytest.approx((alpha**2).sum(), rel=1e-6)
    shN = model.shN.copy()
    shN[:, 3:8] = 0.0
    with_band, without = (render(one, camera, mode="exact").rgb for one in (model, replace(model, shN=shN)))
    if (with_band[alpha > 0.1] > 0.0).all() and (without[alpha > 0.1] > 0.0).all():  # no clamp
        assert found.bands[0, 1] == pytest.approx(float(np.sum((with_band - without) ** 2)), rel=1e-4)


def test_a_splat_out_of_view_is_unseen():
    model = scene(count=3)
    far = model.means.copy()
    far[2] = 100.0
    found = measure_pruning_error(replace(model, means=far), views(1))
    assert not found.seen[2]
    assert found.error[2] == 0.0
    assert found.seen[:2].all()


@pytest.mark.parametrize("threads", [1, 2])
def test_the_number_of_threads_does_not_change_the_result(threads):
    model = scene(count=300)
    found, other = measure_pruning_error(model, views(2), threads=threads), measure_pruning_error(model, views(2))
    for name in ("error", "squared_weight", "bands"):
        np.testing.assert_array_equal(getattr(found, name), getattr(other, name))


@pytest.mark.area(name="rasteriser")
@pytest.mark.parametrize("antialiased", [False, True])
def test_slanted_needles_lose_no_row(antialiased):
    model = scene(count=30, seed=4)
    scales = np.tile(np.float32([-0.5, -6.0, -6.0]), (30, 1))  # needles, which leave most rows of their boxes empty
    model = replace(model, scales=scales, antialiased=antialiased)
    expected = pruning_error_exact(model, views(1), np.arange(30), transmittance_min=0.0)
    found = measure_pruning_error(model, views(1), dtype=np.float64, transmittance_min=0.0)
    assert relative(found.error, expected)[expected > 0.0].max() < 1e-9
    assert np.count_nonzero(expected) > 20


@pytest.mark.parametrize("name", [name for name, _ in adversarial()])
def test_errors_of_adversarial_splats_are_finite(name):
    case = dict(adversarial())[name]
    assert_finite(case.arrays, case.view, antialiased=case.antialiased)


@pytest.mark.parametrize("log_scale", [-60.0, 60.0, 88.0, -88.0, 3e38, -3e38])
def test_errors_of_tiny_and_huge_splats_are_finite(log_scale):
    assert_finite(extreme_splats(scales=log_scale), facing())
    assert_finite(extreme_splats(scales=(log_scale, -2.0, -2.0)), facing())


@pytest.mark.parametrize("field", ["sh0", "shN"])
@pytest.mark.parametrize("size", [1e12, 1e25, 3e38])
def test_errors_of_huge_colours_are_finite(field, size):
    arrays = extreme_splats()
    arrays[field] = np.where(arrays[field] > 0.0, size, -size).astype(np.float32)
    assert_finite(arrays, facing())


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("field", ["means", "quats", "scales", "opacities", "sh0", "shN"])
def test_non_finite_rows_are_unseen_and_change_nothing(field, bad):
    arrays = extreme_splats(count=30)
    clean = measured({name: value[3:] for name, value in arrays.items()}, facing())
    arrays[field].reshape(30, -1)[:3, -1] = bad
    found = measured(arrays, facing())
    assert not found.seen[:3].any()
    for name in ("error", "squared_weight", "bands"):
        np.testing.assert_array_equal(getattr(clean, name), getattr(found, name)[3:])


def measured(arrays, view, *, antialiased=False):
    """Measure arrays that a `SplatModel` would refuse."""
    degree = sh_degree_of(arrays["shN"].shape[1])
    return measure_pruning_error(Loose(**arrays, sh_degree=degree, antialiased=antialiased), [view])


def assert_finite(arrays, view, *, antialiased=False):
    found = measured(arrays, view, antialiased=antialiased)
    for name in ("error", "squared_weight", "bands"):
        assert np.isfinite(getattr(found, name)).all(), name


@dataclass(frozen=True)
class Loose(UncheckedSplats):
    """The fields of a model that `measure_pruning_error` reads, without validation."""

    sh_degree: int
    antialiased: bool

    def __len__(self):
        return len(self.means)


def test_errors_of_groups_of_views_add_up():
    model, cameras = scene(count=50), views(3)
    whole = measure_pruning_error(model, cameras)
    parts = measure_pruning_error(model, cameras[:1]) + measure_pruning_error(model, cameras[1:])
    np.testing.assert_allclose(whole.error, parts.error, rtol=1e-12)
    assert whole.value_count == parts.value_count
    np.testing.assert_array_equal(whole.seen, parts.seen)


def test_missing_cameras_or_references_are_refused():
    with pytest.raises(InputError, match="camera"):
        measure_pruning_error(scene(), [])
    with pytest.raises(InputError, match="1 reference images, expected one for each of 2"):
        measure_pruning_error(scene(), views(2), references=[np.zeros((30, 40, 3))])


# Colours.
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
    whole = drawing.project_view(model, views(1, 70, 50)[0])
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

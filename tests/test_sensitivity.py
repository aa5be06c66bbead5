"""Sensitivity against finite differences of the exact twin, files of sensitivities, and the command."""

import json
from dataclasses import replace

import numpy as np
import pytest

from csplat.encoder import EncodeOptions
from csplat.errors import InputError
from csplat.model import SplatModel, normalise_quats
from csplat.ply import read_ply, write_ply

pytest.importorskip("numba", reason="the renderer requires the extra [render]")

from checked import covariances, quaternion_of
from command_line import call, change_views, invoke

from csplat_render.camera import intrinsics, look_at
from csplat_render.reference_rasteriser import Decisions, render_exact
from csplat_render.scene_frame import scene_frame
from csplat_tools.encode_file import OutOfCoreOptions, encode_file
from csplat_tools.importance_file import encoder_importance
from csplat_trainer.sensitivity import measure_sensitivity
from csplat_trainer.sensitivity_file import GROUPS, read_sensitivity, write_sensitivity

pytestmark = pytest.mark.usefixtures("small_views")

STEP = 1e-5


def small_scene(count=6, degree=2, seed=0, **fields):
    rng = np.random.default_rng(seed)
    return SplatModel(
        means=rng.normal(0, 0.5, (count, 3)).astype(np.float32),
        quats=normalise_quats(rng.normal(size=(count, 4)).astype(np.float32)),
        scales=rng.normal(-1.6, 0.4, (count, 3)).astype(np.float32),
        opacities=rng.uniform(0.2, 0.95, count).astype(np.float32),
        sh0=rng.normal(0.5, 0.5, (count, 3)).astype(np.float32),
        shN=rng.normal(0, 0.1, (count, (degree + 1) ** 2 - 1, 3)).astype(np.float32),
        **fields,
    )


def cameras(count=2, size=(40, 32)):
    K = intrinsics(*size, 50.0)
    up = np.array([0.0, 1.0, 0.0])
    eyes = [np.array([3 * np.sin(a), 0.6, 3 * np.cos(a)]) for a in np.arange(count) * 2.1]
    return [look_at(eye, np.zeros(3), up, K, *size, 0.1) for eye in eyes]


class Loose:
    """Mutable float64 arrays of a model."""

    def __init__(self, model):
        for name in ("means", "quats", "scales", "opacities", "sh0", "shN"):
            setattr(self, name, getattr(model, name).astype(np.float64))


def derivatives(model, camera, change):
    """Return d render / d parameter, [H, W, 3], by central differences with all comparisons fixed."""
    decisions = Decisions()
    render_exact(Loose(model), camera, antialiased=model.antialiased, decisions=decisions)
    pictures = []
    for step in (STEP, -STEP):
        moved = Loose(model)
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


@pytest.mark.area(name="rasteriser")
@pytest.mark.parametrize("antialiased", [False, True])
def test_shape_and_opacity_agree_with_finite_differences(antialiased):
    model, views = small_scene(3, antialiased=antialiased), cameras()
    found = measure_sensitivity(model, views, dtype=np.float64)
    pixels = sum(view.W * view.H for view in views)
    for row in range(len(model)):
        sizes, net, squares = np.zeros(6), np.zeros(6), 0.0
        for view in views:
            for e, (i, j) in enumerate(ENTRIES):
                slope = derivatives(model, view, lambda s, step, i=i, j=j, row=row: bend(s, row, i, j, step))
                sizes[e] += np.abs(slope).sum()
                net[e] += abs(slope.sum())
                squares += (slope**2).sum() / (1 if i == j else 2)  # two mirror entries share an off-diagonal change
        np.testing.assert_allclose(sizes.max() / pixels, found.shape[row], rtol=2e-5)
        np.testing.assert_allclose(net.max() / pixels, found.shape_net[row], rtol=2e-5)
        np.testing.assert_allclose(squares / pixels, found.shape_squares[row], rtol=2e-5)

        def fade(splats, step, row=row):
            splats.opacities[row] += step

        slopes = [derivatives(model, view, fade) for view in views]
        np.testing.assert_allclose(sum(np.abs(s).sum() for s in slopes) / pixels, found.opacity[row], rtol=2e-5)
        np.testing.assert_allclose(sum(abs(s.sum()) for s in slopes) / pixels, found.opacity_net[row], rtol=2e-5)
        np.testing.assert_allclose(sum((s**2).sum() for s in slopes) / pixels, found.opacity_squares[row], rtol=2e-5)


@pytest.mark.area(name="rasteriser")
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


@pytest.mark.area(name="rasteriser")
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


@pytest.mark.area(name="rasteriser")
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


def test_no_cameras_are_refused():
    with pytest.raises(InputError, match="camera"):
        measure_sensitivity(small_scene(), [])


# Files.


@pytest.fixture
def stored(tmp_path):
    model = small_scene(30, 2)
    found = measure_sensitivity(model, cameras(), metric=True)
    path = tmp_path / "scene.npz"
    with path.open("wb") as stream:
        write_sensitivity(stream, model, found, "cameras")
    return path, model, found


def test_a_file_is_written_and_read(stored):
    path, model, found = stored
    read = read_sensitivity(path, model)
    assert ("cameras", 2) == (read.source, read.view_count)
    assert np.isnan(read.missed_share)
    for name in GROUPS:
        np.testing.assert_array_equal(getattr(found, name).astype(np.float32), read.groups[name], name)
    importance = read.importance()
    assert (30, 36) == importance.sh_metric.shape
    assert (30, 21) == importance.shape_metric.shape
    rows, columns = np.triu_indices(8)
    np.testing.assert_allclose(1.0, importance.sh_metric[:, rows == columns].mean(axis=1), rtol=1e-3)


def test_blocks_follow_from_the_sensitivities(stored):
    path, model, found = stored
    curvatures = read_sensitivity(path, model).importance().blocks
    np.testing.assert_allclose(curvatures.means, found.means_squares / 3.0, rtol=1e-5)
    np.testing.assert_allclose(curvatures.shapes, found.shape_metric / 3.0, rtol=1e-4, atol=1e-9)


def test_virtual_views_in_surroundings_give_no_blocks(stored):
    path, model, _ = stored
    read = read_sensitivity(path, model)
    far = np.linspace(0.0, 20.0 * np.pi, len(model), dtype=np.float32)[:, None]
    ring = 500.0 * np.concatenate([np.cos(far), np.sin(far), 0.0 * far], axis=1)
    scales = np.where(np.arange(len(model))[:, None] % 2, np.float32(-5.0), np.float32(3.0))
    means = np.where(np.arange(len(model))[:, None] % 2, model.means, ring).astype(np.float32)
    inside = replace(model, means=means, scales=np.broadcast_to(scales, (len(model), 3)).astype(np.float32))
    assert scene_frame(inside).kind == "surrounding"
    virtual = replace(read, source="virtual")
    assert encoder_importance(virtual, inside).blocks is None
    assert encoder_importance(read, inside).blocks is not None
    assert encoder_importance(virtual, model).blocks is not None


def test_a_file_is_refused_for_another_scene(stored):
    path, model, _ = stored
    with pytest.raises(InputError, match="of 30 splats, but the scene has 29"):
        read_sensitivity(path, model.select(np.arange(29)))
    with pytest.raises(InputError, match="another scene"):
        read_sensitivity(path, replace(model, sh0=model.sh0 + np.float32(0.5)))


def test_damaged_files_are_refused(stored):
    path, model, _ = stored
    data = path.read_bytes()
    for bad in (b"", b"PK", data[: len(data) // 2], data[:-30], b"nonsense" * 10):
        path.write_bytes(bad)
        with pytest.raises(InputError, match="not a file of sensitivities"):
            read_sensitivity(path, model)
    with path.open("wb") as stream:
        np.savez(stream, colour=np.ones(30))
    with pytest.raises(InputError, match="not a file of sensitivities"):
        read_sensitivity(path, model)


@pytest.mark.slow
@pytest.mark.parametrize("packed", [False, True], ids=["as written", "deflated"])
def test_flipped_bits_are_refused_or_read(tmp_path, packed):
    # Bits of the archive's directory at a small stride, bits of the arrays at a large one.
    model, path = small_scene(1, 1), tmp_path / "one.npz"
    with path.open("wb") as stream:
        write_sensitivity(stream, model, measure_sensitivity(model, cameras(), metric=True), "cameras")
    if packed:
        with np.load(path) as file:
            arrays = dict(file)
        np.savez_compressed(path, **arrays)
    data = path.read_bytes()
    directory, refused = data.index(b"PK\x01\x02"), 0
    for bit in (*range(0, 8 * directory, 1201), *range(8 * directory, 8 * len(data), 53)):
        bad = bytearray(data)
        bad[bit // 8] ^= 1 << bit % 8
        path.write_bytes(bad)
        try:
            read_sensitivity(path, model)
        except (InputError, OSError):  # zipfile seeks to before the file
            refused += 1
    assert refused > 0.3 * directory * 8 / 1201


@pytest.mark.parametrize(
    ("name", "array"),
    [
        ("views", np.array(["1"] * 30)),
        ("colour", np.ones(30, np.complex64)),
        ("view_count", np.array(np.inf)),
        ("shape_matrices", np.ones((29, 21), np.float32)),
        ("matrices", np.ones(30, np.float16)),
        ("views", np.array(1)),
        ("colour", np.full(30, np.nan, np.float32)),
    ],
)
def test_invalid_arrays_are_refused(stored, name, array):
    path, model, _ = stored
    with np.load(path) as file:
        arrays = dict(file)
    np.savez(path, **(arrays | {name: array}))
    with pytest.raises(InputError, match="not a file of sensitivities"):
        read_sensitivity(path, model)


def test_unseen_splats_have_a_small_weight(stored):
    path, model, _ = stored
    away = np.where(np.arange(30)[:, None] < 3, np.float32(100.0), model.means)
    model = replace(model, means=away)
    with path.open("wb") as stream:
        write_sensitivity(stream, model, measure_sensitivity(model, cameras(), metric=True), "virtual")
    read = read_sensitivity(path, model)
    weights = read.importance().sh
    assert 3 == np.count_nonzero(~read.seen)
    assert 0.0 < weights[:3].max() < np.median(weights[3:])
    assert np.isfinite(read.importance().sh_metric).all()


# The command line.


@pytest.fixture
def camera_file(tmp_path):
    path = tmp_path / "cameras.json"
    path.write_text(json.dumps([camera.to_json() for camera in cameras(3)]))
    return path


@pytest.mark.slow
def test_encode_uses_the_file_of_the_command(tmp_path, camera_file):
    model = small_scene(400, 1)
    away = np.where(np.arange(400)[:, None] < 40, np.float32(100.0), model.means)
    model = replace(model, means=away)
    ply, npz, out, index = (tmp_path / name for name in ("s.ply", "s.npz", "s.csplat", "s.npy"))
    write_ply(ply, model)
    facts = json.loads(call("sensitivity", ply, npz, "--cameras", camera_file, "--json", "--quiet").stdout)
    assert (400, 3, "cameras") == (facts["splats"], facts["views"], facts["source"])
    unseen = facts["unseen"]
    assert 40 <= unseen < 400
    call("sensitivity", ply, npz, "--cameras", camera_file, status=1)  # not without --force
    encoded = encode_file(str(ply), str(out), EncodeOptions(), importance=npz, prune_unseen=True, source_index=index)
    assert 400 - unseen == encoded.report.splat_count
    assert set(range(400)) - set(np.load(index).tolist()) >= set(range(40))
    call("verify", out, "--source", ply, "--source-index", index)


@pytest.fixture
def seen_in_part(tmp_path):
    """A PLY of opaque splats that a few views see only in part."""
    rng = np.random.default_rng(0)
    means = rng.standard_normal((400, 3))
    means /= np.linalg.norm(means, axis=1, keepdims=True)
    model = small_scene(400, 0)
    opaque = np.full(400, 0.999, np.float32)
    write_ply(tmp_path / "part.ply", replace(model, means=means.astype(np.float32), opacities=opaque))
    return tmp_path / "part.ply"


@pytest.mark.slow
def test_the_command_places_virtual_views_and_announces_the_time(tmp_path, seen_in_part, monkeypatch):
    monkeypatch.setattr("csplat_tools.views.view_sets.render_seconds", lambda *_, **__: 1.0)
    change_views(monkeypatch, 20, (48, 36))
    done = invoke("sensitivity", seen_in_part, tmp_path / "s.npz")
    assert 0 == done.exit_code, done.stderr
    assert "20 virtual views" in done.stderr
    assert "this takes about 2 to 4 minutes here" in done.stderr  # 36 renders: 16 more check


@pytest.mark.slow
def test_pruning_reports_the_share_that_other_views_see(tmp_path, seen_in_part, monkeypatch):
    npz, out = tmp_path / "s.npz", tmp_path / "o.csplat"
    change_views(monkeypatch, 2, None)
    invoke("sensitivity", seen_in_part, npz)
    missed = read_sensitivity(npz, read_ply(seen_in_part)).missed_share
    assert missed > 0.0
    pruned = encode_file(str(seen_in_part), str(out), EncodeOptions(), importance=str(npz), prune_unseen=True)
    assert f"{100 * missed:.1f} % of the splats were pruned although" in " ".join(pruned.report.notes)
    assert "left out" not in invoke("encode", seen_in_part, out, "--importance", npz, "--force", "-q").stderr


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
        ({"importance": "w.npy", "encoder": print}, "an encoder and an importance"),
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

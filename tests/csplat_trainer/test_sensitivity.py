# SPDX-License-Identifier: Apache-2.0
"""Sensitivity of splats, against finite differences of the exact renderer; the command.

Also: csplat_tools.cli.sensitivity.
"""

import json
from dataclasses import replace
from functools import partial
from types import SimpleNamespace

import numpy as np
import pytest
from checked import covariances, quaternion_of
from command_line import call, invoke
from sensitivity_cases import cameras, small_scene

from csplat.context import Context
from csplat.encoder import EncodeOptions, Target
from csplat.errors import InputError
from csplat.ply import write_ply
from csplat_render.reference_rasteriser import Decisions, render_exact
from csplat_tools.encode_file import encode_file
from csplat_trainer.sensitivity import measure_sensitivity

pytestmark = pytest.mark.usefixtures("small_views")
STEP = 1e-5


def loose(model):
    """Return mutable float64 arrays of a model."""
    fields = ("means", "quats", "scales", "opacities", "sh0", "shN")
    return SimpleNamespace(**{name: getattr(model, name).astype(np.float64) for name in fields})


def derivatives(model, views, change):
    """Return d render / d parameter of each view, [H, W, 3], by central differences with all comparisons fixed."""
    slopes = []
    for view in views:
        decisions, pictures = Decisions(), []
        render_exact(loose(model), view, antialiased=model.metadata.antialiased, decisions=decisions)
        for step in (STEP, -STEP):
            moved = loose(model)
            change(moved, step)
            decisions.replay()
            pictures.append(render_exact(moved, view, antialiased=model.metadata.antialiased, decisions=decisions).rgb)
        slopes.append((pictures[0] - pictures[1]) / (2 * STEP))
    return slopes


def shifted(name, *place):
    def change(splats, step):
        getattr(splats, name)[place] += step

    return change


ENTRIES = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))


def bent(row, weights):
    """Return a change of a covariance's entries and their mirror entries, by a step relative to the trace."""

    def change(splats, step):
        (covariance,) = covariances(splats.quats[row][None], splats.scales[row][None])
        trace = np.trace(covariance)
        for (i, j), weight in zip(ENTRIES, weights, strict=True):
            covariance[i, j] += step * weight * trace
            covariance[j, i] = covariance[i, j]
        values, axes = np.linalg.eigh(covariance)
        axes[:, 0] *= np.linalg.det(axes)
        splats.scales[row] = 0.5 * np.log(values)
        splats.quats[row] = quaternion_of(axes)

    return change


def sums(slopes):
    """Return the sums over views of magnitudes, of each view's net change, and of squares."""
    return [sum(np.abs(s).sum() for s in slopes), sum(abs(s.sum()) for s in slopes), sum((s**2).sum() for s in slopes)]


@pytest.mark.long
@pytest.mark.parametrize("antialiased", [False, True])
def test_sensitivities_agree_with_finite_differences(antialiased):
    model, views = small_scene(3, antialiased=antialiased), cameras()
    found = measure_sensitivity(model, views, metric=True)
    pixels = sum(view.W * view.H for view in views)
    close, rng = partial(np.testing.assert_allclose, rtol=2e-5), np.random.default_rng(3)
    roots, diagonal = np.sqrt([1, 1, 1, 2, 2, 2]), np.equal(*np.triu_indices(9))
    for row in range(len(model)):
        by_entry = np.array([sums(derivatives(model, views, bent(row, weights))) for weights in np.eye(6)]) / pixels
        close(by_entry[:, 0].max(), found.shape[row])
        close(by_entry[:, 1].max(), found.shape_net[row])
        close((by_entry[:, 2] / roots**2).sum(), found.shape_squares[row])  # mirror entries share a change
        direction, matrix = rng.normal(size=6), np.zeros((6, 6))
        matrix[np.triu_indices(6)] = found.shape_metric[row]
        matrix += np.triu(matrix, 1).T
        change = sums(derivatives(model, views, bent(row, direction)))
        close(change[2] / pixels, (direction * roots) @ matrix @ (direction * roots), rtol=1e-4)
        fading = np.array(sums(derivatives(model, views, shifted("opacities", row)))) / pixels
        close(fading, [found.opacity[row], found.opacity_net[row], found.opacity_squares[row]])
        places = [[("sh0", row, c) if k == 0 else ("shN", row, k - 1, c) for c in range(3)] for k in range(9)]
        colour = np.array([[sums(derivatives(model, views, shifted(*at))) for at in band] for band in places]) / pixels
        close(colour[..., 1].max(), found.colour[row])
        close(colour[..., 2].max(axis=1), found.metric[row][diagonal], rtol=1e-4)
    # The squares of a band's basis functions add up to the same value in every direction.
    close(found.colour_squares, found.metric[:, diagonal].sum(axis=1) * 4 * np.pi / 9)


@pytest.mark.long
def test_means_agree_roughly_with_finite_differences():
    model, views = small_scene(degree=0), cameras()
    found = measure_sensitivity(model, views)
    for row in range(len(model)):
        squares = sum(sums(derivatives(model, views, shifted("means", row, axis)))[2] for axis in range(3))
        # The sensitivity ignores the change of size.
        pixels = sum(view.W * view.H for view in views)
        np.testing.assert_allclose(squares / pixels, found.means_squares[row], rtol=0.2)


def test_nothing_cancels_within_a_view_whatever_the_number_of_threads():
    model, views = small_scene(300, 3), cameras(3)
    one, two = (measure_sensitivity(model, views, metric=True, context=Context(threads=threads)) for threads in (1, 2))
    for name in ("colour", "opacity", "shape", "shape_net", "shape_metric", "means_squares", "metric", "views"):
        np.testing.assert_array_equal(getattr(one, name), getattr(two, name), name)
    assert (one.shape >= one.shape_net * (1 - 1e-6)).all()
    assert (one.shape > 1.5 * one.shape_net).any()


@pytest.fixture
def camera_file(tmp_path):
    path = tmp_path / "cameras.json"
    path.write_text(json.dumps([camera.as_json() for camera in cameras(3)]))
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
    assert 400 - facts["unseen"] == encoded.result.report.splat_count
    assert set(range(400)) - set(np.load(index).tolist()) >= set(range(40))
    call("verify", out, "--source", ply, "--source-index", index)


def test_invalid_options_and_cameras_without_splats_in_view_are_refused(tmp_path, sample_path, camera_file):
    out, weights, away = (tmp_path / name for name in ("out.npz", "w.npy", "s.ply"))
    np.save(weights, np.ones(3))
    model = small_scene(20, 1)
    write_ply(away, replace(model, means=model.means + np.float32(1000.0)))
    call("sensitivity", sample_path, out, "--cameras", camera_file, "--data", tmp_path, status=2)
    call("sensitivity", sample_path, "-", status=2)
    done = invoke("encode", sample_path, tmp_path / "o.csplat", "--importance", weights, "-q")
    assert (1, 1) == (done.exit_code, len(done.stderr.splitlines()))
    done = call("sensitivity", away, out, "--cameras", camera_file, "-q", status=1)
    assert "no view shows any splat" in done.stderr
    assert not out.exists()


def test_contradictory_arguments_are_refused_before_the_scene_is_read(tmp_path):
    pruned = {"prune_unseen": True}
    for arguments, message in (
        (pruned, "requires a file of `csplat sensitivity`"),
        ({**pruned, "context": Context(workers=1)}, "requires a file of"),
        ({**pruned, "importance": "w.npy", "target": Target(psnr=30.0)}, "prune_unseen and a target"),
        ({"importance": "w.npy", "context": Context(resume=True)}, "larger than memory"),
    ):  # fmt: skip
        with pytest.raises(InputError, match=message):
            encode_file(str(tmp_path / "missing.ply"), str(tmp_path / "out.csplat"), EncodeOptions(), **arguments)

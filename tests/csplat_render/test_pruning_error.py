# SPDX-License-Identifier: Apache-2.0
"""Tests of csplat_render.pruning_error."""

import itertools
from dataclasses import dataclass, replace

import numpy as np
import pytest
from models import with_facts
from oracle import GROUPS, adversarial, extreme_splats, facing
from sensitivity_cases import scene, small_scene, views
from tables import failures

from csplat.context import Context
from csplat.errors import InputError
from csplat.model import sh_degree_of
from csplat.ply import read_ply
from csplat.scene_metadata import SceneMetadata
from csplat_render.conventions import UncheckedSplats
from csplat_render.pruning_error import measure_pruning_error, pruning_error_exact
from csplat_render.virtual_cameras import virtual_cameras
from csplat_trainer.sensitivity import measure_sensitivity


@pytest.mark.parametrize("measure", [measure_sensitivity, measure_pruning_error])
def test_no_cameras_are_refused(measure):
    with pytest.raises(InputError, match="camera"):
        measure(small_scene(), [])


def relative(error, expected):
    return np.abs(error - expected) / np.maximum(expected, 1e-12)


#: They leave most rows of their boxes empty.
NEEDLES = replace(scene(count=30, seed=4), scales=np.tile(np.float32([-0.5, -6.0, -6.0]), (30, 1)))


@pytest.mark.long
@pytest.mark.parametrize("antialiased", [False, True])
@pytest.mark.parametrize("model", [scene(30), NEEDLES], ids=["usual", "needles"])
def test_pruning_errors_agree_with_removing_splats_one_by_one(model, antialiased):
    model = with_facts(model, antialiased=antialiased)
    options = {"background": (0.2, 0.5, 0.9), "transmittance_min": 0.0}
    expected = pruning_error_exact(model, views(2), np.arange(30), **options)
    found = measure_pruning_error(model, views(2), **options)
    assert relative(found.error, expected)[expected > 1e-6].max() < 1e-4
    assert expected.max() > 0.05
    assert np.count_nonzero(expected) > 20


@pytest.mark.slow
def test_pruning_errors_agree_on_the_sample(sample_path):
    source = read_ply(sample_path)
    model, camera = source.select(slice(0, None, max(1, len(source) // 500))), virtual_cameras(source, 1, 64, 48)
    error = measure_pruning_error(model, camera, transmittance_min=0.0).error
    rows = np.argsort(-error)[:120:40]
    assert relative(error[rows], pruning_error_exact(model, camera, rows, transmittance_min=0.0)).max() < 1e-4


@pytest.mark.slow
def test_only_finished_pixels_are_left_out():
    model = scene(count=60)
    model = replace(model, opacities=np.full(60, 0.97, np.float32), scales=model.scales + np.float32(1.0))
    exact = pruning_error_exact(model, views(1), np.arange(60))
    found = measure_pruning_error(model, views(1)).error
    assert abs(found.sum() / exact.sum() - 1.0) < 2e-2
    assert np.corrcoef(found, exact)[0, 1] > 0.999


def test_a_splat_out_of_view_is_unseen():
    model = scene(count=3)
    found = measure_pruning_error(replace(model, means=model.means + np.float32([[0], [0], [100]])), views(1))
    assert [True, True, False] == found.seen.tolist()
    assert 0.0 == found.error[2]


def test_errors_of_groups_of_views_add_up_in_any_number_of_threads():
    model, cameras = scene(count=50), views(3)
    whole, same = (measure_pruning_error(model, cameras, context=Context(threads=threads)) for threads in (1, 2))
    parts = measure_pruning_error(model, cameras[:1]) + measure_pruning_error(model, cameras[1:])
    np.testing.assert_array_equal(whole.error, same.error)
    np.testing.assert_allclose(whole.error, parts.error, rtol=1e-12)
    assert whole.value_count == parts.value_count
    np.testing.assert_array_equal(whole.seen, parts.seen)


def extreme_cases():
    """Yield a name, arrays, a camera and whether it is antialiased."""
    for name, case in adversarial():
        yield name, case.arrays, case.view, case.antialiased
    for log_scale in (-60.0, 60.0, 88.0, -88.0, 3e38, -3e38):
        for scales in (log_scale, (log_scale, -2.0, -2.0)):
            yield f"scales {scales}", extreme_splats(scales=scales), facing(), False
    for field in ("sh0", "shN"):
        for size in (1e12, 1e25, 3e38):
            arrays = extreme_splats()
            arrays[field] = np.where(arrays[field] > 0.0, size, -size).astype(np.float32)
            yield f"{field} {size}", arrays, facing(), False


def test_errors_of_extreme_splats_are_finite():
    def check(case):
        arrays, view, antialiased = case
        assert np.isfinite(measured(arrays, view, antialiased=antialiased).error).all()

    assert [] == failures({name: case for name, *case in extreme_cases()}, check)


def test_non_finite_rows_are_unseen_and_change_nothing():
    def check(case):
        field, bad = case
        arrays = extreme_splats(count=30)
        clean = measured({name: value[3:] for name, value in arrays.items()}, facing())
        arrays[field].reshape(30, -1)[:3, -1] = bad
        found = measured(arrays, facing())
        assert not found.seen[:3].any()
        np.testing.assert_array_equal(clean.error, found.error[3:])

    cases = itertools.product(GROUPS, (np.nan, np.inf, -np.inf))
    assert [] == failures({f"{field} {bad}": (field, bad) for field, bad in cases}, check)


def measured(arrays, view, *, antialiased=False):
    """Measure arrays that a `SplatModel` would refuse."""
    degree = sh_degree_of(arrays["shN"].shape[1])
    return measure_pruning_error(
        Unchecked(**arrays, sh_degree=degree, metadata=SceneMetadata(antialiased=antialiased)), [view]
    )


@dataclass(frozen=True)
class Unchecked(UncheckedSplats):
    """The fields of a model that `measure_pruning_error` reads, without validation."""

    sh_degree: int
    metadata: SceneMetadata

    def __len__(self):
        return len(self.means)

# SPDX-License-Identifier: Apache-2.0
"""Tests of csplat_trainer.splat_refit."""

from dataclasses import replace

import captures
import numpy as np
import pytest

from csplat.scene import join_blocks
from csplat_render.conventions import UncheckedSplats
from csplat_render.pruning_error import measure_pruning_error
from csplat_render.rasteriser import Rasteriser
from csplat_render.scorer import renderer
from csplat_tools.views import camera_sequence
from csplat_trainer.parameters import Parameters, from_model
from csplat_trainer.splat_refit import refit_splats

pytestmark = pytest.mark.usefixtures("small_views")


def render_all(model, seen_from):
    draw = renderer(model, (0.0, 0.0, 0.0))
    return [draw(camera).rgb for camera in seen_from]


@pytest.fixture(scope="module")
def source():
    return captures.shell_with_hidden_splats()


def test_unseen_splats_are_not_refitted(source):
    cameras = camera_sequence(source, 4, (48, 36))[:1]
    wanted = [picture + np.float32(0.1) for picture in render_all(source, cameras)]
    adjusted = refit_splats(source, cameras, wanted, steps=8)
    seen = measure_pruning_error(source, cameras).seen
    assert 0 < np.count_nonzero(seen) < len(source)
    np.testing.assert_array_equal(source.means, adjusted.means)
    for name in ("opacities", "quats", "scales", "sh0", "shN"):
        np.testing.assert_array_equal(getattr(source, name)[~seen], getattr(adjusted, name)[~seen])
        assert (getattr(source, name)[seen] != getattr(adjusted, name)[seen]).mean() > 0.9


@pytest.mark.slow
def test_centres_move_back_if_a_refit_moves_them(source):
    cameras = camera_sequence(source, 12, (96, 72))
    wanted = render_all(source, cameras)
    sizes = np.exp(source.scales.mean(axis=1, keepdims=True))
    shifted = replace(source, means=source.means + 0.3 * sizes, means_double=None)
    fixed, moved = (refit_splats(shifted, cameras, wanted, steps=120, moves=moves) for moves in (False, True))
    np.testing.assert_array_equal(shifted.means, fixed.means)
    still, adapted = (np.square(np.subtract(render_all(model, cameras), wanted)).mean() for model in (fixed, moved))
    assert adapted < 0.7 * still
    assert (np.abs(moved.means - shifted.means) <= 30 * sizes).all()


@pytest.mark.parametrize("fitted", [0, 5, 16, 37, None])
def test_a_step_fits_the_first_splats_alone(source, fitted):
    (camera,) = camera_sequence(source, 1, (48, 36))
    parameters = Parameters.starting_at(from_model(source, source.sh_degree))
    before = {name: array.copy() for name, array in parameters.values.items()}
    step = parameters.next_step(dict.fromkeys(before, 0.01), fitted_count=fitted)
    splats = UncheckedSplats(**{"opacities" if name == "logits" else name: parameters.values[name] for name in before})
    Rasteriser().refit(splats, camera, np.ones((36, 48, 3), np.float32), step)
    changed = np.zeros(len(source), bool)
    for name, array in parameters.values.items():
        changed |= (array != before[name]).reshape(len(source), -1).any(axis=1)
    count = len(source) if fitted is None else fitted
    assert not changed[count:].any()
    assert not count or changed[:count].any()


def test_a_backdrop_is_shown_and_not_changed(source):
    cameras = camera_sequence(source, 8, (48, 36))
    half, around = (source.select(np.arange(first, len(source), 2)) for first in (0, 1))
    half = replace(half, sh0=half.sh0 + np.float32(0.3))
    wanted = render_all(source, cameras)
    adjusted = refit_splats(half, cameras, wanted, steps=64, backdrop=around, moves=True)
    assert len(half) == len(adjusted)
    errors = [
        np.square(np.subtract(render_all(join_blocks(part, [part, around]), cameras), wanted)).mean()
        for part in (half, adjusted)
    ]
    assert errors[1] < 0.5 * errors[0]
    alone = refit_splats(half, cameras, wanted, steps=64, moves=True)
    assert not np.array_equal(alone.sh0, adjusted.sh0)


def test_alphas_of_a_refit_stay_within_0_and_1(source):
    cameras = camera_sequence(source, 4, (48, 36))
    wanted = render_all(source, cameras)
    extreme = replace(source, opacities=np.where(np.arange(len(source)) % 2, 0.0, 1.0).astype(np.float32))
    adjusted = refit_splats(extreme, cameras, wanted, steps=8)
    assert np.isfinite(adjusted.scales).all()
    assert 0.0 <= adjusted.opacities.min() <= adjusted.opacities.max() <= 1.0

"""Tests of csplat_tools.views.virtual_views."""

from dataclasses import replace

import captures
import numpy as np
import pytest
from captures import views_of

from csplat.encoder import Target
from csplat_render.scene_frame import surface_areas
from csplat_render.scorer import Scorer
from csplat_tools.optimise.simplify import SimplifyOptions, simplify
from csplat_tools.views import (
    VIEW_COUNT,
    VIEW_SIZE,
    camera_sequence,
    default_views,
)

pytest.importorskip("numba", reason="simplification requires the extra [render]")


pytestmark = pytest.mark.usefixtures("small_views")
SMALL = SimplifyOptions(views=12, view_size=(48, 36), effort=1)


@pytest.fixture(scope="module")
def source():
    return captures.shell_with_hidden_splats()


def test_a_sequence_of_cameras_is_a_prefix_of_a_longer_one(source):
    short, long = camera_sequence(source, 5, (40, 30)), camera_sequence(source, 9, (40, 30))
    for one, other in zip(short, long, strict=False):
        np.testing.assert_array_equal(one.viewmat, other.viewmat)
    positions = np.array([camera.position for camera in long])
    assert positions[:, 1].min() < 0.0 < positions[:, 1].max()  # from above and from below


@pytest.mark.slow
def test_exact_errors_prune_better_than_opacity(source):
    check = camera_sequence(source, 6, (64, 48), seed=9)
    judge = Scorer.of_source(source, check, (0, 0, 0))
    views = views_of(camera_sequence(source, 32, (48, 36), seed=3))
    by_error = judge.psnr(simplify(source, Target(keep=0.8), views=views, options=replace(SMALL, refit=False)).model)
    by_opacity = []
    for weights in (1.0, surface_areas(source)):
        least = np.argsort(source.opacities * weights, kind="stable")[: len(source) - round(0.8 * len(source))]
        by_opacity.append(judge.psnr(source.select(np.delete(np.arange(len(source)), least))))
    assert by_error > max(by_opacity) + 3.0


def test_views_of_many_splats_are_larger_and_fewer():
    assert default_views(100_000) == (VIEW_COUNT, VIEW_SIZE)
    assert default_views(10_000_000) == (VIEW_COUNT // 2, (2 * VIEW_SIZE[0], 2 * VIEW_SIZE[1]))
    assert SimplifyOptions().views_and_size(100) == default_views(100)
    assert SimplifyOptions(views=3, view_size=(20, 10)).views_and_size(10_000_000) == (3, (20, 10))

# SPDX-License-Identifier: Apache-2.0
"""Tests of csplat_tools.level_fitting."""

from dataclasses import replace

import numpy as np
import pytest

import csplat
from csplat import LimitError
from csplat.scene import join_blocks
from csplat_render.scene_frame import scene_frame
from csplat_render.scorer import Scorer
from csplat_render.virtual_cameras import virtual_cameras
from csplat_tools.level_fitting import LevelFitter, Work, make_backdrop
from csplat_tools.level_merging import merge_neighbours
from csplat_trainer.merging import light_of


@pytest.fixture(scope="module")
def sample(sample_path):
    return csplat.read(sample_path)


@pytest.mark.long
def test_fitted_levels_look_better_than_merged_ones(sample):
    model, nodes = sample.select(slice(0, 1200)), np.zeros(1200, np.int64)
    others = sample.select(slice(1200, None))
    fitters = LevelFitter(model, make_backdrop(sample, len(sample))), LevelFitter(model)  # with all steps
    levels = merge_neighbours(model, nodes, 300)[1], *(fitter.fit(model, nodes, 300, 1)[1] for fitter in fitters)
    scorer = Scorer.of_source(model, virtual_cameras(model, 3, 96, 72))
    within = Scorer.of_source(sample, virtual_cameras(sample, 3, 96, 72))
    alone = [scorer.psnr(splats) for splats in levels]
    beside = [within.psnr(join_blocks(splats, [splats, others])) for splats in levels]
    assert alone[0] + 0.5 < alone[2]
    assert beside[0] + 0.5 < beside[1]


@pytest.mark.slow
def test_every_node_keeps_a_splat_and_unseen_splats_are_thinned_out(sample):
    # Behind a wall of opaque splats, no camera sees the others.
    rng = np.random.default_rng(0)
    sides, within = rng.normal(size=(300, 3)), rng.uniform(-0.3, 0.3, (100, 3))
    sides = (sides / np.linalg.norm(sides, axis=1, keepdims=True)).astype(np.float32)
    wall = replace(sample.select(np.arange(300)), means=sides, scales=np.full((300, 3), -0.8, np.float32))
    hidden = replace(sample.select(np.arange(100)), means=within.astype(np.float32))
    hidden = replace(hidden, scales=np.full((100, 3), -7.0, np.float32))
    wall.opacities[:], hidden.opacities[:] = 1.0, rng.uniform(0.1, 1.0, 100)
    scene = replace(join_blocks(wall, [wall, hidden]), means_double=None)
    work = Work(splats_to_measure=0.0, views=(8, 8), splats_to_move=0.0, steps=(5, 5))
    kept, splats = LevelFitter(scene, work=work).fit(scene, np.repeat([0, 1, 2], [300, 99, 1]), 100, 1)
    assert len(kept) == len(splats) <= 102
    assert {0, 1, 2} == set(kept)
    assert 12 <= np.count_nonzero(kept == 1) <= 38
    assert splats.opacities[kept == 1].min() >= np.sort(scene.opacities[300:])[-39]


def test_a_backdrop_covers_as_much_as_the_scene_and_does_not_stand_for_the_part(sample):
    backdrop = make_backdrop(sample.select(np.arange(0, len(sample), 2)), len(sample), most=400)
    assert 200 < len(backdrop) <= 400
    assert light_of(backdrop).sum() == pytest.approx(light_of(sample).sum(), rel=0.2)
    part = sample.select(np.arange(1000))
    rest = LevelFitter(part, backdrop)._rest
    assert part.shN.shape[1:] == rest.shN.shape[1:]
    inside = (backdrop.means[:, None] == part.means).all(axis=2).any(axis=1)
    np.testing.assert_array_equal(backdrop.means[~inside], rest.means)
    assert 0 < np.count_nonzero(inside) < len(backdrop)


def test_every_other_view_of_a_coarse_level_of_a_whole_scene_is_farther_away(sample):
    ball = sample.select(slice(0, 500))
    apart = np.where(np.arange(500) % 3, 1.0, 40.0)[:, None]  # a third of the splats is all around the others
    room = replace(ball, means=(ball.means * apart).astype(np.float32), means_double=None)
    assert ["surrounding", "object"] == [scene_frame(room).kind, scene_frame(ball).kind]
    fitter = LevelFitter(room, work=Work(0.0, (8, 8), 0.0, (5, 5)))
    for scene, times in (room, 4.0), (ball, 2.0):
        whole = replace(fitter, scene=scene)
        near, far = (
            [np.linalg.norm(camera.position - scene_frame(scene).centre) for camera in whole._views(level)]
            for level in (1, 3)
        )  # fmt: skip
        np.testing.assert_allclose(np.tile([1.0, times], len(near) // 2), np.divide(far, near))
    assert whole._views(1) is whole._views(2)
    part = replace(fitter, backdrop=make_backdrop(room, len(room)))
    assert part._views(1) is part._views(3)


class Crowded(LevelFitter):
    """A fitter whose scene has too many splats at one place for the renderer."""

    def _fit(self, *_args):
        raise LimitError("MAX_INTERSECTIONS", 2)


def test_merges_splats_that_are_too_many_to_be_rendered(sample):
    model, nodes = sample.select(slice(0, 400)), np.arange(400) // 200
    kept, splats = Crowded(model).fit(model, nodes, 100, 1)
    assert len(kept) == len(splats) == 100
    assert {*nodes} == {*kept}

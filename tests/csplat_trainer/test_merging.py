# SPDX-License-Identifier: Apache-2.0
"""Pairs of splats that are alike: which are found, and how well one splat stands for both."""

from dataclasses import replace

import numpy as np
import pytest
from checked import cloud

from csplat.scene import join_blocks
from csplat_render.scorer import Scorer
from csplat_render.virtual_cameras import virtual_cameras
from csplat_trainer.merging import find_alike, merge_alike
from csplat_trainer.pruning import MeasuredViews, PruningOrder

BLACK = (0.0, 0.0, 0.0)


def splats(count=40, opacity=0.3):
    """Return splats far from each other, in comparison with their sizes."""
    rng = np.random.default_rng(5)
    means = rng.permutation(np.stack(np.meshgrid(*[np.arange(4.0)] * 3), -1).reshape(-1, 3))[:count]
    model = cloud(means, scales=np.log(rng.uniform(0.05, 0.2, (count, 3))).astype(np.float32))
    quats = rng.standard_normal((count, 4)).astype(np.float32)
    return replace(
        model,
        quats=quats / np.linalg.norm(quats, axis=1, keepdims=True),
        opacities=np.full(count, opacity, np.float32),
        sh0=rng.uniform(-1.0, 1.0, (count, 3)).astype(np.float32),
    )


def with_copies(model, rows, *, shift=0.0, opacity=0.3):
    """Return the splats and copies of some, moved along x by a fraction of their largest size."""
    copies = model.select(np.asarray(rows))
    means = copies.means + shift * np.exp(copies.scales.max(axis=1))[:, None] * np.array([1, 0, 0], np.float32)
    opacities = np.full(len(copies), opacity, np.float32)
    return join_blocks(model, [model, replace(copies, means=means.astype(np.float32), opacities=opacities)])


@pytest.mark.parametrize("shift", [0.0, 0.05])
def test_copies_are_found_and_the_splat_with_more_light_stays(shift):
    pairs, mismatch = find_alike(with_copies(splats(), range(10), shift=shift, opacity=0.1))
    assert {(row, 40 + row) for row in range(10)} == set(map(tuple, pairs.T.tolist()))
    assert (mismatch >= 0.1**2 - 1e-6).all()
    assert (mismatch < 0.2).all()


def test_distance_shape_and_opacity_raise_the_mismatch():
    def mismatch(first, second):
        found = find_alike(join_blocks(first, [first, second]))[1]
        return found[0] if len(found) else 1.0

    one = replace(splats(1, opacity=0.1), scales=np.log([[0.1, 0.1, 0.1]]).astype(np.float32))
    longer = replace(one, scales=np.log([[0.13, 0.1, 0.1]]).astype(np.float32))
    opaque = replace(one, opacities=np.array([0.9], np.float32))
    moved = replace(one, means=one.means + np.array([[0.03, 0.0, 0.0]], np.float32))
    assert mismatch(one, one) == pytest.approx(0.01)
    assert mismatch(one, moved) == pytest.approx(0.01 + 0.3**2)
    relative = (0.13**2 - 0.1**2) ** 2 / np.sqrt(3 * 0.1**4 * (0.13**4 + 2 * 0.1**4))
    assert mismatch(one, longer) == pytest.approx(0.01 + relative)
    assert mismatch(opaque, opaque) == pytest.approx(0.81)
    assert mismatch(one, replace(one, means=one.means + 1.0)) == 1.0


@pytest.mark.parametrize("count", [0, 1, 2])
def test_few_and_extreme_splats_are_no_pairs(count):
    model = splats(count)
    assert find_alike(model)[0].shape == (2, 0)
    if count:
        sizes = np.linspace(-88.0, 88.0, count, dtype=np.float32)[:, None] * np.ones((1, 3), np.float32)
        extreme = replace(model, scales=sizes, means=(1e30 * model.means).astype(np.float32))
        assert find_alike(extreme)[0].shape == (2, 0)
        twice = find_alike(with_copies(extreme, range(count)))[0]
        assert twice.shape == (2, count)


def test_a_merged_splat_has_the_image_of_both():
    model = splats()
    both = with_copies(model, range(20), shift=0.05)
    cameras = virtual_cameras(both, 4, 160, 120)
    pairs = find_alike(both)[0]
    merged = merge_alike(both, pairs).select(np.setdiff1d(np.arange(len(both)), pairs[1]))
    scorer = Scorer.of_source(both, cameras, BLACK)
    assert len(merged) == len(model)
    np.testing.assert_array_equal(both.means[:40], merged.means)
    assert scorer.psnr(merged) > scorer.psnr(model) + 10.0


def test_copies_are_merged_before_visible_splats_are_pruned():
    both = with_copies(splats(), range(12), shift=0.02)
    groups = [MeasuredViews.of(both, virtual_cameras(both, 6, 160, 120), BLACK)]
    order = PruningOrder(both, groups, BLACK, merges=True)
    rows = order.kept(40)
    is_merged = order.partners[:12] >= 0
    assert is_merged.sum() >= 8  # the others hardly show
    pairs = np.sort([order.rows[:12][is_merged], order.partners[:12][is_merged]], axis=0)
    np.testing.assert_array_equal(pairs[0] + 40, pairs[1])
    merged = order.merge(both, np.arange(len(both)), 0, 12).select(rows)
    alone = PruningOrder(both, groups, BLACK)
    scorer = Scorer.of_source(both, virtual_cameras(both, 5, 160, 120, seed=1), BLACK)
    assert scorer.psnr(merged) > scorer.psnr(both.select(alone.kept(40))) + 6.0
    # In two parts the values are the same.
    part = order.merge(both, np.arange(len(both)), 0, 5)
    again = order.merge(part, np.arange(len(both)), 5, 12).select(rows)
    np.testing.assert_array_equal(merged.opacities, again.opacities)

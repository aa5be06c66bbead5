# SPDX-License-Identifier: Apache-2.0
"""Tests of csplat_tools.level_merging."""

import math

import numpy as np
import pytest
from checked import cloud
from hypothesis import given, settings
from hypothesis import strategies as st

from csplat_tools.level_merging import merge_neighbours


def splats_at(means, opacities, log_sizes, colours):
    """Return round splats without SH."""
    opacities, colours = np.array(opacities, np.float32), np.array(colours, np.float32)
    return cloud(np.array(means), np.exp(log_sizes), opacities=opacities, sh0=colours)


def test_merged_splats_keep_mean_covariance_and_light():
    # Two equal splats next to each other, on the x axis: variance 1 + 1 along it.
    two = splats_at([[-1, 0, 0], [1, 0, 0]], [0.25, 0.25], [0.0, 0.0], [[1, 0, 0], [0, 1, 0]])
    nodes, one = merge_neighbours(two, np.array([7, 7]), 1)
    assert ([7], 1) == (nodes.tolist(), len(one))
    assert ([0.0, 0.0, 0.0], [0.5, 0.5, 0.0]) == (one.means[0].tolist(), one.sh0[0].tolist())
    assert np.sort(np.exp(one.scales[0])) == pytest.approx([1.0, 1.0, math.sqrt(2.0)], rel=1e-6)
    area = (2.0 * math.sqrt(2.0) + 1.0) / 3.0
    assert one.opacities[0] == pytest.approx(2 * 0.25 / area, rel=1e-6)


def test_merged_splats_grow_by_half_of_what_no_opacity_can_carry():
    # Four times the light of an opaque splat at one place: opacity 0.99, twice the area.
    four = splats_at([[0, 0, 0]] * 4, [0.99] * 4, [0.0] * 4, [[0, 0, 0]] * 4)
    one = merge_neighbours(four, np.zeros(4, np.int64), 1)[1]
    assert np.float32(0.99) == one.opacities[0]
    assert np.exp(2.0 * one.scales[0]) == pytest.approx([2.0] * 3, rel=1e-5)


def test_pairs_that_look_alike_are_merged_first_and_never_across_nodes():
    # Four in a row: the two red ones, although the blue one is as near, and no red one of another node.
    red, blue = [1, 0, 0], [-1, -1, 1]
    row = splats_at([[x, 0, 0] for x in range(4)], [0.5] * 4, [-0.5] * 4, [blue, red, red, blue])
    for nodes, count, places in (([0, 0, 0, 0], 3, [0.0, 1.5, 3.0]), ([0, 0, 1, 1], 1, [0.5, 2.5])):
        kept, merged = merge_neighbours(row, np.array(nodes), count)
        assert sorted({*nodes}) == sorted({*kept.tolist()})
        assert places == sorted(merged.means[:, 0].tolist())


@pytest.mark.slow
@settings(max_examples=30)
@given(seed=st.integers(0, 1000), count=st.integers(1, 60), spread=st.sampled_from([0.0, 1e-3, 1.0, 1e5]))
def test_any_splats_are_merged_to_the_number_asked_for(seed, count, spread):
    # Also at one place or far apart, without opacity, huge or tiny.
    rng = np.random.default_rng(seed)
    means, opacities = rng.normal(size=(60, 3)) * spread, rng.choice([0.0, 0.003, 1.0], 60)
    scene = splats_at(means, opacities, rng.uniform(-20, 20, 60), rng.normal(size=(60, 3)) * 3.0)
    nodes, splats = merge_neighbours(scene, np.zeros(60, np.int64), count)
    assert count == len(splats) == len(nodes)
    for name in ("means", "quats", "scales", "opacities", "sh0"):
        assert np.isfinite(getattr(splats, name)).all()
    assert splats.opacities.max(initial=0.0) <= 1.0

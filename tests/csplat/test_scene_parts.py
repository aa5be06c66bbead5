# SPDX-License-Identifier: Apache-2.0
"""Tests of csplat.scene_parts, and of what the encoder makes of parts far from each other."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from checked import cloud, encoded
from editing_cases import merge

import csplat
from csplat import EncodeOptions
from csplat.scene_parts import find_parts, part_of

RNG = np.random.default_rng(0)


def cluster(count=900, radius=1.0, centre=(0.0, 0.0, 0.0)):
    directions = RNG.normal(size=(count, 3))
    directions *= radius / np.linalg.norm(directions, axis=1)[:, None]
    return directions * RNG.random((count, 1)) ** (1 / 3) + np.array(centre)


def dome(count, radius):
    directions = RNG.normal(size=(count, 3))
    return directions * radius / np.linalg.norm(directions, axis=1)[:, None]


def together(*points):
    return np.concatenate(points)


PIECES = {  # how many parts have at least a tenth of the splats, the rest included
    "one cluster": (1, cluster()),
    "few splats": (1, cluster(30)),
    "equal means": (1, np.zeros((500, 3))),
    "two that touch": (1, together(cluster(), cluster(centre=(2, 0, 0)))),
    "an outlier": (1, together(cluster(), [[1e6, 0, 0]])),
    "outliers on all sides": (1, together(cluster(), dome(5, 1000))),
    "a density that falls": (1, cluster(3000) * 10.0 ** RNG.uniform(-1, 1, (3000, 1))),
    "two far ones": (2, together(cluster(), cluster(centre=(8, 0, 0)))),
    "two very far ones": (2, together(cluster(), cluster(centre=(1e7, 0, 0)))),
    "one small and dense": (2, together(cluster(2000), cluster(250, 0.1, (0, 30, 0)))),
    "a dome of large radius": (2, together(cluster(600), dome(300, 500))),
    "a dome of most splats": (2, together(cluster(300), dome(600, 20))),
    "less apart than a splat is large": (1, together(1e-30 * cluster(300), cluster(300, 0.05))),
    "a few between them": (2, together(cluster(), cluster(centre=(50, 0, 0)), RNG.uniform(0, 50, (20, 3)))),
    "five in a row": (5, together(*(cluster(300, centre=(20 * i, 0, 0)) for i in range(5)))),
}


def test_parts_are_what_has_much_more_space_around_it_than_within():
    found = {}
    for name, (_, points) in PIECES.items():
        parts = find_parts(points, np.full((len(points), 3), math.log(0.02), np.float32))
        index = part_of(points.astype(np.float32), parts)
        found[name] = int((np.bincount(index) >= len(points) / 10).sum())
    assert {name: count for name, (count, _) in PIECES.items()} == found


PARTS = (cluster(), cluster(700, 0.1, (300, 0, 0)), cluster(800, 10.0, (0, 500, 0)))
SIZES = (0.03, 0.003, 0.3)


@pytest.fixture(scope="module")
def far():
    return cloud(together(*PARTS), np.repeat(SIZES, [len(part) for part in PARTS])[:, None])


def alone(preset, number):
    return encoded(cloud(PARTS[number], SIZES[number]), preset=preset)[0].largest_error("means")


def errors_of_parts(source, result, decoded):
    """Return the largest error of means in each of `PARTS`."""
    moved = np.linalg.norm(decoded.means.astype(np.float64) - source.means[result.source_index], axis=1)
    number = np.repeat(range(len(PARTS)), [len(part) for part in PARTS])[result.source_index]
    return [float(moved[number == part].max()) for part in range(len(PARTS))]


def test_each_part_has_the_step_that_it_has_alone(far):
    for preset in ("fast", "balanced", "small"):
        for options in ({}, {"bucket_splats": 1000}):
            result, decoded = encoded(far, preset=preset, **options)
            for number, error in enumerate(errors_of_parts(far, result, decoded)):
                assert 0.4 < error / alone(preset, number) < 1.6, (preset, options, number)
            assert () == result.report.notes
    assert np.allclose(errors_of_parts(far, *encoded(far, position_step=0.01)), 0.0087, rtol=0.1)


def test_coarse_levels_have_the_steps_of_their_parts(far):
    data = csplat.encode(far, EncodeOptions(), levels="merged")
    with csplat.open(data) as file:
        step = file.header.attribute(4).step
        steps = [np.ldexp(step, tile.exponent) for tile in file.header.all_tiles]
    assert min(steps) < max(steps) / 30


def test_steps_that_are_coarse_for_small_splats_are_noted():
    nested = cloud(cluster(4000) * (radii := 10.0 ** RNG.uniform(-2, 2, (4000, 1))), 0.03 * radii)
    (note,) = encoded(nested)[0].report.notes
    assert note.startswith("means: errors of up to ")
    assert "bound the error of means" in note
    assert not any("blurs" in text for text in encoded(nested, position_error=1e-4)[0].report.notes)


def test_scenes_are_merged_with_their_steps_or_not_at_all():
    def merged(distance):
        files = [encoded(replace(cloud(cluster()), origin=(place, 0.0, 0.0)))[0].data for place in (0.0, distance)]
        return files, merge(*files)[1]

    files, data = merged(1e4)
    largest = [csplat.decode_scene(file).declared_bounds.records[0].max for file in (*files, data)]
    assert largest[2] < 2.0 * max(largest[:2])
    with pytest.raises(csplat.InputError, match="stay files of their own"):
        merged(1e6)

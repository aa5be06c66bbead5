# SPDX-License-Identifier: Apache-2.0
"""Tests of csplat.encoder.levels.

Also: csplat.encoder.container.
"""

import math
from dataclasses import replace

import numpy as np
import pytest

import csplat
from csplat import InputError, decode, read_header
from csplat.encoder import EncodeOptions, EncodePlan
from csplat.encoder.levels import LevelNode, encode_levels
from csplat_conformance.validator import validate
from csplat_tools.level_builder import kd_groups
from csplat_tools.level_errors import measure_errors
from csplat_tools.level_merging import merge_neighbours

pytestmark = pytest.mark.usefixtures("little_level_work")

SPLATS = 400
ARRAYS = ("means", "quats", "scales", "opacities", "sh0", "shN")


@pytest.fixture(scope="module")
def model(sample_path):
    return csplat.read(sample_path).select(slice(0, SPLATS))


def quarter(splats):
    return merge_neighbours(splats, np.zeros(len(splats), np.int64), math.ceil(len(splats) / 4))[1]


@pytest.mark.slow
@pytest.mark.parametrize("options", [
    {}, {"preset": "small"}, {"preset": "fast", "sh_degree": 0}, {"means_coding": "axis"},
])  # fmt: skip
def test_level_0_of_a_file_is_the_scene_with_the_errors_of_a_plain_file(model, options):
    options, leaves = EncodeOptions(**options), kd_groups(model.means, 4)
    plain, plan = csplat.encode_with_report(model, options), EncodePlan.of(model, options)
    halves = [quarter(model.select(np.concatenate(leaves[at : at + 2]))) for at in (0, 2)]
    nodes = [LevelNode(0, 4 + number // 2, rows=rows) for number, rows in enumerate(leaves)]
    nodes += [LevelNode(1, 6, splats=half, error=error) for half, error in zip(halves, (0.5, 0.25), strict=True)]
    nodes.append(LevelNode(2, None, splats=quarter(halves[0]), error=1.0))
    data = encode_levels(plan, nodes).write().data
    cut = encode_levels(plan, [LevelNode(0, None, rows=rows) for rows in leaves]).write()
    assert () == read_header(cut.data).coarse_tiles  # leaves alone are no levels
    assert () == tuple(validate(data).violations) == tuple(validate(cut.data).violations)
    whole, other = decode(data), decode(cut.data)
    assert all(np.array_equal(getattr(whole, name), getattr(other, name)) for name in ARRAYS)
    for measure, pair in plain.report.errors.items():
        assert cut.report.errors[measure] == pytest.approx(pair, rel=0.2), measure
    assert np.array_equal(np.sort(cut.source_index), np.arange(len(model)))


def test_refuses_leaves_that_are_not_the_scene(model):
    plan = EncodePlan.of(model)
    with pytest.raises(InputError, match="the leaves do not hold each splat"):
        encode_levels(plan, [LevelNode(0, None, rows=np.arange(5))])
    nodes = [LevelNode(0, 1, rows=np.arange(len(model))), LevelNode(0, None, rows=np.arange(0))]
    with pytest.raises(InputError, match="the parent of a node of level 0 has level 0"):
        encode_levels(plan, nodes)


@pytest.mark.slow
def test_a_node_with_many_splats_below_is_compared_with_a_finer_level(model):
    """The error of that level is added, so that the result is no smaller than if it were compared with level 0."""
    faint = np.arange(SPLATS) % 2 == 0
    scene = replace(model, opacities=np.where(faint, np.float32(0.2), model.opacities), extra={})
    leaves = kd_groups(scene.means, 4)
    rows = [np.concatenate(leaves[at : at + 2]) for at in (0, 2)]
    root = scene.select(~faint)
    nodes = [LevelNode(0, 4 + number // 2, rows=part) for number, part in enumerate(leaves)]
    nodes += [LevelNode(1, 6, splats=scene.select(part[~faint[part]])) for part in rows]
    nodes.append(LevelNode(2, None, splats=replace(root, scales=root.scales + np.float32(0.1))))
    encoded = encode_levels(EncodePlan.of(scene), nodes)
    exact, bounded = (measure_errors(encoded, reference_splats=count) for count in (SPLATS, 250))
    errors, others = ([node.error for node in one.nodes] for one in (exact, bounded))
    assert 0.0 < max(errors[4:6]) <= errors[6] < others[6] < 16.0 * errors[6]
    assert errors[:6] == others[:6]
    data = exact.write().data
    assert () == tuple(validate(data).violations)
    assert errors == [node.error for node in csplat.open(data).nodes]


@pytest.mark.slow
def test_a_node_that_is_its_splats_has_the_smallest_error(model):
    """A parent with the splats of its only child looks like it at every pixel size."""
    rows = np.arange(len(model))
    nodes = [LevelNode(0, 1, rows=rows), LevelNode(1, None, splats=replace(model, extra={}))]
    encoded = encode_levels(EncodePlan.of(model), nodes)
    with csplat.open(encoded.write().data) as file:
        low, high = file.boxes[0]
    radius = np.linalg.norm(high - low) / 2
    assert measure_errors(encoded).nodes[1].error == pytest.approx(radius / 256, rel=1e-6)

# SPDX-License-Identifier: Apache-2.0
"""Tests of csplat.encoder.target.

Also: csplat.encoder.error_targets, csplat.sizes.
"""

from dataclasses import replace

import numpy as np
import pytest
from captures import shell
from checked import measure_errors

from csplat import EncodeOptions, decode, encode
from csplat.encode_api import encode_with_report
from csplat.encoder import Target
from csplat.errors import InputError
from csplat_conformance.validator import validate

pytestmark = pytest.mark.usefixtures("small_views")


@pytest.fixture(scope="module")
def scene():
    return shell(8)


@pytest.mark.slow
def test_impossible_bounds_are_refused(scene):
    for measure, bound in (("opacities", 1e-9), ("opacities", 1e-310), ("covariance", 1e-310)):
        for more in ({}, {"size": 10**6}):
            with pytest.raises(InputError, match=f"no lattice keeps the error of {measure} within {bound:g}"):
                encode(scene, target=Target(max_error={measure: bound}, **more))


@pytest.mark.parametrize(
    ("asked", "message"),
    [
        ({}, "no target"), ({"size": 1000, "psnr": 40.0}, "one of them"),
        ({"keep": 0.5, "max_psnr_drop": 1.0}, "one of them"), ({"keep": 0.5, "max_error": {"means": 1.0}}, "no bounds"),
        ({"max_psnr_drop": 0.5, "max_error": {"means": 1.0}}, "no bounds"), ({"size": 0}, "expected bytes"),
        ({"psnr": 99.5}, "at most 99"), ({"psnr": float("nan")}, "above 0"), ({"max_psnr_drop": 0.0}, "0.001 to 60"),
        ({"max_psnr_drop": 1e-16}, "0.001 to 60"), ({"max_psnr_drop": 4000.0}, "0.001 to 60"),
        ({"keep": 1.5}, "at most 1"), ({"keep": 0.0}, "above 0"), ({"psnr": -1.0}, "above 0"),
        ({"keep": 0.5, "psnr": 40.0}, "one of them"), ({"keep": 0.5, "prune": False}, "excludes prune"),
        ({"psnr": 40.0, "effort": 0}, "1 to 5"), ({"psnr": 40.0, "effort": "3"}, "expected a number"),
    ],
)  # fmt: skip
def test_invalid_targets_are_refused(asked, message):
    with pytest.raises(InputError, match=message):
        Target(**asked)


@pytest.mark.slow
@pytest.mark.parametrize("bounds", [
    {"means": 1e-4}, {"opacities": 0.004, "covariance": 0.02}, {"sh0": 0.01}, {"sh1": 0.02, "sh2": 0.05},
    {"sh4": 0.02},
])  # fmt: skip
def test_bounds_hold_for_every_splat(scene, make_model, bounds):
    source = make_model(300, 4) if "sh4" in bounds else scene
    found = encode_with_report(source, target=Target(max_error=bounds))
    proof = measure_errors(source, decode(found.data), found.source_index)
    for name, bound in bounds.items():
        assert 0.3 * bound < proof[name][0] <= bound
        assert found.report.search.reached[name] == found.report.errors[name][0] <= bound
    assert (300, 0) == (found.report.search.splats, found.report.search.renders)


def placed(scene, means, **changes):
    """Return splats of a scene at other places."""
    return replace(scene.select(np.arange(len(means)) % len(scene)), means=means.astype(np.float32), **changes)


@pytest.mark.slow
def test_position_error_holds_or_is_refused(scene):
    """Half a step per axis is within it, but decoded means are rounded to float32, by up to another half."""
    unit = np.random.default_rng(1).random((60, 3))
    doubles = np.array([4e5, 5e6, 100.0]) + 2000.0 * unit
    origin = tuple(doubles.mean(axis=0))
    huge = np.array([[3.4e38, 2.9e24, -1.0], *np.tile(20.0 * unit, (2, 1))])
    far = placed(scene, doubles * 8 - origin, means_double=doubles * 8, origin=origin)
    for name, model, bound in (
        ("near", placed(scene, 20.0 * unit), 1e-4),
        ("rounded by float32", placed(scene, 500.0 + 500.0 * unit), 1e-4),
        ("at the end of float32", placed(scene, (unit - 0.5) * 6.8e38), 1e31),
        ("doubles", placed(scene, doubles - origin, means_double=doubles, origin=origin), 1e-4),
        ("an outlier on an axis", placed(scene, np.array([[3.4e38, 0.0, 0.0], *(20.0 * unit)])), 1e-4),
    ):
        found = encode_with_report(model, EncodeOptions(position_error=bound))
        largest, _ = measure_errors(model, decode(found.data), found.source_index)["means"]
        assert 0.0 < largest <= found.report.errors["means"][0] <= bound, name
        assert () == validate(found.data).violations, name
    options = EncodeOptions(position_error=1e-4)
    asked = [(options, None), (replace(options, bucket_splats=100), None), (options, Target(psnr=30.0))]
    asked += [(None, Target(max_error={"means": 1e-4})), (None, Target(psnr=30.0, max_error={"means": 1e-4}))]
    for model, message in (
        (placed(scene, huge), r"within 0.0001: the best possible is 2.9e\+24, for a splat 3.4e\+38 from the .* allow"),
        (far, "the best possible is 2, for a splat 3.5e"),
    ):
        for how, target in asked:
            with pytest.raises(InputError, match=message):
                encode(model, how, target=target)

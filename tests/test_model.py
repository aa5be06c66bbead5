"""`SplatModel`: its fields, checks and selections."""

import time
from dataclasses import replace

import numpy as np
import pytest

from csplat.errors import InputError
from csplat.model import SplatModel, normalise_quats


def test_fields_have_defaults(make_model):
    model = make_model(4, 0)
    bare = SplatModel(
        means=model.means, quats=model.quats, scales=model.scales, opacities=model.opacities, sh0=model.sh0
    )
    assert (4, 0, 3) == bare.shN.shape
    assert (0.0, 0.0, 0.0) == bare.origin
    assert "unspecified" == bare.coordinate_system
    assert (None, None) == (bare.unit_metres, bare.cameras)
    assert (False, False) == (bare.antialiased, bare.flat)
    assert ({}, {}) == (dict(bare.metadata), dict(bare.extra))


def test_sh_degree_and_length_follow_from_the_shapes(make_model):
    assert [0, 1, 2, 3] == [make_model(5, degree).sh_degree for degree in range(4)]
    assert (7, 0) == (len(make_model(7)), len(make_model(0)))
    assert "SplatModel(7 splats, sh_degree=2)" == repr(make_model(7, 2))


@pytest.mark.parametrize(("field", "value", "message"), [
    ("means", np.zeros((10, 2), np.float32), r"means has shape \[10, 2\]"),
    ("means", np.float32(1), "means is a float32, expected a float32 array"),
    ("quats", np.zeros((10, 3), np.float32), r"quats has shape \[10, 3\], expected \[10, 4\]"),
    ("scales", np.zeros((9, 3), np.float32), r"scales has shape \[9, 3\], expected \[10, 3\]"),
    ("opacities", np.zeros((10, 1), np.float32), "opacities has shape"),
    ("sh0", np.zeros((10, 3)), "sh0 is float64, expected float32"),
    ("sh0", np.zeros((10, 3), ">f4"), "sh0 is >f4, expected float32"),
    ("shN", np.zeros((10, 4, 3), np.float32), "4 coefficients per channel, expected 0, 3, 8"),
    ("shN", np.zeros((10, 24, 3), np.float32), "24 coefficients"),
    ("shN", np.zeros((10, 45), np.float32), "shN has shape"),
    ("opacities", np.full(10, 1.5, np.float32), "alpha in .0, 1."),
    ("opacities", np.full(10, -0.1, np.float32), "not logits"),
    ("quats", np.zeros((10, 4), np.float32), "10 rows that are not of unit length"),
    ("quats", np.full((10, 4), 1e30, np.float32), "10 rows that are not of unit length"),
    ("origin", (1.0, 2.0), "expected three numbers"),
    ("origin", (1.0, 2.0, float("nan")), "expected finite numbers"),
    ("coordinate_system", "XYZ", "the axes are 'XYZ'"),
    ("coordinate_system", "RLU", "the axes are 'RLU'"),
    ("coordinate_system", "RDFF", "the axes are 'RDFF'"),
    ("unit_metres", 0.0, "unit_metres is 0.0"),
    ("unit_metres", float("inf"), "unit_metres is inf"),
    ("extra", {"id": np.zeros(9)}, "extra column 'id' is not an array of 10"),
    ("extra", {"id": np.zeros(10, bool)}, "extra column 'id' is bool"),
])  # fmt: skip
def test_invalid_fields_are_refused(make_model, field, value, message):
    with pytest.raises(InputError, match=message):
        make_model(10, **{field: value})


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("field", ["means", "quats", "scales", "opacities", "sh0", "shN"])
def test_values_that_are_not_finite_are_refused(make_model, field, value):
    array = getattr(make_model(), field).copy()
    array.flat[-1] = value
    with pytest.raises(InputError, match=f"{field} contains 1 values that are NaN or infinite"):
        make_model(**{field: array})


def test_values_at_their_limits_are_accepted(make_model):
    means = np.full((10, 3), 3e38, np.float32)  # their sum overflows
    assert np.array_equal(make_model(means=means).means, means)
    assert 2 == len(make_model(2, opacities=np.array([0, 1], np.float32)))
    assert (1e7, 2.0, 3.0) == make_model(origin=np.array([1e7, 2, 3])).origin
    for letters in ("RDF", "RUB", "LUF", "FRU", "BLD"):
        assert letters == make_model(coordinate_system=letters).coordinate_system


def with_doubles(make_model):
    doubles = np.random.default_rng(1).normal(0, 1, (10, 3)) + np.array([5e5, 5e6, 300.0])
    origin = (5e5, 5e6, 300.0)
    means = (doubles - np.array(origin)).astype(np.float32)
    return make_model(10, 0, means=means, origin=origin, means_double=doubles)


def test_doubles_have_to_match_their_means(make_model):
    model = with_doubles(make_model)
    some = model.select(np.array([3, 1]))
    np.testing.assert_array_equal(model.means_double[[3, 1]], some.means_double)
    assert replace(model, means=model.means + 1, means_double=None).means_double is None
    for wrong in ({"means": model.means + 1}, {"origin": (0.0, 0.0, 0.0)}, {"means_double": model.means}):
        with pytest.raises(InputError, match="means_double"):
            replace(model, **wrong)


def test_arrays_are_not_copied(make_model):
    model = make_model()
    again = make_model(means=model.means)
    assert again.means is model.means


@pytest.mark.parametrize("index", [slice(2, 5), np.array([4, 1, 1]), np.arange(10) % 3 == 0, slice(0, 0)])
def test_select_keeps_rows_of_every_array(make_model, index):
    model = make_model(10, extra={"id": np.arange(10)}, origin=(1.0, 2.0, 3.0), coordinate_system="RDF")
    part = model.select(index)
    for name in ("means", "quats", "scales", "opacities", "sh0", "shN"):
        assert np.array_equal(getattr(part, name), getattr(model, name)[index])
    assert np.array_equal(part.extra["id"], model.extra["id"][index])
    assert (model.origin, model.coordinate_system) == (part.origin, part.coordinate_system)


def test_normalised_quats_have_unit_length_and_stay_unchanged():
    rng = np.random.default_rng(1)
    quats = (rng.standard_normal((10_000, 4)) * rng.choice([1e-30, 1, 1e30], (10_000, 1))).astype(np.float32)
    once = normalise_quats(quats)
    length = np.sqrt(np.sum(once.astype(np.float64) ** 2, 1))
    assert np.abs(length - 1).max() < 2**-23
    assert np.array_equal(normalise_quats(once), once)


def test_zero_huge_and_denormal_quats_are_normalised():
    quats = np.array([[0, 0, 0, 0], [3e38, 0, 3e38, 0], [0, 1e-45, 0, 0], [0, 0, 0, -2]], np.float32)
    half = np.float32(np.sqrt(0.5))
    expected = [[1, 0, 0, 0], [half, 0, half, 0], [0, 1, 0, 0], [0, 0, 0, -1]]
    assert np.array_equal(normalise_quats(quats), np.array(expected, np.float32))


@pytest.mark.slow
def test_checking_a_million_splats_takes_a_fraction_of_a_second():
    count = 1_000_000
    fields = {
        "means": np.ones((count, 3), np.float32),
        "quats": np.full((count, 4), 0.5, np.float32),
        "scales": np.ones((count, 3), np.float32),
        "opacities": np.ones(count, np.float32),
        "sh0": np.ones((count, 3), np.float32),
        "shN": np.ones((count, 15, 3), np.float32),
    }
    times = []
    for _ in range(3):
        start = time.process_time()
        SplatModel(**fields)
        times.append(time.process_time() - start)
    assert min(times) < 0.15

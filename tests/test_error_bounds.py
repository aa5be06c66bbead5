"""Measured errors agree with the definition in the spec, computed here splat by splat."""

from dataclasses import replace

import numpy as np
import pytest
from checked import measure_errors

from csplat.encoder.error_bounds import ErrorSums
from csplat.errors import InputError
from csplat.model import normalise_quats


def covariance(quat: np.ndarray, scales: np.ndarray) -> np.ndarray:
    w, x, y, z = quat.astype(np.float64) / np.linalg.norm(quat.astype(np.float64))
    rotation = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )
    return rotation @ np.diag(np.exp(2.0 * scales.astype(np.float64))) @ rotation.T


def disturbed(model, amount: float):
    rng = np.random.default_rng(1)

    def near(values: np.ndarray) -> np.ndarray:
        return (values + rng.normal(0, amount, values.shape)).astype(np.float32)

    return replace(
        model,
        means=near(model.means),
        quats=normalise_quats(near(model.quats)),
        scales=near(model.scales),
        opacities=np.clip(near(model.opacities), 0, 1),
        sh0=near(model.sh0),
        shN=near(model.shN),
    )


def test_agrees_with_the_definition(make_model):
    source = make_model(60, 2)
    index = np.random.default_rng(0).permutation(60)[:50]
    decoded = disturbed(source.select(index), 0.05)
    measured = measure_errors(source, decoded, index)
    distances = np.linalg.norm(source.means[index].astype(np.float64) - decoded.means, axis=1)
    relative = []
    for i, j in enumerate(index):
        wanted, found = (covariance(m.quats[k], m.scales[k]) for m, k in ((source, j), (decoded, i)))
        relative.append(np.linalg.norm(wanted - found) / np.linalg.norm(wanted))
    expected = {"means": distances, "covariance": np.array(relative)}
    for name, errors in expected.items():
        assert (errors.max(), np.sqrt(np.mean(errors**2))) == pytest.approx(measured[name], rel=1e-6)
    band = (source.shN[index, 3:8] - decoded.shN[:, 3:8]).astype(np.float64)
    assert (np.abs(band).max(), np.sqrt((band**2).sum() / 50)) == pytest.approx(measured["sh2"], rel=1e-6)
    assert {"means", "covariance", "opacities", "sh0", "sh1", "sh2"} == set(measured)


def test_covariance_errors_do_not_depend_on_the_description(make_model):
    source = make_model(40, 0)
    turned = replace(
        source,
        quats=np.stack([-source.quats[:, 1], source.quats[:, 0], source.quats[:, 3], -source.quats[:, 2]], axis=1),
    )
    assert measure_errors(source, turned, np.arange(40))["covariance"][0] < 1e-5


@pytest.mark.parametrize("size", [-60, 60])
def test_covariance_errors_survive_extreme_scales(make_model, size):
    source = make_model(40, 0)
    source = replace(source, scales=np.full((40, 3), size, np.float32))
    largest = measure_errors(source, replace(source, scales=source.scales + np.float32(0.125)), np.arange(40))
    assert pytest.approx(np.exp(0.25) - 1, rel=1e-4) == largest["covariance"][0]


def test_a_band_that_only_one_model_has_is_measured_against_zero(make_model):
    source = make_model(20, 2)
    cut = replace(source, shN=source.shN[:, :3])
    for first, second in ((source, cut), (cut, source)):
        largest = measure_errors(first, second, np.arange(20))["sh2"][0]
        assert largest == pytest.approx(float(np.abs(source.shN[:, 3:]).max()))


def test_sums_add_up_in_parts(make_model):
    source = make_model(50, 1)
    decoded = disturbed(source, 0.01)
    whole = measure_errors(source, decoded, np.arange(50))
    halves = [measure_errors(source, decoded.select(part), np.arange(50)[part]) for part in (slice(25), slice(25, 50))]
    assert whole["means"][0] == max(half["means"][0] for half in halves)
    assert ErrorSums().bounds() == {}


@pytest.mark.parametrize("index", [np.arange(9), np.arange(10) - 1, np.arange(10) + 1])
def test_refuses_an_index_that_does_not_fit(make_model, index):
    model = make_model(10, 0)
    with pytest.raises(InputError, match="source index"):
        measure_errors(model, model, index)

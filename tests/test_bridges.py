"""`from_gsplat` and `to_gsplat`: what trainers hold, as arrays and as tensors, in both forms."""

import sys
from dataclasses import replace

import numpy as np
import pytest

import csplat
from csplat.errors import InputError

NAMES = ("means", "quats", "scales", "opacities", "sh0", "shN")


@pytest.fixture
def model(make_model):
    made = make_model(20, 2)
    made.opacities[:2] = 0.0, 1.0
    return made


def assert_near(a, b):
    for name in NAMES:
        assert np.allclose(getattr(a, name), getattr(b, name), rtol=1e-6, atol=2e-7), name


def test_parameters_are_logarithms_and_logits(model):
    splats = csplat.to_gsplat(model)
    assert NAMES == tuple(splats)
    assert [(20, 3), (20, 4), (20, 3), (20,), (20, 1, 3), (20, 8, 3)] == [splats[name].shape for name in NAMES]
    assert np.array_equal(model.scales, splats["scales"])
    assert np.allclose(1.0 / (1.0 + np.exp(-splats["opacities"].astype(np.float64))), model.opacities, atol=1e-7)
    assert np.isfinite(splats["opacities"]).all()


def test_the_activated_form_is_what_rasterization_takes(model):
    splats = csplat.to_gsplat(model, form="activated")
    assert np.allclose(np.exp(model.scales), splats["scales"], rtol=1e-6)
    assert np.array_equal(model.opacities, splats["opacities"])


@pytest.mark.parametrize("form", ["parameters", "activated"])
def test_a_model_comes_back(model, form):
    assert_near(model, csplat.from_gsplat(csplat.to_gsplat(model, form=form), form=form))


def test_nothing_is_shared_with_the_model(model):
    for array in csplat.to_gsplat(model).values():
        array[:] = 9.0
    again = csplat.to_gsplat(model)
    made = csplat.from_gsplat(again)
    before = made.means.copy()
    again["means"] += 1.0
    assert np.array_equal(before, made.means)
    assert model.opacities.max() <= 1.0


def test_a_checkpoint_of_the_trainer_is_understood(model):
    splats = csplat.to_gsplat(model)
    splats["quats"] *= 3.0  # they are normalised where they are used
    splats["opacities"] = splats["opacities"][:, None]
    assert_near(model, csplat.from_gsplat({"step": 30_000, "splats": splats}))


def test_shn_may_be_left_out(model):
    splats = csplat.to_gsplat(model)
    del splats["shN"]
    assert 0 == csplat.from_gsplat(splats).sh_degree


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"sh0": None}, "have no sh0"),
        ({"sh0": None, "features": 1}, "features of appearance"),
        ({"means": np.zeros((20, 2))}, r"means has shape \[20, 2\]"),
        ({"sh0": np.zeros((20, 2, 3))}, r"sh0 has shape \[20, 2, 3\], wanted \[20, 1, 3\]"),
        ({"opacities": np.full(20, np.nan)}, "NaN"),
        ({"quats": np.full((20, 4), np.inf)}, "quats holds values that are NaN"),
        ({"quats": np.zeros((20, 3))}, r"quats has shape \[20, 3\]"),
        ({"shN": "text"}, "shN is a str"),
    ],
)
def test_what_is_no_dict_of_splats_is_refused_by_name(model, change, says):
    splats = {**csplat.to_gsplat(model), **change}
    splats = {name: value for name, value in splats.items() if value is not None}
    with pytest.raises(InputError, match=says):
        csplat.from_gsplat(splats)


def test_the_wrong_form_is_noticed_where_it_can_be(model):
    with pytest.raises(InputError, match="logarithms"):
        csplat.from_gsplat(csplat.to_gsplat(model), form="activated")
    for call, given in ((csplat.from_gsplat, {}), (csplat.to_gsplat, model)):
        with pytest.raises(InputError, match="wanted one of parameters, activated"):
            call(given, form="logits")
    with pytest.raises(InputError, match="takes a SplatModel"):
        csplat.to_gsplat({})


def test_tensors_without_torch_are_an_error_that_says_what_helps(model, monkeypatch):
    monkeypatch.setitem(sys.modules, "torch", None)
    with pytest.raises(InputError, match="device=None gives NumPy arrays"):
        csplat.to_gsplat(model, device="cpu")


def test_tensors_go_both_ways_with_gradients_and_in_half_precision(model):
    torch = pytest.importorskip("torch", reason="tensors want torch (the train extra)")
    tensors = csplat.to_gsplat(model, device="cpu")
    assert all(isinstance(one, torch.Tensor) and one.dtype == torch.float32 for one in tensors.values())
    assert_near(model, csplat.from_gsplat(torch.nn.ParameterDict(tensors)))
    half = replace(csplat.from_gsplat({name: one.bfloat16() for name, one in tensors.items()}), quats=model.quats)
    assert np.allclose(model.means, half.means, rtol=1e-2)

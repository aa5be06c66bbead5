# SPDX-License-Identifier: Apache-2.0
"""Checkpoints and tensors of gsplat, splatfacto and INRIA as scenes; without torch an error names the extra.

Also: csplat_trainer.torch_checkpoints.
"""

import io
import pickle
import sys
import zipfile
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import Mock

import numpy as np
import pytest
from checked import flipped, refusals

import csplat
from csplat.errors import InputError
from csplat.formats import read_scene
from csplat.interop import to_gsplat

ARRAYS = ("means", "quats", "scales", "opacities", "sh0", "shN")
CHECKPOINTS = Path(__file__).parents[1] / "helpers" / "checkpoints"
STORED = [CHECKPOINTS / "gsplat.pt", CHECKPOINTS / "splatfacto.ckpt"]


class PlainTensor(np.ndarray):
    """An array with the one tensor method that the reader calls."""

    def numel(self):
        return self.size


def tensor(values):
    return np.asarray(values).view(PlainTensor)


def load_plainly(path, **_):
    """Read the contiguous float32 tensors of a checkpoint as `torch.load` does."""

    class Reader(pickle.Unpickler):  # noqa: S301  # a file of the project
        def find_class(self, module, name):
            if name == "_rebuild_tensor_v2":
                return lambda values, at, shape, *_: tensor(values[at:][: np.prod(shape, dtype=int)]).reshape(shape)
            if name == "_rebuild_parameter":
                return lambda values, *_: values
            return name if module.startswith("torch") else super().find_class(module, name)

        def persistent_load(self, entry):
            return np.frombuffer(archive.read(f"{folder}/data/{entry[2]}"), "<f4")

    with zipfile.ZipFile(path) as archive:
        folder = archive.namelist()[0].partition("/")[0]
        return Reader(io.BytesIO(archive.read(f"{folder}/data.pkl"))).load()


@pytest.fixture
def torch():
    return pytest.importorskip("torch", reason="checkpoints want torch (the train extra)")


@pytest.fixture
def no_torch(monkeypatch):
    """Return a function that replaces torch by a module whose `load` reads checkpoints without it."""

    def replace_by(load=load_plainly):
        monkeypatch.setitem(sys.modules, "torch", SimpleNamespace(__version__="2.5.0", load=load))

    return replace_by


@pytest.fixture
def read_holding(no_torch):
    """Return a function that reads a checkpoint that holds an object."""

    def read(said, read=csplat.read, **options):
        no_torch(lambda *_, **__: said)
        return read(STORED[0], **options)

    return read


def made_splats(make_model, degree):
    """Return a scene as gsplat's dictionary of tensors."""
    return {name: tensor(values) for name, values in to_gsplat(make_model(5, degree)).items()}


def saved(torch, checkpoint):
    stream = io.BytesIO()
    torch.save(checkpoint, stream)
    return stream.getvalue()


def of_splatfacto(splats, **changed):
    names = {"sh0": "features_dc", "shN": "features_rest"}
    named = {f"_model.gauss_params.{names.get(name, name)}": value for name, value in splats.items()}
    named["_model.gauss_params.features_dc"] = splats["sh0"][:, 0]
    named["_model.gauss_params.opacities"] = splats["opacities"][:, None]
    return {"step": 29999, "pipeline": {**named, **changed, "_model.camera_optimizer.pose_adjustment": splats["means"]}}


def of_checkpoint(path):
    """Check the five stored splats: normals of NumPy's generator of seed 0."""
    rng = np.random.default_rng(0)
    means, quats, scales = (rng.standard_normal((5, width)) for width in (3, 4, 3))
    quats /= np.linalg.norm(quats, axis=1)[:, None]
    wanted = [means, quats, scales - 4, rng.random(5), rng.standard_normal((5, 3)), rng.standard_normal((5, 3, 3))]
    model = csplat.read(path)
    for name, values in zip(ARRAYS, wanted, strict=True):
        np.testing.assert_allclose(values, getattr(model, name), atol=1e-6)


# without torch
def test_stored_checkpoints_are_read(no_torch):
    no_torch()
    for path in STORED:
        of_checkpoint(path)


def test_colours_that_splatfacto_trained_without_sh_are_logits(read_holding, make_model):
    splats = made_splats(make_model, 0)
    own, theirs = (read_holding(said) for said in ({"splats": splats}, of_splatfacto(splats)))
    assert np.allclose(1.0 / (1.0 + np.exp(-own.sh0)), 0.5 + 0.28209479177387814 * theirs.sh0, atol=1e-6)
    assert (own.means == theirs.means).all()


def test_sh_bands_above_the_requested_degree_are_left_out(read_holding, make_model):
    splats = made_splats(make_model, 3)
    many = tensor(np.concatenate([splats["shN"], np.ones((5, 20, 3), np.float32)], axis=1))
    for said in ({"splats": {**splats, "shN": many}}, of_splatfacto({**splats, "shN": many})):
        with pytest.raises(InputError, match=r"shN has SH degree 5, expected at most 4: --sh-degree 4 of csplat"):
            read_holding(said)
        for degree in (4, 3, 1):
            assert np.array_equal(many[:, : (degree + 1) ** 2 - 1], read_holding(said, sh_degree=degree).shN)


def test_a_checkpoint_without_splats_is_refused(read_holding, make_model):
    splats = made_splats(make_model, 1)
    many = np.broadcast_to(np.float32(0.0), (10**9, 3)).view(PlainTensor)
    few = {name: values[:2] for name, values in splats.items()}
    names = ("means", "quats", "scales", "opacities", "appearance_features")
    for said, expected in (
        ([1], "it holds a list"),
        (([1, 2], 3), "it holds a tuple"),
        ({"model": 3}, "it holds model: neither"),
        ({"splats": {**splats, "means": many}}, "means is not a tensor, or larger than the file"),
        ({"splats": {**splats, "means": "many"}}, "means is not a tensor"),
        ({"splats": {**splats, "means": tensor(np.full((5, 3), np.inf))}}, "NaN or infinity"),
        ({"splats": {"means": splats["means"]}}, "no quats"),
        ({f"m.{name}": splats.get(name, splats["sh0"]) for name in names}, "no sh0, .*; it was trained with appear"),
        (of_splatfacto(splats, **{"_model.gauss_params.scales": tensor(np.zeros((3, 3)))}), "scales"),
        ({"pipeline": {**renamed(splats, "_model.gauss_params."), **renamed(few, "_model.background.gauss_params.")}},
            r"2 models of splats, .*: _model\.gauss_params\.\* \(5 splats\), _model\.background\.gauss_params\.\* \(2"),
    ):  # fmt: skip
        with pytest.raises(InputError, match=rf"^gsplat\.pt: .*{expected}"):
            read_holding(said)


def renamed(splats, prefix):
    """Return the tensors of splatfacto under other names."""
    return {
        name.replace("_model.gauss_params.", prefix): one for name, one in of_splatfacto(splats)["pipeline"].items()
    }


def of_inria(splats):
    """Return the pair that INRIA's trainer saves: the result of `GaussianModel.capture`, and the iteration."""
    arrays = (splats[name] for name in ("means", "sh0", "shN", "scales", "quats"))
    return ((3, *arrays, splats["opacities"][:, None], 0, 0, 0, {"state": {}}, 5.0), 30000)


def other_names(splats, prefix, names):
    """Return tensors under the names of another program, in the order of `ARRAYS`."""
    return {prefix + name: splats[own] for own, name in zip(ARRAYS, names.split(), strict=True)}


def test_checkpoints_of_other_programs_and_versions_give_the_same_scene(read_holding, make_model):
    splats = made_splats(make_model, 3)
    expected = read_holding({"splats": splats})
    for said in (
        {"step": 1, "pipeline": renamed(splats, "_model.")},  # nerfstudio before 1.1
        {"step": 1, "pipeline": renamed(splats, "module._model.gauss_params.")},
        {"state_dict": renamed(splats, "gauss_params.")},
        renamed(splats, "_model."),
        splats,
        of_inria(splats),
        {"state_dict": other_names(splats, "gaussian_model.gaussians.",
            "means rotations scales opacities shs_dc shs_rest")},  # Gaussian Splatting Lightning
        other_names(splats, "_", "xyz rotation scaling opacity features_dc features_rest"),
    ):  # fmt: skip
        read = read_holding(said)
        assert all(np.array_equal(getattr(expected, name), getattr(read, name)) for name in ARRAYS)


def test_checkpoints_of_several_gpus_are_one_scene(no_torch, make_model, tmp_path):
    splats = made_splats(make_model, 1)
    paths = [tmp_path / f"ckpt_29_rank{rank}.pt" for rank in range(3)]
    for path in [*paths, tmp_path / "ckpt_6_rank7.pt"]:
        path.write_bytes(STORED[0].read_bytes())
    no_torch(lambda path, **_: {"splats": {name: one[int(path.stem[-1]) :: 3] for name, one in splats.items()}})
    scene = read_scene(paths[1])
    assert np.array_equal(scene.model().means, splats["means"][[0, 3, 1, 4, 2]])
    assert [("ranks", False)] == [(one.id, one.usual) for one in scene.findings]
    paths[1].unlink()
    with pytest.raises(InputError, match=r"ckpt_29_rank2\.pt has the splats of one of several .*: no ckpt_29_rank1"):
        csplat.read(paths[2])
    paths[2].unlink()
    scene = read_scene(paths[0])
    assert 2 == scene.count
    assert [("ranks", "note", True)] == [(one.id, one.kind, one.usual) for one in scene.findings]


def test_values_are_checked_like_those_of_a_ply(read_holding, make_model):
    splats = made_splats(make_model, 0)

    def read(**changed):
        scene = read_holding({"splats": {**splats, **changed}}, read_scene)
        return scene.model(), {one.id: one for one in scene.findings}

    many = {name: tensor(values) for name, values in to_gsplat(make_model(20, 0)).items()}
    many |= {"opacities": tensor(np.linspace(0, 1, 20, dtype="f4")), "scales": np.exp(many["scales"])}
    many["quats"][3] = 0
    model, found = read(**many, filter_3D=tensor(np.ones(20)))
    assert {"zero-quats", "opacities-are-alphas", "scales-are-linear", "filter-3d"} <= set(found)
    assert "repair" == found["zero-quats"].kind == found["filter-3d"].kind
    assert [1, 0, 0, 0] == model.quats[3].tolist()
    scales = splats["scales"]
    zero = np.where([0, 0, 1], -np.float32(np.inf), scales)
    for one, name, third in (
        (scales[:, :1], "one-scale", scales[:, 0]), (scales[:, 0], "one-scale", scales[:, 0]),
        (scales[:, :2], "flat-scales", scales[:, :2].min() - np.log(100)), (zero, "zero-scales", -88.0),
    ):  # fmt: skip
        model, found = read(scales=tensor(one))
        assert (True, name == "flat-scales") == (name in found, model.metadata.flat)
        assert np.array_equal(scales[:, 0], model.scales[:, 0])
        np.testing.assert_allclose(
            model.scales[:, 2], np.broadcast_to(third, 5), rtol=1e-6 if name != "zero-scales" else 0.01
        )
    far = tensor(splats["means"].astype(np.float64) + 1e7 + 0.3)
    model, found = read(means=far)
    assert "double-means" in found
    assert np.float32 == model.means.dtype
    np.testing.assert_allclose(model.means + np.array(model.origin), far, rtol=0, atol=1e-6)


def test_other_files_are_refused_before_torch_loads_them_and_those_that_it_cannot_load(no_torch, tmp_path, monkeypatch):
    no_torch(lambda path, **_: load_plainly(path) if path.stem == "b_rank0" else pytest.fail("it was loaded"))
    (tmp_path / "b_rank0.pt").write_bytes(STORED[0].read_bytes())
    for data, expected in (
        (b"404: Not Found", "not a checkpoint of torch: it begins with b'404: Not'"),
        (b"version https://git-lfs.github.com/spec/v1\noid", "a pointer of Git LFS"),
    ):
        for written, read in (("a.pt", "a.pt"), ("b_rank1.pt", "b_rank0.pt")):
            (tmp_path / written).write_bytes(data)
            with pytest.raises(InputError, match=rf"^{written} is {expected}[^\n]*$"):
                csplat.read(tmp_path / read)
    for error, expected in (
        (pickle.UnpicklingError("Weights only load failed"), "contains objects that could run code"),
        (RuntimeError("PytorchStreamReader failed"), "is a truncated or damaged checkpoint"),
    ):
        no_torch(Mock(side_effect=error))
        with pytest.raises(InputError, match=rf"^gsplat\.pt {expected}[^\n]*$"):
            csplat.read(STORED[0])
    monkeypatch.setitem(sys.modules, "torch", None)
    for path in STORED:
        with pytest.raises(InputError, match=rf"{path.name} is a checkpoint of torch: .*extra train"):
            csplat.read(path)


# with torch
@pytest.mark.torch
@pytest.mark.usefixtures("torch")
def test_torch_reads_stored_checkpoints_as_the_plain_reader_does():
    for path in STORED:
        of_checkpoint(path)


@pytest.mark.torch
@pytest.mark.parametrize("degree", [0, 3])
def test_checkpoints_of_all_programs_are_read(torch, make_model, degree):
    model = make_model(20, degree)
    splats = {name: torch.nn.Parameter(torch.from_numpy(array)) for name, array in to_gsplat(model).items()}
    loose = {**splats, "quats": splats["quats"] * 3.0}  # trainers normalise them on use
    own = csplat.read(saved(torch, {"step": 7, "splats": loose}))
    inria = csplat.read(saved(torch, of_inria(loose)))
    assert all(np.array_equal(getattr(own, name), getattr(inria, name)) for name in ARRAYS)
    theirs = csplat.read(saved(torch, of_splatfacto(loose)))
    for name in ARRAYS if degree else ARRAYS[:-2]:
        assert np.allclose(getattr(model, name), getattr(own, name), atol=1e-6), name
        assert (getattr(own, name) == getattr(theirs, name)).all()
    whole = saved(torch, {"schedulers": {"last": [np.float64(0.1), np.float32(0.2)]}, "splats": splats})
    old = io.BytesIO()  # scalars as NumPy 1 writes them
    with zipfile.ZipFile(io.BytesIO(whole)) as source, zipfile.ZipFile(old, "w") as target:
        for name in source.namelist():
            target.writestr(name, source.read(name).replace(b"numpy._core.multiarray", b"numpy.core.multiarray"))
    assert 20 == len(csplat.read(whole)) == len(csplat.read(old.getvalue()))


@pytest.mark.torch
def test_invalid_tensors_and_damage_are_refused(torch, make_model, tmp_path):
    splats, path = to_gsplat(make_model(3, 0), device="cpu"), tmp_path / "a.pt"
    for values, message in (
        ({**splats, "means": torch.zeros(1).expand(10**9, 3)}, "means is not a tensor, or larger than the file"),
        ({**splats, "means": torch.full((3, 3), torch.inf)}, "NaN or infinity"),
        ({**splats, "sh0": torch.zeros(3, 2)}, "sh0 has shape"),
        (print, "contains objects that could run code"),
    ):
        path.write_bytes(saved(torch, {"splats": values}))
        with pytest.raises(InputError, match=rf"^a\.pt[^\n]*{message}[^\n]*$"):
            csplat.read(path)
    whole = saved(torch, {"splats": splats})
    assert [""] == refusals(path, [whole])
    assert all("a.pt" in one for one in refusals(path, (whole[:size] for size in range(0, len(whole), 311))))
    refusals(path, flipped(whole, range(0, len(whole), 29)))


@pytest.fixture
def model(make_model):
    return make_model(20, 2, opacities=np.linspace(0, 1, 20, dtype="f4"))


def assert_near(a, b):
    for name in ARRAYS:
        assert np.allclose(getattr(a, name), getattr(b, name), rtol=1e-6, atol=2e-7), name


def test_splats_of_gsplat_are_parameters_or_activated(model):
    splats, activated = csplat.to_gsplat(model), csplat.to_gsplat(model, form="activated")
    assert ARRAYS == tuple(splats) == tuple(activated)
    assert [(20, 3), (20, 4), (20, 3), (20,), (20, 1, 3), (20, 8, 3)] == [splats[name].shape for name in ARRAYS]
    assert np.array_equal(model.scales, splats["scales"])
    assert np.allclose(1.0 / (1.0 + np.exp(-splats["opacities"].astype(np.float64))), model.opacities, atol=1e-7)
    assert np.isfinite(splats["opacities"]).all()
    assert np.allclose(np.exp(model.scales), activated["scales"], rtol=1e-6)
    assert np.array_equal(model.opacities, activated["opacities"])
    assert_near(model, csplat.from_gsplat(splats))
    assert_near(model, csplat.from_gsplat(activated, form="activated"))
    loose = {**splats, "quats": 3 * splats["quats"], "opacities": splats["opacities"][:, None]}  # as in a checkpoint
    assert_near(model, csplat.from_gsplat({"step": 30_000, "splats": loose}))
    made = csplat.from_gsplat(splats)
    for array in splats.values():
        array[:] = 9.0
    assert not any((getattr(one, name) == 9.0).any() for one in (model, made) for name in ARRAYS)  # no shared memory
    del splats["shN"]
    assert 0 == csplat.from_gsplat(splats).sh_degree


BAD_ARRAYS = [
    ({"sh0": None}, "have no sh0"),
    ({"sh0": None, "features": 1}, "appearance features"),
    ({"means": np.zeros((20, 2))}, r"means has shape \[20, 2\]"),
    ({"sh0": np.zeros((20, 2, 3))}, r"sh0 has shape \[20, 2, 3\], expected \[20, 1, 3\]"),
    ({"opacities": np.full(20, np.nan)}, "NaN"),
    ({"quats": np.full((20, 4), np.inf)}, "quats contains NaN"),
    ({"quats": np.zeros((20, 3))}, r"quats has shape \[20, 3\]"),
    ({"shN": "text"}, "shN is a str"),
]


def test_invalid_arrays_forms_and_tensors_without_torch_are_refused(model, monkeypatch):
    for change, expected in BAD_ARRAYS:
        splats = {**csplat.to_gsplat(model), **change}
        with pytest.raises(InputError, match=expected):
            csplat.from_gsplat({name: value for name, value in splats.items() if value is not None})
    with pytest.raises(InputError, match="logarithms"):
        csplat.from_gsplat(csplat.to_gsplat(model), form="activated")
    for function, given in ((csplat.from_gsplat, {}), (csplat.to_gsplat, model)):
        with pytest.raises(InputError, match="expected one of parameters, activated"):
            function(given, form="logits")
    with pytest.raises(InputError, match="expects a SplatModel"):
        csplat.to_gsplat({})
    monkeypatch.setitem(sys.modules, "torch", None)
    with pytest.raises(InputError, match="use device=None for NumPy arrays"):
        csplat.to_gsplat(model, device="cpu")


def test_tensors_may_require_gradients_or_have_half_precision(model):
    torch = pytest.importorskip("torch", reason="tensors want torch (the train extra)")
    tensors = csplat.to_gsplat(model, device="cpu")
    assert all(isinstance(one, torch.Tensor) and one.dtype == torch.float32 for one in tensors.values())
    assert_near(model, csplat.from_gsplat(torch.nn.ParameterDict(tensors)))
    half = replace(csplat.from_gsplat({name: one.bfloat16() for name, one in tensors.items()}), quats=model.quats)
    assert np.allclose(model.means, half.means, rtol=1e-2)

"""Checkpoints of gsplat and splatfacto as scenes; the same bytes without torch are an error that names the extra."""

import io
import sys
import zipfile

import numpy as np
import pytest

import csplat
from csplat.bridges import to_gsplat
from csplat.errors import InputError

ARRAYS = ("means", "quats", "scales", "opacities", "sh0", "shN")


@pytest.fixture
def torch():
    return pytest.importorskip("torch", reason="checkpoints want torch (the train extra)")


def saved(torch, said):
    stream = io.BytesIO()
    torch.save(said, stream)
    return stream.getvalue()


def of_splatfacto(splats, **changed):
    names = {"sh0": "features_dc", "shN": "features_rest"}
    named = {f"_model.gauss_params.{names.get(name, name)}": value for name, value in splats.items()}
    named["_model.gauss_params.features_dc"] = splats["sh0"][:, 0]
    named["_model.gauss_params.opacities"] = splats["opacities"][:, None]
    return {"step": 29999, "pipeline": {**named, **changed, "_model.camera_optimizer.pose_adjustment": splats["means"]}}


@pytest.mark.parametrize("degree", [0, 3])
def test_a_scene_comes_out_of_either(torch, make_model, degree):
    model = make_model(20, degree)
    splats = {name: torch.nn.Parameter(torch.from_numpy(array)) for name, array in to_gsplat(model).items()}
    loose = {**splats, "quats": splats["quats"] * 3.0}  # they are normalised where they are used
    own = csplat.read(saved(torch, {"step": 7, "splats": loose}))
    theirs = csplat.read(saved(torch, of_splatfacto(loose)))
    for name in ARRAYS if degree else ARRAYS[:-2]:
        assert np.allclose(getattr(model, name), getattr(own, name), atol=1e-6), name
        assert (getattr(own, name) == getattr(theirs, name)).all()
    if not degree:  # logits of colours
        colours = 0.5 + 0.28209479177387814 * theirs.sh0
        assert np.allclose(1.0 / (1.0 + np.exp(-model.sh0)), colours, atol=1e-6)


def test_learning_rates_may_be_numbers_of_either_numpy(torch, make_model):
    splats = to_gsplat(make_model(5, 0), device="cpu")
    whole = saved(torch, {"schedulers": {"last": [np.float64(0.1), np.float32(0.2)]}, "splats": splats})
    old = io.BytesIO()
    with zipfile.ZipFile(io.BytesIO(whole)) as source, zipfile.ZipFile(old, "w") as target:
        for name in source.namelist():
            target.writestr(name, source.read(name).replace(b"numpy._core.multiarray", b"numpy.core.multiarray"))
    assert len(csplat.read(whole)) == len(csplat.read(old.getvalue())) == 5


def test_what_is_no_scene_is_refused(torch, make_model, tmp_path):
    splats = to_gsplat(make_model(5, 0), device="cpu")
    many = torch.zeros(1).expand(10**9, 3)
    endless = {**splats, "means": torch.full((5, 3), torch.inf)}
    for said, says in (
        ([1], "it holds a list"),
        ({"model": 3}, "it holds model: neither"),
        ({"splats": {**splats, "means": many}}, "means is no tensor that the file can hold"),
        ({"splats": {**splats, "means": "many"}}, "means is no tensor"),
        ({"splats": endless}, "NaN or infinite"),
        ({"splats": {"means": splats["means"]}}, "no quats"),
        ({"splats": {**splats, "sh0": torch.zeros(5, 2)}}, "sh0 has shape"),
        ({"splats": print}, r"a\.pt holds objects of a program"),
        (of_splatfacto(splats, **{"_model.gauss_params.scales": torch.zeros(3, 3)}), "scales"),
    ):
        (tmp_path / "a.pt").write_bytes(saved(torch, said))
        with pytest.raises(InputError, match=rf"a\.pt.*{says}|{says}") as caught:
            csplat.read(tmp_path / "a.pt")
        assert "a.pt" in str(caught.value)
        assert "\n" not in str(caught.value)


def test_damage_is_refused_or_read(torch, make_model, tmp_path):
    whole, path = saved(torch, {"splats": to_gsplat(make_model(3, 0), device="cpu")}), tmp_path / "a.ckpt"

    def read(data):
        path.write_bytes(data)
        try:
            csplat.read(path)
        except InputError as error:
            return str(error)
        return ""

    assert not read(whole)
    assert all("a.ckpt" in read(whole[:size]) for size in range(0, len(whole), 311))
    for at in range(0, len(whole), 29):
        read(whole[:at] + bytes([whole[at] ^ (1 << at % 8)]) + whole[at + 1 :])


def test_without_torch_the_extra_is_named(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "torch", None)
    with zipfile.ZipFile(tmp_path / "a.bin", "w") as archive:
        archive.writestr("archive/data.pkl", b"")
    with pytest.raises(InputError, match=r"a\.bin is a checkpoint of torch: .*csplat\[train\]"):
        csplat.read(tmp_path / "a.bin")

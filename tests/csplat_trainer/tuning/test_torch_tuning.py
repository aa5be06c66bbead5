# SPDX-License-Identifier: Apache-2.0
"""Fine-tuning in torch, against the native engine.

Also: csplat_trainer.torch_quantisers.
"""

from dataclasses import replace

import numpy as np
import pytest
from captures import cameras, shell

from csplat import EncodeOptions
from csplat.encoder import EncodePlan, fix_quantisation
from csplat.errors import InputError
from csplat_trainer.device_measurements import make_rasteriser
from csplat_trainer.training_options import Outputs
from csplat_trainer.tuning import FinetuneOptions, renders_of, split_views, tune
from csplat_trainer.tuning.torch_tuning import TorchTuning
from csplat_trainer.tuning.tuning_engine import CpuTuning

torch = pytest.importorskip("torch", reason="the engine requires torch (the train extra)")
pytestmark = pytest.mark.torch
BLACK = np.zeros(3, np.float32)
needs_gpu = pytest.mark.skipif(not torch.cuda.is_available(), reason="gsplat needs a GPU")

ENCODINGS = {
    "codebook": EncodeOptions(attribute_psnr=28.0, sh_coding="codebook", codebook_size=16),
    "shapes": EncodeOptions(attribute_psnr=28.0, sh_coding="codebook", codebook_size=16, shape_codebook_size=32),
    "scalar": EncodeOptions(attribute_psnr=28.0, sh_coding="scalar", tile_splats=80),
    "no SH": EncodeOptions(attribute_psnr=28.0, sh_coding="none"),
}


@pytest.fixture(scope="module", params=ENCODINGS)
def fixed(request):
    return fix_quantisation(EncodePlan.of(shell(8), ENCODINGS[request.param], importance=np.linspace(1, 99, 300)))


@pytest.fixture(scope="module")
def views():
    return split_views(renders_of(shell(8), cameras(6), BLACK), BLACK, validation_count=2)


def engine_of(fixed, options, device="cpu"):
    return TorchTuning(fixed, options, BLACK, make_rasteriser(device, antialiased=False))


@pytest.mark.parametrize("device", ["cpu", pytest.param("cuda", marks=[pytest.mark.gpu, needs_gpu])])
def test_the_loss_sees_what_a_decoder_returns(fixed, views, device):
    engine = engine_of(fixed, FinetuneOptions(iterations=9), device)
    rates = dict.fromkeys(engine.parameters.values, 0.02)
    for view in views.train:
        engine.step(view, None, rates, engine.count(1e-3))
        engine.free_values()  # which compares the quantisers with the encoder's


def test_tuning_takes_the_same_steps(fixed, views):
    options = FinetuneOptions(iterations=9)
    engines = CpuTuning(fixed, options, BLACK), engine_of(fixed, options)
    values, figures = [], []
    for engine in engines:
        rates = dict.fromkeys(engine.parameters.values, 1e-3)
        costs = engine.count(1e-4)
        losses = [engine.step(view, None, rates, costs).read().loss for view in views.train]
        figures.append([costs.bits, *losses, engine.score(views.validation[0], None)[1]])
        values.append(engine.free_values())
    assert np.allclose(*figures, rtol=2e-3)
    for name, array in vars(values[0]).items():
        assert np.count_nonzero(np.abs(array - getattr(values[1], name)) > 1e-5) <= 0.02 * array.size, name


def test_values_that_the_encoder_quantises_differently_are_refused(fixed):
    engine = engine_of(fixed, FinetuneOptions())
    engine.parameters.tensors["sh0"][0] = 1e9
    with pytest.raises(InputError, match="sh0 are too large"):
        engine.free_values()


def test_either_engine_resumes_a_tuning_of_the_other(fixed, views, tmp_path):
    path = tmp_path / "run.npz"
    options = FinetuneOptions(iterations=6, validate_every=3, warm_up=1, engine="torch")
    tune(fixed, views, options, outputs=Outputs(checkpoint=path))
    longer = replace(options, iterations=9, engine="native")
    found = tune(fixed, views, longer, outputs=Outputs(checkpoint=path, resume=path))
    again = tune(fixed, views, replace(options, iterations=12), outputs=Outputs(resume=path))
    assert [9, 12] == [len(one.log["losses"]) for one in (found, again)]
    assert again.log["best_psnr"] > found.log["start_psnr"] - 0.2

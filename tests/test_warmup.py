"""Warming up: what it compiles is all that the commands run, and it says so."""

import json
import subprocess
import sys

import pytest

pytest.importorskip("numba", reason="the renderer wants the extra [render]")

# The versions of each kernel that are known after warming up, and those that using it for a scene adds.
_USE = """
import json, sys
import numpy as np
from csplat.model import SplatModel
from csplat_render.warmup import warm_up

def compiled():
    return {
        f"{name}.{key}": len(value.signatures)
        for name, module in list(sys.modules.items()) if name.startswith(("csplat_render", "csplat_trainer"))
        for key, value in vars(module).items() if isinstance(getattr(value, "signatures", None), list)
    }

rng = np.random.default_rng(0)
shapes = {"means": (40, 3), "quats": (40, 4), "scales": (40, 3), "opacities": (40,), "sh0": (40, 3), "shN": (40, 15, 3)}
arrays = {name: rng.uniform(0.1, 0.9, shape).astype("<f4") for name, shape in shapes.items()}
arrays["quats"] = np.tile(np.float32([1.0, 0.0, 0.0, 0.0]), (40, 1))
model = SplatModel(**arrays)
"""
_SIMPLIFY = """
from csplat_tools.files.extras import prepare_renderer
prepare_renderer(quiet=True, simplify=True)
from csplat_tools.optimise.simplify import SimplifyOptions, simplify
before = compiled()
simplify(model, keep=0.5, options=SimplifyOptions(views=2, view_size=(32, 24)))
"""
_COMPARE = """
warm_up(gradients=False, ssim=True, lpips=True)
from csplat_render.convolving import convolve
from csplat_render.lpips import SCALE
from csplat_render.judge import Judge
from csplat_tools.views import comparison_cameras
before = compiled()
def lpips(a, b):
    kernel = np.full((11, 11, 3, 64), 0.1, np.float32)
    return float(convolve((a - b) / SCALE, kernel, np.zeros(64, np.float32), 4, 2).mean())
Judge.of_source(model, comparison_cameras(model)).scores(model.select(np.arange(30)), lpips=lpips)
"""
_TELL = "print(json.dumps([before, compiled()]))"


@pytest.mark.parametrize("use", [_SIMPLIFY, _COMPARE], ids=["simplify", "compare"])
def test_nothing_is_left_to_compile_after_warming_up(use):
    run = subprocess.run([sys.executable, "-c", _USE + use + _TELL], check=True, stdout=subprocess.PIPE, text=True)
    before, after = json.loads(run.stdout)
    assert sum(before.values()) > 5
    assert {} == {name: count for name, count in after.items() if count != before.get(name, 0)}


def test_what_a_plain_renderer_needs_is_not_all():
    script = _USE + _SIMPLIFY.replace("simplify=True", "simplify=False") + _TELL
    run = subprocess.run([sys.executable, "-c", script], check=True, stdout=subprocess.PIPE, text=True)
    before, after = json.loads(run.stdout)
    assert "csplat_render.blending_sums.sum_removal" in {name for name in after if after[name] > before.get(name, 0)}

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
_PLAIN = """
from csplat_tools.files.extras import prepare_renderer
prepare_renderer(quiet=True, simplify=False)
plain = compiled()
"""
_SIMPLIFY = """
prepare_renderer(quiet=True, simplify=True)
from csplat_render.virtual import virtual_cameras
from csplat_tools.optimise.simplify import SimplifyOptions, simplify
before = compiled()
simplify(model, keep=0.5, options=SimplifyOptions(views=2, view_size=(32, 24), rounds=1, effort=1))
"""
_COMPARE = """
plain = None
warm_up(gradients=False, ssim=True, lpips=True)
from csplat_render.convolving import convolve
from csplat_render.lpips import SCALE
from csplat_render.judge import Judge
from csplat_render.virtual import virtual_cameras
before = compiled()
def lpips(a, b):
    kernel = np.full((11, 11, 3, 64), 0.1, np.float32)
    return float(convolve((a - b) / SCALE, kernel, np.zeros(64, np.float32), 4, 2).mean())
judge = Judge.of_source(model, virtual_cameras(model, 1, 64, 48), (0.0, 0.0, 0.0))
judge.scores(model.select(np.arange(30)), lpips=lpips)
"""
_TELL = "print(json.dumps([plain, before, compiled()]))"


def versions_by(*parts):
    """Run parts of a program; return how many versions of each kernel there were at each of three times."""
    code = "".join([_USE, *parts, _TELL])
    run = subprocess.run([sys.executable, "-c", code], check=True, stdout=subprocess.PIPE, text=True)
    return json.loads(run.stdout)


def assert_nothing_was_compiled(before, after):
    assert sum(before.values()) > 5
    assert {} == {name: count for name, count in after.items() if count != before.get(name, 0)}


@pytest.mark.slow
def test_nothing_is_left_to_compile_after_warming_up_for_simplify_and_a_plain_renderer_needs_less():
    plain, before, after = versions_by(_PLAIN, _SIMPLIFY)
    assert_nothing_was_compiled(before, after)
    assert "csplat_render.blending_sums.sum_removal" in {name for name in after if after[name] > plain.get(name, 0)}


@pytest.mark.slow
def test_nothing_is_left_to_compile_after_warming_up_for_compare():
    _, before, after = versions_by(_COMPARE)
    assert_nothing_was_compiled(before, after)

"""Warming up compiles all that the commands run, and reports it."""

import json
import os
import subprocess
import sys

import pytest

pytest.importorskip("numba", reason="the renderer wants the extra [render]")

pytestmark = [
    pytest.mark.area(name="rasteriser"),
    pytest.mark.skipif(not hasattr(os, "fork"), reason="there is no fork on this system"),
]

# The versions of each kernel after warming up, and the versions that using it for a scene adds.
_USE = """
import json, os, sys
import numpy as np
import csplat_tools.optimise.pruning, csplat_render.scorer, csplat_render.lpips, csplat_render.metric_kernels
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
from csplat_tools.optional_packages import prepare_renderer
prepare_renderer(quiet=True, simplify=False)
plain = compiled()
"""
_SIMPLIFY = """
prepare_renderer(quiet=True, simplify=True)
from csplat_tools.optimise.pruning_order import SimplifyOptions
from csplat_tools.optimise.pruning import simplify
before = compiled()
simplify(model, keep=0.5, options=SimplifyOptions(views=2, view_size=(32, 24), rounds=1, effort=1))
"""
_COMPARE = """
plain = None
warm_up(gradients=False, ssim=True, lpips=True)
from csplat_render.metric_kernels import convolve
from csplat_render.lpips import SCALE
from csplat_render.scorer import Scorer
from csplat_render.camera import intrinsics, look_at
before = compiled()
def lpips(a, b):
    kernel = np.full((11, 11, 3, 64), 0.1, np.float32)
    return float(convolve((a - b) / SCALE, kernel, np.zeros(64, np.float32), 4, 2).mean())
camera = look_at((4.0, 4.0, 4.0), (0.5, 0.5, 0.5), (0.0, 0.0, 1.0), intrinsics(64, 48, 60.0), 64, 48)
judge = Scorer.of_source(model, [camera], (0.0, 0.0, 0.0))
judge.scores(model.select(np.arange(30)), lpips=lpips)
"""
_TELL = "print(json.dumps([plain, before, compiled()]), flush=True)"


@pytest.fixture(scope="module")
def versions():
    """Count the compiled versions of each kernel at three times of each part, in processes that share only imports."""
    parts = [f"{part}{_TELL}" for part in (_PLAIN + _SIMPLIFY, _COMPARE)]
    code = f"""{_USE}
for part in {parts!r}:
    if os.fork() == 0:
        exec(part)
        os._exit(0)
    if os.wait()[1]:
        sys.exit("a part failed")
"""
    run = subprocess.run([sys.executable, "-c", code], check=True, stdout=subprocess.PIPE, text=True)
    return [json.loads(line) for line in run.stdout.splitlines()]


def assert_nothing_was_compiled(before, after):
    assert sum(before.values()) > 5
    assert {} == {name: count for name, count in after.items() if count != before.get(name, 0)}


def test_nothing_is_left_to_compile_after_warming_up_for_simplify_and_a_plain_renderer_needs_less(versions):
    plain, before, after = versions[0]
    assert_nothing_was_compiled(before, after)
    assert "csplat_render.contributions.sum_pruning" in {name for name in after if after[name] > plain.get(name, 0)}


def test_nothing_is_left_to_compile_after_warming_up_for_compare(versions):
    _, before, after = versions[1]
    assert_nothing_was_compiled(before, after)

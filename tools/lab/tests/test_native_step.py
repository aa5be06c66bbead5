"""The study of compiled kernels, built by the system's compiler: its images, gradients and steps, and their hashes."""

import shutil

import numpy as np
import pytest

pytest.importorskip("numba", reason="the kernels are compared with those of the extra [render]")

from csplat_bench.scenes import SAMPLE
from native_step.__main__ import hashes_of, relative_differences
from native_step.refit_steps import GROUPS, CompiledRefit, NumbaRefit, StepInputs, available_sets, build

pytestmark = pytest.mark.slow  # compiling takes five seconds


@pytest.fixture(scope="module")
def library():
    if shutil.which("c++") is None:
        pytest.skip("there is no C++ compiler (c++)")
    if "avx2" not in available_sets():
        pytest.skip("this machine has no AVX2")
    return build("c++", "avx2")


@pytest.fixture(scope="module")
def inputs():
    return StepInputs.of(SAMPLE, views=1)


def test_a_view_and_a_step_are_those_of_the_renderer_and_the_trainer(library, inputs):
    (camera,), (reference,) = inputs.cameras, inputs.references
    ours, theirs = CompiledRefit(library, inputs.values), NumbaRefit(inputs.values)
    error, image, gradients = ours.gradients(camera, reference)
    expected_error, expected_image, expected = theirs.gradients(camera, reference)
    assert expected_error > 50  # the disturbed scene differs from the reference
    assert expected_error == pytest.approx(error, rel=1e-6)
    assert np.abs(image - expected_image).max() < 1e-5
    assert max(relative_differences(gradients, expected).values()) < 1e-4
    assert ours.step(camera, reference, 0.02) == error
    theirs.step(camera, reference, 0.02)
    # The first step of Adam has the length of the learning rate and the sign of the gradient, which may be noise.
    values, expected_values = ours.values, theirs.values
    for name in GROUPS:
        moves = expected_values[name] - inputs.values[name]
        assert np.abs(moves).max() > 0
        assert np.linalg.norm(values[name] - expected_values[name]) < 0.02 * np.linalg.norm(moves)


def test_the_number_of_threads_changes_no_bit(library, inputs):
    assert hashes_of(inputs, library, 1) == hashes_of(inputs, library, 2)

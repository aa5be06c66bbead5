# SPDX-License-Identifier: Apache-2.0
"""The SH basis, its gradient and its rotation, compared with the definition and with the tables of other programs."""

import math
from dataclasses import replace

import numpy as np
import pytest
from checked import sh_by_definition
from rasteriser_cases import camera, one_splat

from csplat.editing.transform import sh_rotations
from csplat.model import SplatModel
from csplat.spherical_harmonics import BASIS_SIZE, SH_C0, evaluate_sh, sh_basis_gradient
from csplat_render import render
from csplat_render.conventions import ALPHA_CAP

RNG = np.random.default_rng(4)
DIRECTIONS = RNG.standard_normal((500, 3))
DIRECTIONS /= np.linalg.norm(DIRECTIONS, axis=1)[:, None]
ANY = np.linalg.qr(RNG.standard_normal((3, 3)))[0]


def gsplat_basis(x, y, z):
    """Evaluate degree 4 as `sh_coeffs_to_color_fast` of gsplat's SphericalHarmonicsCUDA.cu does."""
    z2 = z * z
    fC1, fS1 = x * x - y * y, 2.0 * x * y
    pSH6 = 0.9461746957575601 * z2 - 0.3153915652525201
    fC2, fS2 = x * fC1 - y * fS1, x * fS1 + y * fC1
    pSH12 = z * (1.865881662950577 * z2 - 1.119528997770346)
    fTmp0D = z * (-4.683325804901025 * z2 + 2.007139630671868)
    fTmp1C = 3.31161143515146 * z2 - 0.47308734787878
    fTmp2B = -1.770130769779931 * z
    fC3, fS3 = x * fC2 - y * fS2, x * fS2 + y * fC2
    pSH20 = 1.984313483298443 * z * pSH12 - 1.006230589874905 * pSH6
    first = [0.6258357354491763 * fS3, fTmp2B * fS2, fTmp1C * fS1, fTmp0D * y]
    return np.stack([*first, pSH20, fTmp0D * x, fTmp1C * fC1, fTmp2B * fC2, 0.6258357354491763 * fC3], axis=1)


def test_the_basis_follows_the_definition_and_band_4_that_of_gsplat():
    for degree in range(5):
        expected = sh_by_definition(degree, DIRECTIONS)
        np.testing.assert_allclose(evaluate_sh(degree, DIRECTIONS), expected, rtol=0, atol=1e-14)
    np.testing.assert_allclose(expected[:, 16:], gsplat_basis(*DIRECTIONS.T), rtol=0, atol=1e-14)
    assert expected.shape[1] == BASIS_SIZE


def test_the_gradient_is_that_of_the_basis():
    for degree in range(5):
        weights = RNG.standard_normal((degree + 1) ** 2)
        for point in DIRECTIONS[:6]:
            gradient = np.array(sh_basis_gradient(degree, *point, weights))
            for way in np.linalg.svd(point[None])[2][1:]:  # two directions at right angles to the point
                ends = np.stack([point * np.cos(t) + way * np.sin(t) for t in (1e-5, -1e-5)])
                slope = (evaluate_sh(degree, ends) @ weights) @ [1, -1] / 2e-5
                assert gradient @ way == pytest.approx(slope, rel=1e-7, abs=1e-8)


def test_rotations_move_the_colour_of_each_direction():
    before = evaluate_sh(4, DIRECTIONS)
    for matrix in (ANY, -ANY, np.eye(3)[[2, 0, 1]], np.diag([1.0, -1.0, 1.0])):
        after = evaluate_sh(4, DIRECTIONS @ matrix.T)
        for band, turn in enumerate(sh_rotations(4, matrix), start=1):
            part, sh = slice(band**2, (band + 1) ** 2), RNG.standard_normal(2 * band + 1)
            np.testing.assert_allclose(after[:, part] @ turn @ sh, before[:, part] @ sh, atol=1e-12)


def stacked(*models):
    arrays = ("means", "quats", "scales", "opacities", "sh0", "shN")
    return SplatModel(**{name: np.concatenate([getattr(one, name) for one in models]) for name in arrays})


def test_renders_have_the_values_of_the_definition():
    half = math.sqrt(0.5)
    needle = one_splat(scale=(-1.0, -6.0, -6.0), quat=(half, 0.0, 0.0, half))  # 90° about z: x becomes y: down
    picture = render(needle, camera()).alpha
    assert picture[34, 32] > 0.04 > picture[24, 42] == 0.0
    capped = replace(one_splat(alpha=1.0, scale=0.0), sh0=np.array([[-10.0, 0.0, 10.0]], np.float32))
    result = render(capped, camera())
    assert result.alpha[24, 32] == pytest.approx(ALPHA_CAP, abs=1e-6)
    assert result.rgb[24, 32] == pytest.approx([0.0, 0.5 * ALPHA_CAP, (0.5 + 10 * SH_C0) * ALPHA_CAP], abs=1e-5)
    stack = stacked(*[one_splat(alpha=0.95, scale=0.0, colour=(1, 1, 1))] * 5)
    # 0.05⁴ is below 1e-4, the least transmittance: three are drawn.
    assert render(stack, camera(65, 49)).alpha[24, 32] == pytest.approx(1 - 0.05**3, abs=1e-6)


def test_splats_are_drawn_by_depth_then_by_index():
    both = stacked(one_splat(0.9, -1.0, (1, 0, 0), (0, 0, 0.5)), one_splat(0.9, -1.0, (0, 0, 1), (0, 0, -0.5)))
    level = replace(both, means=np.zeros((2, 3), np.float32))
    red, _, blue = render(both, camera()).rgb[24, 32]
    assert blue > 5 * red
    red, _, blue = render(level, camera()).rgb[24, 32]
    assert red > 5 * blue

"""Values at the ends of what there is, which an encoder may refuse but must not get wrong."""

from __future__ import annotations

import numpy as np

from csplat_conformance.encoders.inputs.making import APART, Input, cloud, made
from csplat_conformance.encoders.plyfile import Layout, Splats


def nasty_values() -> list[Input]:
    """Return them, in the order of a run."""
    no_splats = np.zeros(0, np.intp)
    return [
        made("nasty/empty", "no splats", lambda: cloud(1, 0).select(no_splats), renders=False),
        made("nasty/empty_degree_3", "no splats of degree 3", lambda: cloud(1, 3).select(no_splats), renders=False),
        made("nasty/infinite_logits", "logits of ±infinity: alpha 1 and 0", _infinite_logits),
        made("nasty/zero_quaternion", "rotations of length 0", _zero_quats),
        made(
            "nasty/tiny_and_huge_quaternions", "lengths of 1e−45 to 6e38, whose squares leave binary32", _extreme_quats
        ),
        made("nasty/huge_scales", "logarithms of ±60", _huge_scales, renders=False),
        made("nasty/scales_beyond_88", "logarithms beyond ±88, which count as ±88", _scales_88, renders=False),
        made("nasty/scales_of_float", "logarithms of ±1e4 and ±3e38", _scales_of_float, renders=False),
        made("nasty/needles", "one axis 1e5 to 1e30 times the others", _needles, renders=False),
        made("nasty/far_coordinates", "centres about 1,000,000", _far, apart=30.0),
        made(
            "nasty/far_doubles",
            "centres about 4,000,000 in doubles: binary32 holds them not exactly, relative to any origin",
            _far_doubles,
            Layout(means_dtype="f8"),
        ),
        made("nasty/outlier", "one splat 100,000 times as far as the others", _outlier, renders=False),
        made("nasty/edge_of_float", "one centre at 3e38 and −3e38, near the end of binary32", _edge, renders=False),
        made("nasty/duplicates", "every third splat four times", _duplicates),
        made("nasty/one_place", "one splat 20,000 times", _one_place, renders=False),
        made("nasty/tiny_scene", "a scene of a millionth of a unit", _tiny, apart=APART * 1e-6),
        made("nasty/huge_colours", "coefficients of ±1e6 beside small ones", _huge_colours, renders=False),
        made("nasty/not_a_number", "NaN in three rows", _with_nan, renders=False),
        made("nasty/infinities", "infinite centres, rotations and colours: four rows are no splats", _infinities),
        made("nasty/infinite_scales", "scales of ±infinity, two rows of discs: none is a splat", _infinite_scales),
        made("nasty/beyond_float", "doubles beyond binary32: two rows are no splats", _beyond, Layout(dtype="f8")),
    ]


def _infinite_logits() -> Splats:
    splats = cloud(64, 0, 21)
    splats.logits[::3], splats.logits[1::3] = np.inf, -np.inf
    return splats


def _zero_quats() -> Splats:
    splats = cloud(64, 0, 22)
    splats.quats[::5] = 0.0
    splats.quats[::10, 2] = -0.0
    return splats


def _extreme_quats() -> Splats:
    splats = cloud(64, 0, 32)
    factors = np.array([1e-30, 1e30, 1e-38, 1e37, 1e-20, 1e20, 1e-10, 1e10], np.float32)
    splats.quats[:56] *= np.repeat(factors, 7)[:, None]
    splats.quats[56:60] = np.array([[1, -1, 1, 1], [1, 1, 1, -1], [-1, 0, 1, 0], [0, 0, -1, 1]]) * np.float32(3e38)
    splats.quats[60:64] = np.array([[1, 0, 0, 0], [0, 1, -1, 0], [-2, 3, 1, 1], [3, 1, 1, 9]]) * np.float32(1.4e-45)
    return splats


def _huge_scales() -> Splats:
    splats = cloud(64, 0, 23)
    splats.scales[0], splats.scales[1], splats.scales[2] = 60.0, -60.0, (60.0, 0.0, -60.0)
    return splats


def _scales_88() -> Splats:
    """Half of the splats lie beyond with all their scales: their errors are 0, whatever becomes of the scales."""
    splats = cloud(64, 0, 33)
    ends = np.array([88.0, 88.5, 88.7229, 89.0, 104.0], np.float32)
    splats.scales[:5, 0], splats.scales[5:10, 1] = ends, -ends
    splats.scales[32:48] += np.float32(94.0)
    splats.scales[48:] -= np.float32(94.0)
    return splats


def _scales_of_float() -> Splats:
    splats = cloud(64, 0, 33)
    ends = np.array([1e4, 3e38], np.float32)
    splats.scales[:2, 0], splats.scales[2:4, 1] = ends, -ends
    splats.scales[4:6], splats.scales[6:8] = ends[:, None], -ends[:, None]
    return splats


def _needles() -> Splats:
    splats, rng = cloud(64, 0, 34), np.random.default_rng(34)
    long = rng.integers(0, 3, 64)
    ratio = np.where(np.arange(64) % 8, 1e5, 1e30)
    splats.scales[:] = (np.log(0.05) - np.log(ratio))[:, None]
    splats.scales[np.arange(64), long] = np.log(0.05)
    return splats


def _far() -> Splats:
    splats = cloud(64, 0, 24)
    splats.means = (splats.means.astype(np.float64) * 1000.0 + [1e6, -1e6, 1e6]).astype(np.float32)
    splats.scales += np.float32(np.log(1000.0))
    return splats


def _far_doubles() -> Splats:
    splats, rng = cloud(216, 1, 35), np.random.default_rng(35)
    low_bits = rng.uniform(-1e-8, 1e-8, (216, 3))
    splats.means = splats.means.astype(np.float64) + np.array((500_123.4, 4_012_345.6, -123.4)) + low_bits
    return splats


def _outlier() -> Splats:
    splats = cloud(125, 0, 25)
    splats.means[77] = (1e5, 0.0, -1e5)
    return splats


def _edge() -> Splats:
    splats = cloud(125, 0, 36)
    splats.means[77] = (3e38, 0.0, -3e38)
    return splats


def _duplicates() -> Splats:
    splats = cloud(64, 1, 26)
    return splats.select(np.repeat(np.arange(64), np.where(np.arange(64) % 3, 1, 4)))


def _one_place() -> Splats:
    return cloud(1, 1, 37).select(np.zeros(20_000, np.intp))


def _tiny() -> Splats:
    splats = cloud(64, 0, 27)
    splats.means *= np.float32(1e-6)
    splats.scales += np.float32(np.log(1e-6))
    return splats


def _huge_colours() -> Splats:
    splats = cloud(64, 1, 28)
    splats.sh0[3], splats.sh0[4], splats.shN[5] = 1e6, -1e6, 1e6
    splats.sh0[6] = (1e6, -1e6, 1e6)  # grey has no chroma
    return splats


def _with_nan() -> Splats:
    splats = cloud(64, 1, 29)
    splats.means[3, 1], splats.logits[17], splats.shN[40, 2, 2] = np.nan, np.nan, np.nan
    return splats


def _infinities() -> Splats:
    splats = cloud(64, 1, 38)
    splats.means[3, 1], splats.quats[17, 0], splats.sh0[20, 1], splats.shN[40, 2, 2] = np.inf, -np.inf, np.inf, -np.inf
    return splats


def _infinite_scales() -> Splats:
    splats = cloud(64, 1, 39)
    splats.scales[5:7, 2], splats.scales[30], splats.scales[50, 0] = -np.inf, -np.inf, np.inf
    return splats


def _beyond() -> Splats:
    splats = cloud(64, 1, 40)
    splats.means, splats.sh0 = splats.means.astype(np.float64), splats.sh0.astype(np.float64)
    splats.means[9, 0], splats.sh0[33, 2] = 1e39, -1e300
    return splats

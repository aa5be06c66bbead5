# SPDX-License-Identifier: Apache-2.0
"""Helpers of the tests of ply, which several files share."""

import numpy as np

ARRAYS = ("means", "quats", "scales", "sh0", "shN")


def header_of(path):
    return path.read_bytes().split(b"end_header\n")[0].decode().splitlines()


def columns_of(degree, *, normals=True):
    names = ["x", "y", "z"] + (["nx", "ny", "nz"] if normals else [])
    names += ["f_dc_0", "f_dc_1", "f_dc_2"]
    names += [f"f_rest_{i}" for i in range(3 * ((degree + 1) ** 2 - 1))]
    names += ["opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"]
    return names


def assert_same_scene(expected, actual):
    for name in ARRAYS:
        assert np.array_equal(getattr(expected, name), getattr(actual, name)), name
    np.testing.assert_allclose(actual.opacities, expected.opacities, rtol=2e-6, atol=1e-7)

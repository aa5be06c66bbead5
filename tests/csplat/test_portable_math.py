# SPDX-License-Identifier: Apache-2.0
"""The bytes of presets do not depend on the processor; exponentials and logarithms of `csplat.portable_math`."""

import json
import math
import os
import subprocess
import sys

import numpy as np
import pytest
from numpy._core import _multiarray_umath as core  # its lists of processors' features have no public name

from csplat.portable_math import ceil_log2, exp, log, log2

#: Instructions that NumPy uses on this processor and not on all.
WIDE = [name for name in core.__cpu_dispatch__ if core.__cpu_features__[name]]

#: Restricts NumPy, its OpenBLAS and the C library of GNU to what older processors have.
OLDER = {
    "NPY_DISABLE_CPU_FEATURES": " ".join(WIDE),
    "OPENBLAS_CORETYPE": "Nehalem",
    "GLIBC_TUNABLES": "glibc.cpu.hwcaps=-AVX2,-FMA,-FMA4,-AVX",
}

#: Prints a hash of each file, and values that are known to depend on the processor.
CHILD = """
import hashlib, json, sys
from dataclasses import replace
import numpy as np
from csplat import EncodeOptions, encode, read
sample = read(sys.argv[1])
part = sample.select(np.arange(0, len(sample), 8))
ties = replace(sample, means=np.round(sample.means, 1))
cases = {
    "fast": (sample, {}),
    "50 dB of degree 1": (sample, {"attribute_psnr": 50, "sh_degree": 1}),
    "equal coordinates": (ties, {"tile_splats": 500, "sh_degree": 0}),
    "balanced": (part, {"preset": "balanced", "deflate_level": 1}),
    "small": (part, {"preset": "small", "deflate_level": 1}),
}
found = {}
for name, (model, options) in cases.items():
    data = encode(model, EncodeOptions(**{"preset": "fast", **options}))
    found[name] = hashlib.sha256(data).hexdigest()
rng = np.random.default_rng(0)
values = np.exp(rng.random(10_000, np.float32)), np.argpartition(rng.integers(0, 9, 10_000).astype(np.float32), 5_000)
print(json.dumps([found, hashlib.sha256(b"".join(map(bytes, values))).hexdigest()]))
"""


def hashes(sample_path, settings):
    command = [sys.executable, "-W", "ignore", "-c", CHILD, str(sample_path)]
    result = subprocess.run(command, env={**os.environ, **settings}, capture_output=True, text=True, check=True)
    return json.loads(result.stdout)


@pytest.mark.slow
@pytest.mark.skipif(not WIDE, reason="NumPy uses no instructions here that some processors of this kind lack")
def test_presets_write_the_same_bytes_on_an_older_processor(sample_path):
    files, values = hashes(sample_path, {})
    narrow_files, narrow_values = hashes(sample_path, OLDER)
    assert values != narrow_values, "the settings have no effect"
    assert files == narrow_files


def ulps(expected, found):
    return np.max(np.abs(found - expected) / np.spacing(np.abs(expected)))


def test_exp_is_within_an_ulp_and_logarithms_within_two():
    rng = np.random.default_rng(0)
    for reach in (1e-8, 1.0, 40.0, 708.0):
        x = rng.uniform(-reach, reach, 3000)
        assert ulps(np.vectorize(math.exp)(x), exp(x)) <= 1.5  # both results are within an ulp
    for reach in (1e-8, 0.5, 1020.0):
        x = np.exp2(rng.uniform(-reach, reach, 3000))
        x = x[x != 1.0]
        assert ulps(np.vectorize(math.log)(x), log(x)) <= 2.5
        assert ulps(np.vectorize(math.log2)(x), log2(x)) <= 2.5


def test_exp_and_logarithms_of_extremes():
    x = np.array([-np.inf, -1e300, -746.0, -744.0, -710.0, -0.0, 709.78, 709.79, 1e300, np.inf, np.nan])
    expected = [0.0, 0.0, 0.0, math.exp(-744), math.exp(-710), 1.0, math.exp(709.78), np.inf, np.inf, np.inf, np.nan]
    np.testing.assert_allclose(exp(x), expected, rtol=4e-16, atol=0.0)
    least, subnormal, most = 2.0**-1074, 1e-310, float(np.finfo(np.float64).max)
    x = np.array([0.0, -0.0, least, subnormal, 1.0, most, np.inf, -1.0, -np.inf, np.nan])
    finite = [math.log(least), math.log(subnormal), 0.0, math.log(most)]
    expected = [-np.inf, -np.inf, *finite, np.inf, np.nan, np.nan, np.nan]
    np.testing.assert_allclose(log(x), expected, rtol=4e-16, atol=0.0)
    np.testing.assert_allclose(log2(x), np.array(expected) / math.log(2.0), rtol=4e-16, atol=0.0)


def test_log2_of_powers_of_two_is_exact():
    exponents = np.arange(-1074, 1024)
    assert np.array_equal(exponents, log2(np.ldexp(1.0, exponents)))
    values = (2.0**-1074, 0.5, 1.0, math.nextafter(1.0, 2.0), 2.0, 2.5, 1.7e308)
    assert [-1074, -1, 0, 1, 1, 2, 1024] == [ceil_log2(value) for value in values]


def test_shapes_and_kinds_of_numbers_are_kept():
    assert (2, 0, 3) == exp(np.zeros((2, 0, 3), np.float32)).shape
    many = np.linspace(0.5, 9.0, 30_000, dtype=np.float32).reshape(-1, 3)
    assert np.array_equal(log(many[::2].T)[1, 7], log(float(many[14, 1])))
    assert 1.0 == float(exp(0.0))

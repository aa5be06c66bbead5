# SPDX-License-Identifier: Apache-2.0
"""Tests of csplat.errors."""

from __future__ import annotations

import io
import pickle
from dataclasses import replace

import numpy as np
import pytest

import csplat
from csplat.errors import CsplatError, FormatError, InputError, LimitError, UnsupportedError


@pytest.mark.parametrize("function", [csplat.read, csplat.decode, csplat.read_header, csplat.lint_ply])
def test_other_objects_than_files_are_typed_errors(function, tmp_path):
    for wrong in (5, None, 1.5, ["scene.ply"], io.StringIO("ply\n")):
        with pytest.raises(InputError, match="expected"):
            function(wrong)
    with pytest.raises(FileNotFoundError, match="absent"):
        function(tmp_path / "absent")


@pytest.mark.parametrize(("error", "message", "fields"), [
    (FormatError("E_CRC", 12, "CRC-1", "found 0x1a"), "E_CRC at byte 12 (CRC-1): found 0x1a",
        {"code": "E_CRC", "offset": 12, "clause": "CRC-1"}),
    (FormatError("E_COUNT", 40, "IDX-3", found=7, wanted="at most 5"),
        "E_COUNT at byte 40 (IDX-3): found 7, expected at most 5", {}),
    (FormatError("E_HASH", None, "SHA-1"), "E_HASH (SHA-1)", {}),
    (UnsupportedError("0.7"), "E_UNSUPPORTED: 0.7 is not supported", {"code": "E_UNSUPPORTED", "feature": "0.7"}),
    (UnsupportedError("x", code="E_VERSION", offset=8, clause="VER-1"),
        "E_VERSION at byte 8 (VER-1): x is not supported", {"code": "E_VERSION", "offset": 8, "clause": "VER-1"}),
    (LimitError("most", 10, 5), "E_LIMIT: most: needs 10, allowed 5", {"limit": "most", "wanted": 10, "allowed": 5}),
    (LimitError("x", 2, code="E_BUDGET", offset=3), "E_BUDGET at byte 3: x: needs 2", {"code": "E_BUDGET"}),
    (InputError("x"), "x", {"code": "E_INPUT"}),
])  # fmt: skip
def test_an_error_names_code_place_and_values_also_in_another_process(error, message, fields):
    for one in (error, pickle.loads(pickle.dumps(error))):  # noqa: S301 -- our own bytes
        assert isinstance(one, CsplatError)
        assert (message, fields) == (str(one), {name: getattr(one, name) for name in fields})


@pytest.mark.parametrize(("field", "value", "message"), [
    ("means", np.zeros((10, 2), np.float32), r"means has shape \[10, 2\]"),
    ("means", np.float32(1), "means is a float32, expected a float32 array"),
    ("quats", np.zeros((10, 3), np.float32), r"quats has shape \[10, 3\], expected \[10, 4\]"),
    ("scales", np.zeros((9, 3), np.float32), r"scales has shape \[9, 3\], expected \[10, 3\]"),
    ("opacities", np.zeros((10, 1), np.float32), "opacities has shape"),
    ("sh0", np.zeros((10, 3)), "sh0 is float64, expected float32"),
    ("sh0", np.zeros((10, 3), ">f4"), "sh0 is >f4, expected float32"),
    ("shN", np.zeros((10, 4, 3), np.float32), "4 coefficients per channel, expected 0, 3, 8"),
    ("shN", np.zeros((10, 45), np.float32), "shN has shape"),
    ("opacities", np.full(10, 1.5, np.float32), "alpha in .0, 1."),
    ("opacities", np.full(10, -0.1, np.float32), "not logits"),
    ("quats", np.zeros((10, 4), np.float32), "10 rows that are not of unit length"),
    ("quats", np.full((10, 4), 1e30, np.float32), "10 rows that are not of unit length"),
    ("origin", (1.0, 2.0), "expected three numbers"),
    ("origin", (1.0, 2.0, float("nan")), "expected finite numbers"),
    ("coordinate_system", "XYZ", "the axes are 'XYZ'"),
    ("coordinate_system", "RLU", "the axes are 'RLU'"),
    ("unit_metres", 0.0, "unit_metres is 0.0"),
    ("unit_metres", float("inf"), "unit_metres is inf"),
    ("extra", {"id": np.zeros(9)}, "extra column 'id' has shape .9,., expected .10,."),
    ("extra", {"id": np.zeros(10, bool)}, "extra column 'id' is bool"),
])  # fmt: skip
def test_invalid_fields_are_refused(make_model, field, value, message):
    with pytest.raises(InputError, match=message):
        make_model(10, **{field: value})


@pytest.mark.parametrize("field", ["means", "quats", "scales", "opacities", "sh0", "shN"])
def test_values_that_are_not_finite_are_refused(make_model, field):
    for value in (np.nan, np.inf, -np.inf):
        array = getattr(make_model(), field).copy()
        array.flat[-1] = value
        with pytest.raises(InputError, match=rf"{field} contains NaN or infinity \(1 value\)"):
            make_model(**{field: array})


def test_doubles_have_to_match_their_means(make_model):
    origin = (5e5, 5e6, 300.0)
    doubles = np.random.default_rng(1).normal(0, 1, (10, 3)) + np.array(origin)
    means = (doubles - np.array(origin)).astype(np.float32)
    model = make_model(10, 0, means=means, origin=origin, means_double=doubles)
    np.testing.assert_array_equal(model.means_double[[3, 1]], model.select(np.array([3, 1])).means_double)
    assert replace(model, means=model.means + 1, means_double=None).means_double is None
    for wrong in ({"means": model.means + 1}, {"origin": (0.0, 0.0, 0.0)}, {"means_double": model.means}):
        with pytest.raises(InputError, match="means_double"):
            replace(model, **wrong)

"""FLIP: the result of the package's own example, and the message if the package is absent."""

import importlib

import numpy as np
import pytest

from csplat.errors import InputError
from csplat_render.metrics import flip


def test_flip_is_zero_for_equal_pictures_and_grows():
    pytest.importorskip("flip_evaluator", reason="an optional package: pip install 'csplat[flip]'")
    a = np.random.default_rng(0).random((40, 50, 3)).astype(np.float32)
    assert 0.0 == flip(a, a)
    assert 0.0 < flip(a, 0.95 * a) < flip(a, 0.7 * a) <= 1.0
    assert flip(a, 0.95 * a) == flip(a.astype(np.float64), (0.95 * a).astype(np.float64))


def test_black_against_white_differs_fully():
    pytest.importorskip("flip_evaluator", reason="an optional package: pip install 'csplat[flip]'")
    black = np.zeros((30, 30, 3))
    assert flip(black, black + 1.0) > 0.9


def test_refuses_pictures_that_differ_in_shape():
    with pytest.raises(InputError, match="FLIP"):
        flip(np.zeros((4, 4, 3)), np.zeros((4, 5, 3)))


def test_an_absent_package_is_named(monkeypatch):
    def absent(name):
        raise ImportError(name)

    monkeypatch.setattr(importlib, "import_module", absent)
    with pytest.raises(InputError, match="flip-evaluator"):
        flip(np.zeros((4, 4, 3)), np.zeros((4, 4, 3)))

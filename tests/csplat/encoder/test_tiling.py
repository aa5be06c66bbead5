# SPDX-License-Identifier: Apache-2.0
"""Tests of csplat.encoder.tiling."""

from __future__ import annotations

import itertools
import math

import numpy as np

from csplat.encoder.coding_parameters import Lattice
from csplat.encoder.quantisation import quantise_means
from csplat.encoder.tiling import cut_tiles


def cloud(count: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).uniform(-1, 1, (count, 3)).astype(np.float32)


def test_every_splat_is_in_one_of_the_fewest_tiles():
    for count in (0, 1, 2, 99, 100, 101, 1000):
        tiles = cut_tiles(cloud(count), Lattice(1e-3, 16), 100)
        rows = np.concatenate([np.zeros(0, np.intp), *(tile.rows for tile in tiles)])
        assert list(range(count)) == sorted(rows.tolist())
        assert all(len(tile.rows) <= 100 for tile in tiles)
        assert math.ceil(count / 100) == len(tiles)


def test_an_outlier_gets_a_tile_of_its_own():
    means = np.concatenate([cloud(1000), [[1000, 0, 0]]]).astype(np.float32)
    tiles = cut_tiles(means, Lattice(1e-4, 16), 65536)
    assert [0, 0] == [tile.exponent for tile in tiles]
    assert sorted([1, 1000]) == sorted(len(tile.rows) for tile in tiles)


def test_no_tile_exceeds_its_bits():
    for bits, scale, finest in itertools.product((2, 8, 16), (1e-30, 1.0, 1e30), (False, True)):
        means = (cloud(300) * scale).astype(np.float32)
        lattice = Lattice(scale / 2**bits, bits, finest)
        for tile in cut_tiles(means, lattice, 60):
            n = quantise_means(means[tile.rows].T.copy(), math.ldexp(lattice.step, tile.exponent))
            extent = int((n.max(axis=1) - n.min(axis=1)).max())
            assert extent < 2**bits
            assert np.abs(n).max() <= 2**53
            if finest and bits > 2:
                assert extent >= 2 ** (bits - 2)


def test_means_from_denormal_to_huge_are_tiled():
    rng = np.random.default_rng(0)
    magnitudes = 10.0 ** rng.uniform(-38, 38, (2000, 1))
    means = (rng.choice([-1, 1], (2000, 3)) * magnitudes).astype(np.float32)
    tiles = cut_tiles(means, Lattice(1e-3, 16), 65536)
    assert 2000 == sum(len(tile.rows) for tile in tiles)
    for tile in tiles:
        step = math.ldexp(1e-3, tile.exponent)
        assert np.isfinite(quantise_means(means[tile.rows].T.copy(), step)).all()

"""Tiles hold every splat once, are full where they can be, and keep outliers from coarsening the rest."""

import numpy as np
import pytest

from csplat.encoder.coding_parameters import Lattice
from csplat.encoder.quantisation import lattice_step, quantise_means
from csplat.encoder.tiling import cut_tiles


def cloud(count: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).uniform(-1, 1, (count, 3)).astype(np.float32)


@pytest.mark.parametrize("count", [0, 1, 2, 99, 100, 101, 1000])
def test_every_splat_is_in_one_tile(count):
    tiles = cut_tiles(cloud(count), Lattice(1e-3, 16), 100)
    rows = np.concatenate([tile.rows for tile in tiles]) if tiles else np.zeros(0, np.intp)
    assert list(range(count)) == sorted(rows.tolist())
    assert all(len(tile.rows) <= 100 for tile in tiles)


def test_tiles_are_as_few_as_they_can_be():
    assert 10 == len(cut_tiles(cloud(1000), Lattice(1e-3, 16), 100))


def test_an_outlier_gets_a_tile_of_its_own():
    means = np.concatenate([cloud(1000), [[1000, 0, 0]]]).astype(np.float32)
    tiles = cut_tiles(means, Lattice(1e-4, 16), 65536)
    assert [0, 0] == [tile.exponent for tile in tiles]
    assert sorted([1, 1000]) == sorted(len(tile.rows) for tile in tiles)


@pytest.mark.parametrize("finest", [False, True])
@pytest.mark.parametrize("bits", [2, 8, 16])
@pytest.mark.parametrize("scale", [1e-30, 1.0, 1e30])
def test_no_tile_needs_more_bits_than_it_may_use(bits, scale, finest):
    means = (cloud(500) * scale).astype(np.float32)
    lattice = Lattice(scale / 2**bits, bits, finest)
    for tile in cut_tiles(means, lattice, 100):
        n = quantise_means(means[tile.rows].T.copy(), lattice_step(lattice.step, tile.exponent))
        extent = int((n.max(axis=1) - n.min(axis=1)).max())
        assert extent < 2**bits
        assert np.abs(n).max() <= 2**53
        if finest and bits > 2:
            assert extent >= 2 ** (bits - 2)


def test_magnitudes_from_denormal_to_huge_are_cut_apart():
    rng = np.random.default_rng(0)
    magnitudes = 10.0 ** rng.uniform(-38, 38, (2000, 1))
    means = (rng.choice([-1, 1], (2000, 3)) * magnitudes).astype(np.float32)
    tiles = cut_tiles(means, Lattice(1e-3, 16), 65536)
    assert 2000 == sum(len(tile.rows) for tile in tiles)
    for tile in tiles:
        step = lattice_step(1e-3, tile.exponent)
        assert np.isfinite(quantise_means(means[tile.rows].T.copy(), step)).all()

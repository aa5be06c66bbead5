# SPDX-License-Identifier: Apache-2.0
"""Tests of csplat_render.gpu.packing.

Also: csplat.decoder.packed, csplat.packed.
"""

import numpy as np
import pytest
from oracle import extreme_splats

from csplat.decoder import iter_packed
from csplat.errors import LimitError
from csplat_authoring.builder import build
from csplat_authoring.samples import rich_scene
from csplat_render.conventions import UncheckedSplats
from csplat_render.gpu.packing import BLOCK, SharedTables, pack_splats, pack_tile


class Reader:
    """Reads a splat of a packed tile as layout.wgsl does."""

    def __init__(self, tile, splat):
        self.tile, self.bit = tile, 0
        words_per_splat = int(tile.constants[0, 1])
        first = splat // BLOCK * BLOCK * words_per_splat + splat % BLOCK
        words = tile.words[first : first + BLOCK * words_per_splat : BLOCK]
        self.bits = int.from_bytes(words.astype("<u4").tobytes(), "little")

    def field(self, width):
        value = self.bits >> self.bit & (1 << width) - 1
        self.bit += width
        return float(np.uint32(value).view(np.float32)) if width == 32 else value


def test_packed_words_hold_every_field():
    for tile in iter_packed(build(rich_scene()).data):
        words = pack_tile(tile, SharedTables(1 << 20), np.zeros(3), antialiased=False)
        bits = [int(word) >> shift & 255 for word in words.constants[1, :2] for shift in (0, 8, 16, 24)]
        for splat in range(len(tile.opacities)):
            reader = Reader(words, splat)
            means = words.corner + words.step * np.array([reader.field(width) for width in bits[:3]])
            np.testing.assert_allclose(tile.means.integers[splat] * tile.means.step, means)
            assert tile.opacities[splat] == reader.field(bits[3])
            scales, quats, sh0 = (np.array([reader.field(width) for _ in range(3)]) for width in bits[4:7])
            assert (tile.quats[splat] + tile.quat_levels).tolist() == quats.tolist()
            for packed, row, found in ((tile.scales, 2, scales), (tile.sh0, 3, sh0)):
                *offsets, step = words.constants[row].view(np.float32).astype(np.float64)
                np.testing.assert_allclose(packed.integers[splat] * packed.step, offsets + found * step, rtol=1e-6)


def test_splats_with_nan_have_no_opacity():
    arrays = extreme_splats(count=4)
    arrays["shN"][1, 2, 0] = np.nan
    arrays["means"][2, 0] = np.inf
    arrays["sh0"][3] = 2e38
    splats = UncheckedSplats(**{name: np.asarray(array, np.float32) for name, array in arrays.items()})
    for degree, good in ((3, [1, 0, 0, 1]), (0, [1, 1, 0, 1])):
        packed = pack_splats(splats, slice(0, 4), np.zeros(3), antialiased=True, sh_degree=degree)
        assert 4 - sum(good) == packed.ignored
        found = packed.words[3 * BLOCK : 3 * BLOCK + 4].view(np.float32)
        np.testing.assert_array_equal(np.where(good, splats.opacities, 0.0), found)


def test_codebooks_that_do_not_fit_are_refused():
    tile = next(iter_packed(build(rich_scene()).data))
    with pytest.raises(LimitError, match="codebooks"):
        pack_tile(tile, SharedTables(1), np.zeros(3), antialiased=False)

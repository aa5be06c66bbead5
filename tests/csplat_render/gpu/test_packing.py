"""Tests of csplat_render.gpu.packing."""

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


def floats(words):
    return words.view(np.float32).astype(np.float64)


def test_packed_words_hold_every_field():
    data = build(rich_scene()).data
    for tile in iter_packed(data):
        words = pack_tile(tile, SharedTables(1 << 20), np.zeros(3), antialiased=False)
        bits = [int(word) >> shift & 255 for word in words.constants[1, :2] for shift in (0, 8, 16, 24)]
        for splat in range(len(tile.opacities)):
            reader = Reader(words, splat)
            means = words.corner + words.step * np.array([reader.field(width) for width in bits[:3]])
            np.testing.assert_allclose(tile.means.integers[splat] * tile.means.step, means)
            assert tile.opacities[splat] == reader.field(bits[3])
            for packed, width, row in ((tile.scales, bits[4], 2), (None, bits[5], 0), (tile.sh0, bits[6], 3)):
                found = np.array([reader.field(width) for _ in range(3)])
                if packed is None:
                    assert (tile.quats[splat] + tile.quat_levels).tolist() == found.tolist()
                else:
                    *offsets, step = floats(words.constants[row])
                    np.testing.assert_allclose(packed.integers[splat] * packed.step, offsets + found * step, rtol=1e-6)


def float32_splats(arrays):
    return UncheckedSplats(**{name: np.asarray(array, np.float32) for name, array in arrays.items()})


def test_splats_with_nan_have_no_opacity():
    arrays = extreme_splats(count=4)
    arrays["shN"][1, 2, 0] = np.nan
    arrays["means"][2, 0] = np.inf
    arrays["sh0"][3] = 2e38
    for degree, bad in ((3, (0, 1, 1, 0)), (0, (0, 0, 1, 0))):
        words = pack_splats(float32_splats(arrays), slice(0, 4), np.zeros(3), antialiased=True, sh_degree=degree)
        assert sum(bad) == words.ignored
        assert [0.0 if one else alpha for alpha, one in zip(np.float32(arrays["opacities"]), bad, strict=True)] == [
            np.float32(words.words[3 * BLOCK + splat].view(np.float32)) for splat in range(4)
        ]


def test_codebooks_that_do_not_fit_are_refused():
    tile = next(iter_packed(build(rich_scene()).data))
    with pytest.raises(LimitError, match="codebooks"):
        pack_tile(tile, SharedTables(1), np.zeros(3), antialiased=False)

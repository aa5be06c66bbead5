"""`csplat_bench.codec.parts`: the box that it reads, and what it counts."""

import numpy as np
import pytest

import csplat
from csplat_bench.codec.parts import measured, middle_box

pytestmark = pytest.mark.area(name="benchmarks")


@pytest.fixture(scope="module")
def path(sample_path, tmp_path_factory):
    path = tmp_path_factory.mktemp("parts") / "scene.csplat"
    path.write_bytes(csplat.encode(csplat.read_ply(sample_path), csplat.EncodeOptions(preset="fast", tile_splats=500)))
    return path


@pytest.mark.parametrize("share", [1e-6, 0.1, 0.5, 1.0])
def test_the_box_has_the_share_of_the_splats_or_just_more(path, share):
    with csplat.open(path) as file:
        low, high = np.reshape(middle_box(file, share), (2, 3))
        found = [tile.tile.splat_count for tile in file.tiles((*low, *high), sh_degree=0)]
        smaller = (low + 1e-6, high - 1e-6)
        less = [] if (smaller[0] > smaller[1]).any() else list(file.tiles((*smaller[0], *smaller[1]), sh_degree=0))
        assert share * len(file) <= sum(found)
        assert sum(len(one.means) for one in less) < sum(found) or share == 1e-6


def test_what_is_read_is_counted_from_opening_on(path):
    with csplat.open(path) as file:
        box = middle_box(file, 0.1)
        model = file.read(box, sh_degree=0)
        row = measured("disk", str(path), None, box, 0, 1)
        assert ("disk", 0, len(model), file.requests, file.bytes_read) == (
            row.place, row.sh_degree, row.splats, row.requests, row.bytes_read,
        )  # fmt: skip
    assert 0.0 < row.open_seconds < row.seconds

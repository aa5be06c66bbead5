"""Parts of a file as files of their own."""

import io
import math
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

import csplat
import csplat_conformance
from csplat import EncodeOptions, FormatError, InputError, decode, encode, read_header, read_ply
from csplat.decoder import read_declared_bounds, read_metadata, read_options
from csplat_conformance.validator import validate
from csplat_tools.cli.app import app

VECTORS = Path(csplat_conformance.__file__).parent / "vectors" / "valid"
ALL = (-1e6, -1e6, -1e6, 1e6, 1e6, 1e6)


@pytest.fixture(scope="module")
def data(sample_path):
    return encode(read_ply(sample_path).select(slice(0, None, 3)), EncodeOptions(tile_splats=350))


def extract(data, box):
    """The part, and its bytes."""
    stream = io.BytesIO()
    part = csplat.extract(data, box, stream)
    assert part.size == len(stream.getvalue())
    return part, stream.getvalue()


def box_of(tile, header):
    step = math.ldexp(header.attributes[3].step, tile.exponent)
    low = [corner * step for corner in tile.corner]
    return low, [(corner + extent) * step for corner, extent in zip(tile.corner, tile.extent, strict=True)]


def test_a_part_has_the_tiles_that_touch_the_box_bit_for_bit(data):
    header = read_header(data)
    low, high = box_of(header.tiles[2], header)
    part, cut = extract(data, (*high, *low))
    assert 2 in part.tiles
    assert 1 <= len(part.tiles) < len(header.tiles)
    whole, found = decode(data, tiles=part.tiles), decode(cut)
    assert part.splat_count == len(found) == len(whole)
    for name in ("means", "quats", "scales", "opacities", "sh0", "shN"):
        np.testing.assert_array_equal(getattr(whole, name), getattr(found, name))
    for index, tile in enumerate(header.tiles):
        least, most = box_of(tile, header)
        touches = all(least[k] <= high[k] and most[k] >= low[k] for k in range(3))
        assert touches == (index in part.tiles)
    assert () == validate(cut).violations
    assert len(cut) < 0.9 * len(data)


def test_a_part_says_of_the_scene_what_the_file_says_and_nothing_of_its_errors(data):
    part = extract(data, ALL)[1]
    assert read_metadata(data) == read_metadata(part)
    assert decode(data).cameras == decode(part).cameras
    assert read_declared_bounds(data) is not None
    assert read_declared_bounds(part) is None
    assert read_options(part) is None
    before, after = read_header(data), read_header(part)
    for name in ("origin", "coordinate_system", "antialiased", "flat", "unit_metres", "sh_degree", "codebooks"):
        assert getattr(before, name) == getattr(after, name)
    assert part == extract(part, ALL)[1]


def test_extra_columns_come_along(sample_path):
    model = read_ply(sample_path).select(slice(0, 500))
    model.extra["id"] = np.arange(500, dtype=np.uint32)
    data = encode(model, EncodeOptions(preset="fast", keep_extra=True))
    np.testing.assert_array_equal(decode(data).extra["id"], decode(extract(data, ALL)[1]).extra["id"])


@pytest.mark.parametrize(
    "name", ["rich", "combined_codebooks", "combined_tiles", "ancillary_extras", "chunks_reversed"]
)
def test_everything_of_a_vector_decodes_to_the_same(name):
    data = (VECTORS / f"{name}.csplat").read_bytes()
    _, part = extract(data, (-1e300, -1e300, -1e300, 1e300, 1e300, 1e300))
    assert () == validate(part).violations
    whole, found = decode(data), decode(part)
    for array in ("means", "quats", "scales", "opacities", "sh0", "shN"):
        np.testing.assert_array_equal(getattr(whole, array), getattr(found, array))
    assert whole.extra.keys() == found.extra.keys()


def test_a_box_that_nothing_touches_is_refused(data):
    with pytest.raises(InputError, match="no tile touches the box 1000, 1000, 1000"):
        extract(data, (1000, 1000, 1000, 1001, 1001, 1001))
    with pytest.raises(InputError, match="six finite numbers"):
        extract(data, (0, 0, 0, 1, 1, math.inf))


def test_what_is_copied_is_checked(data):
    header = read_header(data)
    record = header.tiles[0].layers[0]
    damaged = bytearray(data)
    damaged[record.offset + record.size - 1] ^= 1
    with pytest.raises(FormatError, match="E_CRC"):
        extract(bytes(damaged), ALL)


def test_the_command_says_what_it_cut(data, tmp_path):
    (tmp_path / "in.csplat").write_bytes(data)
    header = read_header(data)
    low, high = box_of(header.tiles[2], header)
    words = ["extract", str(tmp_path / "in.csplat"), str(tmp_path / "out.csplat")]
    box = f"--box={','.join(map(repr, (*low, *high)))}"
    done = CliRunner().invoke(app, [*words, box])
    assert 0 == done.exit_code, done.stderr
    assert "splats in" in done.stderr
    assert extract(data, (*low, *high))[1] == (tmp_path / "out.csplat").read_bytes()
    assert 1 == CliRunner().invoke(app, [*words, box]).exit_code  # it is there
    refused = CliRunner().invoke(app, [*words, "--force", "--box=1,2,3"])
    assert 2 == refused.exit_code
    assert "wanted 6 numbers" in refused.stderr

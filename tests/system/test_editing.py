from dataclasses import replace

import numpy as np
import pytest
from editing_cases import STEPS, box_of, extract, merge
from typer.testing import CliRunner

from csplat import EncodeOptions, encode, read_header, read_ply
from csplat_tools.cli.app import app


@pytest.fixture(scope="module")
def sample(sample_path):
    return read_ply(sample_path).select(slice(0, None, 9))


@pytest.fixture(scope="module")
def data(sample):
    return encode(sample, EncodeOptions(tile_splats=120))


def test_the_command_extracts_and_reports(data, tmp_path):
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
    assert "expected 6 numbers" in refused.stderr


@pytest.fixture(scope="module")
def halves(sample):
    """Encode two files with the same steps and separate codebooks of SH and of shapes."""
    order = np.argsort(sample.means[:, 0])
    options = EncodeOptions(
        preset="fast", sh_coding="codebook", codebook_size=64, escape_fraction=0.05, shape_codebook_size=64,
        shape_escape_fraction=0.05, tile_splats=170, keep_extra=True, **STEPS,
    )  # fmt: skip
    ids = np.arange(len(sample), dtype=np.uint32)
    model = replace(sample, extra={"id": ids})
    return [encode(model.select(half), options) for half in np.array_split(order, 2)]


@pytest.mark.slow
def test_the_command_merges_and_reports(halves, make_model, tmp_path):
    for name, data in zip("abc", [*halves, encode(make_model(40, 3))], strict=True):
        (tmp_path / f"{name}.csplat").write_bytes(data)
    a, b, c, out = (str(tmp_path / f"{name}.csplat") for name in ("a", "b", "c", "out"))
    done = CliRunner().invoke(app, ["merge", a, b, "-o", out])
    assert 0 == done.exit_code, done.stderr
    assert "993 splats in 6 tiles, copied: " in done.stderr
    assert merge(*halves)[1] == (tmp_path / "out.csplat").read_bytes()
    assert 1 == CliRunner().invoke(app, ["merge", a, b, "-o", out]).exit_code  # it is there
    refused = CliRunner().invoke(app, ["merge", a, b, "-o", a, "--force"])
    assert 1 == refused.exit_code
    assert "is the input" in refused.stderr
    again = CliRunner().invoke(app, ["merge", a, c, "-o", out, "--force", "--preset", "fast", "--json"])
    assert 0 == again.exit_code, again.stderr
    assert "decoded and coded again (fast): " in again.stderr
    assert '"copied": false' in again.stdout

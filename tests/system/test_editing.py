# SPDX-License-Identifier: Apache-2.0
"""`csplat extract` and `csplat merge`, as users run them.

Also: csplat_tools.cli.extract, csplat_tools.cli.merge.
"""

from dataclasses import replace

import numpy as np
import pytest
from command_line import call
from editing_cases import STEPS, box_of, extract, merge

from csplat import EncodeOptions, decode, encode, read_header
from csplat.ply import read_ply


@pytest.fixture(scope="module")
def sample(sample_path):
    return read_ply(sample_path).select(slice(0, None, 9))


def test_the_command_extracts_and_reports(sample, tmp_path):
    data, out = encode(sample, EncodeOptions(tile_splats=120)), tmp_path / "out.csplat"
    (tmp_path / "in.csplat").write_bytes(data)
    header = read_header(data)
    low, high = box_of(header.tiles[2], header)
    words, box = ("extract", tmp_path / "in.csplat", out), f"--box={','.join(map(repr, (*low, *high)))}"
    said = call(*words, box).stderr
    assert ("splats in" in said, "nothing is left out" in said) == (True, False)
    assert extract(data, (*low, *high))[1] == out.read_bytes()
    call(*words, box, status=1)  # it is there
    assert "expected 6 numbers" in call(*words, "--force", "--box=1,2,3", status=2).stderr
    assert "nothing is left out" in call(*words, "--force", "--box=-9,-9,-9,9,9,9").stderr


@pytest.mark.slow
def test_the_command_merges_and_reports(sample, make_model, tmp_path):
    """Two files have the same steps and separate codebooks of SH and of shapes."""
    options = EncodeOptions(
        preset="fast", sh_coding="codebook", codebook_size=64, escape_fraction=0.05, shape_codebook_size=64,
        shape_escape_fraction=0.05, tile_splats=170, keep_extra=True, **STEPS,
    )  # fmt: skip
    facts = replace(sample.metadata, semantics={"normal": "normal"})
    columns = {"id": np.arange(len(sample), dtype=np.uint32), "normal": np.ones((len(sample), 3), np.float32)}
    model = replace(sample, extra=columns, metadata=facts)
    halves = [encode(model.select(part), options) for part in np.array_split(np.argsort(sample.means[:, 0]), 2)]
    a, b, c, out = (tmp_path / f"{name}.csplat" for name in ("a", "b", "c", "out"))
    for path, data in zip((a, b, c), [*halves, encode(make_model(40, 3))], strict=True):
        path.write_bytes(data)
    assert "993 splats in 6 tiles, copied: " in call("merge", a, b, "-o", out).stderr
    assert merge(*halves)[1] == out.read_bytes()
    merged = decode(out)
    assert (len(sample), {"normal": "normal"}) == (len(np.unique(merged.extra["id"])), merged.metadata.semantics)
    assert (len(sample), 3) == merged.extra["normal"].shape
    call("merge", a, b, "-o", out, status=1)  # it is there
    assert "is the input" in call("merge", a, b, "-o", a, "--force", status=1).stderr
    again = call("merge", a, c, "-o", out, "--force", "--preset", "fast", "--json")
    assert "decoded and coded again (fast): " in again.stderr
    assert "left out: id, normal" in again.stderr
    assert '"copied": false' in again.stdout

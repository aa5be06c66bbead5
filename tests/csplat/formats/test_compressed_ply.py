# SPDX-License-Identifier: Apache-2.0
"""PlayCanvas' compressed PLY: files built word by word, and round trips."""

import struct
from dataclasses import replace

import numpy as np
import pytest
from checked import assert_damage_is_refused_or_read
from models import with_facts

import csplat
from csplat.errors import InputError
from csplat.formats import compressed_ply, detect_format, format_by_suffix, lint_file, read_scene
from csplat.ply import read_ply
from csplat.scene import BLOCK_SPLATS

BOUNDS = "min_x min_y min_z max_x max_y max_z min_scale_x min_scale_y min_scale_z max_scale_x max_scale_y max_scale_z"
COLOURS = "min_r min_g min_b max_r max_g max_b"
WORDS = "packed_position packed_rotation packed_scale packed_color"


def built(bounds, words, sh=(), *, comments=(), colours=True, rest=9):
    lines = ["ply", "format binary_little_endian 1.0", *(f"comment {one}" for one in comments)]
    lines += [f"element chunk {len(bounds)}"]
    lines += [f"property float {name}" for name in f"{BOUNDS} {COLOURS if colours else ''}".split()]
    lines += [f"element vertex {len(words)}", *(f"property uint {name}" for name in WORDS.split())]
    if len(sh):
        lines += [f"element sh {len(sh)}", *(f"property uchar f_rest_{index}" for index in range(rest))]
    rows = [struct.pack(f"<{len(row)}f", *row) for row in bounds] + [struct.pack("<4I", *row) for row in words]
    return "\n".join([*lines, "end_header\n"]).encode() + b"".join([*rows, *map(bytes, sh)])


ROW = [0, 10, -1, 4, 10, 1, -8, -7, -6, -4, -3, -2, 0.5, 0, 0, 1.5, 1, 1]
# The index of the largest component, then three components of ten bits; 511.5 would be 0.
WORD = (2047 << 21 | 1023 << 11 | 0, 1 << 30 | 1023 << 20 | 511 << 10 | 512, 0, 255 << 24 | 0 << 16 | 255 << 8 | 51)
SMALL = built([ROW], [WORD, (0, 0, 0xFFFFFFFF, 0)], [[0, 255, 128, *range(3, 9)], range(9)], comments=["made by hand"])


def test_packed_words_are_recognised_and_read(tmp_path):
    (tmp_path / "a.ply").write_bytes(SMALL)
    assert "compressed-ply" == detect_format(tmp_path / "a.ply").name
    assert ["compressed-ply", "ply"] == [format_by_suffix(tmp_path / one).name for one in ("b.Compressed.ply", "b.ply")]
    with pytest.raises(InputError, match=r"a\.ply is compressed PLY.*csplat convert.*csplat\.read"):
        read_ply(tmp_path / "a.ply")
    model = csplat.read(tmp_path / "a.ply")
    assert [[4, 10, -1], [0, 10, -1]] == model.means.tolist()
    assert [[-8, -7, -6], [-4, -3, -2]] == model.scales.tolist()
    assert np.array([0.2, 0.0], np.float32).tolist() == model.opacities.tolist()
    np.testing.assert_allclose(model.sh0[0] * 0.28209479 + 0.5, [1.5, 0, 1], atol=1e-6)
    half = 0.5 / 1023 * 2**0.5
    np.testing.assert_allclose(model.quats[0], [2**-0.5, (0.5 - 2 * half**2) ** 0.5, -half, half], atol=1e-6)
    assert [-4, 4, 0.5 / 32] == model.shN[0, :, 0].tolist()
    assert [(index + 0.5) / 32 - 4 for index in (3, 6)] == model.shN[0, 0, 1:].tolist()
    assert {"comments": ["made by hand"]} == model.metadata.entries


def test_old_and_empty_elements_rounded_bounds_and_band_4_are_read(tmp_path):
    old = csplat.read(built([ROW[:12]], [WORD], colours=False))  # without bounds of colours
    np.testing.assert_allclose(old.sh0[0] * 0.28209479 + 0.5, [1, 0, 1], atol=1e-6)
    data = built([ROW], [WORD], [()], rest=0)  # as gsplat writes it
    assert b"element sh 1\nend_header\n" in data
    assert (1, 0) == (len(csplat.read(data)), csplat.read(data).sh_degree)
    above = float(np.nextafter(np.float32(4), np.float32(9)))
    (tmp_path / "a.ply").write_bytes(built([[above, *ROW[1:]]], [WORD]))
    assert [] == lint_file(tmp_path / "a.ply")
    four = csplat.read(built([ROW], [WORD], [range(100, 172)], rest=72))
    assert ((np.arange(100, 172).reshape(3, 24).T + 0.5) / 32 - 4).tolist() == four.shN[0].tolist()


def test_splats_far_away_do_not_make_others_coarse(tmp_path, make_model):
    near = make_model(300, 0)
    for far in ([[5e5, 0, 0]], [[300, 0, 0], [0, -3e4, 0], [0, 0, 1e30]], np.full((60, 3), 4000) * [[1, -1, 1]]):
        means = np.concatenate([near.means, np.asarray(far, np.float32)])
        model = near.select(np.arange(len(means)) % 300)
        model = replace(model, means=means, scales=np.full_like(means, -3.0), opacities=np.ones(len(means), "f4"))
        found = {one.id: one for one in csplat.write(tmp_path / "a.compressed.ply", model)}["filling-splats"]
        read = csplat.read(tmp_path / "a.compressed.ply")
        visible = read.select(read.opacities > 0)
        assert (len(model), found.count) == (len(visible), len(read) - len(model))
        order = np.abs(visible.means[:, None] - means).max(axis=2).argmin(axis=1)
        error = np.abs(visible.means - means[order]) / np.maximum(np.abs(means[order]).max(axis=1, keepdims=True), 4)
        assert error.max() < 2e-3
        assert len(np.unique(order)) >= 300
        assert "filling-splats" not in [one.id for one in csplat.write(tmp_path / "b.compressed.ply", read)]


@pytest.mark.slow
def test_written_files_read_back_within_a_step(tmp_path, make_model):
    path, model = tmp_path / "a.compressed.ply", make_model(700, 3, antialiased=True, origin=(1.0, 2.0, 3.0))
    csplat.write(path, with_facts(model, entries={"licence": "CC0"}))
    back = csplat.read(path)
    assert (True, (1.0, 2.0, 3.0), {"licence": "CC0"}) == (
        back.metadata.antialiased,
        back.origin,
        back.metadata.entries,
    )
    # Splats are reordered; the nearest mean identifies each.
    rows = np.array([np.argmin(((model.means - one) ** 2).sum(1)) for one in back.means])
    assert 700 == len(set(rows))
    for name, error in (("means", 0.006), ("scales", 0.006), ("opacities", 0.002), ("sh0", 0.03), ("shN", 0.0157)):
        wanted = getattr(model, name)[rows].clip(-4 if name == "shN" else None, 4)
        assert np.abs(wanted - getattr(back, name)).max() < error
    assert np.abs((model.quats[rows] * back.quats).sum(1)).min() > 1 - 5e-6
    large = model.select(np.arange(BLOCK_SPLATS + 300) % 300)  # blocks consist of whole chunks
    csplat.write(path, large)
    with csplat.open(path) as scene:
        assert [BLOCK_SPLATS, 300] == [len(one) for one in scene.blocks()]
        assert np.abs(np.sort(large.means[:, 0]) - np.sort(scene.model().means[:, 0])).max() < 0.01
    csplat.write(path, make_model(0, 2))
    assert (0, 2) == (len(csplat.read(path)), csplat.read(path).sh_degree)


@pytest.mark.parametrize(("data", "message"), [
    (SMALL[:-1], "copy or download it again"),
    (SMALL.replace(b"vertex 2", b"vertex 2000000000"), "copy or download it again"),
    (SMALL.replace(b"vertex 2", b"vertex " + b"9" * 30), "header line"),
    (SMALL.replace(b"vertex 2", b"vertex -2"), "header line"), (built([ROW, ROW], [WORD]), "2 chunks for 1 splat,"),
    (SMALL.replace(b"element sh 2", b"element sh 1"), "1 row of 9 SH"),
    (SMALL.replace(b"property uchar f_rest_8\n", b""), "8 SH coefficients"),
    (SMALL.replace(b"min_scale_x", b"min_scale_q"), "no float32 min_scale_x"),
    (SMALL.replace(b"uint packed_scale", b"int packed_scale"), "no uint32 packed_scale"),
    (SMALL.replace(b"packed_color", b"packed_scale"), "twice"),
    (SMALL.replace(b"little", b"big"), "expected binary_little_endian"),
    (SMALL.replace(b"made by hand", b"csplat origin 1 2"), "data: .*3 finite numbers"),
    (built([[*ROW[:4], float("nan"), *ROW[5:]]], [WORD]), "max_y of chunk 0 is not finite"),
    (SMALL.replace(struct.pack("<f", -8), b"\1\0\xa0\x7f"), "min_scale_x of chunk 0 is not finite"),  # signalling
    (built([[ROW[3] + 1, *ROW[1:]]], [WORD]), "chunk 0 has min_x .*, expected at most max_x"),
])  # fmt: skip
def test_inconsistent_files_are_refused(data, message):
    with pytest.raises(InputError, match=message):
        csplat.read(data, "compressed-ply")


def test_unusual_files_are_read_and_reported():
    header = SMALL.partition(b"end_header\n")[0]
    for data, found in (
        (b"\xef\xbb\xbf" + SMALL, ["unusual-header"]),
        (SMALL.replace(b"ply\nformat", b"PLY\nFORMAT").replace(b"end_h", b"END_H"), ["unusual-header"]),
        (SMALL.replace(b"\n", b"\r", header.count(b"\n") + 1), []),
        (SMALL + SMALL, ["trailing-bytes"]),
    ):
        scene = read_scene(data)
        assert [4, 10, -1] == scene.model().means[0].tolist()
        assert found == [one.id for one in scene.findings]


@pytest.mark.slow
def test_damage_is_refused_or_read(tmp_path):
    sizes, places = range(0, len(SMALL), 29), range(0, len(SMALL), 7)

    def read(path):  # other formats, which damage may turn a file into, have tests of their own
        with compressed_ply.FORMAT.open(path) as scene:
            return scene.model()

    assert_damage_is_refused_or_read(tmp_path / "a.ply", SMALL, sizes, places, read)

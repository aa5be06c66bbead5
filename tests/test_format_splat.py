""".splat: rows of 32 bytes, read and written."""

import gzip
import struct
from dataclasses import replace

import numpy as np
import pytest

import csplat
from csplat.errors import InputError
from csplat.formats import assume_format, lint_file, open_scene
from csplat.scene_source import BLOCK_SPLATS

ROW = struct.pack("<6f8B", 1.5, -2, 3e9, 1, 0.5, 0, 0, 255, 51, 102, 128, 0, 128, 128)


def test_a_row_means_what_the_format_says(tmp_path):
    (tmp_path / "a.splat").write_bytes(ROW + ROW[:-4] + b"\x80" * 4)
    model = csplat.read(tmp_path / "a.splat")
    assert [1.5, -2, 3e9] == model.means[0].tolist()
    np.testing.assert_allclose([0, np.log(0.5), np.log(1e-20)], model.scales[0], rtol=1e-6)
    assert [[0, -1, 0, 0], [1, 0, 0, 0]] == model.quats.tolist()
    assert model.opacities[0] == np.float32(0.4)
    np.testing.assert_allclose(np.array([-0.5, 0.5, -0.3]) / 0.28209479, model.sh0[0], rtol=1e-6)
    assert (0, "unspecified") == (model.sh_degree, model.coordinate_system)


def test_what_is_written_comes_back(tmp_path, make_model):
    model = make_model(
        BLOCK_SPLATS + 5, 0, sh0=np.random.default_rng(0).uniform(-1.7, 1.7, (BLOCK_SPLATS + 5, 3)).astype("f4")
    )
    csplat.write(tmp_path / "a.splat", model)
    with open_scene(tmp_path / "a.splat") as scene:
        assert [BLOCK_SPLATS, 5] == [len(block) for block in scene.blocks()]
        found = scene.model()
    assert (model.means == found.means).all()
    np.testing.assert_allclose(found.scales, model.scales, atol=1e-6)
    np.testing.assert_allclose(found.opacities, model.opacities, atol=0.5 / 255 + 1e-6)
    np.testing.assert_allclose(found.sh0, model.sh0, atol=0.5 / 255 / 0.28209 + 1e-6)
    turned = 2 * np.arccos(np.minimum(1, np.abs(np.einsum("ij,ij->i", found.quats.astype(float), model.quats))))
    assert np.degrees(turned.max()) < 1
    assert (tmp_path / "a.splat").stat().st_size == 32 * len(model)


def test_the_identity_and_values_beyond_the_range_have_bytes(tmp_path, make_model):
    quats, scales = np.array([[1, 0, 0, 0]], "f4"), np.array([[100, 0, -100]], "f4")
    csplat.write(tmp_path / "a.splat", make_model(1, 0, quats=quats, scales=scales, sh0=np.array([[9, -9, 0]], "f4")))
    data = (tmp_path / "a.splat").read_bytes()
    assert bytes([0, 128, 128, 128]) == data[28:]
    assert [255, 0, 128] == list(data[24:27])
    np.testing.assert_allclose(csplat.read(tmp_path / "a.splat").scales, [[88, 0, np.log(1e-20)]], rtol=1e-6)


def test_splats_that_are_not_finite_are_dropped_and_counted(tmp_path):
    bad = struct.pack("<f", np.nan) + ROW[4:], ROW[:12] + struct.pack("<f", np.inf) + ROW[16:]
    (tmp_path / "a.splat").write_bytes(ROW + b"".join(bad) + ROW)
    with open_scene(tmp_path / "a.splat") as scene:
        assert 2 == scene.count == len(scene.model())
        assert [("nonfinite-rows", 2)] == [(one.id, one.count) for one in scene.findings]
    (tmp_path / "a.splat").write_bytes(bad[0])
    with pytest.raises(InputError, match="none is left"):
        csplat.read(tmp_path / "a.splat")


def test_a_cut_row_is_refused(tmp_path):
    (tmp_path / "a.splat").write_bytes(ROW[:-1])
    with pytest.raises(InputError, match=r"a\.splat has 31 bytes, wanted a multiple of 32"):
        csplat.read(tmp_path / "a.splat")


def plausible(rows):
    """Rows as a scene might have them, and one for each index of `rows` with what is given."""
    table = np.zeros(20, [("means", "<f4", 3), ("scales", "<f4", 3), ("colours", "u1", 4), ("quats", "u1", 4)])
    table["means"], table["scales"] = np.random.default_rng(0).normal(0, 5, (2, 20, 3))
    table["scales"] = np.abs(table["scales"]) / 100
    table["quats"] = [128, 0, 128, 128]
    for name, values in rows.items():
        table[name] = values
    return table.tobytes()


@pytest.mark.parametrize(
    ("data", "says"),
    [
        (b"<!DOCTYPE html><html>" + b"a" * 3083, "is a web page"),
        (b"version https://git-lfs.github.com/spec/v1\noid sha256:0\nsize 1\n", "git lfs pull"),
        (b'{"message": "Not Found"}'.ljust(64), "is JSON"),
        (gzip.compress(bytes(100), mtime=0).ljust(64), "gunzip"),
        (
            b"what somebody wrote down, in many words of English".ljust(96),
            "hardly .splat: it is text, and begins with 'what",
        ),
        (b"0.1234 0.5678 0.9012 1.0 0.5 0.5\n" * 32, "hardly .splat: it is text"),
        (np.random.default_rng(0).normal(size=320).astype("<f4").tobytes(), "are no splats; that .* has scales of"),
        (np.random.default_rng(0).bytes(32 * 40), "hardly .splat: [89].% of 40 rows are no splats"),
        (bytes(64), "a rotation of the bytes 0, 0, 0, 0"),
    ],
)
def test_what_is_hardly_a_splat_file_is_refused_unless_insisted(tmp_path, data, says):
    (tmp_path / "a.splat").write_bytes(data)
    with pytest.raises(InputError, match=says):
        csplat.read(tmp_path / "a.splat")
    if len(data) % 32 == 0 and "web page" not in says:  # which is nothing but that
        with assume_format("splat"), open_scene(tmp_path / "a.splat") as scene:
            assert "splat" == scene.format


@pytest.mark.parametrize("size", [1e-9, 1.0, 1e6])
@pytest.mark.parametrize("count", [1, 2, 30])
def test_scenes_of_any_size_are_no_doubt(tmp_path, make_model, size, count):
    model = make_model(count, 0)
    means, scales = model.means * np.float32(size) + np.float32(size), model.scales + np.float32(np.log(size))
    csplat.write(tmp_path / "a.splat", replace(model, means=means, scales=scales, means_double=None))
    assert count == len(csplat.read(tmp_path / "a.splat"))
    means[:, 1] = np.float32(size) * np.float32(1e-16)  # flat, but for rounding
    csplat.write(tmp_path / "a.splat", replace(model, means=means, scales=scales, means_double=None))
    assert count == len(csplat.read(tmp_path / "a.splat"))
    csplat.write(tmp_path / "a.splat", replace(model, means=np.zeros((count, 3), np.float32), means_double=None))
    assert count == len(csplat.read(tmp_path / "a.splat"))


def test_forbidden_values_are_told(tmp_path):
    path = tmp_path / "a.splat"
    scales = np.full((20, 3), 0.1)
    scales[3, 1] = -0.1
    path.write_bytes(plausible({"scales": scales}))
    (finding,) = lint_file(path)
    assert ("negative-scales", 1, "repair") == (finding.id, finding.count, finding.kind)
    assert "scale of splat 3 is -0.1" in finding.text
    np.testing.assert_allclose(np.log(0.1), csplat.read(path).scales, rtol=1e-6)
    path.write_bytes(plausible({"scales": np.full((20, 3), -3.0)}))
    assert [("log-scales", 20)] == [(one.id, one.count) for one in lint_file(path)]
    assert (csplat.read(path).scales == -3).all()
    path.write_bytes(plausible({"quats": 128}))
    assert [("zero-quats", 20)] == [(one.id, one.count) for one in lint_file(path)]
    clipped = np.clip(np.random.default_rng(0).normal(size=(20, 4)) * 512 + 128, 0, 255)
    path.write_bytes(plausible({"quats": clipped}))
    assert [] == lint_file(path)


def test_rows_of_zeros_and_huge_values_are_told(tmp_path):
    path = tmp_path / "a.splat"
    path.write_bytes(plausible({}) + bytes(32 * 6))
    assert [("zero-rows", 6, "note")] == [(one.id, one.count, one.kind) for one in lint_file(path)]
    assert 26 == len(csplat.read(path))
    scales = np.full((20, 3), 0.1)
    scales[4, 1] = 2e38
    path.write_bytes(plausible({"scales": scales}))
    assert [("huge-values", 1, "note")] == [(one.id, one.count, one.kind) for one in lint_file(path)]

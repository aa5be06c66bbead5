# SPDX-License-Identifier: Apache-2.0
""".splat and .ksplat: rows, sections, buckets and levels, read from bytes written by hand; .splat is also written.

Also: csplat.formats.ksplat.
"""

import gzip
import itertools
import struct
from dataclasses import replace

import numpy as np
import pytest
from checked import assert_damage_is_refused_or_read

import csplat
from csplat.errors import InputError
from csplat.formats import lint_file
from csplat.ply.columns import LOG_OF_0
from csplat.scene import BLOCK_SPLATS

ROW = struct.pack("<6f8B", 1.5, -2, 3e9, 1, 0.5, 0, 0, 255, 51, 102, 128, 0, 128, 128)


def test_rows_of_a_splat_are_read():
    model = csplat.read(ROW + ROW[:-4] + b"\x80" * 4, "splat")
    assert [1.5, -2, 3e9] == model.means[0].tolist()
    np.testing.assert_allclose([0, np.log(0.5), LOG_OF_0], model.scales[0], rtol=1e-6)
    assert [[0, -1, 0, 0], [1, 0, 0, 0]] == model.quats.tolist()
    assert model.opacities[0] == np.float32(0.4)
    np.testing.assert_allclose(np.array([-0.5, 0.5, -0.3]) / 0.28209479, model.sh0[0], rtol=1e-6)
    assert (0, "unspecified") == (model.sh_degree, model.metadata.coordinate_system)


def test_written_splats_read_back(tmp_path, make_model):
    path, count = tmp_path / "a.splat", BLOCK_SPLATS + 5
    model = make_model(count, 0, sh0=np.random.default_rng(0).uniform(-1.7, 1.7, (count, 3)).astype("f4"))
    csplat.write(path, model)
    with csplat.open(path) as scene:
        assert [BLOCK_SPLATS, 5] == [len(block) for block in scene.blocks()]
        found = scene.model()
    assert (model.means == found.means).all()
    for name, step in (("scales", 0), ("opacities", 1 / 255), ("sh0", 1 / 255 / 0.28209)):
        np.testing.assert_allclose(getattr(found, name), getattr(model, name), atol=step / 2 + 1e-6)
    turned = 2 * np.arccos(np.minimum(1, np.abs(np.einsum("ij,ij->i", found.quats.astype(float), model.quats))))
    assert np.degrees(turned.max()) < 1
    assert path.stat().st_size == 32 * count
    quats, scales = np.array([[1, 0, 0, 0]], "f4"), np.array([[100, 0, -100]], "f4")  # exact, and beyond the range
    csplat.write(path, make_model(1, 0, quats=quats, scales=scales, sh0=np.array([[9, -9, 0]], "f4")))
    assert bytes([255, 0, 128]) == path.read_bytes()[24:27]
    assert bytes([0, 128, 128, 128]) == path.read_bytes()[28:]
    np.testing.assert_allclose(csplat.read(path).scales, [[88, 0, LOG_OF_0]], rtol=1e-6)


def test_splats_that_are_not_finite_are_dropped_and_counted(tmp_path):
    bad = struct.pack("<f", np.nan) + ROW[4:], ROW[:12] + struct.pack("<f", np.inf) + ROW[16:]
    table = rows(1, 5, 1)
    table["s"][1, 0], table["r"][3, 4] = np.inf, np.nan
    for data, kept in ((ROW + b"".join(bad) + ROW, 2), (ksplat(1, [section(table, 1, 1)]), 3)):
        (tmp_path / "a.splat").write_bytes(data)
        with csplat.open(tmp_path / "a.splat") as scene:
            assert kept == scene.count == len(scene.model())
            assert [("nonfinite-rows", 2)] == [(one.id, one.count) for one in scene.findings]
    with pytest.raises(InputError, match="none is left"):
        csplat.read(bad[0], "splat")


def plausible(**columns):
    """Return 20 plausible rows, with some of their columns replaced."""
    table = np.zeros(20, [("means", "<f4", 3), ("scales", "<f4", 3), ("colours", "u1", 4), ("quats", "u1", 4)])
    table["means"], table["scales"] = np.random.default_rng(0).normal(0, 5, (2, 20, 3))
    table["scales"] = np.abs(table["scales"]) / 100
    table["quats"] = [128, 0, 128, 128]
    for name, values in columns.items():
        table[name] = values
    return table.tobytes()


@pytest.mark.parametrize(("data", "message"), [
    (b"<!DOCTYPE html><html>" + b"a" * 3083, "is a web page"),
    (b"version https://git-lfs.github.com/spec/v1\noid sha256:0\nsize 1\n", "git lfs pull"),
    (b'{"message": "Not Found"}'.ljust(64), "is JSON"),
    (gzip.compress(bytes(100), mtime=0).ljust(64), "gunzip"),
    (b"a text in many words of English".ljust(96), "hardly .splat: it is text, and begins with 'a text"),
    (b"0.1234 0.5678 0.9012 1.0 0.5 0.5\n" * 32, "hardly .splat: it is text"),
    (np.random.default_rng(0).normal(size=320).astype("<f4").tobytes(), "are not splats; the one .* has scales of"),
    (np.random.default_rng(0).bytes(32 * 40), "hardly .splat: [89].% of 40 rows are not splats"),
    (bytes(64), "a rotation of the bytes 0, 0, 0, 0"),
    (ROW[:-1], r"a\.splat has 31 bytes, expected a multiple of 32"),
])  # fmt: skip
def test_implausible_splat_files_are_refused_unless_the_format_is_given(tmp_path, data, message):
    (tmp_path / "a.splat").write_bytes(data)
    with pytest.raises(InputError, match=message):
        csplat.read(tmp_path / "a.splat")
    if len(data) % 32 == 0 and "web page" not in message:  # a web page is refused in any case
        with csplat.open(tmp_path / "a.splat", "splat") as scene:
            assert "splat" == scene.format


@pytest.mark.slow
def test_scenes_of_any_size_are_plausible(tmp_path, make_model):
    for size, count in itertools.product((1e-9, 1.0, 1e6), (1, 2, 30)):
        model = make_model(count, 0)
        means, scales = model.means * np.float32(size) + np.float32(size), model.scales + np.float32(np.log(size))
        flat = np.where([False, True, False], np.float32(size * 1e-16), means)  # flat except for rounding
        for places, sizes in ((means, scales), (flat, scales), (np.zeros((count, 3), np.float32), model.scales)):
            csplat.write(tmp_path / "a.splat", replace(model, means=places, scales=sizes, means_double=None))
            assert count == len(csplat.read(tmp_path / "a.splat"))


def tenths(place, value):
    """Return scales of a tenth, except for one of them."""
    return np.where(np.arange(60).reshape(20, 3) == place, value, 0.1)


STEEP = np.clip(np.random.default_rng(0).normal(size=(20, 4)) * 512 + 128, 0, 255)


@pytest.mark.parametrize(("data", "findings", "scales"), [
    (plausible(scales=tenths(10, -0.1)), [("negative-scales", 1, "repair")], np.log(0.1)),
    (plausible(scales=-3.0), [("log-scales", 20, "repair")], -3),
    (plausible(quats=128, scales=0.1), [("zero-quats", 20, "repair")], np.log(0.1)),
    (plausible(quats=STEEP), [], None),
    (plausible() + bytes(32 * 6), [("zero-rows", 6, "note")], None),
    (plausible(scales=tenths(13, 2e38)), [("huge-values", 1, "note")], None),
])  # fmt: skip
def test_lint_reports_unusual_values_of_a_splat(tmp_path, data, findings, scales):
    path = tmp_path / "a.splat"
    path.write_bytes(data)
    found = lint_file(path)
    assert findings == [(one.id, one.count, one.kind) for one in found]
    assert all("scale of splat 3 is -0.1" in one.text for one in found if one.id == "negative-scales")
    model = csplat.read(path)
    assert len(data) // 32 == len(model)
    if scales is not None:
        np.testing.assert_allclose(scales, model.scales, rtol=1e-6)


LEVELS = (("<f4", "<f4", "<f4"), ("<u2", "<f2", "<f2"), ("<u2", "<f2", "u1"))
CENTRES = np.array([[10, 20, 30], [-4, 0, 4], [100, 0, 0]], "<f4")


def rows(level, count, degree):
    """Return rows of a section: splat i at i, i + 1, i + 2 units; coefficient k of channel c is (k + 8 c) / 8."""
    means, others, rest = LEVELS[level]
    order = [(8 * c + k) for first, end in ((0, 3), (3, 8))[:degree] for c in range(3) for k in range(first, end)]
    columns = [("m", means, 3), ("s", others, 3), ("q", others, 4), ("c", "u1", 4), ("r", rest, (len(order),))]
    table = np.zeros(count, columns)
    table["m"] = np.arange(count)[:, None] + [0, 1, 2] + (1000 if level else 0)
    table["s"] = [1, 0.5, 2]
    table["q"] = [0, 0, 2, 0]
    table["c"] = [0, 51, 255, 102]
    table["r"] = np.array(order) / (1 if level == 2 else 8)
    return table


def section(table, level, degree, *, full=1, bucket=2, partial=(1, 2), centres=CENTRES, span=1000, **other):
    """Return the header of a section, and its data after all headers."""
    centres = centres if level else centres[:0]
    full, partial = (full, partial) if level else (0, ())
    head = {
        "count": len(table), "room": len(table), "bucket": bucket, "buckets": len(centres), "block": 5.0, "size": 12,
        "span": span, "stored": 0, "full": full, "partial": len(partial), "degree": degree, **other,
    }  # fmt: skip
    data = struct.pack(f"<{len(partial)}I", *partial) + centres.tobytes() + table.tobytes()
    return struct.pack("<IIIIfHxxIIIIH", *head.values()), data


def ksplat(level, sections, *, count=None, version=(0, 1), sh=(-2.0, 2.25), most=None):
    """Return a file of these sections."""
    count = sum(struct.unpack_from("<I", head)[0] for head, _ in sections) if count is None else count
    most = len(sections) if most is None else most
    head = struct.pack("<BBxxIIIIHxx12xff", *version, most, most, count, count, level, *sh)
    heads, parts = [one.ljust(1024, b"\0") for one, _ in sections], [data for _, data in sections]
    return b"".join([head.ljust(4096, b"\0"), *heads, *parts])


def simple(level, degree=0, count=5, **other):
    return ksplat(level, [section(rows(level, count, degree), level, degree, **other)])


@pytest.mark.parametrize("level", [0, 1, 2])
@pytest.mark.parametrize("degree", [0, 1, 2])
def test_ksplat_rows_of_each_level_are_read(level, degree):
    model = csplat.read(simple(level, degree))
    steps = np.arange(5)[:, None] + [0, 1, 2]
    wanted = CENTRES[[0, 0, 1, 2, 2]] + steps * 0.0025 if level else steps
    np.testing.assert_allclose(wanted, model.means, atol=1e-5)
    np.testing.assert_allclose([np.log([1, 0.5, 2])] * 5, model.scales, atol=1e-6)
    assert [[0, 0, 1, 0]] * 5 == model.quats.tolist()
    assert {np.float32(0.4)} == set(model.opacities)
    np.testing.assert_allclose(np.array([-0.5, -0.3, 0.5]) / 0.28209479, model.sh0[0], rtol=1e-6)
    numbers = (np.arange(8)[:, None] + [0, 8, 16])[: (0, 3, 8)[degree]]
    np.testing.assert_allclose(numbers / 60 - 2 if level == 2 else numbers / 8, model.shN[4], atol=1e-6)
    assert "unspecified" == model.metadata.coordinate_system


@pytest.mark.slow
def test_sections_of_several_degrees_are_one_scene():
    counts = ((3, 0), (BLOCK_SPLATS + 2, 2), (0, 0))
    sections = [section(rows(1, count, degree), 1, degree, bucket=count) for count, degree in counts]
    with csplat.open(ksplat(1, [*sections, (bytes(42), b"")])) as scene:
        assert [3, BLOCK_SPLATS, 2] == [len(block) for block in scene.blocks()]
        model = scene.model()
    assert 2 == model.sh_degree
    assert not model.shN[:3].any()
    assert [0.125, 1.125, 2.125] == model.shN[3, 1].tolist()


def test_ranges_of_0_are_defaults():
    model = csplat.read(simple(1, span=0))
    np.testing.assert_allclose(CENTRES[0] + (np.arange(3) + 1000 - 32767) * 2.5 / 32767, model.means[0], rtol=1e-6)
    data = ksplat(2, [section(rows(2, 5, 1), 2, 1)], sh=(0, 0))
    np.testing.assert_allclose(np.array([0, 8, 16]) / 85 - 1.5, csplat.read(data).shN[0, 0], rtol=1e-6)


@pytest.mark.parametrize(("data", "message"), [
    (simple(0)[:4095], "ends within its header"), (ksplat(0, [], version=(0, 2)), r"version 0\.2, expected 0\.1"),
    (ksplat(3, []), "compression level 3, expected at most 2"), (ksplat(2, [], sh=(-np.inf, 1)), "SH from -inf"),
    (ksplat(0, [], most=2**32 - 1), "4,294,967,295 sections, too many"),
    (ksplat(0, [section(rows(0, 5, 0), 0, 0)], count=6), "5 splats in its sections, its header declares 6"),
    (simple(0, degree=2)[:-1], "section 0 ends at byte"), (simple(1, room=2**32 - 1), "section 0 ends at byte"),
    (simple(1, buckets=2**32 - 1), "section 0 ends at byte"), (simple(1, room=4), "5 splats, but space for 4"),
    (ksplat(0, [section(rows(0, 1, 2), 0, 3)]), "SH degree 3, expected at most 2"),
    (simple(1, partial=(1, 1)), "contain fewer than its 5 splats"),
    (simple(1, full=2), "2 full and 2 partial buckets, expected 3"), (simple(1, block=np.nan), "not finite"),
    (simple(1, block=-5.0), "length of its blocks is -5"),
    (ksplat(2, [section(rows(2, 5, 1), 2, 1)], sh=(2.0, -2.0)), "expected finite numbers"),
    (simple(1, centres=CENTRES * np.float32(1.1e36)), "not finite"),
])  # fmt: skip
def test_invalid_ksplat_files_are_refused(data, message):
    with pytest.raises(InputError, match=message):
        csplat.read(data, "ksplat")


@pytest.mark.slow
@pytest.mark.parametrize("level", [0, 1, 2])
def test_a_damaged_file_is_refused_or_read(tmp_path, level):
    whole = simple(level, 1)
    places = [*range(0, 44, 2), *range(4096, 4138), *range(5120, 5200, 3)]  # headers, buckets, first row
    assert_damage_is_refused_or_read(tmp_path / "a.ksplat", whole, (*places[::9], len(whole) - 1), places)


def test_lint_reports_forbidden_values_and_trailing_bytes_of_a_ksplat(tmp_path):
    path, table = tmp_path / "a.ksplat", rows(1, 5, 0)
    table["q"][2] = 0
    for scale, found, logarithm in ((-4.0, "log-scales", -4), ([0.5, -0.5, 0.5], "negative-scales", np.log(0.5))):
        table["s"] = scale
        path.write_bytes(ksplat(1, [section(table, 1, 0)]))
        assert {"zero-quats": 1, found: 5} == {one.id: one.count for one in lint_file(path)}
        np.testing.assert_allclose(logarithm, csplat.read(path).scales, rtol=1e-6)
    path.write_bytes(simple(0) + bytes(33))
    assert [("trailing-bytes", 33)] == [(one.id, one.count) for one in lint_file(path)]

""".ksplat: sections, buckets and levels, read from bytes written by hand."""

import struct

import numpy as np
import pytest

import csplat
from csplat.errors import InputError
from csplat.formats import lint_file, open_scene
from csplat.scene_source import BLOCK_SPLATS

LEVELS = (("<f4", "<f4", "<f4"), ("<u2", "<f2", "<f2"), ("<u2", "<f2", "u1"))
CENTRES = np.array([[10, 20, 30], [-4, 0, 4], [100, 0, 0]], "<f4")


def rows(level, count, degree):
    """Rows of a section: splat i at i, i + 1, i + 2 units; coefficient k of channel c is (k + 8 c) / 8."""
    means, others, rest = LEVELS[level]
    order = [(8 * c + k) for first, end in ((0, 3), (3, 8))[:degree] for c in range(3) for k in range(first, end)]
    table = np.zeros(
        count, [("m", means, 3), ("s", others, 3), ("q", others, 4), ("c", "u1", 4), ("r", rest, (len(order),))]
    )
    table["m"] = np.arange(count)[:, None] + [0, 1, 2] + (1000 if level else 0)
    table["s"] = [1, 0.5, 2]
    table["q"] = [0, 0, 2, 0]
    table["c"] = [0, 51, 255, 102]
    table["r"] = np.array(order) / (1 if level == 2 else 8)
    return table


def section(table, level, degree, *, full=1, bucket=2, partial=(1, 2), centres=CENTRES, span=1000, **other):
    """The header of a section and what follows all headers."""
    centres = centres if level else centres[:0]
    full, partial = (full, partial) if level else (0, ())
    head = {
        "count": len(table), "room": len(table), "bucket": bucket, "buckets": len(centres), "block": 5.0, "size": 12,
        "span": span, "stored": 0, "full": full, "partial": len(partial), "degree": degree, **other,
    }  # fmt: skip
    data = struct.pack(f"<{len(partial)}I", *partial) + centres.tobytes() + table.tobytes()
    return struct.pack("<IIIIfHxxIIIIH", *head.values()), data


def ksplat(level, sections, *, count=None, version=(0, 1), sh=(-2.0, 2.25), most=None):
    """A file of these sections."""
    count = sum(struct.unpack_from("<I", head)[0] for head, _ in sections) if count is None else count
    most = len(sections) if most is None else most
    head = struct.pack("<BBxxIIIIHxx12xff", *version, most, most, count, count, level, *sh)
    return (
        head.ljust(4096, b"\0")
        + b"".join(one.ljust(1024, b"\0") for one, _ in sections)
        + b"".join(data for _, data in sections)
    )


def simple(level, degree=0, count=5, **other):
    return ksplat(level, [section(rows(level, count, degree), level, degree, **other)])


@pytest.mark.parametrize("level", [0, 1, 2])
@pytest.mark.parametrize("degree", [0, 1, 2])
def test_the_bytes_of_each_level_mean_what_the_format_says(level, degree):
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
    assert "unspecified" == model.coordinate_system


def test_sections_of_several_degrees_are_one_scene():
    sections = [
        section(rows(1, n, degree), 1, degree, bucket=n) for n, degree in ((3, 0), (BLOCK_SPLATS + 2, 2), (0, 0))
    ]
    with open_scene(ksplat(1, [*sections, (bytes(42), b"")])) as scene:
        assert [3, BLOCK_SPLATS, 2] == [len(block) for block in scene.blocks()]
        model = scene.model()
    assert 2 == model.sh_degree
    assert not model.shN[:3].any()
    assert [0.125, 1.125, 2.125] == model.shN[3, 1].tolist()


def test_a_range_of_0_is_the_usual_one():
    model = csplat.read(simple(1, span=0))
    np.testing.assert_allclose(CENTRES[0] + (np.arange(3) + 1000 - 32767) * 2.5 / 32767, model.means[0], rtol=1e-6)
    data = ksplat(2, [section(rows(2, 5, 1), 2, 1)], sh=(0, 0))
    np.testing.assert_allclose(np.array([0, 8, 16]) / 85 - 1.5, csplat.read(data).shN[0, 0], rtol=1e-6)


def test_splats_that_are_not_finite_are_dropped_and_counted():
    table = rows(1, 5, 1)
    table["s"][1, 0], table["r"][3, 4] = np.inf, np.nan
    with open_scene(ksplat(1, [section(table, 1, 1)])) as scene:
        assert 3 == scene.count == len(scene.model())
        assert [("nonfinite-rows", 2)] == [(one.id, one.count) for one in scene.findings]


@pytest.mark.parametrize(
    ("data", "says"),
    [
        (simple(0)[:4095], "ends inside of its header"),
        (ksplat(0, [], version=(0, 2)), r"version 0\.2, wanted 0\.1"),
        (ksplat(3, []), "compression level 3, wanted at most 2"),
        (ksplat(2, [], sh=(-np.inf, 1)), "SH from -inf"),
        (ksplat(0, [], most=2**32 - 1), "4,294,967,295 sections, more than"),
        (ksplat(0, [section(rows(0, 5, 0), 0, 0)], count=6), "5 splats in its sections, and its header says 6"),
        (simple(0, degree=2)[:-1], "section 0 ends at byte"),
        (simple(1, room=2**32 - 1), "section 0 ends at byte"),
        (simple(1, buckets=2**32 - 1), "section 0 ends at byte"),
        (simple(1, room=4), "5 splats in room for 4"),
        (ksplat(0, [section(rows(0, 1, 2), 0, 3)]), "SH degree 3, wanted at most 2"),
        (simple(1, partial=(1, 1)), "hold fewer than its 5 splats"),
        (simple(1, full=2), "2 full buckets and 2 others, of 3"),
        (simple(1, block=np.nan), "finite places"),
        (simple(1, block=-5.0), "its blocks are -5 long"),
        (ksplat(2, [section(rows(2, 5, 1), 2, 1)], sh=(2.0, -2.0)), "wanted numbers"),
        (simple(1, centres=CENTRES * np.float32(1.1e36)), "finite places"),
    ],
)
def test_what_is_no_ksplat_or_too_much_is_refused(tmp_path, data, says):
    (tmp_path / "a.ksplat").write_bytes(data)
    with pytest.raises(InputError, match=says):
        csplat.read(tmp_path / "a.ksplat")


@pytest.mark.parametrize("level", [0, 1, 2])
def test_a_damaged_file_is_refused_or_read(tmp_path, level):
    whole = simple(level, 1)
    path = tmp_path / "a.ksplat"

    def read(data):
        path.write_bytes(data)
        try:
            csplat.read(path)
        except InputError as error:
            return str(error)
        return ""

    assert not read(whole)
    told = [*range(44), *range(4096, 4138), *range(5120, 5200)]  # headers, buckets, first row
    assert all(read(whole[:size]) for size in (*told[::9], len(whole) - 1))
    for at in told:
        says = read(whole[:at] + bytes([whole[at] ^ (255 >> at % 8)]) + whole[at + 1 :])
        assert not says or ("a.ksplat" in says and "\n" not in says)


@pytest.mark.parametrize(("scale", "found"), [(-4.0, "log-scales"), ([0.5, -0.5, 0.5], "negative-scales")])
def test_forbidden_values_are_told(tmp_path, scale, found):
    table = rows(1, 5, 0)
    table["s"] = scale
    table["q"][2] = 0
    (tmp_path / "a.ksplat").write_bytes(ksplat(1, [section(table, 1, 0)]))
    findings = {one.id: one.count for one in lint_file(tmp_path / "a.ksplat")}
    assert {"zero-quats": 1, found: 5} == findings
    scales = csplat.read(tmp_path / "a.ksplat").scales
    np.testing.assert_allclose(-4 if found == "log-scales" else np.log(0.5), scales, rtol=1e-6)


def test_what_follows_the_last_section_is_told(tmp_path):
    (tmp_path / "a.ksplat").write_bytes(simple(0) + bytes(33))
    assert [("trailing-bytes", 33)] == [(one.id, one.count) for one in lint_file(tmp_path / "a.ksplat")]

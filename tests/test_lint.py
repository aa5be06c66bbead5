"""Each defect on its own: what lint calls it, what reading makes of it, what strict says."""

import numpy as np
import pytest

from csplat.errors import InputError
from csplat.ply import lint_ply, read_ply

NAMES = ["x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2"]
NAMES += [f"f_rest_{i}" for i in range(9)]
NAMES += ["opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"]


def good_rows(count=5, names=NAMES):
    rows = np.zeros(count, [(name, "<f4") for name in names])
    for index, name in enumerate(name for name in names if not name.startswith(("n", "rot"))):
        rows[name] = np.arange(count) + index / 8
    if "rot_0" in names:
        rows["rot_0"] = 1
    return rows


def header(rows, *, kind="binary_little_endian", before=(), after=(), name="vertex", count=None):
    types = {"f4": "float", "f8": "double", "i4": "int"}
    lines = ["ply", f"format {kind} 1.0", *before]
    lines.append(f"element {name} {len(rows) if count is None else count}")
    lines += [f"property {types[rows.dtype[one].str[1:]]} {one}" for one in rows.dtype.names]
    return "\n".join([*lines, *after, "end_header\n"]).encode()


@pytest.fixture
def path(tmp_path):
    return tmp_path / "a.ply"


def found(path):
    return {one.id: one for one in lint_ply(path)}


def without(*names):
    return [name for name in NAMES if name not in names]


def test_a_good_file_has_no_findings(path):
    path.write_bytes(header(good_rows()) + good_rows().tobytes())
    assert [] == lint_ply(path)
    assert 5 == len(read_ply(path, strict=True))


def test_a_finding_says_what_it_is(path):
    path.write_bytes(header(good_rows()) + good_rows().tobytes() + b"abc")
    (finding,) = lint_ply(path)
    assert ("trailing-bytes", 3, "repair") == (finding.id, finding.count, finding.kind)
    assert finding.repairable
    assert "repair: trailing-bytes: 3 bytes after the last row: ignored" == str(finding)


def test_trailing_bytes_are_ignored_and_counted(path):
    rows = good_rows()
    path.write_bytes(header(rows) + rows.tobytes() + bytes(14))
    assert 14 == found(path)["trailing-bytes"].count
    assert 5 == len(read_ply(path))
    with pytest.raises(InputError, match="trailing-bytes: 14 bytes"):
        read_ply(path, strict=True)


def test_trailing_lines_of_an_ascii_file_are_counted(path):
    rows = good_rows(2)
    lines = "".join(" ".join(map(str, row)) + "\n" for row in rows.tolist()).encode()
    path.write_bytes(header(rows, kind="ascii") + lines + b"\n")
    assert "trailing-bytes" not in found(path)
    path.write_bytes(header(rows, kind="ascii") + lines + b"1 2 3\n")
    assert 5 == found(path)["trailing-bytes"].count
    assert 2 == len(read_ply(path))


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("name", ["x", "f_dc_1", "f_rest_8", "scale_2", "rot_3"])
def test_rows_that_are_not_finite_are_dropped_and_counted(path, name, value):
    rows = good_rows()
    rows[name][[1, 3]] = value
    path.write_bytes(header(rows) + rows.tobytes())
    assert 2 == found(path)["nonfinite-rows"].count
    assert [0.0, 2.0, 4.0] == read_ply(path).means[:, 0].tolist()
    with pytest.raises(InputError, match="nonfinite-rows: 2 splats"):
        read_ply(path, strict=True)


def test_rows_are_dropped_wherever_they_are(path):
    rows = good_rows(20_000)
    bad = np.random.default_rng(0).random(20_000) < 0.3
    rows["f_rest_0"][bad] = np.nan
    path.write_bytes(header(rows) + rows.tobytes())
    assert bad.sum() == found(path)["nonfinite-rows"].count
    model = read_ply(path)
    assert np.array_equal(model.means[:, 0], rows["x"][~bad])
    assert np.array_equal(model.shN[:, 2, 2], rows["f_rest_8"][~bad])


def test_a_file_of_nothing_but_nan_is_refused(path):
    rows = good_rows()
    rows["x"] = np.nan
    path.write_bytes(header(rows) + rows.tobytes())
    assert "error" == found(path)["nonfinite-rows"].kind
    with pytest.raises(InputError, match="5 splats with NaN or infinity: none is left"):
        read_ply(path)


def test_a_nan_opacity_is_a_defect_and_an_infinite_one_is_not(path):
    rows = good_rows()
    rows["opacity"] = [np.nan, np.inf, -np.inf, 0, 0]
    path.write_bytes(header(rows) + rows.tobytes())
    assert 1 == found(path)["nonfinite-rows"].count
    assert 2 == found(path)["infinite-logits"].count
    assert "note" == found(path)["infinite-logits"].kind
    assert [1.0, 0.0, 0.5, 0.5] == read_ply(path).opacities.tolist()


def test_nan_normals_harm_nobody(path):
    rows = good_rows()
    rows["nx"] = np.nan
    path.write_bytes(header(rows) + rows.tobytes())
    assert 5 == found(path)["nonzero-normals"].count
    assert 5 == len(read_ply(path, strict=True))


def test_large_finite_values_are_no_defect(path):
    rows = good_rows()
    rows["x"] = 3e38
    path.write_bytes(header(rows) + rows.tobytes())
    assert [] == lint_ply(path)
    assert [float(np.float32(3e38))] * 5 == read_ply(path).means[:, 0].tolist()


def test_zero_rotations_become_the_identity(path):
    rows = good_rows()
    rows["rot_0"][:2] = 0
    path.write_bytes(header(rows) + rows.tobytes())
    assert 2 == found(path)["zero-quats"].count
    assert [[1, 0, 0, 0]] * 5 == read_ply(path).quats.tolist()
    with pytest.raises(InputError, match="zero-quats: 2 rotations"):
        read_ply(path, strict=True)


@pytest.mark.parametrize("length", [1e-40, 0.006, 2.0, 1e30])
def test_rotations_of_any_length_are_normalised(path, length):
    rows = good_rows()
    rows["rot_0"] = 0
    rows["rot_2"] = -length
    path.write_bytes(header(rows) + rows.tobytes())
    assert 5 == found(path)["unnormalised-quats"].count
    assert [[0, 0, -1, 0]] * 5 == read_ply(path, strict=True).quats.tolist()


@pytest.mark.parametrize("missing", [("x",), ("opacity",), ("f_dc_0", "f_dc_2"), ("scale_0",), ("rot_3",)])
def test_missing_columns_are_named_and_refused(path, missing):
    rows = good_rows(names=without(*missing))
    path.write_bytes(header(rows) + rows.tobytes())
    finding = found(path)["missing-columns"]
    assert (len(missing), False) == (finding.count, finding.repairable)
    with pytest.raises(InputError, match=f"no column {', '.join(missing)}"):
        read_ply(path)


def test_two_scales_are_discs(path):
    rows = good_rows(names=without("scale_2"))
    path.write_bytes(header(rows) + rows.tobytes())
    assert "note" == found(path)["flat-scales"].kind
    model = read_ply(path, strict=True)
    assert model.flat
    smallest = min(rows["scale_0"].min(), rows["scale_1"].min())
    np.testing.assert_allclose(model.scales[:, 2], smallest + np.log(0.01), rtol=1e-6)


@pytest.mark.parametrize("count", [1, 8, 10, 12, 15, 44, 46])
def test_sh_columns_of_no_degree_are_refused(path, count):
    names = without(*(name for name in NAMES if name.startswith("f_rest")))
    names += [f"f_rest_{i}" for i in range(count)]
    rows = good_rows(names=names)
    path.write_bytes(header(rows) + rows.tobytes())
    assert count == found(path)["sh-columns"].count
    with pytest.raises(InputError, match=f"{count} f_rest columns are no SH degree, expected 0, 9, 24 or 45"):
        read_ply(path)


def test_sh_columns_with_a_gap_are_refused(path):
    names = ["f_rest_45" if name == "f_rest_3" else name for name in NAMES]
    rows = good_rows(names=names)
    path.write_bytes(header(rows) + rows.tobytes())
    with pytest.raises(InputError, match="not numbered from 0 to 8"):
        read_ply(path)


def test_degree_4_is_named(path):
    names = without(*(name for name in NAMES if name.startswith("f_rest")))
    rows = good_rows(names=[*names, *(f"f_rest_{i}" for i in range(72))])
    path.write_bytes(header(rows) + rows.tobytes())
    with pytest.raises(InputError, match="SH degree 4, expected at most 3: --sh-degree 3"):
        read_ply(path)


def test_a_negative_count_is_refused_in_words(path):
    rows = good_rows()
    path.write_bytes(header(rows).replace(b"element vertex 5", b"element vertex -5") + rows.tobytes())
    assert "error" == found(path)["malformed"].kind
    with pytest.raises(InputError, match="-5 rows are declared"):
        read_ply(path)


def test_a_truncated_file_is_refused_with_the_count(path):
    rows = good_rows()
    path.write_bytes(header(rows) + rows.tobytes()[:-1])
    finding = found(path)["truncated"]
    assert (1, "error") == (finding.count, finding.kind)
    with pytest.raises(InputError, match="5 rows of vertex are declared, 4 are there"):
        read_ply(path)


def test_a_truncated_ascii_file_is_refused(path):
    rows = good_rows(1)
    line = " ".join(map(str, rows.tolist()[0]))
    path.write_bytes(header(rows, kind="ascii", count=3) + f"{line}\n".encode())
    assert 2 == found(path)["truncated"].count


def test_a_malformed_row_is_refused_with_its_number(path):
    rows = good_rows(2)
    lines = [" ".join(map(str, row)) for row in rows.tolist()]
    path.write_bytes(header(rows, kind="ascii") + f"{lines[0]}\n{lines[1]} 7\n".encode())
    with pytest.raises(InputError, match="malformed: row 1 of vertex"):
        read_ply(path)


@pytest.mark.parametrize("kind", ["ascii", "binary_little_endian"])
def test_a_count_that_no_file_holds_allocates_nothing(path, kind):
    rows = good_rows()
    path.write_bytes(header(rows, kind=kind, count=10**15) + rows.tobytes())
    assert found(path)["truncated"].repairable is False


def test_extra_columns_are_named_and_dropped(path):
    rows = np.zeros(5, [*good_rows().dtype.descr, ("object_id", "<i4"), ("conf", "<f8")])
    for name in NAMES:
        rows[name] = good_rows()[name]
    path.write_bytes(header(rows) + rows.tobytes())
    assert 2 == found(path)["extra-columns"].count
    with pytest.raises(InputError, match="columns object_id, conf are no property of splats"):
        read_ply(path, strict=True)
    report = []
    assert [
        "object_id",
        "conf",
    ] == list(read_ply(path, strict=True, keep_extra=True, report=report).extra)
    assert [] == report


def test_normals_are_noted_and_dropped(path):
    rows = good_rows()
    rows["ny"][:3] = 1
    path.write_bytes(header(rows) + rows.tobytes())
    assert 3 == found(path)["nonzero-normals"].count


def test_other_elements_are_named_and_dropped(path):
    rows = good_rows()
    faces = ["element face 2", "property list uchar int vertex_indices"]
    face = b"\x03" + np.arange(3, dtype="<i4").tobytes()
    path.write_bytes(header(rows, after=faces) + rows.tobytes() + face * 2)
    assert ["other-elements"] == list(found(path))
    assert np.array_equal(read_ply(path).means[:, 0], rows["x"])
    with pytest.raises(InputError, match=r"other-elements: .* face"):
        read_ply(path, strict=True)


def test_list_properties_of_splats_are_dropped(path):
    rows = good_rows(2)
    listed = header(rows, after=["property list uchar float tags"])
    body = b"".join(row.tobytes() + bytes([index]) + b"\0\0\0\0" * index for index, row in enumerate(rows))
    path.write_bytes(listed + body)
    assert 1 == found(path)["list-columns"].count
    assert np.array_equal(read_ply(path).means[:, 0], rows["x"])


def test_a_ply_without_vertices_is_refused(path):
    rows = good_rows()
    path.write_bytes(header(rows, name="point") + rows.tobytes())
    with pytest.raises(InputError, match="no element 'vertex'"):
        lint_ply(path)


def test_a_point_cloud_is_refused_by_its_columns(path):
    rows = good_rows(names=["x", "y", "z"])
    path.write_bytes(header(rows) + rows.tobytes())
    with pytest.raises(InputError, match="not a PLY of Gaussian splats"):
        read_ply(path)


def test_duplicate_columns_are_refused(path):
    rows = good_rows()
    path.write_bytes(header(rows, after=["property float x"]) + rows.tobytes() + bytes(20))
    with pytest.raises(InputError, match="same name"):
        read_ply(path)


def test_doubles_beyond_float32_are_dropped(path):
    kinds = [(name, "<f8" if name in ("x", "f_dc_0") else "<f4") for name in NAMES]
    rows = good_rows().astype(kinds)
    rows["x"][1] = 1e300
    rows["f_dc_0"][2] = -1e300
    path.write_bytes(header(rows) + rows.tobytes())
    assert 2 == found(path)["nonfinite-rows"].count
    assert 3 == len(read_ply(path))


def test_the_report_names_repairs_even_when_strict_refuses(path):
    rows = good_rows()
    rows["x"][0] = np.nan
    path.write_bytes(header(rows) + rows.tobytes() + b"!")
    report = []
    with pytest.raises(InputError):
        read_ply(path, strict=True, report=report)
    assert "trailing-bytes" in {one.id for one in report}


def test_real_defects_are_found(data_dir):
    expected = {
        "object_id": {"extra-columns": 1},
        "trailing_bytes": {"trailing-bytes": 14_029, "unnormalised-quats": 99},
        "horse": {"unnormalised-quats": 28_218},
        "jacket": {"unnormalised-quats": 54_460},
    }
    for name, findings in expected.items():
        assert findings == {one.id: one.count for one in lint_ply(data_dir / "ply" / f"{name}.ply")}


def test_what_is_said_of_no_splats_is_looked_at_too(path):
    path.write_bytes(header(good_rows(0), before=("comment csplat unit_metres -1",)))
    with pytest.raises(InputError, match="unit_metres is -1"):
        lint_ply(path)

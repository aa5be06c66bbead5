"""Defects of PLY files: their name in lint, the result of reading, and the error of strict reading."""

import re
import tracemalloc

import numpy as np
import pytest

import csplat
from csplat.errors import InputError
from csplat.formats import open_scene
from csplat.ply import lint_ply, read_ply
from csplat.ply.columns import alpha_of_logits

ARRAYS = ("means", "quats", "scales", "opacities", "sh0", "shN")

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
    types = {"f4": "float", "f8": "double", "i4": "int", "u1": "uchar", "u2": "ushort"}
    lines = ["ply", f"format {kind} 1.0", *before]
    lines.append(f"element {name} {len(rows) if count is None else count}")
    lines += [f"property {types[rows.dtype[one].str[1:]]} {one}" for one in rows.dtype.names]
    return "\n".join([*lines, *after, "end_header\n"]).encode()


@pytest.fixture
def path(tmp_path):
    return tmp_path / "a.ply"


def put(path, rows, trailing=b"", **words):
    path.write_bytes(header(rows, **words) + rows.tobytes() + trailing)


def found(path):
    return {one.id: one for one in lint_ply(path)}


def put_text(path, text, rows=None, **words):
    path.write_bytes(header(ROWS if rows is None else rows, kind="ascii", **words) + text.encode())


def without(*names):
    return [name for name in NAMES if name not in names]


def test_a_good_file_has_no_findings(path):
    put(path, good_rows())
    assert [] == lint_ply(path)
    assert 5 == len(read_ply(path, strict=True))


def test_trailing_bytes_are_ignored_and_counted(path):
    put(path, good_rows(), bytes(14))
    (finding,) = lint_ply(path)
    assert ("trailing-bytes", 14, "repair") == (finding.id, finding.count, finding.kind)
    assert finding.repairable
    assert "repair: trailing-bytes: 14 bytes after the last row: ignored" == str(finding)
    assert 5 == len(read_ply(path))
    with pytest.raises(InputError, match="trailing-bytes: 14 bytes"):
        read_ply(path, strict=True)


def test_rows_damaged_by_a_text_mode_transfer_are_refused(path):
    rows = good_rows(300)
    rows["x"] = np.arange(300, dtype="<u4").view("<f4")
    data = header(rows) + rows.tobytes()
    path.write_bytes(data.replace(b"\n", b"\r\n"))
    with pytest.raises(InputError, match=r"text-mode transfer \(git autocrlf, FTP\): copy it again as binary"):
        read_ply(path)
    crlf = header(rows).replace(b"\n", b"\r\n") + rows.tobytes()
    path.write_bytes(crlf)
    assert np.array_equal(read_ply(path, strict=True).means[:, 0], rows["x"])
    path.write_bytes(crlf + b"\r\n")
    assert "repair" == found(path)["trailing-bytes"].kind


def test_trailing_lines_of_an_ascii_file_are_counted(path):
    lines = "\n".join(lines_of(ROWS)) + "\n"
    put_text(path, f"{lines}\n")
    assert "trailing-bytes" not in found(path)
    put_text(path, f"{lines}1 2 3\n")
    assert 5 == found(path)["trailing-bytes"].count
    assert 4 == len(read_ply(path))


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("name", ["x", "f_dc_1", "f_rest_8", "scale_2", "rot_3"])
def test_rows_that_are_not_finite_are_dropped_and_counted(path, name, value):
    if (name, value) == ("scale_2", -np.inf):
        return  # a size of 0
    rows = good_rows()
    rows[name][[1, 3]] = value
    put(path, rows)
    assert 2 == found(path)["nonfinite-rows"].count
    assert [0.0, 2.0, 4.0] == read_ply(path).means[:, 0].tolist()
    with pytest.raises(InputError, match="nonfinite-rows: 2 splats"):
        read_ply(path, strict=True)


@pytest.mark.parametrize("names", [("scale_2",), ("scale_0", "scale_1", "scale_2")])
def test_log_scales_of_minus_infinity_are_sizes_of_0(path, names):
    rows = good_rows(names=NAMES)
    for name in names:
        rows[name][1:4] = -np.inf
    rows["opacity"][3] = np.nan
    rows["scale_1"][4] = np.inf
    put(path, rows)
    assert {"zero-scales": 2, "nonfinite-rows": 2} == {one.id: one.count for one in lint_ply(path)}
    with open_scene(path) as scene:
        blocks = scene.model()
    for model in (read_ply(path), blocks):
        assert [0, 1, 2] == model.means[:, 0].tolist()
        for name in names:
            sizes = np.exp(model.scales[1:, int(name[-1])].astype(float))
            assert (sizes < 1e-37).all()
            assert (sizes > 0).all()
        assert (model.scales[0] == [rows[f"scale_{axis}"][0] for axis in range(3)]).all()


def test_sizes_of_0_are_read_from_arrays(make_model):
    splats = csplat.to_gsplat(make_model(5, 0))
    sizes = {**splats, "scales": np.exp(splats["scales"]), "opacities": np.full(5, 0.5, "f4")}
    splats["scales"][2, 1] = -np.inf
    sizes["scales"][2, 1] = 0
    for model in (csplat.from_gsplat(splats), csplat.from_gsplat(sizes, form="activated")):
        assert 0 < np.exp(model.scales[2, 1].astype(float)) < 1e-37
    sizes["scales"][0, 0] = -1
    with pytest.raises(InputError, match="at least 0"):
        csplat.from_gsplat(sizes, form="activated")


def test_non_finite_rows_anywhere_are_dropped(path):
    rows = good_rows(20_000)
    bad = np.random.default_rng(0).random(20_000) < 0.3
    rows["f_rest_0"][bad] = np.nan
    put(path, rows)
    assert bad.sum() == found(path)["nonfinite-rows"].count
    model = read_ply(path)
    assert np.array_equal(model.means[:, 0], rows["x"][~bad])
    assert np.array_equal(model.shN[:, 2, 2], rows["f_rest_8"][~bad])


def test_a_file_of_only_nan_is_refused(path):
    rows = good_rows()
    rows["x"] = np.nan
    put(path, rows)
    assert "error" == found(path)["nonfinite-rows"].kind
    with pytest.raises(InputError, match="5 splats with NaN or infinity: none is left"):
        read_ply(path)


def test_a_nan_opacity_is_a_defect_and_an_infinite_one_is_not(path):
    rows = good_rows()
    rows["opacity"] = [np.nan, np.inf, -np.inf, 0, 0]
    put(path, rows)
    assert 1 == found(path)["nonfinite-rows"].count
    assert 2 == found(path)["infinite-logits"].count
    assert "note" == found(path)["infinite-logits"].kind
    assert [1.0, 0.0, 0.5, 0.5] == read_ply(path).opacities.tolist()


@pytest.mark.parametrize("value", [1, np.nan])
def test_normals_are_noted_and_dropped(path, value):
    rows = good_rows()
    rows["ny"][:3] = value
    put(path, rows)
    assert 3 == found(path)["nonzero-normals"].count
    assert 5 == len(read_ply(path, strict=True))


def test_large_finite_values_are_accepted(path):
    rows = good_rows()
    rows["x"] = 3e38
    put(path, rows)
    assert [] == lint_ply(path)
    assert [float(np.float32(3e38))] * 5 == read_ply(path).means[:, 0].tolist()


def test_zero_rotations_become_the_identity(path):
    rows = good_rows()
    rows["rot_0"][:2] = 0
    put(path, rows)
    assert {"zero-quats": 2} == {one.id: one.count for one in lint_ply(path)}
    assert [[1, 0, 0, 0]] * 5 == read_ply(path).quats.tolist()
    with pytest.raises(InputError, match="zero-quats: 2 rotations"):
        read_ply(path, strict=True)


@pytest.mark.parametrize("length", [1e-40, 0.006, 2.0, 1e30])
def test_rotations_of_any_length_are_normalised(path, length):
    rows = good_rows()
    rows["rot_0"] = 0
    rows["rot_2"] = -length
    put(path, rows)
    assert 5 == found(path)["unnormalised-quats"].count
    assert [[0, 0, -1, 0]] * 5 == read_ply(path, strict=True).quats.tolist()


@pytest.mark.parametrize("missing", [("x",), ("opacity",), ("f_dc_0", "f_dc_2"), ("scale_0",), ("rot_3",)])
def test_missing_columns_are_named_and_refused(path, missing):
    put(path, good_rows(names=without(*missing)))
    finding = found(path)["missing-columns"]
    assert (len(missing), False) == (finding.count, finding.repairable)
    with pytest.raises(InputError, match=f"no column {', '.join(missing)}"):
        read_ply(path)


def test_two_scales_are_read_as_discs(path):
    rows = good_rows(names=without("scale_2"))
    put(path, rows)
    assert "note" == found(path)["flat-scales"].kind
    model = read_ply(path, strict=True)
    assert model.flat
    smallest = min(rows["scale_0"].min(), rows["scale_1"].min())
    np.testing.assert_allclose(model.scales[:, 2], smallest + np.log(0.01), rtol=1e-6)


@pytest.mark.parametrize(("absent", "kept"), [
    (("scale_1", "scale_2"), True), (("scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"), False),
])  # fmt: skip
def test_one_scale_is_the_size_of_all_axes(path, absent, kept):
    for name in ("scale_0", "scale", "scalar_scale"):
        rows = good_rows(names=without(*absent))
        rows.dtype.names = [name if one == "scale_0" else one for one in rows.dtype.names]
        if kept:
            rows["rot_1"] = 1
        put(path, rows)
        assert "note" == found(path)["one-scale"].kind
        with open_scene(path) as scene:
            blocks = scene.model()
        for model in (read_ply(path, strict=True), blocks):
            assert (np.repeat(rows[name][:, None], 3, axis=1) == model.scales).all()
            assert not model.flat
            assert (model.quats[:, 0] == (np.float32(0.5**0.5) if kept else 1)).all()
    put(path, good_rows(names=without("rot_0", "rot_1", "rot_2", "rot_3")))
    assert "error" == found(path)["missing-columns"].kind


def test_the_filter_of_mip_splatting_is_fused_into_one_scale(path):
    rows = np.zeros(3, [(name, "<f4") for name in [*without("scale_1", "scale_2"), "filter_3D"]])
    rows["rot_0"], rows["filter_3D"] = 1, 1
    put(path, rows)
    np.testing.assert_allclose(read_ply(path).scales, np.full((3, 3), np.log(2**0.5)), rtol=1e-6)


@pytest.mark.parametrize("name", ["colors", "rgb"])
def test_three_bytes_of_colour_declared_as_one_are_read(path, name):
    names = [("nx", "<f4"), (name, "u1"), *((one, "<f4") for one in without(*(f"f_rest_{i}" for i in range(9))) if
             not one.startswith(("n", "f_dc")))]  # fmt: skip
    wide = [(one, kind, 3) if one == name else (one, kind) for one, kind in names]
    rows = np.zeros(4, wide)
    rows["rot_0"], rows[name], rows["x"] = 1, np.arange(12).reshape(4, 3) * 20, np.arange(4)
    declared = header(np.zeros(0, names), count=4)
    path.write_bytes(declared + rows.tobytes())
    assert {"packed-colours", "rgb-colours"} <= set(found(path))
    assert "trailing-bytes" not in found(path)
    with open_scene(path) as scene:
        blocks = scene.model()
    for model in (read_ply(path), blocks):
        np.testing.assert_allclose(model.sh0 * 0.28209479 + 0.5, rows[name] / 255, atol=1e-6)
        assert [0, 1, 2, 3] == model.means[:, 0].tolist()
    path.write_bytes(declared + rows.tobytes() + b"x")
    with pytest.raises(InputError, match="f_dc_0"):
        read_ply(path)


@pytest.mark.parametrize("count", [1, 8, 10, 12, 15, 44, 46])
def test_other_numbers_of_sh_columns_are_refused(path, count):
    names = without(*(name for name in NAMES if name.startswith("f_rest")))
    names += [f"f_rest_{i}" for i in range(count)]
    put(path, good_rows(names=names))
    assert count == found(path)["sh-columns"].count
    with pytest.raises(InputError, match=f"{count} f_rest columns match no SH degree, expected 0, 9, 24, 45 or 72"):
        read_ply(path)


def test_degree_5_is_read_with_fewer_bands(path):
    names = without(*(name for name in NAMES if name.startswith("f_rest")))
    rows = good_rows(names=[*names, *(f"f_rest_{i}" for i in range(105))])
    put(path, rows)
    for read in (read_ply, csplat.read):
        with pytest.raises(InputError, match=r"SH degree 5, expected at most 4: --sh-degree 4 .* leaves band 5 out"):
            read(path)
        with pytest.raises(InputError, match="sh_degree is 5, expected 0 to 4"):
            read(path, sh_degree=5)
    for degree, kept in ((4, 24), (3, 15), (1, 3), (0, 0)):
        report = []
        model = read_ply(path, sh_degree=degree, strict=True, keep_extra=True, report=report)
        assert ({}, ("sh-bands", 105 - 3 * kept)) == (model.extra, (report[0].id, report[0].count))
        for channel in range(3):
            expected = [rows[f"f_rest_{35 * channel + band}"] for band in range(kept)]
            assert np.array_equal(model.shN[:, :, channel], np.reshape(expected, (kept, 5)).T)
        with open_scene(path, sh_degree=degree) as scene:
            assert np.array_equal(model.shN, scene.model().shN)
    assert "sh-bands" in [one.id for one in lint_ply(path, sh_degree=3)]


def test_fewer_bands_are_read_on_request(path):
    put(path, good_rows())
    report = []
    assert 0 == read_ply(path, sh_degree=0, strict=True, report=report).sh_degree
    assert [] == report
    assert 1 == csplat.read(path, sh_degree=2).sh_degree


def renamed(rows, name_of):
    copy = rows.copy()
    copy.dtype.names = tuple(map(name_of, rows.dtype.names))
    return copy


@pytest.mark.parametrize("name_of", [
    lambda name: name if len(name) < 3 else f"scalar_{name}",
    lambda name: name if len(name) < 3 else f"scalar_scal_{name}",
    lambda name: name if len(name) < 3 else f"scal_{name}",
    str.upper,
    lambda name: re.sub(r"f_rest_(\d)$", r"f_rest_0\1", name),
], ids=["CloudCompare", "3dgsconverter 0.1", "its columns", "capitals", "numbers with zeros"])  # fmt: skip
def test_column_names_of_other_programs_are_read(path, name_of):
    plain, rows = good_rows(), renamed(good_rows(), name_of)
    put(path, plain)
    expected = read_ply(path)
    put(path, rows)
    report = []
    model = read_ply(path, strict=True, report=report)
    assert all(np.array_equal(getattr(expected, one), getattr(model, one)) for one in ARRAYS)
    count = sum(name != name_of(name) for name in NAMES)
    assert [("alias-columns", count, "note")] == [(one.id, one.count, one.kind) for one in report]


def test_the_usual_column_name_takes_precedence(path):
    rows = good_rows(names=[*NAMES, "scalar_opacity"])
    rows["scalar_opacity"] = 9.0
    put(path, rows)
    assert "scalar_opacity: duplicated" in found(path)["second-columns"].text
    assert np.array_equal(alpha_of_logits(rows["opacity"]), read_ply(path).opacities)


COLOURS = ("red", "green", "blue")


def coloured(kind, values, names=COLOURS, count=3):
    plain = [name for name in NAMES if not name.startswith("f_")]
    kinds = [(name, "<f4") for name in plain[:6]] + [(name, kind) for name in names]
    rows = np.zeros(count, [*kinds, *((name, "<f4") for name in plain[6:])])
    for name in ("x", "rot_0"):
        rows[name] = 1
    for name, value in zip(names, values, strict=True):
        rows[name] = value
    return rows


@pytest.mark.parametrize(("kind", "largest", "names"), [
    ("|u1", 255, COLOURS),
    ("<u2", 65535, ("diffuse_red", "diffuse_green", "diffuse_blue")),
    ("<f4", 1, COLOURS),
    ("<f8", 1, ("r", "g", "b")),
])  # fmt: skip
def test_red_green_and_blue_replace_f_dc(path, kind, largest, names):
    put(path, coloured(kind, (0, largest, largest // 5), names))
    assert ["rgb-colours"] == list(found(path))
    expected = (np.array([0, 1, (largest // 5) / largest]) - 0.5) / 0.28209479177387814
    model = read_ply(path, strict=True)
    np.testing.assert_allclose(model.sh0, [expected] * 3, rtol=1e-6)
    with open_scene(path) as scene:
        assert np.array_equal(model.sh0, scene.model().sh0)


@pytest.mark.parametrize(("kind", "values", "message"), [
    ("<f4", (0, 17, 255), "floats up to 255, expected 0 to 1"),
    ("<i4", (0, 17, 255), "of type int32, int32, int32, expected uint8, uint16 or float"),
])  # fmt: skip
def test_colours_of_another_range_are_refused(path, kind, values, message):
    put(path, coloured(kind, values))
    assert ["colour-columns"] == [one.id for one in found(path).values() if one.kind == "error"]
    with pytest.raises(InputError, match=message):
        read_ply(path)


def test_colours_of_16_bits_up_to_255_are_read_as_bytes(path):
    put(path, coloured("<u2", (0, 17, 255)))
    assert "in steps of 1/255: they have 16 bits, but are at most 255" in found(path)["rgb-colours"].text
    expected = (np.array([0, 17 / 255, 1]) - 0.5) / 0.28209479177387814
    np.testing.assert_allclose(read_ply(path, strict=True).sh0, [expected] * 3, rtol=1e-6)
    with open_scene(path) as scene:
        assert np.array_equal(read_ply(path).sh0, scene.model().sh0)


def test_f_dc_takes_precedence_over_red_green_and_blue(path):
    rows = good_rows(names=[*NAMES, *COLOURS])
    put(path, rows)
    assert np.array_equal(rows["f_dc_1"], read_ply(path).sh0[:, 1])
    assert "red, green, blue are not splat attributes" in found(path)["extra-columns"].text


def test_the_filter_of_mip_splatting_is_fused(path):
    rng = np.random.default_rng(1)
    rows = good_rows(200, [*NAMES, "filter_3D"])
    for name in ("f_dc_0", "opacity", "scale_0", "scale_1", "scale_2"):
        rows[name] = rng.normal(-3, 2, 200)
    rows["filter_3D"] = rng.uniform(0.001, 0.2, 200)
    rows["filter_3D"][:20] = 0
    rows["filter_3D"][20] = np.nan
    put(path, rows)
    assert {"filter-3d": 179, "nonfinite-rows": 1} == {one.id: one.count for one in found(path).values()}
    # create_fused_ply.py: sqrt(s^2 + f^2), and opacity * sqrt(prod s^2 / prod (s^2 + f^2))
    rows = rows[~np.isnan(rows["filter_3D"])]
    squares = np.exp(np.stack([rows[f"scale_{axis}"] for axis in range(3)], 1).astype(float)) ** 2
    fused = squares + rows["filter_3D"].astype(float)[:, None] ** 2
    alphas = 1 / (1 + np.exp(-rows["opacity"].astype(float)))
    model = read_ply(path, keep_extra=True)
    np.testing.assert_allclose(model.scales, np.log(np.sqrt(fused)), atol=1e-6)
    np.testing.assert_allclose(model.opacities, alphas * np.sqrt(squares.prod(1) / fused.prod(1)), rtol=1e-6)
    assert np.array_equal(rows["scale_1"][:20], model.scales[:20, 1])
    assert np.array_equal(alpha_of_logits(rows["opacity"][:20]), model.opacities[:20])
    assert ({}, False) == (model.extra, model.antialiased)
    with open_scene(path) as scene:
        assert np.array_equal(model.opacities, scene.model().opacities)


def test_the_filter_of_discs_is_not_fused(path):
    rows = good_rows(names=[*without("scale_2"), "filter_3D"])
    put(path, rows)
    assert "which is not defined for discs: it is not fused" in found(path)["filter-3d"].text
    assert np.array_equal(rows["scale_1"], read_ply(path).scales[:, 1])


def test_integer_positions_are_reported(path):
    put(path, good_rows().astype([(name, "<i4" if name in "xyz" else "<f4") for name in NAMES]))
    assert "positions are integers: 5 means are float32" in found(path)["double-means"].text


def test_extreme_filters_stay_finite(path):
    rows = good_rows(4, [*NAMES, "filter_3D"])
    for name in ("scale_0", "scale_1", "scale_2"):
        rows[name] = [-80, 80, -80, 0]
    rows["filter_3D"] = [1e38, 1e-45, -1e-30, -1]
    put(path, rows)
    model = read_ply(path)
    np.testing.assert_allclose(model.scales[:, 0], [np.log(1e38), 80, np.log(1e-30), np.log(2) / 2], rtol=1e-6)
    assert (0, alpha_of_logits(rows["opacity"])[1]) == (model.opacities[0], model.opacities[1])
    np.testing.assert_allclose(model.opacities[3], alpha_of_logits(rows["opacity"])[3] / 2**1.5, rtol=1e-6)


@pytest.mark.parametrize(("changes", "noted"), [
    ({"opacity": (0, 1)}, {"opacities-are-alphas"}),
    ({"opacity": (-0.1, 1)}, set()),
    ({"opacity": (-1e-7, 1.0000002)}, {"opacities-are-alphas"}),
    ({"opacity": (0, 255)}, {"opacities-are-alphas"}),
    ({"scale_0": (0, 0.1), "scale_1": (0, 2), "scale_2": (0, 0.1)}, {"scales-are-linear"}),
    ({"scale_0": (0.3, 2), "scale_1": (0.5, 3), "scale_2": (1.5, 4)}, set()),  # from 1.3 to 55 in 40
    ({"scale_0": (1e-3, 0.1), "scale_1": (1e-3, 2), "scale_2": (1e-3, 0.1)}, {"scales-are-linear"}),
    ({"f_dc_0": (0, 1), "f_dc_1": (0, 1), "f_dc_2": (0, 1)}, {"colours-are-rgb"}),
    ({"f_dc_0": (0, 255), "f_dc_1": (0, 255), "f_dc_2": (0, 255)}, {"colours-are-rgb"}),
])  # fmt: skip
def test_values_after_their_activation_are_noted(path, changes, noted):
    for count in (40, 8):
        rows = good_rows(count)
        for name in NAMES:
            if name.startswith(("f_dc", "scale", "opacity")):
                rows[name] = np.linspace(-5, 3, count)
        for name, (low, high) in changes.items():
            rows[name] = np.linspace(low, high, count)
        put(path, rows)
        assert (noted if count == 40 else set()) == set(found(path))
        read_ply(path, strict=True)


@pytest.mark.parametrize(("names", "after", "message"), [
    (["x", "y", "z", *COLOURS], [], r"but a point cloud \(it has x, y, z, red, green, blue\): csplat train"),
    (["x", "y", "z"], ["element face 0", "property list uchar int vertex_indices"], "but a mesh"),
    (["x", "y", "z", "f_offset_0", "f_anchor_feat_0", "opacity"], [], "but anchors of Scaffold-GS"),
    ([*without("scale_0", "scale_1", "scale_2"), "scale_x"], [], "no column scale_0, scale_1, scale_2.* it has x"),
])  # fmt: skip
def test_other_contents_are_named(path, names, after, message):
    put(path, good_rows(names=names), after=after)
    with pytest.raises(InputError, match=message):
        read_ply(path)


def test_columns_of_dynamic_splats_are_named(path):
    for names in (["motion_0", "trbf_center"], ["t", "scale_t"]):
        put(path, good_rows(names=[*NAMES, *names]))
        message = "are not splat attributes: dropped; the file contains dynamic (4D) splats: their time"
        assert f"{', '.join(names)} {message}" in found(path)["extra-columns"].text


def test_elements_of_dynamic_splats_are_named(path):
    put(path, good_rows(), bytes(4), after=["element delta_vertex_0 1", "property float x"])
    assert "of which the first frame is kept" in found(path)["other-elements"].text
    assert 5 == len(read_ply(path))


def lines_of(rows):
    return [" ".join(map(str, row)) for row in rows.tolist()]


ROWS = good_rows(4)  # an x of 3.0 in the last row


@pytest.mark.parametrize(("written", "message"), [
    (lambda lines: "\n".join(lines).replace(".", ","), "decimal commas"),
    (lambda lines: "\n".join(lines).replace(".", ",").replace(" ", ";"), "decimal commas"),
    (lambda lines: "\n".join(lines).replace(" ", ", "), "commas or semicolons between numbers"),
    (lambda lines: "\n" + "\n\n".join(lines) + "\n\n", "blank lines"),
    (lambda lines: "\n".join(lines).replace("\n3.0 ", "\n3D+00 "), "an exponent as Fortran writes it (1"),
    (" ".join, "all values in one line"),
    (lambda lines: "\n".join(lines).replace(" ", "\n"), "4 of vertex in 104 lines"),
    (lambda lines: "\r".join([" ".join(lines[:2]), " ".join(lines[2:])]), "4 of vertex in 2 lines"),
])  # fmt: skip
def test_unambiguous_rows_of_text_are_read(path, written, message):
    put_text(path, written(lines_of(ROWS)))
    assert message in found(path)["unusual-rows"].text
    model = read_ply(path)
    assert np.array_equal(model.means[:, 0], ROWS["x"])
    assert np.array_equal(model.quats[:, 3], ROWS["rot_3"])
    assert np.array_equal(model.scales[:, 2], ROWS["scale_2"])


@pytest.mark.parametrize("word", ["-nan(ind)", "nan(snan)", "-1.#IND", "1.#QNAN0", "1.#INF00"])
def test_nan_and_infinity_are_read_in_other_spellings(path, word):
    put_text(path, "\n".join(lines_of(ROWS)).replace("3.0", word, 1))
    assert {"unusual-rows": 1, "nonfinite-rows": 1} == {one.id: one.count for one in lint_ply(path)}
    assert 3 == len(read_ply(path))


@pytest.mark.parametrize(("old", "new", "message"), [
    ("\n3.0 ", "\n3,0 ", "row 3 of vertex: x is '3,0', expected a number"),
    ("\n3.0 ", "\n3.0.0 ", r"row 3 of vertex: x is '3\.0\.0', expected a number"),
    ("\n3.0 ", "\n", "row 3 of vertex has 25 values, expected 26"),
    ("\n2.0 ", " 9.0\n", "row 1 of vertex has 27 values, expected 26"),
])  # fmt: skip
def test_ambiguous_rows_of_text_are_refused(path, old, new, message):
    put_text(path, "\n".join(lines_of(ROWS)).replace(old, new, 1))
    with pytest.raises(InputError, match=message):
        read_ply(path)


def test_numbers_with_thousands_separators_are_refused(path):
    rows = good_rows(2, names=without("nx", "ny", "nz"))
    put_text(path, "\n".join([" ".join(["1,000"] * len(rows.dtype.names))] * 2), rows)
    with pytest.raises(InputError, match="x is '1,000', expected a number"):
        read_ply(path)


def test_rows_of_text_end_at_the_declared_count(path):
    text = "\n\n".join(lines_of(ROWS))
    put_text(path, f"{text}\n\nand more")
    assert 8 == found(path)["trailing-bytes"].count
    put_text(path, text, count=6)
    assert 2 == found(path)["truncated"].count


@pytest.mark.parametrize("kind", ["ascii", "binary_little_endian"])
@pytest.mark.parametrize(("written", "message"), [
    (lambda head: b"\xef\xbb\xbf" + head, "a byte order mark"),
    (lambda head: head.replace(b"element", b"\nelement"), "a blank line"),
    (lambda head: head.replace(b"end_header", b" \n\nend_header"), "2 blank lines"),
    (lambda head: head.replace(b"vertex", b"Vertex"), "capitals in Vertex"),
    (lambda head: head.upper(), "capitals in PLY FORMAT"),
    (lambda head: head.replace(b"end_header", b"end_header \t"), "spaces next to end_header"),
    (lambda head: head.replace(b"\n", b"\r\n", 4), "line ends of two kinds"),
])  # fmt: skip
def test_headers_in_other_spellings_are_read(path, kind, written, message):
    body = ROWS.tobytes() if kind != "ascii" else ("\n".join(lines_of(ROWS)) + "\n").encode()
    path.write_bytes(written(header(ROWS, kind=kind, before=["comment Made by É"])) + body)
    assert message in found(path)["unusual-header"].text
    model = csplat.read(path)
    assert np.array_equal(model.means[:, 0], ROWS["x"])
    assert "by ??" in model.metadata["comments"][0].lower()
    assert np.array_equal(model.scales[:, 2], ROWS["scale_2"])


def test_a_carriage_return_may_end_the_header(path):
    rows = good_rows(3)
    rows["x"] = np.array([0x0A, 1, 2], "<u4").view("<f4")  # the first byte of the rows is a line feed
    path.write_bytes(header(rows).replace(b"\n", b"\r") + rows.tobytes())
    assert np.array_equal(read_ply(path, strict=True).means[:, 0], rows["x"])


def test_a_ply_in_utf_16_is_named(path):
    path.write_text((header(ROWS, kind="ascii") + "\n".join(lines_of(ROWS)).encode()).decode(), "utf-16")
    with pytest.raises(InputError, match="is a PLY in UTF-16, expected ASCII: save it as UTF-8"):
        read_ply(path)


@pytest.mark.parametrize("order", ["<", ">"])
def test_half_floats_in_columns_of_integers_are_read(path, order):
    rows = good_rows(20)
    halves = np.zeros(20, [(name, f"{order}u2") for name in NAMES])
    for name in NAMES:
        halves[name] = rows[name].astype(f"{order}f2").view(f"{order}u2")
    kind = "binary_little_endian" if order == "<" else "binary_big_endian"
    put(path, halves, kind=kind)
    assert len(NAMES) == found(path)["half-floats"].count
    model = read_ply(path)
    assert np.array_equal(model.scales[:, 1], rows["scale_1"])
    assert np.array_equal(model.means[:, 0], rows["x"])


def halves_of(rows, names):
    kinds = [(name, "<u2" if name in names else "<f4") for name in rows.dtype.names]
    out = np.zeros(len(rows), kinds)
    for name in rows.dtype.names:
        out[name] = rows[name].astype("<f2").view("<u2") if name in names else rows[name]
    return out


def test_non_finite_half_floats_are_dropped_like_floats(path):
    rows = good_rows(60)
    rows["f_dc_1"][7], rows["opacity"][9] = np.nan, np.inf
    put(path, halves_of(rows, NAMES))
    assert {"half-floats", "nonfinite-rows", "infinite-logits"} <= set(found(path))
    assert 59 == len(read_ply(path))


def test_only_positions_may_be_half_floats(path):
    rng = np.random.default_rng(1)
    rows = good_rows(60)
    for name in NAMES:
        rows[name] = rng.normal(size=60)
    halves = halves_of(rows, ["x", "y", "z"])
    put(path, halves)
    assert 3 == found(path)["half-floats"].count
    np.testing.assert_allclose(read_ply(path).means[:, 1], rows["y"], rtol=1e-3)
    for values in (rng.integers(0, 30_000, 60), rng.integers(0, 1000, 60), rng.integers(64_000, 65_536, 60)):
        halves["x"] = halves["y"] = halves["z"] = values
        put(path, halves)
        with pytest.raises(InputError, match=r"integer-columns: x, y, z are 16-bit integers other than half floats"):
            read_ply(path)


def test_quantised_values_are_refused(path):
    rows = np.zeros(60, [(name, "<u2") for name in NAMES])
    for index, name in enumerate(NAMES):
        rows[name] = np.random.default_rng(index).integers(0, 30_000, 60)
    put(path, rows)
    with pytest.raises(InputError, match="of type uint16, expected float: export the values before quantisation"):
        read_ply(path)


@pytest.mark.parametrize(("changed", "kind", "message"), [
    (["opacity"], "u1", "opacity is of type uint8, expected float: export"),
    (["f_dc_0", "f_dc_1", "f_dc_2"], "u1", "are of type uint8, expected float: rename colours of 0 to 255 to red"),
    (["scale_0", "rot_2"], "i4", "scale_0, rot_2 are of type int32, expected float"),
    (without(*"xyz", "nx", "ny", "nz"), "u2", "are of type uint16, expected float"),  # NaN as halves
])  # fmt: skip
def test_integers_in_place_of_floats_are_refused(path, changed, kind, message):
    rows = np.zeros(5, [(name, kind if name in changed else "<f4") for name in NAMES])
    for name in changed:
        rows[name] = 65535 if kind == "u2" else 200
    put(path, rows)
    with pytest.raises(InputError, match=f"integer-columns: .*{message}"):
        read_ply(path)


def test_the_camera_of_ml_sharp_is_a_note(path):
    rows = good_rows()
    after = ["element image_size 2", "property uint image_size", "element color_space 1", "property uchar color_space"]
    body = rows.tobytes() + np.array([640, 480], "<u4").tobytes()
    path.write_bytes(header(rows, after=after) + body + b"\0")
    assert "image_size, color_space: dropped; they are the camera of ml-sharp" in found(path)["sharp-elements"].text
    assert 5 == len(read_ply(path, strict=True))
    path.write_bytes(header(rows, after=after) + body + b"\1")
    with pytest.raises(InputError, match=r"color_space is 1 \(linear RGB\), expected 0 \(sRGB\)"):
        read_ply(path)


def test_a_negative_count_is_refused(path):
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
    with pytest.raises(InputError, match="5 rows of vertex are declared, 4 are present"):
        read_ply(path)


def test_a_truncated_ascii_file_is_refused(path):
    put_text(path, "\n".join(lines_of(ROWS)[:1]) + "\n", count=3)
    assert 2 == found(path)["truncated"].count


@pytest.mark.parametrize("kind", ["ascii", "binary_little_endian"])
def test_a_huge_count_allocates_nothing(path, kind):
    put(path, good_rows(), kind=kind, count=10**15)
    assert found(path)["truncated"].repairable is False


def test_extra_columns_are_named_and_dropped(path):
    rows = np.zeros(5, [*good_rows().dtype.descr, ("object_id", "<i4"), ("conf", "<f8")])
    for name in NAMES:
        rows[name] = good_rows()[name]
    put(path, rows)
    assert 2 == found(path)["extra-columns"].count
    with pytest.raises(InputError, match="columns object_id, conf are not splat attributes"):
        read_ply(path, strict=True)
    report = []
    assert ["object_id", "conf"] == list(read_ply(path, strict=True, keep_extra=True, report=report).extra)
    assert [] == report


def test_other_elements_are_named_and_dropped(path):
    rows = good_rows()
    faces = ["element face 2", "property list uchar int vertex_indices"]
    face = b"\x03" + np.arange(3, dtype="<i4").tobytes()
    put(path, rows, face * 2, after=faces)
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


@pytest.mark.parametrize(("read", "rows", "options", "message"), [
    (lint_ply, good_rows(), {"name": "point"}, "no element 'vertex'"),
    (lint_ply, good_rows(0), {"before": ("comment csplat unit_metres -1",)}, "unit_metres is -1"),
    (read_ply, good_rows(names=["x", "y", "z"]), {}, "not a PLY of Gaussian splats"),
    (read_ply, good_rows(), {"after": ["property float x"]}, "same name"),
    (read_ply, good_rows(names=[*without("opacity"), "scalar_opacity", "Opacity"]), {}, "both be opacity: rename"),
    (read_ply, good_rows(names=[one.replace("rest_3", "rest_45") for one in NAMES]), {}, "not numbered from 0 to"),
])  # fmt: skip
def test_other_columns_elements_and_comments_are_refused(path, read, rows, options, message):
    put(path, rows, bytes(20), **options)
    with pytest.raises(InputError, match=message):
        read(path)


def test_doubles_beyond_float32_are_dropped(path):
    kinds = [(name, "<f8" if name in ("x", "f_dc_0") else "<f4") for name in NAMES]
    rows = good_rows().astype(kinds)
    rows["x"][1] = 1e300
    rows["f_dc_0"][2] = -1e300
    put(path, rows)
    assert 2 == found(path)["nonfinite-rows"].count
    assert 3 == len(read_ply(path))


def test_the_report_names_repairs_even_if_strict_reading_fails(path):
    rows = good_rows()
    rows["x"][0] = np.nan
    put(path, rows, b"!")
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


def test_an_integer_beyond_its_type_is_refused(path):
    columns = ["label", "other", *NAMES]
    properties = "".join(f"property {'uchar' if name in columns[:2] else 'float'} {name}\n" for name in columns)
    zeros = " 0" * len(NAMES)
    path.write_text(
        f"ply\nformat ascii 1.0\nelement vertex 2\n{properties}end_header\n\n1 2{zeros}\n{10**30} 2{zeros}\n"
    )
    with pytest.raises(InputError, match=path.name):
        read_ply(path)


def test_an_element_without_properties_is_refused(tmp_path):
    (tmp_path / "a.ply").write_text(
        "ply\nformat ascii 1.0\nelement face 1\nelement vertex 0\n"
        + "".join(f"property float {name}\n" for name in NAMES)
        + "end_header\n1\n"
    )
    with pytest.raises(InputError, match="face"):
        read_ply(tmp_path / "a.ply")


@pytest.mark.parametrize(("old", "new", "message"), [
    (b"vertex 5", b"vertex " + b"5" * 5000, r"555\.\.\. \(5,000 digits\) rows are declared, the file has"),
    (b"vertex 5", b"vertex -" + b"5" * 5000, r"-555.* rows are declared"),
    (b"vertex 5", b"vertex 1_0", "the count '1_0' of an element is not a whole number"),
    (b"vertex 5", b"vertex 5.0", "the count '5.0' of an element is not a whole number"),
    (b"end_header", b"element a 0\n" * 5000 + b"end_header", "more than 4,096 elements and properties"),
    (b"end_header", b"property int a\n" * 5000 + b"end_header", "more than 4,096 elements and properties"),
    (b"end_header", b"comment a\n" * 10**6 + b"end_header", "no line end_header in its first 1,048,576 bytes"),
    (b"end_header", b"element a 5" + b"5" * 1000 + b"\nend_header", r"555\.\.\. \(1,001 digits\) rows are declared"),
])  # fmt: skip
def test_headers_that_declare_too_much_are_refused(path, old, new, message):
    path.write_bytes(header(good_rows()).replace(old, new) + good_rows().tobytes())
    with pytest.raises(InputError, match=message) as caught:
        read_ply(path)
    assert len(str(caught.value)) < 300


_LISTS = 12_000
_HEADER_PEAK = 1_100_000  # bytes; up to 1 MiB of the file is searched for the end of the header
_EMPTY_LISTS = [f"element tags {_LISTS}", "property list uchar int a"]
_UNUSED = {  # other elements, their rows in binary, and their lines in ASCII
    "empty lists": (_EMPTY_LISTS, bytes(_LISTS), "0\n" * _LISTS),
    "lists of two kinds": (
        ["element tags 2", "property list ushort short a", "property int b", "property list char double c"],
        bytes.fromhex("0200 0000 0000 00000000 01 0000000000000000 0000 00000000 00"), "2 0 0 7 1 0.5\n0 7 0\n",
    ),
    "fixed rows": (["element tags 3", "property int a", "property uchar b"], bytes(15), "1 2\n" * 3),
    "rows that share a line": (["element tags 3", "property int a", "property uchar b"], bytes(15), "1 2 1 2 1 2\n"),
    "a blank line": (["element tags 2", "property list uchar int a"], bytes(2), "0\n\n0\n"),
}  # fmt: skip


def with_element(kind, lines, rows, *, comes_first):
    """Return a file with another element next to that of the splats."""
    text = header(ROWS, kind=kind)
    splats = "".join(f"{line}\n" for line in lines_of(ROWS)).encode() if kind == "ascii" else ROWS.tobytes()
    added = "".join(f"{line}\n" for line in lines).encode()
    where = b"element vertex" if comes_first else b"end_header"
    text = text.replace(where, added + where)
    return text + (rows + splats if comes_first else splats + rows)


def peak_of(read, path):
    """Return what `read` returns, and the most bytes of Python objects at a time."""
    tracemalloc.start()
    try:
        return read(path), tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()


@pytest.mark.parametrize("comes_first", [True, False])
@pytest.mark.parametrize("kind", ["ascii", "binary_little_endian", "binary_big_endian"])
def test_other_elements_are_skipped_without_an_object_per_row(path, kind, comes_first):
    for name, (lines, binary, text) in _UNUSED.items():
        rows = text.encode() if kind == "ascii" else binary
        data = with_element(kind, lines, rows, comes_first=comes_first)
        if kind.endswith("big_endian"):
            swapped = rows if name != "lists of two kinds" else rows.replace(b"\2\0", b"\0\2")
            data = data.replace(ROWS.tobytes(), ROWS.byteswap().tobytes()).replace(rows, swapped)
        path.write_bytes(data)
        model, peak = peak_of(read_ply, path)
        assert np.array_equal(model.means[:, 0], ROWS["x"]), name
        assert np.array_equal(model.scales[:, 2], ROWS["scale_2"]), name
        assert peak < 8 * len(data) + _HEADER_PEAK, name  # a kept object per row takes 60 to 140 bytes


@pytest.mark.parametrize(("lines", "rows", "message"), [
    (["element tags 1", "property list uint int a"], b"\xff" * 4, "1 rows of tags are declared, 0 are present"),
    (["element tags 3", "property list uchar int a"], b"\0\0\2", "3 rows of tags are declared, 2 are present"),
    (["element tags 2", "property list char int a"], b"\0\xff", "row 1 of tags: the list a has a length of -1"),
    (["element tags 1", "property list float int a"], bytes(4), "the list a of tags has lengths of type float32"),
    (["element tags 2", "property double a"], bytes(9), "2 rows of tags are declared, 1 are present"),
    (["element tags 1000000000000"], b"", "1000000000000 rows are declared, the file has"),
])  # fmt: skip
def test_other_elements_that_the_file_does_not_have_are_refused(path, lines, rows, message):
    path.write_bytes(with_element("binary_little_endian", lines, rows, comes_first=False))
    with pytest.raises(InputError, match=message):
        read_ply(path)


@pytest.mark.parametrize(("rows", "message"), [
    ("1 2\n1\n", "row 1 of tags has 1 values, expected 2"),
    ("1 2\n1 2 3\n", "row 1 of tags has 3 values, expected 2"),
    ("1 2\n", "2 rows of tags are declared, 1 are present"),
])  # fmt: skip
def test_other_elements_of_text_are_counted(path, rows, message):
    lines = ["element tags 2", "property int a", "property int b"]
    path.write_bytes(with_element("ascii", lines, rows.encode(), comes_first=False))
    with pytest.raises(InputError, match=message):
        read_ply(path)


@pytest.mark.parametrize("kind", ["ascii", "binary_little_endian"])
def test_a_file_without_columns_of_splats_is_refused_from_its_header(path, kind):
    data = header(good_rows(names=["x", "y", "z"]), kind=kind, after=["property list uchar int a"])
    path.write_bytes(data)  # without rows
    assert ["list-columns", "missing-columns"] == list(found(path))


def test_lists_of_splats_are_dropped_without_an_object_per_list(path):
    rows, names = good_rows(130), [f"property list uchar int a{index}" for index in range(100)]
    path.write_bytes(header(rows, after=names) + b"".join(row.tobytes() + bytes(100) for row in rows))
    model, peak = peak_of(read_ply, path)
    assert np.array_equal(model.means[:, 0], rows["x"])
    assert peak < 8 * path.stat().st_size + _HEADER_PEAK


def test_lists_of_splats_in_text_are_dropped(path):
    lines = [f"{line} {'2 1 1' if row % 2 else '0'}" for row, line in enumerate(lines_of(ROWS))]
    for text in ("\n".join(lines), "\n\n".join(lines)):
        put_text(path, text, after=["property list uchar int a"])
        assert 1 == found(path)["list-columns"].count
        assert np.array_equal(read_ply(path).scales[:, 2], ROWS["scale_2"])
    put_text(path, "\n".join(lines).replace("2 1 1", "2 1"), after=["property list uchar int a"])
    with pytest.raises(InputError, match="row 1 of vertex has 28 values, which its properties do not match"):
        read_ply(path)

# SPDX-License-Identifier: Apache-2.0
"""Defects of PLY files: their name in lint, the result of reading, and the error of strict reading.

Also: csplat.ply.column_names, csplat.ply.columns, csplat.ply.ply_header, csplat.ply.ply_rows,
csplat_tools.cli.lint.
"""

import re
import tracemalloc

import numpy as np
import pytest
from ply_cases import columns_of
from tables import failures

import csplat
from csplat.errors import InputError
from csplat.ply import lint_ply, read_ply
from csplat.ply.columns import alpha_of_logits

ARRAYS = ("means", "quats", "scales", "opacities", "sh0", "shN")
NAMES, COLOURS = columns_of(1), ("red", "green", "blue")
SCALES, ROTATIONS = ("scale_0", "scale_1", "scale_2"), ("rot_0", "rot_1", "rot_2", "rot_3")


def without(*names):
    return [name for name in NAMES if name not in names]


PLAIN = without(*(name for name in NAMES if name.startswith("f_rest")))


def good_rows(count=5, names=NAMES, kind="<f4", kinds=(), **columns):
    """Return rows without defects, with some columns replaced, of which `kinds` are of another kind."""
    rows = np.zeros(count, [(name, kind if name in kinds else "<f4") for name in names])
    for index, name in enumerate(name for name in names if not name.startswith(("n", "rot"))):
        rows[name] = np.arange(count) + index / 8
    if "rot_0" in names:
        rows["rot_0"] = 1
    for name, values in columns.items():
        rows[name] = values
    return rows


def header(rows, *, kind="binary_little_endian", before=(), after=(), name="vertex", count=None):
    types = {"f4": "float", "f8": "double", "i4": "int", "u1": "uchar", "u2": "ushort"}
    lines = ["ply", f"format {kind} 1.0", *before]
    lines.append(f"element {name} {len(rows) if count is None else count}")
    lines += [f"property {types[rows.dtype[one].str[1:]]} {one}" for one in rows.dtype.names]
    return "\n".join([*lines, *after, "end_header\n"]).encode()


def lines_of(rows):
    return [" ".join(map(str, row)) for row in rows.tolist()]


ROWS = good_rows(4)  # an x of 3.0 in the last row
LINES = "\n".join(lines_of(ROWS))


def ply(rows, trailing=b"", **words):
    return header(rows, **words) + rows.tobytes() + trailing


def text_ply(text, rows=ROWS, **words):
    return header(rows, kind="ascii", **words) + text.encode()


def assert_splats_of_rows(model):
    assert np.array_equal(model.means[:, 0], ROWS["x"])
    assert np.array_equal(model.scales[:, 2], ROWS["scale_2"])
    assert np.array_equal(model.quats[:, 0], ROWS["rot_0"])


@pytest.fixture
def path(tmp_path):
    return tmp_path / "a.ply"


def put(path, rows, trailing=b"", **words):
    path.write_bytes(ply(rows, trailing, **words))


def found(path):
    return {one.id: one for one in lint_ply(path)}


def counts(path):
    return {one.id: one.count for one in lint_ply(path)}


def both(path, **options):
    """Read a file at once and in blocks."""
    with csplat.open(path) as scene:
        return read_ply(path, **options), scene.model()


def assert_refused(path, cases):
    """Assert that reading the bytes of each case is refused with its message."""

    def check(case):
        data, message = case
        path.write_bytes(data)
        with pytest.raises(InputError, match=message) as caught:
            read_ply(path)
        assert len(str(caught.value)) < 600

    assert [] == failures(cases, check)


def coloured(kind, values, names=COLOURS):
    """Return three rows with colours of this kind in place of f_dc."""
    names = [*(name for name in NAMES if not name.startswith("f_")), *names]
    return good_rows(3, names, kind, names[-3:], **dict(zip(names[-3:], values, strict=True)))


def packed(name):
    """Return a PLY in which three bytes of colour are declared as one."""
    names = [(name, "u1") if one == "f_dc_0" else (one, "<f4") for one in PLAIN if one not in ("f_dc_1", "f_dc_2")]
    rows = np.zeros(4, [(*one, 3) if one[0] == name else one for one in names])
    rows["rot_0"], rows[name] = 1, np.arange(12).reshape(4, 3) * 20
    return header(np.zeros(0, names), count=4) + rows.tobytes()


def sh_of(*colours):
    return (np.array(colours) - 0.5) / 0.28209479177387814


GOOD_SH = np.stack([good_rows()[f"f_dc_{channel}"] for channel in range(3)], 1)
BAD_VALUES = [("x", np.nan), ("x", -np.inf), ("f_dc_1", np.inf), ("f_rest_8", np.nan), ("f_rest_8", -np.inf),
    ("scale_2", np.nan), ("scale_2", np.inf), ("rot_3", np.nan), ("rot_3", np.inf)]  # fmt: skip
ONE_SCALE = without(*SCALES)
VALUES = {  # rows or bytes, findings, and an array of the model that is read
    "good": (good_rows(), {}, "sh0", GOOD_SH),
    "normals": (good_rows(ny=[np.nan, 1, 1, 0, 0]), {"nonzero-normals": 3}, "sh0", GOOD_SH),
    "large means": (good_rows(x=3e38, y=0, z=0), {}, "means", [[3e38, 0, 0]] * 5),
    "opacities": (good_rows(opacity=[np.nan, np.inf, -np.inf, 0, 0]), {"nonfinite-rows": 1, "infinite-logits": 2},
        "opacities", [1, 0, 0.5, 0.5]),
    "large doubles": (
        good_rows(kind="<f8", kinds=["x", "f_dc_0"], x=[0, 1e300, 2, 3, 4], f_dc_0=[0, 1, -1e300, 3, 4]),
        {"nonfinite-rows": 2, "double-means": 3}, "opacities", alpha_of_logits(good_rows()["opacity"][[0, 3, 4]])),
    "integers": (good_rows(kind="<i4", kinds="xyz", y=range(5), z=range(5)), {"double-means": 5},
        "means", [[x] * 3 for x in range(5)]),
    "zero rotations": (good_rows(rot_0=[0, 0, 1, 1, 1]), {"zero-quats": 2}, "quats", [[1, 0, 0, 0]] * 5),
    **{f"rotations of {length}": (good_rows(rot_0=0, rot_2=-length), {"unnormalised-quats": 5},
        "quats", [[0, 0, -1, 0]] * 5) for length in (1e-40, 0.006, 2.0, 1e30)},
    **{f"{name} of {value}": (good_rows(**{name: [0, value, 0, value, 0]}), {"nonfinite-rows": 2},
        "opacities", alpha_of_logits(good_rows()["opacity"][::2])) for name, value in BAD_VALUES},
    **{f"{word} in text": (text_ply(LINES.replace("3.0", word, 1)), {"unusual-rows": 1, "nonfinite-rows": 1},
        "quats", [[1, 0, 0, 0]] * 3) for word in ("-nan(ind)", "nan(snan)", "-1.#IND", "1.#QNAN0", "1.#INF00")},
    "discs": (good_rows(names=without("scale_2"), scale_0=range(5), scale_1=2), {"flat-scales": 1},
        "scales", [[x, 2, np.log(0.01)] for x in range(5)]),
    **{f"one scale, {name}": (good_rows(names=[*ONE_SCALE, name], **{name: range(5)}), {"one-scale": 1},
        "scales", [[x] * 3 for x in range(5)]) for name in ("scale_0", "scale", "scalar_scale")},
    "one scale without rotations": (good_rows(names=[*without(*SCALES, *ROTATIONS), "scale"]), {"one-scale": 1},
        "quats", [[1, 0, 0, 0]] * 5),
    "a filter of one scale": (good_rows(3, [*ONE_SCALE, "scale", "filter_3D"], scale=0, filter_3D=1),
        {"one-scale": 1, "filter-3d": 3}, "scales", np.full((3, 3), np.log(2**0.5))),
    "bytes": (coloured("|u1", (0, 255, 51)), {"rgb-colours": 3}, "sh0", [sh_of(0, 1, 0.2)] * 3),
    "16 bits": (coloured("<u2", (0, 65535, 13107), ("diffuse_red", "diffuse_green", "diffuse_blue")),
        {"rgb-colours": 3}, "sh0", [sh_of(0, 1, 0.2)] * 3),
    "16 bits of 255": (coloured("<u2", (0, 51, 255)), {"rgb-colours": 3}, "sh0", [sh_of(0, 0.2, 1)] * 3),
    "floats of colours": (coloured("<f4", (0, 1, 0)), {"rgb-colours": 3}, "sh0", [sh_of(0, 1, 0)] * 3),
    "doubles": (coloured("<f8", (0, 1, 0), ("r", "g", "b")), {"rgb-colours": 3}, "sh0", [sh_of(0, 1, 0)] * 3),
    **{f"packed {name}": (packed(name), {"packed-colours": 1, "rgb-colours": 3},
        "sh0", sh_of(*np.arange(12).reshape(4, 3) / 12.75)) for name in ("colors", "rgb")},
}  # fmt: skip


@pytest.mark.slow
def test_unusual_values_are_counted_and_repaired_unless_reading_is_strict(path):
    def check(case):
        data, findings, name, values = case
        path.write_bytes(data if isinstance(data, bytes) else ply(data))
        others = {"shuffled-columns", "alias-columns"}
        assert findings == {one: count for one, count in counts(path).items() if one not in others}
        for model in both(path):
            np.testing.assert_allclose(getattr(model, name), np.asarray(values, np.float32), rtol=1e-6, atol=1e-7)
            assert ("flat-scales" in findings) == model.metadata.flat
        repaired = [one for one in ("nonfinite-rows", "zero-quats") if one in findings]
        assert repaired == [one.id for one in lint_ply(path) if one.kind == "repair"]
        if not repaired:
            assert len(model) == len(read_ply(path, strict=True))
        for one in repaired:
            with pytest.raises(InputError, match=f"{one}: {findings[one]} (splats?|rotations) "):
                read_ply(path, strict=True)

    assert [] == failures(VALUES, check)


def test_trailing_bytes_are_ignored_and_counted_unless_line_ends_were_changed(path):
    put(path, good_rows(x=[np.nan, 1, 2, 3, 4]), bytes(14))
    assert ("repair", True) == (found(path)["trailing-bytes"].kind, found(path)["trailing-bytes"].repairable)
    assert 4 == len(read_ply(path))
    with pytest.raises(InputError, match="trailing-bytes: 14 bytes"):
        read_ply(path, strict=True)
    rows = good_rows(300, x=np.arange(10, 310, dtype="<u4").view("<f4"))  # the first byte is a line feed
    path.write_bytes(ply(rows).replace(b"\n", b"\r\n"))
    with pytest.raises(InputError, match=r"text-mode transfer \(git autocrlf, FTP\): copy it again as binary"):
        read_ply(path)
    for end in (b"\r", b"\r\n"):  # lines of the header may end so
        data = header(rows).replace(b"\n", end) + rows.tobytes()
        path.write_bytes(data)
        assert np.array_equal(read_ply(path, strict=True).means[:, 0], rows["x"])
        path.write_bytes(data + end)
        assert "repair" == found(path)["trailing-bytes"].kind


@pytest.mark.parametrize(("text", "count", "findings"), [
    (f"{LINES}\n\n", 4, {}),
    (f"{LINES}\n1 2 3\n", 4, {"trailing-bytes": 5}),
    (LINES.replace("\n", "\n\n") + "\n\nand more", 4, {"trailing-bytes": 8}),
    (LINES.replace("\n", "\n\n"), 6, {"truncated": 2}),
    (LINES, 6, {"truncated": 2}),
    (f"{lines_of(ROWS)[0]}\n", 3, {"truncated": 2}),
])  # fmt: skip
def test_lines_after_and_before_the_declared_count_are_counted(path, text, count, findings):
    path.write_bytes(text_ply(text, count=count))
    assert findings == {name: one for name, one in counts(path).items() if name != "unusual-rows"}
    if "truncated" not in findings:
        assert 4 == len(read_ply(path))


def test_non_finite_rows_are_dropped_in_every_block(path):
    bad = np.random.default_rng(0).random(20_000) < 0.3
    rows = good_rows(20_000, f_rest_0=np.where(bad, np.nan, 0))
    put(path, rows)
    assert bad.sum() == counts(path)["nonfinite-rows"]
    model = read_ply(path)
    assert np.array_equal(model.means[:, 0], rows["x"][~bad])
    assert np.array_equal(model.shN[:, 2, 2], rows["f_rest_8"][~bad])


@pytest.mark.parametrize("names", [("scale_2",), SCALES])
def test_log_scales_of_minus_infinity_are_sizes_of_0(path, names):
    rows = good_rows(opacity=[0, 0, 0, np.nan, 0])
    for name in names:
        rows[name][1:4] = -np.inf
    rows["scale_1"][4] = np.inf
    put(path, rows)
    assert {"zero-scales": 2, "nonfinite-rows": 2} == counts(path)
    for model in both(path):
        assert [0, 1, 2] == model.means[:, 0].tolist()
        sizes = np.exp(model.scales[1:, [int(name[-1]) for name in names]].astype(float))
        assert ((sizes > 0) & (sizes < 1e-37)).all()
        assert (model.scales[0] == [rows[name][0] for name in SCALES]).all()


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


def test_degree_5_is_read_with_fewer_bands(path):
    rows = good_rows(names=[*PLAIN, *(f"f_rest_{i}" for i in range(105))])
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
        assert np.array_equal(model.shN, csplat.read(path, sh_degree=degree).shN)
    assert "sh-bands" in [one.id for one in lint_ply(path, sh_degree=3)]
    put(path, good_rows())  # of degree 1
    assert (0, 1) == (read_ply(path, sh_degree=0, strict=True).sh_degree, csplat.read(path, sh_degree=2).sh_degree)


@pytest.mark.parametrize("name_of", [
    lambda name: name if len(name) < 3 else f"scalar_{name}",
    lambda name: name if len(name) < 3 else f"scalar_scal_{name}",
    lambda name: name if len(name) < 3 else f"scal_{name}",
    str.upper,
    lambda name: re.sub(r"f_rest_(\d)$", r"f_rest_0\1", name),
], ids=["CloudCompare", "3dgsconverter 0.1", "its columns", "capitals", "numbers with zeros"])  # fmt: skip
def test_column_names_of_other_programs_are_read(path, name_of):
    rows = good_rows()
    put(path, rows)
    expected = read_ply(path)
    rows.dtype.names = tuple(map(name_of, NAMES))
    put(path, rows)
    report = []
    model = read_ply(path, strict=True, report=report)
    assert all(np.array_equal(getattr(expected, one), getattr(model, one)) for one in ARRAYS)
    count = sum(name != name_of(name) for name in NAMES)
    assert [("alias-columns", count, "note")] == [(one.id, one.count, one.kind) for one in report]


def test_the_usual_columns_take_precedence(path):
    rows = good_rows(names=[*NAMES, "scalar_opacity", *COLOURS], scalar_opacity=9.0)
    put(path, rows)
    assert "scalar_opacity: duplicated" in found(path)["second-columns"].text
    assert "red, green, blue are dropped" in found(path)["extra-columns"].text
    assert np.array_equal(alpha_of_logits(rows["opacity"]), read_ply(path).opacities)
    assert np.array_equal(rows["f_dc_1"], read_ply(path).sh0[:, 1])


def test_the_filter_of_mip_splatting_is_fused(path):
    rng = np.random.default_rng(1)
    random = {name: rng.normal(-3, 2, 200) for name in ("f_dc_0", "opacity", *SCALES)}
    filters = rng.uniform(0.001, 0.2, 200)
    filters[:21] = [0] * 20 + [np.nan]
    rows = good_rows(200, [*NAMES, "filter_3D"], **random, filter_3D=filters)
    put(path, rows)
    assert {"filter-3d": 179, "nonfinite-rows": 1} == counts(path)
    # create_fused_ply.py: sqrt(s^2 + f^2), and opacity * sqrt(prod s^2 / prod (s^2 + f^2))
    rows = rows[~np.isnan(rows["filter_3D"])]
    squares = np.exp(np.stack([rows[name] for name in SCALES], 1).astype(float)) ** 2
    fused = squares + rows["filter_3D"].astype(float)[:, None] ** 2
    alphas = 1 / (1 + np.exp(-rows["opacity"].astype(float)))
    model = read_ply(path, keep_extra=True)
    np.testing.assert_allclose(model.scales, np.log(np.sqrt(fused)), atol=1e-6)
    np.testing.assert_allclose(model.opacities, alphas * np.sqrt(squares.prod(1) / fused.prod(1)), rtol=1e-6)
    assert np.array_equal(rows["scale_1"][:20], model.scales[:20, 1])
    assert np.array_equal(alpha_of_logits(rows["opacity"][:20]), model.opacities[:20])
    assert ({}, False) == (model.extra, model.metadata.antialiased)
    assert np.array_equal(model.opacities, both(path)[1].opacities)


def test_the_filter_is_not_fused_into_discs_and_extreme_filters_stay_finite(path):
    rows = good_rows(names=[*without("scale_2"), "filter_3D"])
    put(path, rows)
    assert "which is not defined for discs: it is not fused" in found(path)["filter-3d"].text
    assert np.array_equal(rows["scale_1"], read_ply(path).scales[:, 1])
    scales = {name: [-80, 80, -80, 0] for name in SCALES}
    rows = good_rows(4, [*NAMES, "filter_3D"], **scales, filter_3D=[1e38, 1e-45, -1e-30, -1])
    put(path, rows)
    model, alphas = read_ply(path), alpha_of_logits(rows["opacity"])
    np.testing.assert_allclose(model.scales[:, 0], [np.log(1e38), 80, np.log(1e-30), np.log(2) / 2], rtol=1e-6)
    np.testing.assert_allclose(model.opacities[[0, 1, 3]], [0, alphas[1], alphas[3] / 2**1.5], rtol=1e-6)


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
        usual = {name: (-5, 3) for name in NAMES if name.startswith(("f_dc", "scale", "opacity"))}
        columns = {name: np.linspace(*ends, count) for name, ends in (usual | changes).items()}
        put(path, good_rows(count, **columns))
        assert (noted if count == 40 else set()) == set(found(path))


def test_other_elements_and_dynamic_splats_are_named_and_dropped(path):
    rows = good_rows()
    for data, after, text in (
        (b"\0\1abcd", ["element face 2", "property list uchar int vertex_indices"], "face"),
        (bytes(4), ["element delta_vertex_0 1", "property float x"], "of which the first frame is kept"),
    ):
        put(path, rows, data, after=after)
        assert ["other-elements"] == list(found(path))
        assert np.array_equal(read_ply(path).means[:, 0], rows["x"])
        with pytest.raises(InputError, match=f"other-elements: .*{text}"):
            read_ply(path, strict=True)
    for names in (["motion_0", "trbf_center"], ["t", "scale_t"]):
        put(path, good_rows(names=[*NAMES, *names]))
        assert "; the file contains dynamic (4D) splats: their time" in found(path)["extra-columns"].text


@pytest.mark.parametrize(("text", "message"), [
    (LINES.replace(".", ","), "decimal commas"),
    (LINES.replace(".", ",").replace(" ", ";"), "decimal commas"),
    (LINES.replace(" ", ", "), "commas or semicolons between numbers"),
    ("\n" + LINES.replace("\n", "\n\n") + "\n\n", "blank lines"),
    (LINES.replace("\n3.0 ", "\n3D+00 "), "an exponent as Fortran writes it (1"),
    (LINES.replace("\n", " "), "all values in one line"),
    (LINES.replace(" ", "\n"), "4 of vertex in 104 lines"),
    ("\r".join([" ".join(lines_of(ROWS[:2])), " ".join(lines_of(ROWS[2:]))]), "4 of vertex in 2 lines"),
])  # fmt: skip
def test_unambiguous_rows_of_text_are_read(path, text, message):
    path.write_bytes(text_ply(text))
    assert message in found(path)["unusual-rows"].text
    assert_splats_of_rows(read_ply(path))


BIG_LABELS = f"1 2{' 0' * len(NAMES)}\n{10**30} 2{' 0' * len(NAMES)}\n"
BAD_TEXT = {
    "a decimal comma": (LINES.replace("\n3.0 ", "\n3,0 "), ROWS, "row 3 of vertex: x is '3,0', expected a number"),
    "two points": (LINES.replace("\n3.0 ", "\n3.0.0 "), ROWS, r"row 3 of vertex: x is '3\.0\.0', expected a number"),
    "a value less": (LINES.replace("\n3.0 ", "\n"), ROWS, "row 3 of vertex has 25 values, expected 26"),
    "a value more": (LINES.replace("\n2.0 ", " 9.0\n"), ROWS, "row 1 of vertex has 27 values, expected 26"),
    "thousands separators": (f"{'1,000 ' * len(PLAIN)}\n" * 2, good_rows(2, PLAIN), "x is '1,000', expected a number"),
    "an integer beyond its type": (
        "\n" + BIG_LABELS, np.zeros(2, [("label", "u1"), ("other", "u1"), *ROWS.dtype.descr]),
        "line 35: row 1 of vertex has an integer beyond its type"),
}  # fmt: skip


def test_ambiguous_rows_of_text_are_refused(path):
    cases = {name: (text_ply(text, rows), message) for name, (text, rows, message) in BAD_TEXT.items()}
    utf16 = text_ply(LINES).decode().encode("utf-16")
    assert_refused(path, {**cases, "UTF-16": (utf16, "is a PLY in UTF-16, expected ASCII: save it as UTF-8")})


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
    body = ROWS.tobytes() if kind != "ascii" else f"{LINES}\n".encode()
    path.write_bytes(written(header(ROWS, kind=kind, before=["comment Made by É"])) + body)
    assert message in found(path)["unusual-header"].text
    model = csplat.read(path)
    assert_splats_of_rows(model)
    assert "by é" in model.metadata.entries["comments"][0].lower()


def halves_of(rows, names, order="<"):
    """Return rows with half floats in some columns, declared as integers."""
    halves = rows.astype([(name, f"{order}f2" if name in names else "<f4") for name in NAMES])
    return halves.view([(name, f"{order}u2" if name in names else "<f4") for name in NAMES])


@pytest.mark.parametrize(("order", "kind"), [("<", "binary_little_endian"), (">", "binary_big_endian")])
def test_half_floats_in_columns_of_integers_are_read(path, order, kind):
    rows = good_rows(60)
    put(path, halves_of(rows, NAMES, order), kind=kind)
    assert len(NAMES) == counts(path)["half-floats"]
    assert np.array_equal(read_ply(path).scales[:, 1], rows["scale_1"])
    rows["f_dc_1"][7], rows["opacity"][9] = np.nan, np.inf
    put(path, halves_of(rows, NAMES, order), kind=kind)
    assert (1, 1) == (counts(path)["nonfinite-rows"], counts(path)["infinite-logits"])
    assert 59 == len(read_ply(path))


def test_positions_alone_may_be_half_floats(path):
    rng = np.random.default_rng(1)
    rows = good_rows(60, **{name: rng.normal(size=60) for name in NAMES})
    halves = halves_of(rows, ["x", "y", "z"])
    put(path, halves)
    assert 3 == counts(path)["half-floats"]
    np.testing.assert_allclose(read_ply(path).means[:, 1], rows["y"], rtol=1e-3)
    cases = {}
    for low, high in ((0, 30_000), (0, 1000), (64_000, 65_536)):
        halves["x"] = halves["y"] = halves["z"] = rng.integers(low, high, 60)
        cases[f"{low} to {high}"] = (ply(halves), r"integer-columns: x, y, z are 16-bit integers other than half float")
    assert_refused(path, cases)


RANDOM = np.random.default_rng(0).integers(0, 30_000, 60)
BAD_KINDS = {
    "u1 in opacity": (["opacity"], 200, "opacity is of type uint8, expected float: export"),
    "u1 in colours": (["f_dc_0", "f_dc_1", "f_dc_2"], 200, "uint8, expected float: rename colours of 0 to 255 to red"),
    "i4 in two": (["scale_0", "rot_2"], 200, "scale_0, rot_2 are of type int32, expected float"),
    "u2 that are NaN as halves": (PLAIN[6:], 65535, "are of type uint16, expected"),
    "u2 in all": (NAMES, RANDOM, "of type uint16, expected float: export the values before quantisation"),
}


def test_integers_in_place_of_floats_are_refused(path):
    cases = {}
    for name, (kinds, values, message) in BAD_KINDS.items():
        rows = good_rows(60, kind=name[:2], kinds=kinds, **dict.fromkeys(kinds, values))
        cases[name] = ply(rows), f"integer-columns: .*{message}"
    assert_refused(path, cases)


def test_the_camera_of_ml_sharp_is_a_note(path):
    rows, camera = good_rows(), np.array([640, 480], "<u4").tobytes()
    after = ["element image_size 2", "property uint image_size", "element color_space 1", "property uchar color_space"]
    put(path, rows, camera + b"\0", after=after)
    assert "image_size, color_space: dropped; they are the camera of ml-sharp" in found(path)["sharp-elements"].text
    assert 5 == len(read_ply(path, strict=True))
    linear = ply(rows, camera + b"\1", after=after)
    assert_refused(path, {"linear": (linear, r"color_space is 1 \(linear RGB\), expected 0 \(sRGB\)")})


def test_extra_columns_are_named_and_dropped(path):
    rows = np.zeros(5, [*good_rows().dtype.descr, ("object_id", "<i4"), ("conf", "<f8")])
    rows["rot_0"] = 1
    put(path, rows)
    finding = found(path)["extra-columns"]
    assert (2, "note") == (finding.count, finding.kind)
    assert finding.text.startswith("extra columns object_id, conf are dropped: --keep-extra of csplat encode or")
    assert {} == read_ply(path, strict=True).extra
    assert ["object_id", "conf"] == list(read_ply(path, strict=True, keep_extra=True).extra)


FACES = ["element face 0", "property list uchar int vertex_indices"]
BAD_COLUMNS = {
    "no finite row": (ply(good_rows(x=np.nan)), "nonfinite-rows: 5 splats with NaN or infinity: none is left"),
    **{
        f"no {' '.join(missing)}": (ply(good_rows(names=without(*missing))), f"no column {', '.join(missing)}")
        for missing in (("x",), ("opacity",), ("f_dc_0", "f_dc_2"), ("scale_0",), ("rot_3",), ROTATIONS)
    },
    **{
        f"{count} of SH": (ply(good_rows(names=[*PLAIN, *(f"f_rest_{i}" for i in range(count))])),
            f"{count} f_rest columns match no SH degree, expected 0, 9, 24, 45 or 72")
        for count in (1, 8, 10, 12, 15, 46)
    },
    "floats of 255": (ply(coloured("<f4", (0, 17, 255))), "colour-columns: .*floats up to 255, expected 0 to 1"),
    "signed colours": (ply(coloured("<i4", (0, 17, 255))), "of type int32, int32, int32, expected uint8, uint16 or fl"),
    "a point cloud": (ply(good_rows(names=["x", "y", "z", *COLOURS])),
        r"but a point cloud \(it has x, y, z, red, green, blue\): csplat train"),
    "a mesh": (ply(good_rows(names=["x", "y", "z"]), after=FACES), "but a mesh"),
    "anchors": (ply(good_rows(names=["x", "y", "z", "f_offset_0", "f_anchor_feat_0", "opacity"])),
        "not a PLY of Gaussian splats, but anchors of Scaffold-GS"),
    "another scale": (ply(good_rows(names=[*without(*SCALES), "scale_x"])),
        "no column scale_0, scale_1, scale_2.* it has x"),
    "two columns x": (ply(good_rows(), bytes(20), after=["property float x"]), "column x: declared twice"),
    "two opacities": (ply(good_rows(names=[*without("opacity"), "scalar_opacity", "Opacity"])),
        "both be opacity: rename"),
    "a gap": (ply(good_rows(names=[one.replace("rest_3", "rest_45") for one in NAMES])), "not numbered from 0 to"),
    "no vertex": (ply(good_rows(), name="point"), "no element 'vertex'"),
    "a comment": (ply(good_rows(), before=("comment csplat unit_metres -1",)), "unit_metres is -1"),
}  # fmt: skip


def test_columns_that_are_not_those_of_splats_are_refused(path):
    assert_refused(path, BAD_COLUMNS)
    for name, count in (("no scale_0", 1), ("8 of SH", 8)):
        path.write_bytes(BAD_COLUMNS[name][0])
        assert [(count, False)] == [(one.count, one.repairable) for one in lint_ply(path) if one.kind == "error"]
    for kind in ("ascii", "binary_little_endian"):  # from the header alone
        path.write_bytes(header(good_rows(names=["x", "y", "z"]), kind=kind, after=["property list uchar int a"]))
        assert ["list-columns", "missing-columns"] == list(found(path))


GOOD = ply(good_rows())
BAD_HEADERS = {
    f"{new[:20].decode()}, {len(new)} bytes": (GOOD.replace(old, new), message)
    for old, new, message in [
        (b"vertex 5", b"vertex -5", "malformed: .*-5 rows are declared"),
        (b"vertex 5", b"vertex " + b"5" * 5000, r"555\.\.\. \(5,000 digits\) rows are declared, the file has"),
        (b"vertex 5", b"vertex 1_0", "the count '1_0' of an element is not a whole number"),
        (b"vertex 5", b"vertex 5.0", "the count '5.0' of an element is not a whole number"),
        (b"end_header", b"element a 0\n" * 5000 + b"end_header", "more than 4,096 elements and properties"),
        (b"end_header", b"property int a\n" * 5000 + b"end_header", "more than 4,096 elements and properties"),
        (b"end_header", b"comment a\n" * 10**6 + b"end_header", "no line end_header in its first 1,048,576 bytes"),
    ]
}  # fmt: skip


def test_headers_that_declare_too_much_are_refused(path):
    assert_refused(path, {**BAD_HEADERS, "a row less": (GOOD[:-1], "5 rows of vertex are declared, 4 are present")})
    for kind in ("ascii", "binary_little_endian"):
        put(path, good_rows(), kind=kind, count=10**15)
        assert found(path)["truncated"].repairable is False


LIST, PAIR = "property list uchar int a", ["element tags 2", "property int a", "property int b"]
HEADER_PEAK = 1_100_000  # bytes; up to 1 MiB of the file is searched for the end of the header
UNUSED = {  # other elements, their rows in binary, and their lines in ASCII
    "empty lists": (["element tags 12000", LIST], bytes(12_000), "0\n" * 12_000),
    "lists of two kinds": (
        ["element tags 2", "property list ushort short a", "property int b", "property list char double c"],
        bytes.fromhex("0200 0000 0000 00000000 01 0000000000000000 0000 00000000 00"), "2 0 0 7 1 0.5\n0 7 0\n",
    ),
    "fixed rows": (PAIR, bytes(16), "1 2\n" * 2),
    "rows that share a line": (PAIR, bytes(16), "1 2 1 2\n"),
    "a blank line": (["element tags 2", LIST], bytes(2), "0\n\n0\n"),
}  # fmt: skip


def with_element(kind, lines, rows, *, comes_first):
    """Return a file with another element next to that of the splats."""
    splats = f"{LINES}\n".encode() if kind == "ascii" else ROWS.tobytes()
    added = "".join(f"{line}\n" for line in lines).encode()
    where = b"element vertex" if comes_first else b"end_header"
    text = header(ROWS, kind=kind).replace(where, added + where)
    return text + (rows + splats if comes_first else splats + rows)


def peak_of(read, path):
    """Return what `read` returns, and the most bytes of Python objects at a time."""
    tracemalloc.start()
    try:
        return read(path), tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()


@pytest.mark.slow
@pytest.mark.parametrize("comes_first", [True, False])
@pytest.mark.parametrize("kind", ["ascii", "binary_little_endian", "binary_big_endian"])
def test_other_elements_are_skipped_without_an_object_per_row(path, kind, comes_first):
    for name, (lines, binary, text) in UNUSED.items():
        rows = text.encode() if kind == "ascii" else binary
        data = with_element(kind, lines, rows, comes_first=comes_first)
        if kind.endswith("big_endian"):
            swapped = rows if name != "lists of two kinds" else rows.replace(b"\2\0", b"\0\2")
            data = data.replace(ROWS.tobytes(), ROWS.byteswap().tobytes()).replace(rows, swapped)
        path.write_bytes(data)
        model, peak = peak_of(read_ply, path) if name == "empty lists" and comes_first else (read_ply(path), 0)
        assert_splats_of_rows(model)
        assert peak < 8 * len(data) + HEADER_PEAK  # a kept object per row takes 60 to 140 bytes


BAD_ELEMENTS = {
    f"{lines[-1]}, rows {rows}": (
        with_element("ascii" if lines == PAIR else "binary_little_endian", lines, rows, comes_first=False), message)
    for lines, rows, message in [
        (["element tags 1", "property list uint int a"], b"\xff" * 4, "1 rows of tags are declared, 0 are present"),
        (["element tags 3", LIST], b"\0\0\2", "3 rows of tags are declared, 2 are present"),
        (["element tags 2", "property list char int a"], b"\0\xff", "row 1 of tags: the list a has a length of -1"),
        (["element tags 1", "property list float int a"], bytes(4), "the list a of tags has lengths of type float32"),
        (["element tags 2", "property double a"], bytes(9), "2 rows of tags are declared, 1 are present"),
        (["element tags 1000000000000"], b"", "1000000000000 rows are declared, the file has"),
        (PAIR, b"1 2\n1\n", "row 1 of tags has 1 values, expected 2"),
        (PAIR, b"1 2\n1 2 3\n", "row 1 of tags has 3 values, expected 2"),
        (PAIR, b"1 2\n", "2 rows of tags are declared, 1 are present"),
    ]
}  # fmt: skip


def test_other_elements_that_the_file_does_not_have_are_refused(path):
    first = text_ply("1\n").replace(b"element vertex 4", b"element face 1\nelement vertex 0")
    assert_refused(path, {**BAD_ELEMENTS, "no properties": (first, "face")})


@pytest.mark.slow
def test_lists_of_splats_are_dropped_without_an_object_per_list(path):
    body = b"".join(row.tobytes() + bytes([index]) + bytes(4 * index) for index, row in enumerate(ROWS))
    text = "\n".join(f"{line} {'2 1 1' if row % 2 else '0'}" for row, line in enumerate(lines_of(ROWS)))
    texts = [text_ply(one, after=[LIST]) for one in (text, text.replace("\n", "\n\n"))]
    for data in (header(ROWS, after=[LIST]) + body, *texts):
        path.write_bytes(data)
        assert 1 == counts(path)["list-columns"]
        assert_splats_of_rows(read_ply(path))
    short = text_ply(text.replace("2 1 1", "2 1"), after=[LIST])
    assert_refused(path, {"short": (short, "row 1 of vertex has 28 values, which its properties do not match")})
    rows, names = good_rows(130), [f"property list uchar int a{index}" for index in range(100)]
    path.write_bytes(header(rows, after=names) + b"".join(row.tobytes() + bytes(100) for row in rows))
    model, peak = peak_of(read_ply, path)
    assert np.array_equal(model.means[:, 0], rows["x"])
    assert peak < 8 * path.stat().st_size + HEADER_PEAK

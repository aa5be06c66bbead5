"""PLY: columns, headers, comments and doubles, read and written; refusals; limits of time and memory."""

import gzip
import os
import time
import tracemalloc
import zipfile
from contextlib import suppress

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from tables import failures

from csplat import decode, encode
from csplat.errors import InputError
from csplat.ply import read_ply, write_ply
from csplat.ply.columns import LOGIT_OF_0, LOGIT_OF_1, alpha_of_logits, logits_of_alpha
from csplat.training_record import TrainingRecord

ARRAYS = ("means", "quats", "scales", "sh0", "shN")


def header_of(path):
    return path.read_bytes().split(b"end_header\n")[0].decode().splitlines()


def write_rows(path, names, rows, *, kind="binary_little_endian", comments=(), after=b""):
    """Write a PLY of float columns without csplat's writer."""
    lines = ["ply", f"format {kind} 1.0", *(f"comment {one}" for one in comments)]
    lines += [f"element vertex {len(rows)}", *(f"property float {name}" for name in names)]
    data = "\n".join([*lines, "end_header\n"]).encode()
    rows = np.asarray(rows, np.float32).reshape(len(rows), len(names))
    if kind == "ascii":
        body = "".join(" ".join(f"{float(v)!r}" for v in row) + "\n" for row in rows).encode()
    else:
        body = rows.astype("<f4" if "little" in kind else ">f4").tobytes()
    path.write_bytes(data + body + after)


def written(path, degree, count=7, **options):
    """Write a PLY of random rows; return its columns and rows."""
    names = columns_of(degree)
    rows = random_rows(names, count)
    write_rows(path, names, rows, **options)
    return names, rows


def columns_of(degree, *, normals=True):
    names = ["x", "y", "z"] + (["nx", "ny", "nz"] if normals else [])
    names += ["f_dc_0", "f_dc_1", "f_dc_2"]
    names += [f"f_rest_{i}" for i in range(3 * ((degree + 1) ** 2 - 1))]
    names += ["opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"]
    return names


def random_rows(names, count=7, seed=0):
    rows = np.random.default_rng(seed).standard_normal((count, len(names))).astype(np.float32)
    rows[:, [i for i, name in enumerate(names) if name in ("nx", "ny", "nz")]] = 0
    return rows


def assert_holds(model, names, rows):
    """Assert that a model agrees with rows, by the definition of the columns."""
    at = {name: rows[:, index].astype(np.float64) for index, name in enumerate(names)}
    coefficients = sum(name.startswith("f_rest") for name in names) // 3
    assert np.array_equal(model.means, np.stack([at[n] for n in ("x", "y", "z")], 1))
    assert np.array_equal(model.sh0, np.stack([at[f"f_dc_{i}"] for i in range(3)], 1))
    assert np.array_equal(model.scales, np.stack([at[f"scale_{i}"] for i in range(3)], 1))
    assert (len(rows), coefficients, 3) == model.shN.shape
    for channel in range(3):
        for k in range(coefficients):
            expected = at[f"f_rest_{channel * coefficients + k}"]
            assert np.array_equal(model.shN[:, k, channel], expected)
    quats = np.stack([at[f"rot_{i}"] for i in range(4)], 1)
    quats /= np.linalg.norm(quats, axis=1, keepdims=True)
    np.testing.assert_allclose(model.quats, quats, atol=1e-7)
    alpha = (1 / (1 + np.exp(-at["opacity"]))).astype(np.float32)
    assert np.array_equal(model.opacities, alpha)


def assert_same_scene(expected, actual):
    for name in ARRAYS:
        assert np.array_equal(getattr(expected, name), getattr(actual, name)), name
    np.testing.assert_allclose(actual.opacities, expected.opacities, rtol=2e-6, atol=1e-7)


@pytest.mark.parametrize("kind", ["binary_little_endian", "binary_big_endian", "ascii"])
@pytest.mark.parametrize("normals", [True, False])
@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_reads_every_degree_and_encoding(tmp_path, degree, normals, kind):
    names = columns_of(degree, normals=normals)
    rows = random_rows(names)
    write_rows(tmp_path / "a.ply", names, rows, kind=kind)
    report = []
    model = read_ply(tmp_path / "a.ply", strict=True, report=report)
    assert_holds(model, names, rows)
    assert {one.id for one in report} <= {"unnormalised-quats"}


def test_reads_more_rows_than_one_block(tmp_path):
    names, rows = written(tmp_path / "a.ply", 3, 10_000)
    assert_holds(read_ply(tmp_path / "a.ply"), names, rows)


def test_reads_columns_by_name_in_any_order(tmp_path):
    names = columns_of(2)
    rows = random_rows(names)
    order = np.random.default_rng(5).permutation(len(names))
    shuffled = [names[i] for i in order]
    write_rows(tmp_path / "a.ply", shuffled, rows[:, order])
    report = []
    assert_holds(read_ply(tmp_path / "a.ply", report=report), names, rows)
    assert "shuffled-columns" in {one.id for one in report}


def test_reads_a_header_with_windows_line_ends(tmp_path):
    names, rows = written(tmp_path / "a.ply", 0)
    head, body = (tmp_path / "a.ply").read_bytes().split(b"end_header\n")
    crlf = head.replace(b"\n", b"\r\n") + b"end_header\r\n" + body
    assert_holds(read_ply(crlf, strict=True), names, rows)


def test_keeps_header_comments(tmp_path):
    written(tmp_path / "a.ply", 0, comments=["made by", "a machine"])
    model = read_ply(tmp_path / "a.ply")
    assert ["made by", "a machine"] == model.metadata["comments"]
    write_ply(tmp_path / "b.ply", model)
    assert model.metadata == read_ply(tmp_path / "b.ply").metadata


@pytest.mark.parametrize("kind", ["binary_little_endian", "ascii"])
def test_a_comment_of_end_header_does_not_end_the_header(tmp_path, kind):
    names, rows = written(tmp_path / "a.ply", 0, kind=kind, comments=["end_header", "é end_header"])
    report = []
    assert_holds(read_ply(tmp_path / "a.ply", strict=True, report=report), names, rows)
    assert {"non-ascii-header", "unnormalised-quats"} == {one.id for one in report}


def test_a_header_outside_ascii_is_read_with_question_marks(tmp_path):
    names, rows = written(tmp_path / "a.ply", 0, comments=["café"])
    report = []
    model = read_ply(tmp_path / "a.ply", report=report)
    assert_holds(model, names, rows)
    assert ["caf??"] == model.metadata["comments"]
    assert "non-ascii-header" in {one.id for one in report}


@pytest.mark.parametrize("kind", ["binary_little_endian", "ascii"])
def test_reads_a_file_without_splats(tmp_path, kind):
    written(tmp_path / "a.ply", 3, 0, kind=kind)
    model = read_ply(tmp_path / "a.ply", strict=True)
    assert (0, 3) == (len(model), model.sh_degree)


def test_extra_columns_are_kept_on_request(tmp_path, make_model):
    ids, classes = np.arange(10, dtype=np.int32), np.arange(10, dtype=np.uint8)
    extra = {"object_id": ids, "class": classes, "weight": np.linspace(0, 1, 10)}
    model = make_model(10, 3, extra=extra)
    write_ply(tmp_path / "a.ply", model)
    again = read_ply(tmp_path / "a.ply", keep_extra=True, strict=True)
    assert_same_scene(model, again)
    assert list(extra) == list(again.extra)
    for name, column in extra.items():
        assert column.dtype == again.extra[name].dtype
        assert np.array_equal(again.extra[name], column)
    assert {} == dict(read_ply(tmp_path / "a.ply").extra)


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
@pytest.mark.parametrize("count", [0, 1, 2, 5000])
def test_written_scenes_read_back(tmp_path, make_model, count, degree):
    model = make_model(count, degree)
    write_ply(tmp_path / "a.ply", model)
    report = []
    again = read_ply(tmp_path / "a.ply", strict=True, report=report)
    assert_same_scene(model, again)
    assert ["empty"] if count == 0 else [] == ([one.id for one in report])


def test_writes_the_columns_and_order_that_viewers_expect(tmp_path, make_model):
    write_ply(tmp_path / "a.ply", make_model(3, 1, origin=(1.0, 2.0, 3.0)))
    lines = header_of(tmp_path / "a.ply")
    assert ["ply", "format binary_little_endian 1.0", "element vertex 3"] == lines[:3]
    assert [f"property float {name}" for name in columns_of(1)] == lines[3:-1]
    assert "comment csplat origin 1.0 2.0 3.0" == lines[-1]


def test_writes_rows_that_plain_numpy_reads(tmp_path, make_model):
    model = make_model(5, 2)
    write_ply(tmp_path / "a.ply", model)
    names = columns_of(2)
    rows = np.frombuffer((tmp_path / "a.ply").read_bytes().split(b"end_header\n")[1], "<f4")
    rows = rows.reshape(5, len(names))
    at = {name: rows[:, index] for index, name in enumerate(names)}
    assert np.array_equal(at["f_rest_9"], model.shN[:, 1, 1])
    assert np.array_equal(at["rot_0"], model.quats[:, 0])
    assert not at["nx"].any()
    assert not at["nz"].any()


def test_metadata_survive_a_ply(tmp_path, make_model):
    model = make_model(4, origin=(4.5e6, -1.25, 0.1), coordinate_system="RUB", unit_metres=0.01, antialiased=True,
        flat=True, metadata={"licence": "CC0-1.0", "comments": ["hello"]})  # fmt: skip
    write_ply(tmp_path / "a.ply", model)
    again = read_ply(tmp_path / "a.ply", strict=True)
    for name in ("origin", "coordinate_system", "unit_metres", "antialiased", "flat", "metadata"):
        assert getattr(model, name) == getattr(again, name)
    assert_same_scene(model, again)
    assert {"comment SplatRenderMode: mip", "comment SplatRenderMode: 2dgs"} < set(header_of(tmp_path / "a.ply"))


def test_antialiasing_comments_of_other_programs_are_read(tmp_path, make_model):
    write_ply(tmp_path / "a.ply", make_model(2, 0, antialiased=True))
    for message, antialiased, flat in [
        ("antialiased 1", True, False),
        ("antialiased 0", False, False),
        ("SplatRenderMode: default", False, False),
        ("splatrendermode: 2DGS", False, True),
        ("csplat antialiased", True, False),
    ]:
        data = (tmp_path / "a.ply").read_bytes().replace(b"SplatRenderMode: mip", message.encode())
        found = read_ply(data)
        assert (antialiased, flat, {}) == (found.antialiased, found.flat, found.metadata)


@pytest.mark.parametrize(("comments", "up", "kept", "noted"), [
    (["Vertical Axis: z"], [0, 0, 1], [], True),
    (["Generated by Nerstudio", "vertical axis: Y"], [0, 1, 0], ["Generated by Nerstudio"], True),
    (["  vertical axis : Z "], [0, 0, 1], [], True),
    (["Vertical Axis: -x"], [-1, 0, 0], [], True),
    (["Vertical Axis: up"], None, ["Vertical Axis: up"], False),
    (["Vertical Axis: z", "Vertical Axis: y"], None, ["Vertical Axis: z", "Vertical Axis: y"], True),
    (["Exported from Brush", "Vertical axis: y"], None, ["Exported from Brush", "Vertical axis: y"], False),
    (["csplat up 0 -1 0", "Vertical Axis: z"], [0, -1, 0], ["Vertical Axis: z"], False),
    (["csplat coordinate_system RUB", "Vertical Axis: z"], None, ["Vertical Axis: z"], False),
])  # fmt: skip
def test_a_comment_on_the_vertical_axis_sets_up(tmp_path, comments, up, kept, noted):
    written(tmp_path / "a.ply", 0, comments=comments)
    report = []
    model = read_ply(tmp_path / "a.ply", strict=True, report=report)
    assert (up, kept) == (model.metadata.get("up"), model.metadata.get("comments", []))
    assert noted == any(one.id == "vertical-axis" for one in report)
    write_ply(tmp_path / "b.ply", model)
    assert model.metadata == read_ply(tmp_path / "b.ply").metadata


def test_absolute_positions_are_doubles_and_keep_the_origin(tmp_path, make_model):
    model = make_model(50, 0, origin=(1e7, -3e6, 12.25))
    write_ply(tmp_path / "a.ply", model, absolute=True)
    lines = header_of(tmp_path / "a.ply")
    assert "property double x" in lines
    assert "comment csplat absolute_origin 10000000.0 -3000000.0 12.25" in lines
    again = read_ply(tmp_path / "a.ply", strict=True)
    assert model.origin == again.origin
    np.testing.assert_allclose(again.means, model.means, rtol=1e-6, atol=2e-9)


def read_doubles(path, positions, **options):
    """Read a PLY of these positions in doubles."""
    names = columns_of(0, normals=False)
    rows = np.zeros(len(positions), [(n, "<f8" if n in "xyz" else "<f4") for n in names])
    for axis, name in enumerate("xyz"):
        rows[name] = positions[:, axis]
    rows["rot_0"] = 1
    lines = ["ply", "format binary_little_endian 1.0", f"element vertex {len(rows)}"]
    lines += [f"property {'double' if n in 'xyz' else 'float'} {n}" for n in names]
    path.write_bytes("\n".join([*lines, "end_header\n"]).encode() + rows.tobytes())
    return read_ply(path, **options)


@pytest.mark.parametrize("centre", [(0, 0, 0), (1e7, 5e6, -2e6), (3.0, 1e7, 0)])
def test_an_origin_keeps_positions_in_doubles(tmp_path, centre):
    positions = np.random.default_rng(3).standard_normal((500, 3)) + centre
    report = []
    model = read_doubles(tmp_path / "a.ply", positions, strict=True, report=report)
    assert "double-means" in {one.id for one in report}
    assert any(centre) == any(model.origin)
    restored = model.means.astype(np.float64) + np.array(model.origin)
    assert np.abs(restored - positions).max() < 1e-6


def test_an_outlier_does_not_move_the_origin(tmp_path):
    positions = np.random.default_rng(3).standard_normal((500, 3)) + 1e7
    positions[0] = -1e12
    model = read_doubles(tmp_path / "a.ply", positions)
    assert np.abs(np.array(model.origin) - 1e7).max() < 1
    restored = model.means[1:].astype(np.float64) + np.array(model.origin)
    assert np.abs(restored - positions[1:]).max() < 1e-6


def test_doubles_that_float32_does_not_hold_are_kept_and_written_back(tmp_path):
    positions = np.random.default_rng(3).normal(0, 5, (20, 3)) + np.array([481_250.0, 5_467_100.0, 310.0])
    model = read_doubles(tmp_path / "a.ply", positions)
    write_ply(tmp_path / "b.ply", model, absolute=True)
    np.testing.assert_array_equal(positions, model.means_double)
    np.testing.assert_array_equal(positions, read_ply(tmp_path / "b.ply").means_double)


def test_doubles_that_are_floats_keep_origin_zero(tmp_path):
    positions = np.float32(1e7) + np.arange(30.0).reshape(10, 3)
    model = read_doubles(tmp_path / "a.ply", positions)
    assert (0.0, 0.0, 0.0) == model.origin
    assert np.array_equal(model.means, positions)


def test_splats_in_one_point_far_away_are_exact(tmp_path):
    positions = np.full((10, 3), 1e7 + 0.1)
    model = read_doubles(tmp_path / "a.ply", positions)
    assert np.array_equal(model.means + np.array(model.origin), positions)


def test_the_training_record_survives_files(tmp_path, make_model):
    trained = TrainingRecord((1.0, 1.0, 1.0), 5, (238, 134), 0.003, "bilder  für alle")
    write_ply(tmp_path / "a.ply", make_model(metadata={"training": trained.as_json()}))
    model = read_ply(tmp_path / "a.ply")
    assert {"training": trained.as_json()} == model.metadata
    write_ply(tmp_path / "b.ply", decode(encode(model)))
    assert trained == TrainingRecord.of(read_ply(tmp_path / "b.ply").metadata)
    line = header_of(tmp_path / "b.ply")[-1]
    assert line.startswith('comment csplat training {"background": [1.0, 1.0, 1.0], "test_every": 5')


def test_an_invalid_training_record_is_not_written(tmp_path, make_model):
    write_ply(tmp_path / "a.ply", make_model(metadata={"training": "on a laptop"}))
    assert {} == read_ply(tmp_path / "a.ply").metadata


COMMENTS = {
    "training ": "csplat training.*is invalid: not JSON",
    "training white": "csplat training.*is invalid: not JSON",
    "training " + "[" * 100_000: "csplat training.*is invalid: .*nested too deep",
    "training []": r"is invalid: training is \[\], expected an object",
    "training {}": "training has no background",
    'training {"background": [0, 0]}': "background of training is",
    'training {"background": [0, 0, 1.5]}': "background of training is",
    'training {"background": [0, 0, NaN]}': "background of training is",
    'training {"background": [0, 0, true]}': "background of training is",
    'training {"background": [0, 0, 0], "size": [3.5, 2]}': "size of training is",
    'training {"background": [0, 0, 0], "test_every": 1}': "test_every of training is 1",
    'training {"background": [0, 0, 0], "test_every": false}': "test_every of training is",
    'training {"background": [0, 0, 0], "near": 1e999}': "near of training is",
    'training {"background": [0, 0, 0], "images": 4}': "images of training is",
    'training {"background": [0, 0, 0], "images": "\\ud800"}': "half of a surrogate pair",
    **{
        f"view {text}": "csplat view.*is invalid"
        for text in ("", "0 0 1", "[]", '{"near": 1e999}', '{"near": NaN}', "[" * 100_000)
    },
    **dict.fromkeys(("origin 1 2", "origin a b c", "absolute_origin 1 2 inf"), "3 finite numbers"),
}


def test_invalid_comments_of_csplat_are_refused(tmp_path):
    def check(case):
        comment, message = case
        written(tmp_path / "a.ply", 0, comments=[f"csplat {comment}"])
        with pytest.raises(InputError, match=message):
            read_ply(tmp_path / "a.ply")

    assert [] == failures({one: (one, message) for one, message in COMMENTS.items()}, check)


def test_the_first_view_survives_files(tmp_path, make_model):
    view = {"K": [[1, 0, 2], [0, 1, 2], [0, 0, 1]], "viewmat": np.eye(4).tolist(), "W": 4, "H": 4, "image": "ä b.png"}
    write_ply(tmp_path / "a.ply", make_model(metadata={"view": view}))
    model = read_ply(tmp_path / "a.ply")
    assert {"view": view} == model.metadata == decode(encode(model)).metadata
    for unsound in ("from above", {"near": np.inf}, {"K": np.eye(3)}):
        write_ply(tmp_path / "b.ply", make_model(metadata={"view": unsound}))
        assert {} == read_ply(tmp_path / "b.ply").metadata


def test_infinite_logits_are_alpha_1_and_0(tmp_path):
    names = columns_of(0)
    rows = random_rows(names, 3)
    rows[:, names.index("opacity")] = [np.inf, -np.inf, 0]
    write_rows(tmp_path / "a.ply", names, rows)
    assert [1.0, 0.0, 0.5] == read_ply(tmp_path / "a.ply", strict=True).opacities.tolist()


def test_alphas_of_0_and_1_have_finite_logits():
    logits = logits_of_alpha(np.array([0, 1], np.float32))
    assert [LOGIT_OF_0, LOGIT_OF_1] == logits.tolist()
    assert [0.0, 1.0] == alpha_of_logits(logits).tolist()
    with np.errstate(over="ignore"):
        in_float32 = np.float32(1) / (np.float32(1) + np.exp(-logits))
        other_way = np.exp(logits) / (np.float32(1) + np.exp(logits))
    assert np.float32 == in_float32.dtype
    assert [0.0, 1.0] == in_float32.tolist()
    assert [0.0, 1.0] == other_way.tolist()


@pytest.mark.slow
@given(st.floats(0, 1, width=32))
def test_logits_of_alphas_are_invertible(alpha):
    array = np.array([alpha], np.float32)
    again = alpha_of_logits(logits_of_alpha(array))
    # A logit of magnitude L carries alpha (1 - alpha) L 2**-24; near 1 alpha itself is coarser.
    assert abs(float(again[0]) - float(array[0])) <= 8e-6 * min(alpha, 1 - alpha) + 2**-24 * alpha


def test_a_file_is_replaced_only_once_it_is_complete(tmp_path, make_model):
    path = tmp_path / "a.ply"
    path.write_bytes(b"old")
    with pytest.raises(InputError, match="not a PLY type"):
        write_ply(path, make_model(extra={"id": np.arange(10, dtype=np.int64)}))
    assert b"old" == path.read_bytes()
    write_ply(path, make_model())
    assert 10 == len(read_ply(path))
    assert ["a.ply"] == [one.name for one in tmp_path.iterdir()]


def test_writing_follows_a_symbolic_link(tmp_path, make_model):
    (tmp_path / "real.ply").write_bytes(b"")
    (tmp_path / "link.ply").symlink_to(tmp_path / "real.ply")
    write_ply(tmp_path / "link.ply", make_model())
    assert (tmp_path / "link.ply").is_symlink()
    assert 10 == len(read_ply(tmp_path / "real.ply"))


@pytest.mark.skipif(os.name == "nt", reason="Windows has no /dev/null")
def test_writing_to_a_device_leaves_it_a_device(make_model):
    write_ply("/dev/null", make_model())
    assert not os.path.isfile("/dev/null")  # noqa: PTH113 -- as short as it gets


@pytest.mark.parametrize("name", ["x", "opacity", "f_rest_0", "two words", "ü", ""])
def test_invalid_names_of_extra_columns_are_refused(tmp_path, make_model, name):
    with pytest.raises(InputError, match="extra column"):
        write_ply(tmp_path / "a.ply", make_model(extra={name: np.arange(10.0)}))


def test_comments_cannot_break_the_header(tmp_path, make_model):
    model = make_model(metadata={"comments": ["one\nend_header", "naïve", 5], "licence": "a\nb"})
    write_ply(tmp_path / "a.ply", model)
    again = read_ply(tmp_path / "a.ply", strict=True)
    assert {"comments": ["one", "end_header", "na?ve"], "licence": "a b"} == again.metadata
    assert_same_scene(model, again)


@pytest.mark.parametrize(("name", "data", "format"), [
    ("a.spz", gzip.compress(b"NGSP\x02\0\0\0", mtime=0), "SPZ"),
    ("renamed.ply", gzip.compress(b"NGSP\x02\0\0\0", mtime=0), "SPZ"),
    ("v4.bin", b"NGSP\x04\0\0\0", "SPZ"),
    ("a.splat", bytes(64), ".splat"),
    ("unnamed", b"\x80" * 64, ".splat"),
    ("a.ksplat", b"\x00\x01" + bytes(4096), ".ksplat"),
    ("a.spx", b"spx\x01", "spx"),
    ("a.bin", b"glTF\x02\0\0\0", "glTF"),
    ("a.gltf", b'{"asset": {}}', "glTF"),
    ("meta.json", b'{"means": {}}', "SOG"),
    ("a.csplat", b"\x89CSP", "csplat decode"),
])  # fmt: skip
def test_other_formats_are_named_with_a_converter(tmp_path, name, data, format):
    (tmp_path / name).write_bytes(data)
    with pytest.raises(InputError, match="convert it to PLY first, with") as caught:
        read_ply(tmp_path / name)
    assert format in str(caught.value)


def test_a_ply_with_codebooks_is_named(tmp_path):
    columns = "\nproperty uchar opacity\nproperty uchar scaling\n"
    text = f"ply\nformat binary_little_endian 1.0\nelement vertex_0 1{columns}element codebook_centers 1{columns}"
    (tmp_path / "a.ply").write_bytes(f"{text}end_header\n".encode() + bytes(4))
    with pytest.raises(InputError, match=r"is a PLY with codebooks .*: save it there without quantisation"):
        read_ply(tmp_path / "a.ply")


def test_sog_is_named_in_a_zip_and_in_a_folder(tmp_path):
    with zipfile.ZipFile(tmp_path / "scene.ply", "w") as archive:
        archive.writestr("meta.json", "{}")
    folder = tmp_path / "scene"
    folder.mkdir()
    (folder / "meta.json").write_text("{}")
    for path in (tmp_path / "scene.ply", folder):
        with pytest.raises(InputError, match=r"is SOG, .* `csplat convert`.*csplat\.read"):
            read_ply(path)


def test_a_zip_without_a_scene_is_refused(tmp_path):
    with zipfile.ZipFile(tmp_path / "a.zip", "w") as archive:
        archive.writestr("readme.txt", "")
    with pytest.raises(InputError, match=r"is a zip without a scene: readme\.txt"):
        read_ply(tmp_path / "a.zip")


@pytest.mark.parametrize("data", [b"", b"hello", b"plywood is no PLY"])
def test_other_files_are_refused(tmp_path, data):
    (tmp_path / "a.ply").write_bytes(data)
    with pytest.raises(InputError, match=r"a\.ply is"):
        read_ply(tmp_path / "a.ply")


def test_every_prefix_of_a_file_is_refused(tmp_path):
    written(tmp_path / "a.ply", 0, 2)
    data = (tmp_path / "a.ply").read_bytes()
    for length in range(len(data)):
        with pytest.raises(InputError):
            read_ply(data[:length])


@pytest.mark.slow
def test_flipped_header_bits_are_read_or_refused(tmp_path):
    """Read a header with every third bit flipped, so that each bit position within a byte occurs.

    In lines of columns after the first two, only the name is changed: the rest repeats itself.
    """
    names = columns_of(0, normals=False)
    write_rows(tmp_path / "a.ply", names, random_rows(names, 2))
    data = (tmp_path / "a.ply").read_bytes()
    lines = data[: data.index(b"end_header\n") + 11].splitlines(keepends=True)
    starts = np.cumsum([0, *map(len, lines)]).tolist()
    columns = [number for number, line in enumerate(lines) if line.startswith(b"property float ")]
    same = {starts[number] + at for number in columns[2:] for at in range(len("property float "))}
    bits = [8 * byte + place for byte in range(starts[-1]) if byte not in same for place in range(8)]
    for bit in bits[::3]:
        flipped = bytearray(data)
        flipped[bit // 8] ^= 1 << bit % 8
        with suppress(InputError):
            read_ply(flipped)


def test_a_missing_file_is_an_os_error(tmp_path):
    with pytest.raises(FileNotFoundError):
        read_ply(tmp_path / "none.ply")


@pytest.fixture(scope="module")
def many(tmp_path_factory):
    """A PLY of 400,000 splats."""
    path = tmp_path_factory.mktemp("many") / "a.ply"
    written(path, 3, 10_000)
    data = path.read_bytes().replace(b"vertex 10000\n", b"vertex 400000\n")
    head = data.index(b"end_header\n") + 11
    with path.open("wb") as stream:
        stream.write(data[:head])
        for _ in range(40):
            stream.write(data[head:])
    yield path
    path.unlink()


@pytest.mark.slow
def test_a_million_splats_are_read_in_under_a_second_of_cpu(many):
    times = []
    while len(times) < 5 and min(times, default=1.0) >= 0.4 * 0.8:  # until one run was undisturbed
        start = time.process_time()
        model = read_ply(many)
        times.append(time.process_time() - start)
    assert (400_000, 3) == (len(model), model.sh_degree)
    assert min(times) < 0.4 * 0.8


@pytest.mark.slow
def test_reading_allocates_little_more_than_the_arrays(many):
    tracemalloc.start()
    model = read_ply(many)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    size = sum(getattr(model, name).nbytes for name in (*ARRAYS, "opacities"))
    assert peak < size + 16e6


SCENES = {
    "lego60k": (60_000, 3), "fox120k": (120_000, 3), "fox60k_noreg": (60_000, 3), "plane3": (13_982, 3),
    "train1000": (1_000, 3), "object_id": (4_560, 3), "donut": (45_624, 0), "horse": (28_218, 0),
    "jacket": (54_460, 0), "trailing_bytes": (100, 3),
}  # fmt: skip


@pytest.mark.parametrize("name", SCENES)
def test_real_scenes_are_read_and_written(data_dir, tmp_path, name):
    model = read_ply(data_dir / "ply" / f"{name}.ply")
    assert SCENES[name] == (len(model), model.sh_degree)
    write_ply(tmp_path / "a.ply", model)
    assert_same_scene(model, read_ply(tmp_path / "a.ply", strict=True))


@pytest.mark.parametrize(("path", "format"), [
    ("other/guitar.compressed.ply", "compressed PLY"),
    ("other/tabletop.spz", "SPZ"),
    ("other/luma-seal.splat", ".splat"),
    ("sog/angel.sog", "SOG"),
    ("sog/statue", "SOG"),
    ("sog/statue/meta.json", "SOG"),
])  # fmt: skip
def test_real_files_of_other_formats_are_named(data_dir, path, format):
    with pytest.raises(InputError, match=r"splat-transform|csplat convert") as caught:
        read_ply(data_dir / path)
    assert f"is {format}, " in str(caught.value)

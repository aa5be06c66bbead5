# SPDX-License-Identifier: Apache-2.0
"""PLY: columns, headers, comments and doubles, read and written; refusals; a limit of memory.

Also: csplat.ply.comments.
"""

import gzip
import tracemalloc

import numpy as np
import pytest
import text_plys as texts
from checked import flipped, refusals
from formats_cases import zip_of
from hypothesis import given, settings
from hypothesis import strategies as st
from ply_cases import ARRAYS, assert_same_scene, columns_of, header_of
from tables import failures

from csplat import decode, encode
from csplat.context import Context
from csplat.errors import InputError
from csplat.ply import read_ply, write_ply
from csplat.ply.columns import LOGIT_OF_0, LOGIT_OF_1, alpha_of_logits, logits_of_alpha
from csplat.scene_metadata import TrainingRecord


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


def random_rows(names, count=7):
    rows = np.random.default_rng(0).standard_normal((count, len(names))).astype(np.float32)
    rows[:, [i for i, name in enumerate(names) if name in ("nx", "ny", "nz")]] = 0
    return rows


def written(path, degree, count=7, *, normals=True, **options):
    """Write a PLY of random rows; return its columns and rows."""
    names = columns_of(degree, normals=normals)
    rows = random_rows(names, count)
    write_rows(path, names, rows, **options)
    return names, rows


def assert_holds(model, names, rows):
    """Assert that a model agrees with rows, by the definition of the columns."""
    at = {name: rows[:, index].astype(np.float64) for index, name in enumerate(names)}
    coefficients = sum(name.startswith("f_rest") for name in names) // 3
    for axis in range(3):
        assert np.array_equal(model.means[:, axis], at["xyz"[axis]])
        assert np.array_equal(model.sh0[:, axis], at[f"f_dc_{axis}"])
        assert np.array_equal(model.scales[:, axis], at[f"scale_{axis}"])
        for k in range(coefficients):
            assert np.array_equal(model.shN[:, k, axis], at[f"f_rest_{axis * coefficients + k}"])
    assert (len(rows), coefficients, 3) == model.shN.shape
    quats = np.stack([at[f"rot_{i}"] for i in range(4)], 1)
    np.testing.assert_allclose(model.quats, quats / np.linalg.norm(quats, axis=1, keepdims=True), atol=1e-7)
    assert np.array_equal(model.opacities, (1 / (1 + np.exp(-at["opacity"]))).astype(np.float32))


@pytest.mark.parametrize("kind", ["binary_little_endian", "binary_big_endian", "ascii"])
@pytest.mark.parametrize(("degree", "normals"), [(0, True), (1, False), (2, True), (3, True), (3, False)])
def test_reads_every_degree_and_encoding(tmp_path, degree, normals, kind):
    path, report = tmp_path / "a.ply", []
    names, rows = written(path, degree, normals=normals, kind=kind)
    assert_holds(read_ply(path, strict=True, report=report), names, rows)
    assert {one.id for one in report} <= {"unnormalised-quats"}
    write_rows(path, names, rows[:0], kind=kind)
    assert (0, degree) == (len(empty := read_ply(path, strict=True)), empty.sh_degree)


def test_reads_more_rows_than_one_block_and_columns_by_name_in_any_order(tmp_path):
    names, rows = written(tmp_path / "a.ply", 3, 10_000)
    assert_holds(read_ply(tmp_path / "a.ply"), names, rows)
    names = columns_of(2)
    rows = random_rows(names)
    order, report = np.random.default_rng(5).permutation(len(names)), []
    write_rows(tmp_path / "a.ply", [names[i] for i in order], rows[:, order])
    assert_holds(read_ply(tmp_path / "a.ply", report=report), names, rows)
    assert "shuffled-columns" in {one.id for one in report}


@pytest.mark.parametrize("kind", ["binary_little_endian", "ascii"])
def test_header_comments_are_kept(tmp_path, kind):
    comments = ["made by", "a machine", "end_header", "é end_header", "café"]
    names, rows = written(tmp_path / "a.ply", 0, kind=kind, comments=comments)
    report = []
    model = read_ply(tmp_path / "a.ply", strict=True, report=report)
    assert_holds(model, names, rows)
    assert comments == model.metadata.entries["comments"]
    assert {"unnormalised-quats"} == {one.id for one in report}
    write_ply(tmp_path / "b.ply", model)
    assert model.metadata == read_ply(tmp_path / "b.ply").metadata


def test_text_has_one_grammar_of_numbers_and_rows(tmp_path):
    # `test_c_encoder.py` has the same cases: both readers accept the same texts, and name the same lines.
    path = tmp_path / "text.ply"

    def read(data):
        path.write_bytes(data)
        return read_ply(path, keep_extra=True)

    def check_layout(name):
        body, place = texts.LAYOUTS[name]
        if name in texts.REFUSED:
            with pytest.raises(InputError, match=place):
                read(texts.text_ply(body))
            return
        model = read(texts.text_ply(body))
        assert [[1, 2, 3]] * 2 == model.means.tolist()
        assert [[0.5, 0.25, 0.125]] * 2 == model.sh0.tolist()

    assert [] == failures({name: name for name in texts.LAYOUTS}, check_layout)

    def body(word):
        return f"{texts.ROW} {word}\n{texts.ROW} 1\n"

    for word, value in texts.NUMBERS.items():
        found = read(texts.text_ply(body(word), extra="property double more\n")).extra["more"][0]
        assert np.array_equal(np.float64(value), found, equal_nan=True), word
    for word in texts.INTEGERS:
        assert int(word) == read(texts.text_ply(body(word), extra="property uchar more\n")).extra["more"][0]
    for kind, words in (("float", texts.NO_NUMBERS), ("uchar", texts.NO_INTEGERS)):
        for word in words:
            with pytest.raises(InputError):
                read(texts.text_ply(body(word), extra=f"property {kind} more\n"))
    with pytest.raises(InputError, match="origin"):
        read(texts.text_ply(f"{texts.ROW}\n{texts.ROW}\n", comment="comment csplat origin 1_0 2 3\n"))


def test_extra_columns_are_kept_on_request(tmp_path, make_model):
    extra = {"object_id": np.arange(10, dtype=np.int32), "class": np.arange(10, dtype=np.uint8)}
    extra["weight"] = np.linspace(0, 1, 10)
    write_ply(tmp_path / "a.ply", make_model(10, 3, extra=extra))
    again = read_ply(tmp_path / "a.ply", keep_extra=True, strict=True).extra
    assert [(name, one.dtype, one.tolist()) for name, one in extra.items()] == [
        (name, one.dtype, one.tolist()) for name, one in again.items()
    ]
    assert {} == dict(read_ply(tmp_path / "a.ply").extra)


def test_numbered_columns_of_one_type_become_the_components_of_one(tmp_path, make_model):
    single = {f"f_{k}": np.full(10, k, np.float32) for k in range(70)} | {"g_0": np.arange(10.0), "h_1": np.zeros(10)}
    single |= {"u_0": np.zeros(10, np.int32), "u_1": np.zeros(10, np.uint32), "n": np.ones(10), "n_0": np.ones(10)}
    single |= {"n_1": np.ones(10), "q_00": np.ones(10), "q_01": np.ones(10)}
    write_ply(tmp_path / "a.ply", make_model(10, 0, extra=single))
    model = read_ply(tmp_path / "a.ply", keep_extra=True)
    shapes = {name: column.shape[1:] for name, column in model.extra.items()}
    assert {"f": (64,), "f_64": (6,)} == {name: shape for name, shape in shapes.items() if shape}
    assert {*single} - {f"f_{k}" for k in range(70)} == {name for name, shape in shapes.items() if not shape}
    assert model.extra["f"][3].tolist() == list(range(64))
    write_ply(tmp_path / "b.ply", model)
    assert (tmp_path / "a.ply").read_bytes() == (tmp_path / "b.ply").read_bytes()
    wide = make_model(10, 0, extra={"n": np.zeros((10, 3), np.float32), "n_1": np.zeros(10)})
    with pytest.raises(InputError, match="extra column 'n_1': the PLY has a column 'n_1' already"):
        write_ply(tmp_path / "c.ply", wide)


def test_names_state_semantics_that_suit_the_type_and_comments_state_others(tmp_path, make_model):
    extra = {"label": np.zeros(10, np.uint8), "object_id": np.zeros(10), "normal": np.zeros((10, 3), np.float32)}
    extra |= {"time": np.zeros(10), "frame": np.zeros((10, 2), np.int32), "x_clip": np.zeros((10, 8), np.float32)}
    write_ply(tmp_path / "a.ply", make_model(10, 0, extra=extra, semantics={"x_clip": "feature:clip"}))
    semantics = read_ply(tmp_path / "a.ply", keep_extra=True).metadata.semantics
    assert {"label": "label", "normal": "normal", "time": "time", "x_clip": "feature:clip"} == semantics


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
    assert (up, kept) == (model.metadata.entries.get("up"), model.metadata.entries.get("comments", []))
    assert noted == any(one.id == "vertical-axis" for one in report)
    write_ply(tmp_path / "b.ply", model)
    assert model.metadata == read_ply(tmp_path / "b.ply").metadata


def read_doubles(path, positions, **options):
    """Read a PLY of these positions in doubles."""
    names = columns_of(0, normals=False)
    rows = np.zeros(len(positions), [(n, "<f8" if n in "xyz" else "<f4") for n in names])
    rows["x"], rows["y"], rows["z"] = positions.T
    rows["rot_0"] = 1
    lines = ["ply", "format binary_little_endian 1.0", f"element vertex {len(rows)}"]
    lines += [f"property {'double' if n in 'xyz' else 'float'} {n}" for n in names]
    path.write_bytes("\n".join([*lines, "end_header\n"]).encode() + rows.tobytes())
    return read_ply(path, **options)


@pytest.mark.parametrize("centre", [(0, 0, 0), (1e7, 5e6, -2e6), (3.0, 1e7, 0), (481_250.0, 5_467_100.0, 310.0)])
def test_an_origin_keeps_positions_in_doubles(tmp_path, centre):
    positions = np.random.default_rng(3).standard_normal((500, 3)) + centre
    model = read_doubles(tmp_path / "a.ply", positions, strict=True)
    assert any(centre) == any(model.origin)
    assert np.abs(model.means.astype(np.float64) + model.origin - positions).max() < 1e-6
    write_ply(tmp_path / "b.ply", model, absolute=True)
    np.testing.assert_array_equal(positions, model.means_double)
    np.testing.assert_array_equal(positions, read_ply(tmp_path / "b.ply").means_double)
    positions[0] = -1e12  # an outlier does not move the origin
    model = read_doubles(tmp_path / "a.ply", positions)
    assert np.abs(np.array(model.origin) - centre).max() < 1
    assert np.abs(model.means[1:].astype(np.float64) + model.origin - positions[1:]).max() < 1e-6


def test_positions_that_floats_hold_about_their_origin_are_exact(tmp_path):
    floats = np.float32(1e7) + np.arange(30.0).reshape(10, 3)
    assert (0.0, 0.0, 0.0) == read_doubles(tmp_path / "a.ply", floats).origin
    for positions in (floats, np.full((10, 3), 1e7 + 0.1)):
        model = read_doubles(tmp_path / "a.ply", positions)
        assert np.array_equal(model.means + np.array(model.origin), positions)


COMMENTS = {
    "training ": "csplat training.*is invalid: not JSON",
    "training white": "csplat training.*is invalid: not JSON",
    "training " + "[" * 10_000: "csplat training.*is invalid: .*nested too deep",
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
        for text in ("", "0 0 1", "[]", '{"near": 1e999}', '{"near": NaN}', "[" * 10_000)
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


VIEW = {"K": [[1, 0, 2], [0, 1, 2], [0, 0, 1]], "viewmat": np.eye(4).tolist(), "W": 4, "H": 4, "image": "ä b.png"}
TRAINED = TrainingRecord((1.0, 1.0, 1.0), 5, (238, 134), 0.003, "bilder  für alle")


@pytest.mark.parametrize(("metadata", "line"), [
    ({"view": VIEW}, 'view {"H": 4, "K": [[1, 0, 2]'),
    ({"training": TRAINED.as_json()}, 'training {"background": [1.0, 1.0, 1.0], "test_every": 5'),
])  # fmt: skip
def test_the_training_record_and_the_first_view_survive_files(tmp_path, make_model, metadata, line):
    write_ply(tmp_path / "a.ply", make_model(entries=metadata))
    model = read_ply(tmp_path / "a.ply")
    assert metadata == model.metadata.entries
    write_ply(tmp_path / "b.ply", decode(encode(model)))
    again = read_ply(tmp_path / "b.ply").metadata
    assert metadata == again.entries
    assert "view" in metadata or TRAINED == again.training
    assert header_of(tmp_path / "b.ply")[-1].startswith(f"comment csplat {line}")


def test_alphas_of_0_and_1_have_finite_logits():
    logits = logits_of_alpha(np.array([0, 1], np.float32))
    assert ([LOGIT_OF_0, LOGIT_OF_1], [0.0, 1.0]) == (logits.tolist(), alpha_of_logits(logits).tolist())
    with np.errstate(over="ignore"):  # by both formulas that programs use, in float32
        formulas = 1 / (1 + np.exp(-logits)), np.exp(logits) / (1 + np.exp(logits))
    assert all(np.float32 == one.dtype and [0.0, 1.0] == one.tolist() for one in formulas)


@pytest.mark.slow
@settings(max_examples=50)
@given(st.floats(0, 1, width=32))
def test_logits_of_alphas_are_invertible(alpha):
    array = np.array([alpha], np.float32)
    again = alpha_of_logits(logits_of_alpha(array))
    # A logit of magnitude L carries alpha (1 - alpha) L 2**-24; near 1 alpha itself is coarser.
    assert abs(float(again[0]) - float(array[0])) <= 8e-6 * min(alpha, 1 - alpha) + 2**-24 * alpha


CONVERT = "convert it to PLY first, with.*"
CODED = "\nproperty uchar opacity\nproperty uchar scaling\n"
CODEBOOKS = f"element vertex_0 1{CODED}element codebook_centers 1{CODED}end_header\n\1\1\1\1"


@pytest.mark.parametrize(("name", "data", "message"), [
    ("a.spz", gzip.compress(b"NGSP\x02\0\0\0", mtime=0), f"SPZ.*{CONVERT}"),
    ("renamed.ply", gzip.compress(b"NGSP\x02\0\0\0", mtime=0), f"SPZ.*{CONVERT}"),
    ("v4.bin", b"NGSP\x04\0\0\0", f"SPZ.*{CONVERT}"),
    ("a.splat", bytes(64), rf"is \.splat.*{CONVERT}"),
    ("unnamed", b"\x80" * 64, rf"is .*\.splat.*{CONVERT}"),
    ("a.ksplat", b"\x00\x01" + bytes(4096), rf"is \.ksplat.*{CONVERT}"),
    ("a.spx", b"spx\x01", f"is .*spx.*{CONVERT}"),
    ("a.bin", b"glTF\x02\0\0\0", f"glTF.*{CONVERT}"),
    ("a.gltf", b'{"asset": {}}', f"glTF.*{CONVERT}"),
    ("meta.json", b'{"means": {}}', f"SOG.*{CONVERT}"),
    ("a.csplat", b"\x89CSP", f"{CONVERT}csplat decode"),
    ("scene.ply", zip_of([("meta.json", "{}")]), r"is SOG, .* `csplat convert`.*csplat\.read"),
    ("a.zip", zip_of([("readme.txt", "{}")]), r"is a zip without a scene: readme\.txt"),
    ("a.ply", f"ply\nformat binary_little_endian 1.0\n{CODEBOOKS}".encode(), r"with codebooks .* without quantisation"),
    ("a.ply", b"", r"a\.ply is"),
    ("a.ply", b"plywood is no PLY", r"a\.ply is"),
])  # fmt: skip
def test_other_files_are_named_and_refused(tmp_path, name, data, message):
    (tmp_path / name).write_bytes(data)
    with pytest.raises(InputError, match=message):
        read_ply(tmp_path / name)


def test_folders_and_missing_files_are_refused(tmp_path):
    (tmp_path / "meta.json").write_text("{}")
    with pytest.raises(InputError, match=r"is SOG, .* `csplat convert`.*csplat\.read"):
        read_ply(tmp_path)
    with pytest.raises(FileNotFoundError):
        read_ply(tmp_path / "none.ply")


@pytest.mark.slow
def test_damage_is_refused_or_read(tmp_path):
    path = tmp_path / "a.ply"
    written(path, 0, 2, normals=False)
    data = path.read_bytes()
    end = data.index(b"end_header\n") + 11
    sizes = [*range(60), *range(60, end, 9), *range(end - 12, len(data), 5), len(data) - 1]
    assert all(refusals(path, (data[:size] for size in sizes), read_ply))
    places = [*range(60), *range(60, end - 20, 11), *range(end - 20, end)]
    assert any(refusals(path, flipped(data, places), read_ply))


@pytest.mark.slow
def test_reading_allocates_little_more_than_the_arrays(tmp_path):
    path = tmp_path / "a.ply"
    written(path, 3, 10_000)
    head, rows = path.read_bytes().split(b"end_header\n", 1)
    path.write_bytes(head.replace(b"vertex 10000\n", b"vertex 200000\n") + b"end_header\n" + rows * 20)
    tracemalloc.start()
    model = read_ply(path)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    size = sum(getattr(model, name).nbytes for name in (*ARRAYS, "opacities"))
    assert peak < size + 16e6


@pytest.mark.slow
def test_threads_change_neither_splats_nor_findings(tmp_path):
    path, count = tmp_path / "a.ply", 80_000  # 20 MB
    names, rows = columns_of(3), np.tile(random_rows(columns_of(3), 1000), (count // 1000, 1))
    rows[:, names.index("x")] = np.arange(count)
    bad = np.r_[3, 9000:14000, 40_000, count - 1]  # a few, a block and more
    rows[bad, names.index("f_dc_1")] = np.nan
    write_rows(path, names, rows)
    one, several = [], []
    expected = read_ply(path, report=one, context=Context(threads=1))
    model = read_ply(path, report=several, context=Context(threads=3))
    assert np.array_equal(np.delete(np.arange(count), bad), expected.means[:, 0])
    assert one == several
    for name in (*ARRAYS, "opacities"):
        assert np.array_equal(getattr(expected, name), getattr(model, name)), name


@pytest.mark.parametrize(("name", "count", "degree"), [
    ("plane3", 13_982, 3), ("object_id", 4_560, 3), ("horse", 28_218, 0), ("trailing_bytes", 100, 3),
])  # fmt: skip
def test_real_scenes_are_read_and_written(data_dir, tmp_path, name, count, degree):
    model = read_ply(data_dir / "ply" / f"{name}.ply")
    assert (count, degree) == (len(model), model.sh_degree)
    write_ply(tmp_path / "a.ply", model)
    assert_same_scene(model, read_ply(tmp_path / "a.ply", strict=True))

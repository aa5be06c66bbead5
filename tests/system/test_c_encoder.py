# SPDX-License-Identifier: Apache-2.0
"""The encoder in C: it writes the integers of the preset `fast`, passes the encoder suite, and refuses bad input."""

import ctypes
import os
import shlex
import shutil
import subprocess
import sys
import zlib
from dataclasses import replace
from typing import ClassVar

import numpy as np
import pytest
import text_plys as texts
from c_encoder import BUCKET_SPLATS, SAMPLE, C, compiled, run
from tables import failures

import csplat
from csplat import InputError
from csplat.decoder.decode_api import decode_integers, decode_scene
from csplat.ply import read_ply
from csplat.scene_metadata import SceneMetadata
from csplat_conformance.encoders import EncoderSuiteOptions, run_encoder

pytestmark = pytest.mark.slow
SANITIZED = ("-g", "-O1", "-fsanitize=address,undefined", "-fno-sanitize-recover=all")
in_depth = pytest.mark.long


@pytest.fixture(scope="module")
def library(tmp_path_factory):
    """The optimised encoder; GCC vectorises at -O2."""
    return ctypes.CDLL(str(compiled(tmp_path_factory.mktemp("c"), "encode.so", "-O2", "-shared", "-fPIC")))


@pytest.fixture(scope="module", params=[("-O2",), pytest.param(SANITIZED, marks=in_depth)], ids=["plain", "sanitizers"])
def tool(request, tmp_path_factory):
    return compiled(tmp_path_factory.mktemp("tool"), "encode", *request.param, C / "tools" / "encode.c")


Allocate = ctypes.CFUNCTYPE(ctypes.c_void_p, ctypes.c_void_p, ctypes.c_size_t)
Release = ctypes.CFUNCTYPE(None, ctypes.c_void_p, ctypes.c_void_p)
Progress = ctypes.CFUNCTYPE(ctypes.c_int, ctypes.c_void_p, ctypes.c_double)
Deflate = ctypes.CFUNCTYPE(
    ctypes.c_size_t, ctypes.c_void_p, ctypes.c_void_p, ctypes.c_size_t, ctypes.c_void_p, ctypes.c_size_t
)


class Splats(ctypes.Structure):
    ARRAYS = ("means", "quats", "scales", "opacities", "sh0", "shN", "positions")
    _fields_: ClassVar = [
        ("count", ctypes.c_uint32),
        ("sh_degree", ctypes.c_uint),
        *((name, ctypes.c_void_p) for name in ARRAYS),
        ("origin", ctypes.c_double * 3),
        ("unit_metres", ctypes.c_double),
        ("axes", ctypes.c_char * 4),
        ("antialiased", ctypes.c_uint8),
        ("flat", ctypes.c_uint8),
        ("colour_space", ctypes.c_uint8),
        ("metadata", ctypes.c_char_p),
        ("metadata_size", ctypes.c_size_t),
    ]


class Options(ctypes.Structure):
    _fields_: ClassVar = [
        ("source_index", ctypes.c_void_p),
        ("progress", Progress),
        ("allocate", Allocate),
        ("release", Release),
        ("deflate", Deflate),
        ("user", ctypes.c_void_p),
    ]


class Error(ctypes.Structure):
    _fields_: ClassVar = [
        ("code", ctypes.c_int),
        ("offset", ctypes.c_uint64),
        ("clause", ctypes.c_char_p),
        ("message", ctypes.c_char * 192),
    ]


def encode(library, model, options=None, **fields):
    """Return the bytes of a file and its source index, or raise an `InputError` with the message."""
    arrays = [np.ascontiguousarray(getattr(model, name)) for name in Splats.ARRAYS[:-1]]
    pointers = [array.ctypes.data for array in arrays]
    splats = Splats(len(model), model.sh_degree, *pointers, None, model.origin, **fields)
    index = np.zeros(len(model), np.uint32)
    options = options or Options()
    options.source_index = index.ctypes.data
    data, size, error = ctypes.POINTER(ctypes.c_uint8)(), ctypes.c_size_t(), Error()
    if library.csplat_encode(*map(ctypes.byref, (splats, options, data, size, error))):
        assert not data
        raise csplat.InputError(error.message.decode())
    content = ctypes.string_at(data, size.value)
    (options.release or free)(None, data)
    return content, index


def free(_user, data):
    ctypes.CDLL(None).free(data)


@pytest.fixture(scope="module")
def sample():
    return csplat.read(SAMPLE).with_metadata(SceneMetadata())


def assert_like_python(library, model):
    """Assert the integers, values, order and declared errors of the preset `fast`, in not many more bytes."""
    ours = csplat.encode_with_report(model, csplat.EncodeOptions(preset="fast"))
    content, index = encode(library, model)
    expected, actual = decode_integers(ours.data), decode_integers(content)
    assert expected.keys() == actual.keys()
    assert [] == [name for name in expected if not np.array_equal(expected[name], actual[name])]
    expected, actual = decode_scene(ours.data), decode_scene(content)
    assert expected.declared_bounds == actual.declared_bounds
    assert [] == [
        name
        for name in ("means", "quats", "scales", "opacities", "sh0", "shN")
        if not np.array_equal(getattr(expected.model, name), getattr(actual.model, name))
    ]
    assert np.array_equal(ours.source_index, index)
    assert len(content) <= 1.02 * len(ours.data)


def test_writes_the_integers_of_the_preset_fast(library, sample):
    assert_like_python(library, sample)
    for degree in range(3):
        assert_like_python(library, replace(sample, shN=sample.shN[:, : (degree + 1) ** 2 - 1]))
    assert_like_python(library, sample.select(slice(0, 255)))  # too few for a codebook
    assert_like_python(library, sample.select(slice(0, 700)))  # fewer entries
    assert_like_python(library, replace(sample, shN=np.concatenate([sample.shN, sample.shN[:, :9]], axis=1)))


def test_writes_the_same_integers_for_extreme_values(library, sample):
    few = sample.select(slice(0, 3000))
    rows = np.arange(len(few))
    cases = [("means", 1e5), ("means", 1e-6), ("sh0", 1e4), ("shN", 300.0), ("scales", 20.0), ("scales", 1e37)]
    for name, factor in cases:
        array = getattr(few, name).copy()
        array[rows % 50 == 0] *= np.float32(factor)
        assert_like_python(library, replace(few, **{name: array}))
    assert_like_python(library, replace(few, means=np.round(few.means * 64) / np.float32(64)))  # on a grid
    assert_like_python(library, few.select(np.zeros(5000, np.intp)))


def test_cuts_the_same_tiles(library, sample):
    rng, few = np.random.default_rng(3), replace(sample, shN=sample.shN[:, :3])
    for count in (40_000, 140_000):  # the least limit of a tile holds, and an eighth of the splats
        model = few.select(rng.integers(0, len(few), count))
        moved = model.means + rng.normal(0.0, 0.3, model.means.shape).astype(np.float32)
        assert_like_python(library, replace(model, means=moved))


def test_gives_the_same_steps_to_parts_far_from_each_other(library, sample):
    rng, few = np.random.default_rng(4), sample.select(slice(0, 1500))
    for parts in (2, 3, 7):
        part = np.repeat(np.arange(parts), rng.integers(150, 1500, parts))
        model = few.select(rng.integers(0, len(few), len(part)))
        sizes, centres = np.exp(rng.uniform(-3.0, 3.0, parts)), rng.normal(0.0, 300.0, (parts, 3))
        means = (model.means * sizes[part, None] + centres[part]).astype(np.float32)
        scales = (model.scales + np.log(sizes[part, None])).astype(np.float32)
        scales[::400] += np.float32(30.0)  # outliers
        assert_like_python(library, replace(model, means=means, scales=scales))


@in_depth
def test_writes_the_same_integers_for_a_scene_of_several_buckets(library, sample):
    count = BUCKET_SPLATS + 20000
    rng = np.random.default_rng(1)
    model = sample.select(rng.integers(0, len(sample), count))
    moved = model.means + rng.normal(0.0, 0.3, model.means.shape).astype(np.float32)
    noisy = (model.shN[:, :8] + rng.normal(0.0, 0.02, (count, 8, 3))).astype(np.float32)
    assert_like_python(library, replace(model, means=moved, shN=noisy))


@pytest.mark.shared_data
@in_depth
def test_writes_the_same_integers_for_trained_scenes(library, data_dir):
    for path in sorted((data_dir / "ply").glob("*.ply")):
        assert_like_python(library, csplat.read(path).with_metadata(SceneMetadata()))


def test_states_what_the_caller_specifies(library, sample):
    few = replace(sample.select(slice(0, 100)), origin=(4e6, -2.5, 0.0))
    text = b'{"title":"a"}'
    fields = {"axes": b"RDF", "unit_metres": 0.5, "flat": 1, "antialiased": 1, "colour_space": 1}
    content, _ = encode(library, few, metadata=text, metadata_size=len(text), **fields)
    model = csplat.decode(content)
    metadata = model.metadata
    assert few.origin == model.origin
    assert ("RDF", 0.5, "a") == (metadata.coordinate_system, metadata.unit_metres, metadata.entries["title"])
    assert metadata.flat
    assert metadata.antialiased
    assert "lin_rec709_display" == metadata.colour_space
    assert csplat.decode(encode(library, few)[0]).metadata == SceneMetadata()


def test_refuses_invalid_scenes_in_one_line(library, sample):
    few = sample.select(slice(0, 10))
    broken = vars(few) | {"means": np.full((10, 3), np.nan, np.float32)}
    cases = [
        (type("Broken", (), broken | {"sh_degree": 3, "__len__": lambda _: 10})(), {}, "means contains NaN"),
        (few, {"axes": b"RRU"}, "axes are not three directions"),
        (few, {"axes": b"RD"}, "axes are not three directions"),
        (few, {"unit_metres": -1.0}, "unit_metres is negative"),
        (few, {"colour_space": 2}, "colour_space is 2"),
    ]
    for model, fields, message in cases:
        with pytest.raises(csplat.InputError, match=f"^E_INPUT: {message}[^\n]*$"):
            encode(library, model, **fields)


def test_uses_the_functions_of_the_caller_and_survives_their_failures(library, sample):
    few = sample.select(slice(0, 400))
    libc, held, calls, calls_max, fractions = ctypes.CDLL(None), set(), 0, 1 << 30, []
    libc.malloc.restype, libc.malloc.argtypes = ctypes.c_void_p, [ctypes.c_size_t]
    libc.free.argtypes = [ctypes.c_void_p]

    def allocate(_user, size):
        nonlocal calls
        calls += 1
        if calls > calls_max:
            return None
        held.add(memory := libc.malloc(size))
        return memory

    def release(_user, memory):
        memory = ctypes.cast(memory, ctypes.c_void_p).value
        held.discard(memory)
        libc.free(memory)

    def deflate(_user, data, size, out, room):
        coder = zlib.compressobj(1, zlib.DEFLATED, -15)
        coded = coder.compress(ctypes.string_at(data, size)) + coder.flush()
        if len(coded) > room:
            return 0
        ctypes.memmove(out, coded, len(coded))
        return len(coded)

    def progress(_user, done):
        fractions.append(done)
        return done < limit

    limit = 2.0
    options = Options(None, Progress(progress), Allocate(allocate), Release(release), Deflate(deflate))
    content, _ = encode(library, few, options)
    assert content != encode(library, few)[0]
    expected, actual = decode_integers(encode(library, few)[0]), decode_integers(content)
    assert all(np.array_equal(expected[name], actual[name]) for name in expected)
    assert sorted(fractions) == fractions
    assert 0.0 == fractions[0] < fractions[-1] <= 1.0
    assert not held
    total, calls = calls, 0
    for allowed in range(0, total, 7):
        calls, calls_max = 0, allowed
        with pytest.raises(csplat.InputError, match=r"^E_LIMIT: no memory[^\n]*$"):
            encode(library, few, options)
        assert not held
    calls_max, limit = 1 << 30, 0.5
    with pytest.raises(csplat.InputError, match=r"^E_INPUT: the caller stopped"):
        encode(library, few, options)
    assert not held


def test_passes_the_encoder_suite(tool):
    command = f"{shlex.quote(str(tool))} {{ply}} {{out}} {{index}}"
    report = run_encoder(command, EncoderSuiteOptions(levels=("L1", "L2", "L3"), jobs=2))
    assert [] == report.failures
    declined = [outcome.name for outcome in report.outcomes if outcome.status == "declined"]
    assert ["nasty/degree_5"] == declined
    assert len(report.outcomes) > 150


def test_reads_what_comments_of_csplat_specify(tool, tmp_path, sample):
    few = replace(sample.select(slice(0, 50)), origin=(1e6, 2.0, 3.0))
    metadata = SceneMetadata(coordinate_system="RUB", unit_metres=2.0, antialiased=True)
    csplat.write_ply(tmp_path / "scene.ply", few.with_metadata(metadata))
    assert (0, "", "") == run(tool, "scene.ply", "scene.csplat", folder=tmp_path)
    model = csplat.decode((tmp_path / "scene.csplat").read_bytes())
    assert few.origin == model.origin
    assert ("RUB", 2.0) == (model.metadata.coordinate_system, model.metadata.unit_metres)
    assert model.metadata.antialiased


class Ply(ctypes.Structure):
    _fields_: ClassVar = [("splats", Splats), ("row_count", ctypes.c_uint64), ("memory", ctypes.c_void_p)]


class RefusedError(Exception):
    """A PLY that the reader in C refuses."""


def read_in_c(library, data):
    """Return the arrays of a PLY by name, and its origin."""
    ply, error, release = Ply(), Error(), ctypes.CDLL(None).free
    release.argtypes = [ctypes.c_void_p]
    if library.csplat_read_ply(data, ctypes.c_size_t(len(data)), None, ctypes.byref(ply), ctypes.byref(error)):
        assert error.message.startswith(b"E_INPUT: ")
        raise RefusedError(error.message.decode())
    splats = ply.splats
    widths = {"means": 3, "quats": 4, "scales": 3, "opacities": 1, "sh0": 3}
    arrays = {
        name: np.array(ctypes.cast(getattr(splats, name), ctypes.POINTER(ctypes.c_float))[: width * splats.count])
        for name, width in widths.items()
    }
    arrays["positions"] = (
        ctypes.cast(splats.positions, ctypes.POINTER(ctypes.c_double))[: 3 * splats.count] if splats.positions else None
    )
    origin = tuple(splats.origin)
    release(ply.memory)
    return arrays, origin


def test_reads_the_texts_that_python_reads_and_names_the_same_lines(library):
    def check(case):
        data, place = case
        if place is None:
            model, (arrays, origin) = read_ply(data), read_in_c(library, data)
            assert model.origin == origin
            for name in ("means", "quats", "scales", "opacities", "sh0"):
                assert np.array_equal(getattr(model, name).ravel(), arrays[name].astype(np.float32)), name
            return
        with pytest.raises(InputError, match=place):
            read_ply(data)
        with pytest.raises(RefusedError, match=place):
            read_in_c(library, data)

    def ply(word, extra):
        return texts.text_ply(f"{texts.ROW} {word}\n{texts.ROW} 1\n", extra=f"property {extra} more\n")

    place = f"line {texts.HEADER_LINES + 2}: row 0"
    origins = {"-2.5e-1": None, **dict.fromkeys(("1_0", "1d5", "0x1", "inf"), "origin")}
    cases = {name: (texts.text_ply(body), wrong or None) for name, (body, wrong) in texts.LAYOUTS.items()}
    cases |= {f"number {word}": (ply(word, "float"), None) for word in texts.NUMBERS}
    cases |= {f"no number {word!r}": (ply(word, "float"), place) for word in texts.NO_NUMBERS}
    cases |= {f"integer {word}": (ply(word, "uchar"), None) for word in texts.INTEGERS}
    cases |= {f"no integer {word}": (ply(word, "uchar"), place) for word in texts.NO_INTEGERS}
    rows = "".join(f"{texts.ROW.replace('0.25', word)}\n" for word in texts.hard_numbers(400))
    cases["numbers that are hard to round"] = (texts.text_ply(rows, 400), None)
    for word, refused in origins.items():
        comment = f"comment csplat origin {word} 2 3\n"
        cases[f"origin {word}"] = (texts.text_ply(f"{texts.ROW}\n", 1, comment=comment), refused)
    assert [] == failures(cases, check)


def test_rounds_doubles_of_texts_once(library):
    words = texts.hard_numbers(3000, seed=1)
    rows = "".join(f"{word} 2 3 {texts.ROW.split(' ', 3)[3]}\n" for word in words if abs(float(word)) < 1e30)
    data = texts.text_ply(rows, rows.count("\n"), comment="comment csplat origin 0 0 0\n")
    arrays, _ = read_in_c(library, data.replace(b"float x", b"double x"))
    expected = [float(row.split()[0]) for row in rows.splitlines()]
    assert expected == arrays["positions"][::3]


def test_a_locale_with_decimal_commas_changes_nothing(tmp_path, library):
    localedef = shutil.which("localedef")
    made = localedef and subprocess.run(
        [localedef, "-i", "de_DE", "-f", "UTF-8", tmp_path / "de_DE.UTF-8"], capture_output=True, check=False
    )
    if not made or made.returncode:
        pytest.skip("localedef cannot make a locale with decimal commas")
    (tmp_path / "text.ply").write_bytes(texts.text_ply(f"{texts.ROW}\n", 1, comment="comment csplat origin 0.5 2 3\n"))
    program = (
        "import ctypes, locale, sys; locale.setlocale(locale.LC_ALL, '')\n"
        "assert locale.localeconv()['decimal_point'] == ','\n"
        "data = open(sys.argv[2], 'rb').read(); memory = ctypes.create_string_buffer(4096)\n"
        "print(ctypes.CDLL(sys.argv[1]).csplat_read_ply(data, ctypes.c_size_t(len(data)), None, memory, None))"
    )
    words = [sys.executable, "-c", program, library._name, str(tmp_path / "text.ply")]
    locale = {"LOCPATH": str(tmp_path), "LC_ALL": "de_DE.UTF-8"}
    assert b"0\n" == subprocess.run(words, env=os.environ | locale, capture_output=True, check=True).stdout


def test_refuses_files_in_one_line_and_writes_nothing(tool, tmp_path):
    names = "x y z rot_0 rot_1 rot_2 rot_3 scale_0 scale_1 scale_2 opacity f_dc_0 f_dc_1 f_dc_2"
    lines = "".join(f"property float {name}\n" for name in names.split())

    def ply(lines, rows):
        return f"ply\nformat binary_little_endian 1.0\nelement vertex 1\n{lines}end_header\n".encode() + rows

    cases = {
        b"": "the PLY header has no line end_header",
        b"ply \n\n": "the PLY header has no line end_header",
        b"plywood\n": "the file is no PLY",
        ply(lines, bytes(55)): "the file is cut off",
        ply(lines + "property float filter_3D\n", bytes(60)): "filter_3D",
        ply(lines.replace("float x", "int x"), bytes(56)): "column x has no type of floats",
        ply(lines.replace("float rot_2", "float rot_4"), bytes(56)): "no column rot_2",
        ply(lines + "property float x\n", bytes(60)): "column x occurs twice",
        ply("comment csplat origin 1 2\n" + lines, bytes(56)): "the header comment 'csplat origin'",
        ply(lines, b"\xff" * 56): "all 1 rows contain NaN",
    }
    (tmp_path / "out.csplat").write_bytes(b"before")
    for content, message in cases.items():
        (tmp_path / "in.ply").write_bytes(content)
        status, output, errors = run(tool, "in.ply", "out.csplat", folder=tmp_path)
        assert (1, "", 1) == (status, output, errors.count("\n"))
        assert errors.startswith("E_INPUT: ")
        assert message in errors
    assert {"in.ply", "out.csplat"} == {path.name for path in tmp_path.iterdir()}
    assert b"before" == (tmp_path / "out.csplat").read_bytes()
    expected = (1, "", "absent.ply: No such file or directory\n")
    assert expected == run(tool, "absent.ply", "out.csplat", folder=tmp_path)

# SPDX-License-Identifier: Apache-2.0
"""The Python interface: names, imports, errors, `SplatModel`, forms of files, and the commands that call it.

Also: csplat.model, csplat.types, csplat_tools.optional_packages.
"""

import doctest
import gzip
import io
import os
import re
import subprocess
import sys
from dataclasses import replace
from importlib.metadata import EntryPoints

import numpy as np
import pytest
from stores import assert_same
from typer.testing import CliRunner

import csplat
import csplat_render
import csplat_tools
import csplat_tools.encode_file
import csplat_trainer
from csplat.errors import CsplatError, InputError
from csplat.model import SplatModel, normalise_quats
from csplat.plugins import load_plugins
from csplat.ply import read_ply
from csplat_render.kernels import SET_VARIABLE
from csplat_tools.cli.app import app
from csplat_tools.scene_files import load_scene


@pytest.fixture
def files(make_model, tmp_path):
    """A ball as a model, a PLY and a .csplat file."""
    model = make_model(60, 1, scales=np.full((60, 3), -1.5, np.float32))
    model = replace(model, means=model.means / np.linalg.norm(model.means, axis=1, keepdims=True))
    csplat.write_ply(tmp_path / "scene.ply", model)
    (tmp_path / "scene.csplat").write_bytes(csplat.encode(model))
    return model, tmp_path / "scene.ply", tmp_path / "scene.csplat"


FORMS = {
    "str": str,
    "path": lambda path: path,
    "bytes": lambda path: path.read_bytes(),
    "bytearray": lambda path: bytearray(path.read_bytes()),
    "memoryview": lambda path: memoryview(path.read_bytes()),
    "BytesIO": lambda path: io.BytesIO(path.read_bytes()),
    "gzip": lambda path: gzip.GzipFile(fileobj=io.BytesIO(gzip.compress(path.read_bytes()))),
}


ARRAYS = ("means", "quats", "scales", "opacities", "sh0", "shN")


def test_every_listed_name_exists():
    for package in (csplat, csplat_render, csplat_tools, csplat_trainer):
        assert set(package.__all__) <= set(dir(package))
        assert all(getattr(package, name) is not None for name in package.__all__)
    assert sorted(csplat.__all__) == dir(csplat)
    with pytest.raises(AttributeError, match="no attribute 'nonsense'"):
        csplat.nonsense  # noqa: B018 -- the access is the test


@pytest.mark.slow
@pytest.mark.parametrize("package", [csplat, csplat_render, csplat_tools])
def test_examples_of_the_documentation_run(package, tmp_path, sample_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    model = csplat.read(sample_path).select(slice(0, 1000))
    csplat.write_ply("scene.ply", model)
    (tmp_path / "scene.csplat").write_bytes(csplat.encode(model, csplat.EncodeOptions(preset="fast")))
    shown = {id(one): one for one in (package, *(getattr(package, name) for name in package.__all__))}
    examples = 0
    for one in shown.values():
        for test in doctest.DocTestFinder(recurse=False).find(one, getattr(one, "__name__", "?"), globs={}):
            assert 0 == doctest.DocTestRunner().run(test).failed, test.name
            examples += len(test.examples)
    assert examples >= 3


@pytest.mark.slow
@pytest.mark.parametrize("form", FORMS.values(), ids=FORMS)
def test_files_may_be_paths_streams_or_bytes(files, form):
    model, ply, coded = files
    assert_same(csplat.read(ply), csplat.read(form(ply)))
    assert_same(csplat.decode(coded.read_bytes()), csplat.decode(form(coded)))
    assert len(model) == csplat.read_header(form(coded)).splat_count
    assert csplat.lint_ply(ply) == csplat.lint_ply(form(ply))
    for path in (ply, coded):
        loaded = load_scene(form(path))
        assert (len(model), path.stat().st_size) == (loaded.count, loaded.size_bytes)


def test_open_files_are_written_read_from_their_position_and_named(files, tmp_path):
    model, ply, _ = files
    stream = io.BytesIO(b"before")
    stream.seek(6)
    csplat.write_ply(stream, model)
    assert b"before" + ply.read_bytes() == stream.getvalue()
    stream.seek(6)
    assert_same(csplat.read(ply), csplat.read(stream))
    (tmp_path / "wrong.ply").write_bytes(b"nothing of the kind")
    with (tmp_path / "wrong.ply").open("rb") as stream, pytest.raises(InputError, match=r"wrong\.ply is not a PLY"):
        csplat.read(stream)


def test_objects_and_files_of_another_kind_are_refused_with_a_remedy(files, tmp_path):
    model, ply, coded = files
    out = tmp_path / "out.ply"
    for wrong in ("scene.ply", b"ply", None, 5):
        for call in (csplat.encode, csplat.encode_with_report, lambda wrong: csplat.write_ply(out, wrong)):
            with pytest.raises(InputError, match=r"expects a SplatModel.*csplat\.read"):
                call(wrong)
    assert not out.exists()
    with pytest.raises(InputError, match=r"EncodeOptions\(preset="):
        csplat.encode(model, "small")
    for call, wrong in ((read_ply, coded), (csplat.decode, ply)):
        for form in FORMS.values():
            with pytest.raises(CsplatError):
                call(form(wrong))
    with pytest.raises(csplat.FormatError, match=r"a PLY, which csplat\.read reads"):
        csplat.decode(ply)


@pytest.mark.slow
def test_the_program_starts_without_extras_and_without_the_renderer(files):
    code = f"""
import sys
from csplat_tools.cli.app import app
app(["--help"], standalone_mode=False)  # which imports every command
assert "csplat_tools.cli.render" in sys.modules
loaded = {{"PIL", "matplotlib", "torch"}} & set(sys.modules)
assert not loaded, loaded
import csplat, csplat_render, csplat_tools, csplat_trainer
from csplat_render.virtual_cameras import virtual_cameras
assert "torch" not in sys.modules
path = {str(files[1])!r}
model = csplat.read(path)
csplat.encode(model, target=csplat.Target(max_error={{"means": 0.01}}))
for call in (
    lambda: csplat.encode(model, target=csplat.Target(psnr=40.0)),
    lambda: csplat_tools.simplify(path, csplat.Target(keep=0.5)),
    lambda: csplat_tools.compare(path, path),
    lambda: csplat_tools.tradeoff(path),
    lambda: csplat_render.render(model, virtual_cameras(model, 1, 8, 8)[0]),
):
    try:
        raise SystemExit(f"no error but {{call()}}")
    except csplat.InputError as error:
        assert str(error).startswith("CSPLAT_INSTRUCTION_SET is 'absent'"), error
"""
    environment = {**os.environ, SET_VARIABLE: "absent"}
    subprocess.run([sys.executable, "-c", code], check=True, stdout=subprocess.DEVNULL, env=environment)


def test_a_target_of_largest_errors_needs_no_search(files, tmp_path):
    stages, target = [], csplat.Target(max_error={"means": 0.01})
    found = csplat.encode_with_report(files[0], target=target)
    context = csplat.Context(progress=lambda *stage: stages.append(stage))
    assert found.data == csplat.encode(files[0], target=target, context=context)
    assert found.report.search.reached["means"] <= 0.01
    assert (len(found.data), None) == (found.size_bytes, found.psnr)
    found.save(tmp_path / "found.csplat")
    assert found.data == (tmp_path / "found.csplat").read_bytes()
    assert stages
    assert all(isinstance(stage, str) and 0.0 <= done <= 1.0 for stage, done in stages)


def test_a_search_and_a_builder_of_levels_are_called_by_their_entry_points(files, tmp_path, monkeypatch):
    from csplat_tools.optimise.target_encoding import meet_target

    assert {"target": meet_target} == load_plugins("csplat.search")

    def search(*given, **named):
        raise Called(given, named)

    place = "csplat.encode_api.load_plugins"
    monkeypatch.setattr(place, lambda group: {"csplat.search": {"target": search}}[group])
    target, weights = csplat.Target(psnr=40.0), np.ones(60)
    with pytest.raises(Called) as raised:
        csplat.encode_with_report(files[0], target=target, views="views", importance=weights)
    (model, options), named = raised.value.args
    assert (files[0], csplat.EncodeOptions()) == (model, options)
    wanted = {"target": target, "views": "views", "importance": weights, "levels": None, "context": csplat.Context()}
    assert wanted == named
    monkeypatch.setattr(place, lambda _: {})
    with pytest.raises(InputError, match=r"no search for targets is installed.*installed as a whole"):
        csplat.encode(files[0], target=target)
    with pytest.raises(InputError, match="no builder of levels of detail is installed"):
        csplat.encode(files[0], levels="auto")
    monkeypatch.setattr(place, lambda _: {"builder": lambda *given: given == (60, csplat.EncodeOptions(), 2) or None})
    with pytest.raises(AttributeError, match="encode_plan"):  # what was built is called
        csplat.encode(files[0], levels=2)
    monkeypatch.setattr(place, lambda _: {"builder": lambda *_: None})  # too few splats for levels
    csplat.encode(files[0], out=tmp_path / "out.csplat", levels="auto")
    assert csplat.encode(files[0]) == (tmp_path / "out.csplat").read_bytes()


@pytest.mark.parametrize(("named", "message"), [
    ({"target": 40.0}, r"target is 40.0, expected csplat\.Target\(psnr=\.\.\.\)"),
    ({"views": "views"}, "views are given without a target"),
    ({"target": csplat.Target(psnr=40.0), "options": "small"}, r"EncodeOptions\(preset="),
])  # fmt: skip
def test_arguments_that_contradict_a_target_are_refused(files, named, message):
    with pytest.raises(InputError, match=message):
        csplat.encode_with_report(files[0], **named)


class Called(Exception):  # noqa: N818  # not an error
    """Ends a command when it calls the interface; carries the arguments."""


def arguments_of(monkeypatch, module, name, words):
    """Run a command until it calls a public function; return the arguments."""

    def called(*args, **named):
        raise Called(args, named)

    monkeypatch.setattr(module, name, called)
    raised = CliRunner().invoke(app, [*words, "--quiet"]).exception
    assert isinstance(raised, Called), raised
    return raised.args


@pytest.mark.slow
@pytest.mark.usefixtures("small_views")
@pytest.mark.parametrize(("words", "given"), [
    ("simplify scene.ply o --keep 0.5", {}),
    ("compare scene.ply scene.csplat --backend fast", {"mode": "fast", "backend": "cpu"}),
    ("tradeoff scene.ply --what presets", {"say": None}),
    ("encode scene.ply o --max-error means=0.01", {"max_error": {"means": 0.01}}),
    ("encode scene.ply o --target-psnr 40", {"psnr": 40.0}),
    ("encode scene.ply o --keep 0.5 --effort 1", {"keep": 0.5, "effort": 1}),
    ("encode scene.ply o --target-size 5kB --no-prune", {"size": 5000, "prune": False}),
])  # fmt: skip
def test_commands_call_the_public_functions(files, monkeypatch, words, given):
    monkeypatch.chdir(files[1].parent)
    words = words.split()
    encodes = words[0] == "encode"
    place = (csplat_tools.encode_file, "encode_with_report") if encodes else (csplat_tools, words[0])
    (scene, *_), named = arguments_of(monkeypatch, *place, words)
    model = scene.model() if isinstance(scene, csplat.Scene) else getattr(scene, "source", scene)
    assert_same(csplat.read(files[1]), model)
    if encodes:
        assert csplat.Target(**given) == named["target"]
        assert ("max_error" in given) == (named["views"] is None)
    else:
        assert given.items() <= named.items()


def test_the_size_of_a_model_is_that_of_a_plain_ply(files):
    model, ply, coded = files
    size = ply.stat().st_size - len(ply.read_bytes().partition(b"end_header\n")[0]) - len(b"end_header\n")
    assert size == load_scene(model).size_bytes
    loaded = load_scene(coded)
    assert loaded is load_scene(loaded)
    assert loaded.header == csplat.read_header(coded)


@pytest.mark.slow
@pytest.mark.parametrize(("statement", "unwanted"), [
    ("import csplat", r"csplat\..*"),
    ("import csplat, csplat_tools, csplat_trainer", "numpy|typer|rich|torch|csplat_render"),
    ("import sys; sys.modules['plyfile'] = None; import csplat.decoder; csplat.decode; del sys.modules['plyfile']",
        r"(plyfile|torch|deflate|typer|rich|csplat_tools|csplat\.(encoder|ply|lint|detect|disk_files)).*"),
    ("from csplat.ply import read_ply", r"csplat\.(encoder|decoder).*"),
    ("import csplat_render.rasteriser, csplat_render.reference_rasteriser",
        r"(torch|csplat_trainer|csplat_tools|plyfile)(\..*)?"),
    ("from csplat_tools.cli.app import app; app(['encode', 'scene.ply', 'o.csplat'], standalone_mode=False)",
        r"rich|csplat_tools\.cli\.(info|train)"),
    ("from csplat_tools.cli.app import app; app(['info', 'scene.csplat'], standalone_mode=False)",
        r"rich|PIL|multiprocessing|csplat\.(encode_api|out_of_core|encoder\.(?!encode_options|target).*)"),
    ("import csplat.model", r"importlib\.metadata|csplat\.encoder"),
], ids=["csplat", "packages", "decoder", "reader", "renderer", "program", "description", "model"])  # fmt: skip
def test_an_import_loads_no_other_part(files, statement, unwanted):
    words = [sys.executable, "-c", f"{statement}\nimport sys\nprint(*sorted(sys.modules))"]
    done = subprocess.run(words, cwd=files[1].parent, capture_output=True, text=True, check=True)
    assert [] == [name for name in done.stdout.split() if re.fullmatch(unwanted, name)]


def test_arrays_are_not_copied_and_optional_fields_may_be_left_out(make_model):
    arrays = {name: getattr(make_model(4, 0), name) for name in ARRAYS[:5]}
    bare = SplatModel(**arrays)
    assert all(getattr(bare, name) is array for name, array in arrays.items())
    assert (4, 0, (4, 0, 3), "unspecified") == (
        len(bare), bare.sh_degree, bare.shN.shape, bare.metadata.coordinate_system,
    )  # fmt: skip
    assert [0, 1, 2, 3] == [make_model(5, degree).sh_degree for degree in range(4)]


@pytest.mark.slow
def test_train_and_finetune_call_the_public_functions(tmp_path, monkeypatch):
    from captures import photograph, shell

    monkeypatch.chdir(photograph(shell(3), tmp_path))
    for words, kind in (
        ("train . a.ply --iterations 5", "DataSet"),
        ("finetune scene.ply a.csplat --data .", "SplatModel"),
    ):
        (given, *_), _ = arguments_of(monkeypatch, csplat_trainer, words.split()[0], words.split())
        assert kind == type(given).__name__


def test_values_at_their_limits_are_accepted(make_model):
    means = np.full((10, 3), 3e38, np.float32)  # their sum overflows
    assert np.array_equal(means, make_model(means=means).means)
    assert 2 == len(make_model(2, opacities=np.array([0, 1], np.float32)))
    assert (1e7, 2.0, 3.0) == make_model(origin=np.array([1e7, 2, 3])).origin
    for letters in ("RDF", "RUB", "LUF", "FRU", "BLD"):
        assert letters == make_model(coordinate_system=letters).metadata.coordinate_system


@pytest.mark.parametrize("index", [slice(2, 5), np.array([4, 1, 1]), np.arange(10) % 3 == 0, slice(0, 0)])
def test_select_keeps_rows_of_every_array(make_model, index):
    model = make_model(10, extra={"id": np.arange(10)}, origin=(1.0, 2.0, 3.0), coordinate_system="RDF")
    part = model.select(index)
    for name in ARRAYS:
        assert np.array_equal(getattr(model, name)[index], getattr(part, name))
    assert np.array_equal(model.extra["id"][index], part.extra["id"])
    assert (model.origin, model.metadata.coordinate_system) == (part.origin, part.metadata.coordinate_system)


def test_normalised_quats_have_unit_length_and_stay_unchanged():
    rng = np.random.default_rng(1)
    quats = (rng.standard_normal((10_000, 4)) * rng.choice([1e-30, 1, 1e30], (10_000, 1))).astype(np.float32)
    once = normalise_quats(quats)
    length = np.sqrt(np.sum(once.astype(np.float64) ** 2, 1))
    assert np.abs(length - 1).max() < 2**-23
    assert np.array_equal(normalise_quats(once), once)
    extremes = np.array([[0, 0, 0, 0], [3e38, 0, 3e38, 0], [0, 1e-45, 0, 0], [0, 0, 0, -2]], np.float32)
    half = np.float32(np.sqrt(0.5))
    expected = [[1, 0, 0, 0], [half, 0, half, 0], [0, 1, 0, 0], [0, 0, 0, -1]]
    assert np.array_equal(normalise_quats(extremes), np.array(expected, np.float32))


def test_functions_of_the_other_packages_are_offered_by_entry_points(monkeypatch):
    for name, package in (
        ("compare", csplat_tools), ("finetune", csplat_trainer), ("render", csplat_render), ("simplify", csplat_tools),
        ("train", csplat_trainer),
    ):  # fmt: skip
        assert getattr(package, name) is getattr(csplat, name)
        monkeypatch.delitem(vars(csplat), name)
    monkeypatch.setattr("csplat.plugins._entry_points", lambda _: EntryPoints())
    with pytest.raises(InputError, match=r"csplat\.compare is not installed"):
        csplat.compare  # noqa: B018 -- the access is the test

"""The Python interface: names, forms of files, refusals, and the commands that call it."""

import doctest
import gzip
import io
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
from typer.testing import CliRunner

import csplat
import csplat_render
import csplat_tools
import csplat_trainer
from csplat.errors import CsplatError, InputError
from csplat_tools.cli.app import app


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


def assert_same(a, b):
    for name in ("means", "quats", "scales", "opacities", "sh0", "shN"):
        assert np.array_equal(getattr(a, name), getattr(b, name)), name


# Names.
@pytest.mark.parametrize("package", [csplat, csplat_render, csplat_tools, csplat_trainer])
def test_every_listed_name_exists(package):
    assert set(package.__all__) <= set(dir(package))
    for name in package.__all__:
        assert getattr(package, name) is not None


def test_importing_the_packages_loads_no_renderer_or_command_line():
    code = "import csplat, csplat_tools, csplat_trainer, sys; print(*sys.modules)"
    loaded = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.split()
    assert not {"numba", "numpy", "typer", "rich", "torch", "csplat_render"} & set(loaded)


# Examples of the documentation.
@pytest.fixture(scope="module")
def documented(tmp_path_factory, sample_path):
    """A folder with the files of the examples."""
    folder = tmp_path_factory.mktemp("documented")
    model = csplat.read_ply(sample_path).select(slice(0, 1000))
    csplat.write_ply(folder / "scene.ply", model)
    (folder / "scene.csplat").write_bytes(csplat.encode(model, csplat.EncodeOptions(preset="fast")))
    return folder


@pytest.mark.slow
@pytest.mark.parametrize("package", [csplat, csplat_render, csplat_tools])
def test_examples_of_the_documentation_run(package, documented, monkeypatch):
    monkeypatch.chdir(documented)
    shown = {id(one): one for one in (package, *(getattr(package, name) for name in package.__all__))}
    examples = 0
    for one in shown.values():
        for test in doctest.DocTestFinder(recurse=False).find(one, getattr(one, "__name__", "?"), globs={}):
            assert 0 == doctest.DocTestRunner().run(test).failed, test.name
            examples += len(test.examples)
    assert examples >= 3


# Forms of files.
@pytest.mark.parametrize("form", FORMS.values(), ids=FORMS)
def test_files_may_be_paths_streams_or_bytes(files, form):
    model, ply, coded = files
    assert_same(csplat.read_ply(ply), csplat.read_ply(form(ply)))
    assert_same(csplat.decode(coded.read_bytes()), csplat.decode(form(coded)))
    assert len(model) == csplat.read_header(form(coded)).splat_count
    assert csplat.lint_ply(ply) == csplat.lint_ply(form(ply))
    for path in (ply, coded):
        loaded = csplat_tools.load_model(form(path))
        assert (len(model), path.stat().st_size) == (len(loaded.model), loaded.size_bytes)


def test_a_ply_is_written_to_an_open_file(files):
    model, ply, _ = files
    stream = io.BytesIO()
    csplat.write_ply(stream, model)
    assert ply.read_bytes() == stream.getvalue()


def test_open_files_are_read_from_their_position(files):
    _, ply, _ = files
    stream = io.BytesIO(b"before" + ply.read_bytes())
    stream.seek(6)
    assert_same(csplat.read_ply(ply), csplat.read_ply(stream))


def test_messages_name_an_open_file(tmp_path):
    (tmp_path / "wrong.ply").write_bytes(b"nothing of the kind")
    with (tmp_path / "wrong.ply").open("rb") as stream, pytest.raises(InputError, match=r"wrong\.ply is not a PLY"):
        csplat.read_ply(stream)


# Refusals.
@pytest.mark.parametrize("wrong", [5, None, 1.5, ["scene.ply"], io.StringIO("ply\n")])
@pytest.mark.parametrize("function", ["read_ply", "decode", "read_header", "lint_ply"])
def test_other_objects_than_files_are_typed_errors(function, wrong):
    with pytest.raises(InputError, match="expected"):
        getattr(csplat, function)(wrong)


@pytest.mark.parametrize("function", ["read_ply", "decode", "read_header"])
def test_an_absent_file_is_named(function, tmp_path):
    with pytest.raises(FileNotFoundError, match="absent"):
        getattr(csplat, function)(tmp_path / "absent")


@pytest.mark.parametrize("wrong", ["scene.ply", b"ply", None, 5])
def test_other_objects_than_models_are_refused_with_a_remedy(wrong, tmp_path):
    calls = [csplat.encode, csplat.encode_with_report, lambda model: csplat.write_ply(tmp_path / "out.ply", model)]
    for call in calls:
        with pytest.raises(InputError, match=r"expects a SplatModel.*csplat\.read_ply"):
            call(wrong)
    assert not list(tmp_path.iterdir())


def test_a_preset_in_place_of_options_is_refused_with_a_remedy(files):
    with pytest.raises(InputError, match=r"EncodeOptions\(preset="):
        csplat.encode(files[0], "small")


def test_files_of_the_other_kind_are_typed_errors(files):
    _, ply, coded = files
    for call, wrong in ((csplat.read_ply, coded), (csplat.decode, ply)):
        for form in FORMS.values():
            with pytest.raises(CsplatError):
                call(form(wrong))


def test_decoding_a_ply_names_the_right_function(files):
    with pytest.raises(csplat.FormatError, match=r"a PLY, which csplat\.read_ply reads"):
        csplat.decode(files[1])


@pytest.mark.slow
def test_the_program_starts_without_extras_and_names_missing_ones(files):
    code = f"""
import sys
from csplat_tools.cli.app import app
app(["--help"], standalone_mode=False)  # which imports every command
assert "csplat_tools.cli.render" in sys.modules
loaded = {{"numba", "PIL", "scipy", "matplotlib", "torch"}} & set(sys.modules)
assert not loaded, loaded
sys.modules["numba"] = None
import csplat, csplat_render, csplat_tools, csplat_trainer
from csplat_render import Camera, render
from csplat_render.virtual_cameras import virtual_cameras
assert not {{"scipy", "torch"}} & set(sys.modules)
path = {str(files[1])!r}
model = csplat.read_ply(path)
csplat_tools.encode_to(path, errors={{"means": 0.01}})
for call in (
    lambda: csplat_tools.encode_to(path, psnr=40.0),
    lambda: csplat_tools.simplify(path, keep=0.5),
    lambda: csplat_tools.compare(path, path),
    lambda: csplat_tools.tradeoff(path),
    lambda: csplat_trainer.train(path),
    lambda: csplat_trainer.finetune(model, None),
    lambda: csplat_render.render(model, virtual_cameras(model, 1, 8, 8)[0]),
):
    try:
        call()
    except csplat.InputError as error:
        assert "this needs numba: pip install 'csplat[render]'" == str(error), error
    else:
        raise SystemExit("nothing was said")
"""
    subprocess.run([sys.executable, "-c", code], check=True, stdout=subprocess.DEVNULL)


# Targets.
def test_targets_of_a_model_and_a_file_give_the_same_bytes(files):
    _, ply, _ = files
    stages = []

    def progress(stage, done):
        stages.append((stage, done))

    first = csplat_tools.encode_to(csplat.read_ply(ply), errors={"means": 0.01}, progress=progress)
    assert first.data == csplat_tools.encode_to(ply.read_bytes(), errors={"means": 0.01}).data
    assert first.report.reached["means"] <= 0.01
    assert stages
    assert all(isinstance(stage, str) and 0.0 <= done <= 1.0 for stage, done in stages)


@pytest.mark.parametrize(("asked", "message"), [
    ({}, "no target"),
    ({"psnr": 40.0, "size": 1000}, "one of them"),
    ({"size": "5 parsecs"}, "expected bytes"),
    ({"errors": {"colour": 1.0}}, "not a measure"),
    ({"errors": {"means": "2mm"}}, "means is '2mm', expected a number"),
    ({"psnr": "40"}, "psnr is '40', expected a number"),
])  # fmt: skip
def test_an_invalid_target_is_refused_before_reading_the_scene(asked, message):
    with pytest.raises(InputError, match=message):
        csplat_tools.encode_to("absent.ply", **asked)


# Commands.
@pytest.fixture(scope="module")
def views_once():
    """Place virtual cameras once: all commands get the same scene."""
    pytest.importorskip("numba", reason="virtual cameras require the extra [render]")
    from csplat_tools.views import view_sets

    search, known = view_sets.virtual_cameras, {}

    def find(model, *args, **named):
        key = (*args, *sorted(named.items()))
        if key not in known:
            known[key] = search(model, *args, **named)
        return known[key]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(view_sets, "virtual_cameras", find)
        yield


class Called(Exception):  # noqa: N818  # not an error
    """Ends a command when it calls the interface; carries the arguments."""


@pytest.mark.parametrize(("words", "name", "given"), [
    (["encode", "scene.ply", "o", "--max-error", "means=0.01"], "encode_to", {"errors": {"means": 0.01}}),
    (["encode", "scene.ply", "o", "--target-psnr", "40"], "encode_to", {"psnr": 40.0, "no_prune": False}),
    (["encode", "scene.ply", "o", "--target-size", "5kB", "--no-prune"], "encode_to", {"size": 5000}),
    (["simplify", "scene.ply", "o", "--keep", "0.5"], "simplify", {"keep": 0.5, "psnr": None, "max_psnr_drop": None}),
    (["compare", "scene.ply", "scene.csplat", "--mode", "fast"], "compare", {"mode": "fast"}),
    (["tradeoff", "scene.ply", "--what", "presets"], "tradeoff", {"say": None}),
])  # fmt: skip
@pytest.mark.usefixtures("views_once")
def test_commands_call_the_public_functions(files, monkeypatch, words, name, given):
    monkeypatch.chdir(files[1].parent)
    monkeypatch.setattr("csplat_render.warmup.warm_up", lambda *_, **__: None)

    def called(*args, **named):
        raise Called(args, named)

    monkeypatch.setattr(csplat_tools, name, called)
    raised = CliRunner().invoke(app, [*words, "--quiet"]).exception
    assert isinstance(raised, Called), raised
    scene, named = raised.args[0][0], raised.args[1]
    assert_same(csplat.read_ply(files[1]), getattr(scene, "model", getattr(scene, "source", scene)))
    assert given.items() <= named.items()


def test_the_size_of_a_model_is_that_of_a_plain_ply(files):
    pytest.importorskip("numba", reason="comparing requires the extra [render]")
    model, ply, coded = files
    size = ply.stat().st_size - len(ply.read_bytes().partition(b"end_header\n")[0]) - len(b"end_header\n")
    assert size == csplat_tools.load_model(model).size_bytes
    loaded = csplat_tools.load_model(coded)
    assert loaded is csplat_tools.load_model(loaded)
    assert replace(loaded, size_bytes=1).header == csplat.read_header(coded)


@pytest.mark.parametrize(("words", "name", "kind"), [
    (["train", ".", "out.ply", "--iterations", "3"], "train", "DataSet"),
    (["finetune", "scene.ply", "out.csplat", "--data", "."], "finetune", "SplatModel"),
])  # fmt: skip
def test_train_and_finetune_call_the_public_functions(tmp_path, monkeypatch, words, name, kind):
    pytest.importorskip("numba", reason="these commands require the extra [render]")
    pytest.importorskip("scipy", reason="data sets require the extra [render]")
    from captures import photograph, shell

    monkeypatch.chdir(photograph(shell(3), tmp_path))
    monkeypatch.setattr("csplat_render.warmup.warm_up", lambda *_, **__: None)

    def called(*args, **named):
        raise Called(args, named)

    monkeypatch.setattr(csplat_trainer, name, called)
    raised = CliRunner().invoke(app, [*words, "--quiet"]).exception
    assert isinstance(raised, Called), raised
    assert kind == type(raised.args[0][0]).__name__

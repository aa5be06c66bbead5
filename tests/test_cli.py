"""The command line: output, statuses, messages; no partial files, no tracebacks."""

import errno
import gzip
import io
import json
import os
import pty
import resource
import select
import signal
import stat
import subprocess
import sys
import tempfile
import threading
from contextlib import contextmanager, suppress
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import typer
from command_line import heed_interrupts
from typer.main import get_command
from typer.testing import CliRunner

import csplat
from csplat import _spec, decode, read_ply, write_ply
from csplat.errors import InputError
from csplat_conformance.manifest import VECTORS
from csplat_tools.__main__ import main
from csplat_tools.cli.app import app
from csplat_tools.file_streams import check_output, write_bytes

PROGRAM = [sys.executable, "-m", "csplat_tools"]


@pytest.fixture
def ply(tmp_path, make_model):
    path = tmp_path / "scene.ply"
    write_ply(path, make_model(200, 2))
    return path


@pytest.fixture(scope="module")
def encoded_once():
    """Return the files that `encode` writes for `ply`, by name; the first test that needs them fills it."""
    return {}


@pytest.fixture
def csplat_file(tmp_path, ply, encoded_once):
    names = ("scene.csplat", "index.npy")
    if not encoded_once:
        call("encode", ply, tmp_path / names[0], "--source-index", tmp_path / names[1], "--quiet")
        encoded_once.update({name: (tmp_path / name).read_bytes() for name in names})
    for name, data in encoded_once.items():
        (tmp_path / name).write_bytes(data)
    return tmp_path / names[0]


@pytest.fixture(autouse=True)
def no_estimated_up(monkeypatch):
    """Estimate no up direction after encoding, which takes longer than encoding small scenes."""
    monkeypatch.setattr("csplat_tools.cli.encode.estimate_up", lambda _model, _every: None)


def invoke(*words, **options):
    return CliRunner().invoke(app, [str(word) for word in words], **options)


def call(*words, **options):
    """Run a command that succeeds; return what it printed as data."""
    result = invoke(*words, **options)
    assert result.exit_code == 0, result.stderr
    return result.stdout


def refused(*words, status=1):
    """Run a command that is refused with one line; return the line."""
    result = invoke(*words)
    assert result.exit_code == status, (result.stdout, result.stderr, result.exception)
    assert result.exception is None or isinstance(result.exception, SystemExit)
    assert result.stderr.count("\n") == 1
    assert result.stderr.startswith("error: ")
    return result.stderr


def program(*words, **options):
    return subprocess.run([*PROGRAM, *map(str, words)], capture_output=True, check=False, **options)


def status_of(*words):
    """Run the program in this process; return its exit status."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "argv", ["csplat", *map(str, words)])
        try:
            main()
        except SystemExit as ended:
            return ended.code or 0
    return 0


@contextmanager
def limited_files(size):
    """Let files have a limited size, as on a disk that is full."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


# Encode and decode --------------------------------------------------------------------------------


def test_reports_as_json(tmp_path, ply):
    out = tmp_path / "out.csplat"
    report = json.loads(call("encode", ply, out, "--json", "--preset", "fast"))
    size = out.stat().st_size
    assert (200, size, size / 200) == (report["splats"], report["size_bytes"], report["bytes_per_splat"])
    assert report["ratio"] == ply.stat().st_size / size
    assert {"means", "covariance", "opacities", "sh0", "sh1", "sh2"} == set(report["stated_errors"])
    assert report["options"]["asked"] == {"preset": "fast"}
    quiet = invoke("encode", ply, out, "--quiet", "--force")
    assert (quiet.stdout, quiet.stderr) == ("", "")


def commands():
    """Yield the names and commands of the program."""
    group = get_command(app)
    context = typer.Context(group, info_name="csplat")
    for name in group.list_commands(context):
        one = group.get_command(context, name)
        for inner, each in getattr(one, "commands", {"": one}).items():
            yield f"{name} {inner}".split(), each


COMMON = {"--force", "--report", "--json", "--quiet", "--help-all"}


def test_every_command_has_the_five_common_options_and_help_for_all(monkeypatch):
    monkeypatch.setenv("COLUMNS", "80")
    count = 0
    for name, command in commands():
        options = [one for one in command.params if one.param_type_name == "option"]
        spelt = [{*one.opts, *one.secondary_opts} for one in options]
        assert COMMON <= set().union(*spelt), name
        assert [] == [one.opts for one in options if not one.help], name
        count += sum(not one & COMMON for one in spelt)
        hidden = [one.opts[0] for one in options if one.hidden]
        if name == ["encode"]:
            shown, everything = call(*name, "--help"), call(*name, "--help-all")
            assert [] == [one for one in hidden if one not in everything]
            assert "--threads" in hidden
            assert "--threads" not in shown
    assert count <= 150


@pytest.mark.slow
def test_encoding_by_a_preset_does_not_import_the_renderer(ply, tmp_path):
    code = f"""
import sys
from csplat_tools.cli.app import app
app(["encode", {str(ply)!r}, {str(tmp_path / "out.csplat")!r}], standalone_mode=False)
assert not {{"numba", "scipy", "rich"}} & set(sys.modules)
assert not {{"csplat_tools.cli.info", "csplat_tools.cli.train"}} & set(sys.modules)
"""
    subprocess.run([sys.executable, "-c", code], check=True, capture_output=True)
    assert (tmp_path / "out.csplat").exists()


@pytest.mark.parametrize("name", ["info", "verify", "lint", "decode"])
def test_the_report_is_what_json_prints(tmp_path, csplat_file, ply, name):
    words = {"lint": (ply,), "decode": (csplat_file, tmp_path / "back.ply")}.get(name, (csplat_file,))
    printed = call(name, *words, "--json", "--report", tmp_path / "report.json")
    assert json.loads(printed) == json.loads((tmp_path / "report.json").read_text())
    assert "exists: --force replaces it" in refused(name, *words, "--report", tmp_path / "report.json")


@pytest.mark.parametrize(
    "words",
    [
        ("--preset", "slow"),
        ("--sh-degree", "5"),
        ("--up", "0,0,0"),
        ("--max-psnr-drop", "much"),
        ("--memory", "1GB", "--keep", "0.5"),
        ("--no-prune",),
        ("--no-such-option",),
        ("--json", "-"),
    ],
)
def test_wrong_options_are_usage_errors(tmp_path, ply, words):
    target = [] if "-" in words else [tmp_path / "out.csplat"]
    line = refused("encode", ply, *target, *words, status=2)
    assert line.startswith("error: csplat encode: ")
    assert line.endswith("; `csplat encode --help` lists the options (E_USAGE)\n")
    assert not (tmp_path / "out.csplat").exists()


def test_encode_takes_metadata_that_a_ply_lacks(tmp_path, ply):
    metadata = ("--up", "z", "--unit-metres", "0.5", "--antialiased", "--licence", "CC0")
    call("encode", ply, tmp_path / "out.csplat", *metadata)
    model = decode(tmp_path / "out.csplat")
    assert ([0, 0, 1], "CC0") == (model.metadata["up"], model.metadata["licence"])
    assert (0.5, True) == (model.unit_metres, model.antialiased)


def test_repairs_are_reported_even_if_quiet(tmp_path, make_model):
    source = tmp_path / "extra.ply"
    write_ply(source, make_model(20, 0, extra={"object_id": np.arange(20, dtype=np.int32)}))
    quiet = invoke("encode", source, tmp_path / "q.csplat", "--quiet")
    assert "extra-columns" in quiet.stderr
    assert 1 == len(quiet.stderr.splitlines())
    call("encode", source, tmp_path / "c.csplat", "--keep-extra")
    assert sorted(decode(tmp_path / "c.csplat").extra["object_id"]) == list(range(20))


def test_encode_reports_lengths_of_rotations_that_no_training_produces(tmp_path, ply):
    line = "1 rotation not of unit length"
    for length, reported in ((0.3, False), (5.0, False), (1e-6, True), (1e6, True)):
        data = bytearray(ply.read_bytes())
        data[-16:] = np.array([length, 0, 0, 0], "<f4").tobytes()  # the last rotation
        ply.write_bytes(data)
        encoded = invoke("encode", ply, tmp_path / "out.csplat", "--preset", "fast", "--force")
        assert (length, reported) == (length, line in encoded.stderr)
        assert line in call("lint", ply)


def test_a_command_replaces_none_of_its_own_files(tmp_path, ply, csplat_file):
    weights, out = tmp_path / "weights.npy", tmp_path / "out.csplat"
    np.save(weights, np.ones(5))
    before = [path.read_bytes() for path in (ply, csplat_file, weights)]
    for words in (("encode", ply, ply), ("decode", csplat_file, csplat_file), ("encode", ply, weights)):
        line = refused(*words, *(("--importance", weights) if weights in words else ()), "--force")
        assert "is the input" in line
    assert before == [path.read_bytes() for path in (ply, csplat_file, weights)]
    assert "two outputs" in refused("encode", ply, out, "--source-index", tmp_path / "." / "out.csplat")
    assert not out.exists()


def test_importance_is_taken_from_a_file(tmp_path, ply):
    weights = tmp_path / "weights.npy"
    np.save(weights, np.linspace(0, 1, 200))
    call("encode", ply, tmp_path / "out.csplat", "--importance", weights)
    for wrong, message in (
        (np.ones(3), "importance"), (np.array([{}], dtype=object), ""), (None, "weights.npy is not a NumPy array file"),
    ):  # fmt: skip
        weights.write_text("not an array") if wrong is None else np.save(weights, wrong, allow_pickle=True)
        assert message in refused("encode", ply, tmp_path / "no.csplat", "--importance", weights, "--quiet")


def test_decodes_fewer_bands(tmp_path, csplat_file):
    call("decode", csplat_file, tmp_path / "d1.ply", "--sh-degree", 1)
    call("decode", csplat_file, tmp_path / "d2.ply", "--sh-degree", 3)
    one, two = read_ply(tmp_path / "d1.ply"), read_ply(tmp_path / "d2.ply")
    assert (one.sh_degree, two.sh_degree) == (1, 2)
    np.testing.assert_array_equal(one.shN, two.shN[:, :3])


def test_decodes_absolute_positions(tmp_path, make_model):
    model = make_model(20, 0, origin=(1e7, -2e6, 3.0))
    write_ply(tmp_path / "geo.ply", model)
    call("encode", tmp_path / "geo.ply", tmp_path / "geo.csplat")
    call("decode", tmp_path / "geo.csplat", tmp_path / "abs.ply", "--absolute")
    absolute, relative = read_ply(tmp_path / "abs.ply"), decode(tmp_path / "geo.csplat")
    assert absolute.origin == relative.origin == model.origin
    np.testing.assert_array_equal(absolute.means, relative.means)
    assert b"property double x" in (tmp_path / "abs.ply").read_bytes()


def test_decode_and_verify_refuse_more_splats_than_allowed(tmp_path, csplat_file):
    assert "LIM-1" in invoke("verify", csplat_file, "--max-splats", 199).stdout
    call("verify", csplat_file, "--max-splats", 200)
    assert "E_LIMIT" in refused("decode", csplat_file, tmp_path / "out.ply", "--max-splats", 199)
    call("decode", csplat_file, tmp_path / "out.ply", "--max-splats", 200)


def test_an_empty_scene_round_trips(tmp_path, make_model):
    source, file = tmp_path / "empty.ply", tmp_path / "empty.csplat"
    write_ply(source, make_model(0, 1))
    assert json.loads(call("encode", source, file, "--json"))["bytes_per_splat"] is None
    for words in (("info", file), ("verify", file, "--source", source), ("decode", file, tmp_path / "back.ply")):
        call(*words)
    assert len(read_ply(tmp_path / "back.ply")) == 0


# Files: none partial, none replaced ----------------------------------------------------


@pytest.mark.parametrize("command", ["encode", "decode"])
def test_replaces_nothing_without_force(tmp_path, ply, csplat_file, command):
    source = ply if command == "encode" else csplat_file
    target = tmp_path / "there"
    target.write_text("precious")
    assert "--force" in refused(command, source, target)
    assert target.read_text() == "precious"
    call(command, source, target, "--force")
    assert target.read_bytes() != b"precious"


def test_files_have_the_usual_permissions(csplat_file):
    mask = os.umask(0o022)
    os.umask(mask)
    assert csplat_file.stat().st_mode & 0o777 == 0o666 & ~mask


@pytest.mark.parametrize(
    ("words", "part"),
    [
        (("encode", "absent.ply", "out.csplat"), "absent.ply: No such file"),
        (("decode", "absent.csplat", "out.ply"), "absent.csplat: No such file"),
        (("info", "absent.csplat"), "No such file"),
        (("verify", "absent.csplat"), "No such file"),
        (("lint", "absent.ply"), "No such file"),
        (("info", "."), "is a folder, not a scene"),
        (("encode", "scene.ply", "."), "is a folder"),
        (("encode", "scene.ply", "no/such/folder/out.csplat"), "No such file"),
    ],
)
def test_absent_files_are_refused_in_one_line(tmp_path, ply, monkeypatch, words, part):
    assert ply.name == "scene.ply"
    monkeypatch.chdir(tmp_path)
    assert part in refused(*words)


def test_the_second_of_two_writers_of_a_name_is_refused(tmp_path, monkeypatch):
    target, written, both = str(tmp_path / "new"), os.fsync, threading.Barrier(2, timeout=20)

    def meet(number):
        written(number)
        both.wait()  # both files are complete, and neither has its name

    monkeypatch.setattr(os, "fsync", meet)
    check_output(target, force=False)
    lost = []

    def write(data):
        try:
            write_bytes(target, data)
        except InputError as error:
            lost.append((data, str(error)))

    writers = [threading.Thread(target=write, args=(data,)) for data in (b"one", b"two")]
    for writer in writers:
        writer.start()
    for writer in writers:
        writer.join()
    assert 1 == len(lost)
    data, message = lost[0]
    assert "and it was not replaced; --force replaces it" in message
    assert {b"one": b"two", b"two": b"one"}[data] == (tmp_path / "new").read_bytes()
    assert ["new"] == [path.name for path in tmp_path.iterdir()]


@pytest.mark.parametrize("links", [True, False])
def test_a_name_that_was_taken_meanwhile_is_replaced_only_by_force(tmp_path, monkeypatch, links):
    if not links:  # a file system without hard links, such as FAT

        def refuse(*_):
            raise PermissionError(1, "Operation not permitted")

        monkeypatch.setattr(os, "link", refuse)
    target = tmp_path / "new"
    check_output(str(target), force=False)
    target.write_bytes(b"theirs")
    with pytest.raises(InputError, match="another program wrote it meanwhile"):
        write_bytes(str(target), b"ours")
    assert b"theirs" == target.read_bytes()
    check_output(str(target), force=True)
    write_bytes(str(target), b"ours")
    assert b"ours" == target.read_bytes()
    target.unlink()
    check_output(str(target), force=False)
    write_bytes(str(target), b"first")
    write_bytes(str(target), b"second")  # the name is ours now
    assert b"second" == target.read_bytes()
    assert ["new"] == [path.name for path in tmp_path.iterdir()]


def test_a_full_disk_leaves_the_old_file_and_the_error_names_it(tmp_path, ply, monkeypatch):
    folder = tmp_path / "out"
    folder.mkdir()
    old = folder / "old.csplat"
    old.write_text("precious")
    with limited_files(1000):
        line = refused("encode", ply, old, "--force")
    assert line.startswith(f"error: {old}: File too large; no partial file was left")
    assert line.endswith("(EFBIG)\n")

    def fail(_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", fail)
    assert "No space left" in refused("encode", ply, old, "--force", "--quiet")
    assert [old] == list(folder.iterdir())
    assert old.read_text() == "precious"


def test_a_full_standard_output_is_one_line(csplat_file, monkeypatch, capsys):
    line = "error: standard output: No space left on device; the output is incomplete (ENOSPC)\n"
    for words in (("info", csplat_file), ("--version",)):
        full = Path("/dev/full").open("w", encoding="utf-8")  # noqa: SIM115  # what closes it fails as well
        monkeypatch.setattr(sys, "stdout", full)
        status = status_of(*words)
        monkeypatch.undo()
        with suppress(OSError):
            full.close()
        assert (1, line) == (status, capsys.readouterr().err)
    assert refused("decode", csplat_file, "/dev/full").startswith("error: /dev/full: No space left")


# Wrong kinds of files -----------------------------------------------------------------------------


def test_files_of_the_other_kind_are_refused_with_the_command_for_them(tmp_path, ply, csplat_file):
    renamed = tmp_path / "renamed.ply"
    renamed.write_bytes(csplat_file.read_bytes())
    for path in (csplat_file, renamed):
        assert "csplat decode" in refused("encode", path, tmp_path / "out")
        assert "csplat decode" in refused("lint", path)
    for words in (("decode", ply, tmp_path / "out"), ("verify", ply)):
        assert "csplat encode" in refused(*words)


def test_the_default_output_is_next_to_its_source(tmp_path, ply):
    call("encode", ply)
    call("export-html", tmp_path / "scene.csplat")
    assert {"scene.ply", "scene.csplat", "scene.html"} <= {one.name for one in tmp_path.iterdir()}
    assert "scene.ply exists" in refused("decode", tmp_path / "scene.csplat")
    assert "expected an output" in refused("encode", "-", status=2)


def test_unreadable_formats_are_refused_with_a_converter(tmp_path):
    path = tmp_path / "a.lcc"
    path.write_bytes(bytes(60))
    for words in [("encode", path, tmp_path / "out.csplat"), ("lint", path), ("info", path)]:
        line = refused(*words)
        assert line.startswith("error: a.lcc is LCC, which csplat does not read: convert it to PLY first, with splat-t")
        assert line.endswith("(E_INPUT)\n")
    (tmp_path / "a.spz").write_bytes(gzip.compress(b"NGSP" + bytes(60)))
    for words in [("decode", tmp_path / "a.spz", tmp_path / "out.ply"), ("verify", tmp_path / "a.spz")]:
        assert "convert it with `csplat encode`" in refused(*words)


@pytest.mark.parametrize(
    ("words", "meant"),
    [
        (("encode", "scene.ply", "out.ply"), "csplat encode scene.ply out.csplat"),
        (("encode", "scene.csplat", "out.ply"), "csplat decode scene.csplat out.ply"),
        (("encode", "scene.ply", "page.html"), "csplat export-html scene.ply page.html"),
        (("encode", "scene.ply", "out.spz"), "csplat convert scene.ply out.spz"),
        (("decode", "scene.csplat", "out.csplat"), "csplat decode scene.csplat out.ply"),
        (("decode", "scene.ply", "out.csplat"), "csplat encode scene.ply out.csplat"),
        (("export-html", "scene.csplat", "out.ply"), "csplat decode scene.csplat out.ply"),
        (("render", "scene.ply", "out.ply", "--orbit", "2"), "csplat render scene.ply out.webp"),
        (("lint", "scene.ply", "--fix", "out.csplat"), "csplat encode scene.ply out.csplat"),
        (("info", "scene.csplat", "--page", "out.png"), "--page out.html"),
        (("tradeoff", "scene.ply", "-o", "out.png"), "-o out.html"),
        (("encode", "scene.ply", "out.csplat", "--report", "out.csv"), "--report out.json"),
    ],
)
def test_a_name_of_another_kind_is_refused_with_a_suggestion(tmp_path, ply, csplat_file, monkeypatch, words, meant):
    assert {ply.name, csplat_file.name} == {"scene.ply", "scene.csplat"}
    monkeypatch.chdir(tmp_path)
    assert f"did you mean `{meant}`? (E_INPUT)" in refused(*words)
    assert {"scene.ply", "scene.csplat", "index.npy"} == {path.name for path in tmp_path.iterdir()}


def test_a_url_instead_of_a_file_is_reported(tmp_path):
    for words in (["info"], ["lint"], ["encode"]):
        line = refused(words[0], "https://example.com/a/b.ply", *[tmp_path / "c.csplat"][: words == ["encode"]])
        assert line.startswith("error: https://example.com/a/b.ply is a URL, expected a file: download it first")


def test_errors_name_the_file_that_was_read(tmp_path, make_model, csplat_file):
    path = damaged_ply(tmp_path / "bad.ply", make_model)
    path.write_bytes(path.read_bytes().replace(b"property float opacity\n", b"property float opaqueness\n"))
    line = refused("encode", path, tmp_path / "out.csplat")
    assert line.startswith(f"error: {path}: missing-columns: no column opacity")
    (tmp_path / "cut.csplat").write_bytes(csplat_file.read_bytes()[:200])
    line = refused("compare", csplat_file, tmp_path / "cut.csplat")
    assert line.startswith(f"error: {tmp_path / 'cut.csplat'}: the file ends too early: E_TRUNCATED")
    (tmp_path / "none.csplat").write_bytes(b"nothing of ours" * 20)
    line = refused("decode", tmp_path / "none.csplat", tmp_path / "out.ply")
    assert line.startswith(f"error: {tmp_path / 'none.csplat'}: not a .csplat file: E_MAGIC at byte 0")
    assert "`csplat encode` makes one of a PLY" in line


# Info ---------------------------------------------------------------------------------------------


def test_info_accounts_for_every_byte_and_prints_text(tmp_path, csplat_file):
    described = json.loads(call("info", csplat_file, "--json"))
    attributes = sum(one["size_bytes"] for one in described["attributes"].values())
    assert attributes + sum(described["overhead"].values()) == csplat_file.stat().st_size == described["size_bytes"]
    assert list(described["attributes"]) == ["opacities", "scales", "quats", "means", "sh0", "sh1", "sh2"]
    assert list(described["layers"]) == ["geometry", "sh1", "sh2"]
    assert described["stated_errors"]["source_splats"] == 200
    assert described["options"]["asked"]["preset"] == "balanced"
    assert "splats       200, SH degree 2" in call("info", csplat_file)
    data = csplat_file.read_bytes()
    for wrong, code in ((data[:1], "wrong is"), (data[:-1], "E_TRUNCATED"), (data + b"x", "E_TRAILING")):
        (tmp_path / "wrong").write_bytes(wrong)
        assert code in refused("info", tmp_path / "wrong")


# Verify -------------------------------------------------------------------------------------------


def test_verify_finds_damage(csplat_file):
    assert "intact" in call("verify", csplat_file)
    assert json.loads(call("verify", csplat_file, "--json"))["holds"]
    assert call("verify", csplat_file, "--quiet") == ""
    data = bytearray(csplat_file.read_bytes())
    data[len(data) // 2] ^= 0x40
    csplat_file.write_bytes(data)
    result = invoke("verify", csplat_file, "--json")
    report = json.loads(result.stdout)
    assert (1, False) == (result.exit_code, report["holds"])
    assert "CHK-1" in {one["clause"] for one in report["violations"]}


def test_every_violation_is_listed_with_its_clause(ply, csplat_file):
    data = bytearray(csplat_file.read_bytes())
    data[13] = 1  # a reserved field of the header
    at = _spec.HEADER_SIZE + _spec.INDEX_HEAD_OFFSETS["scene_flags"]
    data[at] |= 0x08  # and a reserved flag of the scene
    csplat_file.write_bytes(data)
    result = invoke("verify", csplat_file, "--source", ply)
    assert result.exit_code == 1
    lines = result.stdout.splitlines()
    assert ["RES-1 E_RESERVED", "HDR-3 E_CRC", "RES-1 E_RESERVED", "IDX-1 E_CRC"] == [
        " ".join(line.split()[:2]) for line in lines
    ]
    assert f"at byte {at}, index.scene_flags: bits 0x08 are reserved" in lines[2]
    assert result.stderr.splitlines() == [
        f"error: {csplat_file}: 4 violations of HDR-3, IDX-1, RES-1; copy or make it again (E_CRC, E_RESERVED)",
        "error: the declared errors were not checked",
    ]
    assert invoke("verify", csplat_file, "--quiet").stdout == ""


def test_verify_proves_the_declared_errors_of_their_source(tmp_path, ply, csplat_file):
    index = ("--source-index", tmp_path / "index.npy")
    assert "the declared errors hold" in call("verify", csplat_file, "--source", ply, *index)
    report = json.loads(call("verify", csplat_file, "--source", ply, *index, "--json"))
    assert report["proof"]["rms_and_counts_proved"]
    assert all(one["holds"] for one in report["proof"]["measures"].values())
    assert "rms and counts are not proved" in call("verify", csplat_file, "--source", ply)
    model, other = read_ply(ply), tmp_path / "other.ply"
    model.means[7] += 1.0
    model.opacities[9] = 1.0 - model.opacities[9]
    write_ply(other, model)
    results = [invoke("verify", csplat_file, "--source", other, *words) for words in ((), index)]
    write_ply(other, read_ply(ply).select(slice(0, 199)))
    results.append(invoke("verify", csplat_file, "--source", other))
    assert [1, 1, 1] == [result.exit_code for result in results]
    assert "2 splats of the file have no splat of the source" in results[0].stderr
    assert "error: means: max" in results[1].stderr
    assert "error: opacities: rms" in results[1].stderr
    assert "199 splats" in results[2].stderr


def test_a_wrong_index_is_refused(tmp_path, ply, csplat_file):
    index, wrong = np.load(tmp_path / "index.npy"), tmp_path / "wrong.npy"
    assert sorted(index) == list(range(200))
    words = ("verify", csplat_file, "--source", ply, "--source-index", wrong)
    for values, message in ((index[:-1], "200"), (index.astype(np.float64), ""), (index + 1, "")):
        np.save(wrong, values)
        assert message in refused(*words, "--quiet")
    index[0] = index[1]
    np.save(wrong, index)
    result = invoke(*words)
    assert result.exit_code == 1
    assert "splats 0 and 1 both have the source index" in result.stderr
    assert invoke("verify", csplat_file, "--source-index", wrong).exit_code == 2


def test_errors_of_omitted_bands_are_verified_against_zero(tmp_path, ply):
    target, index = tmp_path / "d0.csplat", tmp_path / "d0.npy"
    call("encode", ply, target, "--sh-degree", 0, "--source-index", index)
    call("verify", target, "--source", ply, "--source-index", index)
    call("verify", target, "--source", ply)


# Lint ---------------------------------------------------------------------------------------------


def damaged_ply(path, make_model):
    model = make_model(50, 1)
    write_ply(path, model)
    data = bytearray(path.read_bytes())
    start = data.index(b"end_header\n") + 11
    data[start : start + 4] = np.float32(np.nan).tobytes()
    path.write_bytes(data + b"trailing")
    return path


def test_lint_names_defects_with_their_counts_and_repairs_them(tmp_path, make_model):
    path, good = damaged_ply(tmp_path / "bad.ply", make_model), tmp_path / "good.ply"
    result = invoke("lint", path, "--json")
    report = json.loads(result.stdout)
    assert (1, False) == (result.exit_code, report["clean"])
    assert {one["id"]: one["count"] for one in report["findings"]} == {"trailing-bytes": 8, "nonfinite-rows": 1}
    assert "nonfinite-rows" in invoke("lint", path).stdout
    call("lint", path, "--fix", good)
    assert len(read_ply(good, strict=True)) == 49
    assert call("lint", good) == "nothing found\n"
    assert json.loads(call("lint", good, "--json"))["clean"]


def test_lint_does_not_guess(tmp_path, ply):
    data = ply.read_bytes().replace(b"property float opacity\n", b"property float opaqueness\n")
    ply.write_bytes(data)
    result = invoke("lint", ply, "--fix", tmp_path / "good.ply")
    assert result.exit_code == 1
    assert "missing-columns" in result.stdout
    assert not (tmp_path / "good.ply").exists()


# Conformance, help, version -----------------------------------------------------------------------


def test_runs_the_conformance_suite():
    report = json.loads(invoke("conformance", "decoder", "--filter", "valid/q*", "--json").stdout)
    assert report["passed"] is True
    assert ["L1", "L2", "L3"] == list(report["levels"])
    assert invoke("conformance", "decoder", "--filter", "nothing").exit_code == 1


def test_a_misspelt_command_gets_a_suggestion():
    result = invoke("enocde")
    assert 2 == result.exit_code
    assert "'encode'" in result.stderr


def test_completes_commands_and_options(monkeypatch, capfd):
    def complete(*words):
        monkeypatch.setenv("_CSPLAT_COMPLETE", "complete_bash")
        monkeypatch.setenv("COMP_WORDS", " ".join(words))
        monkeypatch.setenv("COMP_CWORD", str(len(words) - 1))
        assert 0 == status_of()
        return capfd.readouterr().out.split()

    assert ["encode"] == complete("csplat", "enc")
    assert ["--preset"] == complete("csplat", "encode", "--pre")


def test_csplat_as_a_module_is_the_program_and_prints_its_version():
    done = subprocess.run([sys.executable, "-m", "csplat", "--version"], capture_output=True, text=True, check=True)
    assert call("--version") == done.stdout
    assert done.stdout.startswith(f"csplat {csplat.__version__}, format 0.3")


# As a process -------------------------------------------------------------------------------------


@pytest.mark.slow
def test_works_in_pipes_and_gives_the_same_bytes_in_every_process(ply, csplat_file):
    encoded = program("encode", "-", "-", "--quiet", "--threads", 1, input=ply.read_bytes())
    assert (0, b"", csplat_file.read_bytes()) == (encoded.returncode, encoded.stderr, encoded.stdout)


def test_a_closed_pipe_is_no_traceback(csplat_file, monkeypatch, capsys):
    near, far = os.pipe()
    os.close(near)
    with os.fdopen(far, "w") as pipe:
        monkeypatch.setattr(sys, "stdout", pipe)
        status = status_of("info", csplat_file, "--json")
        monkeypatch.undo()
        assert (1, "") == (status, capsys.readouterr().err)
        pipe.write("what the interpreter flushes when it ends")


def test_writes_no_binary_to_a_terminal(ply, csplat_file, monkeypatch, capsys):
    near, far = pty.openpty()
    with os.fdopen(far, "w") as terminal, os.fdopen(near, "rb", buffering=0) as shown:
        for words in (("encode", ply, "-"), ("decode", csplat_file, "-")):
            monkeypatch.setattr(sys, "stdout", terminal)
            status = status_of(*words)
            monkeypatch.undo()
            assert 1 == status
            assert "terminal" in capsys.readouterr().err
        assert not select.select([shown], [], [], 0)[0]


# Names, links, permissions, and faults of the disk -------------------------------------------------


@pytest.mark.slow
def test_a_replaced_output_keeps_its_permissions(tmp_path, ply, csplat_file):
    page, folder = tmp_path / "page.html", tmp_path / "streamed" / "lod-meta.json"
    report, modes = tmp_path / "report.json", (0o640, 0o755, 0o400, 0o2660)
    outputs = {
        csplat_file: ("encode", ply, csplat_file, "--preset", "fast"),
        page: ("info", csplat_file, "--page", page),
        tmp_path / "back.ply": ("decode", csplat_file, tmp_path / "back.ply"),
        report: ("lint", ply, "--report", report),
    }
    for output, words in outputs.items():
        for mode in (0o600, *(modes if output == report else ())):
            output.touch()
            output.chmod(mode)
            call(*words, "--force", "--quiet")
            assert mode == stat.S_IMODE(output.stat().st_mode), output
            assert output.stat().st_size
            output.chmod(0o600)
    folder.parent.mkdir()
    folder.parent.chmod(0o700)
    for force in ((), ("--force",)):
        call("convert", ply, folder, "--quiet", *force)
        assert 0o700 == stat.S_IMODE(folder.parent.stat().st_mode)
    if os.getuid() == 0:
        os.chown(page, 65534, 65534)
        call(*outputs[page], "--force", "--quiet")
        assert (65534, 65534) == (page.stat().st_uid, page.stat().st_gid)


def test_an_output_that_is_a_link(tmp_path, ply, csplat_file):
    data = csplat_file.read_bytes()
    link, hard = tmp_path / "link.csplat", tmp_path / "hard.csplat"
    link.symlink_to(csplat_file.name)
    hard.hardlink_to(csplat_file)
    call("encode", ply, link, "--force", "--quiet", "--preset", "fast")
    assert link.is_symlink()
    assert data == hard.read_bytes() != csplat_file.read_bytes()
    new, nowhere = tmp_path / "new.csplat", tmp_path / "nowhere.csplat"
    link.unlink()
    link.symlink_to(new)
    call("encode", ply, link, "--quiet")
    assert data == new.read_bytes()
    nowhere.symlink_to(tmp_path / "absent" / "x.csplat")
    assert f"{nowhere}: No such file" in refused("encode", ply, nowhere)


@pytest.mark.slow
def test_a_loop_of_links_is_an_error_of_one_line(tmp_path, ply, csplat_file):
    loop, other = tmp_path / "loop", tmp_path / "other"
    loop.symlink_to(other)
    other.symlink_to(loop)
    new = tmp_path / "new"
    lines = [
        ("encode", ply, loop), ("encode", ply, loop, "--force"), ("encode", loop, new), ("encode", ply, loop / "new"),
        ("encode", ply, new, "--report", f"{loop}.json"), ("encode", ply, new, "--source-index", f"{loop}.npy"),
        ("decode", csplat_file, loop), ("info", loop), ("info", csplat_file, "--page", f"{loop}.html"),
        ("convert", ply, loop / "lod-meta.json"), ("convert", ply, f"{loop}.sog"), ("convert", loop, new),
        ("merge", csplat_file, csplat_file, "-o", loop), ("merge", csplat_file, loop, "-o", new), ("lint", loop),
        ("extract", csplat_file, loop, "--box", "0,0,0,1,1,1"), ("verify", csplat_file, "--source", loop),
        ("compare", ply, loop), ("render", ply, loop, "--orbit", 1), ("view", loop), ("export-html", loop, new),
        ("export-html", csplat_file, loop), ("export-element", loop),
    ]  # fmt: skip
    for ending in (".json", ".npy", ".html", ".sog"):
        tmp_path.joinpath(f"loop{ending}").symlink_to(f"loop{ending}")
    before = sorted(tmp_path.rglob("*"))
    for words in lines:
        line = refused(*words)
        assert "loop" in line, words
        assert "(ELOOP)" in line, words
        assert before == sorted(tmp_path.rglob("*")), words


@pytest.mark.slow
def test_names_may_be_as_long_as_the_file_system_allows(tmp_path, ply, csplat_file, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for letter, count in (("n", 255), ("n", 230), ("ö", 126), ("\U0001f600", 62)):
        for ending, words in ((".csplat", ["encode", ply]), (".html", ["info", csplat_file, "--page"])):
            name = letter * (count - len(os.fsencode(ending)) // len(os.fsencode(letter))) + ending
            call(*words, name, "--quiet")
            call(*words, name, "--quiet", "--force")
            longer = letter * 30 + name
            assert f"{longer}: File name too long; choose a shorter name" in refused(*words, longer)
    call("encode", ply, f"{'n' * 248}.csplat", "--force", "--memory", "1GB", "--quiet")  # has a folder .work
    assert [] == [path.name for path in tmp_path.iterdir() if path.name.startswith(".")]


@pytest.mark.skipif(not Path("/proc/self/mem").exists(), reason="reading this file of Linux fails with EIO")
def test_a_read_error_names_the_input(tmp_path, ply, csplat_file):
    bad, new = Path("/proc/self/mem"), tmp_path / "new"
    lines = [
        ("encode", bad, new), ("decode", bad, new), ("convert", bad, f"{new}.ply"), ("info", bad), ("lint", bad),
        ("verify", bad), ("verify", csplat_file, "--source", bad), ("compare", ply, bad), ("compare", bad, ply),
        ("merge", csplat_file, bad, "-o", new), ("extract", bad, new, "--box", "0,0,0,1,1,1"), ("view", bad),
        ("export-html", bad, new), ("render", bad, new, "--orbit", 1), ("simplify", bad, f"{new}.ply", "--keep", 0.5),
        ("encode", ply, new, "--importance", bad), ("verify", csplat_file, "--source", ply, "--source-index", bad),
        ("encode", bad, "-"),
    ]  # fmt: skip
    before = sorted(tmp_path.iterdir())
    for words in lines:
        line = refused(*words)
        assert f"{bad}: Input/output error" in line, words
        assert "standard output" not in line
    assert before == sorted(tmp_path.iterdir())


class FailingInput(io.BytesIO):
    """A file that fails in the middle."""

    def read(self, size=-1, /):
        if size < 0 or self.tell():
            raise OSError(errno.EIO, os.strerror(errno.EIO))
        return super().read(min(size, 1000))

    read1 = read


def test_commands_read_standard_input_and_name_it(ply, csplat_file, monkeypatch, capsys):
    data = csplat_file.read_bytes()
    encoded = invoke("encode", "-", "-", input=ply.read_bytes())
    assert (0, data) == (encoded.exit_code, encoded.stdout_bytes)
    for name in ("info", "verify"):
        assert call(name, csplat_file).partition("\n")[2] == call(name, "-", input=data).partition("\n")[2]
    back = invoke("decode", "-", "-", "--quiet", input=data)
    assert (0, b"") == (back.exit_code, back.stderr_bytes)
    assert json.loads(call("lint", "-", "--json", input=back.stdout_bytes))["clean"]
    assert "standard input" in invoke("encode", "-", "-", input=b"nonsense").stderr
    for words, path in ((("encode", "-", "-"), ply), (("lint", "-"), ply), (("info", "-"), csplat_file)):
        with monkeypatch.context() as patch:
            patch.setattr(sys, "stdin", SimpleNamespace(buffer=FailingInput(path.read_bytes())))
            assert 1 == status_of(*words)
        assert "error: standard input: Input/output error" == capsys.readouterr().err.partition(";")[0]


def test_a_full_folder_of_temporary_files_is_named(tmp_path, ply, csplat_file, monkeypatch):
    with limited_files(1000):
        results = [
            invoke("encode", "-", "-", input=ply.read_bytes()),
            invoke("merge", csplat_file, csplat_file, "-o", tmp_path / "new.csplat"),
            invoke("convert", ply, tmp_path / "new.csplat"),
        ]
    for result, name in zip(results, (f"temporary files in {tempfile.gettempdir()}", "", "new.csplat"), strict=True):
        assert (1, 1) == (result.exit_code, result.stderr.count("\n"))
        assert f"{name}: File too large" in result.stderr
    assert "TMPDIR names another folder (EFBIG)" in results[0].stderr
    assert not (tmp_path / "new.csplat").exists()
    monkeypatch.setattr(tempfile, "tempdir", None)
    with limited_files(0):  # no folder passes the test of the module
        result = invoke("encode", "-", "-", input=ply.read_bytes())
    assert result.stderr.startswith("error: No usable temporary directory")
    assert "set TMPDIR to a folder that can be written (E_INPUT)" in result.stderr


@pytest.mark.slow
@pytest.mark.usefixtures("ply")
def test_a_closed_or_full_standard_stream_is_an_error_of_one_line(tmp_path):
    full = "error: standard output: No space left on device; the output is incomplete (ENOSPC)\n"
    cases = {
        "info scene.ply >&-": "error: standard output: Bad file descriptor; the output is incomplete (EBADF)\n",
        "lint - <&-": "error: standard input: Bad file descriptor (EBADF)\n",
        "encode scene.ply new.csplat <&- >&- 2>&-": "",
        "lint absent.ply 2>/dev/full": "",
        "--version >/dev/full": full,  # and nothing is added when the process ends
    }
    for line, message in cases.items():
        command = f'exec "{sys.executable}" -m csplat_tools {line}'
        run = subprocess.run(["/bin/sh", "-c", command], cwd=tmp_path, capture_output=True, text=True, check=False)
        assert (int("encode" not in line), message) == (run.returncode, run.stderr), line
    assert (tmp_path / "new.csplat").read_bytes().startswith(_spec.MAGIC)


def test_control_characters_of_names_do_not_reach_the_terminal(tmp_path, ply):
    name = "a\x1b[31m\x07\x9b\nb"
    path = tmp_path / f"{name}.ply"
    path.write_bytes(ply.read_bytes())
    result = invoke("encode", path, tmp_path / "new.csplat")
    shown = result.stderr + refused("info", tmp_path / f"{name}.absent")
    assert [] == [letter for letter in shown if not letter.isprintable() and letter != "\n"]
    assert "a\\x1b[31m\\x07\\x9b" in shown


@pytest.mark.slow
def test_an_interrupt_is_status_130_and_leaves_nothing(tmp_path):
    target = tmp_path / "out.csplat"
    with subprocess.Popen(
        [*PROGRAM, "encode", "-", str(target)],
        stdin=subprocess.PIPE,
        stderr=subprocess.PIPE,
        preexec_fn=heed_interrupts,  # noqa: PLW1509  # it sets one signal
    ) as running:
        assert running.stdin is not None
        running.stdin.write(bytes(1 << 20))  # more than a pipe holds: it has begun to read
        running.send_signal(signal.SIGINT)
        assert running.wait(20) == 130
        assert running.stderr is not None
        assert running.stderr.read() == b"interrupted\n"
    assert list(tmp_path.iterdir()) == []


@pytest.mark.slow
def test_an_interrupt_while_the_program_loads_is_no_traceback(tmp_path):
    def interrupted(module, script):
        """Run a script that imports a module in whose import the interrupt becomes another error."""
        folder = tmp_path / module
        folder.mkdir()
        (folder / f"{module}.py").write_text(
            "import sys, time\n"
            "print('loading', flush=True)\n"
            "try:\n    time.sleep(20)\n"
            "except KeyboardInterrupt as error:\n    raise ImportError('half of it') from error\n"
        )
        environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(folder), *filter(None, sys.path)])}
        with subprocess.Popen(
            [sys.executable, "-c", script, "info"], env=environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE,
            preexec_fn=heed_interrupts,  # noqa: PLW1509  # it sets one signal
        ) as running:  # fmt: skip
            assert running.stdout is not None
            assert running.stdout.readline() == b"loading\n"
            running.send_signal(signal.SIGINT)
            _, errors = running.communicate(timeout=20)
            return running.returncode, errors

    run = "from csplat_program import main; main()"
    assert (-signal.SIGINT, b"") == interrupted("contextlib", f"import sys; sys.modules.pop('contextlib', None); {run}")
    assert (130, b"interrupted\n") == interrupted("typer", run)


@pytest.mark.parametrize("digits", ["9" * 5000, "9" * 400 + "M", "١", "²"])
def test_numbers_of_any_length_are_refused(ply, tmp_path, digits):
    for words in (("encode", ply, tmp_path / "b.csplat", "--levels"), ("convert", ply, tmp_path / "b.ply", "--level")):
        refused(*words, digits, status=2)


def test_a_file_with_too_much_metadata_is_not_called_a_large_scene():
    line = refused("info", VECTORS / "invalid" / "json_values_beyond_budget.csplat")
    assert "its metadata or cameras take more memory than is allowed here" in line
    assert "Limits(json_bytes=...)" in line

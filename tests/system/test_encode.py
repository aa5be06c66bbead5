# SPDX-License-Identifier: Apache-2.0
"""`csplat encode`: reports, streams, refusals and options.

Also: csplat_tools.cli.command_output, csplat_tools.cli.encode, csplat_tools.cli.shared_options,
csplat_tools.encode_file, csplat_tools.file_streams.
"""

import errno
import gzip
import io
import json
import os
import pty
import re
import resource
import select
import stat
import subprocess
import sys
import tempfile
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from command_line import PROGRAM, call, invoke, printed, refused, status_of
from typer.main import get_command

import csplat
from csplat import Context, decode, write_ply
from csplat.ply import read_ply
from csplat_tools.cli.app import app
from csplat_tools.encode_file import describe_wait, encode_file
from csplat_tools.present.viewer_server import SceneServer

pytestmark = pytest.mark.usefixtures("no_first_view")


@contextmanager
def limited_files(size):
    """Let files have a limited size, as on a disk that is full."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


def test_reports_as_json(tmp_path, ply):
    out = tmp_path / "out.csplat"
    report = json.loads(printed("encode", ply, out, "--json", "--preset", "fast"))
    size = out.stat().st_size
    assert (200, size, size / 200) == (report["splats"], report["size_bytes"], report["bytes_per_splat"])
    assert report["ratio"] == ply.stat().st_size / size
    assert {"means", "covariance", "opacities", "sh0", "sh1", "sh2"} == set(report["declared_errors"])
    assert {"preset": "fast"} == report["options"]["asked"]
    quiet = invoke("encode", ply, out, "--quiet", "--force")
    assert ("", "") == (quiet.stdout, quiet.stderr)


def test_the_first_line_has_sizes_and_the_last_names_what_shows_more(tmp_path, ply):
    out = tmp_path / "out.csplat"
    lines = invoke("encode", ply, out, "--preset", "fast").stderr.splitlines()
    assert re.fullmatch(
        r"[\d.]+ kB -> [\d.]+ kB, [\d.]+ times smaller: 200 splats of [\d.]+ bytes in 1 tile, .+ s", lines[0]
    )
    assert f"`csplat compare {ply} {out}` shows how it looks, `csplat info {out}` lists" in lines[-1]


COMMON = {"--force", "--report", "--json", "--quiet", "--help-all"}


@pytest.mark.slow
def test_every_command_has_the_five_common_options_and_help_for_all():
    group, count = get_command(app), 0
    for name in group.list_commands(None):
        one = group.get_command(None, name)
        for command in getattr(one, "commands", {"": one}).values():
            options = [one for one in command.params if one.param_type_name == "option"]
            spelt = [{*one.opts, *one.secondary_opts} for one in options]
            assert COMMON <= set().union(*spelt), name
            assert [] == [one.opts for one in options if not one.help], name
            count += sum(not one & COMMON for one in spelt)
    hidden = [one.opts[0] for one in group.get_command(None, "encode").params if getattr(one, "hidden", False)]
    everything = printed("encode", "--help-all")
    assert [] == [one for one in hidden if one not in everything]
    assert (True, False) == ("--threads" in hidden, "--threads" in printed("encode", "--help"))
    assert count <= 151


@pytest.mark.slow
def test_wrong_options_are_usage_errors(tmp_path, ply):
    for words in (
        "--preset slow", "--sh-degree 5", "--up 0,0,0", "--max-psnr-drop much", "--memory 1GB --keep 0.5", "--no-prune",
        "--no-such-option", "--json -",
    ):  # fmt: skip
        target = [] if words == "--json -" else [tmp_path / "out.csplat"]
        line = refused("encode", ply, *target, *words.split(), status=2)
        assert line.startswith("error: csplat encode: ")
        assert line.endswith("; `csplat encode --help` lists the options (E_USAGE)\n")
    assert not (tmp_path / "out.csplat").exists()


def test_encode_takes_metadata_that_a_ply_lacks(tmp_path, ply):
    metadata = ("--up", "z", "--unit-metres", "0.5", "--antialiased", "--licence", "CC0")
    printed("encode", ply, tmp_path / "out.csplat", *metadata)
    model = decode(tmp_path / "out.csplat")
    assert ([0, 0, 1], "CC0") == (model.metadata.entries["up"], model.metadata.entries["licence"])
    assert (0.5, True) == (model.metadata.unit_metres, model.metadata.antialiased)


def test_repairs_are_reported_even_if_quiet(tmp_path, make_model):
    source = tmp_path / "longer.ply"
    write_ply(source, make_model(20, 0))
    source.write_bytes(source.read_bytes() + b"more")
    quiet = invoke("encode", source, tmp_path / "q.csplat", "--quiet")
    assert (1, True) == (quiet.stderr.count("\n"), "trailing-bytes" in quiet.stderr)


def test_extra_columns_are_kept_or_a_note_names_the_option(tmp_path, make_model):
    source = tmp_path / "extra.ply"
    write_ply(source, make_model(20, 0, extra={"object_id": np.arange(20, dtype=np.int32)}))
    text = "note: extra-columns: extra columns object_id are dropped: --keep-extra of csplat encode"
    assert 1 == invoke("encode", source, tmp_path / "a.csplat").stderr.count(text)
    assert "extra columns" not in invoke("encode", source, tmp_path / "c.csplat", "--keep-extra").stderr
    assert list(range(20)) == sorted(decode(tmp_path / "c.csplat").extra["object_id"])


@pytest.mark.slow
def test_encode_reports_lengths_of_rotations_that_no_training_produces(tmp_path, ply):
    line = "1 rotation not of unit length"
    for length, reported in ((0.3, False), (5.0, False), (1e-6, True), (1e6, True)):
        data = bytearray(ply.read_bytes())
        data[-16:] = np.array([length, 0, 0, 0], "<f4").tobytes()  # the last rotation
        ply.write_bytes(data)
        encoded = invoke("encode", ply, tmp_path / "out.csplat", "--preset", "fast", "--force")
        assert reported == (line in encoded.stderr), length
        assert line in printed("lint", ply)


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
    printed("encode", ply, tmp_path / "out.csplat", "--importance", weights)
    for wrong, message in (
        (np.ones(3), "importance"), (np.array([{}], dtype=object), ""), (None, "weights.npy is not a NumPy array file"),
    ):  # fmt: skip
        weights.write_text("not an array") if wrong is None else np.save(weights, wrong, allow_pickle=True)
        assert message in refused("encode", ply, tmp_path / "no.csplat", "--importance", weights, "--quiet")


def test_decodes_absolute_positions(tmp_path, make_model):
    model = make_model(20, 0, origin=(1e7, -2e6, 3.0))
    write_ply(tmp_path / "geo.ply", model)
    printed("encode", tmp_path / "geo.ply", tmp_path / "geo.csplat")
    printed("decode", tmp_path / "geo.csplat", tmp_path / "abs.ply", "--absolute")
    absolute, relative = read_ply(tmp_path / "abs.ply"), decode(tmp_path / "geo.csplat")
    assert absolute.origin == relative.origin == model.origin
    np.testing.assert_array_equal(absolute.means, relative.means)
    assert b"property double x" in (tmp_path / "abs.ply").read_bytes()


def test_replaces_nothing_without_force(tmp_path, ply, csplat_file):
    target = tmp_path / "there"
    for words in (("encode", ply, target), ("decode", csplat_file, target)):
        target.write_text("precious")
        assert "--force" in refused(*words)
        assert "precious" == target.read_text()
        printed(*words, "--force")
        assert b"precious" != target.read_bytes()


@pytest.mark.slow
@pytest.mark.usefixtures("ply")
def test_absent_files_and_folders_are_refused_in_one_line(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for words, part in {
        "encode absent.ply out.csplat": "absent.ply: No such file",
        "decode absent.csplat out.ply": "absent.csplat: No such file",
        "info absent.csplat": "No such file",
        "verify absent.csplat": "No such file",
        "lint absent.ply": "No such file",
        "info .": "is a folder, not a scene",
        "encode scene.ply .": "is a folder",
        "encode scene.ply no/such/folder/out.csplat": "No such file",
    }.items():
        assert part in refused(*words.split()), words


def test_a_full_disk_leaves_the_old_file_and_the_error_names_it(tmp_path, ply, monkeypatch):
    def fail(_):
        raise OSError(28, "No space left on device")

    old = tmp_path / "out" / "old.csplat"
    old.parent.mkdir()
    old.write_text("precious")
    with limited_files(1000):
        line = refused("encode", ply, old, "--force")
    assert line.startswith(f"error: {old}: File too large; no partial file was left")
    assert line.endswith("(EFBIG)\n")
    monkeypatch.setattr(os, "fsync", fail)
    assert "No space left" in refused("encode", ply, old, "--force", "--quiet")
    assert [old] == list(old.parent.iterdir())
    assert "precious" == old.read_text()


@pytest.mark.slow
def test_the_default_output_is_next_to_its_source(tmp_path, ply):
    printed("encode", ply)
    printed("export-html", tmp_path / "scene.csplat")
    assert {"scene.ply", "scene.csplat", "scene.html"} <= {one.name for one in tmp_path.iterdir()}
    assert "scene.ply exists" in refused("decode", tmp_path / "scene.csplat")
    assert "expected an output" in refused("encode", "-", status=2)


def test_unreadable_formats_are_refused_with_a_converter(tmp_path):
    (tmp_path / "a.lcc").write_bytes(bytes(60))
    message = "error: a.lcc is LCC, which csplat does not read: convert it to PLY first, with splat-t"
    assert refused("encode", tmp_path / "a.lcc", tmp_path / "out.csplat").startswith(message)
    (tmp_path / "a.spz").write_bytes(gzip.compress(b"NGSP" + bytes(60)))
    for words in (("decode", tmp_path / "a.spz", tmp_path / "out.ply"), ("verify", tmp_path / "a.spz")):
        assert "convert it with `csplat encode`" in refused(*words)


@pytest.mark.slow
@pytest.mark.usefixtures("csplat_file")
def test_a_name_of_another_kind_is_refused_with_a_suggestion(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for words, meant in {
        "encode scene.ply out.ply": "csplat encode scene.ply out.csplat",
        "encode scene.csplat out.ply": "csplat decode scene.csplat out.ply",
        "encode scene.ply page.html": "csplat export-html scene.ply page.html",
        "encode scene.ply out.spz": "csplat convert scene.ply out.spz",
        "decode scene.csplat out.csplat": "csplat decode scene.csplat out.ply",
        "decode scene.ply out.csplat": "csplat encode scene.ply out.csplat",
        "export-html scene.csplat out.ply": "csplat decode scene.csplat out.ply",
        "render scene.ply out.ply --orbit 2": "csplat render scene.ply out.webp",
        "lint scene.ply --fix out.csplat": "csplat encode scene.ply out.csplat",
        "info scene.csplat --page out.png": "--page out.html",
        "tradeoff scene.ply --page out.png": "--page out.html",
        "encode scene.ply out.csplat --report out.csv": "--report out.json",
    }.items():
        assert f"did you mean `{meant}`? (E_INPUT)" in refused(*words.split()), words
    assert {"scene.ply", "scene.csplat", "index.npy"} == {path.name for path in tmp_path.iterdir()}


def test_errors_name_the_file_that_was_read(tmp_path, damaged_ply, csplat_file):
    path, cut, none = damaged_ply, tmp_path / "cut.csplat", tmp_path / "none.csplat"
    path.write_bytes(path.read_bytes().replace(b"property float opacity\n", b"property float opaqueness\n"))
    cut.write_bytes(csplat_file.read_bytes()[:200])
    none.write_bytes(b"nothing of ours" * 20)
    for words, message in (
        (("encode", path, tmp_path / "out.csplat"), f"{path}: missing-columns: no column opacity"),
        (("compare", csplat_file, cut), f"{cut}: the file ends too early: E_TRUNCATED"),
        (("decode", none, tmp_path / "out.ply"), f"{none}: not a .csplat file: E_MAGIC at byte 0"),
    ):
        assert refused(*words).startswith(f"error: {message}")
    assert "`csplat encode` makes one of a PLY" in refused("info", none)


def test_errors_of_omitted_bands_are_verified_against_zero(tmp_path, ply):
    target, index = tmp_path / "d0.csplat", tmp_path / "d0.npy"
    printed("encode", ply, target, "--sh-degree", 0, "--source-index", index)
    printed("verify", target, "--source", ply, "--source-index", index)
    printed("verify", target, "--source", ply)


@pytest.mark.slow
def test_works_in_pipes_and_gives_the_same_bytes_in_every_process(ply, tmp_path):
    subprocess.run([*PROGRAM, "encode", ply, tmp_path / "scene.csplat", "--quiet"], check=True)
    words = [*PROGRAM, "encode", "-", "-", "--quiet", "--threads", "1"]
    encoded = subprocess.run(words, capture_output=True, check=True, input=ply.read_bytes())
    assert (b"", (tmp_path / "scene.csplat").read_bytes()) == (encoded.stderr, encoded.stdout)


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


@pytest.mark.slow
def test_a_new_output_has_the_usual_permissions_and_a_replaced_one_keeps_its_own(tmp_path, ply, csplat_file):
    mask = os.umask(0o022)
    os.umask(mask)
    assert 0o666 & ~mask == stat.S_IMODE(csplat_file.stat().st_mode)
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
            printed(*words, "--force", "--quiet")
            assert mode == stat.S_IMODE(output.stat().st_mode), output
            assert output.stat().st_size
            output.chmod(0o600)
    folder.parent.mkdir()
    folder.parent.chmod(0o700)
    for force in ((), ("--force",)):
        printed("convert", ply, folder, "--quiet", *force)
        assert 0o700 == stat.S_IMODE(folder.parent.stat().st_mode)
    if os.getuid() == 0:
        os.chown(page, 65534, 65534)
        printed(*outputs[page], "--force", "--quiet")
        assert (65534, 65534) == (page.stat().st_uid, page.stat().st_gid)


@pytest.mark.slow
def test_an_output_that_is_a_link(tmp_path, ply, csplat_file):
    data = csplat_file.read_bytes()
    link, hard = tmp_path / "link.csplat", tmp_path / "hard.csplat"
    link.symlink_to(csplat_file.name)
    hard.hardlink_to(csplat_file)
    printed("encode", ply, link, "--force", "--quiet", "--preset", "fast")
    assert link.is_symlink()
    assert data == hard.read_bytes() != csplat_file.read_bytes()
    new, nowhere = tmp_path / "new.csplat", tmp_path / "nowhere.csplat"
    link.unlink()
    link.symlink_to(new)
    printed("encode", ply, link, "--quiet")
    assert data == new.read_bytes()
    nowhere.symlink_to(tmp_path / "absent" / "x.csplat")
    assert f"{nowhere}: No such file" in refused("encode", ply, nowhere)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["ELOOP", "EIO"])
def test_an_input_or_output_that_fails_is_named_in_one_line(tmp_path, ply, csplat_file, kind):
    """A loop of links, and a file whose reading fails."""
    bad, new = Path("/proc/self/mem") if kind == "EIO" else tmp_path / "loop", tmp_path / "new"
    lines = [
        ("encode", bad, new), ("decode", bad, new), ("convert", bad, f"{new}.ply"), ("info", bad), ("lint", bad),
        ("verify", bad), ("verify", csplat_file, "--source", bad), ("compare", ply, bad), ("compare", bad, ply),
        ("merge", csplat_file, bad, "-o", new), ("extract", bad, new, "--box", "0,0,0,1,1,1"), ("view", bad),
        ("export-html", bad, new), ("render", bad, new, "--orbit", 1), ("simplify", bad, f"{new}.ply", "--keep", 0.5),
        ("encode", ply, new, "--importance", bad), ("verify", csplat_file, "--source", ply, "--source-index", bad),
        ("encode", bad, "-"),
    ]  # fmt: skip
    if kind == "ELOOP":
        for ending in ("", ".json", ".npy", ".html", ".sog"):
            tmp_path.joinpath(f"loop{ending}").symlink_to(f"loop{ending}")
        lines += [
            ("encode", ply, bad), ("encode", ply, bad, "--force"), ("encode", ply, bad / "new"),
            ("encode", ply, new, "--report", f"{bad}.json"), ("encode", ply, new, "--source-index", f"{bad}.npy"),
            ("decode", csplat_file, bad), ("info", csplat_file, "--page", f"{bad}.html"),
            ("convert", ply, f"{bad}.sog"), ("convert", ply, bad / "lod-meta.json"),
            ("merge", csplat_file, csplat_file, "-o", bad), ("extract", csplat_file, bad, "--box", "0,0,0,1,1,1"),
            ("render", ply, bad, "--orbit", 1),
            ("export-html", csplat_file, bad), ("export-element", bad),
        ]  # fmt: skip
    elif not bad.exists():
        pytest.skip("reading this file of Linux fails with EIO")
    before = sorted(tmp_path.rglob("*"))
    for words in lines:
        line = refused(*words)
        assert (True, True) == (str(bad) in line, f"({kind})" in line), (words, line)
        assert before == sorted(tmp_path.rglob("*")), words


@pytest.mark.slow
def test_names_may_be_as_long_as_the_file_system_allows(tmp_path, ply, csplat_file, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for letter, count in (("n", 255), ("n", 230), ("ö", 126), ("\U0001f600", 62)):
        for ending, words in ((".csplat", ["encode", ply]), (".html", ["info", csplat_file, "--page"])):
            name = letter * (count - len(os.fsencode(ending)) // len(os.fsencode(letter))) + ending
            printed(*words, name, "--quiet")
            printed(*words, name, "--quiet", "--force")
            assert f"{letter * 30 + name}: File name too long; choose a" in refused(*words, letter * 30 + name)
    printed("encode", ply, f"{'n' * 248}.csplat", "--force", "--memory", "1GB", "--quiet")  # has a folder .work
    assert [] == [path.name for path in tmp_path.iterdir() if path.name.startswith(".")]


class FailingInput(io.BytesIO):
    def read(self, size=-1, /):
        if size < 0 or self.tell():
            raise OSError(errno.EIO, os.strerror(errno.EIO))
        return super().read(min(size, 1000))

    read1 = read


@pytest.mark.slow
def test_commands_read_standard_input_and_name_it(ply, csplat_file, monkeypatch, capsys):
    data = csplat_file.read_bytes()
    encoded = invoke("encode", "-", "-", input=ply.read_bytes())
    assert (0, data) == (encoded.exit_code, encoded.stdout_bytes)
    for name in ("info", "verify"):
        assert printed(name, csplat_file).partition("\n")[2] == printed(name, "-", input=data).partition("\n")[2]
    back = invoke("decode", "-", "-", "--quiet", input=data)
    assert (0, b"") == (back.exit_code, back.stderr_bytes)
    assert json.loads(printed("lint", "-", "--json", input=back.stdout_bytes))["clean"]
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


def test_control_characters_of_names_do_not_reach_the_terminal(tmp_path, ply):
    name = "a\x1b[31m\x07\x9b\nb"
    path = tmp_path / f"{name}.ply"
    path.write_bytes(ply.read_bytes())
    result = invoke("encode", path, tmp_path / "new.csplat")
    shown = result.stderr + refused("info", tmp_path / f"{name}.absent")
    assert [] == [letter for letter in shown if not letter.isprintable() and letter != "\n"]
    assert "a\\x1b[31m\\x07\\x9b" in shown


def test_numbers_of_any_length_are_refused(ply, tmp_path):
    for words in (("encode", ply, tmp_path / "b.csplat", "--levels"), ("convert", ply, tmp_path / "b.ply", "--level")):
        for digits in ("9" * 5000, "9" * 400 + "M", "١", "²"):
            refused(*words, digits, status=2)


def test_an_open_scene_is_encoded_to_a_target(ply, tmp_path):
    target = csplat.Target(max_error={"means": 1e-4})
    with csplat.open(ply) as scene:
        encoded = encode_file(scene, str(tmp_path / "out.csplat"), csplat.EncodeOptions(), target=target)
    assert encoded.result.report.search.reached["means"] <= 1e-4


def test_the_command_passes_threads_memory_and_the_continuation(ply, tmp_path, monkeypatch):
    contexts, words = [], ("encode", ply, tmp_path / "out.csplat", "--memory", "300MB")

    def encode_here(*given, context, **others):
        contexts.append(context)
        return encode_file(*given, context=context, **others)

    monkeypatch.setattr("csplat_tools.cli.encode.encode_file", encode_here)
    cost = json.loads(printed(*words, "--dry-run", "--json"))
    assert (200, 2, True) == (cost["splats"], cost["sh_degree"], cost["in_memory"])
    assert not words[2].exists()
    printed(*words, "--resume", "--threads", 2, "--preset", "fast", "--quiet")
    assert [Context(threads=2, memory=300_000_000, resume=True)] == contexts
    refused(*words[:3], "--resume", "--target-psnr", "40", "--force", status=2)


@pytest.mark.slow
def test_a_large_scene_needs_little_memory_unless_levels_are_requested(make_model, tmp_path):
    """The splats of this file are a hole in it; an estimate does not read them."""
    large = tmp_path / "large.ply"
    write_ply(large, make_model(1))
    header, _, splat = large.read_bytes().partition(b"end_header\n")
    header = header.replace(b"element vertex 1\n", b"element vertex 3000000\n") + b"end_header\n"
    large.write_bytes(header)
    os.truncate(large, len(header) + 3_000_000 * len(splat))

    def estimate(*more):
        done = invoke("encode", large, "--dry-run", "--json", "--memory", *more)
        assert 0 == done.exit_code, done.output
        return json.loads(done.stdout)

    assert 400_000_000 < estimate("500MB")["memory_bytes"] <= 500_000_000
    cost, more = estimate("8GB"), estimate("8GB", "--levels", "auto")
    assert 1.35 == pytest.approx(more["file_bytes"] / cost["file_bytes"], abs=0.001)
    assert more["seconds"] > cost["seconds"]
    assert cost == estimate("8GB", "--levels", "none")


def test_a_long_wait_for_the_whole_scene_is_reported_with_a_remedy(tmp_path, ply, monkeypatch):
    out, page = tmp_path / "a.csplat", tmp_path / "a.html"
    short = csplat.read_header(csplat.encode(read_ply(ply)))
    header = replace(short, index_size=6_000_000)
    for found in (short, replace(header, coarse_tiles=header.tiles), replace(header, index_size=4_900_000)):
        assert [] == describe_wait(found)
    (line,), (page_line,) = describe_wait(header), describe_wait(short, 7_000_000)
    assert line.startswith("the whole scene is seen after 6.0 MB, 5 s at 10 Mbit/s; with levels of detail, at once (")
    assert "after 7.0 MB, 6 s at 10 Mbit/s; with levels of detail in a page with `csplat export-element`" in page_line
    (line,) = describe_wait(replace(short, coarse_tiles=short.tiles), 9)
    assert "levels of detail only add to it" in line
    (line,) = describe_wait(replace(header, resource_level="B"))
    assert "10 Mbit/s, and phones may refuse the file (resource level B); with levels" in line

    monkeypatch.setattr(SceneServer, "serve_forever", lambda *_, **__: None)
    for module in ("encode", "view"):
        monkeypatch.setattr(f"csplat_tools.cli.{module}.describe_wait", lambda *_: ["a long wait"])
    for words in (("encode", ply, out), ("view", out, "--no-browser"), ("export-html", out, page)):
        done = call(*words, "--json")
        assert "a long wait" in done.stderr.splitlines()
        assert "a long wait" not in done.stdout
        if words[0] != "view":
            assert "" == call(*words, "--force", "--quiet").stderr

"""Benchmarks in small: parts of files, photographs, arrival over slow lines, decoders, renders."""

from __future__ import annotations

import json
import shutil
import sys
import threading
import time
from dataclasses import replace
from http.client import HTTPConnection
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("numba", reason="training wants the extra [render]")
pytest.importorskip("scipy", reason="data sets want the extra [render]")
pytest.importorskip("matplotlib", reason="plots want the extra [render]")
pytest.importorskip("PIL.Image", reason="pictures want the extra [render]")

from chromium import absent
from command_line import bench
from oracle import cropped, difference
from posed_sets import write_blender
from typer.testing import CliRunner

import csplat
from csplat import encode, write_ply
from csplat.ply import read_ply
from csplat_bench.codec.decoders import agree
from csplat_bench.codec.decoders.__main__ import main, measured
from csplat_bench.codec.decoders.started import DECODERS
from csplat_bench.codec.parts import measured as measured_parts
from csplat_bench.codec.parts import middle_box
from csplat_bench.common.command import run
from csplat_bench.common.making import crowd, split
from csplat_bench.common.scenes import Scene
from csplat_bench.photographs.__main__ import main as photographs_main
from csplat_bench.viewer.arrival import Watched
from csplat_bench.viewer.line import Line
from csplat_bench.viewer.rules import Engine
from csplat_render import render
from csplat_render.virtual_cameras import virtual_cameras
from csplat_tools.cli.app import app

pytestmark = pytest.mark.area(name="benchmarks")


@pytest.fixture(scope="module")
def path(sample_path, tmp_path_factory):
    path = tmp_path_factory.mktemp("parts") / "scene.csplat"
    path.write_bytes(csplat.encode(csplat.read_ply(sample_path), csplat.EncodeOptions(preset="fast", tile_splats=500)))
    return path


@pytest.mark.parametrize("share", [1e-6, 0.1, 0.5, 1.0])
def test_the_box_has_the_share_of_the_splats_or_just_more(path, share):
    with csplat.open(path) as file:
        low, high = np.reshape(middle_box(file, share), (2, 3))
        found = [tile.tile.splat_count for tile in file.tiles((*low, *high), sh_degree=0)]
        smaller = (low + 1e-6, high - 1e-6)
        less = [] if (smaller[0] > smaller[1]).any() else list(file.tiles((*smaller[0], *smaller[1]), sh_degree=0))
        assert share * len(file) <= sum(found)
        assert sum(len(one.means) for one in less) < sum(found) or share == 1e-6


def test_what_is_read_is_counted_from_opening_on(path):
    with csplat.open(path) as file:
        box = middle_box(file, 0.1)
        model = file.read(box, sh_degree=0)
        row = measured_parts("disk", str(path), None, box, 0, 1)
        assert ("disk", 0, len(model), file.requests, file.bytes_read) == (
            row.place, row.sh_degree, row.splats, row.requests, row.bytes_read,
        )  # fmt: skip
    assert 0.0 < row.open_seconds < row.seconds


CONFIG = """
title = "dots"
size = "24x16"
[trainings.few]
words = ["--max-splats", "40", "--sh-degree", "0", "--iterations", "30"]
[trainings.more]
after = "few"
words = ["--max-splats", "60", "--sh-degree", "0", "--iterations", "60"]
[files]
"trained" = { of = "more", words = ["--keep", "0.5"] }
"encoded" = { of = "more", by = "encode", words = ["--preset", "small"] }
"tuned" = { of = "few", by = "finetune", words = ["--data", "FOLDER", "--iterations", "20"] }
[files.free]
of = "few"
by = "finetune"
without = "a price"
words = ["--data", "FOLDER", "--iterations", "20", "--lambda", "0"]
"""


def test_files_of_trainings_are_made_judged_and_drawn(tmp_path, capsys):
    data, config, work = tmp_path / "dots", tmp_path / "lego800.toml", tmp_path / "work"
    write_blender(data)
    config.write_text(CONFIG)
    assert not run(photographs_main, [str(config), str(data), "--work", str(work)])
    printed = capsys.readouterr().out
    assert all(word in printed for word in ("trained: few", "trained, of more", "HAC++", "RDO-Gaussian"))
    known = json.loads((tmp_path / "lego800.json").read_text())
    assert ["few", "more"] == sorted(known["trainings"])
    assert ["encoded", "free", "trained", "tuned"] == sorted(known["files"])
    for name, one in known["files"].items():
        path = work / f"lego800-{name}.csplat"
        assert one["size_bytes"] == path.stat().st_size
        words = ["compare", str(work / f"lego800-{one['training']}.ply"), str(path), "--data", str(data), "--json"]
        compared = json.loads(CliRunner().invoke(app, words).stdout)["photographs"]  # at the training's size
        assert one["psnr_mean"] == pytest.approx(compared["b"]["psnr_mean"], abs=1e-6)
        assert known["trainings"][one["training"]]["psnr"] == pytest.approx(compared["a"]["psnr"], abs=1e-6)
    assert len(read_ply(work / "lego800-more.ply")) == known["trainings"]["more"]["splats"]
    assert known["files"]["trained"]["splats"] < known["files"]["encoded"]["splats"]
    assert known["trainings"]["more"]["command"].endswith("--resume lego800-few.npz")
    assert str(tmp_path) not in json.dumps(known)
    drawn = (tmp_path / "lego800.svg").read_text()
    assert "csplat train" in drawn
    assert "csplat finetune, without a price" in drawn
    shutil.rmtree(work)  # known results are not made again
    assert not run(photographs_main, [str(config), str(data), "--work", str(work), "--files", "tuned"])
    assert printed == capsys.readouterr().out


BODY = bytes(range(256)) * 200


@pytest.fixture
def folder(tmp_path):
    (tmp_path / "scenes").mkdir()
    (tmp_path / "scenes" / "a.bin").write_bytes(BODY)
    (tmp_path / "page.html").write_text("page")
    return tmp_path


def got(address, path, asked=None):
    connection = HTTPConnection(address.split("/")[2], timeout=10)
    connection.request("GET", path, headers={"Range": asked} if asked else {})
    answer = connection.getresponse()
    found = answer.status, answer.headers.get("Content-Range"), answer.read()
    connection.close()
    return found


def test_the_line_gives_ranges(folder):
    with Line(1e9, 0.0).serve(folder) as address:
        assert (200, None, BODY) == got(address, "/scenes/a.bin")
        assert (206, "bytes 300-9999/51200", BODY[300:10_000]) == got(address, "/scenes/a.bin", "bytes=300-9999")
        assert (206, "bytes 51100-51199/51200", BODY[-100:]) == got(address, "/scenes/a.bin", "bytes=-100")
        assert (416, "bytes */51200", b"") == got(address, "/scenes/a.bin", "bytes=51200-")
        assert 404 == got(address, "/scenes/b.bin")[0]


def test_connections_share_the_rate_and_every_byte_is_noted(folder):
    line = Line(8 * 256_000, 0.0)
    with line.serve(folder) as address:
        threads = [threading.Thread(target=got, args=(address, "/scenes/a.bin")) for _ in range(2)]
        start = time.time()
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        seconds = time.time() - start
    assert seconds >= 2 * len(BODY) / 256_000  # 0.4: one alone would take half of that
    assert 2 * len(BODY) == sum(size for _, size in line.sent)
    halfway = sum(size for when, size in line.sent if when <= start + seconds / 2)
    assert 0.25 < halfway / (2 * len(BODY)) < 0.75
    line.forget()
    assert ([], None) == (line.sent, line.begun)


def test_answers_wait_and_the_line_knows_when_it_is_quiet(folder):
    line = Line(1e9, 0.2)
    with line.serve(folder) as address:
        got(address, "/page.html")
        assert line.begun is None  # files other than scenes are not slowed down
        start = time.time()
        thread = threading.Thread(target=got, args=(address, "/scenes/a.bin", "bytes=0-9"))
        thread.start()
        while line.begun is None:
            time.sleep(0.01)
        assert 0.0 == line.quiet_seconds
        thread.join()
        assert time.time() - start >= 0.2
        while line.quiet_seconds == 0.0:
            time.sleep(0.01)
        assert 10 == sum(size for _, size in line.sent)


def test_the_first_picture_is_not_black_and_the_near_one_has_25_db():
    finished = np.zeros((120, 160, 3), np.uint8)
    finished[30:90, 40:120] = 200
    pictures = np.stack([np.zeros_like(finished), finished // 2, finished - finished // 20, finished])
    seen = Watched([1.0, 2.0, 3.0, 4.0], pictures, [(0.5, 10), (1.5, 20), (2.5, 40), (9.0, 80)], 0.5).seen
    assert [(1500.0, 30), (2500.0, 70), (3500.0, 70)] == [
        (one.ms, one.sent_bytes) for one in (seen.first, seen.good, seen.whole)
    ]
    assert 150 == seen.asked_bytes


# A decoder behind the protocol of codec/js/test/adapter.mjs that gives the same answer to every file.
STUB = """#!{python}
import struct, sys
while head := sys.stdin.buffer.read(4):
    sys.stdin.buffer.read(struct.unpack("<I", head)[0])
    print({answer!r}, flush=True)
"""


@pytest.fixture
def node():
    if shutil.which("node") is None:
        absent("the JavaScript decoder needs Node.js, which is not installed")


@pytest.mark.usefixtures("node")
def test_both_decoders_give_the_same(sample_path, tmp_path, make_model, capsys):
    (tmp_path / "extra.csplat").write_bytes(encode(make_model(50, 2)))
    (tmp_path / "broken.csplat").write_bytes(encode(make_model(50, 1))[:-1])
    write_ply(tmp_path / "tiny.ply", make_model(300, 3))
    assert 0 == agree.main([sample_path, *sorted(tmp_path.glob("*.csplat"))], presets="fast")
    first = capsys.readouterr().out.splitlines()
    assert 0 == agree.main([tmp_path / "tiny.ply"], presets="fast,small")
    lines = [*first, *capsys.readouterr().out.splitlines()]
    assert ["equal"] * 3 == [line.split()[-1] for line in lines if line.startswith(("sample ", "tiny "))]
    assert any(line.startswith("extra.csplat") and line.endswith("equal") for line in lines)
    assert any(line.startswith("broken.csplat") and "both refuse it, E_TRUNCATED" in line for line in lines)
    assert "3 of 3 files agree" == first[-1]


@pytest.mark.parametrize(
    ("answer", "expected"),
    [
        ('{"arrays": {"floats.means": [600, "00"]}}', "DIFFERENT: floats.means"),
        ('{"code": "E_CRC"}', "DIFFERENT: JavaScript refused with E_CRC"),
        ('{"defect": "TypeError: oh"}', "DIFFERENT: JavaScript failed: TypeError: oh"),
    ],
)
def test_a_decoder_that_gives_something_else_fails(tmp_path, make_model, answer, expected, capsys):
    stub = tmp_path / "stub"
    stub.write_text(STUB.format(python=sys.executable, answer=answer))
    stub.chmod(0o755)
    (tmp_path / "scene.csplat").write_bytes(encode(make_model(50, 0)))
    assert 1 == agree.main([tmp_path / "scene.csplat"], node=str(stub))
    said = capsys.readouterr().out
    assert expected in said
    assert "0 of 1 files agree" in said


class Told:
    """A decoder that takes given seconds, in turn and for ever, or fails."""

    def __init__(self, seconds):
        self.seconds = seconds

    def __enter__(self):
        return self

    def __exit__(self, *_):
        pass

    def decode(self):
        if not self.seconds:
            raise OSError("it does not work here")
        self.seconds.append(self.seconds.pop(0))
        return self.seconds[-1], 400

    def growth_bytes(self):
        return 800


def test_a_ratio_is_that_of_one_turn_and_who_fails_is_left_out(tmp_path, capsys):
    (tmp_path / "file").touch()
    native = {(one.driver, one.word): one for one in DECODERS if one.place == "native"}
    seconds = {"csplat": [1.0, 2.0, 4.0], "spz": [5.0, 4.0, 12.0]}  # 5, 2 and 3 times as long
    wanted = [native["csplat", "1"], native["spz", "floats"], native["spz", "packed"]]
    files = dict.fromkeys(("fast.csplat", "v4.spz"), tmp_path / "file")

    def start(one, _path):
        return Told([] if one.word == "packed" else list(seconds[one.driver]))

    ours, theirs = measured(Scene("scene", Path(), 100, 0), wanted, files, 3, start)
    assert (3.0, 1.0) == (ours.ratio, theirs.ratio)
    assert sorted(seconds["csplat"]) == sorted(ours.seconds)
    assert "left out: the same, not unpacked of v4.spz: it does not work here" in capsys.readouterr().err


@pytest.mark.usefixtures("node")
def test_decoders_are_timed_on_files_of_a_scene(tmp_path, make_model, capsys):
    write_ply(tmp_path / "scene.ply", make_model(50, 1))
    words = {"scenes": "", "extra": [tmp_path / "scene.ply"], "presets": "fast", "places": "node", "runs": 1}
    main(**words, no_peers=True, json=tmp_path / "found.json", cache=tmp_path, peers=tmp_path)
    rows = json.loads((tmp_path / "found.json").read_text())["rows"]
    ways = [one for one in DECODERS if (one.place, one.driver) == ("node", "csplat.mjs")]
    whole = {row["decoder"] for row in rows if row["array_bytes"] == 50 * 92}
    assert {one.name for one in ways if one.delivers == "float32"} == whole
    assert {("fast.csplat", 1)} == {(row["file"], len(row["seconds"])) for row in rows}
    assert "scene, 50, SH 1" in capsys.readouterr().out


@pytest.fixture(scope="module")
def sample(sample_path):
    return read_ply(sample_path)


def test_a_crowd_has_as_many_splats_in_view_as_it_says(sample):
    cameras = virtual_cameras(sample, 3, 160, 120)
    count = 2 * len(sample)
    found = crowd(sample, cameras, count)
    drawn = np.median([render(found, camera).drawn for camera in cameras])
    assert abs(drawn - count) <= 0.02 * count


def test_split_splats_have_the_spread_of_the_whole(make_model):
    model = make_model(1, 0, scales=np.log(np.array([[0.5, 0.1, 0.02]], np.float32)))
    parts = split(model, 20_000, np.random.default_rng(0))
    assert len(parts) == 20_000
    w, x, y, z = model.quats[0].astype(np.float64)
    axes = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )
    local = (parts.means - model.means[0]) @ axes
    total = np.sqrt(local.var(axis=0) + np.exp(2.0 * parts.scales[0]))
    np.testing.assert_allclose(total, [0.5, 0.1, 0.02], rtol=0.03)


def test_the_middle_of_a_picture_is_the_same_pixel_for_pixel(sample):
    view = virtual_cameras(sample, 1, 160, 120)[0]
    whole, middle = render(sample, view).rgb, render(sample, cropped(view, 40, 30)).rgb
    off = difference(middle, whole[45:75, 60:100])
    assert off.share <= 0.02  # splats whose centres lie far outside are linearised elsewhere
    assert off.mean <= 1e-3


def test_the_renderer_is_measured(tmp_path):
    bench("rendering", "--scenes", "sample", "--views", 1, "--rounds", 1, "--json", tmp_path / "r.json")
    results = json.loads((tmp_path / "r.json").read_text())["results"]
    assert ["sample standard", "sample fast", "sample antialiased"] == list(results)
    assert all(one["forward"]["wall"] > 0.0 and one["backward"]["wall"] > 0.0 for one in results.values())
    assert results["sample standard"]["psnr"] is None
    assert 30.0 < results["sample fast"]["psnr"] < 60.0


def test_training_is_measured(data_dir, tmp_path):
    folder = data_dir / "images" / "lego200"
    if not folder.is_dir():
        pytest.skip("the Lego pictures are absent")
    bench("training", folder, "--rows", "200:40x40", "--warm", 2, "--steps", 5, "--json", tmp_path / "t.json")
    (result,) = json.loads((tmp_path / "t.json").read_text())["results"]
    assert all(result["seconds"][name] > 0.0 for name in ("step", "forward", "loss", "backward", "Adam"))
    assert result["memory_bytes"] > 0


def test_cameras_are_compared(data_dir, tmp_path):
    if not (data_dir / "psnr_cameras" / "plane3.json").exists():
        pytest.skip("plane3 is absent")
    words = ("--scenes", "plane3", "--presets", "fast", "--seeds", "0", "--no-peers", "--cache", tmp_path)
    bench("codec.quality", *words, "--json", tmp_path / "q.json")
    ((one,),) = json.loads((tmp_path / "q.json").read_text())["scenes"].values()
    assert abs(one["differences"][0]) <= 1.0


def test_rules_of_colours_change_no_picture_whose_colours_stay_in_their_range(sample):
    view = virtual_cameras(sample, 1, 80, 60)[0]
    pale = replace(sample, sh0=0.2 * sample.sh0, shN=0.2 * sample.shN)
    plain, clipped = Engine("plain", ()), Engine("clipped", (), clips=True)
    np.testing.assert_allclose(clipped.drawn(pale, view, 3), plain.drawn(pale, view, 3), atol=1e-4)
    assert np.abs(clipped.drawn(sample, view, 3) - plain.drawn(sample, view, 3)).max() > 0.01

"""`csplat_bench.codec.decoders`: what is compared with what; decoders that agree pass, one that does not is found."""

import json
import shutil
import sys
from pathlib import Path

import pytest
from chromium import absent

from csplat import encode, write_ply
from csplat_bench.codec.decoders import agree
from csplat_bench.codec.decoders.__main__ import main, measured
from csplat_bench.codec.decoders.started import DECODERS
from csplat_bench.common.scenes import Scene

pytestmark = pytest.mark.area(name="benchmarks")

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

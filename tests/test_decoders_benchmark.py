"""`csplat_bench.codec.decoders`: equal decoders pass, and one that gives anything else is found out."""

import shutil
import sys

import pytest
from benching import bench
from chromium import absent

from csplat import encode

# A decoder behind the protocol of codec/js/test/adapter.mjs that gives the same answer to every file.
STUB = """#!{python}
import struct, sys
while head := sys.stdin.buffer.read(4):
    sys.stdin.buffer.read(struct.unpack("<I", head)[0])
    print({answer!r}, flush=True)
"""


def run(*words):
    return bench("codec.decoders", *words, check=False)


@pytest.fixture
def node():
    if shutil.which("node") is None:
        absent("the JavaScript decoder needs Node.js, which is not installed")


@pytest.mark.usefixtures("node")
def test_both_decoders_give_the_same(sample_path, tmp_path, make_model):
    (tmp_path / "extra.csplat").write_bytes(encode(make_model(50, 2)))
    (tmp_path / "broken.csplat").write_bytes(encode(make_model(50, 1))[:-1])
    done = run(sample_path, *sorted(tmp_path.glob("*.csplat")), "--presets", "fast,small")
    assert 0 == done.returncode, done.stderr
    lines = done.stdout.splitlines()
    assert ["equal", "equal"] == [line.split()[-1] for line in lines if line.startswith("sample ")]
    assert any(line.startswith("extra.csplat") and line.endswith("equal") for line in lines)
    assert any(line.startswith("broken.csplat") and "both refuse it, E_TRUNCATED" in line for line in lines)
    assert "4 of 4 files agree" == lines[-1]


@pytest.mark.parametrize(
    ("answer", "expected"),
    [
        ('{"arrays": {"floats.means": [600, "00"]}}', "DIFFERENT: floats.means"),
        ('{"code": "E_CRC"}', "DIFFERENT: JavaScript refused with E_CRC"),
        ('{"defect": "TypeError: oh"}', "DIFFERENT: JavaScript failed: TypeError: oh"),
    ],
)
def test_a_decoder_that_gives_something_else_fails(tmp_path, make_model, answer, expected):
    stub = tmp_path / "stub"
    stub.write_text(STUB.format(python=sys.executable, answer=answer))
    stub.chmod(0o755)
    (tmp_path / "scene.csplat").write_bytes(encode(make_model(50, 0)))
    done = run(tmp_path / "scene.csplat", "--node", stub)
    assert 1 == done.returncode
    assert expected in done.stdout
    assert "0 of 1 files agree" in done.stdout

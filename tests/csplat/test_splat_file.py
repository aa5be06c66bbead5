# SPDX-License-Identifier: Apache-2.0
"""Files that are read in parts from a disk, memory or a store; `test_remote_servers.py` tests servers.

Also: csplat.byte_store.
"""

import io
import math
import re
import sys
from types import SimpleNamespace

import numpy as np
import pytest
from stores import FileSystem, assert_same, box_of
from typer.testing import CliRunner

import csplat
from csplat import EncodeOptions, FormatError, InputError, LimitError, StoreError, _spec, decode, encode, read_header
from csplat.byte_store import FileWindow, MemoryStore, RequestSizes
from csplat.decoder import Limits, iter_tiles
from csplat.file_source import PageReleaser, map_file
from csplat.remote_store import open_store
from csplat.splat_file import SplatFile
from csplat_conformance.manifest import load
from csplat_conformance.validator import validate
from csplat_tools.cli.app import app

#: Small enough that a file of some hundred kB takes several requests.
SMALL = RequestSizes(first=512, batch=20_000, gap=100, request=10_000)


class Watched(SplatFile):
    """A file that keeps its last window."""

    def window(self):
        self.last_window = super().window()
        return self.last_window


def opened(file):
    """Open a file with small requests."""
    store = open_store(file)
    store.sizes = SMALL
    return Watched(store, Limits())


@pytest.fixture(scope="module")
def data(sample_path):
    return encode(csplat.read(sample_path), EncodeOptions(preset="fast", tile_splats=1000))


@pytest.fixture(scope="module")
def box(data):
    return box_of(data, 2)  # others touch it


@pytest.fixture
def store(data, monkeypatch):
    """A file system for `store://` and web URLs, in place of fsspec."""
    system = FileSystem({"scene.csplat": data})
    core = SimpleNamespace(url_to_fs=lambda url, **_: (system, url.partition("://")[2].rpartition("/")[2]))
    monkeypatch.setitem(sys.modules, "fsspec", SimpleNamespace(core=core))
    monkeypatch.setitem(sys.modules, "fsspec.core", core)
    return system


@pytest.mark.slow
def test_a_part_equals_that_of_a_whole_decode_with_fewer_bytes_read(data, box, tmp_path):
    (tmp_path / "scene.csplat").write_bytes(data)
    whole = decode(data)
    with csplat.open(tmp_path / "scene.csplat") as file:
        assert read_header(data) == file.header
        assert len(file) == file.count == file.header.splat_count
        assert (1, 65536) == (file.requests, file.bytes_read)
        chosen = [tile.tile.index for tile in file.tiles(box)]
        assert 2 in chosen
        assert len(chosen) < len(file.header.tiles)
        assert_same(decode(data, tiles=chosen), file.read(box))
        assert_same(decode(data, tiles=[3, 1], sh_degree=1), file.read(tiles=[3, 1], sh_degree=1))
        assert whole.metadata == file.metadata
        assert_same(whole, file.read())


@pytest.mark.slow
def test_boxes_of_tiles_are_exact(data):
    with csplat.open(data) as file:
        assert (len(file.header.tiles), 2, 3) == file.boxes.shape
        for box, tile in zip(file.boxes, file.tiles(sh_degree=0), strict=True):
            np.testing.assert_array_equal(box[0], tile.means.min(axis=0))
            np.testing.assert_array_equal(box[1], tile.means.max(axis=0))


@pytest.mark.slow
def test_tiles_are_iterated_and_released(data, box):
    with opened(io.BytesIO(data)) as file:
        for degree in (None, 0):
            for wanted, tile in zip(iter_tiles(data, sh_degree=degree), file.tiles(sh_degree=degree), strict=True):
                assert_same(wanted, tile)
            first = file.header.tiles[0].layers[0]
            assert not any(file.last_window.view[first.offset : first.offset + first.size])
        assert_same(decode(data, tiles=[tile.tile.index for tile in file.tiles(box)]), file.read(box))


def test_unused_bands_are_not_fetched(data):
    layers = {layer: sum(tile.layers[layer].size for tile in read_header(data).tiles) for layer in range(4)}
    with opened(data) as file:
        before = file.bytes_read
        file.read(sh_degree=0)
        assert layers[0] <= file.bytes_read - before < layers[0] + layers[1] / 2


def test_bytes_that_were_not_fetched_fail_their_checksum(data):
    with opened(data) as file:
        window = file.window()
        window.fetch([(0, _spec.HEADER_SIZE + file.header.index_size)])
        with pytest.raises(FormatError, match="E_CRC"):
            decode(window.view, tiles=[4])
        with pytest.raises(FormatError, match="E_CRC"):
            list(iter_tiles(window.view))


def test_releasing_pages_keeps_fetched_bytes(data, tmp_path):
    (tmp_path / "scene.csplat").write_bytes(data)
    window = FileWindow(MemoryStore(data))
    window.fetch([(0, len(data))])
    for view in (window.view, memoryview(map_file(tmp_path / "scene.csplat"))):
        PageReleaser(view, step_bytes=1).after(1)
        assert data == view


def test_a_long_index_takes_a_second_request(data):
    with opened(data) as file:
        assert 2 <= file.requests
        assert _spec.HEADER_SIZE + file.header.index_size == file.bytes_read
        assert read_header(data) == file.header


def test_the_size_of_requests_does_not_change_an_extracted_part(data, box):
    parts = []
    for file in (csplat.open(data), opened(data)):
        with file:
            parts.append(io.BytesIO())
            csplat.extract(file, box, parts[-1])
            requests = file.requests
    assert parts[0].getvalue() == parts[1].getvalue()
    assert requests > 10


def test_neighbouring_parts_are_read_in_one_request(data):
    store = MemoryStore(data)
    window, gap = FileWindow(store), store.sizes.gap
    window.fetch([(10, 5), (0, 10), (15 + gap, 5)])
    assert (1, 20 + gap) == (store.requests, store.bytes_read)
    window.fetch([(12, gap)])  # is there
    assert 1 == store.requests
    window.fetch([(100, 50 + gap)])  # the end of it is not
    assert (2, 150 + gap) == (store.requests, store.bytes_read)
    assert data[: 150 + gap] == window.view[: 150 + gap]
    assert not any(window.view[150 + gap :])
    window.forget()
    assert not any(window.view)


def test_invalid_arguments_are_refused_before_reading(data):
    with csplat.open(data, limits=Limits(splats=1000)) as file:
        before = file.bytes_read
        for call, error, message in (
            (lambda: file.read((0, 0, 0, 1, 1, math.nan)), InputError, "six numbers other than NaN"),
            (lambda: file.read((1e6,) * 6), InputError, "no tile touches the box 1000000, 1000000"),
            (lambda: file.read(tiles=[99]), InputError, "tile 99"),
            (lambda: file.read(sh_degree=5), InputError, "sh_degree is 5"),
            (lambda: file.tiles(sh_degree=-1), InputError, "sh_degree is -1"),
            (lambda: file.read((0, 0, 0, 1, 1, 1), tiles=[1]), InputError, "box and tiles exclude"),
            (file.read, LimitError, "splats"),
        ):
            with pytest.raises(error, match=message):
                call()
        assert before == file.bytes_read
    with pytest.raises(InputError, match="is closed"):
        file.read()
    with pytest.raises(InputError, match="the file is not one"):
        csplat.open(data, storage={"anon": True})


def test_files_of_wrong_size_give_the_errors_of_decode(data):
    for wrong in (data + b"x", *(data[:size] for size in (0, 10, 100, 3000))):
        with pytest.raises(FormatError) as wanted:
            decode(wrong)
        with pytest.raises(FormatError) as raised:
            csplat.open(wrong)
        assert str(wanted.value) == str(raised.value)


def test_a_file_that_changes_while_it_is_read_is_an_error(data, tmp_path):
    path = tmp_path / "scene.csplat"
    for wrong in (data[:70_000], data[:70_000] + bytes(len(data) - 70_000)):
        path.write_bytes(data)
        with csplat.open(path) as file:
            path.write_bytes(wrong)
            with pytest.raises(StoreError, match=r"scene\.csplat has changed while it was read"):
                file.read()


def test_a_damaged_file_is_named(store, data, tmp_path):
    wrong, local = data[:-1] + bytes([data[-1] ^ 1]), str(tmp_path / "scene.csplat")
    store.files["scene.csplat"] = wrong
    (tmp_path / "scene.csplat").write_bytes(wrong)
    for name in (local, "store://scene.csplat"):
        with csplat.open(name) as file, pytest.raises(FormatError, match="E_CRC") as raised:
            file.read()
        assert name == raised.value.path


@pytest.mark.slow
def test_parts_are_read_from_a_store(store, data, box):
    for store.protocol, url in (
        ("store", "store://scenes/scene.csplat"),
        (("http", "https"), "https://a.org/scene.csplat"),
    ):
        store.asked = store.sent = 0
        with csplat.open(url) as file:
            assert (2, 65536) == (file.requests, file.bytes_read)
            chosen = [tile.tile.index for tile in file.tiles(box)]
            assert_same(decode(data, tiles=chosen), file.read(box))
            assert (store.asked, store.sent) == (file.requests, file.bytes_read)


def test_files_of_other_formats_are_downloaded(store, data, make_model, tmp_path):
    model = make_model(50, 1)
    csplat.write(tmp_path / "scene.ply", model)
    store.files["scene.ply"] = (tmp_path / "scene.ply").read_bytes()
    with csplat.open("store://scenes/scene.ply") as scene:
        assert ("ply", "scene.ply", 50) == (scene.format, scene.name, scene.count)
        assert np.array_equal(model.sh0, scene.model().sh0)
    assert np.array_equal(model.shN, csplat.read("store://scene.ply").shN)
    assert_same(decode(data), csplat.read("store://scene.csplat"))


def test_a_stored_file_that_changes_between_requests_is_an_error(store, data):
    for size in (None, 70_000):
        store.files["scene.csplat"] = data
        with csplat.open("store://scene.csplat") as file:
            store.files["scene.csplat"] = bytes(reversed(data))[:size]
            with pytest.raises(StoreError, match=r"/scene\.csplat has changed while it was read: open it again"):
                file.read(tiles=[5])
            del store.files["scene.csplat"]
            with pytest.raises(FileNotFoundError, match=r"store://scene\.csplat"):
                file.read(tiles=[5])


def test_an_incomplete_answer_of_a_store_is_a_typed_error(store):
    store.cut_after = 0
    with pytest.raises(StoreError, match=r"/scene\.csplat returned 32768 bytes from byte 0, expected 65536"):
        csplat.open("store://scene.csplat")
    store.cut_after = None
    with csplat.open("store://scene.csplat") as file:
        store.answer = ConnectionError("lost")
        with pytest.raises(StoreError, match=r"/scene\.csplat: lost"):
            file.read(sh_degree=0)


def test_errors_of_a_store_contain_no_secrets(store):
    for status, error, message in (
        (404, FileNotFoundError, "No such file"),
        (403, PermissionError, "Permission"),
        (500, StoreError, "status 500"),
    ):
        store.answer = Refused("store://scene.csplat?key=secret")
        store.answer.status = status
        with pytest.raises(error, match=message) as raised:
            csplat.open("store://somebody:password@scenes/scene.csplat?key=secret")
        assert "scene.csplat" in str(raised.value)
        assert not re.search("secret|password", str(raised.value))


def test_each_part_of_a_chained_url_is_redacted(store):
    store.answer = Refused("no")
    store.answer.status = 500
    for url, shown in {
        "simplecache::https://user:pw@host/f.csplat?X-Amz-Signature=abc": "simplecache::https://host/f.csplat",
        "zip://f.csplat::https://user:pw@host/a.zip?sig=abc#abc": "zip://f.csplat::https://host/a.zip",
        "zip://f?abc::simplecache::s3://user:pw@bucket/a.zip": "zip://f::simplecache::s3://bucket/a.zip",
        "https://user:pw@[2001:db8::1]:8443/f.csplat?sig=abc": "https://[2001:db8::1]:8443/f.csplat",
        "https://user:p@pw@host/f@2.csplat": "https://host/f@2.csplat",
        "s3://bucket/f.csplat": "s3://bucket/f.csplat",
    }.items():
        with pytest.raises(StoreError) as raised:
            csplat.open(url)
        assert f"{shown}: HTTP status 500" == str(raised.value)


def test_urls_in_the_message_of_an_exception_are_redacted(store):
    store.answer = Refused("cannot reach https://somebody:password@host/f?sig=secret, nor s3://somebody:password@f")
    with pytest.raises(StoreError, match=r"store://f: cannot reach https://host/f nor s3://f$"):
        csplat.open("store://f")


class Refused(Exception):  # noqa: N818  # named like errors of libraries
    """An error that a store raises."""


def test_an_unknown_url_is_refused(store, monkeypatch):
    def refuse(url, **_):
        raise ValueError(f"Protocol not known: {url}")

    monkeypatch.setattr(sys.modules["fsspec.core"], "url_to_fs", refuse)
    with pytest.raises(InputError, match="nowhere://scene"):
        csplat.open("nowhere://scene.csplat")
    assert 0 == store.asked


def test_without_the_extra_a_url_is_an_error_with_a_remedy(monkeypatch):
    monkeypatch.setitem(sys.modules, "fsspec.core", None)
    with pytest.raises(InputError, match="of the extra remote: pip install"):
        csplat.open("https://example.org/scene.csplat")


@pytest.mark.slow
def test_extract_reads_a_url_and_leaves_no_partial_file(store, data, box, tmp_path):
    out, local = tmp_path / "part.csplat", tmp_path / "local.csplat"
    words = ["extract", "store://scenes/scene.csplat", str(out), f"--box={','.join(map(repr, box))}"]
    done = CliRunner().invoke(app, words)
    assert 0 == done.exit_code, done.stderr
    csplat.extract(data, box, local)
    assert local.read_bytes() == out.read_bytes()
    assert () == validate(out.read_bytes()).violations
    store.cut_after = store.asked + 2
    refused = CliRunner().invoke(app, [*words, "--force"])
    assert (1, 1) == (refused.exit_code, len(refused.stderr.splitlines()))
    assert "store://scenes/scene.csplat" in refused.stderr
    assert local.read_bytes() == out.read_bytes()  # the previous file


def test_extract_reads_standard_input_and_writes_standard_output(data, box):
    def run(data):
        return CliRunner().invoke(app, ["extract", "-", "-", f"--box={','.join(map(repr, box))}"], input=data)

    stream = io.BytesIO()
    csplat.extract(data, box, stream)
    done, short, ply = map(run, (data, data[:-1], b"ply\nformat"))
    assert (0, stream.getvalue()) == (done.exit_code, done.stdout_bytes)
    assert 1 == short.exit_code
    assert short.stderr.startswith("error: standard input: the file ends too early")
    assert "standard input is a PLY" in ply.stderr


def test_ways_of_drawing_that_no_renderer_has_are_findings():
    vectors = {vector.name.removeprefix("valid/"): vector for vector in load()}
    expected = {"rich": [], "scene_facts": ["colour-space"], "ancillary_hints": ["projection", "colour-space"]}
    for name, found in expected.items():
        with csplat.open(vectors[name].data) as scene:
            assert found == [finding.id for finding in scene.findings]

# SPDX-License-Identifier: Apache-2.0
"""Files at URLs of a local web server and a local S3, through fsspec."""

import io
import re
import threading

import numpy as np
import pytest
from stores import Web, assert_same, box_of, s3

import csplat
from csplat import EncodeOptions, FormatError, StoreError, decode, encode
from csplat.byte_store import RequestSizes
from csplat.encoder import EncodePlan, LevelNode, encode_levels
from csplat.remote_store import RemoteStore

pytestmark = pytest.mark.remote
fsspec = pytest.importorskip("fsspec", reason="URLs require the extra [remote]")
aiohttp = pytest.importorskip("aiohttp", reason="URLs require the extra [remote]")


@pytest.fixture(scope="module")
def data(sample_path):
    return encode(csplat.read(sample_path), EncodeOptions(preset="fast", tile_splats=1000))


@pytest.fixture(scope="module")
def box(data):
    return box_of(data, 2)  # others touch it


def assert_part(file, data, box):
    assert_same(decode(data, tiles=[tile.tile.index for tile in file.tiles(box)]), file.read(box))


@pytest.fixture
def web(data, monkeypatch):
    monkeypatch.setattr(RemoteStore, "sizes", RequestSizes(waits=(0.01, 0.01, 0.01)))
    monkeypatch.setenv("no_proxy", "127.0.0.1")
    server = Web({"/scene.csplat": data})
    with server.serve() as address:
        server.url = f"{address}/scene.csplat"
        yield server


def test_parts_are_read_from_a_web_server(web, data, box):
    with csplat.open(web.url) as file:
        assert [("HEAD", None), ("GET", "bytes=0-65535")] == [(one[0], one[2]) for one in web.asked]
        assert_part(file, data, box)
        assert (len(web.asked), web.sent) == (file.requests, file.bytes_read)
        assert_same(decode(data), file.read())


def test_a_coarser_version_is_read_without_the_rest(web, sample_path):
    model = csplat.read(sample_path)
    leaves = np.array_split(np.argsort(model.means[:, 0]), 3)
    nodes = [LevelNode(0, 3, rows=rows) for rows in leaves]
    nodes.append(LevelNode(1, None, splats=model.select(slice(0, None, 8)), error=1.0))
    data = encode_levels(EncodePlan.of(model, EncodeOptions(preset="fast")), nodes).write().data
    web.files["/scene.csplat"] = data
    with csplat.open(web.url) as file:
        coarse = file.read(tiles=file.cut(max_splats=len(model) - 1))
        assert_same(decode(data, tiles=[tile.index for tile in file.header.coarse_tiles]), coarse)
        # The first request has geometry of level 0 as well; of the rest, codebooks and parts of the bands are needed.
        assert web.sent == file.bytes_read < (1 << 16) + (len(data) - (1 << 16)) / 2
        before = file.bytes_read
        assert_same(decode(data), file.read())
        assert file.bytes_read - before > len(data) / 2


#: Answers to the GETs of a read after which the data are right.
SURVIVED = [
    ["short"], ["short", "short", "short"], [None, "short"], ["until it closes"], [503], [429, 503, 502], [None, 503],
    ["hang up"], [None, "hang up", "hang up"], ["half"], [None, "half", "broken chunk"], ["stall"], [None, "stall"],
    [None, "part as 200"], ["gzip", "gzip"],
]  # fmt: skip
FAULTS = [  # and with the error after others
    *((faults, "") for faults in SURVIVED),
    ([503] * 9, "HTTP status 503, try again after 0 s; tried 4 times"),
    (["stall"] * 9, "the server sends nothing; tried 4 times"),
    ([None, *["hang up"] * 9], "Server disconnected; tried 4 times"),
    (["whole"], "the server sends only whole files"),
    ([None, "whole"], "the server sends only whole files"),
    (["shifted"], "the server sent the part from byte 1, requested was the one from byte 0"),
    ([None, 403], "403: not public, or the signature of the URL has expired"),
    ([None, 404], "No such file"),
    ([None, 500], "HTTP status 500"),
]


def test_failed_requests_are_repeated_and_short_answers_continued(web, data):
    storage = {"client_kwargs": {"timeout": aiohttp.ClientTimeout(sock_read=0.1)}}
    right, wrong = decode(data, sh_degree=0), {}
    for faults, message in FAULTS:
        web.faults = list(faults)
        try:
            with csplat.open(web.url, storage=storage) as file:
                assert_same(right, file.read(sh_degree=0))
            said = ""
        except (StoreError, OSError) as error:
            said = str(error)
            assert web.url in said
            assert 1 == len(said.splitlines())
        if re.search(message, said) is None or bool(message) != bool(said):
            wrong[str(faults)] = said
        web.released.set()
        web.released = threading.Event()
    assert {} == wrong


def test_a_connection_without_bytes_is_lost_after_a_while(web):
    with csplat.open(web.url) as file:
        timeout = file._store._fs.client_kwargs["timeout"]
    assert timeout.total is None  # large files take longer than the five minutes of aiohttp
    assert 0 < timeout.sock_read <= 60 >= timeout.sock_connect > 0


def test_a_server_that_asks_for_a_long_break_is_not_waited_for(web, monkeypatch):
    web.files["/scene.csplat"] = 503
    monkeypatch.setattr(RemoteStore, "sizes", RequestSizes(waits=(100.0,)))
    with pytest.raises(StoreError, match=r"HTTP status 503$"):
        csplat.open(web.url)


def test_a_file_that_is_stored_compressed_is_refused(web):
    for web.coding in ("gzip", "br"):  # aiohttp unpacks br only with another package
        with pytest.raises(StoreError, match=rf"compressed \(Content-Encoding(: {web.coding})?\), so no parts"):
            csplat.open(web.url)


def test_a_proxy_of_the_environment_is_used(web, data, monkeypatch):
    web.files["http://far.example/scene.csplat"] = data
    monkeypatch.setenv("http_proxy", web.url.removesuffix("/scene.csplat"))
    monkeypatch.setenv("no_proxy", "")
    with csplat.open("http://far.example/scene.csplat") as file:
        assert_same(decode(data, sh_degree=0), file.read(sh_degree=0))


def test_a_weak_etag_is_the_same_version(web, data):
    web.tag = '"a"'
    web.files["/scene.csplat"] = data[:-1] + bytes([data[-1] ^ 1])
    with csplat.open(web.url) as file:
        web.tag = 'W/"a"'
        with pytest.raises(FormatError, match="E_CRC") as raised:
            file.read()
    assert web.url == raised.value.path


@pytest.mark.parametrize("size", [None, 70_000])
def test_a_file_that_changes_between_requests_is_an_error(web, data, size):
    with csplat.open(web.url) as file:
        web.files["/scene.csplat"] = bytes(reversed(data))[:size]
        with pytest.raises(StoreError, match=r"/scene\.csplat has changed while it was read: open it again"):
            file.read(tiles=[5])


def test_errors_of_a_server_contain_no_secrets(web):
    address = web.url.replace("://", "://somebody:password@").replace("scene", "other") + "?key=secret"
    for web.files["/other.csplat?key=secret"], error in (
        (404, FileNotFoundError), (403, PermissionError), (500, StoreError),
    ):  # fmt: skip
        with pytest.raises(error, match=r"other\.csplat") as raised:
            csplat.open(address)
        assert not re.search("secret|password", str(raised.value))


def test_other_file_systems_of_fsspec_are_used(data, box, tmp_path):
    (tmp_path / "scene.csplat").write_bytes(data)
    fsspec.filesystem("memory").pipe("/scene.csplat", data)
    for url in ("memory://scene.csplat", f"file://{tmp_path}/scene.csplat"):
        with csplat.open(url) as file:
            assert_part(file, data, box)


def test_parts_are_read_from_s3(data, box):
    pytest.importorskip("moto", reason="an S3 requires the extra [remote-tests]")
    with s3({"scene.csplat": data}) as storage:
        with csplat.open("s3://scenes/scene.csplat", storage=storage) as file:
            assert 65536 == file.bytes_read
            assert_part(file, data, box)
            stream = io.BytesIO()
            part = csplat.extract(file, box, stream)
            file._store._fs.pipe("scenes/scene.csplat", bytes(reversed(data)))
            with pytest.raises(StoreError, match="has changed while it was read"):
                file.read(tiles=[5])
            file._store._fs.rm("scenes/scene.csplat")
            with pytest.raises(FileNotFoundError, match=r"s3://scenes/scene\.csplat"):
                file.read(tiles=[5])
        assert part.splat_count == len(decode(stream.getvalue()))
        with pytest.raises(FileNotFoundError, match="s3://scenes/absent"):
            csplat.open("s3://scenes/absent", storage=storage)

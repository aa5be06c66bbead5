# SPDX-License-Identifier: Apache-2.0
"""`csplat view`: answers and refusals of its server, and the end of the command.

Also: csplat_tools.cli.view.
"""

import http.client
import json
import os
import re
import signal
import socket
import subprocess
import sys
import threading
from contextlib import contextmanager
from urllib.parse import parse_qs, urlsplit

import numpy as np
import pytest
import typer
from checked import cloud
from chromium import ViewerPage
from command_line import call

from csplat import FormatError, InputError, decode, encode, write_ply
from csplat.ply import read_ply
from csplat_tools.cli.shared_options import parse_axes, parse_overrides, parse_up
from csplat_tools.present.viewer_page import web_files
from csplat_tools.present.viewer_server import byte_range, open_server, open_viewer_scene, page_parameters


@pytest.fixture
def scene_path(tmp_path):
    path = tmp_path / "a scene.csplat"
    path.write_bytes(encode(cloud(np.random.default_rng(0).standard_normal((200, 3)))))
    return path


@contextmanager
def served(path, **options):
    with open_viewer_scene(str(path), preset="fast") as scene, open_server(scene, **options) as server:
        thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.02})
        thread.start()
        try:
            yield server
        finally:
            server.shutdown()
            thread.join()


def ask(server, path, method="GET", **headers):
    connection = http.client.HTTPConnection(*server.server_address[:2], timeout=10)
    try:
        connection.request(method, path, headers={name.replace("_", "-"): value for name, value in headers.items()})
        response = connection.getresponse()
        return response.status, dict(response.getheaders()), response.read()
    finally:
        connection.close()


#: What is asked of 1,000 bytes, and the start and size of the answer.
RANGES = {
    None: None, "bytes=0-0": (0, 1), "bytes=10-19": (10, 10), "bytes=990-": (990, 10), "bytes=-10": (990, 10),
    "bytes=-5000": (0, 1000), "bytes=999-5000": (999, 1), "BYTES=0-9": (0, 10), "bytes= 0-9 ": (0, 10),
    "bytes=9-3": None, "bytes=-": None, "bytes=a-b": None, "bytes=0 - 9": None, "bytes=--1": None, "items=0-1": None,
    "bytes=0-1,5-6": None,  # several ranges may be answered with everything
    "bytes=\u0661-2": None,  # a digit, but none of ASCII
    "bytes=0-" + "9" * 5000: (0, 1000), "bytes=-" + "9" * 5000: (0, 1000),
    "bytes=" + "0" * 5000 + "7-9": (7, 3), "bytes=" + "9" * 5000 + "-5": None,
    "Bytes=990-99999999999999999999999999": (990, 10),
}  # fmt: skip


def test_ranges():
    assert RANGES == {header: byte_range(header, 1000) for header in RANGES}
    for header, size in (("bytes=1000-", 1000), ("bytes=-0", 1000), ("bytes=0-0", 0), ("bytes=-5", 0)):
        with pytest.raises(ValueError, match="range"):
            byte_range(header, size)


def test_the_root_leads_to_the_page_and_the_page_to_scene_and_cameras(tmp_path, scene_path):
    entry = {"K": [[500, 0, 320], [0, 500, 240], [0, 0, 1]], "viewmat": np.eye(4).tolist(), "W": 640, "H": 480}
    (tmp_path / "cameras.json").write_text(json.dumps([entry, entry]))
    wishes = {"axes": "RDF", **page_parameters(str(tmp_path / "cameras.json"))}
    with served(scene_path, wishes=wishes) as server:
        status, headers, _ = ask(server, "/")
        query = parse_qs(urlsplit(headers["Location"]).query)
        assert (302, ["RDF"]) == (status, query["axes"])
        places = (headers["Location"], query["scene"][0], query["camera"][0])
        page, scene, cameras = (ask(server, place) for place in places)
    assert (200, "text/html; charset=utf-8") == (page[0], page[1]["Content-Type"])
    assert (200, "model/vnd.csplat", scene_path.read_bytes()) == (scene[0], scene[1]["Content-Type"], scene[2])
    assert (200, "application/json") == (cameras[0], cameras[1]["Content-Type"])
    assert [500.0, 500.0] == [one["K"][0][0] for one in json.loads(cameras[2])]


def test_ranges_of_the_scene_and_its_tag(scene_path, make_model):
    data, path = scene_path.read_bytes(), "/scene/a%20scene.csplat"
    size = len(data)
    with served(scene_path) as server:
        status, headers, body = ask(server, path)
        assert (200, "bytes", data) == (status, headers["Accept-Ranges"], body)
        etag = headers["ETag"]
        for asked, expected, place in (("64-163", data[64:164], "64-163"), ("-7", data[-7:], f"{size - 7}-{size - 1}")):
            for method, content in (("GET", expected), ("HEAD", b"")):
                status, headers, body = ask(server, path, method, Range=f"bytes={asked}")
                assert (206, content, f"bytes {place}/{size}") == (status, body, headers["Content-Range"])
                assert str(len(expected)) == headers["Content-Length"]
        status, headers, body = ask(server, path, Range=f"bytes={size}-")
        assert (416, f"bytes */{size}", b"") == (status, headers["Content-Range"], body)
        assert 206 == ask(server, path, Range="bytes=0-9", If_Range=etag)[0]
        assert (200, data) == ask(server, path, Range="bytes=0-9", If_Range='"another"')[::2]
        assert (404, b"") == ask(server, "/nothing", "HEAD")[::2]
        scene_path.write_bytes(encode(make_model(50)))
        assert etag != ask(server, path, "HEAD")[1]["ETag"]
        scene_path.unlink()
        assert 404 == ask(server, path)[0]


ELSEWHERE = [
    "/scene/", "/scene/other.csplat", "/scene/../secret.txt", "/scene/..%2fsecret.txt", "/scene/%2e%2e/secret.txt",
    "/tools/viewer/", "/tools/viewer/../../../secret.txt", "/tools/viewer/..%5c..%5csecret.txt", "//etc/passwd",
    "/etc/passwd", "/codec/js/package.json", "/codec/js/test/adapter.mjs", "/tools/viewer/main.mjs%00.html", "/%",
]  # fmt: skip


@pytest.mark.slow
def test_modules_of_the_page_are_served_as_javascript_and_other_paths_are_not_served(scene_path):
    (scene_path.parent / "secret.txt").write_text("secret")
    with served(scene_path) as server:
        for name, path in web_files().items():
            status, headers, body = ask(server, f"/{name}")
            assert (200, path.read_bytes()) == (status, body)
            assert path.suffix != ".mjs" or headers["Content-Type"].startswith("text/javascript")
        answers = {path: ask(server, path) for path in ELSEWHERE}
    assert {"tools/viewer/main.mjs", "tools/viewer/worker.mjs", "codec/js/decoder.mjs"} <= set(web_files())
    assert not [name for name in web_files() if "test" in name or "node_modules" in name]
    assert dict.fromkeys(ELSEWHERE, 404) == {path: status for path, (status, _, _) in answers.items()}
    assert [] == [path for path, (_, _, body) in answers.items() if b"secret" in body]


ANYWHERE = "0.0.0.0"  # noqa: S104  # the documented value of --host
GOOD = [
    "localhost", "LOCALHOST:80", "localhost.", "localhost:", "127.0.0.1:9", "127.0.0.2", "[::1]", "[::1]:80",
    "192.0.2.1",
]  # fmt: skip


BAD = [
    "evil.example", "EVIL.example:80", "127.0.0.1.evil.example", "localhost.evil.example", "evil.example.", "[evil]",
    "user@localhost", "localhost:80:80", "x[::1]", "evil.example:80]", "localhost\t.evil.example", "127.0.0.1..",
    "[::1", "",
]  # fmt: skip


@pytest.mark.slow
def test_the_bound_address_decides_which_hosts_are_served(scene_path):
    own, served_at = socket.gethostname(), []
    for place in ("127.1", "LOCALHOST", "0:0:0:0:0:0:0:1", "::ffff:127.0.0.1", ANYWHERE):
        good, bad = ([*GOOD, own, f"{own}.local:80"], BAD) if place == ANYWHERE else (GOOD, [*BAD, own])
        try:
            with served(scene_path, host=place) as server:
                found = {host: ask(server, "/", Host=host)[0] for host in (*good, *bad)}
        except InputError:  # a system without IPv6, or without /etc/hosts
            continue
        assert dict.fromkeys(good, 302) | dict.fromkeys(bad, 421) == found, place
        served_at.append(place)
    assert {"127.1", ANYWHERE} <= set(served_at)


def test_addresses_that_cannot_be_served_are_refused(scene_path):
    with socket.socket() as other, open_viewer_scene(str(scene_path), preset="fast") as scene:
        other.bind(("127.0.0.1", 0))
        other.listen()
        port = other.getsockname()[1]
        for place, message in (
            ({"port": port}, f"port {port} is in use"), ({"host": " \t"}, "is empty"),
            ({"host": "203.0.113.1"}, r"203\.0\.113\.1 is not an address of this machine"),
            ({"host": "a" * 300}, "not an address"), ({"host": " 127.0.0.1"}, "not an address"),
        ):  # fmt: skip
            with pytest.raises(InputError, match=message), open_server(scene, **place):
                pass


def exchange(server, data):
    """Send bytes, and return all that is answered until the server closes the connection."""
    with socket.create_connection(server.server_address[:2], timeout=10) as connection:
        connection.sendall(data)
        return b"".join(iter(lambda: connection.recv(1 << 16), b""))


def test_every_request_gets_one_answer_with_a_status(scene_path):
    head, get = b"Host: localhost\r\nConnection: close\r\n", b"GET / HTTP/1.1\r\n"
    follower = get + head + b"\r\n"
    lines = {  # the first line of a request whose heads are complete
        b"GET http://[ HTTP/1.1": 400, b"GET //[ HTTP/1.1": 404, b"GET * HTTP/1.1": 400,
        b"GET viewer.html HTTP/1.1": 400, b"GET ftp://localhost/ HTTP/1.1": 400,
        b"GET http://localhost/ HTTP/1.1": 302, b"GET http://evil.example/ HTTP/1.1": 421,
        b"GET https://user@localhost/ HTTP/1.1": 421, b"GET /%00 HTTP/1.1": 404,
        b"GET /\xff\xfe HTTP/1.1": 404, b"GET /%ff HTTP/1.1": 404,
        b"GET / HTTP/9.9": 505, b"GET / HTTP/x": 400, b"GET / there HTTP/1.1": 400, b"get / HTTP/1.1": 501,
        b"PROPFIND / HTTP/1.1": 501, b"GET /" + b"a" * 70_000 + b" HTTP/1.1": 414,
    }  # fmt: skip
    heads = {
        get + b"Connection: close\r\n": 400, b"GET / HTTP/1.0\r\n": 421, get + b"Host: localhost\r\n" + head: 400,
        b"GET /\r\n": 400, b"GET\r\n": 400, get + head + b"X: " + b"a" * 70_000 + b"\r\n": 431,
        get + head + b"X: a\r\n" * 300: 431, get + head + b"Expect: 100-continue\r\nContent-Length: 5\r\n": 302,
    }  # fmt: skip
    bodies = {
        b"Content-Length: %d\r\n\r\n" % len(follower) + follower: 404,
        b"Transfer-Encoding: chunked\r\n\r\n0\r\n\r\n" + follower: 404,
        b"Content-Length: 5\r\nTransfer-Encoding: chunked\r\n\r\n0\r\n\r\n" + follower: 404,
        b"Content-Length: nonsense\r\n\r\n" + follower: 404,
        b"Content-Length: 200000\r\n\r\n" + bytes(200_000): 404,
        b"Content-Length: 0\r\n\r\n" + follower: (404, 302),  # no body: the connection stays open
    }
    requests = {line + b"\r\n" + head + b"\r\n": status for line, status in lines.items()}
    requests |= {words + b"\r\n": status for words, status in heads.items()}
    requests |= {b"GET /nothing HTTP/1.1\r\nHost: localhost\r\n" + rest: status for rest, status in bodies.items()}
    with served(scene_path) as server:
        for request, status in requests.items():
            found = tuple(map(int, re.findall(rb"HTTP/1\.1 (\d+) ", exchange(server, request))))
            assert (status if isinstance(status, tuple) else (status,)) == found, request[:80]


@pytest.mark.slow
def test_a_ply_of_any_name_is_encoded_in_memory(tmp_path, make_model):
    for name in ("scene.ply", "scene.csplat"):
        write_ply(tmp_path / name, make_model(300))
        with served(tmp_path / name) as server:
            assert 300 == len(decode(ask(server, "/scene/scene.csplat")[2]))
            assert 206 == ask(server, "/scene/scene.csplat", Range="bytes=0-63")[0]
    assert ["scene.csplat", "scene.ply"] == sorted(path.name for path in tmp_path.iterdir())


def test_the_page_receives_the_given_up_direction_and_invalid_ones_are_refused():
    for words, wishes in (
        ({"up": None, "axes": "RFU"}, {"axes": "RFU"}), ({"up": "+Z"}, {"up": "0,0,1"}),
        ({"up": "0,-2,0.2", "axes": "RDF"}, {"up": "0,-0.995037,0.099504", "axes": "RDF"}),
    ):  # fmt: skip
        assert wishes == page_parameters(None, parse_overrides(**words))
    for parse, message, texts in (
        (parse_axes, "expected three letters", ("RL", "RDX", "RUD", "rdf", "RDFF")),
        (parse_up, "three numbers as", ("", "w", "+-y", "0,0", "0,0,0", "0,nan,1", "x y z")),
    ):
        for text in texts:
            with pytest.raises(typer.BadParameter, match=message):
                parse(text)


def test_damaged_files_and_other_formats_are_refused_before_they_are_served(scene_path):
    data, text = scene_path.read_bytes(), scene_path.with_suffix(".txt")
    text.write_text("no scene")
    for damaged, message in (
        (data[:-1], "E_TRUNCATED"), (data[:20], "E_TRUNCATED"), (b"", "E_TRUNCATED"), (data + b"x", "E_TRAILING"),
        (data[:100] + bytes([data[100] ^ 1]) + data[101:], "E_CRC"), (b"\0" + data[1:], "E_MAGIC"),
    ):  # fmt: skip
        scene_path.write_bytes(damaged)
        with pytest.raises(FormatError, match=message), open_viewer_scene(str(scene_path), preset="fast"):
            pass
    with pytest.raises(InputError, match="no format that csplat knows"), open_viewer_scene(str(text), preset="fast"):
        pass


@pytest.mark.slow
def test_the_page_runs_from_the_server(tab, site, tmp_path, make_model):
    write_ply(tmp_path / "a & b.ply", make_model(200, 1))
    viewer = ViewerPage(tab, site)
    with served(tmp_path / "a & b.ply", wishes={"axes": "RFU"}) as server:
        viewer.visit(server.url)
        assert "a & b.csplat" == viewer.text("#title")
        assert "200 splats" in viewer.text("#summary")
        assert [0, 0, 1] == viewer.pose["up"]
        tab.page.goto("about:blank")  # hangs up, so that the server can end


@pytest.mark.slow
def test_the_command_prints_the_address_and_ends_with_status_0(sample_path):
    line, pipe = [sys.executable, "-m", "csplat_tools", "view", str(sample_path), "--no-browser"], subprocess.PIPE
    streams = {"stdin": subprocess.DEVNULL, "stdout": pipe, "stderr": pipe, "text": True}
    environment = {**os.environ, "PYTHONUNBUFFERED": "1"}
    with subprocess.Popen(line, **streams, env=environment) as process:
        try:
            url = process.stdout.readline().strip()
            assert re.fullmatch(r"http://127\.0\.0\.1:\d+/", url)
            connection = http.client.HTTPConnection(urlsplit(url).netloc, timeout=10)
            connection.request("GET", "/scene/sample.csplat")
            assert len(read_ply(sample_path)) == len(decode(connection.getresponse().read()))
            process.send_signal(signal.SIGINT)  # while the connection is still open
            assert 0 == process.wait(timeout=10)
            connection.close()
            said = process.stderr.read()
        finally:
            process.kill()
    found = [text in said for text in ("encoded with the preset fast", "Ctrl-C", "Traceback")]
    assert [True, True, False] == found, said
    for words, status, message in (
        (["absent.csplat"], 1, "No such file"), ([sample_path, "--up", "w"], 2, "up is 'w'"),
        ([sample_path, "--cameras", "absent.json"], 1, "absent.json"),
    ):  # fmt: skip
        done = call("view", *words, "--no-browser", status=status)
        assert "" == done.stdout
        assert message in " ".join(done.stderr.split())

"""`csplat view`: answers and refusals of its server, and the end of the command."""

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
from chromium import ViewerPage
from command_line import heed_interrupts, invoke

from csplat import decode, encode, read_ply, write_ply
from csplat.errors import FormatError, InputError
from csplat_tools.cli.shared_options import parse_axes, parse_overrides, parse_up
from csplat_tools.present.viewer_page import web_files
from csplat_tools.present.viewer_server import byte_range, open_server, open_viewer_scene, page_parameters

SIZE = 1000


@pytest.fixture
def scene_path(tmp_path, make_model):
    path = tmp_path / "a scene.csplat"
    path.write_bytes(encode(make_model(200)))
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
    connection = http.client.HTTPConnection("127.0.0.1", server.server_address[1], timeout=10)
    try:
        connection.request(method, path, headers={name.replace("_", "-"): value for name, value in headers.items()})
        response = connection.getresponse()
        return response.status, dict(response.getheaders()), response.read()
    finally:
        connection.close()


RANGES = {
    None: None,
    "bytes=0-0": (0, 1),
    "bytes=10-19": (10, 10),
    "bytes=990-": (990, 10),
    "bytes=-10": (990, 10),
    "bytes=-5000": (0, 1000),
    "bytes=999-5000": (999, 1),
    "BYTES=0-9": (0, 10),
    "bytes=9-3": None,  # a range that makes no sense is no range
    "bytes=-": None,
    "bytes=a-b": None,
    "bytes=0-1,5-6": None,  # several ranges may be answered with everything
    "items=0-1": None,
    "bytes=\u0661-2": None,  # a digit, but none of ASCII
    "bytes= 0-9 ": (0, 10),
    "bytes=0 - 9": None,
    "bytes=0-" + "9" * 5000: (0, 1000),
    "bytes=-" + "9" * 5000: (0, 1000),
    "bytes=" + "0" * 5000 + "7-9": (7, 3),
    "bytes=" + "9" * 5000 + "-5": None,
    "bytes=--1": None,
    "Bytes=990-99999999999999999999999999": (990, 10),
}


def test_ranges():
    assert RANGES == {header: byte_range(header, SIZE) for header in RANGES}


@pytest.mark.parametrize(
    ("header", "size"), [("bytes=1000-", SIZE), ("bytes=-0", SIZE), ("bytes=0-0", 0), ("bytes=-5", 0)]
)
def test_ranges_beyond_the_end_are_refused(header, size):
    with pytest.raises(ValueError, match="range"):
        byte_range(header, size)


def test_the_root_leads_to_the_page_and_the_page_to_the_scene(scene_path):
    with served(scene_path, wishes={"axes": "RDF"}) as server:
        status, headers, _ = ask(server, "/")
        assert 302 == status
        target = urlsplit(headers["Location"])
        query = parse_qs(target.query)
        assert ["RDF"] == query["axes"]
        assert (200, "text/html; charset=utf-8") == pick(ask(server, headers["Location"]))
        status, headers, body = ask(server, query["scene"][0])
        assert (200, "model/vnd.csplat") == (status, headers["Content-Type"])
        assert scene_path.read_bytes() == body


def pick(answer):
    status, headers, _ = answer
    return status, headers.get("Content-Type")


def test_every_module_of_the_page_is_served_as_javascript(scene_path):
    with served(scene_path) as server:
        for name, path in web_files().items():
            status, headers, body = ask(server, f"/{name}")
            assert (200, path.read_bytes()) == (status, body)
            if path.suffix == ".mjs":
                assert headers["Content-Type"].startswith("text/javascript")
        assert {"tools/viewer/main.mjs", "tools/viewer/worker.mjs", "codec/js/decoder.mjs"} <= set(web_files())
        assert not [name for name in web_files() if "test" in name or "node_modules" in name]


def test_ranges_of_the_scene(scene_path):
    data = scene_path.read_bytes()
    with served(scene_path) as server:
        path = "/scene/a%20scene.csplat"
        status, headers, body = ask(server, path, Range="bytes=64-163")
        assert (206, data[64:164]) == (status, body)
        assert f"bytes 64-163/{len(data)}" == headers["Content-Range"]
        assert "100" == headers["Content-Length"]
        status, headers, body = ask(server, path, Range="bytes=-7")
        assert (206, data[-7:]) == (status, body)
        status, headers, body = ask(server, path, Range=f"bytes={len(data)}-")
        assert (416, f"bytes */{len(data)}", b"") == (status, headers["Content-Range"], body)
        status, headers, body = ask(server, path)
        assert (200, "bytes", data) == (status, headers["Accept-Ranges"], body)
        etag = headers["ETag"]
        assert 206 == ask(server, path, Range="bytes=0-9", If_Range=etag)[0]
        assert (200, data) == ask(server, path, Range="bytes=0-9", If_Range='"another"')[::2]


def test_head_gives_headers_alone(scene_path):
    size = scene_path.stat().st_size
    with served(scene_path) as server:
        status, headers, body = ask(server, "/scene/a%20scene.csplat", "HEAD")
        assert (200, str(size), b"") == (status, headers["Content-Length"], body)
        status, headers, body = ask(server, "/scene/a%20scene.csplat", "HEAD", Range="bytes=5-9")
        assert (206, "5", b"") == (status, headers["Content-Length"], body)
        assert (404, b"") == ask(server, "/nothing", "HEAD")[::2]


def test_a_file_that_changes_has_another_tag(scene_path, make_model):
    with served(scene_path) as server:
        before = ask(server, "/scene/a%20scene.csplat", "HEAD")[1]["ETag"]
        scene_path.write_bytes(encode(make_model(50)))
        assert before != ask(server, "/scene/a%20scene.csplat", "HEAD")[1]["ETag"]
        scene_path.unlink()
        assert 404 == ask(server, "/scene/a%20scene.csplat")[0]


ELSEWHERE = [
    "/scene/", "/scene/other.csplat", "/scene/../secret.txt", "/scene/..%2fsecret.txt", "/scene/%2e%2e/secret.txt",
    "/tools/viewer/", "/tools/viewer/../../../secret.txt", "/tools/viewer/..%5c..%5csecret.txt", "//etc/passwd",
    "/etc/passwd", "/codec/js/package.json", "/codec/js/test/adapter.mjs", "/tools/viewer/main.mjs%00.html", "/%",
]  # fmt: skip


def test_other_paths_are_not_served(scene_path):
    (scene_path.parent / "secret.txt").write_text("secret")
    with served(scene_path) as server:
        answers = {path: ask(server, path) for path in ELSEWHERE}
    assert dict.fromkeys(ELSEWHERE, 404) == {path: status for path, (status, _, _) in answers.items()}
    assert [] == [path for path, (_, _, body) in answers.items() if b"secret" in body]


def test_another_name_for_this_machine_is_misdirected(scene_path):
    with served(scene_path) as server:
        port = server.server_address[1]
        assert 421 == ask(server, "/", Host="evil.example:80")[0]
        assert 421 == ask(server, "http://evil.example/scene/a%20scene.csplat")[0]
        assert 302 == ask(server, "/", Host=f"localhost:{port}")[0]


LOOPBACK = ["127.0.0.1", "127.0.0.2", "127.1", "LOCALHOST", "localhost", "::1", "0:0:0:0:0:0:0:1", "::ffff:127.0.0.1"]
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


def host_statuses(server, hosts):
    """The statuses of requests for several hosts, on one connection."""
    connection = http.client.HTTPConnection(server.server_address[0], server.server_address[1], timeout=10)
    found = {}
    for host in hosts:
        connection.putrequest("GET", "/", skip_host=True)
        connection.putheader("Host", host)
        connection.endheaders()
        response = connection.getresponse()
        response.read()
        found[host] = response.status
    connection.close()
    return found


def test_the_bound_address_decides_which_hosts_are_served(scene_path):
    own = socket.gethostname()
    with open_viewer_scene(str(scene_path), preset="fast") as scene:
        served_at = []
        for place in (*LOOPBACK, ANYWHERE):
            try:
                server = open_server(scene, host=place)
                opened = server.__enter__()
            except InputError:  # a system without IPv6
                continue
            thread = threading.Thread(target=opened.serve_forever, kwargs={"poll_interval": 0.02})
            thread.start()
            try:
                is_public = place == ANYWHERE
                good = [*GOOD, own, f"{own}.local:80"] if is_public else GOOD
                bad = BAD if is_public else [*BAD, own, "elsewhere.local"]
                assert dict.fromkeys(good, 302) | dict.fromkeys(bad, 421) == host_statuses(opened, [*good, *bad]), place
                served_at.append(place)
            finally:
                opened.shutdown()
                thread.join()
                server.__exit__(None, None, None)
    assert {"127.0.0.1", "LOCALHOST", ANYWHERE} <= set(served_at)


def test_an_empty_host_and_one_that_is_no_name_are_refused(scene_path):
    with open_viewer_scene(str(scene_path), preset="fast") as scene:
        for host, message in (
            ("", "is empty"),
            (" \t", "is empty"),
            ("a" * 300, "not an address"),
            (" 127.0.0.1", "not an address"),
        ):
            with pytest.raises(InputError, match=message), open_server(scene, host=host):
                pass


def exchange(server, data):
    """Send bytes, and return all that is answered until the server closes the connection."""
    with socket.create_connection(server.server_address[:2], timeout=10) as connection:
        connection.sendall(data)
        return b"".join(iter(lambda: connection.recv(1 << 16), b""))


def test_every_request_gets_one_answer_with_a_status(scene_path):
    head = b"Host: localhost\r\nConnection: close\r\n"
    follower = b"GET / HTTP/1.1\r\nHost: localhost\r\nConnection: close\r\n\r\n"
    heads = {
        b"GET http://[ HTTP/1.1\r\n" + head: 400,
        b"GET //[ HTTP/1.1\r\n" + head: 404,
        b"GET * HTTP/1.1\r\n" + head: 400,
        b"GET viewer.html HTTP/1.1\r\n" + head: 400,
        b"GET ftp://localhost/ HTTP/1.1\r\n" + head: 400,
        b"GET http://localhost/ HTTP/1.1\r\n" + head: 302,
        b"GET http://evil.example/ HTTP/1.1\r\n" + head: 421,
        b"GET https://user@localhost/ HTTP/1.1\r\n" + head: 421,
        b"GET /%00 HTTP/1.1\r\n" + head: 404,
        b"GET /\xff\xfe HTTP/1.1\r\n" + head: 404,
        b"GET /%ff HTTP/1.1\r\n" + head: 404,
        b"GET / HTTP/1.1\r\nConnection: close\r\n": 400,
        b"GET / HTTP/1.0\r\n": 421,
        b"GET / HTTP/1.1\r\nHost: localhost\r\n" + head: 400,
        b"GET / HTTP/9.9\r\n" + head: 505,
        b"GET / HTTP/x\r\n" + head: 400,
        b"GET /\r\n": 400,
        b"GET\r\n": 400,
        b"GET / there HTTP/1.1\r\n" + head: 400,
        b"get / HTTP/1.1\r\n" + head: 501,
        b"PROPFIND / HTTP/1.1\r\n" + head: 501,
        b"GET / HTTP/1.1\r\n" + head + b"X: " + b"a" * 70_000 + b"\r\n": 431,
        b"GET / HTTP/1.1\r\n" + head + b"X: a\r\n" * 300: 431,
        b"GET /" + b"a" * 70_000 + b" HTTP/1.1\r\n" + head: 414,
        b"GET / HTTP/1.1\r\n" + head + b"Expect: 100-continue\r\nContent-Length: 5\r\n": 302,
    }
    bodies = {
        b"Content-Length: %d\r\n\r\n" % len(follower) + follower: 404,
        b"Transfer-Encoding: chunked\r\n\r\n0\r\n\r\n" + follower: 404,
        b"Content-Length: 5\r\nTransfer-Encoding: chunked\r\n\r\n0\r\n\r\n" + follower: 404,
        b"Content-Length: nonsense\r\n\r\n" + follower: 404,
        b"Content-Length: 200000\r\n\r\n" + bytes(200_000): 404,
        b"Content-Length: 0\r\n\r\n" + follower: (404, 302),  # no body: the connection stays open
    }
    requests = {words + b"\r\n": status for words, status in heads.items()}
    requests |= {b"GET /nothing HTTP/1.1\r\nHost: localhost\r\n" + rest: status for rest, status in bodies.items()}
    with served(scene_path) as server:
        for request, status in requests.items():
            found = tuple(map(int, re.findall(rb"HTTP/1\.1 (\d+) ", exchange(server, request))))
            assert (status if isinstance(status, tuple) else (status,)) == found, request[:80]


def test_other_methods_are_refused(scene_path):
    with served(scene_path) as server:
        assert 501 == ask(server, "/", "POST")[0]


def test_a_ply_is_encoded_in_memory(tmp_path, make_model):
    model = make_model(300)
    write_ply(tmp_path / "scene.ply", model)
    with served(tmp_path / "scene.ply") as server:
        _, _, body = ask(server, "/scene/scene.csplat")
        assert len(model) == len(decode(body))
        assert 206 == ask(server, "/scene/scene.csplat", Range="bytes=0-63")[0]
    assert ["scene.ply"] == sorted(path.name for path in tmp_path.iterdir())


def test_cameras_are_served_with_the_scene(tmp_path, scene_path):
    entry = {"K": [[500, 0, 320], [0, 500, 240], [0, 0, 1]], "viewmat": np.eye(4).tolist(), "W": 640, "H": 480}
    cameras = tmp_path / "cameras.json"
    cameras.write_text(json.dumps([entry, entry]))
    with served(scene_path, wishes=page_parameters(str(cameras))) as server:
        query = parse_qs(urlsplit(ask(server, "/")[1]["Location"]).query)
        status, headers, body = ask(server, query["camera"][0])
        assert (200, "application/json") == (status, headers["Content-Type"])
        assert [500.0, 500.0] == [one["K"][0][0] for one in json.loads(body)]


def test_invalid_axes_and_directions_are_refused():
    for parse, message, texts in (
        (parse_axes, "expected three letters", ["RL", "RDX", "RUD", "rdf", "RDFF"]),
        (parse_up, "three numbers as", ["", "w", "+-y", "0,0", "0,0,0", "0,nan,1", "x y z"]),
    ):
        for text in texts:
            with pytest.raises(typer.BadParameter, match=message):
                parse(text)


@pytest.mark.parametrize(
    ("words", "wishes"),
    [
        ({"up": None}, {}), ({"up": None, "axes": "RFU"}, {"axes": "RFU"}), ({"up": "-y"}, {"up": "0,-1,0"}),
        ({"up": "+Z"}, {"up": "0,0,1"}),
        ({"up": "0,-2,0.2", "axes": "RDF"}, {"up": "0,-0.995037,0.099504", "axes": "RDF"}),
    ],
)  # fmt: skip
def test_the_page_receives_the_given_up_direction(words, wishes):
    assert wishes == page_parameters(None, parse_overrides(**words))


def refused(path):
    with pytest.raises((FormatError, InputError)) as caught, open_viewer_scene(str(path), preset="fast"):
        pass
    return str(caught.value)


def test_damaged_files_are_refused_before_they_are_served(scene_path):
    data = scene_path.read_bytes()
    scene_path.write_bytes(data[:-1])
    assert "E_TRUNCATED" in refused(scene_path)
    scene_path.write_bytes(data + b"x")
    assert "E_TRAILING" in refused(scene_path)
    scene_path.write_bytes(data[:100] + bytes([data[100] ^ 1]) + data[101:])
    assert "E_CRC" in refused(scene_path)
    scene_path.write_bytes(data[:20])
    assert "E_TRUNCATED" in refused(scene_path)


@pytest.mark.parametrize(("begin", "code"), [(b"", "E_TRUNCATED"), (b"\0", "E_MAGIC")])
def test_a_file_that_is_damaged_from_its_first_byte_is_known_by_its_name(scene_path, begin, code):
    data = scene_path.read_bytes()
    scene_path.write_bytes(begin and begin + data[1:])
    assert code in refused(scene_path)


def test_a_ply_may_have_any_name(tmp_path, make_model):
    path = tmp_path / "scene.csplat"
    write_ply(path, make_model(20, 1))
    with open_viewer_scene(str(path), preset="fast") as scene:
        assert 20 == scene.header.splat_count


def test_another_format_is_refused(tmp_path):
    path = tmp_path / "scene.txt"
    path.write_text("no scene")
    assert "no format that csplat knows" in refused(path)


def test_a_port_in_use_and_an_address_of_another_machine_are_refused(scene_path):
    with socket.socket() as other, open_viewer_scene(str(scene_path), preset="fast") as scene:
        other.bind(("127.0.0.1", 0))
        other.listen()
        port = other.getsockname()[1]
        elsewhere = r"203\.0\.113\.1 is not an address of this machine"
        for place, message in (({"port": port}, f"port {port} is in use"), ({"host": "203.0.113.1"}, elsewhere)):
            with pytest.raises(InputError, match=message), open_server(scene, **place):
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


@contextmanager
def command(*words):
    environment = {**os.environ, "PYTHONUNBUFFERED": "1"}
    streams = {"stdin": subprocess.DEVNULL, "stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    command = [sys.executable, "-m", "csplat_tools", "view", *map(str, words)]
    process = subprocess.Popen(command, **streams, env=environment, preexec_fn=heed_interrupts)  # noqa: PLW1509
    with process:
        try:
            yield process
        finally:
            process.kill()


@pytest.mark.slow
def test_the_command_prints_the_address_and_ends_with_status_0(sample_path):
    with command(sample_path, "--no-browser") as process:
        url = process.stdout.readline().strip()
        assert re.fullmatch(r"http://127\.0\.0\.1:\d+/", url)
        connection = http.client.HTTPConnection(urlsplit(url).netloc, timeout=10)
        connection.request("GET", "/scene/sample.csplat")
        assert len(read_ply(sample_path)) == len(decode(connection.getresponse().read()))
        process.send_signal(signal.SIGINT)  # while the connection is still open
        assert 0 == process.wait(timeout=10)
        connection.close()
        said = process.stderr.read()
    assert "encoded with the preset fast" in said
    assert "Ctrl-C" in said
    assert "Traceback" not in said


@pytest.mark.parametrize(
    ("words", "status", "expected"),
    [
        (["absent.csplat"], 1, "No such file"),
        (["SAMPLE", "--preset", "tiny"], 2, "--preset is an option of `csplat encode`"),
        (["SAMPLE", "--up", "w"], 2, "up is 'w'"),
        (["SAMPLE", "--cameras", "absent.json"], 1, "absent.json"),
        (["SAMPLE", "--port", "70000"], 2, "65535"),
    ],
)
def test_errors_of_the_command_are_reported(sample_path, words, status, expected):
    given = [str(sample_path) if word == "SAMPLE" else word for word in words]
    done = invoke("view", *given, "--no-browser")
    assert (status, "") == (done.exit_code, done.stdout)
    assert expected in " ".join(done.stderr.split())

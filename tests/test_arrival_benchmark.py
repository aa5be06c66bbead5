"""`csplat_bench.viewer.arrival`: what the slow line gives and how fast, and which picture is which."""

import threading
import time
from http.client import HTTPConnection

import numpy as np
import pytest

from csplat_bench.viewer.arrival import Watched
from csplat_bench.viewer.line import Line

pytestmark = pytest.mark.area(name="benchmarks")

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

# SPDX-License-Identifier: Apache-2.0
"""The viewer in Chromium, Firefox and WebKit: seconds from the address to a complete frame.

A case has a `browser` and a `place`: view (`csplat view`), folder or http (an exported page). Another file that is then
opened, and the scene's own with another up axis, must come right as well, else the case fails. Requires playwright;
firefox-esr; WebKitWebDriver with MiniBrowser (Debian: webkit2gtk-driver); xvfb-run.
"""

from __future__ import annotations

import base64
import json
import os
import shutil
import signal
import socket
import subprocess
import tempfile
import threading
import time
import urllib.error
import urllib.request
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, ExitStack, contextmanager
from pathlib import Path
from typing import Any

from csplat.decoder import decode
from csplat.encode_api import encode
from csplat.encoder import EncodeOptions
from csplat.ply import read_ply
from csplat_bench.browser import open_page, serve
from csplat_bench.protocol import AbsentError, Measure, Setup
from csplat_bench.scenes import find_scene
from csplat_bench.suites import Case
from csplat_tools.present.viewer_page import export_page
from csplat_tools.present.viewer_server import open_server, open_viewer_scene

_TIMEOUT_SECONDS = 600.0
_SCREEN = ["xvfb-run", "--auto-servernum", "--server-args=-screen 0 1280x1024x24"]

#: Version of a browser; opens an address; runs the body of an async function in the page.
Drive = tuple[str, Callable[[str], Any], Callable[[str], Any]]

_READY = """
while (!window.csplatViewer) await new Promise((resolve) => setTimeout(resolve, 20));
await csplatViewer.ready;
const error = document.getElementById('error');
return error.hidden ? csplatViewer.engine.stats.splatsDrawn : document.getElementById('error-facts').textContent;"""
# Opens a file as the file picker does, then asks for the same with +z up.
_OTHER = """
const bytes = Uint8Array.from(atob(%s), (letter) => letter.charCodeAt(0));
await csplatViewer.show(new File([bytes], 'other.csplat'), 'other.csplat');
const written = await csplatViewer.engine.fileWith({ up: [0, 0, 1] });
return btoa(Array.from(written, (byte) => String.fromCharCode(byte)).join(''));"""
_ASYNC = "const done = arguments[arguments.length - 1]; (async () => {%s})().then(done, (e) => done('failed: ' + e));"


@contextmanager
def measure_browsers(setup: Setup, name: str, _: Sequence[Case]) -> Iterator[Measure]:
    """Yield the function that opens a file in a browser; browsers stay open."""
    scene = find_scene(name, setup.data, setup.work)
    path = setup.work / f"{scene.name}.browsers.csplat"
    path.write_bytes(encode(read_ply(scene.path), EncodeOptions(preset="balanced")))
    with ExitStack() as stack:
        addresses = stack.enter_context(_serve_pages(path))
        drives: dict[str, Drive] = {}

        def measure(case: Case) -> Mapping[str, Any]:
            if case["browser"] not in drives:
                drives[case["browser"]] = stack.enter_context(_BROWSERS[case["browser"]](setup.chromium))
            version, go, ask = drives[case["browser"]]
            seconds = _open_once(addresses[case["place"]], path.read_bytes(), go, ask)
            return {"splats": scene.splat_count, "version": version, "seconds": seconds}

        yield measure


def _open_once(url: str, data: bytes, go: Callable[[str], Any], ask: Callable[[str], Any]) -> float:
    """Open the scene, then another file; return the seconds from the address to a complete frame.

    Raises:
        OSError: the viewer shows an error, or the file that it writes is not right.
    """
    count = len(decode(data))
    go("about:blank")
    began = time.monotonic()
    go(url)
    drawn = ask(_READY)
    seconds = time.monotonic() - began
    if not isinstance(drawn, int) or not 0 < drawn <= count:
        raise OSError(str(drawn))
    text = ask(_OTHER % json.dumps(base64.b64encode(data).decode()))
    try:
        kept = decode(base64.b64decode(text, validate=True))
    except ValueError:
        raise OSError(str(text)) from None
    if kept.metadata.entries["up"] != [0, 0, 1] or len(kept) != count:
        raise OSError("the file with another up axis is not that of the scene")
    return seconds


@contextmanager
def _serve_pages(source: Path) -> Iterator[dict[str, str]]:
    """Yield the addresses at which the scene can be opened, by name."""
    with tempfile.TemporaryDirectory() as folder, open_viewer_scene(str(source), preset="fast") as scene:
        page = Path(folder, "page.html")
        page.write_bytes(export_page(scene.read(), scene.name).page)
        with open_server(scene) as server, serve(folder) as address:
            threading.Thread(target=server.serve_forever, daemon=True).start()
            yield {"view": server.url, "folder": page.as_uri(), "http": f"{address}page.html"}
            server.shutdown()


@contextmanager
def _chromium(program: str) -> Iterator[Drive]:
    with open_page(program, gpu=False) as page:
        yield page.context.browser.version, page.goto, lambda body: page.evaluate(f"async () => {{{body}}}")


@contextmanager
def _firefox(_: str) -> Iterator[Drive]:
    """Drive Firefox by Marionette: `LENGTH:[0, id, command, values]`, answered by `LENGTH:[1, id, error, result]`."""
    port = _free_port()
    with tempfile.TemporaryDirectory() as profile:
        Path(profile, "user.js").write_text(
            f'user_pref("marionette.port", {port});\nuser_pref("webgl.force-enabled", true);\n', encoding="utf-8"
        )
        words = ["firefox-esr", "--marionette", "--no-remote", "--profile", profile]
        with _start(words), _connect(port) as wire, wire.makefile("rb") as answers:

            def answer() -> Any:
                length = b"".join(iter(lambda: answers.read(1), b":"))
                return json.loads(answers.read(int(length)))

            def call(command: str, **parameters: Any) -> Any:
                message = json.dumps([0, 0, f"WebDriver:{command}", parameters]).encode()
                wire.sendall(b"%d:%s" % (len(message), message))
                _, _, error, result = answer()
                if error is not None:
                    raise OSError(f"firefox: {error['message']}")
                return result

            answer()  # the greeting of the driver
            version = call("NewSession")["capabilities"]["browserVersion"]
            call("SetTimeouts", script=1000 * _TIMEOUT_SECONDS, pageLoad=1000 * _TIMEOUT_SECONDS)
            yield (
                version,
                lambda url: call("Navigate", url=url),
                lambda body: call("ExecuteAsyncScript", script=_ASYNC % body, args=[], sandbox=None)["value"],
            )


@contextmanager
def _webkit(_: str) -> Iterator[Drive]:
    """Drive WebKit by WebDriver (W3C)."""
    browsers = sorted(Path("/usr/lib").glob("*/webkit2gtk-*/MiniBrowser"))
    if not browsers:
        raise AbsentError("WebKit's MiniBrowser is not installed: on Debian it comes with webkit2gtk-driver")
    port = _free_port()

    def call(path: str, **parameters: Any) -> Any:
        body = json.dumps(parameters).encode()
        request = urllib.request.Request(f"http://127.0.0.1:{port}/session{path}", body)
        try:
            with urllib.request.urlopen(request, timeout=_TIMEOUT_SECONDS) as response:  # noqa: S310  # http
                return json.load(response)["value"]
        except urllib.error.HTTPError as error:
            raise OSError(f"webkit: {error.read().decode()}") from None

    options = {"binary": str(browsers[-1]), "args": ["--automation"]}
    # As root there is no sandbox; only our own pages are opened.
    with _start(["WebKitWebDriver", f"--port={port}"], WEBKIT_DISABLE_SANDBOX_THIS_IS_DANGEROUS="1"):
        with _connect(port):
            pass
        session = call("", capabilities={"alwaysMatch": {"webkitgtk:browserOptions": options}})
        at = f"/{session['sessionId']}"
        call(f"{at}/timeouts", script=1000 * _TIMEOUT_SECONDS, pageLoad=1000 * _TIMEOUT_SECONDS)
        yield (
            session["capabilities"]["browserVersion"],
            lambda url: call(f"{at}/url", url=url),
            lambda body: call(f"{at}/execute/async", script=_ASYNC % body, args=[]),
        )


_BROWSERS: dict[str, Callable[[str], AbstractContextManager[Drive]]] = {
    "chromium": _chromium, "firefox": _firefox, "webkit": _webkit,
}  # fmt: skip


@contextmanager
def _start(words: list[str], **environment: str) -> Iterator[None]:
    """Run a program on a virtual screen; end it and its children."""
    for program in (_SCREEN[0], words[0]):
        if shutil.which(program) is None:
            raise AbsentError(f"{program} is not installed")
    process = subprocess.Popen(
        [*_SCREEN, *words], env={**os.environ, **environment}, start_new_session=True,
        stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
    )  # fmt: skip
    try:
        yield
    finally:
        os.killpg(process.pid, signal.SIGTERM)
        process.wait()


def _connect(port: int) -> socket.socket:
    """Connect to a program as soon as it listens."""
    end = time.monotonic() + 60.0
    while True:
        try:
            return socket.create_connection(("127.0.0.1", port))
        except ConnectionRefusedError:
            if time.monotonic() > end:
                raise
            time.sleep(0.1)


def _free_port() -> int:
    with socket.socket() as found:
        found.bind(("127.0.0.1", 0))
        port: int = found.getsockname()[1]
        return port

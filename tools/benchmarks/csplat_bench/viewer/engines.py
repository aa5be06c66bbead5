"""Open the viewer in the engines of Chrome, Firefox and Safari: as `csplat view` serves it, exported, from a folder.

    python -m csplat_bench.viewer.engines scene.csplat
    python -m csplat_bench.viewer.engines scene.csplat --engines webkit --runs 1

Prints how long each takes from the address to a scene that is drawn whole, and reports failures: a file that is
opened then, and the scene's own with another way up, have to come right as well. Status 1 if something does not.
Requires Chromium and playwright; firefox-esr; WebKitWebDriver with MiniBrowser (Debian: webkit2gtk-driver); xvfb-run.
"""

from __future__ import annotations

import base64
import json
import os
import shutil
import signal
import socket
import statistics
import subprocess
import sys
import tempfile
import threading
import time
import urllib.error
import urllib.request
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path
from typing import Annotated, Any

import typer

from csplat.decoder import decode
from csplat.errors import InputError
from csplat_bench.common.browser import open_page, serve
from csplat_bench.common.command import listed, run
from csplat_bench.common.report import table
from csplat_tools.console import note
from csplat_tools.present.viewer_page import export_page
from csplat_tools.present.viewer_server import open_server, open_viewer_scene

_PATIENCE = 600.0  # seconds
_SCREEN = ["xvfb-run", "--auto-servernum", "--server-args=-screen 0 1280x1024x24"]

#: Opens an address; runs the body of an async function in the page.
Drive = tuple[str, Callable[[str], Any], Callable[[str], Any]]

_READY = """
while (!window.csplatViewer) await new Promise((resolve) => setTimeout(resolve, 20));
await csplatViewer.ready;
const error = document.getElementById('error');
return error.hidden ? csplatViewer.engine.stats.splatsDrawn : document.getElementById('error-facts').textContent;"""
# Opens a file as a person does who chooses one, then asks for the same with +z up.
_OTHER = """
const bytes = Uint8Array.from(atob(%s), (letter) => letter.charCodeAt(0));
await csplatViewer.show(new File([bytes], 'other.csplat'), 'other.csplat');
const written = await csplatViewer.engine.fileWithUp([0, 0, 1]);
return btoa(Array.from(written, (byte) => String.fromCharCode(byte)).join(''));"""
_ASYNC = "const done = arguments[arguments.length - 1]; (async () => {%s})().then(done, (e) => done('failed: ' + e));"


def main(
    source: Annotated[Path, typer.Argument(metavar="SCENE.csplat")],
    *,
    engines: Annotated[str, typer.Option(help="which")] = "chromium,firefox,webkit",
    runs: Annotated[int, typer.Option(help="of each")] = 3,
) -> int:
    """Measure what the command line names, and print a table."""
    rows, wrong = list[tuple[str, ...]](), 0
    with _places(source) as places:
        for engine in listed(engines):
            with _ENGINES[engine]() as (version, go, ask):
                for place, url in places.items():
                    seconds, said = _opened(url, source, runs, go, ask)
                    wrong += said != "right"
                    rows.append((engine, version, place, f"{statistics.median(seconds):.1f}", said))
                    note(f"{engine} {place}: {said}")
    print(table(("engine", "version", "opened", "seconds", "what came"), rows))
    return 1 if wrong else 0


def _opened(
    url: str, source: Path, runs: int, go: Callable[[str], Any], ask: Callable[[str], Any]
) -> tuple[list[float], str]:
    """Seconds of each run, and "right" or what went wrong."""
    data, seconds = source.read_bytes(), []
    count = len(decode(data))
    for _ in range(runs):
        go("about:blank")
        began = time.monotonic()
        go(url)
        drawn = ask(_READY)
        seconds.append(time.monotonic() - began)
        if not isinstance(drawn, int) or not 0 < drawn <= count:
            return seconds, str(drawn)
    text = ask(_OTHER % json.dumps(base64.b64encode(data).decode()))
    try:
        kept = decode(base64.b64decode(text, validate=True))
    except ValueError:
        return seconds, str(text)
    return seconds, "right" if kept.metadata["up"] == [0, 0, 1] and len(kept) == count else "another file"


@contextmanager
def _places(source: Path) -> Iterator[dict[str, str]]:
    """Yield the addresses at which the scene can be opened, by name."""
    with tempfile.TemporaryDirectory() as folder, open_viewer_scene(str(source), preset="fast") as scene:
        page = Path(folder, "page.html")
        page.write_bytes(export_page(scene.read(), scene.name).page)
        with open_server(scene) as server, serve(folder) as address:
            threading.Thread(target=server.serve_forever, daemon=True).start()
            yield {"csplat view": server.url, "page, folder": page.as_uri(), "page, HTTP": f"{address}page.html"}
            server.shutdown()


@contextmanager
def _chromium() -> Iterator[Drive]:
    with open_page(shutil.which("chromium") or "chromium", gpu=False) as page:
        yield page.context.browser.version, page.goto, lambda body: page.evaluate(f"async () => {{{body}}}")


@contextmanager
def _firefox() -> Iterator[Drive]:
    """Drive Firefox by Marionette: `LENGTH:[0, id, command, values]`, answered by `LENGTH:[1, id, error, result]`."""
    port = _free_port()
    with tempfile.TemporaryDirectory() as profile:
        Path(profile, "user.js").write_text(
            f'user_pref("marionette.port", {port});\nuser_pref("webgl.force-enabled", true);\n', encoding="utf-8"
        )
        words = ["firefox-esr", "--marionette", "--no-remote", "--profile", profile]
        with _started(words), _connected(port) as wire, wire.makefile("rb") as answers:

            def answer() -> Any:
                length = b"".join(iter(lambda: answers.read(1), b":"))
                return json.loads(answers.read(int(length)))

            def call(command: str, **parameters: Any) -> Any:
                message = json.dumps([0, 0, f"WebDriver:{command}", parameters]).encode()
                wire.sendall(b"%d:%s" % (len(message), message))
                _, _, error, result = answer()
                if error is not None:
                    raise InputError(f"firefox: {error['message']}")
                return result

            answer()  # the greeting of the driver
            version = call("NewSession")["capabilities"]["browserVersion"]
            call("SetTimeouts", script=1000 * _PATIENCE, pageLoad=1000 * _PATIENCE)
            yield (
                version,
                lambda url: call("Navigate", url=url),
                lambda body: call("ExecuteAsyncScript", script=_ASYNC % body, args=[], sandbox=None)["value"],
            )


@contextmanager
def _webkit() -> Iterator[Drive]:
    """Drive WebKit by WebDriver (W3C)."""
    browsers = sorted(Path("/usr/lib").glob("*/webkit2gtk-*/MiniBrowser"))
    if not browsers:
        raise InputError("WebKit's MiniBrowser is not installed: on Debian it comes with webkit2gtk-driver")
    port = _free_port()

    def call(path: str, **parameters: Any) -> Any:
        body = json.dumps(parameters).encode()
        request = urllib.request.Request(f"http://127.0.0.1:{port}/session{path}", body)
        try:
            with urllib.request.urlopen(request, timeout=_PATIENCE) as response:  # noqa: S310  # http
                return json.load(response)["value"]
        except urllib.error.HTTPError as error:
            raise InputError(f"webkit: {error.read().decode()}") from None

    options = {"binary": str(browsers[-1]), "args": ["--automation"]}
    # as root there is no sandbox; only our own pages are opened
    with _started(["WebKitWebDriver", f"--port={port}"], WEBKIT_DISABLE_SANDBOX_THIS_IS_DANGEROUS="1"):
        with _connected(port):
            pass
        session = call("", capabilities={"alwaysMatch": {"webkitgtk:browserOptions": options}})
        at = f"/{session['sessionId']}"
        call(f"{at}/timeouts", script=1000 * _PATIENCE, pageLoad=1000 * _PATIENCE)
        yield (
            session["capabilities"]["browserVersion"],
            lambda url: call(f"{at}/url", url=url),
            lambda body: call(f"{at}/execute/async", script=_ASYNC % body, args=[]),
        )


_ENGINES: dict[str, Callable[[], AbstractContextManager[Drive]]] = {
    "chromium": _chromium, "firefox": _firefox, "webkit": _webkit,
}  # fmt: skip


@contextmanager
def _started(words: list[str], **environment: str) -> Iterator[None]:
    """A program on a screen of its own; ends it, and what it has started."""
    process = subprocess.Popen(
        [*_SCREEN, *words], env={**os.environ, **environment}, start_new_session=True,
        stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
    )  # fmt: skip
    try:
        yield
    finally:
        os.killpg(process.pid, signal.SIGTERM)
        process.wait()


def _connected(port: int) -> socket.socket:
    """Connect to a program that is just starting."""
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


if __name__ == "__main__":
    sys.exit(run(main))

"""A page in Chromium, and a server of folders for it."""

from __future__ import annotations

import functools
import http.server
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from csplat.errors import InputError

_PATIENCE = 600_000  # milliseconds

_SOFTWARE = ["--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
#: What the first line asks for, through Vulkan: so that WebGPU has a device that can draw on a page, too.
_WEBGPU = [
    "--enable-unsafe-webgpu", "--use-webgpu-adapter=swiftshader", "--enable-features=Vulkan",
    "--use-vulkan=swiftshader", "--use-angle=swiftshader",
]  # fmt: skip
_HARDWARE = ["--ignore-gpu-blocklist", "--use-angle=vulkan", "--enable-features=Vulkan", "--disable-vulkan-surface"]


@contextmanager
def open_page(chromium: str, *, gpu: bool, webgpu: bool = False) -> Iterator[Any]:
    """Start a browser; yields playwright's page.

    Args:
        chromium: the program.
        gpu: let it use the machine's GPU; SwiftShader draws otherwise.
        webgpu: with SwiftShader's WebGPU, which it has not by itself.

    Raises:
        InputError: playwright is not installed.
    """
    try:
        from playwright.sync_api import sync_playwright
    except ModuleNotFoundError:
        raise InputError("playwright is not installed: pip install playwright") from None
    with sync_playwright() as playwright:
        arguments = [
            "--no-sandbox",
            "--disable-dev-shm-usage",
            *(_HARDWARE if gpu else _WEBGPU if webgpu else _SOFTWARE),
        ]
        browser = playwright.chromium.launch(executable_path=chromium, args=arguments)
        page = browser.new_page()
        page.set_default_timeout(_PATIENCE)
        yield page
        browser.close()


@contextmanager
def serve(folder: str | Path) -> Iterator[str]:
    """Serve the files of a folder, also those that links in it point to; yields its address."""
    quiet = type("Quiet", (http.server.SimpleHTTPRequestHandler,), {"log_message": lambda *_: None})
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), functools.partial(quiet, directory=str(folder))) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        yield f"http://127.0.0.1:{server.server_address[1]}/"
        server.shutdown()

# SPDX-License-Identifier: Apache-2.0
"""Pages in Chromium, and a server of folders."""

from __future__ import annotations

import functools
import http.server
import shutil
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from csplat_bench.protocol import AbsentError

_TIMEOUT_MS = 600_000  # milliseconds; limit for every action of a page

_SOFTWARE = ["--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
# SwiftShader through Vulkan, which gives WebGPU a device that can draw on a page.
_WEBGPU = [
    "--enable-unsafe-webgpu", "--use-webgpu-adapter=swiftshader", "--enable-features=Vulkan",
    "--use-vulkan=swiftshader", "--use-angle=swiftshader",
]  # fmt: skip
_HARDWARE = ["--ignore-gpu-blocklist", "--use-angle=vulkan", "--enable-features=Vulkan", "--disable-vulkan-surface"]


@contextmanager
def open_page(chromium: str, *, gpu: bool, webgpu: bool = False) -> Iterator[Any]:
    """Start a browser; yield playwright's page.

    Args:
        chromium: the program.
        gpu: use the machine's GPU; otherwise SwiftShader draws.
        webgpu: enable WebGPU by SwiftShader.

    Raises:
        AbsentError: playwright or the browser is not installed.
    """
    try:
        from playwright.sync_api import sync_playwright
    except ModuleNotFoundError:
        raise AbsentError("playwright is not installed: pip install playwright") from None
    if shutil.which(chromium) is None:
        raise AbsentError(f"{chromium} is not installed")
    with sync_playwright() as playwright:
        arguments = [
            "--no-sandbox",
            "--disable-dev-shm-usage",
            *(_HARDWARE if gpu else _WEBGPU if webgpu else _SOFTWARE),
        ]
        browser = playwright.chromium.launch(executable_path=chromium, args=arguments)
        page = browser.new_page()
        page.set_default_timeout(_TIMEOUT_MS)
        yield page
        browser.close()


@contextmanager
def serve(folder: str | Path) -> Iterator[str]:
    """Serve the files of a folder, through links as well; yield its address."""
    quiet = type("Quiet", (http.server.SimpleHTTPRequestHandler,), {"log_message": lambda *_: None})
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), functools.partial(quiet, directory=str(folder))) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        yield f"http://127.0.0.1:{server.server_address[1]}/"
        server.shutdown()

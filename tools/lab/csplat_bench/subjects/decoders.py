# SPDX-License-Identifier: Apache-2.0
"""Decoders of ours and of others: seconds from bytes in memory to arrays, all checks included, and memory.

All decoders of a scene are started first, each in a process or page of its own that holds its file, and take turns.
SPZ, SPLAT and KSPLAT are written by their owners' libraries with their defaults, which keep less than ours.

A case has
    place       native, python, node or chromium
    driver      csplat, csplat-own, spz (programs, built on demand), serve.py, csplat.mjs or others.mjs (bundled)
    threads     for csplat, csplat-own and serve.py: number of threads (0: all cores)
    output      for spz: floats or packed
    export      for a module: the exported function that makes the decoder
    file        suffix of its file: PRESET.csplat, v2.spz to v4.spz, splat, ksplat
    delivers    description of the arrays
    reference   the case that it is compared with, in the same turn

Programs are made in the folder of peers: csplat's need cc; SPZ's git, c++, zlib and libzstd with headers; others npm.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from functools import cache
from pathlib import Path
from typing import Any, Self

from csplat import EncodeOptions, encode
from csplat.formats import write
from csplat.ply import read_ply, write_ply
from csplat_bench.browser import open_page, serve
from csplat_bench.measuring import peak_bytes, reset_peak
from csplat_bench.peers import DRIVERS, build_with_spz, npm_pinned
from csplat_bench.protocol import AbsentError, Measure, Setup
from csplat_bench.scenes import ROOT, Scene, find_scene
from csplat_bench.suites import Case
from csplat_tools.console import note

_C = ROOT / "codec" / "c"
_THREADS_MAX = 64  # the driver in C has an array of this size
_PACKAGES = {
    "@adobe/spz": "0.2.3", "@sparkjsdev/spark": "2.2.0", "three": "0.187.0", "@mkkellogg/gaussian-splats-3d": "0.4.7",
    "esbuild": "0.28.2",
}  # fmt: skip
_LOAD = """async ([timing, module, name, url]) => {
  try {
    const { once } = await import(timing);
    const decode = await (await import(module))[name]();
    const bytes = new Uint8Array(await (await fetch(url)).arrayBuffer());
    window.decodeOnce = () => once(decode, bytes).catch(String);
  } catch (error) {
    window.decodeOnce = () => String(error);
  }
}"""


@contextmanager
def measure_decoders(setup: Setup, name: str, cases: Sequence[Case]) -> Iterator[Measure]:
    """Yield the function that lets a decoder decode once; the first time gives `first_seconds` and memory, too."""
    scene = find_scene(name, setup.data, setup.work)
    with tempfile.TemporaryDirectory(prefix="csplat-decoders-") as temporary, ExitStack() as stack:
        folder = Path(temporary)
        start = _starter(setup, folder, stack, any(case["place"] == "chromium" for case in cases))
        running: dict[str, Process | Tab] = {}

        def measure(case: Case) -> Mapping[str, Any]:
            first = case.name not in running
            if first:
                _write_file(scene, case["file"], setup.peers, folder)
                running[case.name] = start(case)
            seconds, array_bytes = running[case.name].decode()
            if not first:
                return {"decode_seconds": seconds}
            return {
                "splats": scene.splat_count, "sh_degree": scene.sh_degree, "place": case["place"], "file": case["file"],
                "delivers": case["delivers"], "size_bytes": (folder / f"scene.{case['file']}").stat().st_size,
                "array_bytes": array_bytes, "first_seconds": seconds,
                "growth_bytes": running[case.name].growth_bytes(), "decode_seconds": seconds,
            }  # fmt: skip

        yield measure


class Process:
    """A decoder in a process that holds a file. Owns the process, which `with` ends."""

    def __init__(self, words: Sequence[object]) -> None:
        command = [str(word) for word in words]
        self._process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
        self._read_line()  # it is ready
        self._before = reset_peak(self._process.pid)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._process.kill()
        self._process.communicate()

    def decode(self) -> tuple[float, int]:
        """Decode once; return seconds, and bytes of the arrays."""
        assert self._process.stdin is not None
        print(file=self._process.stdin, flush=True)
        seconds, size = self._read_line().split()
        return float(seconds), int(size)

    def growth_bytes(self) -> int | None:
        """Return the largest growth since the process was ready, in bytes; `None` if the kernel does not report it."""
        peak = peak_bytes(self._process.pid)
        return peak - self._before if peak else None

    def _read_line(self) -> str:
        assert self._process.stdout is not None
        line = self._process.stdout.readline()
        if not line:
            raise OSError(f"the decoder ended with status {self._process.wait()}")
        return line


class Tab:
    """A decoder in a page that holds a file. Owns the page, which `with` closes."""

    def __init__(self, browser: Any, address: str, module: str, case: Case) -> None:
        drivers = f"{address}tree/{DRIVERS.relative_to(ROOT).as_posix()}"
        folder = f"{address}peers/decoders" if module == "others.mjs" else drivers
        self._page = browser.new_page()
        self._page.goto(f"{address}files/")
        words = [f"{drivers}/timing.mjs", f"{folder}/{module}", case["export"], f"{address}files/scene.{case['file']}"]
        self._page.evaluate(_LOAD, words)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._page.close()

    def decode(self) -> tuple[float, int]:
        """Decode once; return seconds, and bytes of the arrays."""
        result = self._page.evaluate("decodeOnce()")
        if isinstance(result, str):
            raise OSError(f"in the page: {result}")
        return float(result[0]), int(result[1])

    def growth_bytes(self) -> None:
        """Return `None`: a browser has many processes."""


def _starter(setup: Setup, folder: Path, stack: ExitStack, in_browser: bool) -> Callable[[Case], Process | Tab]:
    """Return a function that starts the decoder of a case on its file; the stack ends it."""
    browser, address = None, ""
    if in_browser:
        root = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="csplat-served-")))
        setup.peers.mkdir(parents=True, exist_ok=True)
        for name, target in (("tree", ROOT), ("peers", setup.peers), ("files", folder)):
            (root / name).symlink_to(target.resolve())
        address = stack.enter_context(serve(root))
        browser = stack.enter_context(open_page(setup.chromium, gpu=False)).context.browser

    def start(case: Case) -> Process | Tab:
        driver, file = case["driver"], folder / f"scene.{case['file']}"
        if driver in _BUILDERS:
            build(driver, setup.peers)
        running: Process | Tab
        if case["place"] == "chromium":
            running = Tab(browser, address, driver, case)
        elif case["place"] == "node":
            modules = setup.peers / "decoders" if driver == "others.mjs" else DRIVERS
            running = Process(["node", "--expose-gc", DRIVERS / "node.mjs", modules / driver, case["export"], file])
        elif case["place"] == "python":
            running = Process([sys.executable, DRIVERS / driver, file, _thread_count(case)])
        else:
            argument = case["output"] if driver == "spz" else _thread_count(case)
            running = Process([_program(setup.peers, driver), file, argument])
        stack.enter_context(running)
        return running

    return start


def _thread_count(case: Case) -> int:
    threads: int = case["threads"]
    return threads or min(os.cpu_count() or 1, _THREADS_MAX)


def _write_file(scene: Scene, suffix: str, peers: Path, folder: Path) -> None:
    """Write a scene as scene.SUFFIX, unless it is there; SPZ and KSPLAT all at once."""
    if (folder / f"scene.{suffix}").exists():
        return
    note(f"{scene.name}: writing {suffix}")
    model = read_ply(scene.path)
    if suffix.endswith(".csplat"):
        preset: Any = suffix.removesuffix(".csplat")
        (folder / f"scene.{suffix}").write_bytes(encode(model, EncodeOptions(preset=preset)))
        return
    build("others.mjs", peers)
    write_ply(folder / "scene.ply", model)
    write(folder / "scene.spz", model)
    write(folder / "scene.splat", model)
    words = ["node", str(peers / "decoders" / "convert.mjs"), str(folder / "scene")]
    subprocess.run(words, check=True, capture_output=True)


@cache
def build(driver: str, peers: Path) -> None:
    """Build a driver into the folder of peers.

    Raises:
        AbsentError: something that it needs is not installed.
    """
    note(f"building {driver}")
    try:
        _BUILDERS[driver](peers)
    except (OSError, subprocess.CalledProcessError) as error:
        text = (getattr(error, "stderr", "") or str(error)).strip().splitlines()
        raise AbsentError(text[0] if text else str(error)) from None


def _build_csplat(peers: Path) -> None:
    sources = [f"-I{_C}", DRIVERS / "csplat.c", _C / "csplat.c"]
    _run(["cc", "-O3", *sources, "-lz", "-lm", "-lpthread", "-o", _program(peers, "csplat")])


def _build_csplat_own(peers: Path) -> None:
    sources = [f"-I{_C}", "-DCSPLAT_NO_ZLIB", DRIVERS / "csplat.c", _C / "csplat.c", _C / "inflate.c"]
    _run(["cc", "-O3", *sources, "-lm", "-lpthread", "-o", _program(peers, "csplat-own")])


def _build_spz(peers: Path) -> None:
    build_with_spz(DRIVERS / "spz.cc", _program(peers, "spz"), peers)


def _build_bundle(peers: Path) -> None:
    npm_pinned(peers, _PACKAGES)
    modules = peers.resolve() / "node_modules"
    words = ["--bundle", "--format=esm", "--log-level=error", "--out-extension:.js=.mjs", "--external:node:*"]
    sources = [DRIVERS / "others.mjs", DRIVERS / "convert.mjs"]
    outdir = f"--outdir={peers / 'decoders'}"
    _run([modules / ".bin" / "esbuild", *words, outdir, *sources], {"NODE_PATH": str(modules)})


_BUILDERS: dict[str, Callable[[Path], None]] = {
    "csplat": _build_csplat, "csplat-own": _build_csplat_own, "spz": _build_spz, "others.mjs": _build_bundle,
}  # fmt: skip


def _run(command: Sequence[object], environment: Mapping[str, str] = {}) -> None:
    words = list(map(str, command))
    subprocess.run(words, check=True, capture_output=True, text=True, env={**os.environ, **environment})


def _program(peers: Path, name: str) -> Path:
    (peers / "decoders").mkdir(parents=True, exist_ok=True)
    return peers / "decoders" / name

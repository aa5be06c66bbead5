"""Decoders in processes and pages of their own that hold a file, and decode it each time they are asked."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Self

from csplat.errors import InputError
from csplat_bench.common.measuring import peak_bytes, reset_peak
from csplat_bench.common.peers import npm_pinned
from csplat_bench.common.scenes import ROOT
from csplat_tools.console import note

DRIVERS = Path(__file__).with_name("drivers")

_C = ROOT / "codec" / "c"
_CORES = str(min(os.cpu_count() or 1, 64))
_SPZ = "https://github.com/nianticlabs/spz"
_SPZ_COMMIT = "21715c3b7a609ea6fb7c69b8ae42181a12b59f22"
_PACKAGES = {
    "@adobe/spz": "0.2.3", "@sparkjsdev/spark": "2.2.0", "three": "0.187.0", "@mkkellogg/gaussian-splats-3d": "0.4.7",
    "esbuild": "0.28.2",
}  # fmt: skip

_PRESETS = ("fast.csplat", "balanced.csplat", "small.csplat")
_FLOATS = "float32"
_GEOMETRY = "float32 centres, covariances; bytes"
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


@dataclass(frozen=True)
class Decoder:
    """A decoder that is measured.

    Attributes:
        place: native, python, node or chromium.
        name: name in the table.
        files: suffixes of the files that it is given.
        delivers: description of the arrays that it returns.
        driver: the program (built on demand) or the JavaScript or Python module that runs it.
        word: argument of the driver: an export of the module, a number of threads, or what to deliver.
    """

    place: str
    name: str
    files: Sequence[str]
    delivers: str
    driver: str
    word: str

    @property
    def is_reference(self) -> bool:
        """True for SPZ's own library, decoding to floats."""
        return (self.driver, self.word) in {("spz", "floats"), ("others.mjs", "adobe")}


def _in_javascript(place: str) -> list[Decoder]:
    return [
        Decoder(place, "csplat WebAssembly", _PRESETS, _FLOATS, "csplat.mjs", "compiled"),
        Decoder(place, "csplat WebAssembly, all cores", _PRESETS, _FLOATS, "csplat.mjs", "workers"),
        Decoder(place, "csplat WebAssembly, packed", _PRESETS, "narrow integers", "csplat.mjs", "packed"),
        Decoder(place, "csplat JavaScript alone", _PRESETS, _FLOATS, "csplat.mjs", "plain"),
        Decoder(place, "@adobe/spz", ("v4.spz",), _FLOATS, "others.mjs", "adobe"),
        Decoder(place, "three.js SPZLoader", ("v4.spz",), _GEOMETRY, "others.mjs", "threeSpz"),
    ]


#: All that are known, neighbours as the table has them.
DECODERS = [
    Decoder("native", "csplat C", _PRESETS, _FLOATS, "csplat", "1"),
    Decoder("native", "csplat C, all cores", _PRESETS, _FLOATS, "csplat", _CORES),
    Decoder("native", "csplat C, inflate.c", _PRESETS, _FLOATS, "csplat-own", "1"),
    Decoder("native", "SPZ's library in C++", ("v4.spz", "v3.spz"), _FLOATS, "spz", "floats"),
    Decoder("native", "the same, not unpacked", ("v4.spz",), "bytes", "spz", "packed"),
    Decoder("python", "csplat Python", _PRESETS, _FLOATS, "serve.py", "1"),
    Decoder("python", "csplat Python, all cores", _PRESETS, _FLOATS, "serve.py", _CORES),
    *_in_javascript("node"),
    Decoder("node", "three.js SPLATLoader", ("splat",), _GEOMETRY, "others.mjs", "threeSplat"),
    Decoder("node", "three.js KSPLATLoader", ("ksplat",), _GEOMETRY, "others.mjs", "threeKsplat"),
    *_in_javascript("chromium"),
    Decoder("chromium", "Spark", ("v3.spz",), "16 bytes; SH in words", "others.mjs", "spark"),
    Decoder("chromium", "GaussianSplats3D", ("v2.spz",), "float32, SH to degree 2", "others.mjs", "gaussianSplats3d"),
]  # fmt: skip


def built(wanted: Sequence[Decoder], peers: Path, chromium: str) -> list[Decoder]:
    """Build what decoders need into a folder; return the available ones, and report the others.

    Args:
        wanted: decoders.
        peers: folder for npm packages, sources and programs.
        chromium: the program.
    """
    ways = {"csplat": _build_csplat, "csplat-own": _build_csplat_own, "spz": _build_spz, "others.mjs": _build_bundle}
    drivers = {one.driver for one in wanted}
    if "spz" in drivers:
        drivers.add("others.mjs")  # which writes the SPZ
    absent = {}
    if shutil.which("node") is None:
        absent["node"] = "Node.js is not installed"
    if shutil.which(chromium) is None or find_spec("playwright") is None:
        absent["chromium"] = "Chromium or playwright is not installed"
    for driver in sorted(drivers & ways.keys()):
        note(f"building {driver}")
        try:
            ways[driver](peers)
        except (OSError, InputError) as error:
            absent[driver] = str(error)
        except subprocess.CalledProcessError as error:
            absent[driver] = ((error.stderr or "").strip().splitlines() or [str(error)])[0]
    if "others.mjs" in absent:
        absent.setdefault("spz", "there are no SPZ without @adobe/spz")
    for name, reason in absent.items():
        if any(name in (one.place, one.driver) for one in wanted):
            note(f"left out: {name}: {reason}")
    return [one for one in wanted if not {one.place, one.driver} & absent.keys()]


def _build_csplat(peers: Path) -> None:
    sources = [f"-I{_C}", DRIVERS / "csplat.c", _C / "csplat.c"]
    _run(["cc", "-O3", *sources, "-lz", "-lm", "-lpthread", "-o", _program(peers, "csplat")])


def _build_csplat_own(peers: Path) -> None:
    sources = [f"-I{_C}", "-DCSPLAT_NO_ZLIB", DRIVERS / "csplat.c", _C / "csplat.c", _C / "inflate.c"]
    _run(["cc", "-O3", *sources, "-lm", "-lpthread", "-o", _program(peers, "csplat-own")])


def _build_spz(peers: Path) -> None:
    """As CMake does for a release, of the library alone; zlib and libzstd with their headers have to be there."""
    source = peers / "spz" / "src" / "cc"
    if not source.exists():
        _run(["git", "clone", "--quiet", "--no-checkout", _SPZ, peers / "spz"])
        _run(["git", "-C", peers / "spz", "checkout", "--quiet", _SPZ_COMMIT, "--", "src"])
    sources = [f"-I{source}", DRIVERS / "spz.cc", source / "load-spz.cc", source / "splat-types.cc"]
    _run(["c++", "-O3", "-DNDEBUG", "-std=c++17", *sources, "-lz", "-lzstd", "-o", _program(peers, "spz")])


def _build_bundle(peers: Path) -> None:
    failed = npm_pinned(peers, _PACKAGES)
    if failed:
        raise InputError(failed)
    modules = peers.resolve() / "node_modules"
    words = ["--bundle", "--format=esm", "--log-level=error", "--out-extension:.js=.mjs", "--external:node:*"]
    sources = [DRIVERS / "others.mjs", DRIVERS / "convert.mjs"]
    outdir = f"--outdir={peers / 'decoders'}"
    _run([modules / ".bin" / "esbuild", *words, outdir, *sources], {"NODE_PATH": str(modules)})


def _run(command: Sequence[object], environment: Mapping[str, str] = {}) -> None:
    subprocess.run(
        list(map(str, command)), check=True, capture_output=True, text=True, env={**os.environ, **environment}
    )


def _program(peers: Path, name: str) -> Path:
    (peers / "decoders").mkdir(parents=True, exist_ok=True)
    return peers / "decoders" / name


class Process:
    """A decoder as a program, with a file; `with` ends it."""

    def __init__(self, decoder: Decoder, peers: Path, file: Path) -> None:
        words = [decoder.word]
        program = [str(_program(peers, decoder.driver))]
        if decoder.place == "python":
            program = [sys.executable, str(DRIVERS / decoder.driver)]
        elif decoder.place == "node":
            folder = peers / "decoders" if decoder.driver == "others.mjs" else DRIVERS
            program = ["node", "--expose-gc", str(DRIVERS / "node.mjs"), str(folder / decoder.driver), decoder.word]
            words = []
        self._process = subprocess.Popen(
            [*program, str(file), *words], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
        )
        self._heard()  # that it is ready
        self._before = reset_peak(self._process.pid)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._process.kill()
        self._process.communicate()

    def decode(self) -> tuple[float, int]:
        """Seconds of one decoding, and bytes of its arrays."""
        assert self._process.stdin is not None
        print(file=self._process.stdin, flush=True)
        seconds, size = self._heard().split()
        return float(seconds), int(size)

    def growth_bytes(self) -> int | None:
        """Return the largest growth since the process was ready, in bytes; `None` if the kernel does not report it."""
        peak = peak_bytes(self._process.pid)
        return peak - self._before if peak else None

    def _heard(self) -> str:
        assert self._process.stdout is not None
        line = self._process.stdout.readline()
        if not line:
            raise OSError(f"{' '.join(map(str, self._process.args))} ended with status {self._process.wait()}")  # type: ignore[arg-type]  # a list
        return line


class Tab:
    """A decoder in a page of its own, with a file; `with` closes it."""

    def __init__(self, decoder: Decoder, browser: Any, address: str, file: str) -> None:
        drivers = f"{address}tree/{DRIVERS.relative_to(ROOT).as_posix()}"
        folder = f"{address}peers/decoders" if decoder.driver == "others.mjs" else drivers
        self._page = browser.new_page()
        self._page.goto(f"{address}files/")
        module = f"{folder}/{decoder.driver}"
        self._page.evaluate(_LOAD, [f"{drivers}/timing.mjs", module, decoder.word, f"{address}files/{file}"])

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._page.close()

    def decode(self) -> tuple[float, int]:
        """Seconds of one decoding, and bytes of its arrays."""
        said = self._page.evaluate("decodeOnce()")
        if isinstance(said, str):
            raise OSError(f"in the page: {said}")
        return float(said[0]), int(said[1])

    def growth_bytes(self) -> None:
        """Unknown: a browser has many processes."""

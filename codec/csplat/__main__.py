"""`python -m csplat`: the program `csplat`. The library itself knows nothing of the command line."""

from __future__ import annotations

from importlib import import_module

if __name__ == "__main__":
    import_module("csplat_tools.__main__").main()

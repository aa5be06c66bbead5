"""Command line, conversion, comparison and reports around the csplat codec."""

from __future__ import annotations

from csplat import __version__
from csplat._spec import VERSION_MAJOR, VERSION_MINOR

__all__ = ["VERSIONS"]

#: Of the program and of the format.
VERSIONS = f"csplat {__version__}, format {VERSION_MAJOR}.{VERSION_MINOR}"

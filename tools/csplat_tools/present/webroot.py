"""Locate the page of the viewer and the JavaScript decoder, in a checkout or in the installed package.

Both places have the folders `tools/viewer` and `codec/js` under one root, as the modules' imports require.
"""

from __future__ import annotations

from pathlib import Path

from csplat.errors import InputError

#: Paths below the root: the page, the element for other pages, and the module that both start as a worker.
PAGE = "tools/viewer/index.html"
ELEMENT = "tools/viewer/element.mjs"
WORKER = "tools/viewer/worker.mjs"

_FOLDERS = {"tools/viewer": (".html", ".css", ".mjs"), "codec/js": (".mjs",)}


def web_files() -> dict[str, Path]:
    """Find every file that the page may load.

    Returns:
        Local files by their paths below the root, with slashes: `tools/viewer/index.html`, `codec/js/decoder.mjs`, ...

    Raises:
        InputError: the installation is not complete.
    """
    package = Path(__file__).resolve().parent.parent  # csplat_tools
    for root in (package / "web", package.parent.parent):  # an installed wheel, a checkout
        if (root / PAGE).is_file():
            return {
                f"{folder}/{path.name}": path
                for folder, endings in _FOLDERS.items()
                for path in sorted((root / folder).iterdir())
                if path.suffix in endings
            }
    raise InputError("the page of the viewer is not installed: install csplat again")

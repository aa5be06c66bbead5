# SPDX-License-Identifier: Apache-2.0
"""Compile the library of the renderer when a package is built, for wheels and for editable installs.

The environment variable CSPLAT_NATIVE is `auto` (default: a wheel for every system, without the library, if it cannot
be compiled), `require` (fail instead), or `off` (do not compile).
"""

from __future__ import annotations

import os
import runpy
from pathlib import Path
from types import SimpleNamespace
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface

_MODES = ("auto", "require", "off")
_SOURCES = "trainer/csplat_render/native"
_TARGET = "csplat_render/native"  # the folder of the libraries in a wheel


class NativeBuildHook(BuildHookInterface):
    """A hook of hatchling's wheels."""

    def dependencies(self) -> list[str]:
        """Return the package with a compiler, if the machine has none."""
        requirements: list[str] = [] if self._mode() == "off" else self._build().requirements()
        return requirements

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        """Compile the library next to its sources, and add it to the wheel.

        Args:
            version: `standard` or `editable`.
            build_data: properties of the wheel, which are changed.
        """
        if self._mode() == "off":
            return
        build = self._build()
        try:
            files = build.build()
        except build.BuildError as error:
            if self._mode() == "require":
                self.app.abort(str(error))
            self.app.display_warning(f"{error}\ncsplat is built without its compiled renderer")
            return
        if version == "standard":
            build_data["tag"] = f"py3-none-{build.wheel_platform()}"
            build_data["pure_python"] = False
            build_data["force_include"].update({str(file): f"{_TARGET}/{file.name}" for file in files})

    def _mode(self) -> str:
        """Return the value of CSPLAT_NATIVE, or end with an error."""
        mode = os.environ.get("CSPLAT_NATIVE") or _MODES[0]
        if mode not in _MODES:
            self.app.abort(f"CSPLAT_NATIVE is {mode!r}, expected {', '.join(_MODES)}")
        return mode

    def _build(self) -> Any:
        """Load the module that compiles the library."""
        return SimpleNamespace(**runpy.run_path(str(Path(self.root) / _SOURCES / "build.py")))

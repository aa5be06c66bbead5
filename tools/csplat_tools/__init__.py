# SPDX-License-Identifier: Apache-2.0
"""Command line, conversion, comparison and reports around the csplat codec.

    >>> import csplat, csplat_tools
    >>> simple = csplat_tools.simplify("scene.ply", csplat.Target(keep=0.5))  # doctest: +SKIP
    >>> compared = csplat_tools.compare("scene.ply", simple.model)  # doctest: +SKIP

The commands call these functions. A *scene* is a `SplatModel`, or a file of either kind: a path, an open binary file,
or bytes. Images and plots require the packages of the extra `render`. The names load their modules when first used.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from csplat import __version__, lazy_exports
from csplat._spec import VERSION_MAJOR, VERSION_MINOR

if TYPE_CHECKING:
    from csplat_tools.batch import Batch, run_batch
    from csplat_tools.inspect.comparison import Comparison, compare
    from csplat_tools.optimise.simplify import Simplified, SimplifyOptions, simplify
    from csplat_tools.scene_files import SceneLike
    from csplat_tools.tradeoffs import Tradeoff, parse_formats, parse_grid, tradeoff
    from csplat_tools.views import DataOptions, ViewSet, find_view_set

__all__ = [
    "Batch",
    "Comparison",
    "DataOptions",
    "SceneLike",
    "Simplified",
    "SimplifyOptions",
    "Tradeoff",
    "ViewSet",
    "compare",
    "find_view_set",
    "parse_formats",
    "parse_grid",
    "run_batch",
    "simplify",
    "tradeoff",
]

#: Versions of the program and of the format.
VERSIONS = f"csplat {__version__}, format {VERSION_MAJOR}.{VERSION_MINOR}"

_MODULE_OF = {
    "Batch": "csplat_tools.batch",
    "Comparison": "csplat_tools.inspect.comparison",
    "DataOptions": "csplat_tools.views",
    "SceneLike": "csplat_tools.scene_files",
    "Simplified": "csplat_tools.optimise.simplify",
    "SimplifyOptions": "csplat_tools.optimise.simplify",
    "Tradeoff": "csplat_tools.tradeoffs",
    "ViewSet": "csplat_tools.views",
    "compare": "csplat_tools.inspect.comparison",
    "find_view_set": "csplat_tools.views",
    "parse_formats": "csplat_tools.tradeoffs",
    "parse_grid": "csplat_tools.tradeoffs",
    "run_batch": "csplat_tools.batch",
    "simplify": "csplat_tools.optimise.simplify",
    "tradeoff": "csplat_tools.tradeoffs",
}
__getattr__, __dir__ = lazy_exports(__name__, _MODULE_OF)

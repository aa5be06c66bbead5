# SPDX-License-Identifier: Apache-2.0
"""csplat: a compressed format for 3D Gaussian splats.

    >>> import csplat
    >>> model = csplat.read("scene.ply")
    >>> data = csplat.encode(model, csplat.EncodeOptions(preset="small"))
    >>> data = csplat.encode(model, target=csplat.Target(psnr=38))  # doctest: +SKIP
    >>> model = csplat.decode(data)
    >>> with csplat.open("scene.csplat") as file:  # or https://…, s3://…: reads only the parts it needs
    ...     model = file.read(box=(-1, -1, -1, 1, 1, 1))
    >>> csplat.compare("scene.ply", "scene.csplat").psnr  # doctest: +SKIP
    41.2

Functions that read a *file* (`read`, `open`, `decode`) accept a path, an open binary file or bytes.
`encode` takes a *scene*: a `SplatModel`, or a `Scene` of any size from `open`.

All errors are `CsplatError`s: `FormatError`, `UnsupportedError` and `LimitError` concern the file, `InputError` the
caller's data, `StoreError` a server. Errors of the operating system stay `OSError`s.

Names are imported on first use (PEP 562): `import csplat.decoder` loads neither the encoder nor the PLY reader, so a
decoder can be embedded alone. `compare`, `finetune`, `render`, `simplify` and `train` are those of the other packages,
which register them (`csplat.plugins`).
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping
from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from csplat.context import Context
    from csplat.decoder import Limits, decode, decode_integers, decode_scene, read_header
    from csplat.editing.extract import extract
    from csplat.editing.merge import merge
    from csplat.encode_api import encode, encode_with_report
    from csplat.encoder import EncodeOptions, EncodeResult, Target
    from csplat.errors import (
        CsplatError,
        FormatError,
        InputError,
        LimitError,
        SearchInterrupted,
        StoreError,
        UnsupportedError,
    )
    from csplat.formats import open, read, write
    from csplat.interop import from_gsplat, to_gsplat
    from csplat.model import SplatModel
    from csplat.ply import lint_ply, write_ply
    from csplat.scene import Scene
    from csplat.scene_metadata import SceneMetadata
    from csplat.splat_file import SplatFile

    # Checkers that shall know their types import them from `csplat_tools`, `csplat_render` and `csplat_trainer`.
    compare: Callable[..., Any]
    finetune: Callable[..., Any]
    render: Callable[..., Any]
    simplify: Callable[..., Any]
    train: Callable[..., Any]

__version__ = "1.0.0"

__all__ = [
    "Context",
    "CsplatError",
    "EncodeOptions",
    "EncodeResult",
    "FormatError",
    "InputError",
    "LimitError",
    "Limits",
    "Scene",
    "SceneMetadata",
    "SearchInterrupted",
    "SplatFile",
    "SplatModel",
    "StoreError",
    "Target",
    "UnsupportedError",
    "__version__",
    "compare",
    "decode",
    "decode_integers",
    "decode_scene",
    "encode",
    "encode_with_report",
    "extract",
    "finetune",
    "from_gsplat",
    "lint_ply",
    "merge",
    "open",
    "read",
    "read_header",
    "render",
    "simplify",
    "to_gsplat",
    "train",
    "write",
    "write_ply",
]


def lazy_exports(package: str, module_of: Mapping[str, str]) -> tuple[Callable[[str], object], Callable[[], list[str]]]:
    """Return `__getattr__` and `__dir__` for a package that imports its public names on first use (PEP 562).

    A name whose module needs an optional package that is not installed raises an `InputError` with the install command.

    Args:
        package: name of the package.
        module_of: module of each public name.
    """

    def get(name: str) -> object:
        module = module_of.get(name)
        if module is None:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        try:
            value: object = getattr(import_module(module), name)
        except ModuleNotFoundError as error:
            if (error.name or "csplat").startswith("csplat"):
                raise
            from csplat.errors import missing_package

            raise missing_package(error) from None
        setattr(sys.modules[package], name, value)  # later accesses bypass __getattr__
        return value

    return get, lambda: sorted(sys.modules[package].__all__)


_MODULE_OF = {
    "Context": "csplat.context",
    "CsplatError": "csplat.errors",
    "EncodeOptions": "csplat.encoder",
    "EncodeResult": "csplat.encoder",
    "FormatError": "csplat.errors",
    "InputError": "csplat.errors",
    "LimitError": "csplat.errors",
    "Limits": "csplat.decoder",
    "Scene": "csplat.scene",
    "SearchInterrupted": "csplat.errors",
    "SceneMetadata": "csplat.scene_metadata",
    "SplatFile": "csplat.splat_file",
    "SplatModel": "csplat.model",
    "StoreError": "csplat.errors",
    "Target": "csplat.encoder",
    "UnsupportedError": "csplat.errors",
    "decode": "csplat.decoder",
    "decode_integers": "csplat.decoder",
    "decode_scene": "csplat.decoder",
    "encode": "csplat.encode_api",
    "encode_with_report": "csplat.encode_api",
    "extract": "csplat.editing.extract",
    "from_gsplat": "csplat.interop",
    "lint_ply": "csplat.ply",
    "merge": "csplat.editing.merge",
    "open": "csplat.formats",
    "read_header": "csplat.decoder",
    "read": "csplat.formats",
    "to_gsplat": "csplat.interop",
    "write": "csplat.formats",
    "write_ply": "csplat.ply.ply_writer",
    **dict.fromkeys(("compare", "finetune", "render", "simplify", "train"), "csplat.plugins"),
}
__getattr__, __dir__ = lazy_exports(__name__, _MODULE_OF)

"""csplat: a compressed format for 3D Gaussian splats.

    >>> import csplat
    >>> model = csplat.read_ply("scene.ply")            # doctest: +SKIP
    >>> data = csplat.encode(model)                     # doctest: +SKIP
    >>> model = csplat.decode(data)                     # doctest: +SKIP

The names below load their modules when first used (PEP 562): `import csplat.decoder` brings in
neither the encoder nor the PLY reader, so that a decoder can be embedded alone.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from csplat.decoder import decode, decode_integers, read_header
    from csplat.encoder import EncodeOptions, encode
    from csplat.errors import (
        CsplatError,
        FormatError,
        InputError,
        LimitError,
        UnsupportedError,
    )
    from csplat.model import SplatModel
    from csplat.ply import read_ply, write_ply

__version__ = "0.1.0"

__all__ = [
    "CsplatError",
    "EncodeOptions",
    "FormatError",
    "InputError",
    "LimitError",
    "SplatModel",
    "UnsupportedError",
    "__version__",
    "decode",
    "decode_integers",
    "encode",
    "read_header",
    "read_ply",
    "write_ply",
]

_MODULE_OF = {
    "CsplatError": "csplat.errors",
    "EncodeOptions": "csplat.encoder",
    "FormatError": "csplat.errors",
    "InputError": "csplat.errors",
    "LimitError": "csplat.errors",
    "SplatModel": "csplat.model",
    "UnsupportedError": "csplat.errors",
    "decode": "csplat.decoder",
    "decode_integers": "csplat.decoder",
    "encode": "csplat.encoder",
    "read_header": "csplat.decoder",
    "read_ply": "csplat.ply",
    "write_ply": "csplat.ply",
}


def __getattr__(name: str) -> object:
    module = _MODULE_OF.get(name)
    if module is None:
        raise AttributeError(f"module 'csplat' has no attribute {name!r}")
    value: object = getattr(import_module(module), name)
    globals()[name] = value  # the next access does not come here again
    return value


def __dir__() -> list[str]:
    return sorted(__all__)

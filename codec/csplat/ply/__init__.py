# SPDX-License-Identifier: Apache-2.0
"""PLY files of 3D Gaussian splats: INRIA's layout and its variants.

| module | contents |
|---|---|
| `ply_reader` | `read_ply`, `lint_ply`; the only module that imports plyfile, which is GPL-3.0-or-later |
| `ply_header` | headers and text rows, rewritten for plyfile if necessary |
| `ply_rows` | rows and lists that are skipped, so that plyfile sees only what is needed |
| `column_names` | the columns of a file by their meaning |
| `columns` | conversion of rows to the arrays of a model, with repairs |
| `comments` | metadata of a scene in header comments |
| `ply_writer` | `write_ply` |

Modules are loaded when one of the names below is first used, so writing a PLY does not load plyfile.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from csplat import lazy_exports

if TYPE_CHECKING:
    from csplat.ply.ply_reader import lint_ply, open_ply, read_ply
    from csplat.ply.ply_writer import write_ply, write_scene_ply

__all__ = ["lint_ply", "open_ply", "read_ply", "write_ply", "write_scene_ply"]

_MODULE_OF = {
    "lint_ply": "csplat.ply.ply_reader",
    "open_ply": "csplat.ply.ply_reader",
    "read_ply": "csplat.ply.ply_reader",
    "write_ply": "csplat.ply.ply_writer",
    "write_scene_ply": "csplat.ply.ply_writer",
}
__getattr__, __dir__ = lazy_exports(__name__, _MODULE_OF)

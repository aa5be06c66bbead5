# SPDX-License-Identifier: CC0-1.0
"""Recipes of vectors: valid files, and files with a defect."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from csplat import _spec
from csplat_authoring.builder import Built, build, repair
from csplat_authoring.scene import Scene

#: CHK-6: chunks whose payload a decoder may leave unread.
_ANCILLARY = (_spec.CHUNK_METADATA, _spec.CHUNK_CAMERAS, _spec.CHUNK_OPTIONS, _spec.CHUNK_DECLARED_ERRORS)


@dataclass(frozen=True)
class View:
    """A view of a rendered vector.

    Attributes:
        camera: K, viewmat, W, H and near, in the form of a camera file.
        psnr: required PSNR of a renderer compared with the reference, dB.
    """

    camera: dict[str, Any]
    psnr: float


@dataclass(frozen=True)
class Recipe:
    """The recipe of one vector.

    Attributes:
        name: group and name, `valid/morton`.
        why: purpose of the vector, one line.
        clauses: ids of the clauses that it covers; for invalid files, the violated one comes first.
        data: returns the file.
        scene: the scene that it must decode to; None if it must be refused.
        code: error code, if it must be refused.
        offset: offset of the defect, if it is a single byte.
        also: further codes that a decoder may report.
        optional: type of the chunk whose payload has the defect, such as `META`; decoders that leave it unread (CHK-6)
            accept the file. Empty if every decoder must refuse the file.
        views: reference views, for rendered scenes.
    """

    name: str
    why: str
    clauses: tuple[str, ...]
    data: Callable[[], bytes]
    scene: Scene | None = None
    code: str = ""
    offset: int | None = None
    also: tuple[str, ...] = ()
    optional: str = ""
    views: tuple[View, ...] = ()


def valid_recipe(group: str, name: str, why: str, clauses: str, made: Scene) -> Recipe:
    """Return the recipe of a valid file.

    Args:
        group: `valid`, `extreme` or `render`.
        name: name of the vector.
        why: purpose of the vector, one line.
        clauses: ids of the clauses that it covers, separated by blanks.
        made: the scene.
    """
    return Recipe(f"{group}/{name}", why, tuple(clauses.split()), lambda: build(made).data, made)


def invalid_recipe(
    name: str,
    why: str,
    clauses: str,
    code: str,
    base: Built | Scene,
    changes: Mapping[str, Any] | None = None,
    also: tuple[str, ...] = (),
    at: str = "",
    within: int = 0,
    cut: int = 0,
) -> Recipe:
    """Return the recipe of a file that must be refused.

    Args:
        name: name of the vector.
        why: the defect, one line.
        clauses: the violated clause, and others that the vector covers.
        code: error code.
        base: the file, or its scene.
        changes: new values of fields by name; checksums are repaired.
        also: further acceptable codes.
        at: field to report; default: the first that changes.
        within: byte within that field.
        cut: number of bytes to remove at the end of the last chunk's payload; all sizes are adjusted.
    """
    built = build(base) if isinstance(base, Scene) else base
    changes = dict(changes or {})
    offset = built.fields[at or next(iter(changes))].offset + within
    payloads = {_unread(field) for field in (changes if changes and not cut else (at,))}
    optional = payloads.pop() if len(payloads) == 1 else ""

    def data() -> bytes:
        if cut:
            return repair(built.patched(changes | _sizes(built, cut), repaired=False)[:-cut])
        return built.patched(changes) if changes else built.data

    return Recipe(f"invalid/{name}", why, tuple(clauses.split()), data, None, code, offset, also, optional)


def _unread(field: str) -> str:
    """Return the ancillary chunk whose payload contains a field, or an empty string."""
    chunk, _, part = field.partition("/")
    return chunk if chunk.encode() in _ANCILLARY and part != "crc" and not part.startswith("header.") else ""


def _sizes(base: Built, cut: int) -> dict[str, int]:
    """Return the size fields of a file whose last chunk is shorter."""
    chunk, (offset, length) = max(base.spans.items(), key=lambda item: item[1])
    kind, *numbers = chunk.split(".")
    record = "tile[{}].layer[{}]".format(*numbers) if kind == "TILE" else f"directory[{chunk}]"
    return {
        f"{record}.size": length - cut,
        f"{chunk}/header.payload_size": length - _spec.CHUNK_HEADER_SIZE - cut,
        "header.file_size": offset + length - cut,
    }

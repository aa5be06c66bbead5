"""Recipes that break a valid file: they overwrite its fields, or declare its scene wrongly."""

from __future__ import annotations

import struct
from functools import cache
from typing import Any

from csplat import _spec
from csplat_authoring.builder import Built, build
from csplat_authoring.repair import repair
from csplat_authoring.samples import Recipe, rich_scene, scene
from csplat_authoring.scene import Scene

#: CHK-6: chunks whose payload a decoder may leave unread.
_ANCILLARY = (_spec.CHUNK_METADATA, _spec.CHUNK_CAMERAS, _spec.CHUNK_OPTIONS, _spec.CHUNK_STATED_ERRORS)


@cache
def small() -> Built:
    """Return one tile of two splats."""
    return build(scene())


@cache
def rich() -> Built:
    """Return the scene of `valid/rich`."""
    return build(rich_scene())


def patched(
    name: str,
    why: str,
    clauses: str,
    code: str,
    base: Built,
    changes: dict[str, Any],
    also: tuple[str, ...] = (),
    at: str = "",
    within: int = 0,
) -> Recipe:
    """Return a recipe that overwrites fields of a valid file.

    Args:
        name: name of the vector.
        why: one line.
        clauses: the one that is broken, and others that the vector covers.
        code: error code.
        base: the valid file.
        changes: field to value.
        also: further codes that do as well.
        at: field that is to blame; by default the first that changes.
        within: byte within that field.
    """
    place = base.fields[at or next(iter(changes))].offset + within
    ids = tuple(clauses.split())
    payloads = {_unread(field) for field in changes}
    optional = payloads.pop() if len(payloads) == 1 else ""
    return Recipe(f"invalid/{name}", why, ids, lambda: base.patched(changes), None, code, place, also, optional)


def whole(name: str, why: str, clauses: str, code: str, made: Scene, at: str, within: int = 0) -> Recipe:
    """Return a recipe whose scene is declared wrong; `at` names the field that is to blame."""
    built = build(made)
    place = built.fields[at].offset + within
    ids = tuple(clauses.split())
    return Recipe(f"invalid/{name}", why, ids, lambda: built.data, None, code, place, optional=_unread(at))


def _unread(field: str) -> str:
    """Return the ancillary chunk in whose payload a field lies, neither in its frame nor in its CRC; or nothing."""
    chunk, _, part = field.partition("/")
    return chunk if chunk.encode() in _ANCILLARY and part != "crc" and not part.startswith("header.") else ""


def cut(
    name: str,
    why: str,
    clauses: str,
    code: str,
    base: Built,
    size: int,
    at: str,
    changes: dict[str, Any] | None = None,
    within: int = 0,
) -> Recipe:
    """Return a recipe that shortens the payload of a file's last chunk; all sizes of the container are right.

    Args:
        name, why, clauses, code: as for `patched`.
        base: the valid file.
        size: bytes that are missing at the end.
        at: field that is to blame.
        changes: field to value, in addition to the sizes.
        within: byte within that field.
    """
    chunk, (offset, length) = max(base.spans.items(), key=lambda item: item[1])
    kind, *numbers = chunk.split(".")
    record = "tile[{}].layer[{}]".format(*numbers) if kind == "TILE" else f"directory[{chunk}]"
    sizes = {
        f"{record}.size": length - size,
        f"{chunk}/header.payload_size": length - _spec.CHUNK_HEADER_SIZE - size,
        "header.file_size": offset + length - size,
    }

    def data() -> bytes:
        return repair(base.patched((changes or {}) | sizes, repaired=False)[:-size])

    place = base.fields[at].offset + within
    return Recipe(f"invalid/{name}", why, tuple(clauses.split()), data, None, code, place, optional=_unread(at))


def swapped(base: Built, one: str, other: str) -> dict[str, Any]:
    """Return the changes that exchange two layer records."""
    keys = [f"{name}.{key}" for name in (one, other) for key in ("layer", "size", "offset")]
    values = [struct.unpack_from(base.fields[k].format, base.data, base.fields[k].offset) for k in keys]
    return dict(zip(keys, values[3:] + values[:3], strict=True))

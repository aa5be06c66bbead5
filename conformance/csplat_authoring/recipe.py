"""Recipes of vectors: files that hold a scene, and files with a defect."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from csplat import _spec
from csplat_authoring.builder import Built, build, repair
from csplat_authoring.scene import Scene

#: CHK-6: chunks whose payload a decoder may leave unread.
_ANCILLARY = (_spec.CHUNK_METADATA, _spec.CHUNK_CAMERAS, _spec.CHUNK_OPTIONS, _spec.CHUNK_STATED_ERRORS)


@dataclass(frozen=True)
class View:
    """A rendering.

    Attributes:
        camera: K, viewmat, W, H and near, as a camera file has them.
        psnr: PSNR that a renderer's picture must reach against the reference, dB.
    """

    camera: dict[str, Any]
    psnr: float


@dataclass(frozen=True)
class Recipe:
    """One vector.

    Attributes:
        name: group and name, `valid/morton`.
        why: one line: what it shows, why it hurts.
        clauses: ids that it covers; for invalid files first the one it breaks.
        data: makes the file.
        scene: the scene that it must decode to; None if it must be refused.
        code: error code, if it must be refused.
        offset: the defect's byte, if a single one is to blame.
        also: further codes that a decoder may report.
        optional: type of the chunk in whose payload the defect lies, `META`: decoders that leave it unread (CHK-6)
            accept the file. Empty if every decoder refuses it.
        views: reference views, for scenes that are rendered.
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
    """Return the recipe of a file that holds a scene.

    Args:
        group: `valid`, `extreme` or `render`.
        name: name of the vector.
        why: one line.
        clauses: ids that it covers.
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
        why: one line: the defect.
        clauses: the one that is broken, and others that the vector covers.
        code: error code.
        base: the file, or the scene that it holds.
        changes: field to value, overwritten in the file; checksums are repaired.
        also: further codes that do as well.
        at: field that is to blame; by default the first that changes.
        within: byte within that field.
        cut: bytes that the payload of the last chunk lacks at its end; all sizes of the container follow.
    """
    built = build(base) if isinstance(base, Scene) else base
    changes = dict(changes or {})
    place = built.fields[at or next(iter(changes))].offset + within
    payloads = {_unread(field) for field in (changes if changes and not cut else (at,))}
    optional = payloads.pop() if len(payloads) == 1 else ""

    def data() -> bytes:
        if cut:
            return repair(built.patched(changes | _sizes(built, cut), repaired=False)[:-cut])
        return built.patched(changes) if changes else built.data

    return Recipe(f"invalid/{name}", why, tuple(clauses.split()), data, None, code, place, also, optional)


def _unread(field: str) -> str:
    """Return the ancillary chunk in whose payload a field lies, neither in its frame nor in its CRC; or nothing."""
    chunk, _, part = field.partition("/")
    return chunk if chunk.encode() in _ANCILLARY and part != "crc" and not part.startswith("header.") else ""


def _sizes(base: Built, cut: int) -> dict[str, int]:
    """Return the sizes of a file whose last chunk is shorter."""
    chunk, (offset, length) = max(base.spans.items(), key=lambda item: item[1])
    kind, *numbers = chunk.split(".")
    record = "tile[{}].layer[{}]".format(*numbers) if kind == "TILE" else f"directory[{chunk}]"
    return {
        f"{record}.size": length - cut,
        f"{chunk}/header.payload_size": length - _spec.CHUNK_HEADER_SIZE - cut,
        "header.file_size": offset + length - cut,
    }

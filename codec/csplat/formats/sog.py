"""SOG: lossless WebPs of what splats are beside a meta.json, in a folder or a zip; or many such, in levels."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np

from csplat.errors import counted
from csplat.foreign import zip_holds_meta
from csplat.formats.format import Format
from csplat.formats.sog_files import Json, Parts, parts_at
from csplat.formats.sog_read import COEFFICIENTS, Pictures, Unit, degree_of, unit_of
from csplat.formats.sog_write import write_sog
from csplat.lint import Finding
from csplat.model import SplatModel
from csplat.scene import Scene

__all__ = ["FORMAT"]

_MOST = 1 << 40


def _is_sog(path: Path, head: bytes) -> bool:
    if path.is_dir():
        return any((path / name).is_file() for name in ("meta.json", "lod-meta.json"))
    if head[:4] == b"PK\x03\x04":
        return zip_holds_meta(path)
    return head.lstrip()[:1] == b"{" and path.name.lower().endswith("meta.json")


@contextmanager
def _open(path: Path) -> Iterator[Scene]:
    parts, name = parts_at(path)
    meta = parts.json(name)
    if "lodLevels" in meta or "tree" in meta:
        yield _streamed(parts, meta)
        return
    unit = unit_of(parts, name)
    pictures = Pictures.of(unit)
    degree = COEFFICIENTS.index(pictures.palette.shape[1])
    facts = _facts(degree, antialiased=unit.antialiased, flat=unit.flat)

    def blocks() -> Iterator[SplatModel]:
        for arrays in pictures.blocks(degree):
            yield replace(facts, **arrays)

    yield Scene(unit.count, facts, blocks, _findings(pictures))


def _facts(degree: int, *, antialiased: bool, flat: bool) -> SplatModel:
    three = np.zeros((0, 3), np.float32)
    return SplatModel(
        means=three,
        quats=np.zeros((0, 4), np.float32),
        scales=three,
        opacities=np.zeros(0, np.float32),
        sh0=three,
        shN=np.zeros((0, COEFFICIENTS[degree], 3), np.float32),
        antialiased=antialiased,
        flat=flat,
    )


def _findings(pictures: Pictures) -> list[Finding]:
    if not pictures.zeros:
        return []
    text = f"{counted(pictures.zeros, 'rotation')} that none of four components is left out of: the identity"
    return [Finding("zero-quats", pictures.zeros, text, "repair")]


def _streamed(parts: Parts, meta: Json) -> Scene:
    """The finest level of streamed SOG, and its surroundings; a file of it is open at a time."""
    ranges = _finest(parts, meta)
    if "environment" in meta:
        ranges[meta["environment"].text()] = None
    units: list[tuple[Unit, list[tuple[int, int]]]] = []
    for name, wanted in ranges.items():
        unit = unit_of(*parts_at(parts.file(name), f"{parts.title}: {name}"))
        taken = [(0, unit.count)] if wanted is None else wanted
        if taken[-1][1] > unit.count:
            parts.refuse(f"splats up to {taken[-1][1]:,} of {name} are wanted, it has {unit.count:,}")
        units.append((unit, taken))
    degree = max([degree_of(unit) for unit, _ in units], default=0)
    facts = _facts(
        degree,
        antialiased=bool(units) and all(unit.antialiased for unit, _ in units),
        flat=bool(units) and all(unit.flat for unit, _ in units),
    )
    findings: list[Finding] = []
    seen: set[int] = set()

    def blocks() -> Iterator[SplatModel]:
        for number, (unit, taken) in enumerate(units):
            pictures = Pictures.of(unit)
            if number not in seen:
                seen.add(number)
                findings.extend(_findings(pictures))
            keep = np.zeros(unit.count, bool)
            for start, stop in taken:
                keep[start:stop] = True
            at = 0
            for arrays in pictures.blocks(degree):
                model = replace(facts, **arrays)
                chosen = keep[at : at + len(model)]
                at += len(model)
                if chosen.any():
                    yield model if chosen.all() else model.select(chosen)

    return Scene(sum(stop - start for _, taken in units for start, stop in taken), facts, blocks, findings)


def _finest(parts: Parts, meta: Json) -> dict[str, list[tuple[int, int]] | None]:
    """Which splats of which file the finest level has: ranges that do not overlap, in their order."""
    if "version" in meta and meta["version"].whole(1 << 30) != 1:
        parts.refuse(f"it is of version {meta['version'].value} of streamed SOG, wanted 1")
    names = [one.text() for one in meta["filenames"].list()]
    levels: dict[int, list[tuple[int, int, int]]] = {}
    nodes = [meta["tree"]]
    while nodes:
        node = nodes.pop()
        if "children" in node:
            nodes += reversed(node["children"].list())
        lods = node["lods"].value if "lods" in node else {}
        if not isinstance(lods, dict):
            parts.refuse(f"{node.place} lods is no object")
        for level, value in lods.items():
            reference = Json(parts, f"{node.place} lods", value)
            file = reference["file"].whole(len(names) - 1)
            start = reference["offset"].whole(_MOST)
            stop = start + reference["count"].whole(_MOST)
            if not (level.isdecimal() and level.isascii() and len(level) < 9):
                parts.refuse(f"{level[:20]!r} is no level")
            if stop > start:
                levels.setdefault(int(level), []).append((file, start, stop))
    found: dict[str, list[tuple[int, int]] | None] = {}
    before = (-1, 0, 0)
    for one in sorted(levels[min(levels)]) if levels else []:
        file, start, stop = one
        if file == before[0] and start < before[2]:
            parts.refuse(f"splats {start:,} to {before[2]:,} of {names[file][:80]} are wanted twice")
        if file != before[0] and names[file] in found:
            parts.refuse(f"filenames has {names[file][:80]} twice")
        ranges = found.setdefault(names[file], [])
        assert ranges is not None, "surroundings are added later"
        ranges.append((start, stop))
        before = one
    return found


FORMAT = Format(
    name="sog",
    title="SOG",
    suffixes=(".sog", "meta.json"),
    sniff=_is_sog,
    open=_open,
    write=write_sog,
    carries=frozenset({"antialiased", "flat"}),
)

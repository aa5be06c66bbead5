"""SOG: splat attributes as lossless WebPs next to a meta.json, in a folder or a zip; or many such, in levels."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np

from csplat.archives import folder_refusal, zip_refusal
from csplat.errors import counted
from csplat.formats.format import Format
from csplat.formats.sog_files import Json, Parts, parts_at, with_slashes
from csplat.formats.sog_read import COEFFICIENTS, Pictures, Unit, degree_of, unit_of
from csplat.formats.sog_write import write_sog
from csplat.lint import Finding
from csplat.model import SplatModel
from csplat.scene import Scene

_MOST = 1 << 40
_NAMES = (
    "means",
    "quats",
    "scales",
    "sh0",
    "lodLevels",
    "tree",
)  # keys of the JSON, some of which the JSON of one scene, or of levels, has
_Range = tuple[int, int, int]  # number of a file, first splat and the one behind the last


@contextmanager
def _open(path: Path, level: int = 0) -> Iterator[Scene]:
    parts, name = parts_at(path)
    with parts.held():
        yield _scene(path, parts, name, level)


def _scene(path: Path, parts: Parts, name: str, level: int) -> Scene:
    meta = parts.json(name)
    if isinstance(meta.value, dict) and not any(one in meta for one in _NAMES):
        where = folder_refusal(parts.path) if parts.folder is None else zip_refusal(path)
        parts.refuse(f"{name} is not that of SOG, which has {', '.join(_NAMES[:4])}; {where}")
    if "lodLevels" in meta or "tree" in meta:
        scene = _streamed(parts, meta, level)
        scene.findings.extend(parts.findings)
        return scene
    if level:
        parts.refuse(f"it has no levels, and level {level} is wanted")
    unit = unit_of(parts, name)
    pictures = Pictures.of(unit)
    degree = COEFFICIENTS.index(pictures.palette.shape[1])
    facts = _facts(degree, antialiased=unit.antialiased, flat=unit.flat)

    def blocks() -> Iterator[SplatModel]:
        for arrays in pictures.blocks(degree):
            yield replace(facts, **arrays)

    return Scene(unit.count, facts, blocks, [*parts.findings, *_findings(pictures)])


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


def _streamed(parts: Parts, meta: Json, level: int) -> Scene:
    """A level of streamed SOG, and its surroundings; a file of it is open at a time."""
    names, leaves = _leaves(parts, meta)
    last = max([max(one) for one in leaves], default=0)
    if level > last:
        parts.refuse(f"level {level} is wanted, its levels are 0 to {last}")
    findings: list[Finding] = []
    if any("\\" in name for name in names):
        findings.append(Finding("zip-names", 1, "backslashes in filenames, read as slashes", "note"))
        names = [with_slashes(name) for name in names]
    ranges = _ranges(parts, names, [_at(one, level) for one in leaves])
    if "environment" in meta:
        ranges[with_slashes(meta["environment"].text())] = None
    units: list[tuple[Unit, list[tuple[int, int]]]] = []
    for name, wanted in ranges.items():
        unit = unit_of(*parts.inner(name))
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

    count = sum(stop - start for _, taken in units for start, stop in taken)
    inside = [sum(stop - start for _, start, stop in (_at(leaf, one) for leaf in leaves)) for one in range(last + 1)]
    around = count - inside[level]
    return Scene(count, facts, blocks, findings, levels=tuple(one + around for one in inside))


def _leaves(parts: Parts, meta: Json) -> tuple[list[str], list[dict[int, _Range]]]:
    """The names of the files, and of each part of the scene the splats of its levels."""
    if "version" in meta and meta["version"].whole(1 << 30) != 1:
        parts.refuse(f"it is of version {meta['version'].value} of streamed SOG, wanted 1")
    names = [one.text() for one in meta["filenames"].list()]
    leaves: list[dict[int, _Range]] = []
    nodes = [meta["tree"]]
    while nodes:
        node = nodes.pop()
        if "lods" not in node:
            nodes += reversed(node["children"].list()) if "children" in node else []
            continue
        lods = node["lods"].value
        if not isinstance(lods, dict):
            parts.refuse(f"{node.place} lods is no object")
        leaf: dict[int, _Range] = {}
        for level, value in lods.items():
            reference = Json(parts, f"{node.place} lods", value)
            file = reference["file"].whole(len(names) - 1)
            start = reference["offset"].whole(_MOST)
            if not (level.isdecimal() and level.isascii() and len(level) < 3):
                parts.refuse(f"{level[:20]!r} is no level")
            leaf[int(level)] = file, start, start + reference["count"].whole(_MOST)
        leaves += [leaf] if leaf else []
    return names, leaves


def _at(leaf: dict[int, _Range], level: int) -> _Range:
    """Return the range of a part of the scene at a level, else at the next coarser one, else at its coarsest."""
    return leaf[min((one for one in leaf if one >= level), default=max(leaf))]


def _ranges(parts: Parts, names: list[str], wanted: list[_Range]) -> dict[str, list[tuple[int, int]] | None]:
    """Collect the ranges of splats to read from each file; they do not overlap and are in order."""
    found: dict[str, list[tuple[int, int]] | None] = {}
    before = (-1, 0, 0)
    for one in sorted(one for one in wanted if one[2] > one[1]):
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
    open=_open,
    open_level=_open,
    write=write_sog,
    carries=frozenset({"antialiased", "flat"}),
)

# SPDX-License-Identifier: CC0-1.0
"""Boundary cases: for each rule of the registry, files with the nearest forbidden values in the field.

The checks that refuse them are written by hand in the decoders and in the validator, so that the cases reveal a rule
that differs.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cache
from typing import Any, Final

from csplat import _spec
from csplat_authoring._rules import CHOICES, MASKS, RANGES, Choice, Mask, Range
from csplat_authoring.builder import Built, build
from csplat_authoring.recipe import Recipe, invalid_recipe
from csplat_authoring.samples import MEANS, SH0, attributes, morton, rich_scene, rows_of, scene, sparse, tile

Rule = Range | Choice | Mask

#: The field that an error reports instead of the one that is wrong.
_BLAMED: Final = {
    ("header", "version_minor"): "version_major",
    ("codebook_record", "band_last"): "band_first",
    ("declared_error_record", "rms"): "max",
}
#: Further codes with which a decoder may refuse, because it checks another clause first.
_ALSO: Final = {
    ("index_head", "axes"): ("E_UNSUPPORTED",),
    ("attribute_record", "mapping"): ("E_UNSUPPORTED",),
    ("directory_record", "flags"): ("E_VALUE",),
    ("tile_record", "extent"): ("E_BOX",),
}
#: Array fields whose last element is set instead of the first, because decoders have to check every element.
_LAST: Final = {("index_head", "origin"), ("tile_record", "corner"), ("tile_record", "extent")}
#: Layers that are required, or precede others.
_TIED: Final = {f"tile[{i}].layer[{layer}].layer" for i, layer in ((0, 0), (0, 1), (1, 0), (1, 1))}
#: Rules whose cases violate another clause with the same code; vectors for them are declared, with matching streams.
_NO_VECTORS: Final = {("stream_head", "width")}


@dataclass(frozen=True)
class BoundaryCase:
    """A file with one field that violates a rule.

    Attributes:
        rule: rule of the registry.
        base: the valid file.
        name: name of the field in the file.
        value: the new value of an element of the field.
        suffix: suffix that distinguishes the cases of a rule.
    """

    rule: Rule
    base: Built
    name: str
    value: float
    suffix: str

    @property
    def changes(self) -> dict[str, Any]:
        """New values of the field and of the fields that depend on it, so that nothing else is wrong."""
        changes = {self.name: self._with(self.name, self.value)}
        prefix, _, field = self.name.rpartition(".")
        if (self.rule.structure, field) == ("tile_record", "splat_count"):
            changes["index.splat_count"] = self.value
        elif (self.rule.structure, field) == ("tile_record", "corner"):
            changes[f"{prefix}.extent"] = self._with(f"{prefix}.extent", 0)
        elif (self.rule.structure, field) == ("codebook_record", "band_first"):
            changes[f"{prefix}.band_last"] = max(self.value, _holding(self.base, f"{prefix}.band_last")[0])
        elif (self.rule.structure, field, self.suffix) == ("declared_error_record", "rms", "above"):
            changes[f"{prefix}.max"] = math.nextafter(self.value, 0.0)
        elif (self.rule.structure, field) == ("directory_record", "flags"):
            chunk = prefix.removeprefix("directory[").removesuffix("]")
            changes[f"{chunk}/header.flags"] = self.value
        return changes

    @property
    def offset(self) -> int:
        """Offset of the byte to report."""
        return self.base.fields[self.blamed].offset + self.within

    @property
    def blamed(self) -> str:
        """Name of the field to report."""
        prefix, _, field = self.name.rpartition(".")
        return f"{prefix}.{_BLAMED.get((self.rule.structure, field), field)}"

    @property
    def within(self) -> int:
        """Offset of the element in its field."""
        entry = self.base.fields[self.name]
        return self._element * struct.calcsize(entry.format[-1])

    @property
    def _element(self) -> int:
        is_last = (self.rule.structure, self.rule.field) in _LAST
        return len(_holding(self.base, self.name)) - 1 if is_last else 0

    def _with(self, name: str, value: float) -> Any:
        """Return the value of a field with one element replaced."""
        values = list(_holding(self.base, name))
        values[self._element] = value
        return bytes(values) if self.base.fields[name].format.endswith("s") else tuple(values)

    def data(self) -> bytes:
        """Return the file, with valid checksums."""
        return self.base.patched(self.changes)


def cases() -> Iterator[BoundaryCase]:
    """Yield every case: both ends of each range, ids around each enum, each unlisted bit."""
    rules: tuple[Rule, ...] = (*RANGES, *CHOICES, *MASKS)
    for rule in rules:
        base, name = next((b, name) for b in _bases() for name in _places(b, rule) if name not in _TIED)
        for suffix, value in _beyond(rule, base.fields[name].format[-1]):
            now = _holding(base, name)[0]
            yield BoundaryCase(rule, base, name, int(now) | int(value) if isinstance(rule, Mask) else value, suffix)


def boundary_recipes() -> list[Recipe]:
    """Return recipes for the cases; of a mask only the first bit, and the last bit if it has more than eight."""
    result = []
    for case in cases():
        rule = case.rule
        if (rule.structure, rule.field) in _NO_VECTORS:
            continue
        if isinstance(rule, Mask):
            bits = [bit for bit in range(rule.bits) if not rule.listed >> bit & 1]
            if case.suffix not in (f"bit_{bits[0]}", f"bit_{bits[-1] if rule.bits > 8 else bits[0]}"):
                continue
        of = f"_{rule.of.lower().replace(' ', '_')}" if rule.of else ""
        result.append(
            invalid_recipe(
                f"{rule.structure}_{rule.field}{of}_{case.suffix}",
                f"{rule.field} of the structure {rule.structure} is {case.value}",
                rule.clause,
                rule.code,
                case.base,
                case.changes,
                _ALSO.get((rule.structure, rule.field), ()),
                at=case.blamed,
                within=case.within,
            )
        )
    return result


def held(built: Built, rule: Rule) -> set[float]:
    """Return the values of the fields of a file to which a rule applies."""
    values: set[float] = set()
    for name in _places(built, rule):
        values |= set(_holding(built, name))
    return values


def _holding(built: Built, name: str) -> tuple[Any, ...]:
    """Return the elements of a field of a file."""
    entry = built.fields[name]
    return struct.unpack_from(entry.format.replace("s", "B"), built.data, entry.offset)


def _places(built: Built, rule: Rule) -> Iterator[str]:
    """Yield the fields of a file to which a rule applies."""
    for name, entry in built.fields.items():
        prefix, _, field = name.rpartition(".")
        if (entry.structure, field) != (rule.structure, rule.field):
            continue
        if not rule.of or rule.of in _words(built, rule.structure, prefix):
            yield name


def _beyond(rule: Rule, code: str) -> Iterator[tuple[str, float]]:
    """Yield the nearest forbidden values that the struct code can represent; for a mask, bits."""
    if isinstance(rule, Choice):
        yield from ((f"is_{value}", value) for value in rule.others)
    elif isinstance(rule, Mask):
        yield from ((f"bit_{bit}", 1 << bit) for bit in range(rule.bits) if not rule.listed >> bit & 1)
    else:
        is_float = code in "fd"
        below = math.nextafter(rule.low, -math.inf) if is_float else rule.low - 1
        above = math.nextafter(rule.high, math.inf) if is_float else rule.high + 1
        for suffix, value in (("below", below), ("above", above)):
            try:
                struct.pack("<" + code, value)
            except struct.error:
                continue
            yield suffix, value


@cache
def _bases() -> tuple[Built, ...]:
    """Return a file without tiles, whose records nothing uses, a small file, and two with all other structures."""
    known = (_spec.DIRECTION_RIGHT, _spec.DIRECTION_DOWN, _spec.DIRECTION_FORWARD)
    rich = rich_scene()
    second = replace(rich.tiles[1], blocks=rich.tiles[1].blocks | {MEANS: morton([[0, 1, 0], [1, 0, 0]], 2)})
    every = replace(
        rich, tiles=(rich.tiles[0], second), sh_degree=4, attributes=attributes(4, ycocg=True, chroma_shift=1)
    )
    mixed = attributes(1) | {SH0 + 1: attributes(1, ycocg=True)[SH0 + 1]}
    some = tile(9, 3, 0, {SH0 + 1: sparse((1, 0, 1), rows_of(1, 2, 9, -9, 9))})
    return build(scene(1, [], axes=known, attributes=mixed)), build(scene()), build(every), build(scene(1, [some]))


def _words(built: Built, structure: str, prefix: str) -> set[str]:
    """Return the values of `of` in rules for a structure: attribute, mapping, codebook kind or coding."""

    def number(field: str) -> int:
        return int(_holding(built, f"{prefix}.{field}")[0])

    if structure == "attribute_record":
        attribute, mapping = number("attribute"), number("mapping")
        kind = "lattice" if _spec.ATTRIBUTE_KIND[attribute] == "lattice" else "level"
        is_shifted = mapping == _spec.MAPPING_YCOCG
        words = {"scales and colours"} if kind == "lattice" and attribute != MEANS else set()
        return words | {
            _spec.ATTRIBUTE_NAMES[attribute],
            f"{kind} attributes",
            "YCOCG" if is_shifted else "other mappings",
        }
    if structure == "codebook_record":
        return {"SH" if number("kind") == _spec.CODEBOOK_KIND_SH else "SHAPE"}
    block, _, part = prefix.rpartition(".")
    if structure == "lattice_params":
        return {block.rpartition("/")[2]}
    if structure == "stream_head":
        if prefix.startswith("CODB"):
            return {"entries of codebooks"}
        if not prefix.startswith("TILE"):
            return {"JSON"}
        if block.endswith(".summand"):
            return {"OFFSET"}
        if part == "mask":
            return {"masks"}
        coding = _spec.CODING_CODEBOOK if part.startswith("indices") else _holding(built, f"{block}.coding")[0]
        return {_spec.CODING_NAMES[coding].upper()}
    return set()

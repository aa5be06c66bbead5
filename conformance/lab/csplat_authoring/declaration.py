# SPDX-License-Identifier: CC0-1.0
"""Scenes and vectors declared in TOML.

Each file of `chapters/` covers a section of the specification. A table is a vector: `[valid.NAME]`, `[extreme.NAME]` or
`[invalid.NAME]`. The keys from `code` on are only for invalid vectors:

| key | meaning |
|---|---|
| why | description, one line |
| clauses | ids, the violated one first |
| scene | the scene of the file; default: one tile of two splats |
| base | name of a shared scene: `rich`, or a key of the table `scenes` of the file |
| code | error code |
| set | fields to overwrite, and their values (`_value`); checksums are repaired |
| swap | two layer records to swap |
| cut | bytes missing at the end of the last chunk, or the field in which it ends and its remaining bytes |
| at, within | field to report, and byte in it; default: the first overwritten field |
| also | further acceptable codes |

A scene starts as `samples.scene`, or as `samples.rich_scene` (`like = "rich"`). A tile starts as `samples.tile`, or as
tile K of the rich scene (`like = K`). The other keys are changes. Rows are arrays, `{ seed, size, range }` or
`{ all, size }`. A mask is a string of 0 and 1. Bytes are strings of characters up to U+00FF. Numbers near a power of 2
are strings: `"2^22 + 1"`, `"-2^-30"`.
"""

from __future__ import annotations

import re
import struct
import tomllib
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any, Final

from csplat import _spec
from csplat_authoring.builder import Built, build
from csplat_authoring.recipe import Recipe, invalid_recipe, valid_recipe
from csplat_authoring.samples import attributes, rich_scene, rows_of, scene, tile
from csplat_authoring.scene import (
    PAIRS,
    PLAIN,
    Attribute,
    Block,
    Chunk,
    Codebook,
    DeclaredErrors,
    Extra,
    Node,
    Rows,
    Scene,
    Stream,
    Tile,
)

_POWER: Final = re.compile(r"(-)?2\^(-?\d+)( [+-] \d+)?")
_FOLDER: Final = Path(__file__).parent / "chapters"


def _ids(names: Mapping[int, str]) -> dict[str, int]:
    return {name: value for value, name in names.items()}


_ATTRIBUTES: Final = _ids(_spec.ATTRIBUTE_NAMES)
_CODINGS: Final = _ids(_spec.CODING_NAMES)
_KINDS: Final = _ids(_spec.CODEBOOK_KIND_NAMES)
_MAPPINGS: Final = _ids(_spec.MAPPING_NAMES)
_MEASURES: Final = _ids(_spec.MEASURE_NAMES)
_TRANSFORMS: Final = _ids(_spec.TRANSFORM_NAMES)
_DTYPES: Final = _ids(_spec.EXTRA_DTYPE_NAMES)

#: Names of values, by field.
_NAMED: Final = {
    "attribute": _ATTRIBUTES,
    "coding": _CODINGS,
    "kind": _KINDS,
    "mapping": _MAPPINGS,
    "measure": _MEASURES,
    "dtype": _DTYPES,
}


def declared_recipes(*groups: str) -> list[Recipe]:
    """Return the recipes of some groups, `valid`, `extreme` or `invalid`, chapter by chapter."""
    return [recipe for path in sorted(_FOLDER.glob("*.toml")) for recipe in _recipes(path, groups)]


def _recipes(path: Path, groups: Collection[str]) -> Iterator[Recipe]:
    tables = _numbers(tomllib.loads(path.read_text(encoding="utf-8")))
    scenes = tables.get("scenes", {})

    @cache
    def scene_named(name: str) -> Scene:
        return rich_scene() if name == "rich" else declared_scene(scenes[name])

    @cache
    def built_named(name: str) -> Built:
        return build(scene_named(name))

    for group in groups:
        for name, table in tables.get(group, {}).items():
            named = table.get("base")
            made = scene_named(named) if named else declared_scene(table.get("scene", {}))
            if group == "invalid":
                yield _invalid(name, table, built_named(named) if named else build(made))
            else:
                yield _valid(group, name, table, made)


def _numbers(value: Any) -> Any:
    """Return a TOML value with strings such as `-2^22 + 1` converted to numbers."""
    if isinstance(value, dict):
        return {key: _numbers(one) for key, one in value.items()}
    if isinstance(value, list):
        return [_numbers(one) for one in value]
    found = _POWER.fullmatch(value) if isinstance(value, str) else None
    if not found:
        return value
    sign, exponent, more = found.groups()
    power = 2 ** int(exponent)
    return (-power if sign else power) + int((more or "0").replace(" ", ""))


def _valid(group: str, name: str, table: dict[str, Any], made: Scene) -> Recipe:
    unknown = {*table} - {*["why", "clauses", "scene", "base"]}
    assert not unknown, f"{name}: {unknown}"
    return valid_recipe(group, name, table["why"], table["clauses"], made)


def _invalid(name: str, table: dict[str, Any], base: Built) -> Recipe:
    unknown = {*table} - {*["why", "clauses", "code", "scene", "base", "set", "swap", "cut", "at", "within", "also"]}
    assert not unknown, f"{name}: {unknown}"
    changes = {field: _value(base, field, value) for field, value in table.get("set", {}).items()}
    if "swap" in table:
        changes |= _swap_fields(base, *table["swap"])
    cut = table.get("cut", 0)
    if not isinstance(cut, int):
        cut = len(base.data) - base.fields[cut["in"]].offset - cut["left"]
    row = {key: table[key] for key in ("why", "clauses", "code", "at", "within") if key in table}
    return invalid_recipe(name, base=base, changes=changes, also=tuple(table.get("also", ())), cut=cut, **row)


def _value(base: Built, field: str, value: Any) -> Any:
    """Return a value of `set`: a number, a name, bytes, the elements of a field, or a value relative to the base.

    `{ of = "index.splat_count", plus = 1 }` is the value of a field of the base plus a number, or plus a list of
    numbers for an array; `ulps` instead of `plus` counts binary32 numbers. `{ size = "index_head", plus = 3 }` is the
    size of a structure plus a number.
    """
    entry, name = base.fields[field], field.rpartition(".")[2]
    if isinstance(value, dict):
        return _relative(base, **value)
    if name == "transforms":
        return bytes(_TRANSFORMS.get(one, one) for one in value).ljust(entry.size, b"\0")
    if isinstance(value, str):
        return _NAMED[name][value] if name in _NAMED else value.encode("latin-1").ljust(entry.size, b"\0")
    return bytes(value) if isinstance(value, list) and entry.format.endswith("s") else value


def _relative(
    base: Built, of: str = "", size: str = "", plus: int | list[int] = 0, ulps: int = 0
) -> int | float | tuple[Any, ...]:
    if size:
        assert isinstance(plus, int)
        return int(getattr(_spec, f"{size.upper()}_SIZE")) + plus
    values = struct.unpack_from(base.fields[of].format, base.data, base.fields[of].offset)
    if ulps:
        (bits,) = struct.unpack("<i", struct.pack("<f", *values))
        return float(*struct.unpack("<f", struct.pack("<i", bits + ulps)))
    return tuple(value + more for value, more in zip(values, plus if isinstance(plus, list) else [plus], strict=True))


def _swap_fields(base: Built, one: str, other: str) -> dict[str, Any]:
    keys = [f"{name}.{key}" for name in (one, other) for key in ("layer", "size", "offset")]
    values = [struct.unpack_from(base.fields[k].format, base.data, base.fields[k].offset) for k in keys]
    return dict(zip(keys, values[3:] + values[:3], strict=True))


# Scenes --------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _PartialTile(Tile):
    """A tile with only some of its layers in the file."""

    present: tuple[int, ...] = ()

    @property
    def layers(self) -> list[int]:
        return list(self.present)


def declared_scene(table: dict[str, Any]) -> Scene:
    """Return the scene that a table declares."""
    rest = dict(table)
    degree = rest.get("sh_degree", 0)
    like = rich_scene() if rest.pop("like", "") else None
    made = like or scene(degree)
    records = made.attributes
    if "colours" in rest:
        records = attributes(degree, **rest.pop("colours"))
    if "attributes" in rest:
        changes = rest.pop("attributes")
        records = records | {
            _ATTRIBUTES[name]: _attribute(records.get(_ATTRIBUTES[name]), change) for name, change in changes.items()
        }
    if "records" in rest:
        records = {_ATTRIBUTES[name]: records[_ATTRIBUTES[name]] for name in rest.pop("records")}
    values: dict[str, Any] = {"attributes": records}
    for key, value in rest.items():
        if key == "tiles":
            values[key] = tuple(_tile(one, degree, like) for one in value)
        elif key == "codebooks":
            values[key] = tuple(_codebook(one) for one in value)
        elif key == "extras":
            values[key] = tuple(Extra(name, _DTYPES.get(dtype, dtype), *more) for name, dtype, *more in value)
        elif key == "chunks":
            values[key] = tuple(_chunk(one) for one in value)
        elif key == "nodes":
            values[key] = tuple(Node(_spec.NO_PARENT if parent == "none" else parent, *rest) for parent, *rest in value)
        elif key == "tails":
            values[key] = tuple((kind, tail.encode("latin-1")) for kind, tail in value.items())
        elif key in ("gap", "trailing"):
            values[key] = value.encode("latin-1")
        else:
            values[key] = tuple(value) if isinstance(value, list) else value
    return replace(made, **values)


def _attribute(old: Attribute | None, table: dict[str, Any]) -> Attribute:
    named = {key: _MAPPINGS[value] if key == "mapping" else value for key, value in table.items()}
    if "step" in named:
        named["step"] = float(named["step"])
    return replace(old or Attribute(0), **named)


def _tile(table: dict[str, Any], degree: int, whole: Scene | None) -> Tile:
    rest = dict(table)
    if "like" in rest:
        assert whole is not None
        made = whole.tiles[rest.pop("like")]
    else:
        made = tile(rest.pop("seed", 1), rest.pop("n", 2), rest.pop("degree", degree))
    blocks = dict(made.blocks)
    values: dict[str, Any] = {}
    for key, value in rest.items():
        if key in _ATTRIBUTES:
            if value is False:
                del blocks[_ATTRIBUTES[key]]
            else:
                blocks[_ATTRIBUTES[key]] = _block(value)
        elif key == "extras":
            values[key] = tuple(_block(one) for one in value)
        elif key == "order":
            values[key] = tuple(_ATTRIBUTES[name] for name in value)
        elif key in ("tails", "unknown"):
            values[key] = tuple((int(layer), payload.encode("latin-1")) for layer, payload in value.items())
        elif key != "layers":
            values[key] = tuple(value) if isinstance(value, list) else value
    made = replace(made, blocks=blocks, **values)
    return _PartialTile(**vars(made), present=tuple(rest["layers"])) if "layers" in rest else made


def _block(table: dict[str, Any]) -> Block:
    coding = table.get("coding", "codebook")
    values: dict[str, Any] = {}
    for key, value in table.items():
        if key == "rows":
            values[key] = _rows(value)
        elif key == "escape":
            values[key] = _block(value)
        elif key == "mask":
            values[key] = tuple(int(bit) for bit in value)
        elif key == "tail":
            values[key] = value.encode("latin-1")
        elif key in _STREAMS:
            plain = PAIRS if key == "stream" and coding == "morton" else PLAIN
            values[_STREAMS[key]] = _stream(value, plain)
        elif key != "coding":
            values[key] = tuple(value) if isinstance(value, list) else value
    if coding == "morton":
        values.setdefault("stream_coding", PAIRS)
    return Block(_CODINGS[coding], **values)


_STREAMS: Final = {"stream": "stream_coding", "mask_stream": "mask_coding", "index_stream": "index_coding"}


def _stream(table: dict[str, Any], plain: Stream = PLAIN) -> Stream:
    values = dict(table)
    if "transforms" in values:
        values["transforms"] = tuple(_TRANSFORMS[name] for name in values["transforms"])
    for key in ("packed", "coded"):
        if key in values:
            values[key] = values[key].encode("latin-1")
    return replace(plain, **values)


def _rows(value: list[list[int]] | dict[str, Any]) -> Rows:
    if isinstance(value, list):
        return value
    if "all" in value:
        return [value["all"]] * int(value["size"])
    return rows_of(value["seed"], *value["size"], *value["range"])


def _codebook(table: dict[str, Any]) -> Codebook:
    return Codebook(
        table["id"],
        _KINDS[table["kind"]],
        {int(layer): _rows(rows) for layer, rows in table["entries"].items()},
        tuple(table.get("bands", (0, 0))),
        _stream(table.get("stream", {}), PAIRS),
        table.get("tail", "").encode("latin-1"),
    )


def _chunk(table: dict[str, Any]) -> Chunk:
    values: dict[str, Any] = {}
    for key, value in table.items():
        if key == "errors":
            records = tuple((_MEASURES[measure], largest, rms) for measure, largest, rms in value["records"])
            values[key] = DeclaredErrors(**(value | {"records": records}))
        elif key == "stream":
            values["stream_coding"] = _stream(value)
        else:
            values[key] = value.encode("latin-1") if isinstance(value, str) else value
    return Chunk(**values)

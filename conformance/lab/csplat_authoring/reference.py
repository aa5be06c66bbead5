# SPDX-License-Identifier: CC0-1.0
"""Compute the expected result of decoding a scene, directly from the formulae of the spec (sections 6.4.5, 7, 9.2).

It uses Python integers and single IEEE operations: slow on purpose, and independent of `csplat.decoder`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from csplat import _spec
from csplat_authoring.scene import Block, Node, Rows, Scene, Tile, attribute_named, band_of

Array = NDArray[Any]

#: NumPy's names for the types of extra columns, by registry value.
EXTRA_DTYPES = {value: f"<{name[0]}{_spec.EXTRA_DTYPE_BYTES[value]}" for value, name in _spec.EXTRA_DTYPE_NAMES.items()}

_ROOT_2 = float.fromhex("0x1.6A09E667F3BCDp+0")
#: Smallest and largest corner of a box.
_Box = tuple[list[float], list[float]]
_FAR = 1e300  # beyond every centre
_BOXES = 6  # tiles or regions of a level, at most, from whose sides boxes start
_COLOURS = range(_spec.ATTRIBUTE_SH0, _spec.ATTRIBUTE_SH4 + 1)


@dataclass
class Expected:
    """Header fields and arrays; for files with levels or several tiles, some cuts and their tiles or error codes."""

    header: dict[str, Any]
    integers: dict[str, Array] = field(default_factory=dict)
    floats: dict[str, Array] = field(default_factory=dict)
    extra: dict[str, Array] = field(default_factory=dict)
    cuts: list[tuple[str, list[int] | str]] = field(default_factory=list)


def expected(scene: Scene, index_size: int) -> Expected:
    """Compute the expected result in the manifest for a valid file, whose index has `index_size` bytes."""
    result = Expected(_header(scene, index_size))
    rows = {attribute: _all_rows(scene, attribute) for attribute in scene.attributes}
    result.integers = _integers(scene, rows)
    if scene.nodes or len(scene.tiles) > 1:
        result.cuts = _cuts(scene)
    if scene.nodes:
        scene = scene.finest
        rows = {attribute: tiles[: len(scene.tiles)] for attribute, tiles in rows.items()}
    result.floats = _floats(scene, rows)
    for i, extra in enumerate(scene.extras):
        if not extra.is_known:
            continue  # ANC-3
        bits = [row for tile in scene.tiles for row in tile.extras[i].rows]
        unsigned = np.array(bits, f"<u{_spec.EXTRA_DTYPE_BYTES[extra.dtype]}").reshape(-1, extra.components)
        values = unsigned.view(EXTRA_DTYPES[extra.dtype])
        result.extra[extra.name] = values if extra.components > 1 else values[:, 0]
    return result


def _header(scene: Scene, index_size: int) -> dict[str, Any]:
    return {
        "profile": _spec.PROFILE_NAMES[_spec.PROFILE_BASE],
        "resource_level": _spec.RESOURCE_LEVEL_NAMES[required_level(scene, index_size)],
        "splat_count": sum(tile.splat_count for tile in scene.finest.tiles),
        "tile_count": len(scene.tiles),
        "sh_degree": scene.sh_degree,
        "scene_flags": [name for bit, name in _spec.SCENE_FLAG_NAMES.items() if scene.scene_flags & bit],
        "axes": "".join(_spec.DIRECTION_LETTER[axis] for axis in scene.axes),
        "unit_metres": scene.unit_metres or 0.0,  # 0 of either sign is 0
        "origin": list(scene.origin),
        "kernel": _spec.KERNEL_NAMES[scene.kernel],
        "projection": scene.projection,
        "antialiasing": scene.antialiasing,
        "colour_space": scene.colour_space,
        "extra_columns": [[extra.name, extra.semantic] for extra in scene.extras if extra.is_known],
    }


def required_level(scene: Scene, index_size: int) -> int:
    """Return the lowest resource level that the contents allow (8.1); `index_size` is in bytes."""
    extra_bytes = sum(extra.splat_bytes for extra in scene.extras)
    splat_bytes = 4 * (11 + 3 * (scene.sh_degree + 1) ** 2)
    coarsest: list[Tile] = [] if scene.nodes else list(scene.tiles)
    left = list(scene.tiles)
    for node in scene.nodes:
        if node.parent == _spec.NO_PARENT:
            coarsest += left[: node.tile_count]
        left = left[node.tile_count :]
    with_extras = all(tile.level == 0 for tile in coarsest)
    sizes = {
        "index": index_size,
        "codebook": sum(4 * len(rows) * len(rows[0]) for book in scene.codebooks for rows in book.entries.values()),
        "tile": max((t.splat_count * (splat_bytes + (t.level == 0) * extra_bytes) for t in scene.tiles), default=0),
        "version": sum(tile.splat_count for tile in coarsest) * (splat_bytes + with_extras * extra_bytes),
    }
    for level in sorted(_spec.RESOURCE_LEVEL_NAMES):
        bounds = {name: getattr(_spec, f"RESOURCE_LEVEL_{name.upper()}_BYTES").get(level) for name in sizes}
        if all(bound is None or sizes[name] <= bound for name, bound in bounds.items()):
            return level
    raise AssertionError("the highest level has bounds")


def _cuts(scene: Scene) -> list[tuple[str, list[int] | str]]:
    """Return cuts by every level, by pixel sizes at and around each error, by several budgets, and in boxes.

    A file without levels has boxes alone.
    """
    records = scene.nodes or (Node(_spec.NO_PARENT, len(scene.tiles), 0.0),)
    nodes = [_Node(n, scene, records) for n in range(len(records))]
    for node in nodes:
        node.children = [child for child in nodes if child.parent == node.number]
    roots = [node for node in nodes if node.parent == _spec.NO_PARENT]
    boxes = _box_cuts(scene, nodes, roots)
    if not scene.nodes:
        return boxes
    errors = [node.error for node in nodes]
    around = {size for e in errors for size in (math.nextafter(e, -1.0), e, math.nextafter(e, math.inf)) if size >= 0}
    mixed = [[errors[(step * n + 1) % len(errors)] for n in range(len(errors))] for step in (1, 3)]
    sizes: list[float | list[float]] = [*sorted(around), 1e300, *mixed]
    levels = sorted({node.level for node in nodes})
    cuts: list[tuple[str, list[int] | str]] = [
        (f"level {level}", _tiles_of(_descend(roots, [node.level > level for node in nodes])))
        for level in (*levels[:: 1 + len(levels) // 8], 255)
    ]
    for size in sizes:
        limits = size if isinstance(size, list) else [size] * len(nodes)
        words = " ".join(map(repr, size if isinstance(size, list) else [size]))
        is_replaced = [error > limit for error, limit in zip(errors, limits, strict=True)]
        cuts.append((f"pixel_size {words}", _tiles_of(_descend(roots, is_replaced))))
    least = sum(node.splats for node in roots)
    most = sum(node.splats for node in nodes if node.level == 0)
    budgets = sorted({least - 1, least, least + 1, (least + most) // 2, most - 1, most, 2**40})
    return [*cuts, *((f"splats {budget}", _limited(roots, budget)) for budget in budgets), *boxes]


def _box_cuts(scene: Scene, nodes: list[_Node], roots: list[_Node]) -> list[tuple[str, list[int] | str]]:
    """Return cuts in half spaces that end at sides of boxes and regions, or just before, and in some corners."""
    boxes = [tile_box(scene, tile) for tile in scene.tiles]
    cuts: dict[str, list[int] | str] = {}  # boxes may share a side

    def select(cut: str, chosen: list[_Node], low: list[float], high: list[float]) -> None:
        tiles = [
            number for node in chosen for number in node.tiles
            if _touch(boxes[number] if node.level == 0 else node.region(boxes), (low, high))
        ]  # fmt: skip
        cuts[f"{cut} box {' '.join(map(repr, low + high))}"] = sorted(tiles)

    below, above = [-_FAR] * 3, [_FAR] * 3
    for level in sorted({0, *(node.level for node in nodes)})[:2]:
        cut = _descend(roots, [node.level > level for node in nodes])
        edges = [node.region(boxes) for node in cut if node.level > 0] if level else boxes
        for number, (low, high) in enumerate(edges[:: 1 + len(edges) // _BOXES]):
            axis = number % 3
            for edge in (high[axis], math.nextafter(high[axis], math.inf)):
                select(f"level {level}", cut, [edge if i == axis else -_FAR for i in range(3)], above)
            for edge in (low[axis], math.nextafter(low[axis], -math.inf)):
                select(f"level {level}", cut, below, [edge if i == axis else _FAR for i in range(3)])
            select(f"level {level}", cut, low, low)
            select(f"level {level}", cut, high, high)
    if scene.nodes:
        error, middle = max(node.error for node in nodes) / 2, boxes[0][1]
        select(f"pixel_size {error!r}", _descend(roots, [node.error > error for node in nodes]), middle, above)
        budget = sum(node.splats for node in roots)  # includes splats outside the box
        select(f"splats {budget}", _refine(roots, budget), middle, above)
    return [*cuts.items()]


def tile_box(scene: Scene, tile: Tile) -> _Box:
    """Return the box of a tile (spec 4.3.5): the smallest and the largest values of its means."""
    step = scene.attributes[_spec.ATTRIBUTE_MEANS].step
    rows = block_rows(scene, tile, _spec.ATTRIBUTE_MEANS, tile.blocks[_spec.ATTRIBUTE_MEANS])
    values = [
        [float(lattice_value(corner + q, step, tile.exponent)) for q in column]
        for corner, column in zip(tile.corner, zip(*rows, strict=True), strict=True)
    ]
    return [min(column) for column in values], [max(column) for column in values]


def _touch(one: _Box, other: _Box) -> bool:
    return all(a <= d and b >= c for a, b, c, d in zip(*one, *other, strict=True))


class _Node:
    def __init__(self, number: int, scene: Scene, records: Sequence[Node]) -> None:
        first = sum(node.tile_count for node in records[:number])
        record = records[number]
        self.number, self.parent = number, record.parent
        self.error = float(np.float32(record.error))
        self.tiles = [*range(first, first + record.tile_count)]
        self.level = scene.tiles[first].level
        self.splats = sum(scene.tiles[i].splat_count for i in self.tiles)
        self.children: list[_Node] = []

    def region(self, boxes: list[_Box]) -> _Box:
        parts = [boxes[number] for number in self.tiles] + [child.region(boxes) for child in self.children]
        lows, highs = ([*zip(*ends, strict=True)] for ends in zip(*parts, strict=True))
        return [min(axis) for axis in lows], [max(axis) for axis in highs]


def _tiles_of(nodes: list[_Node]) -> list[int]:
    return sorted(tile for node in nodes for tile in node.tiles)


def _descend(nodes: list[_Node], is_replaced: list[bool]) -> list[_Node]:
    """Return the first node from each of the given ones that is not replaced by its children."""
    found: list[_Node] = []
    for node in nodes:
        found += _descend(node.children, is_replaced) if is_replaced[node.number] else [node]
    return found


def _limited(roots: list[_Node], budget: int) -> list[int] | str:
    fits = sum(node.splats for node in roots) <= budget
    return _tiles_of(_refine(roots, budget)) if fits else _spec.ERROR_LIMIT


def _refine(roots: list[_Node], budget: int) -> list[_Node]:
    """Replace one node at a time while the budget lasts."""
    cut = list(roots)
    while any(node.children for node in cut):
        worst = max((node for node in cut if node.children), key=lambda node: (node.error, node.number))
        finer = [node for node in cut if node is not worst] + worst.children
        if sum(node.splats for node in finer) > budget:
            break
        cut = finer
    return cut


def block_rows(scene: Scene, tile: Tile, attribute: int, block: Block) -> list[list[int]]:
    """Return [n, C] integers of a block: q for means; colours before the lifting of 7.1."""
    if block.coding == _spec.CODING_SPARSE:
        present, zeros = iter(block.rows), [0] * _spec.ATTRIBUTE_COLUMNS[attribute]
        return [list(next(present)) if bit else zeros for bit in block.mask]
    if block.coding != _spec.CODING_CODEBOOK:
        return [list(row) for row in block.rows]
    book = next(book for book in scene.codebooks if book.id == block.codebook)
    first = next(b for b in tile.blocks.values() if b.codebook == book.id and b.indices)
    layer, columns = band_of(attribute), _spec.ATTRIBUTE_COLUMNS[attribute]
    start = 0
    if attribute == _spec.ATTRIBUTE_QUATS:
        start = _spec.ATTRIBUTE_COLUMNS[_spec.ATTRIBUTE_SCALES]
    entries = book.entries[layer]
    escaped = iter(block.escape.rows if block.escape else ())
    result = []
    for splat, index in enumerate(first.indices):
        if index == len(entries):
            result.append(list(next(escaped)))
            continue
        summand = block.summands[splat] if block.summands else 0
        result.append([summand + value for value in entries[index][start : start + columns]])
    return result


def _all_rows(scene: Scene, attribute: int) -> list[list[list[int]]]:
    """Return the integers of an attribute for each tile, with zeros for omitted bands."""
    zero = [0] * _spec.ATTRIBUTE_COLUMNS[attribute]
    result = []
    for tile in scene.tiles:
        block = tile.blocks.get(attribute)
        rows = block_rows(scene, tile, attribute, block) if block else [zero] * tile.splat_count
        if attribute in _COLOURS:
            rows = _lift(scene, attribute, rows)
        if attribute == _spec.ATTRIBUTE_MEANS:
            rows = [[c + q for c, q in zip(tile.corner, row, strict=True)] for row in rows]
        result.append(rows)
    return result


def _lift(scene: Scene, attribute: int, rows: Rows) -> list[list[int]]:
    """Return the columns R, G, B of each coefficient in the order of the file's columns (spec 7.1)."""
    record = scene.attributes[attribute]
    if record.mapping != _spec.MAPPING_YCOCG:
        return [list(row) for row in rows]
    coefficients = 2 * band_of(attribute) + 1
    result = []
    for row in rows:
        lifted = [0] * len(row)
        for m in range(coefficients):
            y, co, cg = row[m], row[coefficients + m], row[2 * coefficients + m]
            co, cg = co * 2**record.chroma_shift, cg * 2**record.chroma_shift
            t = y - (cg >> 1)
            green = cg + t
            blue = t - (co >> 1)
            lifted[m], lifted[coefficients + m], lifted[2 * coefficients + m] = blue + co, green, blue
        result.append(lifted)
    return result


def _exponent(tile: Tile, attribute: int) -> int:
    if attribute == _spec.ATTRIBUTE_MEANS:
        return tile.exponent
    block = tile.blocks.get(attribute)
    return 0 if block is None else block.exponent


def _integers(scene: Scene, rows: dict[int, list[list[list[int]]]]) -> dict[str, Array]:
    dtypes = {_spec.ATTRIBUTE_OPACITIES: "<u4", _spec.ATTRIBUTE_QUATS: "<i4"}
    result: dict[str, Array] = {}
    for attribute, tiles in rows.items():
        flat = [row for tile in tiles for row in tile]
        columns = _spec.ATTRIBUTE_COLUMNS[attribute]
        array = np.array(flat, dtypes.get(attribute, "<i8")).reshape(len(flat), columns)
        if attribute == _spec.ATTRIBUTE_OPACITIES:
            array = array[:, 0].copy()
        elif band_of(attribute):
            array = np.ascontiguousarray(array.reshape(len(flat), 3, columns // 3).transpose(0, 2, 1))
        result[_spec.ATTRIBUTE_NAMES[attribute]] = array
    result["tile_splats"] = np.array([tile.splat_count for tile in scene.tiles], "<u4")
    table = [[_exponent(tile, attribute) for attribute in scene.attributes] for tile in scene.tiles]
    result["exponents"] = np.array(table, "<i4").reshape(len(scene.tiles), len(scene.attributes))
    return result


def lattice_value(n: int, step: float, exponent: int) -> np.float32:
    """Return the value of a lattice integer (spec 7.2)."""
    with np.errstate(over="ignore"):  # invalid files overflow on purpose
        return np.float32(float(n) * math.ldexp(step, exponent))


def _lattice(scene: Scene, attribute: int, rows: list[list[list[int]]]) -> Array:
    step, columns = scene.attributes[attribute].step, _spec.ATTRIBUTE_COLUMNS[attribute]
    products: list[list[float]] = []
    for tile, tile_rows in zip(scene.tiles, rows, strict=True):
        scale = math.ldexp(step, _exponent(tile, attribute))
        products += [[float(n) * scale for n in row] for row in tile_rows]
    with np.errstate(over="ignore"):  # as in `lattice_value`, but rounded together
        return np.array(products, np.float64).reshape(len(products), columns).astype("<f4")


def max_scale(scene: Scene, tile: Tile) -> float:
    """Return the largest decoded scale of a tile: the value of the largest integer."""
    attribute = _spec.ATTRIBUTE_SCALES
    block = tile.blocks[attribute]
    largest = max(max(row) for row in block_rows(scene, tile, attribute, block))
    return float(lattice_value(largest, scene.attributes[attribute].step, block.exponent))


def _floats(scene: Scene, rows: dict[int, list[list[list[int]]]]) -> dict[str, Array]:
    count = sum(tile.splat_count for tile in scene.tiles)
    result = {
        _spec.ATTRIBUTE_NAMES[attribute]: _lattice(scene, attribute, rows[attribute])
        for attribute in (_spec.ATTRIBUTE_MEANS, _spec.ATTRIBUTE_SCALES, _spec.ATTRIBUTE_SH0)
    }
    result["opacities"] = _opacities(scene, rows[_spec.ATTRIBUTE_OPACITIES])
    result["quats"] = _quats(scene, rows[_spec.ATTRIBUTE_QUATS])
    bands = []
    for band in range(1, scene.sh_degree + 1):
        attribute = attribute_named(f"sh{band}")
        values = _lattice(scene, attribute, rows[attribute])
        bands.append(values.reshape(count, 3, 2 * band + 1).transpose(0, 2, 1))
    result["shN"] = np.concatenate(bands, 1) if bands else np.zeros((count, 0, 3), "<f4")
    return {name: np.ascontiguousarray(array, "<f4") for name, array in result.items()}


def _opacities(scene: Scene, rows: list[list[list[int]]]) -> Array:
    record = scene.attributes[_spec.ATTRIBUTE_OPACITIES]
    m = record.levels
    power = 2 if record.mapping == _spec.MAPPING_SQUARE else 1
    return np.array([np.float32(float(q**power) / float(m**power)) for tile in rows for (q,) in tile], "<f4")


def _quats(scene: Scene, rows: list[list[list[int]]]) -> Array:
    m = scene.attributes[_spec.ATTRIBUTE_QUATS].levels
    c = 1.0 / (float(m) * _ROOT_2)
    values = []
    for tile in rows:
        for q1, q2, q3 in tile:
            r = 2 * m * m - q1 * q1 - q2 * q2 - q3 * q3
            w = np.float32(math.sqrt(float(r)) * c)
            values.append([w, *(np.float32(float(q) * c) for q in (q1, q2, q3))])
    return np.array(values, "<f4").reshape(len(values), 4)

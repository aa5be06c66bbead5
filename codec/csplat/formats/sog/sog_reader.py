# SPDX-License-Identifier: Apache-2.0
"""Read SOG, versions 1 and 2, and levels of streamed SOG.

A byte of an image interpolates between two bounds in version 1, and indexes a codebook in version 2. Follows
`read-sog.ts` and `read-sog-v1.ts` of splat-transform (MIT). The axes are the same as in the PLY that was converted to
SOG.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
from numpy.typing import NDArray

from csplat.archives import folder_refusal, zip_refusal
from csplat.errors import counted
from csplat.formats.common import crossed_bounds, decode_smallest_three
from csplat.formats.sog.sog_files import JsonValue, SogParts, decode_webp, find_parts, use_slashes
from csplat.lint import Finding, list_names, other_contents
from csplat.model import SplatModel
from csplat.ply.columns import alpha_of_logits
from csplat.portable_math import exp
from csplat.scene import BLOCK_SPLATS, Scene
from csplat.scene_metadata import SceneMetadata
from csplat.types import F32, I64, U8, U16

_MAX_OFFSET = 1 << 40  # splats
_MAX_VERSION = 1 << 30  # larger numbers are no versions
_CODES = 256  # codes of a byte of an image
_KEYS = ("means", "quats", "scales", "sh0", "lodLevels", "tree")  # a meta.json of another program has none of these
_SECTIONS = ("means", "scales", "quats", "sh0", "shN")
#: Keys that are read, or say by which program or how the file was made.
_KNOWN_KEYS = {"version", "asset", "generator", "count", "antialias", "model", *_SECTIONS}
_SECTION_KEYS = {"files", "shape", "dtype", "mins", "maxs", "codebook", "count", "bands", "encoding", "quantization"}
_ASSET_KEYS = {"generator", "version"}
_STREAMED_KEYS = {
    "version",
    "asset",
    "generator",
    "count",
    "counts",
    "lodErrors",
    "lodLevels",
    "filenames",
    "environment",
    "tree",
}
_NOTHING: tuple[object, ...] = (None, {}, [], "")  # values of keys that hold nothing
_SHOWN = 80  # characters of a name in messages
_Range = tuple[int, int, int]  # file index, first splat, end


@contextmanager
def open_sog(path: Path, level: int = 0, max_splats: int | None = None) -> Iterator[Scene]:
    """Open a file or folder (`Format.open`, `Format.open_level`)."""
    parts, name = find_parts(path)
    with parts.kept_open():
        yield _open_scene(path, parts, name, level, max_splats)


def read_leaf_numbers(path: Path, level: int = 0) -> I64:
    """Return the leaf of each splat of a level of streamed SOG, in the order of `open_sog`.

    Leaves are numbered in the order of the tree; splats of the environment have the number after the last. A leaf
    without the level is represented by its next coarser level, else by its coarsest.

    Raises:
        InputError: the file is no streamed SOG, or damaged.
        OSError: it cannot be read.
    """
    parts, name = find_parts(path)
    with parts.kept_open():
        meta = parts.json(name)
        if "tree" not in meta:
            parts.refuse("it is not streamed SOG, which has a tree of levels")
        _, leaves = _read_leaves(parts, meta)
        ranges = sorted((*_range_at(leaf, level), number) for number, leaf in enumerate(leaves))
        around = 0
        if "environment" in meta:
            around = read_meta(*parts.nested(use_slashes(meta["environment"].text()))).count
    numbers = [np.full(stop - start, number, np.int64) for _, start, stop, number in ranges]
    return np.concatenate([*numbers, np.full(around, len(leaves), np.int64)])


def _open_scene(path: Path, parts: SogParts, name: str, level: int, max_splats: int | None) -> Scene:
    """Open a SOG, or a level of streamed SOG.

    Args:
        path: path of the file or folder, for messages.
        parts: its parts.
        name: name of the JSON.
        level: level of streamed SOG; 0 for others.
        max_splats: see `_open_streamed`.
    """
    meta = parts.json(name)
    if isinstance(meta.value, dict) and not any(key in meta for key in _KEYS):
        where = folder_refusal(parts.path) if parts.folder is None else zip_refusal(path)
        parts.refuse(f"{name} is not the one of SOG, which has {', '.join(_KEYS[:4])}; {where}")
    if "lodLevels" in meta or "tree" in meta:
        scene = _open_streamed(parts, meta, level, max_splats)
        folders = [PurePosixPath(use_slashes(item.text())).parent for item in meta["filenames"].list()]
        folders += [PurePosixPath(use_slashes(meta["environment"].text())).parent] if "environment" in meta else []
        members = parts.unread_members([name], folders) if all(folder.parts for folder in folders) else []
        scene.findings.extend([*parts.findings, *_other_findings(_unread_keys(meta, _STREAMED_KEYS), members)])
        return scene
    if level:
        parts.refuse(f"it has no levels: level {level} cannot be read")
    sog = read_meta(parts, name)
    images = SogImages.of(sog)
    degree = COEFFICIENTS.index(images.palette.shape[1])
    metadata = SceneMetadata(antialiased=sog.antialiased, flat=sog.flat, quantised=True)

    def blocks() -> Iterator[SplatModel]:
        for arrays in images.blocks(degree):
            yield SplatModel(**arrays, metadata=metadata)

    used = [
        file.text() for key in _SECTIONS if key in meta and "files" in meta[key] for file in meta[key]["files"].list()
    ]
    others = _other_findings(_unread_keys(meta), parts.unread_members([name, *used]))
    return Scene(sog.count, degree, blocks, metadata, findings=[*parts.findings, *others, *_list_findings(images)])


def _unread_keys(meta: JsonValue, known: Collection[str] = _KNOWN_KEYS) -> list[str]:
    """Return the keys of a SOG's JSON, and of its sections, that have a value and are not read."""
    whole = meta.value
    unread = [key for key, value in whole.items() if key not in known and value not in _NOTHING]
    for section, read in (("asset", _ASSET_KEYS), *((name, _SECTION_KEYS) for name in _SECTIONS)):
        inside = whole.get(section)
        if section in known and isinstance(inside, dict):
            unread += [f"{section} {key}" for key, value in inside.items() if key not in read and value not in _NOTHING]
    return unread


def _other_findings(keys: Sequence[str], members: Sequence[str]) -> list[Finding]:
    """Return the finding about keys of the JSON and members of the zip that are not read, if there are any."""
    contents = [f"keys {list_names(keys)} of the JSON"] if keys else []
    return other_contents([*contents, *([f"files {list_names(members)} of the zip"] if members else [])])


def _list_findings(images: SogImages) -> list[Finding]:
    """Return a finding about rotations without a valid tag, if there are any."""
    if not images.zeros:
        return []
    text = f"{counted(images.zeros, 'rotation')} without a valid component tag: set to the identity"
    return [Finding("zero-quats", images.zeros, text, "repair")]


def _open_streamed(parts: SogParts, meta: JsonValue, level: int, max_splats: int | None) -> Scene:
    """Open a level of streamed SOG with its environment; blocks are read file by file.

    With `max_splats`, the level is the finest of at most this number of splats, else the coarsest. Findings about a
    file are added to the scene's findings when its blocks are first read.
    """
    names, leaves = _read_leaves(parts, meta)
    coarsest = max([max(leaf) for leaf in leaves], default=0)
    if level > coarsest:
        parts.refuse(f"the level is {level}, expected 0 to {coarsest}")
    environment = use_slashes(meta["environment"].text()) if "environment" in meta else None
    environment_count = 0 if environment is None else read_meta(*parts.nested(environment)).count
    counts = [
        environment_count + sum(stop - start for _, start, stop in (_range_at(leaf, lod) for leaf in leaves))
        for lod in range(coarsest + 1)
    ]
    if max_splats is not None:
        level = next((lod for lod in range(coarsest) if counts[lod] <= max_splats), coarsest)
    findings: list[Finding] = []
    if any("\\" in name for name in names):
        findings.append(Finding("zip-names", 1, "backslashes in filenames, read as slashes", "note"))
        names = [use_slashes(name) for name in names]
    ranges = _collect_ranges(parts, names, [_range_at(leaf, level) for leaf in leaves])
    if environment is not None:
        ranges[environment] = None
    metas: list[tuple[SogMeta, list[tuple[int, int]]]] = []
    for name, file_ranges in ranges.items():
        sog = read_meta(*parts.nested(name))
        used_ranges = [(0, sog.count)] if file_ranges is None else file_ranges
        end = used_ranges[-1][1]
        if end > sog.count:
            parts.refuse(f"the level uses splats up to {end:,} of {name}, which has {sog.count:,}")
        metas.append((sog, used_ranges))
        findings += [one for one in _other_findings(_unread_keys(sog.meta), ()) if one not in findings]
    degree = max([read_degree(sog) for sog, _ in metas], default=0)
    metadata = SceneMetadata(
        antialiased=bool(metas) and all(sog.antialiased for sog, _ in metas),
        flat=bool(metas) and all(sog.flat for sog, _ in metas),
        quantised=True,
    )
    reported: set[int] = set()  # files whose findings are in `findings`: blocks may be read again

    def blocks() -> Iterator[SplatModel]:
        for number, (sog, used_ranges) in enumerate(metas):
            images = SogImages.of(sog)
            if number not in reported:
                reported.add(number)
                findings.extend(_list_findings(images))
            keep = np.zeros(sog.count, bool)
            for start, stop in used_ranges:
                keep[start:stop] = True
            at = 0
            for arrays in images.blocks(degree):
                model = SplatModel(**arrays, metadata=metadata)
                in_level = keep[at : at + len(model)]
                at += len(model)
                if in_level.any():
                    yield model if in_level.all() else model.select(in_level)

    return Scene(counts[level], degree, blocks, metadata, findings=findings, levels=tuple(counts))


def _read_leaves(parts: SogParts, meta: JsonValue) -> tuple[list[str], list[dict[int, _Range]]]:
    """Return the names of the files; and for each leaf with levels, in the order of the tree, the range of each level.

    Refuses another version, and levels or ranges that are no whole numbers within their limits.
    """
    if "version" in meta and meta["version"].whole(_MAX_VERSION) != 1:
        parts.refuse(f"it is version {meta['version'].value} of streamed SOG, expected 1")
    names = [item.text() for item in meta["filenames"].list()]
    leaves: list[dict[int, _Range]] = []
    nodes = [meta["tree"]]
    while nodes:
        node = nodes.pop()
        if "lods" not in node:
            nodes += reversed(node["children"].list()) if "children" in node else []
            continue
        lods = node["lods"].value
        if not isinstance(lods, dict):
            parts.refuse(f"{node.json_path} lods is not an object")
        leaf: dict[int, _Range] = {}
        for level, value in lods.items():
            reference = JsonValue(parts, f"{node.json_path} lods", value)
            file = reference["file"].whole(len(names) - 1)
            start = reference["offset"].whole(_MAX_OFFSET)
            if not (level.isdecimal() and level.isascii() and len(level) < 3):
                parts.refuse(f"the level is {level[:20]!r}, expected a number below 100")
            leaf[int(level)] = file, start, start + reference["count"].whole(_MAX_OFFSET)
        leaves += [leaf] if leaf else []
    return names, leaves


def _range_at(leaf: dict[int, _Range], level: int) -> _Range:
    """Return the range of a leaf at a level, else at the next coarser level, else at its coarsest."""
    return leaf[min((lod for lod in leaf if lod >= level), default=max(leaf))]


def _collect_ranges(parts: SogParts, names: list[str], spans: list[_Range]) -> dict[str, list[tuple[int, int]] | None]:
    """Return the ranges (first splat, end) to read by file, ascending, without empty ranges; refuse overlaps."""
    ranges_by_file: dict[str, list[tuple[int, int]] | None] = {}
    last_file, last_stop = -1, 0
    for file, start, stop in sorted(span for span in spans if span[2] > span[1]):
        if file == last_file and start < last_stop:
            parts.refuse(f"the level uses splats {start:,} to {last_stop:,} of {names[file][:_SHOWN]} twice")
        if file != last_file and names[file] in ranges_by_file:
            parts.refuse(f"filenames contains {names[file][:_SHOWN]} twice")
        ranges = ranges_by_file.setdefault(names[file], [])
        assert ranges is not None, "the environment is added later"
        ranges.append((start, stop))
        last_file, last_stop = file, stop
    return ranges_by_file


COEFFICIENTS = (0, 3, 8, 15)  #: number of SH coefficients per channel, by degree
ENTRIES = 64  #: palette entries per row of the palette image
LEAST_TAG = 252  #: fourth byte of a rotation: this plus the index of the omitted component
_MAX_SPLATS = 1 << 28  # pixels of the largest WebP image
_MAX_PALETTE = 1 << 16
_FREE = 1 << 20  # splats that are accepted for any size of the images
_SPLATS_PER_BYTE = 8  # beyond that: maximum number of splats per byte of the images
_LARGEST_LOG = 88.0  # its exponential fits in float32
_SPARE = 1 << 16  # pixels that an image may have in addition to four per splat


@dataclass(frozen=True)
class SogMeta:
    """The checked JSON of a SOG.

    Attributes:
        count: N.
        degree: SH degree; `None` if it follows from the width of an image.
        antialiased, flat: as in `SplatModel`.
        bounds: [2, 3] float64, bounds of sign(means) · log(1 + |means|).
        scales, sh0: [3, 256] float32, values by code; NaN beyond the end of a codebook.
        alpha: [256] float32, values by code.
        shN: [256] float32, values by code; `None` without SH.
        palette: number of palette entries; `None` if it follows from the height of an image.
    """

    parts: SogParts
    meta: JsonValue
    count: int
    degree: int | None
    antialiased: bool
    flat: bool
    bounds: NDArray[np.float64]
    scales: F32
    sh0: F32
    alpha: F32
    shN: F32 | None
    palette: int | None


def read_meta(parts: SogParts, name: str) -> SogMeta:
    """Read and check the JSON of a SOG.

    Raises:
        InputError: a value is missing or invalid.
        OSError: the file cannot be read.
    """
    meta = parts.json(name)
    version = meta["version"].whole(_MAX_VERSION) if "version" in meta else 1
    if version not in (1, 2):
        parts.refuse(f"it is version {version} of SOG, expected 1 or 2")
    old = version == 1
    if old and "shape" in meta["means"] and "files" not in meta["means"]:
        parts.refuse(
            "it is gsplat's PNG compression, which csplat does not read:"
            " csplat.from_gsplat(gsplat.PngCompression().decompress(FOLDER)) does"
        )
    if old and not meta["means"]["shape"].list():
        parts.refuse(f"{name} means shape is empty")
    count = (meta["means"]["shape"].list()[0] if old else meta["count"]).whole(_MAX_SPLATS)
    shN: F32 | None = None
    degree: int | None = 0
    palette: int | None = None
    if "shN" in meta:
        sh = meta["shN"]
        if old:
            shN, degree = _interpolate(sh, 1)[0], None
        else:
            degree, palette = sh["bands"].whole(3), sh["count"].whole(_MAX_PALETTE)
            shN = _read_codebook(sh) if degree else None
    model = meta["model"].text() if "model" in meta else ""
    sh0 = _interpolate(meta["sh0"], 4) if old else np.repeat(_read_codebook(meta["sh0"])[None], 3, 0)
    return SogMeta(
        parts=parts,
        meta=meta,
        count=count,
        degree=degree,
        antialiased=model == "antialiased" or ("antialias" in meta and meta["antialias"].value is True),
        flat=model == "2dgs",
        bounds=_read_bounds(meta["means"]),
        scales=_interpolate(meta["scales"], 3) if old else np.repeat(_read_codebook(meta["scales"])[None], 3, 0),
        sh0=sh0[:3],
        alpha=alpha_of_logits(sh0[3]) if old else (np.arange(_CODES) / (_CODES - 1.0)).astype(np.float32),
        shN=shN,
        palette=palette,
    )


def _read_bounds(means: JsonValue) -> NDArray[np.float64]:
    """Return the bounds of the means, [2, 3], logarithmic; refuse bounds that exceed float32."""
    bounds = np.stack(_read_ends(means, 3))
    if np.abs(bounds).max() > _LARGEST_LOG:
        means.parts.refuse(f"the bounds of {means.json_path} exceed float32")
    return bounds


def _read_ends(section: JsonValue, channels: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return `mins` and `maxs` of a section, [channels] each; refuse crossed bounds."""
    low, high = (section[name].numbers(channels, channels) for name in ("mins", "maxs"))
    for channel in np.flatnonzero(crossed_bounds(low, high))[:1]:
        reason = f"mins {low[channel]:.6g}, expected at most maxs {high[channel]:.6g}"
        section.parts.refuse(f"{section.json_path} has {reason}")
    return low, high


def _interpolate(section: JsonValue, channels: int) -> F32:
    """Return the values by code, [channels, 256], evenly spaced between `mins` and `maxs`."""
    low, high = (ends[:, None] for ends in _read_ends(section, channels))
    return (low + (high - low) * (np.arange(_CODES) / (_CODES - 1.0))).astype(np.float32)


def _read_codebook(section: JsonValue) -> F32:
    """Return the values by code, [256]; NaN beyond the end of a shorter codebook."""
    values = section["codebook"].value
    if isinstance(values, list) and len(values) == _CODES and values[0] is None:
        # Early writers omitted the first entry; it is extrapolated as in PlayCanvas' engine.
        after = JsonValue(section.parts, section.json_path, values[1:]).numbers(_CODES - 1, _CODES - 1)
        section.value["codebook"] = [float(after[0] + (after[0] - after[-1]) / (_CODES - 1)), *values[1:]]
    codebook = np.full(_CODES, np.nan, np.float32)
    numbers = section["codebook"].numbers(1, _CODES)
    codebook[: len(numbers)] = numbers
    return codebook


@dataclass(frozen=True)
class SogImages:
    """The codes of all splats, 19 bytes each.

    Attributes:
        means, scales: [N, 3]
        quats, sh0: [N, 4]
        labels: [N], indices into the palette.
        palette: [P, K, 3] float32, SH coefficients by label.
        zeros: number of rotations without a valid tag, which become the identity.
    """

    sog: SogMeta
    means: U16
    quats: U8
    scales: U8
    sh0: U8
    labels: U16
    palette: F32
    zeros: int

    @classmethod
    def of(cls, sog: SogMeta) -> SogImages:
        """Decode all images of a SOG.

        Raises:
            InputError: an image is damaged, has another size, or contains a code without a value.
            OSError: an image cannot be read.
        """
        parts, count = sog.parts, sog.count
        names = [
            _list_files(sog.meta[name], file_count) for name, file_count in (("means", 2), ("quats", 1), ("scales", 1))
        ]
        names += [_list_files(sog.meta["sh0"], 1)] + ([_list_files(sog.meta["shN"], 2)] if sog.shN is not None else [])
        data = {name: parts.read(name) for group in names for name in group}
        size_bytes = sum(map(len, data.values()))
        if count > max(_FREE, _SPLATS_PER_BYTE * size_bytes):
            parts.refuse(f"it declares {count:,} splats, its images have {size_bytes:,} bytes")
        size: list[tuple[int, int]] = []

        def fits(width: int, height: int) -> bool:
            size.append((width, height))
            return size[0] == (width, height) and count <= width * height <= 4 * count + _SPARE

        def codes(name: str, channels: int) -> U8:
            pixels = decode_webp(parts, name, data.pop(name), fits).reshape(-1, 4)
            return np.ascontiguousarray(pixels[:count, :channels])

        low, high = (codes(name, 3).astype(np.uint16) for name in names[0])
        quats, scales, sh0 = codes(names[1][0], 4), codes(names[2][0], 3), codes(names[3][0], 4)
        labels, palette = np.zeros(count, np.uint16), np.zeros((1, 0, 3), np.float32)
        if sog.shN is not None:
            palette = _read_palette(sog, names[4][0], data[names[4][0]])
            pair = codes(names[4][1], 2).astype(np.uint16)
            labels = pair[:, 0] | pair[:, 1] << np.uint16(8)
            if count and labels.max() >= len(palette):
                worst = int(labels.argmax())
                parts.refuse(f"splat {worst} has SH label {labels[worst]} in a palette of {len(palette):,}")
        for name, table, used in (("scales", sog.scales, scales), ("sh0", sog.sh0, sh0)):
            if count and np.isnan(table[0, used[:, :3].max()]):
                parts.refuse(f"a splat has code {used[:, :3].max()} of {name}, whose codebook is shorter")
        none = quats[:, 3] < LEAST_TAG
        return cls(sog, low | high << np.uint16(8), quats, scales, sh0, labels, palette, int(none.sum()))

    def blocks(self, degree: int) -> Iterator[dict[str, Any]]:
        """Yield arrays of at most `BLOCK_SPLATS` splats, with zeros for missing SH bands up to a degree."""
        sog, missing = self.sog, COEFFICIENTS[degree] - self.palette.shape[1]
        for start in range(0, sog.count, BLOCK_SPLATS):
            yield self._block(slice(start, start + BLOCK_SPLATS), missing)

    def _block(self, part: slice, missing: int) -> dict[str, Any]:
        """Decode the splats `part` to the arrays of a model, with zeros for `missing` coefficients per channel."""
        sog, codes = self.sog, self.quats[part]
        three = (codes[:, :3].astype(np.float32) / np.float32(255) * 2 - 1) * np.float32(0.5**0.5)
        quats = decode_smallest_three(codes[:, 3] & 3, three)
        quats[codes[:, 3] < LEAST_TAG] = 1, 0, 0, 0
        logs = sog.bounds[0] + (sog.bounds[1] - sog.bounds[0]) * (self.means[part] / 65535.0)
        shN = np.take(self.palette, self.labels[part], 0)
        return {
            "means": (np.sign(logs) * (exp(np.abs(logs)) - 1.0)).astype(np.float32),
            "quats": quats,
            "scales": _look_up(sog.scales, self.scales[part]),
            "opacities": sog.alpha[self.sh0[part, 3]],
            "sh0": _look_up(sog.sh0, self.sh0[part, :3]),
            "shN": np.pad(shN, ((0, 0), (0, missing), (0, 0))) if missing else shN,
        }


def read_degree(sog: SogMeta) -> int:
    """Return the SH degree of a SOG according to its JSON, else according to its palette image."""
    if sog.degree is not None:
        return sog.degree
    name = _list_files(sog.meta["shN"], 2)[0]
    return COEFFICIENTS.index(_read_palette(sog, name, sog.parts.read(name)).shape[1])


def _look_up(tables: F32, codes: NDArray[Any]) -> F32:
    """Return the values [N, 3] of codes [N, 3] by the table of each column, [3, 256]."""
    values = np.empty(codes.shape, np.float32)
    for axis in range(3):
        values[:, axis] = tables[axis][codes[:, axis]]
    return values


def _list_files(section: JsonValue, count: int) -> list[str]:
    """Return the names of the images of a section; refuse another number of names than `count`."""
    names = [item.text() for item in section["files"].list()]
    if len(names) != count or len(set(names)) != count:
        section.parts.refuse(f"{section.json_path} files has {len(set(names))} names, expected {count}")
    return names


def _read_palette(sog: SogMeta, name: str, data: bytes) -> F32:
    """Return the SH coefficients of a palette image, [entries, K, 3]; refuse unexpected sizes and codes."""

    def fits(width: int, height: int) -> bool:
        degrees = [sog.degree] if sog.degree is not None else [1, 2, 3]
        rows = 1 if sog.palette is None else -(-sog.palette // ENTRIES)
        return (
            width in [ENTRIES * COEFFICIENTS[degree] for degree in degrees]
            and rows <= height <= _MAX_PALETTE // ENTRIES
        )

    codes = decode_webp(sog.parts, name, data, fits)
    entries = codes[:, :, :3].reshape(len(codes) * ENTRIES, -1, 3)[: sog.palette]
    assert sog.shN is not None, "a palette has a codebook"
    palette = sog.shN[entries]
    if np.isnan(palette).any():
        sog.parts.refuse(f"{name} has codes beyond the codebook of shN")
    return np.ascontiguousarray(palette)

# SPDX-License-Identifier: Apache-2.0
"""Merge several files: copy their tiles if possible, otherwise decode the scenes and encode them together.

Copied tiles are not decoded; only their codebook ids are replaced by the ids in the merged file.
"""

from __future__ import annotations

import hashlib
import math
import os
import shutil
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from functools import partial
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from csplat import _spec
from csplat.byte_store import FileWindow
from csplat.context import Context
from csplat.decoder import read_header
from csplat.decoder.container import SceneHeader, Tile
from csplat.decoder.tiles import codebook_references
from csplat.disk_files import BinaryWriter, open_writer, temporary_file, temporary_folder
from csplat.editing.extract import ChunkPrefetcher, TileCopier, chunk_payload, copy_nodes, scene_fields
from csplat.editing.transform import DEFAULT_AXES
from csplat.encode_api import encode
from csplat.encoder import EncodeOptions
from csplat.encoder.container import (
    FileChunk,
    FileNode,
    FileTile,
    IndexedCodebook,
    LazyPayload,
    SceneFields,
    chunk_crc,
    file_pieces,
    json_payload,
    order_nodes,
    tree_chunk,
)
from csplat.encoder.entropy import DeflateSettings
from csplat.errors import InputError
from csplat.file_source import File, open_binary
from csplat.model import SplatModel
from csplat.scene import Scene
from csplat.scene_metadata import CONTRADICTS, UNSPECIFIED, SceneMetadata
from csplat.splat_file import SplatFile

#: Fields that must be equal because they determine how all splats of a file are rendered: words for messages, name.
_SHARED_FIELDS = (
    ("units", "unit_metres"), ("antialiasing", "antialiased"), ("flatness", "flat"), ("colour spaces", "colour_space"),
    ("projections", "projection"), ("antialiasing", "antialiasing"),
)  # fmt: skip


_COARSER_MAX = 2.0  # spacing of float32 means in a merged file, as a multiple of the step of a file


@dataclass(frozen=True)
class MergeResult:
    """The result of merging several files.

    Attributes:
        splat_count: number of splats in the merged file.
        tile_count: number of its tiles.
        size_bytes: size of the file.
        why: the reason why the scenes were encoded again; "" if tiles were copied.
        dropped: extra columns that were dropped because not all files have them; only if scenes were encoded again.
        notes: what was assumed of files that leave axes or unit open, and which metadata not all files share.
    """

    splat_count: int
    tile_count: int
    size_bytes: int
    why: str = ""
    dropped: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()


def merge(
    files: Sequence[File],
    output: str | os.PathLike[str] | BinaryWriter,
    *,
    options: EncodeOptions | None = None,
    storage: Mapping[str, Any] | None = None,
    codebooks_max: int = (1 << 16) - 1,
) -> MergeResult:
    """Merge files: the splats of the first, then the splats of the second, and so on.

    Tiles are copied bit for bit, without decoding, if the files agree on steps and levels of all attributes, SH degree,
    origin and extra columns. That is true for parts of the same file (`extract`) and files encoded with the same steps.
    Codebooks get new ids. Copying takes memory for the codebooks of one file and a few megabytes. Other files are
    decoded and encoded together by `csplat.encode`, which loses quality once more, and levels of
    detail; `MergeResult.why` gives the reason. Pending data is kept in temporary files.

    Metadata and cameras are kept if they are the same in all files. A file without axes is assumed to have x right, y
    down, z forward, as elsewhere: it can be merged with files of these axes, not of others. A file without a unit is
    assumed to have the unit of the others. `MergeResult.notes` reports all of this. Merged files of copied tiles
    declare no error bounds and no options, because nothing is measured.

    Args:
        files: as in `csplat.open`, two or more.
        output: path of the file, which appears when complete, replacing an older one; or an open binary file.
        options: encoder options for encoding again; default: the preset "balanced", keeping extra columns.
        storage: as in `csplat.open`, for all files.
        codebooks_max: encode again if the files have more codebooks together; the default is the format's maximum.

    Examples:
        >>> import csplat
        >>> _ = csplat.extract("scene.csplat", (-1, -1, -1, 1, 1, 1), "part.csplat")
        >>> merged = csplat.merge(["part.csplat", "part.csplat"], "twice.csplat")
        >>> merged.why, merged.splat_count == len(csplat.decode("twice.csplat"))
        ('', True)

    Raises:
        InputError: there are fewer than two files, or they contradict each other in axes, up direction, unit,
            antialiasing, flatness, colour space or projection, or are so far from each other that float32 means
            would ruin one.
        FormatError, UnsupportedError, LimitError, StoreError, OSError: as in `csplat.open`, and errors of reading.
    """
    if isinstance(files, (str, bytes, os.PathLike)) or len(files) < 2:
        raise InputError("merge takes a list of two files or more")
    with ExitStack() as stack:
        scenes = [stack.enter_context(SplatFile.open(file, storage=storage)) for file in files]
        names = [scene.name or f"file {number}" for number, scene in enumerate(scenes, 1)]
        _refuse_other_axes(scenes, names)
        for words, field in _SHARED_FIELDS:
            _refuse_contradiction(words, [getattr(scene.header, field) for scene in scenes], names)
        windows = [scene.window() for scene in scenes]
        fields = [scene_fields(window, scene.header, (), ()) for window, scene in zip(windows, scenes, strict=True)]
        why = _describe_difference(fields, names)
        ids = []
        spool = PayloadSpool(stack.enter_context(temporary_file()))
        books = MergedCodebooks(spool)
        if not why:
            ids = [books.take(window, scene.header) for window, scene in zip(windows, scenes, strict=True)]
            if len(books.records) > codebooks_max:
                why = f"they have {len(books.records):,} codebooks together, a file has at most {codebooks_max:,}"
        if why:
            why += "; levels of detail are left out" * any(scene.header.coarse_tiles for scene in scenes)
            result = _encode_again(scenes, output, options or EncodeOptions(keep_extra=True), why)
            return replace(result, notes=_list_assumptions(scenes, names))
        nodes: list[FileNode] = []
        for window, scene, new in zip(windows, scenes, ids, strict=True):
            copied = renumber_tiles(window, scene.header, new, spool, len(scenes))
            base = len(nodes)
            own = copy_nodes(scene.nodes, range(len(scene.nodes)), copied)
            nodes += [replace(node, parent=None if node.parent is None else base + node.parent) for node in own]
        nodes = order_nodes(nodes)
        tiles = [tile for node in nodes for tile in node.tiles]
        tree = [tree_chunk(nodes)] if any(tile.level for tile in tiles) else []
        together = replace(
            fields[0],
            axes=next((file_fields.axes for file_fields in fields if any(file_fields.axes)), fields[0].axes),
            unit_metres=next((file_fields.unit_metres for file_fields in fields if file_fields.unit_metres), 0.0),
            codebooks=books.records,
            chunks=[*tree, *_common_chunks(scenes), *books.chunks],
        )
        return replace(_write_merged(together, tiles, output), notes=_list_assumptions(scenes, names))


def _refuse_other_axes(scenes: Sequence[SplatFile], names: Sequence[str]) -> None:
    """Raise `InputError` if two files have different axes or up directions; RDF is assumed of files without axes."""
    axes = [scene.header.coordinate_system for scene in scenes]
    if not set(axes) <= {UNSPECIFIED}:
        known = [DEFAULT_AXES if system == UNSPECIFIED else system for system in axes]
        texts = [f"none, for which {DEFAULT_AXES} is assumed," if system == UNSPECIFIED else system for system in axes]
        remedy = "turn one with csplat convert --to-axes, or name the axes of one without with --axes"
        _refuse_contradiction("axes", known, names, texts, remedy)
    ups = [scene.metadata.up for scene in scenes]
    directions = [(np.array(up), name) for up, name in zip(ups, names, strict=True) if up is not None]
    for up, name in directions[1:]:
        first, first_name = directions[0]
        if float(up @ first) < CONTRADICTS:
            both = f"{_format_vector(first)} in {first_name}, {_format_vector(up)} in {name}"
            raise InputError(
                f"scenes with different up directions cannot be merged: {both}: set one with csplat convert --up"
            )


def _format_vector(values: NDArray[Any]) -> str:
    """Format a vector for messages, with commas and without spaces."""
    return ",".join(f"{value:g}" for value in values)


def _list_assumptions(scenes: Sequence[SplatFile], names: Sequence[str]) -> tuple[str, ...]:
    """Describe what is assumed of files that leave axes or unit open, and metadata that not all files share."""
    headers = [scene.header for scene in scenes]
    notes = []
    open_axes = [name for header, name in zip(headers, names, strict=True) if header.coordinate_system == UNSPECIFIED]
    if 0 < len(open_axes) < len(scenes):
        notes.append(f"{', '.join(open_axes)} without axes: {DEFAULT_AXES} is assumed, as the other files have")
    open_units = [name for header, name in zip(headers, names, strict=True) if header.unit_metres is None]
    if 0 < len(open_units) < len(scenes):
        unit = next(header.unit_metres for header in headers if header.unit_metres is not None)
        notes.append(f"{', '.join(open_units)} without a unit: {unit:g} m is assumed, as the other files have")
    entries = [scene.metadata.entries for scene in scenes]
    left_out = sorted(set().union(*entries) - _common_entries(entries).keys())
    cameras = [scene.metadata.cameras for scene in scenes]
    if left_out := [*left_out, *(["cameras"] if any(camera_list != cameras[0] for camera_list in cameras) else [])]:
        notes.append(f"metadata left out, because not all files have the same: {', '.join(left_out)}")
    return tuple(notes)


def _refuse_contradiction(
    words: str, values: Sequence[Any], names: Sequence[str], texts: Sequence[str] = (), remedy: str = ""
) -> None:
    """Raise `InputError` if two files have different values; `None` is an unknown value.

    Args:
        words: name of the values, for the message.
        values, names: values and names of the files.
        texts: descriptions of the values; by default, their own.
        remedy: advice to the user; "" if there is none.
    """
    known = [
        (value, f"{text} in {name}")
        for value, text, name in zip(values, texts or map(_format_value, values), names, strict=True)
        if value is not None
    ]
    for value, text in known[1:]:
        if value != known[0][0]:
            advice = f": {remedy}" if remedy else ""
            raise InputError(f"scenes with different {words} cannot be merged: {known[0][1]}, {text}{advice}")


def _format_value(value: Any) -> str:
    """Format a value for messages; booleans as yes and no."""
    return {True: "yes", False: "no"}[value] if isinstance(value, bool) else str(value)


def _describe_difference(fields: Sequence[SceneFields], names: Sequence[str]) -> str:
    """Return the first difference in header fields that keeps tiles from being copied together; "" if there is none."""
    first, first_name = fields[0], names[0]
    for other, name in zip(fields[1:], names[1:], strict=True):
        if other.sh_degree != first.sh_degree:
            return f"{name} has SH of degree {other.sh_degree}, {first_name} of {first.sh_degree}"
        if other.origin != first.origin:
            return f"{name} and {first_name} have different origins"
        for attribute, counterpart in zip(first.attributes, other.attributes, strict=True):
            if attribute != counterpart:
                return f"{name} and {first_name} have different steps of {_spec.ATTRIBUTE_NAMES[attribute.attribute]}"
        if other.extras != first.extras:
            return f"{name} and {first_name} have different extra columns"
    return ""


def _common_chunks(scenes: Sequence[SplatFile]) -> list[FileChunk]:
    """Return chunks of the metadata and cameras that all files have in common."""
    chunks = []
    if entries := _common_entries([scene.metadata.entries for scene in scenes]):
        chunks.append(FileChunk(_spec.CHUNK_METADATA, json_payload(entries, DeflateSettings())))
    if (cameras := _common_cameras(scenes)) is not None:
        chunks.append(FileChunk(_spec.CHUNK_CAMERAS, json_payload(list(cameras), DeflateSettings())))
    return chunks


def _common_cameras(scenes: Sequence[SplatFile]) -> Sequence[Mapping[str, Any]] | None:
    """Return the cameras, `None` included, that all files share; `None` if the files differ."""
    first, *others = (scene.metadata.cameras for scene in scenes)
    return first if all(cameras == first for cameras in others) else None


def _common_entries(values: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Return the metadata entries that all mappings contain with the same value."""
    first, *others = values
    return {
        key: value
        for key, value in first.items()
        if all(key in entries and entries[key] == value for entries in others)
    }


def _write_merged(
    scene: SceneFields, tiles: Sequence[FileTile], output: str | os.PathLike[str] | BinaryWriter
) -> MergeResult:
    """Write a file of copied tiles; the result counts the splats of level 0."""
    size = 0
    with open_writer(output) as stream:
        for part in file_pieces(scene, tiles):
            stream.write(part)
            size += len(part)
    return MergeResult(sum(tile.splat_count for tile in tiles if tile.level == 0), len(tiles), size)


def _encode_again(
    scenes: Sequence[SplatFile], output: str | os.PathLike[str] | BinaryWriter, options: EncodeOptions, why: str
) -> MergeResult:
    """Decode the scenes tile by tile and encode them together, in memory if they fit."""
    whole = _merge_scenes(scenes)
    _refuse_rounding(scenes, whole)
    dropped = {column.name for scene in scenes for column in scene.header.extras} - whole.extra.keys()
    with temporary_folder() as folder:
        path = folder / "merged.csplat"
        encode(whole, options, out=path, context=Context(folder=folder / "work"))
        with open_binary(path) as coded, open_writer(output) as stream:
            shutil.copyfileobj(coded, stream)
        return MergeResult(whole.count, len(read_header(path).tiles), path.stat().st_size, why, tuple(sorted(dropped)))


def _merge_scenes(scenes: Sequence[SplatFile]) -> Scene:
    """Return all splats with a common origin, and the extra columns that all files have."""
    headers = [scene.header for scene in scenes]
    origins = np.array([header.origin for header in headers])
    x, y, z = map(float, (origins.min(axis=0) + origins.max(axis=0)) / 2.0)  # minimises float32 rounding
    axes = (header.coordinate_system for header in headers if header.coordinate_system != UNSPECIFIED)
    whole = Scene(
        sum(map(len, scenes)),
        max(header.sh_degree for header in headers),
        lambda: _merged_blocks(scenes, whole.empty()),
        origin=(x, y, z),
        has_doubles=bool((origins != origins[0]).any()),
        metadata=SceneMetadata(
            coordinate_system=next(axes, UNSPECIFIED),
            unit_metres=next((header.unit_metres for header in headers if header.unit_metres), None),
            antialiased=headers[0].antialiased,
            flat=headers[0].flat,
            colour_space=scenes[0].metadata.colour_space,
            cameras=_common_cameras(scenes),
            entries=_common_entries([scene.metadata.entries for scene in scenes]),
            semantics=scenes[0].metadata.semantics,
        ),
        extra={
            column.name: column.splat_dtype
            for column in headers[0].extras
            if column.dtype is not None and all(column in header.extras for header in headers)
        },
    )
    return whole


def _refuse_rounding(scenes: Sequence[SplatFile], whole: Scene) -> None:
    """Raise `InputError` if float32 means relative to the common origin are too coarse for the steps of a file."""
    for scene in scenes:
        header = scene.header
        distance = float(np.abs(np.array(header.origin) - whole.origin).max())
        if not len(scene) or not distance:
            continue
        exponents = np.repeat([tile.exponent for tile in header.tiles], [tile.splat_count for tile in header.tiles])
        step = math.ldexp(header.attribute(_spec.ATTRIBUTE_MEANS).step, int(np.median(exponents)))
        spacing = float(np.spacing(np.float32(distance)))
        if spacing > _COARSER_MAX * step:
            raise InputError(
                f"{scene.name or 'a file'} has steps of {step:.3g}, and is {distance:.3g} from the middle of all, where"
                f" float32 means are multiples of {spacing:.3g}: scenes so far from each other stay files of their own"
            )


def _merged_blocks(scenes: Sequence[SplatFile], empty: SplatModel) -> Iterator[SplatModel]:
    """Yield the tiles of all files as models like `empty`.

    Means are relative to the common origin, missing SH bands are 0, and only the extra columns of `empty` are kept.
    """
    for scene in scenes:
        for tile in scene.tiles():
            shN = np.zeros((len(tile.means), *empty.shN.shape[1:]), np.float32)
            shN[:, : tile.shN.shape[1]] = tile.shN
            means, doubles = tile.means, None
            if empty.means_double is not None:
                doubles = tile.means.astype(np.float64) + scene.header.origin
                means = (doubles - empty.origin).astype(np.float32)
            yield replace(
                empty, means=means, quats=tile.quats, scales=tile.scales, opacities=tile.opacities,
                sh0=tile.sh0, shN=shN, extra={name: tile.extra[name] for name in empty.extra},
                means_double=doubles,
            )  # fmt: skip


_ID_SIZE, _ID_MAX = 2, (1 << 16) - 1
_ID_END = _spec.CODEBOOK_HEAD_OFFSETS["codebook_id"] + _ID_SIZE


class PayloadSpool:
    """Payloads in a temporary file until they are written to the output.

    Args:
        stream: a temporary file, open for reading and writing.
    """

    def __init__(self, stream: IO[bytes]) -> None:
        self._stream = stream

    def put(self, kind: bytes, payload: bytes) -> LazyPayload:
        """Store the payload of a chunk."""
        start = self._stream.seek(0, os.SEEK_END)
        self._stream.write(payload)
        return LazyPayload(len(payload), chunk_crc(kind, payload), partial(self._read, start, len(payload)))

    def _read(self, start: int, size: int) -> bytes:
        """Return the payload of `size` bytes that begins at `start` in the temporary file."""
        self._stream.seek(start)
        return self._stream.read(size)


class MergedCodebooks:
    """The codebooks of all files with new ids from 0 on; equal codebooks are stored once.

    Args:
        spool: stores the payloads.

    Attributes:
        records: index records of the codebooks.
        chunks: chunks of the codebooks.
    """

    def __init__(self, spool: PayloadSpool) -> None:
        self.records: list[IndexedCodebook] = []
        self.chunks: list[FileChunk] = []
        self._spool = spool
        self._known: dict[tuple[object, ...], int] = {}

    def take(self, window: FileWindow, header: SceneHeader) -> dict[int, int]:
        """Add the codebooks that the tiles of a file reference; return the new ids by old id."""
        used = {identity for tile in header.all_tiles for identity in tile.codebook_ids}
        chunks = [record for record in header.directory if record.type == _spec.CHUNK_CODEBOOK and record.id in used]
        window.fetch((record.offset, record.size) for record in chunks)
        ids = {}
        for book in header.codebooks:
            if book.codebook_id in used:
                own = sorted(
                    (record for record in chunks if record.id == book.codebook_id), key=lambda record: record.layer
                )
                contents = {record.layer: chunk_payload(window, record)[_ID_END:] for record in own}
                ids[book.codebook_id] = self._id(book, contents)
        window.forget()
        return ids

    def _id(self, book: _spec.CodebookRecord, contents: Mapping[int, bytes]) -> int:
        """Return the new id of a codebook, adding it if it is unknown.

        Args:
            book: the record in its file.
            contents: its payloads after the id, by layer.
        """
        bands = (book.band_first, book.band_last)
        digests = (hashlib.sha256(content).digest() for content in contents.values())
        key = (book.kind, bands, book.size, *digests)
        if key not in self._known:
            id = self._known[key] = len(self.records)
            self.records.append(IndexedCodebook(id, book.kind, bands, book.size))
            if id <= _ID_MAX:  # with more, `merge` encodes again
                for layer, content in contents.items():
                    payload = self._spool.put(_spec.CHUNK_CODEBOOK, _as_bytes(id) + content)
                    self.chunks.append(FileChunk(_spec.CHUNK_CODEBOOK, payload, id, layer))
        return self._known[key]


def renumber_tiles(
    window: FileWindow, header: SceneHeader, ids: Mapping[int, int], spool: PayloadSpool, files: int
) -> list[FileTile]:
    """Return the tiles of a file with new codebook ids.

    Args:
        window, files: as in `ChunkPrefetcher`.
        header: header of the file.
        ids: new ids by old id.
        spool: stores rewritten chunks; other chunks are read when they are written.
    """
    changed: dict[int, dict[int, LazyPayload]] = {}
    naming = [
        (tile, tile.layers[layer])
        for layer in range(_spec.SH_DEGREE_MAX + 1)
        for tile in header.all_tiles
        if layer in _layers_with_changed_ids(header, tile, ids) & tile.layers.keys()
    ]
    turn = ChunkPrefetcher(window, [record for _, record in naming], files)
    for index, (tile, record) in enumerate(naming):
        turn.take(index)
        if stored := _rewrite_ids(window, header, record, ids, spool):
            changed.setdefault(tile.index, {})[record.layer] = stored
    window.forget()
    copies = TileCopier(window, files)
    tiles = [copies.of(tile, changed.get(tile.index)) for tile in header.all_tiles]
    return [
        replace(tile, codebook_ids=tuple(sorted({ids[identity] for identity in tile.codebook_ids}))) for tile in tiles
    ]


def _layers_with_changed_ids(header: SceneHeader, tile: Tile, ids: Mapping[int, int]) -> set[int]:
    """Return the layers of a tile that may reference a codebook whose id changes."""
    moved = {identity for identity in tile.codebook_ids if ids[identity] != identity}
    return {
        layer
        for book in header.codebooks
        if book.codebook_id in moved
        for layer in range(book.band_first, book.band_last + 1)
    }


def _rewrite_ids(
    window: FileWindow, header: SceneHeader, record: _spec.LayerRecord, ids: Mapping[int, int], spool: PayloadSpool
) -> LazyPayload | None:
    """Replace the codebook ids in a layer chunk by `ids[id]`, and store it in `spool`; `None` if it has none."""
    with window.store.named_errors():
        references = list(codebook_references(window.view, header, record))
    if not references:
        return None
    payload = bytearray(chunk_payload(window, record))
    begin = record.offset + _spec.CHUNK_HEADER_SIZE
    for at, id in references:  # offsets in the file
        payload[at - begin : at - begin + _ID_SIZE] = _as_bytes(ids[id])
    return spool.put(_spec.CHUNK_TILE, bytes(payload))


def _as_bytes(id: int) -> bytes:
    """Encode a codebook id as the file stores it."""
    return id.to_bytes(_ID_SIZE, "little")

# SPDX-License-Identifier: Apache-2.0
"""Encode a scene file, in memory or out of core, as `csplat encode` does."""

from __future__ import annotations

import time
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import csplat
from csplat import _spec
from csplat.context import DEFAULT_CONTEXT, Context
from csplat.decoder import SceneHeader
from csplat.disk_files import size_on_disk
from csplat.encode_api import encode_with_report
from csplat.encoder import EncodeOptions, EncodeResult, Target, Views
from csplat.errors import InputError, SearchInterrupted, counted
from csplat.formats import detect_format
from csplat.model import MAX_SH_DEGREE
from csplat.out_of_core import EncodingCost, estimate_cost, working_folder
from csplat.scene import Scene
from csplat_tools.console import format_bytes, format_estimate, note
from csplat_tools.file_streams import STANDARD_STREAM, source_path, write_array, write_bytes
from csplat_tools.level_builder import FittedLevelBuilder, LevelCount, choose_levels, read_streamed_levels
from csplat_tools.scene_files import MetadataOverrides, findings_as_json, read_source, with_first_view

_PLY_FACTOR = 8  # memory of an encoding divided by the size of its PLY, at most; 3 for float32 columns, more for bytes
_LINE_MBITS = 10  # Mbit/s, of the slow line that our measurements use (docs/results/speed.md)
_SLOW_SECONDS = 4.0  # from which Web Vitals call the time to the largest content of a page poor (web.dev/articles/lcp)
_CUT = "the dropped SH bands are cut off: projecting them onto the others requires the scene in memory, without bounds"


def read_degree(options: EncodeOptions) -> int | None:
    """Return the SH degree at which to read a scene to be encoded. `None` keeps all bands.

    Bands that the encoder drops are read as well, since declared errors include them. A file of a higher degree than
    models support can be read only if bands are dropped.
    """
    return None if options.sh_degree is None else MAX_SH_DEGREE


def describe_wait(header: SceneHeader, page_bytes: int | None = None) -> list[str]:
    """Format the wait for a picture of the whole scene, from a file without levels of detail, and what levels cost.

    Args:
        header: header of the file.
        page_bytes: size of an exported page, all of which arrives before it shows its scene; `None`: viewers draw the
            scene when the geometry of all tiles is here.

    Returns:
        The line, in a list; nothing if viewers use levels, or the wait is short.
    """
    geometry = sum(tile.layers[_spec.LAYER_GEOMETRY].size for tile in header.tiles)
    size = _spec.HEADER_SIZE + header.index_size + geometry if page_bytes is None else page_bytes
    seconds, level = 8e-6 * size / _LINE_MBITS, header.resource_level
    if header.coarse_tiles and page_bytes is not None:
        return ["the page is drawn when all of it is here: levels of detail only add to it; an element uses them"]
    if header.coarse_tiles or seconds < _SLOW_SECONDS:
        return []
    is_phones = level == _spec.RESOURCE_LEVEL_NAMES[_spec.RESOURCE_LEVEL_A]
    phones = "" if is_phones else f", and phones may refuse the file (resource level {level})"
    place = "" if page_bytes is None else " in a page with `csplat export-element`"
    time = format_estimate(FittedLevelBuilder(fits=False).seconds(header.splat_count, DEFAULT_CONTEXT.thread_count))
    wait = f"the whole scene is seen after {format_bytes(size)}, {seconds:.0f} s at {_LINE_MBITS} Mbit/s{phones}"
    price = f"`csplat encode --levels merged`: about {time} more, a third more bytes"
    return [f"{wait}; with levels of detail{place}, at once ({price})"]


@dataclass(frozen=True)
class EncodedFile:
    """A written file, with its source.

    Attributes:
        source: the encoded scene; it is closed, and has its splats only if it was encoded in memory.
        result: the encoder's result.
        seconds: time of reading, unless the scene had been read, encoding and writing.
    """

    source: Scene
    result: EncodeResult
    seconds: float

    def as_json(self) -> dict[str, Any]:
        """Return everything as JSON-compatible values."""
        report, source_bytes = self.result.report, self.source.size_bytes
        count = report.splat_count
        return {
            "splats": count,
            "size_bytes": report.size_bytes,
            "source_bytes": source_bytes,
            "ratio": source_bytes / report.size_bytes,
            "bytes_per_splat": report.size_bytes / count if count else None,
            "tiles": report.tile_count,
            "seconds": round(self.seconds, 3),
            "findings": findings_as_json(self.source.findings),
            "notes": list(report.notes),
            "declared_errors": {name: {"max": pair[0], "rms": pair[1]} for name, pair in report.errors.items()},
            "options": report.options,
            **({} if report.search is None else {"target": report.search.as_json()}),
        }


def encode_file(
    source: str | Scene,
    output: str,
    options: EncodeOptions,
    *,
    target: Target | None = None,
    views: Views | None = None,
    overrides: MetadataOverrides | None = None,
    strict: bool = False,
    importance: str | None = None,
    prune_unseen: bool = False,
    source_index: str | None = None,
    levels: LevelCount = None,
    first_view: str | None = None,
    format: str | None = None,
    context: Context = DEFAULT_CONTEXT,
) -> EncodedFile:
    """Read a scene file, encode it, and write the .csplat file, with the first view for viewers.

    Args:
        source: a scene in any format, or `-`; or a scene that `read_source` has read.
        output: the file to write, or `-`; it is replaced without a check.
        options: options of the encoder; `keep_extra` applies to reading, too.
        target, views, context: as for `csplat.encode`. Like `target`, `importance` and `source_index` require the scene
            in memory.
        overrides: overrides of the scene's metadata, for reading.
        strict: refuse defects that would be repaired in reading.
        importance: a .npy file with one weight per splat of the source, or a file of `csplat sensitivity`.
        prune_unseen: prune the splats that no view of the sensitivities saw; requires `importance`.
        source_index: a .npy file to write: the index in the source of each splat of the file.
        levels: number of levels of detail above the scene, 1 to 16; "auto": until the coarsest has 4,096 splats;
            "merged": the same without a fit to renders; `None`: none. Levels of streamed SOG are taken instead, unless
            splats may be pruned.
        first_view: a camera file, of which the first camera is the first view; `None`: see `viewing_metadata`.
        format: as for `csplat.open`.

    Raises:
        InputError: arguments contradict each other.
        CsplatError: the scene or the options are not valid.
        OSError: a file cannot be read or written.
        SearchInterrupted: Ctrl-C interrupted a search; `best` is the `EncodedFile` of the best file so far, which was
            written, or `None`.
    """
    whole = target is not None or importance is not None or source_index is not None
    if prune_unseen and importance is None:
        raise InputError("pruning unseen splats requires a file of `csplat sensitivity` as importance")
    if prune_unseen and target is not None:
        raise InputError("prune_unseen and a target are given, expected only one of them")
    if whole and context.is_bounded:
        raise InputError("a target, an importance and a source index exclude options for scenes larger than memory")
    start, interrupt = time.perf_counter(), None
    with ExitStack() as stack:
        if isinstance(source, Scene):
            scene = source.loaded() if whole else source
            builder = choose_levels(scene.count, options, levels)
        else:
            local = stack.enter_context(source_path(source))
            reading: dict[str, Any] = {
                "format": format, "strict": strict, "keep_extra": options.keep_extra, "sh_degree": read_degree(options),
                "context": context,
            }  # fmt: skip
            context.progress("reading", 0.0)
            if levels is None and (whole or _surely_fits(local, format, context)):
                scene, builder = read_source(local, overrides, **reading), None
            else:
                opened = stack.enter_context(csplat.open(local, format, sh_degree=read_degree(options)))
                builder = choose_levels(opened.count, options, levels)
                has_levels = opened.format == "sog" and len(opened.levels) > 1
                if builder is not None and has_levels and not (target or importance):
                    builder, whole = _levels_of_source(local, builder, context), True
                in_memory = whole or estimate_cost(opened, options, context, builder, out=output).in_memory
                scene = read_source(local, overrides, opened=opened, in_memory=in_memory, **reading)
            context.progress("reading", 1.0)
        scene = with_first_view(scene, first_view, progress=context.progress)
        drops = target is None and options.kept_degree(scene.sh_degree) < scene.sh_degree
        try:
            if scene.in_memory is None:
                result = _encode_on_disk(scene, output, options, builder, context)
            elif importance is not None:
                from csplat_tools.importance_file import encode_by_importance  # imports trainer and renderer

                result = encode_by_importance(
                    scene.in_memory, options, importance, target=target, views=views, prune_unseen=prune_unseen,
                    levels=builder, context=context,
                )  # fmt: skip
            elif drops and not context.is_bounded:
                from csplat_tools.importance_file import encode_fewer_bands

                result = encode_fewer_bands(scene.in_memory, options, levels=builder, context=context)
            else:
                alone = replace(context, memory=None, workers=None, resume=False)  # it fits
                result = encode_with_report(
                    scene, options, levels=builder, target=target, views=views, context=alone
                )  # fmt: skip
        except SearchInterrupted as caught:
            if caught.best is None:
                raise
            result, interrupt = caught.best, caught
        if drops and importance is None and (scene.in_memory is None or context.is_bounded):
            result = result.with_notes(_CUT)
        if scene.in_memory is not None:
            write_bytes(output, result.data)
        if source_index is not None:
            write_array(source_index, result.source_index)
    encoded = EncodedFile(scene, result, time.perf_counter() - start)
    if interrupt is not None:
        raise SearchInterrupted(str(interrupt), encoded)
    return encoded


def _surely_fits(path: Path, format: str | None, context: Context) -> bool:
    """Return True if a PLY fits in memory for certain, so that it need not be surveyed before it is read."""
    if context.is_bounded or detect_format(path, format).name != "ply":
        return False
    return _PLY_FACTOR * size_on_disk(path) <= context.memory_limit


def _levels_of_source(local: Path, builder: FittedLevelBuilder, context: Context) -> FittedLevelBuilder:
    """Return the builder that takes the levels of streamed SOG, which is read from the path `local`.

    Raises:
        InputError: the scene does not fit in memory; or as in `choose_levels`.
    """
    if context.is_bounded:
        raise InputError(
            "taking the levels of detail of the source requires the scene in memory: encode without levels, or encode a"
            " PLY of its finest level"
        )
    return replace(builder, nodes=read_streamed_levels(local, builder.count))


def _encode_on_disk(
    scene: Scene, output: str, options: EncodeOptions, levels: FittedLevelBuilder | None, context: Context
) -> EncodeResult:
    """Encode an opened scene without reading it into memory, and write the .csplat file.

    If it is interrupted or the disk is full, the finished part is kept, and a note tells how to resume.

    Raises:
        InputError: the output is standard output, or an option cannot be used.
        OSError: a file cannot be read or written.
    """
    if output == STANDARD_STREAM:
        raise InputError("the scene does not fit in memory, and cannot be written to standard output: name a file")
    try:
        return encode_with_report(scene, options, out=output, levels=levels, context=context)
    except (KeyboardInterrupt, OSError):
        folder = working_folder(context, output)
        if folder.exists():
            note(f"{folder} holds the finished part: --resume continues from it")
        raise


def format_cost(cost: EncodingCost) -> str:
    """Format the cost of an encoding as a line."""
    where = "in memory" if cost.in_memory else f"on the disk, {counted(cost.workers, 'process', 'processes')}"
    return (
        f"{counted(cost.splats, 'splat')} of SH degree {cost.sh_degree}, {where}: about"
        f" {format_estimate(cost.seconds)}, {format_bytes(cost.memory_bytes)} of memory,"
        f" {format_bytes(cost.disk_bytes)} of disk; the file about {format_bytes(cost.file_bytes)}"
    )


def format_encoding(encoded: EncodedFile, source: str, output: str) -> list[str]:
    """Format sizes, the PSNR, if it was measured, counts and time of an encoding as a line, and what shows more.

    Args:
        encoded: the written file.
        source, output: names of the files.
    """
    report, psnr = encoded.result.report, encoded.result.psnr
    ratio = encoded.source.size_bytes / report.size_bytes
    sizes = f"{format_bytes(encoded.source.size_bytes)} -> {format_bytes(report.size_bytes)}, {ratio:.1f} times smaller"
    per_splat = f" of {report.size_bytes / report.splat_count:.2f} bytes" if report.splat_count else ""
    splats = f"{counted(report.splat_count, 'splat')}{per_splat} in {counted(report.tile_count, 'tile')}"
    lines = [f"{sizes}{'' if psnr is None else f', PSNR {psnr:.2f} dB'}: {splats}, {encoded.seconds:.2f} s"]
    if encoded.source.in_memory is not None and len(encoded.source) and "-" not in (source, output):
        look = f"`csplat compare {source} {output}` shows how it looks, " if psnr is None else ""
        lines.append(f"{look}`csplat info {output}` lists the errors that it declares")
    return lines

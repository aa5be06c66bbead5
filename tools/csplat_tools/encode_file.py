"""Encode a scene file, in memory or out of core, as `csplat encode` does."""

from __future__ import annotations

import time
from collections.abc import Mapping
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import csplat
from csplat._spec import MEASURE_NAMES
from csplat.disk_files import size_on_disk
from csplat.encoder import EncodeOptions, EncodeReport, EncodeResult, Target, encode_with_report
from csplat.errors import InputError, counted
from csplat.formats import detect_format
from csplat.lint import Finding, refuse
from csplat.model import MAX_SH_DEGREE, SplatModel
from csplat.out_of_core import EncodingCost, OutOfCoreOptions, encode_scene, estimate_cost
from csplat.ply.column_names import dropped_columns
from csplat.scene import Scene
from csplat.system import default_memory_bytes
from csplat.types import Progress
from csplat_tools.console import format_bytes, format_estimate, format_table, note
from csplat_tools.file_streams import STANDARD_STREAM, source_path, write_array, write_bytes
from csplat_tools.level_builder import FittedLevelBuilder, LevelCount, choose_levels, read_streamed_levels
from csplat_tools.scene_files import CHEAP_TO_REOPEN, MetadataOverrides, findings_as_json, read_source

_MEMORY_FACTOR = 4  # memory of a scene divided by the size of its PLY; unknown for other formats
_LEVELS_FACTOR = 4  # memory with levels of detail / memory without: renders, and splats in several forms
_SMALL = 4 << 20  # bytes; smaller files of any format always fit in memory

_MANY_SPLATS = 1_000_000  # a file of this many has 8 MB: ten seconds at 6 Mbit/s; a coarsest level has about 70 kB


def read_degree(options: EncodeOptions) -> int | None:
    """Return the SH degree at which to read a scene to be encoded. `None` keeps all bands.

    Bands that the encoder drops are read as well, since declared errors include them. A file of a higher degree than
    models support can be read only if bands are dropped.
    """
    return None if options.sh_degree is None else MAX_SH_DEGREE


def describe_levels(scene: Scene, options: EncodeOptions, limits: OutOfCoreOptions) -> list[str]:
    """Format the use and the cost of levels of detail as a line, for a scene that is encoded without.

    Args:
        scene: the scene; its blocks are not read.
        options, limits: as for `encode_file`.

    Returns:
        The line, in a list; nothing for fewer than a million splats, or if the levels require more memory.
    """
    if scene.count < _MANY_SPLATS:
        return []
    try:
        cost = estimate_cost(scene, options, limits)
        more = estimate_cost(scene, options, limits, FittedLevelBuilder(bucket_splats=options.bucket_splats))
    except InputError:
        return []
    seconds, growth = more.seconds - cost.seconds, more.file_bytes / cost.file_bytes - 1.0
    price = f"about {format_estimate(seconds)} more, {100.0 * growth:.0f} % more bytes"
    return [f"viewers show a scene of {scene.count:,} splats sooner with levels of detail: --levels auto ({price})"]


@dataclass(frozen=True)
class EncodedFile:
    """A written file, with its source and reports.

    Attributes:
        source: the encoded scene; only its metadata if it was encoded out of core.
        report: choices and errors.
        result: the encoder's result; `None` if the scene was encoded out of core.
        findings: lint findings in the source.
        source_bytes: size of the source.
        seconds: time of reading, unless the scene had been read, encoding and writing.
    """

    source: SplatModel
    report: EncodeReport
    result: EncodeResult | None
    findings: tuple[Finding, ...]
    source_bytes: int
    seconds: float

    def as_json(self) -> dict[str, Any]:
        """Return everything as JSON-compatible values."""
        report = self.report
        count = report.splat_count
        return {
            "splats": count,
            "size_bytes": report.size_bytes,
            "source_bytes": self.source_bytes,
            "ratio": self.source_bytes / report.size_bytes,
            "bytes_per_splat": report.size_bytes / count if count else None,
            "tiles": report.tile_count,
            "seconds": round(self.seconds, 3),
            "defects": findings_as_json(self.findings),
            "notes": list(report.notes),
            "stated_errors": {name: {"max": pair[0], "rms": pair[1]} for name, pair in report.errors.items()},
            "options": report.options,
            **({} if report.search is None else {"target": report.search.as_json()}),
        }


def encode_file(
    source: str | Scene,
    output: str,
    options: EncodeOptions,
    *,
    target: Target | None = None,
    views: Any = None,
    overrides: MetadataOverrides | None = None,
    strict: bool = False,
    importance: str | None = None,
    prune_unseen: bool = False,
    source_index: str | None = None,
    levels: LevelCount = None,
    out_of_core: OutOfCoreOptions | None = None,
    format: str | None = None,
    progress: Progress | None = None,
) -> EncodedFile:
    """Read a scene file, encode it, and write the .csplat file.

    A `target`, `importance` and `source_index` require the scene in memory, and exclude `out_of_core`.

    Args:
        source: a scene in any format, or `-`; or a scene that `read_source` has read.
        output: the file to write, or `-`; it is replaced without a check.
        options: options of the encoder; `keep_extra` applies to reading, too.
        target, views: as for `csplat.encode`.
        overrides: overrides of the scene's metadata, for reading.
        strict: refuse defects that would be repaired in reading.
        importance: a .npy file with one weight per splat of the source, or a file of `csplat sensitivity`.
        prune_unseen: prune the splats that no view of the sensitivities saw; requires `importance`.
        source_index: a .npy file to write: the index in the source of each splat of the file.
        levels: number of levels of detail above the scene, 1 to 16; "auto": until the coarsest has 4,096 splats;
            `None`: none. Levels of streamed SOG are taken instead.
        out_of_core: memory, disk and workers.
        format: as for `csplat.open`.
        progress: progress callback.

    Raises:
        InputError: arguments contradict each other.
        CsplatError: the scene or the options are not valid.
        OSError: a file cannot be read or written.
    """
    in_memory = target is not None or importance is not None or source_index is not None
    limits = out_of_core or OutOfCoreOptions()
    if prune_unseen and importance is None:
        raise InputError("pruning unseen splats requires a file of `csplat sensitivity` as importance")
    if prune_unseen and target is not None:
        raise InputError("prune_unseen and a target are given, expected only one of them")
    if in_memory and limits != OutOfCoreOptions():
        raise InputError("a target, an importance and a source index exclude options for scenes larger than memory")
    start = time.perf_counter()
    builder = None
    if isinstance(source, Scene):
        read = source
    else:
        with source_path(source) as local, ExitStack() as stack:
            opened: Scene | None = None
            # A target or an importance may prune splats, whose levels are built anew.
            if (
                levels is not None
                and target is None
                and importance is None
                and detect_format(local, format).name == "sog"
            ):
                builder = _levels_of_source(local, options, levels, limits)
            if not in_memory and builder is None and may_exceed_memory(local, limits, levels, format):
                if progress is not None:
                    progress("opening", 0.0)
                opened = stack.enter_context(csplat.open(local, format, sh_degree=read_degree(options)))
                builder = choose_levels(opened.count, options, levels)
                if limits.resume or not estimate_cost(opened, options, limits, builder).in_memory:
                    return _encode_out_of_core(
                        opened, local, output, options, limits, start, builder, overrides=overrides, strict=strict,
                        progress=progress,
                    )  # fmt: skip
                if opened.format in CHEAP_TO_REOPEN:
                    opened = None
            read = read_source(
                local, overrides, format=format, strict=strict, keep_extra=options.keep_extra,
                sh_degree=read_degree(options), opened=opened, progress=progress,
            )  # fmt: skip
    if builder is None:
        builder = choose_levels(read.count, options, levels)
    model = read.model()
    if importance is not None:
        from csplat_tools.importance_file import encode_by_importance  # imports trainer and renderer

        result = encode_by_importance(
            model, options, importance, target=target, views=views, prune_unseen=prune_unseen, levels=builder,
            progress=progress,
        )  # fmt: skip
    else:
        result = encode_with_report(
            model, options, levels=builder, target=target, views=views, progress=progress
        )  # fmt: skip
    write_bytes(output, result.data)
    if source_index is not None:
        write_array(source_index, result.source_index)
    return EncodedFile(model, result.report, result, tuple(read.findings), read.size_bytes, time.perf_counter() - start)


def _levels_of_source(
    local: Path, options: EncodeOptions, levels: int | Literal["auto"], limits: OutOfCoreOptions
) -> FittedLevelBuilder | None:
    """Return the builder that takes the levels of streamed SOG, or `None` for a single level or a file without levels.

    Raises:
        InputError: the scene does not fit in memory; or as in `choose_levels`.
    """
    with csplat.open(local) as scene:
        counts = scene.levels
    builder = choose_levels(counts[0], options, levels) if len(counts) > 1 else None
    if builder is None:
        return None
    if limits != OutOfCoreOptions():
        raise InputError(
            "taking the levels of detail of the source requires the scene in memory: encode without levels, or encode a"
            " PLY of its finest level"
        )
    return replace(builder, nodes=read_streamed_levels(local, builder.count))


def may_exceed_memory(
    path: Path, limits: OutOfCoreOptions, levels: LevelCount = None, format: str | None = None
) -> bool:
    """Return True if a scene may not fit in memory, which can only be decided after opening it."""
    if limits.scheduler is not None or limits.resume or limits.always:
        return True
    bound = default_memory_bytes() if limits.memory_bytes is None else limits.memory_bytes
    size = size_on_disk(path)
    factor = _MEMORY_FACTOR * (1 if levels is None else _LEVELS_FACTOR)
    return size > _SMALL and (detect_format(path, format).name != "ply" or size * factor > bound)


def _encode_out_of_core(
    reader: Scene,
    local: Path,
    target: str,
    options: EncodeOptions,
    limits: OutOfCoreOptions,
    start: float,
    levels: FittedLevelBuilder | None,
    *,
    overrides: MetadataOverrides | None,
    strict: bool,
    progress: Progress | None,
) -> EncodedFile:
    """Encode an opened scene without reading it into memory, and write the .csplat file."""
    if target == STANDARD_STREAM:
        raise InputError("the scene does not fit in memory, and cannot be written to standard output: name a file")
    findings = [*reader.findings]
    if reader.extra and not options.keep_extra:
        findings.append(dropped_columns(list(reader.extra)))
    refuse(findings, strict=strict)
    scene = (overrides or MetadataOverrides()).apply_to_scene(reader)
    size = size_on_disk(local)
    try:
        source = {"name": local.name, "size": size, "changed": local.stat().st_mtime_ns}
        report = encode_scene(scene, target, options, limits, levels=levels, source=source, progress=progress)
    except (KeyboardInterrupt, OSError):
        folder = limits.working_folder(target)
        if folder.exists():
            note(f"{folder} holds the finished part: --resume continues from it")
        raise
    return EncodedFile(scene.empty(), report, None, tuple(findings), size, time.perf_counter() - start)


def format_cost(cost: EncodingCost) -> str:
    """Format the cost of an encoding as a line."""
    where = "in memory" if cost.in_memory else f"on the disk, {counted(cost.workers, 'process', 'processes')}"
    return (
        f"{counted(cost.splats, 'splat')} of SH degree {cost.sh_degree}, {where}: about"
        f" {format_estimate(cost.seconds)}, {format_bytes(cost.memory_bytes)} of memory,"
        f" {format_bytes(cost.disk_bytes)} of disk; the file about {format_bytes(cost.file_bytes)}"
    )


def format_declared_errors(errors: Mapping[str, tuple[float, float]]) -> list[str]:
    """Format declared errors, maximum and RMS by measure, as a table, or return an empty list if there are none."""
    if not errors:
        return []
    names = sorted(errors, key=list(MEASURE_NAMES.values()).index)
    rows = [(name, *(f"{value:.4g}" for value in errors[name])) for name in names]
    return [format_table(("declared error", "max", "rms"), rows)]


def format_encoding(encoded: EncodedFile, source: str, output: str) -> str:
    """Format counts, time, sizes and the PSNR, if it was measured, of an encoding as a line.

    Args:
        encoded: the written file.
        source, output: names of the files.
    """
    report = encoded.report
    per_splat = f" ({report.size_bytes / report.splat_count:.2f} bytes per splat)" if report.splat_count else ""
    ratio = encoded.source_bytes / report.size_bytes
    splats = f"{counted(report.splat_count, 'splat')} in {counted(report.tile_count, 'tile')}, {encoded.seconds:.2f} s"
    sizes = f"{format_bytes(encoded.source_bytes)} -> {format_bytes(report.size_bytes)}{per_splat}"
    quality, psnr = "", None if encoded.result is None else encoded.result.psnr
    if psnr is not None:
        quality = f", PSNR {psnr:.2f} dB"
    elif encoded.result is not None and len(encoded.source) and "-" not in (source, output):
        quality = f"; `csplat compare {source} {output}` shows how it looks"
    return f"{splats}: {sizes}, {ratio:.1f} times smaller{quality}"

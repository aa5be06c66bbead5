"""Convert PLY to .csplat and back: `csplat encode` and `csplat decode` without the command line."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

from csplat import formats
from csplat.decoder import Limits, open_tiles
from csplat.encoder import EncodeOptions, EncodeReport, EncodeResult, encode_with_report
from csplat.errors import InputError
from csplat.inputs import File
from csplat.lint import Finding
from csplat.model import SplatModel
from csplat.scene import Scene
from csplat.types import Progress, null_progress
from csplat_tools.files.by_disk import ByDisk, Scale, encode_by_disk, read_degree
from csplat_tools.files.facts import SceneOverrides
from csplat_tools.files.filters import Filters
from csplat_tools.files.scenes import LoadedModel, size_of, watched
from csplat_tools.files.streams import is_one_way, mapped_csplat, source_path, write_array, write_bytes, write_model


@dataclass(frozen=True)
class EncodedScene:
    """An encoded file, with the report of the search that made it, if any.

    Attributes:
        result: the encoder's result.
        key: name of the entry of a JSON report that holds `said`; "": none.
        said: report of the target, the candidates and the choice, JSON-compatible.
        lines: remarks for the user, a sentence each.
    """

    result: EncodeResult
    key: str = ""
    said: Mapping[str, Any] = field(default_factory=dict)
    lines: tuple[str, ...] = ()


#: Encodes a scene, with a progress callback.
Encoder = Callable[[SplatModel, EncodeOptions, Progress | None], EncodedScene]


@dataclass(frozen=True)
class Encoded:
    """The outcome of an encoding.

    Attributes:
        source: the scene as it was encoded; without its splats if it did not stay in memory.
        report: choices and errors.
        made: the encoded file; `None` if the scene did not stay in memory.
        findings: findings of lint in the PLY.
        source_bytes: size of the PLY.
        seconds: time of reading, encoding and writing.
    """

    source: SplatModel
    report: EncodeReport
    made: EncodedScene | None
    findings: tuple[Finding, ...]
    source_bytes: int
    seconds: float

    def as_json(self) -> dict[str, Any]:
        """Return everything as JSON-compatible values."""
        report, made = self.report, self.made
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
            **({made.key: dict(made.said)} if made is not None and made.key else {}),
        }


def read_source(
    file: File,
    facts: SceneOverrides | None = None,
    *,
    strict: bool = False,
    keep_extra: bool = False,
    sh_degree: int | None = None,
    progress: Progress | None = None,
) -> LoadedModel:
    """Read a scene in any format, and repair defects if that is safe.

    Args:
        file: a path, or `-`; an open binary file; or bytes.
        facts: overrides of the scene's metadata.
        strict: refuse defects that would be repaired.
        keep_extra: carry columns that splats do not have.
        sh_degree: leave out the SH bands above, even of a file of a higher degree than 3; `None`: keep all.
        progress: progress callback.

    Raises:
        CsplatError: the scene is not usable.
        OSError: the scene cannot be read.
    """
    findings: list[Finding] = []
    report = progress or null_progress
    report("reading", 0.0)
    with source_path(file) as local:
        model = formats.read(local, strict=strict, keep_extra=keep_extra, sh_degree=sh_degree, report=findings)
        size_bytes, name = size_of(local), local.name
    report("reading", 1.0)
    return LoadedModel((facts or SceneOverrides()).applied(model), size_bytes, name=name, findings=tuple(findings))


def encode_file(
    source: str,
    target: str,
    options: EncodeOptions,
    *,
    facts: SceneOverrides | None = None,
    strict: bool = False,
    importance: str | None = None,
    prune_unseen: bool = False,
    source_index: str | None = None,
    encoder: Encoder | None = None,
    scale: Scale | None = None,
    progress: Progress | None = None,
) -> Encoded:
    """Read a PLY, encode it, write the file.

    Args:
        source: a PLY, or `-`.
        target: the file to write, or `-`. The caller has checked that it may be replaced.
        options: options of the encoder; `keep_extra` applies to reading, too.
        facts: overrides of the PLY's metadata.
        strict: refuse defects that would be repaired.
        importance: a .npy file with one weight per splat of the PLY as read, or a file of `csplat sensitivity`.
        prune_unseen: leave out the splats that no view of the sensitivities saw.
        source_index: a .npy file to write: for each splat of the file, its index in the PLY as read.
        encoder: encodes instead of the plain encoder, such as a target search; it does not get `importance`.
        scale: memory, disk and workers. An `encoder`, an importance or a source index requires the scene in memory.
        progress: progress callback.

    Raises:
        CsplatError: the PLY or the options cannot be used.
        OSError: a file cannot be read or written.
    """
    start, scale = time.perf_counter(), scale or Scale()
    in_memory = encoder is not None or importance is not None or source_index is not None
    read: LoadedModel | None = None
    with source_path(source) as local:
        if not in_memory and scale.may_leave_memory(local):
            done = encode_by_disk(local, target, options, facts, scale, strict=strict, progress=progress)
            if isinstance(done, ByDisk):
                seconds = time.perf_counter() - start
                return Encoded(done.facts, done.report, None, done.findings, size_of(local), seconds)
            read = done
        if read is None:
            read = read_source(
                local, facts, strict=strict, keep_extra=options.keep_extra, sh_degree=read_degree(options),
                progress=progress,
            )  # fmt: skip
    model = read.model
    if encoder is not None:
        made = encoder(model, options, progress)
    elif importance is None:
        if prune_unseen:
            raise InputError("only what `csplat sensitivity` wrote says which splats no view saw")
        made = EncodedScene(encode_with_report(model, options, progress=progress))
    else:
        from csplat_tools.files.importance import encode_by_importance  # imports names of trainer and renderer

        made = EncodedScene(
            encode_by_importance(model, options, importance, prune_unseen=prune_unseen, progress=progress)
        )
    write_bytes(target, made.result.data)
    if source_index is not None:
        write_array(source_index, made.result.source_index)
    return Encoded(model, made.result.report, made, read.findings, read.size_bytes, time.perf_counter() - start)


def decode_file(
    source: str,
    target: str,
    *,
    sh_degree: int | None = None,
    absolute: bool = False,
    max_splats: int | None = None,
    facts: SceneOverrides | None = None,
    progress: Progress | None = None,
) -> tuple[int, int]:
    """Read a .csplat file, write a PLY, some splats at a time.

    Args:
        source: the file, or `-`.
        target: the PLY to write, or `-`. The caller has checked that it may be replaced.
        sh_degree: leave out the SH bands above.
        absolute: add the origin and write doubles.
        max_splats: refuse a scene of more splats; `None`: no limit.
        facts: overrides of the file's metadata for the PLY.
        progress: called with the stage's name and the fraction done.

    Returns:
        The number of splats written, and their SH degree.

    Raises:
        CsplatError: the file is not valid, or too large; then there is no PLY.
        OSError: a file cannot be read or written.
    """
    with mapped_csplat(source) as data:
        opened = open_tiles(data, limits=None if max_splats is None else Limits(splats=max_splats))
        decoded = Scene(opened.header.splat_count, opened.facts, opened.models)
        # All bands are decoded, even if some are left out: damage anywhere gives no PLY.
        scene = Filters(sh_degree=sh_degree).applied((facts or SceneOverrides()).applied_to_all(decoded))
        if is_one_way(target):
            for _ in watched(decoded, "checking", progress).blocks():
                pass
        write_model(target, watched(scene, "decoding", progress), absolute=absolute)
    return scene.count, scene.facts.sh_degree


def findings_as_json(findings: tuple[Finding, ...] | list[Finding]) -> list[dict[str, Any]]:
    """Return findings as JSON-compatible values."""
    return [{"id": one.id, "kind": one.kind, "count": one.count, "text": one.text} for one in findings]

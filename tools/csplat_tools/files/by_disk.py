"""Encoding a scene that may not fit the memory: what `csplat encode --memory` does."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from csplat.encoder import EncodeOptions, EncodeReport
from csplat.errors import InputError
from csplat.formats import format_of, open_scene, read_all
from csplat.large import Needs, encode_scene, needs_of
from csplat.lint import Finding, dropped_columns, refuse
from csplat.memory import default_bytes
from csplat.model import MAX_SH_DEGREE, SplatModel
from csplat_tools.files.console import Progress, note
from csplat_tools.files.facts import SceneOverrides
from csplat_tools.files.scenes import READ_ANEW, LoadedModel, size_of
from csplat_tools.files.streams import STANDARD_STREAM

__all__ = ["ByDisk", "Expected", "Scale", "encode_by_disk", "expected", "read_degree"]

_FOLDS = 4  # a scene in memory, in times of a PLY's bytes; of others it has to be looked at
#: By SH degree: seconds per million splats to read once, and to code; seconds for a codebook. Within a tenth of what
#: copies of fox120k took at `balanced`: 10 M and 100 M of degree 0, 3 M of 1, 2 and 3, 30 M of 3.
_SECONDS = ((0.2, 3.1, 0.0), (0.35, 7.0, 8.0), (0.45, 7.3, 12.0), (0.55, 8.0, 20.0))
#: By preset and SH degree, bytes of a file per splat.
_FILE_BYTES = {"fast": (9.0, 9.5, 10.0, 11.0), "balanced": (6.5, 8.0, 8.5, 9.0), "small": (5.0, 6.5, 7.0, 7.5)}
_SMALL = 4 << 20  # bytes of a file of any format that fits every memory


@dataclass(frozen=True)
class Scale:
    """Where a scene lies while it is encoded.

    Attributes:
        memory_bytes: a bound; `None`: half of what is free.
        folder: the working folder; `None`: beside the file.
        resume: go on with what the folder has.
        cluster: address of a Dask scheduler.
        by_disk: a scene of several buckets does not stay in memory, even where it would fit.
    """

    memory_bytes: int | None = None
    folder: str | None = None
    resume: bool = False
    cluster: str | None = None
    by_disk: bool = False

    def may_leave_memory(self, path: Path) -> bool:
        """Whether it has to be found out if a scene fits the memory."""
        if self.cluster is not None or self.resume or self.by_disk:
            return True
        bound = default_bytes() if self.memory_bytes is None else self.memory_bytes
        size = size_of(path)
        return size > _SMALL and (format_of(path).name != "ply" or size * _FOLDS > bound)


@dataclass(frozen=True)
class ByDisk:
    """A scene that was encoded without being in memory."""

    facts: SplatModel
    report: EncodeReport
    findings: tuple[Finding, ...]


def read_degree(options: EncodeOptions) -> int | None:
    """Return the SH degree to read a scene with that is to be encoded: what is dropped of it is part of its errors.

    A file of a higher degree than models have is readable only where bands are to be left out.
    """
    return None if options.sh_degree is None else MAX_SH_DEGREE


def encode_by_disk(
    local: Path,
    target: str,
    options: EncodeOptions,
    facts: SceneOverrides | None,
    scale: Scale,
    *,
    strict: bool,
    progress: Progress | None,
) -> ByDisk | LoadedModel | None:
    """Encode a scene by way of the disk, or give it where it fits the memory.

    Args:
        local: the scene, in any format.
        target: the file to write.
        options: of the encoder.
        facts: what the scene does not say.
        scale: memory, disk, workers.
        strict: refuse what would be repaired.
        progress: is told the stages.

    Returns:
        What was encoded; or the scene, read, as `read_source` has it; `None` where it fits the memory and its format
        has a reader that is quicker from the beginning.

    Raises:
        CsplatError: as of `encode_scene`; or it is too large to go to standard output.
        OSError: likewise.
    """
    if progress is not None:
        progress("opening", 0.0)
    with open_scene(local, sh_degree=read_degree(options)) as opened:
        in_memory = needs_of(opened, options, scale.memory_bytes, by_disk=scale.by_disk).in_memory
        if in_memory and scale.cluster is None and not scale.resume:
            if opened.format in READ_ANEW:
                return None
            findings: list[Finding] = []
            if progress is not None:
                progress("reading", 0.0)
            model = read_all(opened, strict=strict, keep_extra=options.keep_extra, report=findings)
            model = (facts or SceneOverrides()).applied(model)
            return LoadedModel(model, size_of(local), name=local.name, findings=tuple(findings))
        if target == STANDARD_STREAM:
            raise InputError("the scene does not fit the memory, and would be written by way of the disk: name a file")
        findings = [*opened.findings]
        if opened.facts.extra and not options.keep_extra:
            findings.append(dropped_columns(list(opened.facts.extra)))
        refuse(findings, strict=strict)
        scene = (facts or SceneOverrides()).applied_to_all(opened)
        try:
            report = encode_scene(
                scene, target, options, memory_bytes=scale.memory_bytes, by_disk=scale.by_disk, folder=scale.folder,
                resume=scale.resume, cluster=scale.cluster, progress=progress,
                source={"name": local.name, "size": size_of(local), "changed": local.stat().st_mtime_ns},
            )  # fmt: skip
        except (KeyboardInterrupt, OSError):
            folder = Path(scale.folder or f"{target}.work")
            if folder.exists():
                note(f"{folder} keeps what is done: --resume goes on with it")
            raise
        return ByDisk(scene.facts, report, tuple(findings))


@dataclass(frozen=True)
class Expected:
    """What an encoding will take.

    Attributes:
        count, sh_degree: of the scene.
        needs: memory, disk, workers.
        seconds: about, by what was measured (`_SECONDS`) on one core, here with as many as will work.
        file_bytes: of the file, about, at the preset's precision.
    """

    count: int
    sh_degree: int
    needs: Needs
    seconds: float
    file_bytes: int

    def as_json(self) -> dict[str, Any]:
        """Everything, JSON-compatible."""
        return {
            "splats": self.count,
            "sh_degree": self.sh_degree,
            "in_memory": self.needs.in_memory,
            "workers": self.needs.workers,
            "memory_bytes": self.needs.memory_bytes,
            "disk_bytes": self.needs.disk_bytes,
            "seconds": round(self.seconds, 1),
            "file_bytes": self.file_bytes,
        }


def expected(local: Path, options: EncodeOptions, scale: Scale) -> Expected:
    """Say what encoding a scene will take, without looking at its splats.

    Raises:
        CsplatError: it cannot be read, or the memory is too little.
        OSError: it cannot be read.
    """
    with open_scene(local, sh_degree=read_degree(options)) as opened:
        needs = needs_of(opened, options, scale.memory_bytes, by_disk=scale.by_disk)
        count = opened.count
        degree = opened.facts.sh_degree if options.sh_degree is None else min(options.sh_degree, opened.facts.sh_degree)
    read, code, book = _SECONDS[min(degree, 1) if options.preset == "fast" else degree]
    passes = 1 if needs.in_memory else 4
    seconds = count / 1e6 * (read * passes + code / needs.workers) + book * min(1.0, count / 5e5) / needs.workers
    return Expected(count, degree, needs, seconds, round(count * _FILE_BYTES[options.preset][degree]))

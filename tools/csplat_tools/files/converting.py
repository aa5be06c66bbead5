"""From any format to any other: what `csplat convert` and `csplat formats` do, apart from the command line."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from csplat.errors import InputError
from csplat.formats import Format, formats, named, named_by, open_scene
from csplat.formats.format import ARRAYS
from csplat.lint import Finding
from csplat_tools.files.console import Progress
from csplat_tools.files.convert import findings_as_json
from csplat_tools.files.facts import SceneOverrides
from csplat_tools.files.filters import Filters
from csplat_tools.files.scenes import size_of, watched
from csplat_tools.files.streams import local_path

__all__ = ["Converted", "convert_file", "format_rows"]


@dataclass(frozen=True)
class Converted:
    """What became of a scene.

    Attributes:
        source_format, target_format: names of the formats.
        count, sh_degree: of what was written, or would be.
        source_bytes, size_bytes: of the files; the latter is about what is expected where nothing was written, `None`
            where that cannot be said.
        lost: what the target has no place for.
        rounded: names of the arrays that the target rounds.
        axes: before and after.
        findings: what was noticed in the source.
    """

    source_format: str
    target_format: str
    count: int
    sh_degree: int
    source_bytes: int
    size_bytes: int | None
    lost: tuple[str, ...]
    rounded: tuple[str, ...]
    axes: tuple[str, str]
    findings: tuple[Finding, ...]

    def as_json(self) -> dict[str, Any]:
        """Return everything as JSON-compatible values."""
        return {
            "source_format": self.source_format,
            "format": self.target_format,
            "splats": self.count,
            "sh_degree": self.sh_degree,
            "source_bytes": self.source_bytes,
            "size_bytes": self.size_bytes,
            "lost": list(self.lost),
            "rounded": list(self.rounded),
            "axes": list(self.axes),
            "defects": findings_as_json(self.findings),
        }

    def losses(self) -> str:
        """One line: what is lost on the way."""
        words = [*self.lost, *([f"precision of {', '.join(self.rounded)}"] if self.rounded else [])]
        return "; ".join(words)


def convert_file(
    source: str,
    target: str,
    *,
    read_as: str | None = None,
    write_as: str | None = None,
    level: int = 0,
    facts: SceneOverrides | None = None,
    filters: Filters | None = None,
    no_loss: bool = False,
    dry_run: bool = False,
    progress: Progress | None = None,
) -> Converted:
    """Read a scene in one format and write it in another, some splats at a time.

    Args:
        source: a file, or a folder, or `-`.
        target: what to write; its name says the format where `write_as` does not. Whether it may be replaced has been
            settled before.
        read_as: the name of the source's format, where its content does not say it.
        write_as: the name of the target's.
        level: of a source that has the scene several times; 0 is the finest.
        facts: what the source does not say.
        filters: what becomes of the scene on the way.
        no_loss: refuse where anything is lost.
        dry_run: write nothing.
        progress: is told how many splats are read; some formats want them twice.

    Raises:
        CsplatError: the source is not whole, the target cannot hold it, or something would be lost and must not be.
        OSError: a file cannot be read or written.
    """
    writes = named_by(Path(target)) if write_as is None else named(write_as)
    if writes.write is None:
        raise InputError(f"{target} would be {writes.title}, which csplat does not write")
    sh_degree = None if filters is None else filters.sh_degree
    with local_path(source) as local, open_scene(local, read_as, level=level, sh_degree=sh_degree) as opened:
        scene = (facts or SceneOverrides()).applied_to_all(opened)
        before = scene.facts.coordinate_system
        scene = (filters or Filters()).applied(scene)
        lost = writes.losses(scene.facts)
        rounded = tuple(
            name for name in ARRAYS if name not in writes.exact and (name != "shN" or scene.facts.sh_degree)
        )
        made = Converted(
            opened.format, writes.name, scene.count, scene.facts.sh_degree, size_of(local),
            writes.expected_bytes(scene.facts, scene.count), lost, rounded,
            (before, writes.axes or scene.facts.coordinate_system), (),
        )  # fmt: skip
        if no_loss and (lost or rounded):
            raise InputError(f"{writes.title} does not keep all of {source}: {made.losses()}")
        if not dry_run:
            writes.write(Path(target), watched(scene, "reading", progress))
            made = replace(made, size_bytes=size_of(Path(target)))
        return replace(made, findings=tuple(opened.findings))


def format_rows() -> list[tuple[str, ...]]:
    """A row for each format: name, endings, whether it is read and written, SH degree, axes, what it carries."""
    return [
        (
            one.name,
            " ".join(one.suffixes) or "-",
            "yes" if one.open is not None else "no",
            "yes" if one.write is not None else "no",
            str(one.degree),
            one.axes or "-",
            _exactness(one),
            ", ".join(sorted(name.replace("_", " ") for name in one.carries)) or "-",
        )
        for one in formats()
    ]


def _exactness(one: Format) -> str:
    return "all" if set(ARRAYS) <= one.exact else ", ".join(name for name in ARRAYS if name in one.exact) or "-"

"""Convert scenes from any format to any other: `csplat convert` and `csplat formats` without the command line."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from csplat.errors import InputError
from csplat.formats import Format, formats, named, named_by, open_scene
from csplat.formats.format import ARRAYS
from csplat.lint import Finding
from csplat.types import Progress
from csplat_tools.files.convert import findings_as_json
from csplat_tools.files.facts import SceneOverrides
from csplat_tools.files.filters import Filters
from csplat_tools.files.scenes import size_of, watched
from csplat_tools.files.streams import local_path


@dataclass(frozen=True)
class Converted:
    """The outcome of a conversion.

    Attributes:
        source_format, target_format: names of the formats.
        count, sh_degree: number of splats and SH degree of the scene that was written, or would be.
        source_bytes, size_bytes: sizes of the files; the latter is an estimate if nothing was written, `None` if it
            cannot be estimated.
        lost: contents that the target has no place for.
        rounded: names of the arrays that the target rounds.
        axes: axes before and after.
        findings: findings in the source.
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
        """Describe in one line the contents and precision that are lost; empty if there are none."""
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
        target: the file or folder to write; its name determines the format unless `write_as` does. The caller has
            checked that it may be replaced.
        read_as: the name of the source's format, if its content does not tell.
        write_as: the name of the target's format.
        level: level of detail to read from a source that has several; 0 is the finest.
        facts: overrides of the source's metadata.
        filters: changes of the scene on the way.
        no_loss: refuse if anything would be lost.
        dry_run: write nothing.
        progress: called with the fraction of splats that is read; some formats read them twice.

    Raises:
        CsplatError: the source is not whole, the target cannot hold it, or `no_loss` is set and something is lost.
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
    """Return a row for each format: name, endings, if it is read, if it is written, SH degree, axes, exact, carried."""
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

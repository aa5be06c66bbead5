"""Find the scenes of a batch: in a folder, or in the lines of a manifest."""

from __future__ import annotations

import csv
import os
import re
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from fnmatch import fnmatch
from pathlib import Path, PurePath, PurePosixPath
from typing import Any

from csplat.disk_files import parse_json, read_text, resolve_links
from csplat.errors import InputError
from csplat.formats import formats
from csplat.remote_store import is_url
from csplat.system import split_words
from csplat_tools.scene_files import FOLDER_NAMES

_MANIFESTS = (".jsonl", ".csv", ".txt")
_COLUMNS = ("path", "output", "options")
_ONE_LEVEL, _LEVELS = FOLDER_NAMES
_CSPLAT = ".csplat"
#: The file that INRIA's trainer writes next to its scenes, with its initial points; and the folder of its scenes.
_POINTS, _SCENES = "input.ply", "point_cloud"
_OTHER_GPU = re.compile(r"_rank[1-9]\d*\.pt$")  # gsplat's checkpoints, which are read with that of rank 0
#: Commands that take some scenes of a folder: True: only .csplat files; False: all others.
_TAKES_CSPLAT = {"encode": False, "decode": True, "extract": True}


@dataclass(frozen=True)
class Task:
    """A scene and its output.

    Attributes:
        source: path or URL of the scene.
        output: path within the folder of outputs, with slashes; or a URL.
        options: options for this scene only, which follow those for all scenes.
    """

    source: str
    output: str
    options: tuple[str, ...] = ()


@dataclass(frozen=True)
class _ListedScene:
    """A scene whose output may have no name yet; it is then derived from `within`, a relative path."""

    task: Task
    within: str


def find_tasks(scenes: str, command: str, ending: str, *, match: str = "*", without: Path | None = None) -> list[Task]:
    """Return the scenes of a folder, sorted, or those of a manifest in its order.

    Args:
        scenes: a folder, searched with its subfolders for the endings of all formats, without the input.ply of
            INRIA's trainer; or a manifest: lines of JSON (.jsonl), or of path, output and options (.csv,
            .txt), separated by commas or, as some spreadsheets write them, by semicolons or tabs.
        command: the command for the scenes: `encode` skips .csplat files, `decode` skips all others.
        ending: file name ending of outputs without a name.
        match: shell pattern of names within a folder.
        without: a folder that is not searched, such as that of the outputs.

    Raises:
        InputError: `scenes` is neither, or a line is invalid; there are no scenes, or two have the same output.
        OSError: `scenes` cannot be read.
    """
    path = Path(scenes)
    path.stat()
    if path.is_dir():
        found = [_ListedScene(Task(str(path / name), ""), name) for name in _names(path, command, match, without)]
    elif path.suffix.lower() in _MANIFESTS:
        found = list(_listed(path))
    else:
        raise InputError(f"{scenes} is not a folder, expected a folder or a manifest: {', '.join(_MANIFESTS)}")
    if not found:
        raise InputError(f"{scenes} has no scenes for `csplat {command}`")
    named = _named(found, resolve_links(path).name if path.is_dir() else path.stem, ending)
    output, count = Counter(one.output for one in named).most_common(1)[0]
    if count > 1:
        raise InputError(f"{output} is the output of {count} scenes: name their outputs in a manifest")
    return named


def _names(folder: Path, command: str, match: str, without: Path | None) -> list[str]:
    """Return the relative paths of the scenes within a folder, with slashes."""
    endings = tuple(suffix for one in formats() if one.open is not None for suffix in one.suffixes)
    away = None if without is None else resolve_links(without)
    names = []
    for one in sorted(folder.rglob("*")):
        name = one.name.lower()
        known = name.endswith(tuple(end for end in endings if end.startswith("."))) or name in FOLDER_NAMES
        own = _TAKES_CSPLAT.get(command)
        if not known or one.is_dir() or (own is not None and own != name.endswith(_CSPLAT)):
            continue
        relative = one.relative_to(folder).as_posix()
        hidden = any(part.startswith(".") for part in relative.split("/"))
        ours = away is not None and Path(os.path.realpath(one)).is_relative_to(away)
        if not hidden and not ours and (fnmatch(relative, match) or fnmatch(one.name, match)):
            names.append(relative)
    points = starting_points(folder, names)
    return [name for name in names if name not in points and not _is_part(name, names)]


def starting_points(folder: Path, names: Sequence[str] | None = None) -> list[str]:
    """Return the files of a folder that hold the initial points of INRIA's trainer, not a scene.

    Args:
        folder: the folder to search.
        names: relative paths of its files, with slashes; `None`: all files.
    """
    found = [one.relative_to(folder).as_posix() for one in folder.rglob(_POINTS)] if names is None else names
    return [
        one
        for one in sorted(found)
        if PurePosixPath(one).name == _POINTS and (folder / one).with_name(_SCENES).is_dir()
    ]


def _is_part(name: str, names: Sequence[str]) -> bool:
    """Return True if a file is part of a scene with levels in subfolders, or another GPU's part of a checkpoint."""
    path = PurePosixPath(name)
    if (gpu := _OTHER_GPU.search(name)) and f"{name[: gpu.start()]}_rank0.pt" in names:
        return True
    return path.name == _ONE_LEVEL and any(str(above / _LEVELS) in names for above in path.parents)


def _listed(manifest: Path) -> Iterator[_ListedScene]:
    """Yield the scenes of a manifest's lines. Paths are relative to its folder."""
    text = read_text(manifest)
    lines = _json_lines(manifest, text) if manifest.suffix.lower() == ".jsonl" else _table_lines(text)
    for number, fields in lines:
        where = f"{manifest.name}, line {number}"
        source, output, options = (fields.get(name) or "" for name in _COLUMNS)
        if not isinstance(source, str) or not source or not isinstance(output, str):
            raise InputError(f"{where}: expected a path, optionally an output and options")
        if not is_url(output) and leads_out(output):
            raise InputError(f"{where}: the output {output} is outside the folder of outputs")
        try:
            words = split_words(options) if isinstance(options, str) else [str(word) for word in options]
        except (ValueError, TypeError):
            raise InputError(f"{where}: the options are {options!r}, expected words of a command line") from None
        if "\\" in source and not is_url(source) and not (manifest.parent / source).exists():
            source, output = source.replace("\\", "/"), output.replace("\\", "/")  # written on Windows
        placed = source if is_url(source) else str(manifest.parent / source)
        yield _ListedScene(Task(placed, output, tuple(words)), _within(source))


def _json_lines(manifest: Path, text: str) -> Iterator[tuple[int, dict[str, Any]]]:
    for number, line in enumerate(text.splitlines(), 1):
        if not line.strip():
            continue
        try:
            fields = parse_json(line)
        except InputError:
            fields = None
        if not isinstance(fields, dict):
            raise InputError(f"{manifest.name}, line {number}: expected a JSON object with a path")
        yield number, fields


def _table_lines(text: str) -> Iterator[tuple[int, dict[str, Any]]]:
    """Yield each row's line number, and its cells by column; a header row may reorder the columns."""
    rows = csv.reader(text.splitlines(), skipinitialspace=True, delimiter=_separator(text))
    columns: Sequence[str] = _COLUMNS
    for row in _rows(rows):
        cells = [cell.strip() for cell in row]
        if not any(cells) or cells[0].startswith(("#", "sep=")):
            continue
        heading = [cell.casefold() for cell in cells]
        if "path" in heading and set(heading) <= {*_COLUMNS, ""}:
            columns = heading
        else:
            yield rows.line_num, dict(zip(columns, cells, strict=False))


def _rows(rows: Iterator[list[str]]) -> Iterator[list[str]]:
    try:
        yield from rows
    except csv.Error as error:
        raise InputError(f"the manifest is not a table: {error}") from None


def _separator(text: str) -> str:
    """Return the separator of a table's cells: a comma, or what spreadsheets write instead in many countries.

    It is that of the first line: the names of the columns, Excel's `sep=;`, or a scene.
    """
    lines = (line for line in text.splitlines() if line.strip() and not line.startswith("#"))
    first = next(lines, "").casefold().removeprefix("sep=")
    return next((one for one in ";\t" if one in first and "," not in first), ",")


def _within(source: str) -> str:
    """Return a manifest's path as one within the folder of outputs; its last part if it leads out."""
    path = PurePosixPath(source.partition("?")[0])
    return path.name if is_url(source) or leads_out(str(path)) else str(path)


def leads_out(name: str, flavour: type[PurePath] = PurePath) -> bool:
    """Return True if a relative path leads out of its folder, read as a POSIX path or as one of this system.

    Args:
        name: the path.
        flavour: the path class of this system.
    """
    return any(path.anchor or ".." in path.parts for path in (PurePosixPath(name), flavour(name)))


def _named(found: Sequence[_ListedScene], root: str, ending: str) -> list[Task]:
    """Name the outputs: the source's name with another ending, or with one appended if names would clash."""
    short = [one.task.output or _output(one.within, root, ending, whole=False) for one in found]
    counts = Counter(short)
    return [
        replace(
            one.task,
            output=name if one.task.output or counts[name] == 1 else _output(one.within, root, ending, whole=True),
        )
        for one, name in zip(found, short, strict=True)
    ]


def _output(within: str, root: str, ending: str, *, whole: bool) -> str:
    path = PurePosixPath(within)
    if path.name in FOLDER_NAMES:
        return f"{path.parent if path.parent.name else root}{ending}"
    endings = [end for one in formats() for end in one.suffixes if path.name.lower().endswith(end)]
    stem = path.name if whole or not endings else path.name[: -len(max(endings, key=len))]
    return str(path.with_name(stem + ending))

"""Decide which images of a data set are for training, validation and test."""

from __future__ import annotations

from collections.abc import Container, Mapping, Sequence
from pathlib import Path, PurePosixPath

from csplat.errors import InputError, counted
from csplat.files import read_json, read_text
from csplat_trainer.data.dataset import Shot
from csplat_trainer.data.image_files import match_names, plain, shown

_SCANNET = "train_test_lists.json"  # of ScanNet++

#: Names of lists, and what each is for.
ROLES = {"train": "training", "val": "validation", "test": "test"}


def lists_next_to(folders: Sequence[Path]) -> tuple[dict[str, list[str]], str]:
    """Read the files that list images: ScanNet++'s `train_test_lists.json`, or text with a name a line.

    Text files are called `test.txt` or `test_list.txt`, and so for `val` and `train`.

    Args:
        folders: to look in; the first that has any counts.

    Returns:
        Lines by `train`, `val` and `test`, and the files' names.

    Raises:
        InputError: a file is not UTF-8 text.
    """
    for folder in folders:
        document = folder / _SCANNET
        if document.is_file():
            return _json_lists(document), document.name
        files = {role: path for role in ROLES for path in _files(folder, role)[:1]}
        if files:
            lists = {role: read_text(path).splitlines() for role, path in files.items()}
            return lists, ", ".join(path.name for path in files.values())
    return {}, ""


def _json_lists(path: Path) -> dict[str, list[str]]:
    document = read_json(path)
    lists = {role: document.get(role) for role in ROLES} if isinstance(document, dict) else {}
    found = {role: names for role, names in lists.items() if isinstance(names, list)}
    if not found or not all(isinstance(name, str) for names in found.values() for name in names):
        raise InputError(f"{path} holds no lists of names, expected train, val or test")
    return found


def _files(folder: Path, role: str) -> list[Path]:
    names = {path.name.casefold(): path for path in folder.glob("*.[tT][xX][tT]")}
    return [names[name] for name in (f"{role}.txt", f"{role}_list.txt") if name in names]


def _cells(line: str, known: Container[str]) -> list[str]:
    """Return the names of a line of a list: the line itself, or what is between commas and in quotes; no comments."""
    line = line.strip()
    if line in known or plain(line) in known:
        return [line]
    if line.startswith("#"):
        return []
    return [name for cell in line.split(",") if (name := cell.strip().strip("\"'").strip())]


def split_every(shots: Sequence[Shot], every: int, report: list[str]) -> tuple[list[Shot], list[Shot]]:
    """Hold out the first and then every Nth image, in the order of their names.

    Args:
        shots: all images.
        every: N: 8 is the custom; 0 holds out none.
        report: a line is appended if any is held out.

    Returns:
        Training images, test images.

    Raises:
        InputError: N is 1 or negative.
    """
    if every < 0 or every == 1:
        raise InputError(f"a test image every {every} images, expected 2 or more, or 0 for none")
    ordered = sorted(shots, key=lambda shot: shot.name)
    if every == 0 or len(ordered) < 2:
        return ordered, []
    report.append(f"no split is named: every {every}th image is a test image")
    return [s for i, s in enumerate(ordered) if i % every], ordered[::every]


def split_listed(
    shots: Sequence[Shot], lists: Mapping[str, Sequence[str]], where: str, report: list[str]
) -> tuple[list[Shot], list[Shot], list[Shot]]:
    """Split images by lists of names.

    A list that names none of the images decides nothing. An image on two lists is for test rather than validation, and
    for validation rather than training. An image on none is for training, unless training images are listed: then it
    is left out.

    Args:
        shots: all images.
        lists: names, or lines of a file, by `train`, `val` and `test`, of which one is there at least.
        where: the file that has the lists, for messages.
        report: lines are appended on what each list names.

    Returns:
        Training, validation and test images.

    Raises:
        InputError: a name fits two images.
    """
    by_name = {shot.name: shot for shot in shots}
    roles: dict[str, str] = {}
    heeded = []
    for role, word in reversed(ROLES.items()):
        if role not in lists:
            continue
        cells = [name for line in lists[role] for name in _cells(line, by_name)]
        names = list({PurePosixPath(name).as_posix(): name for name in cells}.values())
        found, notes = match_names(names, by_name, where)
        report += notes
        missing = [name for name in names if name not in found]
        line = f"{where} names {counted(len(names), f'{word} image')}"
        there = {0: "none of them is there", 1: "1 of them is there"}.get(len(found), f"{len(found)} of them are there")
        report.append(f"{line}, {there}; missing: {shown(missing)}" if missing else line)
        heeded += [role] if found else []
        twice = [name for name in found.values() if name in roles]
        if twice:
            report.append(
                f"{where}: {counted(len(twice), 'image')} on more than one list, no {word} images: {shown(twice)}"
            )
        roles = {**dict.fromkeys(found.values(), role), **roles}
    unlisted = [shot.name for shot in shots if shot.name not in roles]
    if "train" not in heeded:
        roles |= dict.fromkeys(unlisted, "train")
    elif unlisted:
        report.append(f"{where}: {counted(len(unlisted), 'image')} on no list, left out: {shown(unlisted)}")
    train, val, test = ([shot for shot in shots if roles.get(shot.name) == role] for role in ("train", "val", "test"))
    return train, val, test

"""Decide which images of a data set are for training, validation and test."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from csplat.errors import InputError, counted
from csplat_trainer.data.dataset import Shot
from csplat_trainer.data.image_files import match_names, shown

__all__ = ["split_every", "split_listed"]


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

    An image on two lists is for test rather than validation, and for validation rather than training. An image on none
    is for training; but not if training images are listed: then it is left out.

    Args:
        shots: all images.
        lists: names by `train`, `val` and `test`, of which one is there at least.
        where: the file that has the lists, for messages.
        report: lines are appended on what each list names.

    Returns:
        Training, validation and test images.

    Raises:
        InputError: a name fits two images.
    """
    by_name = {shot.name: shot for shot in shots}
    roles: dict[str, str] = {}
    for role, word in (("test", "test"), ("val", "validation"), ("train", "training")):
        if role not in lists:
            continue
        names = list(dict.fromkeys(lists[role]))
        found, notes = match_names(names, by_name, where)
        report += notes
        missing = [name for name in names if name not in found]
        line = f"{where} names {counted(len(names), f'{word} image')}"
        there = {0: "none of them is there", 1: "1 of them is there"}.get(len(found), f"{len(found)} of them are there")
        report.append(f"{line}, {there}; missing: {shown(missing)}" if missing else line)
        twice = [name for name in found.values() if name in roles]
        if twice:
            report.append(
                f"{where}: {counted(len(twice), 'image')} on more than one list, no {word} images: {shown(twice)}"
            )
        roles = {**dict.fromkeys(found.values(), role), **roles}
    unlisted = [shot.name for shot in shots if shot.name not in roles]
    if "train" not in lists:
        roles |= dict.fromkeys(unlisted, "train")
    elif unlisted:
        report.append(f"{where}: {counted(len(unlisted), 'image')} on no list, left out: {shown(unlisted)}")
    train, val, test = ([shot for shot in shots if roles.get(shot.name) == role] for role in ("train", "val", "test"))
    return train, val, test

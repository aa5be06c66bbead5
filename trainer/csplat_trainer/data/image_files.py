r"""Find the image files that a data set names.

Poses are often computed on another machine, so names may differ in separators, suffixes, case and folders. A name is
matched by these rules in order, and every rule but the first is reported when it is used:

1. as written;
2. `\` as `/`, without a drive letter and surrounding spaces;
3. as a URL: without `file:`, `%20` as a space;
4. in another case or Unicode form;
5. with another image suffix, or with one if there is none (Blender's names), in any case;
6. without its leading folders, if rules 1 to 5 match no name at all;
7. in a folder below, if rule 6 matches none either.

Rules 4 to 7 also apply rules 2 and 3. A name that matches two files is an error, and so are two names that match one
file.
"""

from __future__ import annotations

import os
import re
import unicodedata
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath
from urllib.parse import unquote

from csplat.errors import InputError, counted
from csplat_trainer.data.image_pixels import image_size

IMAGE_ENDINGS = (".png", ".jpg", ".jpeg", ".jpe", ".jfif", ".webp", ".avif", ".tif", ".tiff", ".bmp", ".jp2")
_SHOWN = 5  # largest number of names in a message

_FOLDER_WORDS = ("without leading folders", "in folders below")  # rules 6 and 7

_Key = Callable[[str], str]


class NoImagesError(InputError):
    """None of the images that a set names exists."""


@dataclass(frozen=True, eq=False)
class FoundImages:
    """Image files of a data set.

    Attributes:
        folder: the folder that names are relative to.
        files: existing files, by the name in the set.
        notes: a line for each rule that was used.
    """

    folder: Path
    files: dict[str, Path]
    notes: list[str] = field(default_factory=list)


def normalise_name(name: str) -> str:
    """Return a path with `/` between its parts, without `.`, empty parts, surrounding spaces and a drive letter."""
    return PurePosixPath(re.sub(r"^[A-Za-z]:(?=[\\/])", "", name.strip()).replace("\\", "/")).as_posix()


def describe_missing(missing: Sequence[str], count: int, where: str) -> list[str]:
    """Return a line on missing images, or none if all exist."""
    if not missing:
        return []
    return [f"{where}: {len(missing)} of {counted(count, 'image')} are missing and dropped: {abbreviate(missing)}"]


def find_images(
    root: Path, names: Sequence[str], where: str, folders: Sequence[str], size: tuple[int, int] | None = None
) -> FoundImages:
    """Find the images that a set names, in the first of some folders that has any of them.

    Args:
        root: the folder of the set.
        names: names in the set, at least one.
        where: the file that names them, for messages.
        folders: folders to try in this order, relative to `root`. `.` is `root` itself; it comes last when leading
            folders of names are ignored. Each includes folders of smaller images next to it: `images` includes
            `images_2`, `images_4`, …
        size: requested width and height, for which the smallest sufficient of such folders is used; `None`: the first.

    Raises:
        NoImagesError: none of the images exists.
        InputError: as for `match_names`.
    """
    groups = {folder: _size_folders(root, folder) for folder in dict.fromkeys(folders)}
    for loose in (False, True):
        for folder in sorted(groups, key=lambda one: loose and one == "."):
            found = [one for path in groups[folder] if (one := _find_in(path, names, where, loose=loose)).files]
            if found:
                large = [one for one in found[1:] if size is not None and _is_large(one, size)]
                return large[-1] if large else found[0]
    tried = ", ".join(f"{root}/{folder}" if folder != "." else f"{root} itself" for folder in groups)
    others = next((name for paths in groups.values() for path in paths for name in _images_below(path)), None)
    hint = f"; there are other images, such as {others}" if others else ""
    raise NoImagesError(
        f"{where}: none of its {len(names)} images exists ({abbreviate(names[:1])}, …): searched {tried}{hint}"
    )


def find_masks(root: Path, names: Sequence[str]) -> FoundImages | None:
    """Find the masks of images in a folder `masks` or `mask`: `1.png`, `1.jpg.png`, `1_mask.png` or `mask_1.png`.

    Args:
        root: the folder of the set.
        names: names of the images in the set.

    Returns:
        The masks by names of images; `None` if there is no such folder.

    Raises:
        InputError: as for `match_names`.
    """
    folder = next((folder for name in ("masks", "mask") for folder in _size_folders(root, name)[:1]), None)
    if folder is None:
        return None
    known, where = list(_images_below(folder)), f"{folder.name}/"
    longer = {f"{name}.png": name for name in names}
    files = {longer[name]: folder / name for name in known if name in longer}
    left = [name for name in names if name not in files]
    matched, notes = match_names(left, known, where)
    if not matched:
        shorter = {_without_affix(name): name for name in known}
        matched, notes = match_names(left, shorter, where)
        matched = {name: shorter[to] for name, to in matched.items()}
    return FoundImages(folder, files | {name: folder / to for name, to in matched.items()}, notes)


def describe_masks_among(images: Sequence[Path]) -> list[str]:
    """Return a line on masks next to the images, or none if there are none."""
    stems = {path.stem for path in images}
    for name in _images_below(images[0].parent) if images else ():
        stem, path = PurePosixPath(_without_affix(name)).stem, PurePosixPath(name)
        if stem in stems and (stem != path.stem or path.parent.name.casefold() in ("mask", "masks")):
            return [f"masks next to the images, such as {name}, are ignored: put them into a folder masks"]
    return []


def _without_affix(name: str) -> str:
    path = PurePosixPath(name)
    stem = re.sub(r"^mask[_.-]|[_.-]mask$", "", path.stem, flags=re.IGNORECASE)
    return path.with_name(stem + path.suffix).as_posix() if stem else name


def match_names(
    names: Iterable[str], known: Iterable[str], where: str, *, folders: bool = True
) -> tuple[dict[str, str], list[str]]:
    """Match listed names with existing ones, by the rules of this module.

    Args:
        names: listed names.
        known: existing names, with `/`.
        where: the file that lists them, for messages.
        folders: use rules 6 and 7.

    Returns:
        Existing names by listed ones, without missing ones; and a line for each rule that was used.

    Raises:
        InputError: a name matches two existing ones, or two names match one.
    """
    left, free = dict.fromkeys(names), dict.fromkeys(known)
    matched: dict[str, str] = {}
    notes: list[str] = []
    for words, rules in _rules(left, folders=folders):
        if not left or (matched and words in _FOLDER_WORDS):
            break
        loose: dict[str, str] = {}
        for listed_key, known_key in rules:
            found = _match(left, free, listed_key, known_key, where)
            for name, to in found.items():
                del left[name], free[to]
            matched |= found
            loose |= {name: to for name, to in found.items() if words and not _only_lacks_ending(name, to)}
        if loose:
            name, to = next(iter(loose.items()))
            more = ", …" if len(loose) > 1 else ""
            notes.append(f"{counted(len(loose), 'name')} of {where} found {words}: {name} is {to}{more}")
    return matched, notes


def _rules(names: Iterable[str], *, folders: bool) -> Iterator[tuple[str, list[tuple[_Key, _Key]]]]:
    """Yield the rules in order: a description, and functions that map matching listed and known names to equal keys."""

    def decode(name: str) -> str:
        return normalise_name(unquote(re.sub(r"^file:(//)?(?=/)", "", name)))

    def fold(name: str) -> str:
        return unicodedata.normalize("NFC", decode(name)).casefold()

    def strip_ending(name: str) -> str:
        path = PurePosixPath(decode(name))
        return str(path.with_suffix("") if path.suffix.lower() in IMAGE_ENDINGS else path)

    def parts(name: str) -> list[str]:
        return decode(name).strip("/").split("/")

    def in_any_case(listed: _Key, known: _Key) -> list[tuple[_Key, _Key]]:
        """Compare names in any case; then with any ending, too."""
        return [
            (lambda name: fold(listed(name)), lambda name: fold(known(name))),
            (lambda name: fold(strip_ending(listed(name))), lambda name: fold(strip_ending(known(name)))),
        ]

    def without_first(count: int) -> _Key:
        return lambda name: "/".join(parts(name)[count:])

    def last(count: int) -> _Key:
        return lambda name: "/".join(parts(name)[-count:])

    yield "", [(_as_written, _as_written)]
    yield "with / for \\, without surrounding spaces", [(normalise_name, normalise_name)]
    yield "as a URL", [(decode, normalise_name)]
    yield "in another case", [(fold, fold)]
    yield "with another ending", [(strip_ending, strip_ending), (lambda name: fold(strip_ending(name)),) * 2]
    if not folders:
        return
    depths = {len(parts(name)) for name in names}
    for count in range(1, max(depths, default=0)):
        yield _FOLDER_WORDS[0], in_any_case(without_first(count), normalise_name)
    for count in sorted(depths):
        yield _FOLDER_WORDS[1], in_any_case(normalise_name, last(count))


def _as_written(name: str) -> str:
    return PurePosixPath(name).as_posix()


def _match(
    names: Iterable[str],
    known: Iterable[str],
    listed_key: _Key,
    known_key: _Key,
    where: str,
) -> dict[str, str]:
    index: dict[str, list[str]] = {}
    for name in known:
        index.setdefault(known_key(name), []).append(name)
    found: dict[str, str] = {}
    taken: dict[str, str] = {}
    for name in names:
        fitting = index.get(listed_key(name), [])
        if len(fitting) > 1:
            raise InputError(f"{where}: {name} matches {len(fitting)} files: {abbreviate(sorted(fitting))}")
        if fitting:
            other = taken.setdefault(fitting[0], name)
            if other != name:
                raise InputError(f"{where}: {other} and {name} both match {fitting[0]}")
            found[name] = fitting[0]
    return found


def _only_lacks_ending(name: str, known: str) -> bool:
    return known.startswith(_as_written(name) + ".")


def abbreviate(names: Sequence[str]) -> str:
    """Return the first few names, for a message."""
    return ", ".join(names[:_SHOWN]) + (", …" if len(names) > _SHOWN else "")


def _size_folders(root: Path, folder: str) -> list[Path]:
    """Find a folder, in any case, and those of smaller images next to it, the largest images first."""
    path = root / folder
    if folder == "." or not path.parent.is_dir():
        return [path] if path.is_dir() else []
    names = sorted(one.name for one in path.parent.iterdir() if one.is_dir())
    for flags in (0, re.IGNORECASE):
        matches = [
            match for name in names if (match := re.fullmatch(f"{re.escape(path.name)}(?:_([0-9]+))?", name, flags))
        ]
        if matches:
            return [path.parent / match[0] for match in sorted(matches, key=lambda match: int(match[1] or 1))]
    return []


def _find_in(folder: Path, names: Sequence[str], where: str, *, loose: bool) -> FoundImages:
    files = {name: path for name in names if (path := folder / name).is_file()}
    left = [name for name in names if name not in files]
    if not left or (loose and files):
        return FoundImages(folder, files)
    taken = set(files.values())
    known = [name for name in _images_below(folder) if folder / name not in taken]
    matched, notes = match_names(left, known, where, folders=loose)
    return FoundImages(folder, files | {name: folder / to for name, to in matched.items()}, notes)


def _is_large(found: FoundImages, size: tuple[int, int]) -> bool:
    width, height = image_size(next(iter(found.files.values())))
    return width >= size[0] and height >= size[1]


def _images_below(folder: Path) -> Iterator[str]:
    """Yield the sorted relative paths of images below a folder, without hidden ones and those of macOS' archives."""
    for place, folders, files in os.walk(folder):
        folders[:] = sorted(name for name in folders if not name.startswith((".", "__MACOSX")))
        for name in sorted(files):
            is_image = name.lower().endswith(IMAGE_ENDINGS) and not name.startswith(".")
            if is_image and Path(place, name).exists():  # not a dangling link
                yield Path(place, name).relative_to(folder).as_posix()

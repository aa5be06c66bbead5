# SPDX-License-Identifier: Apache-2.0
r"""Find the image files that a data set names.

Poses are often computed on another machine, so names may differ in separators, suffixes, case and folders. A name is
matched by these rules in order, and every rule but the first is reported when it is used:

1. as written;
2. `\` as `/`, without a drive letter and surrounding spaces;
3. as a URL: without `file:`, `%20` as a space;
4. in another Unicode form, or in another case;
5. with another image suffix, or with a suffix if the name has none (Blender's names), in any case;
6. without its leading folders, if rules 1 to 5 match no name at all;
7. in a folder below, if rule 6 matches none either;
8. under another code page, by all the rules above: bytes that are not UTF-8, or letters that result from reading a name
   in a wrong code page; if one code page explains most of the names that are left.

Rules 4 to 7 also apply rules 2 and 3. A name that matches two files is an error. Two names that match one file are an
error, too. Names that lead out of the folder of the set are matched by rules 6 and 7 alone, unless the set is trusted
(`SetFolder`).
"""

from __future__ import annotations

import os
import re
import unicodedata
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path, PurePosixPath
from urllib.parse import unquote

from csplat.errors import InputError, counted
from csplat_trainer.data.image_pixels import image_size
from csplat_trainer.data.set_folder import SetFolder

#: Suffixes of images; files with the last suffixes are matched, and refused by name.
IMAGE_ENDINGS = (
    *(".png", ".jpg", ".jpeg", ".jpe", ".jfif", ".webp", ".tif", ".tiff", ".bmp"),
    *(".avif", ".heic", ".heif", ".jp2", ".jxl", ".gif", ".exr"),
)
_NAMES_SHOWN = 5  # largest number of names in a message
_NAME_LENGTH_MAX = 200  # largest number of characters of a name in a message

_FOLDER_WORDS = ("without leading folders", "in folders below")  # rules 6 and 7
_MASK_FOLDERS = ("masks", "mask", "_masks", "_mask")
_MASK_AFFIX = re.compile(r"^masks?[_.-]|[_. -]masks?$", re.IGNORECASE)

#: Code pages of file names, by Python's names: Chinese, Japanese, Korean, European, Cyrillic, and code pages of zips.
_CODE_PAGES = {
    "gb18030": "GBK", "cp932": "Shift-JIS", "cp950": "Big5", "cp949": "EUC-KR", "euc_jp": "EUC-JP",
    "cp1252": "Windows-1252", "cp1250": "Windows-1250", "cp1251": "Windows-1251", "cp437": "CP437", "cp850": "CP850",
    "utf-8": "UTF-8",
}  # fmt: skip
_MISREAD_AS = ("cp437", "cp850", "cp1252", "gb18030", "cp932", "cp950", "cp949")  # by programs that unpack archives
_EXPLAINED_MIN = 0.5  # fraction of the names that a code page has to explain, at least

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
    place: SetFolder, names: Sequence[str], where: str, folders: Sequence[str], size: tuple[int, int] | None = None
) -> FoundImages:
    """Find the images that a set names, in the first of some folders that has any of them.

    Args:
        place: the folder of the set.
        names: names in the set, at least one.
        where: the file that names them, for messages.
        folders: folders to try in this order, relative to the folder of the set. `.` is the folder of the set itself.
            It comes last when leading folders of names are ignored. Each includes folders of smaller images next to it:
            `images` includes `images_2`, `images_4`, …
        size: requested width and height, for which the smallest sufficient of such folders is used; `None`: the first.

    Raises:
        NoImagesError: none of the images exists.
        InputError: as for `match_names`; or an image exists, but outside of the folder.
    """
    root = place.path
    groups = {folder: _size_folders(place, folder) for folder in dict.fromkeys(folders)}
    for loose in (False, True):
        for folder in sorted(groups, key=lambda name: loose and name == "."):  # the set's own folder last
            matches = [
                match
                for path in groups[folder]
                if (match := _find_in_folder(place, path, names, where, loose=loose)).files
            ]
            if matches:
                large = [match for match in matches[1:] if size is not None and _is_large(match, size)]
                chosen = large[-1] if large else matches[0]
                _refuse_outside(place, [chosen.folder], [name for name in names if name not in chosen.files], where)
                return chosen
    _refuse_outside(place, [path for paths in groups.values() for path in paths], names, where)
    tried = ", ".join(f"{root}/{folder}" if folder != "." else f"{root} itself" for folder in groups)
    others = next((name for paths in groups.values() for path in paths for name in _images_below(path)), None)
    hint = f"; there are other images, such as {printable(others)}" if others else ""
    if any(name != printable(name) for name in names):
        hint += f"; names are not UTF-8, and match no file under {', '.join(_CODE_PAGES.values())}"
    raise NoImagesError(
        f"{where}: none of its {len(names)} images exists ({abbreviate(names[:1])}, …): searched {tried}{hint}"
    )


def _refuse_outside(place: SetFolder, folders: Sequence[Path], names: Iterable[str], where: str) -> None:
    """Raise an `InputError` for the first name that leads to a file outside of the set; `where` names the list."""
    for name in names:
        path = next((folder / name for folder in folders if place.finds_outside(folder / name)), None)
        if path is not None:
            raise place.refusal(Path(printable(name)), where)


def find_masks(place: SetFolder, images: Mapping[str, Path]) -> FoundImages | None:
    """Find the masks of images in a folder `masks` or `mask`, or RealityScan's masks next to the images.

    In a folder, the masks of `1.jpg` are called `1.png`, `1.jpg.png`, `1_mask.png`, `mask_1.png` or `1.jpg.mask.png`.
    Next to the images, `1.jpg.mask.png` is accepted, which cannot be an image.

    Args:
        place: the folder of the set.
        images: images by their names in the set.

    Returns:
        The masks by names of images; `None` if there are none.

    Raises:
        InputError: as for `match_names`; or a mask is a link that leads out of the folder.
    """
    folder = next((folder for name in _MASK_FOLDERS for folder in _size_folders(place, name)[:1]), None)
    if folder is None:
        return _masks_next_to(place, images)
    known, where = list(_images_below(folder)), f"{folder.name}/"
    image_of_mask = {f"{name}.png": name for name in images}
    files = {image_of_mask[name]: folder / name for name in known if name in image_of_mask}
    unmatched = [name for name in images if name not in files]
    matched, notes = match_names(unmatched, known, where)
    if not matched:
        masks_without_affix = {_without_affix(name): name for name in known}
        matched, notes = match_names(unmatched, masks_without_affix, where)
        matched = {name: masks_without_affix[to] for name, to in matched.items()}
    files |= {name: folder / to for name, to in matched.items()}
    return FoundImages(folder, {name: place.checked(path) for name, path in files.items()}, notes)


def _masks_next_to(place: SetFolder, images: Mapping[str, Path]) -> FoundImages | None:
    """Find masks that are named like an image, followed by `.mask` and a suffix, in any case; `None` if none exists."""
    folders = {path.parent: {file.name.casefold(): file for file in path.parent.iterdir()} for path in images.values()}
    files = {}
    for name, path in images.items():
        masks = (folders[path.parent].get(f"{path.name}.mask{ending}".casefold()) for ending in IMAGE_ENDINGS)
        mask = next((mask for mask in masks if mask is not None), None)
        if mask is not None:
            files[name] = place.checked(mask)
    if not files:
        return None
    first = next(iter(files.values()))
    return FoundImages(first.parent, files, [f"masks next to the images, such as {first.name}"])


def describe_masks_among(images: Sequence[Path]) -> list[str]:
    """Return a line on masks next to the images, or none if there are none."""
    stems = {path.stem for path in images}
    for name in _images_below(images[0].parent) if images else ():
        stem, path = PurePosixPath(_without_affix(name)).stem, PurePosixPath(name)
        if stem in stems and (stem != path.stem or path.parent.name.casefold() in ("mask", "masks")):
            return [f"masks next to the images, such as {name}, are ignored: put them into a folder masks"]
    return []


def _without_affix(name: str) -> str:
    """Return the name of a mask without its affix: `1.png` for `1_mask.png`, and `1.jpg` for `1.jpg.mask.png`."""
    path = PurePosixPath(name)
    stem = _MASK_AFFIX.sub("", path.stem)
    if not stem:
        return name
    whole = PurePosixPath(stem).suffix.lower() in IMAGE_ENDINGS
    return path.with_name(stem if whole else stem + path.suffix).as_posix()


def match_names(
    names: Iterable[str], known: Iterable[str], where: str, *, folders: bool = True
) -> tuple[dict[str, str], list[str]]:
    """Match listed names with existing names, by the rules of this module.

    Args:
        names: listed names.
        known: existing names, with `/`.
        where: the file that lists them, for messages.
        folders: use rules 6 and 7.

    Returns:
        Existing names by listed names, without missing names; and a line for each rule that was used.

    Raises:
        InputError: a name matches two existing names, two names match the same name, or code pages contradict each
            other.
    """
    listed, existing = dict.fromkeys(names), dict.fromkeys(known)  # without repetitions
    matched, notes = _match_by_rules(listed, existing, where, folders=folders)
    unmatched = [name for name in listed if name not in matched]
    taken = set(matched.values())
    unused = [name for name in existing if name not in taken]
    translated, code_page_notes = _match_code_pages(unmatched, unused, where, folders=folders)
    return matched | translated, notes + code_page_notes


def _match_by_rules(
    names: Iterable[str], known: Iterable[str], where: str, *, folders: bool
) -> tuple[dict[str, str], list[str]]:
    """Match names by rules 1 to 7; arguments and result are as in `match_names`."""
    unmatched, unused = dict.fromkeys(names), dict.fromkeys(known)
    matched: dict[str, str] = {}
    notes: list[str] = []
    for words, keys in _matching_rules(unmatched, folders=folders):
        if not unmatched or (matched and words in _FOLDER_WORDS):
            break
        noted: dict[str, str] = {}  # pairs of this rule that the report mentions
        for listed_key, known_key in keys:
            pairs = _match_by_keys(unmatched, unused, listed_key, known_key, where)
            for name, to in pairs.items():
                del unmatched[name], unused[to]
            matched |= pairs
            noted |= {name: to for name, to in pairs.items() if words and not _only_lacks_ending(name, to)}
        if noted:
            name, to = next(iter(noted.items()))
            more = ", …" if len(noted) > 1 else ""
            text = f"{counted(len(noted), 'name')} of {where} found {words}: {printable(name)} is {printable(to)}{more}"
            notes.append(text)
    return matched, notes


def _match_code_pages(
    names: Iterable[str], known: Sequence[str], where: str, *, folders: bool
) -> tuple[dict[str, str], list[str]]:
    """Match names by rule 8; arguments and result are as in `match_names`.

    A code page translates either the listed or the existing names. A translation under which names contradict each
    other is skipped; of the others, the one that matches most names is used.

    Raises:
        InputError: two translations match the same number of names, but different files.
    """
    listed = [name for name in names if not name.isascii()]
    existing = [name for name in known if not name.isascii()]
    best: dict[str, tuple[dict[str, str], str]] = {}  # by the mapping, which several code pages may give
    least_count = max(1.0, _EXPLAINED_MIN * len(listed))
    known_stems, listed_stems = {_stem(name) for name in known}, {_stem(name) for name in listed}
    for translate, title in _translations() if listed else ():
        for translates_listed in (True, False):
            names_to_read, stems = (listed, known_stems) if translates_listed else (existing, listed_stems)
            originals = {read: name for name in names_to_read if (read := translate(name)) is not None and read != name}
            if sum(_stem(name) in stems for name in originals) < least_count:  # saves the time of most code pages
                continue
            ours = originals if translates_listed else {name: name for name in listed}
            theirs = {name: name for name in known} if translates_listed else originals
            try:
                pairs, _ = _match_by_rules(ours, theirs, where, folders=folders)
            except InputError:
                continue
            if len(pairs) < least_count:
                continue
            if len(pairs) > least_count:
                best.clear()
            least_count = float(len(pairs))
            pairs = {ours[name]: theirs[to] for name, to in pairs.items()}
            best.setdefault(repr(sorted(pairs.items())), (pairs, title))
    if not best:
        return {}, []
    if len(best) > 1:
        titles = " and ".join(title for _, title in list(best.values())[:2])
        raise InputError(f"{where}: names match different files in {titles}: rename the files, or write UTF-8")
    ((pairs, title),) = best.values()
    name, to = next(iter(pairs.items()))
    text = f"{counted(len(pairs), 'name')} of {where} found in the code page {title}: {printable(name)} is"
    return pairs, [f"{text} {printable(to)}" + (", …" if len(pairs) > 1 else "")]


def _stem(name: str) -> str:
    """Return the part of a name that all rules leave unchanged."""
    stem = PurePosixPath(name.replace("\\", "/")).name.partition(".")[0]
    return unicodedata.normalize("NFC", stem).casefold().strip()


def _translations() -> Iterator[tuple[Callable[[str], str | None], str]]:
    """Yield functions that read a name in another code page, or return `None`; and the titles of the code pages."""

    def read(name: str, wrong: str, right: str) -> str | None:
        try:
            data = name.encode(wrong, "surrogateescape" if wrong == "utf-8" else "strict")
            return data.decode(right)
        except UnicodeError:
            return None

    for wrong in ("utf-8", *_MISREAD_AS):
        for right, title in _CODE_PAGES.items():
            if wrong != right:
                yield partial(read, wrong=wrong, right=right), title


def printable(name: str) -> str:
    """Return a name with bytes that are not UTF-8 (lone surrogates) as escapes."""
    try:
        return name.encode("utf-8", "surrogateescape").decode("utf-8", "backslashreplace")
    except UnicodeEncodeError:  # surrogates that are no bytes, from JSON
        return name.encode("utf-8", "backslashreplace").decode("utf-8")


def _matching_rules(names: Iterable[str], *, folders: bool) -> Iterator[tuple[str, list[tuple[_Key, _Key]]]]:
    """Yield the rules 1 to 7 in order.

    Args:
        names: the listed names. Their depths are read when rule 6 is requested, so the caller may remove names that
            earlier rules matched.
        folders: yield rules 6 and 7, too, once for each number of folders.

    Yields:
        A description for the report, "" for rule 1; and pairs of functions, to be tried in this order: a listed and a
        known name match if the first gives the same key for the listed name as the second for the known name.
    """

    def decode(name: str) -> str:
        return normalise_name(unquote(re.sub(r"^file:(//)?(?=/)", "", name)))

    def compose(name: str) -> str:
        return unicodedata.normalize("NFC", decode(name))

    def fold(name: str) -> str:
        return compose(name).casefold()

    def strip_ending(name: str) -> str:
        path = PurePosixPath(decode(name))
        return str(path.with_suffix("") if path.suffix.lower() in IMAGE_ENDINGS else path)

    def strip_and_fold(name: str) -> str:
        return fold(strip_ending(name))

    def split_parts(name: str) -> list[str]:
        return decode(name).strip("/").split("/")

    def in_any_case(listed: _Key, known: _Key) -> list[tuple[_Key, _Key]]:
        """Compare names in any case; then with any ending, too."""
        return [
            (lambda name: fold(listed(name)), lambda name: fold(known(name))),
            (lambda name: strip_and_fold(listed(name)), lambda name: strip_and_fold(known(name))),
        ]

    def without_first(count: int) -> _Key:
        return lambda name: "/".join(split_parts(name)[count:])

    def only_last(count: int) -> _Key:
        return lambda name: "/".join(split_parts(name)[-count:])

    yield "", [(_as_written, _as_written)]
    yield "with / for \\, without surrounding spaces", [(normalise_name, normalise_name)]
    yield "as a URL", [(decode, normalise_name)]
    yield "in another Unicode form", [(compose, compose)]
    yield "in another case", [(fold, fold)]
    yield "with another ending", [(strip_ending, strip_ending), (strip_and_fold, strip_and_fold)]
    if not folders:
        return
    depths = {len(split_parts(name)) for name in names}
    for count in range(1, max(depths, default=0)):
        yield _FOLDER_WORDS[0], in_any_case(without_first(count), normalise_name)
    for count in sorted(depths):
        yield _FOLDER_WORDS[1], in_any_case(normalise_name, only_last(count))


def _as_written(name: str) -> str:
    """Return the key of rule 1: the name without `.` and empty parts."""
    return PurePosixPath(name).as_posix()


def _match_by_keys(
    names: Iterable[str],
    known: Iterable[str],
    listed_key: _Key,
    known_key: _Key,
    where: str,
) -> dict[str, str]:
    """Return the known name of each listed name with an equal key; names without a match are omitted.

    Raises:
        InputError: a name matches two known names, or two names match the same known name.
    """
    known_by_key: dict[str, list[str]] = {}
    for name in known:
        known_by_key.setdefault(known_key(name), []).append(name)
    matches: dict[str, str] = {}
    taken: dict[str, str] = {}  # listed names by known names
    for name in names:
        fitting = known_by_key.get(listed_key(name), [])
        if len(fitting) > 1:
            raise InputError(f"{where}: {name} matches {len(fitting)} files: {abbreviate(sorted(fitting))}")
        if fitting:
            earlier = taken.setdefault(fitting[0], name)
            if earlier != name:
                raise InputError(f"{where}: {earlier} and {name} both match {fitting[0]}")
            matches[name] = fitting[0]
    return matches


def _only_lacks_ending(name: str, known: str) -> bool:
    """Return True if a known name is the listed name with a suffix, which Blender omits: no reason for a report."""
    return known.startswith(_as_written(name) + ".")


def abbreviate(names: Sequence[str]) -> str:
    """Return the first few names, for a message."""
    more = ", …" if len(names) > _NAMES_SHOWN else ""
    return ", ".join(printable(name)[:_NAME_LENGTH_MAX] for name in names[:_NAMES_SHOWN]) + more


def _size_folders(place: SetFolder, folder: str) -> list[Path]:
    """Find a folder, in any case, and folders of smaller images next to it, the largest images first.

    For `images`, these are `images_2`, `images_4`, …; none if the folder does not exist, or is outside of the set.
    """
    path = place.path / folder
    if not place.holds(path):
        return []
    if folder == "." or not path.parent.is_dir():
        return [path] if path.is_dir() else []
    names = sorted(sibling.name for sibling in path.parent.iterdir() if sibling.is_dir())
    for flags in (re.NOFLAG, re.IGNORECASE):
        matches = [
            match for name in names if (match := re.fullmatch(f"{re.escape(path.name)}(?:_([0-9]+))?", name, flags))
        ]
        if matches:
            return [path.parent / match[0] for match in sorted(matches, key=lambda match: int(match[1] or 1))]
    return []


def _find_in_folder(place: SetFolder, folder: Path, names: Sequence[str], where: str, *, loose: bool) -> FoundImages:
    """Find images in a folder; `loose` allows rules 6 and 7, which are not used if any name exists as written.

    Raises:
        InputError: as for `match_names`; or an image is a link that leads out of the set.
    """
    files = {name: path for name in names if place.finds(path := folder / name)}
    unmatched = [name for name in names if name not in files]
    notes: list[str] = []
    if unmatched and not (loose and files):
        taken = set(files.values())
        known = [name for name in _images_below(folder) if folder / name not in taken]
        matched, notes = match_names(unmatched, known, where, folders=loose)
        files |= {name: folder / to for name, to in matched.items()}
    return FoundImages(folder, {name: place.checked(path, where) for name, path in files.items()}, notes)


def _is_large(images: FoundImages, size: tuple[int, int]) -> bool:
    """Return True if the first image has at least the requested width and height."""
    width, height = image_size(next(iter(images.files.values())))
    return width >= size[0] and height >= size[1]


def _images_below(folder: Path) -> Iterator[str]:
    """Yield the sorted relative paths of images below a folder, without hidden files and files of macOS' archives."""
    for place, folders, files in os.walk(folder):
        folders[:] = sorted(name for name in folders if not name.startswith((".", "__MACOSX")))
        for name in sorted(files):
            is_image = name.lower().endswith(IMAGE_ENDINGS) and not name.startswith(".")
            if is_image and Path(place, name).is_file():  # neither a dangling link nor a pipe
                yield Path(place, name).relative_to(folder).as_posix()

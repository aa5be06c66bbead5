# SPDX-License-Identifier: Apache-2.0
"""Skip rows of PLY files, and the lists in rows, without keeping an object per row.

Properties are plyfile's objects, which have a `name` and a `val_dtype`. Lists also have a `len_dtype`.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from typing import Any, BinaryIO, Literal

import numpy as np

from csplat.lint import Finding
from csplat.ply.ply_header import RowError, truncated_finding

_SHOWN = 40  # maximum number of characters of a name in a message
_MAX_DIGITS = 18  # digits of the length of a list in text; longer ones exceed every file


def is_list(prop: Any) -> bool:
    """Return True if a property is a list."""
    return hasattr(prop, "len_dtype")


def row_type(properties: Sequence[Any], order: str = "=") -> np.dtype[Any]:
    """Return the type of a row without its lists, in this byte order."""
    return np.dtype([(prop.name, order + prop.val_dtype) for prop in properties if not is_list(prop)])


def skip_lists(
    data: memoryview, at: int, name: str, count: int, properties: Sequence[Any], order: str, copy: BinaryIO | None
) -> int:
    """Walk binary rows that have lists, because the length of a row is in its lists.

    Args:
        data: the file.
        at: offset of the first row.
        name: name of the element.
        count: number of rows.
        properties: properties of the element.
        order: byte order, `<` or `>`.
        copy: file that receives the rows without their lists; `None`: the rows are only skipped.

    Returns:
        Offset of the end of the last row.

    Raises:
        RowError: rows are missing, or the length of a list is not a count.
    """
    byteorder: Literal["little", "big"] = "big" if order == ">" else "little"
    end, gap = len(data), 0  # gap: bytes of single values before a list, or after the last list
    lists = []
    for prop in properties:
        if not is_list(prop):
            gap += np.dtype(prop.val_dtype).itemsize
            continue
        kind = np.dtype(prop.len_dtype)
        if kind.kind == "f":
            text = f"the list {prop.name[:_SHOWN]} of {name} has lengths of type {kind.name}, expected integers"
            raise RowError(Finding("malformed", 1, text, "error"))
        width = np.dtype(prop.val_dtype).itemsize
        lists.append((gap, kind.itemsize, kind == np.uint8, kind.kind == "i", width, prop.name))
        gap = 0
    for row in range(count):
        for before, size, is_byte, is_signed, width, listed in lists:
            start = at + before
            stop = start + size
            if stop > end:
                raise RowError(truncated_finding(name, count, row))
            if copy is not None:
                copy.write(data[at:start])
            if is_byte:
                length = data[start]
            else:
                length = int.from_bytes(data[start:stop], byteorder, signed=is_signed)
            if length < 0:
                text = f"row {row} of {name}: the list {listed[:_SHOWN]} has a length of {length}"
                raise RowError(Finding("malformed", 1, text, "error"))
            at = stop + length * width
        if at + gap > end:
            raise RowError(truncated_finding(name, count, row))
        if copy is not None:
            copy.write(data[at : at + gap])
        at += gap
    return at


def lines_without_lists(
    lines: Iterable[str], name: str, properties: Sequence[Any], numbers: Sequence[int] | None = None
) -> Iterator[str]:
    """Yield rows of text without their lists.

    Args:
        lines: a row each.
        name: name of the element.
        properties: properties of the element.
        numbers: the lines of the rows in the file, for messages.

    Raises:
        RowError: a row has another number of values than declared, or the length of a list is not a count.
    """
    are_lists = [is_list(prop) for prop in properties]
    for row, line in enumerate(lines):
        words = line.split()
        scalars, at = words, len(are_lists)  # at: index after the last declared value
        if any(are_lists):
            scalars, at = [], 0
            for listed in are_lists:
                word = words[at] if at < len(words) else ""
                at += 1
                if not listed:
                    scalars.append(word)
                elif word.isdecimal() and len(word) <= _MAX_DIGITS:
                    at += int(word)
                else:
                    at = -1  # not a count: matches no number of words
                    break
        if at != len(words):
            place = "" if numbers is None else f"line {numbers[row]}: "
            text = f"{place}row {row} of {name} has {len(words)} values, which its properties do not match"
            raise RowError(Finding("malformed", 1, text, "error"))
        yield " ".join(scalars)

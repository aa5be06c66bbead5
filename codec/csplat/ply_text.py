"""Rows of ASCII PLY files that are written in another way than a row a line, with a point in numbers.

Only files that plyfile cannot read come here. What can be meant in one way alone is written anew; else the number or
the row that is wrong is named.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from itertools import accumulate

from csplat.errors import counted
from csplat.lint import Finding
from csplat.ply_header import Element

Rows = list[list[str]]

_LINE_END = re.compile(r"\r\n|\r|\n")
_NAN = re.compile(r"(?<!\S)[+-]?(?:nan\([a-z]*\)|1\.#(?:ind|[qs]nan)0*)(?!\S)", re.IGNORECASE)
_INFINITY = re.compile(r"(?<!\S)([+-]?)1\.#inf0*(?!\S)", re.IGNORECASE)
_EXPONENT = re.compile(r"(?<!\S)([+-]?(?:\d+\.?\d*|\.\d+))d([+-]?\d+)(?!\S)", re.IGNORECASE)
#: By what they are for messages, numbers that other languages write, and how Python does.
_SPELLINGS = {
    "NaN as Microsoft's C writes it": (_NAN, "nan"),
    "infinity as Microsoft's C writes it": (_INFINITY, r"\1inf"),
    "an exponent as Fortran writes it": (_EXPONENT, r"\1e\2"),
}
_DECIMAL_COMMA = re.compile(r"(?<=\d),(?=\d)")
_NO_THOUSANDS = re.compile(r"\d,(?!\d{3}(?!\d))\d")  # not followed by three digits exactly


class _RowError(ValueError):
    """Rows that are none, for the reason that a finding names."""

    def __init__(self, finding: Finding) -> None:
        super().__init__(finding.text)
        self.finding = finding


def regular_rows(body: bytes, elements: Sequence[Element]) -> tuple[Rows | None, list[Finding]]:
    """Take the rows of all elements apart, however they are laid out.

    Args:
        body: the file behind its header.
        elements: what the header declares.

    Returns:
        The words of each row, `None` where there are fewer rows than declared or one has more or fewer values; and
        what was unusual.
    """
    text = body.decode("ascii", "replace")
    said = []
    for what, (pattern, written) in _SPELLINGS.items():
        text, count = pattern.subn(written, text)
        said += [f"{what} ({counted(count, 'number')})"] if count else []
    first: _RowError | None = None
    for separated, what in _separations(text):
        lines = [line.split() for line in _LINE_END.split(separated)]
        try:
            rows, laid_out, rest = _laid_out(lines, elements)
        except _RowError as error:
            first = first or error
            continue
        said += [what] * bool(what) + laid_out
        findings = [Finding("unusual-rows", len(said), f"the rows have {', '.join(said)}", "note")] if said else []
        size = len(" ".join(rest))
        if size:
            findings.append(Finding("trailing-bytes", size, f"{size} bytes after the last row: ignored", "repair"))
        return rows, findings
    assert first is not None, "there is one way at least"
    return None, [first.finding]


def _separations(text: str) -> list[tuple[str, str]]:
    """The text with nothing but spaces between numbers, in each way that its commas can be meant; and that way."""
    if "," not in text and ";" not in text:
        return [(text, "")]
    found = []
    if "." not in text and _NO_THOUSANDS.search(text):
        found.append((_DECIMAL_COMMA.sub(".", text.replace(";", " ")), "decimal commas"))
    return [*found, (re.sub("[,;]", " ", text), "commas or semicolons between numbers"), (text, "")]


def _laid_out(lines: Rows, elements: Sequence[Element]) -> tuple[Rows, list[str], list[str]]:
    """Give each row the values of one; what is unusual of the lines; and the words behind the last row.

    Rows may share lines, or go on in the next one, as long as each line or each row ends with one of the other: a value
    that is missing does not shift those behind it.
    """
    blank = next((at for at in range(len(lines) - 1, -1, -1) if lines[at]), -1) + 1 - sum(map(bool, lines))
    said = ["blank lines"] if blank else []
    lines = [line for line in lines if line]
    rows: Rows = []
    at = 0
    for element in elements:
        width = len(element.properties)
        if not width:
            raise _RowError(Finding("malformed", 1, f"the element {element.name} has no properties", "error"))
        if element.has_lists or all(len(line) == width for line in lines[at : at + element.count]):
            taken = lines[at : at + element.count]
            if len(taken) < element.count:
                raise _RowError(_truncated(element, len(taken)))
            rows += taken
            at += element.count
            continue
        ends = list(accumulate(map(len, lines[at:])))
        count = next((number for number, end in enumerate(ends, 1) if end >= width * element.count), len(ends))
        ends = ends[:count]
        wanted = set(range(width, width * element.count + 1, width))
        if not ends or ends[-1] != width * element.count or not (wanted <= set(ends) or set(ends) <= wanted):
            row, line = next((pair for pair in enumerate(lines[at:]) if len(pair[1]) != width), (0, []))
            text = f"row {row} of {element.name} has {len(line)} values, expected {width}"
            raise _RowError(Finding("malformed", 1, text, "error"))
        words = [word for line in lines[at : at + count] for word in line]
        rows += [words[first : first + width] for first in range(0, len(words), width)]
        said.append(f"{element.count} of {element.name} in {count} lines" if count > 1 else "all values in one line")
        at += count
    rest = [word for line in lines[at:] for word in line]
    if rest and len(rows) != at:
        text = f"there are {counted(len(rest), 'value')} behind rows that are not in lines of their own"
        raise _RowError(Finding("malformed", len(rest), text, "error"))
    return rows, said, rest


def _truncated(element: Element, present: int) -> Finding:
    text = f"{element.count} rows of {element.name} are declared, {present} are there: copy or download it again"
    return Finding("truncated", element.count - present, text, "error")

"""The header of a PLY file, whichever way a program spells it.

plyfile takes headers as the format describes them. What others write and what means the same is rewritten for it:
byte order marks, blank lines, keywords in capitals, spaces behind `end_header`.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from pathlib import Path

from csplat.detect import KINDS, by_content, head_of, is_ply, refusal
from csplat.errors import InputError, counted
from csplat.lint import Finding

#: The element that holds the splats.
ELEMENT = "vertex"

_END_OF_HEADER = re.compile(rb"[\r\n]end_header[ \t]*(\r\n|\n|\r)", re.IGNORECASE)
_MAX_SIZE = 1 << 20
_MARK = b"\xef\xbb\xbf"  # byte order mark of UTF-8
_WIDE_MARKS = (b"\xff\xfe", b"\xfe\xff")  # byte order marks of UTF-16
_LINE_END = re.compile(rb"\r\n|\r|\n")
_FREE_TEXT = (b"comment", b"obj_info")  # keywords that are followed by free text, spaces included


@dataclass
class Element:
    """An element as a header declares it.

    Attributes:
        name: name of the element.
        count: number of rows; 0 if the header has no number.
        properties: names of the properties.
        has_lists: one of the properties is a list.
    """

    name: str
    count: int
    properties: list[str] = field(default_factory=list)
    has_lists: bool = False


@dataclass(frozen=True)
class Header:
    """A header that plyfile can parse.

    Attributes:
        start: bytes of the file before it.
        text: the header up to and including the line `end_header`, with the same length as in the file; ASCII.
        is_text: the rows are numbers in ASCII.
        elements: elements that it declares.
    """

    start: int
    text: bytes
    is_text: bool
    elements: list[Element]

    @property
    def end(self) -> int:
        """Offset in the file where the rows begin."""
        return self.start + len(self.text)


def read_header(path: Path, findings: list[Finding], kind: str = "ply") -> Header:
    """Read the header of a PLY.

    Args:
        path: path of the file.
        findings: anything noticed is appended.
        kind: name of the kind of PLY that is wanted, of `csplat.detect.KINDS`.

    Raises:
        InputError: not a PLY of columns, or one without an end of its header.
        OSError: it cannot be read.
    """
    head = head_of(path)
    if head.startswith(_WIDE_MARKS) and is_ply(head[2:].replace(b"\0", b"")):
        raise InputError(f"{path.name} is a PLY in UTF-16, expected ASCII: save it as UTF-8")
    if by_content(path, head) not in (KINDS["ply"], KINDS[kind]):
        raise refusal(path, head, wanted=kind)
    with path.open("rb") as stream:
        start = len(_MARK) if head.startswith(_MARK) else 0
        stream.seek(start)
        data = stream.read(_MAX_SIZE)
    end = _END_OF_HEADER.search(data)
    if end is None:
        raise InputError(f"{path.name}: the PLY header has no line end_header")
    raw = data[: end.end()]
    if raw[3:5] not in (b"\r\n", b"\r") and raw[3:4] == b"\r" and raw.endswith(b"\r\n"):
        raw = raw[:-1]  # lines end with CR: the LF is the first byte of a row
    text, oddities = _as_plyfile_takes_it(raw)
    if start:
        oddities.insert(0, "a byte order mark")
    if oddities:
        findings.append(Finding("unusual-header", len(oddities), f"the header has {', '.join(oddities)}", "note"))
    if not raw.isascii():
        count = sum(byte > 127 for byte in raw)
        said = f"{counted(count, 'byte')} of the header outside ASCII: read as question marks"
        findings.append(Finding("non-ascii-header", count, said, "note"))
    text = bytes(byte if byte < 128 else ord("?") for byte in text)
    lines = [line.split() for line in text.splitlines()]
    findings += _count_findings(lines, path.stat().st_size)
    return Header(start, text, any(words[:2] == [b"format", b"ascii"] for words in lines), _elements(lines))


def _as_plyfile_takes_it(raw: bytes) -> tuple[bytes, list[str]]:
    """Rewrite a header in the same number of bytes, and list what was unusual; return it unchanged if nothing was."""
    first_end = _LINE_END.search(raw)
    assert first_end is not None, "there is a line end_header"
    end = first_end[0]
    lines = raw.split(end)[:-1]
    spelled = [_spelled(line) for line in lines]
    if lines[-1] == b"end_header" and all(lines) and lines == spelled and (end == b"\n" or not _has_line_end(lines)):
        return raw, []
    lines = _LINE_END.split(raw)[:-1]
    spelled = [_spelled(line) for line in lines]
    changed = [old for old, new in zip(lines, spelled, strict=True) if old.split() != new.split()]
    words = dict.fromkeys(word for line in changed for word in line.split() if word != word.lower())
    blank = sum(not line.strip() for line in lines)
    kinds = {one[0] for one in _LINE_END.finditer(raw)}
    oddities = [f"{blank} blank lines" if blank > 1 else "a blank line"] if blank else []
    oddities += [f"capitals in {' '.join(word.decode('ascii', 'replace') for word in [*words][:3])}"] if words else []
    oddities += ["spaces next to end_header"] if lines[-1].lower() != b"end_header" else []
    oddities += ["line ends of two kinds"] if len(kinds) > 1 else []
    kept = [line for line in spelled if line.strip()]
    text = b"\n".join([*kept, b""])
    kept[1] += b" " * (len(raw) - len(text))  # plyfile finds the rows by their place in the file
    return b"\n".join([*kept, b""]), oddities


def _has_line_end(lines: list[bytes]) -> bool:
    return any(_LINE_END.search(line) for line in lines)


def _spelled(line: bytes) -> bytes:
    """Write a line of a header in small letters, but for names and free text; never longer than before."""
    words = line.split()
    keyword = words[0].lower() if words else b""
    if keyword in _FREE_TEXT:
        return keyword + line.lstrip()[len(keyword) :]
    if keyword in (b"ply", b"format", b"end_header"):
        spelled = [word.lower() for word in words]
    elif keyword == b"property":
        spelled = [*(word.lower() for word in words[:-1]), words[-1]]
    elif keyword == b"element":
        named = [word.lower() if word.lower() == ELEMENT.encode() else word for word in words[1:]]
        spelled = [keyword, *named]
    else:
        return line
    return line if words == spelled and keyword not in (b"ply", b"end_header") else b" ".join(spelled)


def _elements(lines: list[list[bytes]]) -> list[Element]:
    found: list[Element] = []
    for words in lines:
        if words[:1] == [b"element"] and len(words) == 3:
            found.append(Element(words[1].decode(), int(words[2]) if words[2].isdigit() else 0))
        elif words[:1] == [b"property"] and len(words) > 2 and found:
            found[-1].properties.append(words[-1].decode())
            found[-1].has_lists |= words[1] == b"list"
    return found


def _count_findings(lines: list[list[bytes]], size: int) -> list[Finding]:
    findings = []
    for words in lines:
        if words[:1] != [b"element"] or len(words) != 3:
            continue
        if words[2].startswith(b"-"):
            text = f"{words[2].decode('ascii', 'replace')} rows are declared"
            findings.append(Finding("malformed", 1, text, "error"))
        elif words[2].isdigit():
            count = int(words[2])
            if count > size:  # a row takes a byte at least: do not let anyone allocate for it
                text = f"{count} rows are declared, the file has {size} bytes"
                findings.append(Finding("truncated", count, text, "error"))
    return findings

"""The mutants of a source in C: its operators, constants, refusals and calls, one at a time."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final

from csplat_selftest.mutation.mutants import Mutant

_TOKEN: Final = re.compile(
    r"""
    (?P<nothing>/\*[ ]begin[ ]generated.*?/\*[ ]end[ ]generated[ ]\*/ | /\*.*?\*/ | ^\#(?:[^\n\\]|\\.)*)
    | (?P<string>"(?:[^"\\]|\\.)*" | '(?:[^'\\]|\\.)*')
    | (?P<number>0x[0-9a-f.]+(?:p[+-]\d+|p\d+)?[ul]* | \d[\d.]*(?:e[+-]?\d+)?[ul]*)
    | (?P<word>[a-z_]\w*)
    | (?P<operator><<= | >>= | -> | \+\+ | -- | && | \|\| | [<>=!+*/%&|^-]= | << | >> | [^\s])
    """,
    re.VERBOSE | re.DOTALL | re.MULTILINE | re.IGNORECASE,
)
#: Between spaces, as the layout of the source has them on both sides of what is not a sign or a pointer.
_BINARY: Final = {
    "<": ("<=", ">="),
    "<=": ("<", ">"),
    ">": (">=", "<="),
    ">=": (">", "<"),
    "==": ("!=",),
    "!=": ("==", "<", ">"),  # one side of a mismatch alone
    "&&": ("||",),
    "||": ("&&",),
    "+": ("-",),
    "-": ("+",),
    "*": ("/",),
    "/": ("*",),
    "%": ("*",),
    "<<": (">>",),
    ">>": ("<<",),
    "&": ("|",),
    "|": ("&",),
    "^": ("&",),
    "+=": ("-=",),
    "-=": ("+=",),
    "*=": ("/=",),
    "|=": ("&=",),
    "&=": ("|=",),
    "<<=": (">>=",),
    ">>=": ("<<=",),
}
_WORDS: Final = ("fail", "note", "refuse")  # calls whose arguments are for people
_KEPT: Final = ("if", "for", "while", "switch", "return", "sizeof", "release", *_WORDS)


@dataclass(frozen=True)
class _Token:
    kind: str
    text: str
    start: int
    end: int


def c_mutants(file: str, text: str) -> list[Mutant]:
    """Return every mutant of a source, in the order of the text. Some may be no program.

    Args:
        file: its name.
        text: the source; what generated parts, comments, strings and lines of the preprocessor hold stays.
    """
    found = [
        _Token(match.lastgroup or "", match[0], match.start(), match.end())
        for match in _TOKEN.finditer(text)
        if match.lastgroup != "nothing"
    ]
    changes = sorted(_changes(text, found), key=lambda change: change[0])
    return [Mutant(file, text.count("\n", 0, start) + 1, start, text[start:end], new) for start, end, new in changes]


def _changes(text: str, tokens: list[_Token]) -> Iterator[tuple[int, int, str]]:
    """Yield what changes: first character, last, and what comes in between."""
    at = 0
    while at < len(tokens):
        token, last = tokens[at], tokens[at - 1].text if at else ""
        end = _end_of_call(tokens, at)
        if end and token.text in _WORDS:
            if token.text == "fail":
                stays = last == "return" and tokens[end].text == ";"  # the code after it is no longer skipped
                yield (tokens[at - 1].start, tokens[end].end, ";") if stays else (token.start, tokens[end - 1].end, "1")
            at = end
            continue
        if end and last in (";", "{", "}", ")") and tokens[end].text == ";" and token.text not in _KEPT:
            yield token.start, tokens[end].end, ";"
        yield from _change(text, token)
        at += 1


def _change(text: str, token: _Token) -> Iterator[tuple[int, int, str]]:
    if token.kind == "number":
        yield token.start, token.end, f"({token.text} + 1)"
        yield token.start, token.end, f"({token.text} - 1)"
    elif token.text == "!":
        yield token.start, token.end, ""
    elif token.text in _BINARY and f"{text[token.start - 1]}{text[token.end]}".isspace():
        for new in _BINARY[token.text]:
            yield token.start, token.end, new


def _end_of_call(tokens: list[_Token], at: int) -> int:
    """Return the number of the token behind a word and its brackets, or 0 if none follow."""
    if tokens[at].kind != "word" or at + 1 == len(tokens) or tokens[at + 1].text != "(":
        return 0
    depth = 0
    for number in range(at + 1, len(tokens) - 1):
        depth += (tokens[number].text == "(") - (tokens[number].text == ")")
        if depth == 0:
            return number + 1
    return 0

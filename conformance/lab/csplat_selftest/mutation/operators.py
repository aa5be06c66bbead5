# SPDX-License-Identifier: CC0-1.0
"""Mutation operators: small changes of Python by syntax tree, and of C by tokens."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final

from csplat_selftest.mutation.mutants import Mutant

_COMPARISONS: Final = {
    ast.Lt: ("<", ("<=", ">=")),
    ast.LtE: ("<=", ("<", ">")),
    ast.Gt: (">", (">=", "<=")),
    ast.GtE: (">=", (">", "<")),
    ast.Eq: ("==", ("!=",)),
    ast.NotEq: ("!=", ("==", "<", ">")),  # only one direction of a mismatch
    ast.In: ("in", ("not in",)),
    ast.NotIn: (r"not\s+in", ("in",)),
    ast.Is: ("is", ("is not",)),
    ast.IsNot: (r"is\s+not", ("is",)),
}
_ARITHMETIC: Final = {
    ast.Add: ("+", "-"),
    ast.Sub: ("-", "+"),
    ast.Mult: ("*", "//"),
    ast.Div: ("/", "*"),
    ast.FloorDiv: ("//", "*"),
    ast.Mod: ("%", "*"),
    ast.LShift: ("<<", ">>"),
    ast.RShift: (">>", "<<"),
    ast.BitAnd: ("&", "|"),
    ast.BitOr: ("|", "&"),
    ast.BitXor: ("^", "&"),
}
_NAMES: Final = {"min": "max", "max": "min", "any": "all", "all": "any"}
#: Nodes whose text does not influence decoding.
_WORDS: Final = (ast.JoinedStr, ast.arg)


def python_mutants(file: str, text: str) -> list[Mutant]:
    """Return every mutant of a module, in the order of the text. Some may not compile.

    Args:
        file: file name.
        text: source text.
    """
    return list(_Module(file, text).mutants())


class _Module:
    def __init__(self, file: str, text: str) -> None:
        self.file = file
        self.text = text
        lines = text.splitlines(keepends=True)
        self.starts = [0]
        for line in lines:
            self.starts.append(self.starts[-1] + len(line))
        self.lines = lines

    def mutants(self) -> Iterator[Mutant]:
        yield from self.inside(ast.parse(self.text))

    def inside(self, node: ast.AST) -> Iterator[Mutant]:
        if isinstance(node, _WORDS) or _is_for_types(node):
            return
        yield from self.of(node)
        for name, value in ast.iter_fields(node):
            if name in ("annotation", "returns", "decorator_list") or isinstance(node, ast.Raise):
                continue  # a raise is only dropped as a whole
            for child in value if isinstance(value, list) else [value]:
                if isinstance(child, ast.AST):
                    yield from self.inside(child)

    def of(self, node: ast.AST) -> Iterator[Mutant]:
        """Yield the mutants of this node itself."""
        match node:
            case ast.Compare():
                operands = [node.left, *node.comparators]
                for i, operator in enumerate(node.ops):
                    old, news = _COMPARISONS[type(operator)]
                    for new in news:
                        yield self.operator(node, operands[i], operands[i + 1], old, new)
            case ast.BoolOp():
                old, new = ("and", "or") if isinstance(node.op, ast.And) else ("or", "and")
                for left, right in zip(node.values, node.values[1:], strict=False):
                    yield self.operator(node, left, right, old, new)
            case ast.BinOp() if type(node.op) in _ARITHMETIC:
                old, new = _ARITHMETIC[type(node.op)]
                yield self.operator(node, node.left, node.right, re.escape(old), new)
            case ast.AugAssign() if type(node.op) in _ARITHMETIC:
                old, new = _ARITHMETIC[type(node.op)]
                yield self.operator(node, node.target, node.value, re.escape(f"{old}="), f"{new}=", wrap=False)
            case ast.UnaryOp(op=ast.Not()):
                yield self.replaced(node, f"({self.source(node.operand)})")
            case ast.Constant(value=bool()):
                yield self.replaced(node, str(not node.value))
            case ast.Constant(value=int() | float()):
                yield self.replaced(node, f"({self.source(node)} + 1)")
                yield self.replaced(node, f"({self.source(node)} - 1)")
            case ast.Slice():
                for bound in (node.lower, node.upper):
                    if bound is not None and not isinstance(bound, ast.Constant):
                        yield self.replaced(bound, f"({self.source(bound)}) + 1")
                        yield self.replaced(bound, f"({self.source(bound)}) - 1")
            case ast.Call(func=ast.Name(id=name)) if name in _NAMES:
                yield self.replaced(node.func, _NAMES[name])
            case ast.Call(func=ast.Attribute(attr=name) as method) if name in _NAMES:
                yield self.replaced(method, f"{self.source(method.value)}.{_NAMES[name]}")
            case ast.Raise():
                yield self.replaced(node, "pass")
            case ast.Expr(value=ast.Call()):
                yield self.replaced(node, "pass")
            case ast.FunctionDef():
                # Without its last return, a function would return nothing, which any caller notices.
                last = node.body[-1]
                early = [one for one in ast.walk(node) if isinstance(one, ast.Return) and one is not last]
                yield from (self.replaced(one, "pass") for one in early)

    def operator(
        self, node: ast.AST, left: ast.AST, right: ast.AST, old: str, new: str, *, wrap: bool = True
    ) -> Mutant:
        """Replace the operator between two operands; brackets around the node preserve precedence."""
        (start, end), gap_start, gap_end = self.span(node), self.span(left)[1], self.span(right)[0]
        gap = re.sub(rf"(?<![\w]){old}(?![\w])", new, self.text[gap_start:gap_end], count=1)
        changed = self.text[start:gap_start] + gap + self.text[gap_end:end]
        return self.replaced(node, f"({changed})" if wrap else changed)

    def replaced(self, node: ast.AST, new: str) -> Mutant:
        start, end = self.span(node)
        return Mutant(self.file, node.lineno, start, self.text[start:end], new)  # type: ignore[attr-defined]  # has a position

    def source(self, node: ast.AST) -> str:
        start, end = self.span(node)
        return self.text[start:end]

    def span(self, node: ast.AST) -> tuple[int, int]:
        """Return the character range of a node; the tree counts bytes of lines in UTF-8."""
        ends = (node.lineno, node.col_offset), (node.end_lineno, node.end_col_offset)  # type: ignore[attr-defined]  # has a position
        start, end = (
            self.starts[line - 1] + len(self.lines[line - 1].encode()[:column].decode()) for line, column in ends
        )
        return start, end


def _is_for_types(node: ast.AST) -> bool:
    return isinstance(node, ast.If) and isinstance(node.test, ast.Name) and node.test.id == "TYPE_CHECKING"


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
#: Operators surrounded by spaces, which distinguishes them from signs and pointers in our formatting.
_BINARY: Final = {
    "<": ("<=", ">="),
    "<=": ("<", ">"),
    ">": (">=", "<="),
    ">=": (">", "<"),
    "==": ("!=",),
    "!=": ("==", "<", ">"),  # only one direction of a mismatch
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
_MESSAGE_CALLS: Final = ("fail", "note", "refuse")  # calls whose arguments are only messages
_KEPT: Final = ("if", "for", "while", "switch", "return", "sizeof", "release", *_MESSAGE_CALLS)


@dataclass(frozen=True)
class _Token:
    kind: str
    text: str
    start: int
    end: int


def c_mutants(file: str, text: str) -> list[Mutant]:
    """Return every mutant of a source file, in the order of the text. Some may not compile.

    Args:
        file: file name.
        text: source text. Generated parts, comments, strings and preprocessor lines do not change.
    """
    found = [
        _Token(match.lastgroup or "", match[0], match.start(), match.end())
        for match in _TOKEN.finditer(text)
        if match.lastgroup != "nothing"
    ]
    changes = sorted(_changes(text, found), key=lambda change: change[0])
    return [Mutant(file, text.count("\n", 0, start) + 1, start, text[start:end], new) for start, end, new in changes]


def _changes(text: str, tokens: list[_Token]) -> Iterator[tuple[int, int, str]]:
    """Yield changes: start, end and replacement."""
    at = 0
    while at < len(tokens):
        token, last = tokens[at], tokens[at - 1].text if at else ""
        end = _end_of_call(tokens, at)
        if end and token.text in _MESSAGE_CALLS:
            if token.text == "fail":
                stays = last == "return" and tokens[end].text == ";"  # then also execute the code after it
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
    """Return the index of the token after a word and its brackets, or 0 if there are no brackets."""
    if tokens[at].kind != "word" or at + 1 == len(tokens) or tokens[at + 1].text != "(":
        return 0
    depth = 0
    for number in range(at + 1, len(tokens) - 1):
        depth += (tokens[number].text == "(") - (tokens[number].text == ")")
        if depth == 0:
            return number + 1
    return 0

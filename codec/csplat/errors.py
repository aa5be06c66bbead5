# SPDX-License-Identifier: Apache-2.0
"""Define the exceptions, with a class per party at fault.

| class | fault | remedy |
|---|---|---|
| `FormatError` | the file breaks a clause of the format | another copy of the file |
| `UnsupportedError` | the file needs a feature that this decoder does not have | a newer decoder |
| `LimitError` | the file needs more than the caller allows | larger limits |
| `InputError` | the caller's data is invalid: a PLY, an array, an option | see the message |
| `StoreError` | a server or the connection failed | try again |

Every error has a `code`, a short constant string that programs may compare. `SearchInterrupted` is no error but an
interrupt, Ctrl-C, of a search for a target, and has the best result so far.
"""

from __future__ import annotations

from shlex import quote
from typing import Any


class CsplatError(Exception):
    """Base of every error that csplat raises on purpose.

    Attributes:
        code: short constant string for the kind of error, the same in all versions and languages (`E_CRC`).
        path: path of the file that was being read, as the caller named it; `None` if unknown.
    """

    code: str = "E_CSPLAT"
    path: str | None = None


class FormatError(CsplatError):
    """A file breaks a clause of the format.

    `str()` contains the code, the offset, the clause, the value found and the value expected:
    `E_VALUE at byte 72 (TIL-1): splat_count, found 0, expected 1 to 65536`.

    Args:
        code: error code of the registry, `E_...`.
        offset: offset of the invalid field in the file; `None` if no single field is at fault.
        clause: id of the broken clause, `TIL-1`.
        detail: name of the field, or a description of the fault.
        found: value in the file.
        wanted: value that the clause requires.
    """

    offset: int | None
    clause: str

    def __init__(
        self,
        code: str,
        offset: int | None,
        clause: str,
        detail: str = "",
        *,
        found: object = None,
        wanted: object = None,
    ) -> None:
        super().__init__(code, offset, clause, _join_detail(detail, found, wanted))
        self.code = code
        self.offset = offset
        self.clause = clause
        self.detail = _join_detail(detail, found, wanted)

    def __str__(self) -> str:
        return _format_error(self.code, self.offset, self.clause, self.detail)


class UnsupportedError(CsplatError):
    """A file needs a feature that this decoder does not have.

    Args:
        feature: name of the feature that the file requires, `version 0.7`.
        code: error code of the registry.
        offset: offset of the field in the file, if known.
        clause: id of the clause, if any.
    """

    feature: str
    offset: int | None
    clause: str

    def __init__(self, feature: str, code: str = "E_UNSUPPORTED", offset: int | None = None, clause: str = "") -> None:
        super().__init__(feature, code, offset, clause)
        self.code = code
        self.feature = feature
        self.offset = offset
        self.clause = clause

    def __str__(self) -> str:
        return _format_error(self.code, self.offset, self.clause, f"{self.feature} is not supported")


class LimitError(CsplatError):
    """A file needs more than the caller's limits allow. Nothing was allocated.

    Args:
        limit: name of the limit, `max_splats`.
        wanted: amount that the file needs.
        allowed: amount that the caller allows.
        code: error code of the registry.
        offset: offset of the field in the file, if known.
        clause: id of the clause, if any.
    """

    limit: str
    wanted: int | str
    allowed: int | str | None
    offset: int | None
    clause: str

    def __init__(
        self,
        limit: str,
        wanted: int | str,
        allowed: int | str | None = None,
        code: str = "E_LIMIT",
        offset: int | None = None,
        clause: str = "",
    ) -> None:
        super().__init__(limit, wanted, allowed, code, offset, clause)
        self.code = code
        self.limit = limit
        self.wanted = wanted
        self.allowed = allowed
        self.offset = offset
        self.clause = clause

    def __str__(self) -> str:
        allowed = "" if self.allowed is None else f", allowed {self.allowed}"
        return _format_error(self.code, self.offset, self.clause, f"{self.limit}: needs {self.wanted}{allowed}")


class InputError(CsplatError):
    """The caller's data is invalid: a PLY, an array, an option.

    Args:
        message: a line with the problem and the remedy, if there is any.
    """

    code = "E_INPUT"

    def __init__(self, message: str) -> None:
        super().__init__(message)


class StoreError(CsplatError):
    """The store of a file did not return its bytes: no support for ranges, a lost connection, a changed file.

    Args:
        message: a line with the name of the file and the problem.
    """

    code = "E_STORE"

    def __init__(self, message: str) -> None:
        super().__init__(message)


class SearchInterrupted(KeyboardInterrupt):
    """A search for a target was interrupted by Ctrl-C.

    Programs that do not know it end as by any other `KeyboardInterrupt`.

    Args:
        message: the best result so far, or the nearest to the target.
        best: the best result so far that meets the target, of the type that the interrupted function returns; `None` if
            none does.
    """

    best: Any

    def __init__(self, message: str, best: Any = None) -> None:
        super().__init__(message)
        self.best = best


def counted(count: int, singular: str, plural: str | None = None) -> str:
    """Format a count with its noun: `1 tile`, `59,325 tiles`.

    Args:
        count: the number.
        singular: singular of the noun.
        plural: plural of the noun; `None`: the singular with an s.
    """
    return f"{count:,} {singular if count == 1 else plural or singular + 's'}"


def missing_package(error: ModuleNotFoundError, package: str | None = None, *, extra: str = "render") -> InputError:
    """Return the error for a missing optional package.

    Args:
        error: error raised by the import.
        package: name of the package, if it differs from the module's.
        extra: extra of csplat that installs the package.
    """
    name = package or error.name
    return InputError(f"this needs {name}, of the extra {extra}: pip install {quote(name or extra)}")


def _join_detail(detail: str, found: object, wanted: object) -> str:
    """Join the parts of a message, "detail, found X, expected Y", leaving out what is empty or `None`."""
    parts = [detail] if detail else []
    if found is not None:
        parts.append(f"found {found}")
    if wanted is not None:
        parts.append(f"expected {wanted}")
    return ", ".join(parts)


def _format_error(code: str, offset: int | None, clause: str, detail: str) -> str:
    """Return "CODE at byte N (CLAUSE): detail", leaving out what is unknown."""
    where = "" if offset is None else f" at byte {offset}"
    by = f" ({clause})" if clause else ""
    return f"{code}{where}{by}: {detail}" if detail else f"{code}{where}{by}"

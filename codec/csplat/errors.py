"""Define the exceptions, one class for each party at fault.

| class | at fault | what helps |
|---|---|---|
| `FormatError` | the file: it breaks a clause of the format | another copy of the file |
| `UnsupportedError` | nobody: the file needs a feature that this decoder does not have | a newer decoder |
| `LimitError` | nobody: the file needs more than the caller allows | larger limits |
| `InputError` | the caller's data: a PLY, an array, an option | see the message |
| `StoreError` | a server, or the connection to it | trying again |

Every error has a `code`, a short constant string that programs may compare.
"""

from __future__ import annotations


class CsplatError(Exception):
    """Base of every error that csplat raises on purpose.

    Attributes:
        code: short constant string for the kind of error, the same in all versions and languages (`E_CRC`).
        path: path of the file that was being read, as the caller named it; `None` if it is not known.
    """

    code: str = "E_CSPLAT"
    path: str | None = None


class FormatError(CsplatError):
    """A file breaks a clause of the format.

    `str()` gives the code, the offset, the clause, the value found and the value expected:
    `E_CRC at byte 12 (CRC-1): found 0x1a2b3c4d, computed 0x5e6f7081`.

    Args:
        code: error code of the registry, `E_...`.
        offset: offset in the file of the invalid field; `None` if it is not a single field.
        clause: id of the clause that is broken, `CRC-1`.
        detail: text after the colon, if `found` and `wanted` are not enough.
        found: value in the file.
        wanted: value that the clause requires.
    """

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
        super().__init__(code, offset, clause, _join(detail, found, wanted))
        self.code = code
        self.offset = offset
        self.clause = clause
        self.detail = _join(detail, found, wanted)

    def __str__(self) -> str:
        return _sentence(self.code, self.offset, self.clause, self.detail)


class UnsupportedError(CsplatError):
    """A file needs a feature that this decoder does not have.

    Args:
        feature: name of the feature that the file requires, `version 0.7`.
        code: error code of the registry.
        offset: offset in the file of the bytes that need it, if known.
        clause: id of the clause that specifies this, if there is one.
    """

    def __init__(
        self,
        feature: str,
        code: str = "E_UNSUPPORTED",
        offset: int | None = None,
        clause: str = "",
    ) -> None:
        super().__init__(feature, code, offset, clause)
        self.code = code
        self.feature = feature
        self.offset = offset
        self.clause = clause

    def __str__(self) -> str:
        return _sentence(self.code, self.offset, self.clause, f"{self.feature} is not supported")


class LimitError(CsplatError):
    """A file needs more than the caller's limits allow. Nothing was allocated.

    Args:
        limit: name of the limit, `max_splats`.
        wanted: amount that the file needs.
        allowed: amount that the caller allows.
        code: error code of the registry.
        offset: offset in the file of the bytes that need it, if known.
        clause: id of the clause that specifies this, if there is one.
    """

    def __init__(
        self,
        limit: str,
        wanted: int,
        allowed: int | None = None,
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
        return _sentence(self.code, self.offset, self.clause, f"{self.limit}: wanted {self.wanted}{allowed}")


class InputError(CsplatError):
    """The caller's data cannot be used: a PLY, an array, an option.

    Args:
        message: one line that states what is wrong and, if there is one, the remedy.
    """

    code = "E_INPUT"

    def __init__(self, message: str) -> None:
        super().__init__(message)


class StoreError(CsplatError):
    """The store of a file did not return its bytes: no support of ranges, a lost connection, a changed file.

    Args:
        message: one line that names the file and states what arrived instead.
    """

    code = "E_STORE"

    def __init__(self, message: str) -> None:
        super().__init__(message)


def counted(count: int, one: str, many: str | None = None) -> str:
    """Format a number with the noun it counts: `1 tile`, `59,325 tiles`.

    Args:
        count: the number.
        one: the noun in the singular.
        many: the noun in the plural; `None`: the singular with an s.
    """
    return f"{count:,} {one if count == 1 else many or one + 's'}"


def missing_package(error: ModuleNotFoundError, package: str | None = None, *, extra: str = "render") -> InputError:
    """Return the error for a package that a plain install leaves out.

    Args:
        error: error raised by its import.
        package: name of the package, if it is not the module's.
        extra: extra of csplat that installs it.
    """
    return InputError(f"this needs {package or error.name}: pip install 'csplat[{extra}]'")


def _join(detail: str, found: object, wanted: object) -> str:
    parts = [detail] if detail else []
    if found is not None:
        parts.append(f"found {found}")
    if wanted is not None:
        parts.append(f"wanted {wanted}")
    return ", ".join(parts)


def _sentence(code: str, offset: int | None, clause: str, detail: str) -> str:
    where = "" if offset is None else f" at byte {offset}"
    by = f" ({clause})" if clause else ""
    return f"{code}{where}{by}: {detail}" if detail else f"{code}{where}{by}"

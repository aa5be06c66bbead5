# SPDX-License-Identifier: Apache-2.0
"""Read text, JSON and arrays; copy inputs to disk; write files atomically."""

from __future__ import annotations

import codecs
import io
import itertools
import json
import math
import os
import re
import shutil
import tempfile
import warnings
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from glob import escape
from mmap import mmap
from pathlib import Path
from tempfile import TemporaryDirectory
from tokenize import TokenError
from typing import Any, BinaryIO, Protocol

import numpy as np
from numpy.typing import NDArray

from csplat.errors import InputError
from csplat.file_source import File, describe_substitute, named_errors, open_binary, read_bytes
from csplat.system import take_permissions

# As the value of a member; or in a list, since JSON has no numbers that begin with 00 to 09.
_DECIMAL_COMMA = re.compile(r'":\s*([+-]?\d+,\d+(?:[eE][+-]?\d+)?)\s*[,}\n]|[\[,]\s*(-?\d+,0\d+)')
_TRAILING_BYTE = re.compile(r"([\udc81-\udcfe])\\(?!\\)")  # a backslash that ends a character of Shift-JIS, GBK or Big5
_PART_SIZE = 1 << 20  # bytes copied at a time
_NAME_PART = 20  # characters of a file's name in its temporary file's name, whose maximum is 255 bytes
_TEMPORARY = "csplat-"  # beginning of the names of files in the system's folder for temporary files
_numbers = itertools.count()  # tells the temporary files of this process apart
_MB = 1e6  # bytes
#: Names of files that represent the whole folder they are in: SOG as a folder, and with levels.
FOLDER_NAMES = ("meta.json", "lod-meta.json")

#: Exceptions that NumPy raises for damaged headers of arrays.
_NOT_AN_ARRAY = (ValueError, EOFError, SyntaxError, TokenError, TypeError, OverflowError, MemoryError, RecursionError)
_INTEGER_DIGITS = 300  # digits of the longest integer in JSON; longer integers exceed float64
_DEPTH_MAX = 500  # nested brackets in JSON; half of Python's default limit of recursion
_NO_BRACKETS = re.compile(r'"[^"\\]*(?:\\.[^"\\]*)*"|[^][{}"]+', re.DOTALL)  # what surrounds brackets in JSON
_SURROGATE = re.compile(r"\\u[dD][89a-fA-F]")  # an escape in JSON
_HEADER_READERS = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}


class BinaryWriter(Protocol):
    """A binary file open for writing, such as `open(path, "wb")` or `io.BytesIO`."""

    def write(self, data: bytes | memoryview, /) -> object:
        """Write bytes."""
        ...


#: Byte order marks and their encodings. UTF-32 precedes UTF-16, because its little-endian mark begins with UTF-16's.
_MARKS = (
    (codecs.BOM_UTF8, "utf-8-sig"),
    (codecs.BOM_UTF32_LE, "utf-32"),
    (codecs.BOM_UTF32_BE, "utf-32"),
    (codecs.BOM_UTF16_LE, "utf-16"),
    (codecs.BOM_UTF16_BE, "utf-16"),
)


def read_text(path: str | os.PathLike[str], *, any_bytes: bool = False) -> str:
    """Read a text file in UTF-8, or in the encoding of its byte order mark.

    Args:
        path: path of the file.
        any_bytes: keep bytes that are not UTF-8 as lone surrogates, as `os.fsdecode` does, for file names in the code
            page of another system; False: refuse them.

    Returns:
        The text without the mark, with line feeds as line ends.

    Raises:
        InputError: the file cannot be read, has another encoding, or is not text.
    """
    try:
        data = read_bytes(path)
    except OSError as error:
        raise InputError(f"{os.fspath(path)}: {error.strerror or error}") from error
    instead = describe_substitute(data[:64])
    if instead:
        raise InputError(f"{os.fspath(path)} is {instead}")
    encoding = next((name for mark, name in _MARKS if data.startswith(mark)), "utf-8")
    try:
        text = data.decode(encoding, "surrogateescape" if any_bytes and encoding.startswith("utf-8") else "strict")
    except UnicodeDecodeError as error:
        fault = f"byte {error.start} is 0x{data[error.start]:02x}, which is not {encoding.removesuffix('-sig').upper()}"
        raise InputError(f"{os.fspath(path)} is not a text file in UTF-8 ({fault}): save it as UTF-8") from None
    if "\0" in text:
        raise InputError(
            f"{os.fspath(path)} is not a text file in UTF-8 (byte {text.index(chr(0))} is 0): save it as UTF-8"
        )
    return text.replace("\r\n", "\n").replace("\r", "\n")


def read_json(path: str | os.PathLike[str], *, any_bytes: bool = False) -> Any:
    """Read a JSON file, in the encodings of `read_text`; otherwise as `parse_json`.

    Args:
        path: path of the file.
        any_bytes: as in `read_text`.

    Raises:
        InputError: the file cannot be read or is not JSON.
    """
    text = read_text(path, any_bytes=any_bytes)
    try:
        return parse_json(_TRAILING_BYTE.sub(r"\1\\\\", text) if any_bytes else text)
    except InputError as error:
        comma = _DECIMAL_COMMA.search(text)
        hint = f"; it has a decimal comma, {comma[1] or comma[2]}, expected a point" if comma else ""
        raise InputError(f"{os.fspath(path)} is not a JSON file: {error}{hint}") from None


def parse_json(text: str | bytes) -> Any:
    """Parse a JSON text of another program; NaN and infinities are accepted.

    Args:
        text: the text, or its bytes in UTF-8, UTF-16 or UTF-32.

    Returns:
        The value.

    Raises:
        InputError: it is not JSON, nested more than 500 deep, or has an integer of more than 300 digits, or a string
            that is not text (half of a surrogate pair).
    """
    try:
        text = text if isinstance(text, str) else text.decode(json.detect_encoding(text))
        if _json_depth(text) > _DEPTH_MAX:
            raise InputError("its brackets are nested too deep")
        value = json.loads(text, parse_int=_parse_integer)
        if _SURROGATE.search(text):
            json.dumps(value, ensure_ascii=False).encode()
    except UnicodeEncodeError:
        raise InputError("a string has half of a surrogate pair, expected Unicode text") from None
    except ValueError as error:
        raise InputError(" ".join(str(error).split())[:120]) from None
    return value


def _json_depth(text: str) -> int:
    """Return how deep the brackets of a JSON text are nested. The parser's own limit differs between Pythons."""
    brackets = _NO_BRACKETS.sub("", text).translate({ord("{"): "[", ord("}"): "]"}).encode()
    steps = np.where(np.frombuffer(brackets, "u1") == ord("["), 1, -1)
    return int(steps.cumsum().max(initial=0))


def _parse_integer(digits: str) -> int:
    """Parse an integer of JSON; raise a `ValueError` if it has more than `_INTEGER_DIGITS` digits."""
    if len(digits) > _INTEGER_DIGITS:
        raise ValueError(f"an integer has {len(digits):,} digits, expected at most {_INTEGER_DIGITS}")
    return int(digits)


def finite_or_none(value: float | None) -> float | None:
    """Return the value, or `None` for NaN and infinities, which JSON cannot represent."""
    return value if value is not None and math.isfinite(value) else None


def check_free_space(folder: str | os.PathLike[str], wanted_bytes: int, what: str) -> None:
    """Check that a disk has enough free space.

    Args:
        folder: a folder on the disk.
        wanted_bytes: bytes that will be written.
        what: the work, for the message: "the scene is sorted".

    Raises:
        InputError: less space is free.
        OSError: the folder does not exist.
    """
    free = shutil.disk_usage(folder).free
    if free < wanted_bytes:
        raise InputError(
            f"{os.fspath(folder)} has {free / _MB:,.0f} MB free, {wanted_bytes / _MB:,.0f} MB are needed while {what}"
        )


def size_on_disk(path: Path) -> int:
    """Return the size in bytes of a file, or of all files of a folder; a SOG folder counts without its other files."""
    manifest = path.name.lower() if path.name.lower() in FOLDER_NAMES else ""
    if not (path.is_dir() or manifest):
        return path.stat().st_size
    folder = path if path.is_dir() else path.parent
    manifest = manifest or next((name for name in reversed(FOLDER_NAMES) if (folder / name).is_file()), "")
    inside = folder.iterdir() if manifest == "meta.json" else folder.rglob("*")
    parts = (".webp", *FOLDER_NAMES) if manifest else ("",)
    return sum(entry.stat().st_size for entry in inside if entry.name.lower().endswith(parts) and entry.is_file())


@contextmanager
def local_file(file: File, name: str = "") -> Iterator[Path]:
    """Yield the path of a file that can be read twice; inputs other than paths are copied to a temporary file.

    Args:
        file: a path; a binary file, read from its current position; or bytes. Named pipes are copied, too.
        name: name of the copy, for messages; by default the name of the binary file, or "data".

    Raises:
        InputError: `file` has another type, or is open in text mode.
        OSError: the file cannot be read.
    """
    if isinstance(file, (str, os.PathLike)):
        path = Path(file)
        if not path.is_fifo():
            yield path
            return
        with open_binary(path) as pipe, local_file(pipe, path.name if path.suffix else "pipe") as copied:
            yield copied
            return
    own = getattr(file, "name", None)
    own = own if isinstance(own, str) else ""
    with temporary_folder() as folder:
        spool = folder / (name or Path(own).name or "data")
        with open_binary(spool, "x") as stream:
            for part in _parts(file, own or name or "the input"):
                stream.write(part)
        yield spool


def _parts(file: Any, name: str) -> Iterator[memoryview]:
    """Yield the bytes of a binary file or buffer in pieces; an `OSError` gets its name.

    Raises:
        InputError: `file` is neither, or its text does not decode.
    """
    try:
        if isinstance(file, mmap) or not hasattr(file, "read"):
            yield memoryview(file).cast("B")
            return
        while data := _read_part(file, name):
            yield memoryview(data)
    except (TypeError, ValueError) as error:  # ValueError: text that does not decode
        kind = type(file).__name__
        raise InputError(f"file is a {kind}, expected a path, a binary file or bytes: {error}") from None


def _read_part(file: Any, name: str) -> Any:
    """Read at most `_PART_SIZE` bytes; an `OSError` gets the name of the file."""
    with named_errors(name):
        return file.read(_PART_SIZE)


def temporary_root() -> str:
    """Return the folder for temporary files, which the environment variable TMPDIR sets.

    Raises:
        InputError: no such folder can be written.
    """
    try:
        return tempfile.gettempdir()
    except FileNotFoundError as error:
        refused = InputError(f"{error.strerror}: set TMPDIR to a folder that can be written")
        refused.path = "TMPDIR"  # not the file that was to be copied
        raise refused from None


@contextmanager
def temporary_folder() -> Iterator[Path]:
    """Yield a new folder for temporary files, which is deleted afterwards.

    Raises:
        InputError: no folder for temporary files can be written.
        OSError: the disk is full.
    """
    with TemporaryDirectory(
        prefix=_TEMPORARY, dir=temporary_root(), ignore_cleanup_errors=True
    ) as folder:  # Windows: files in it may still be mapped
        yield Path(folder)


def temporary_file() -> BinaryIO:
    """Open a temporary file for writing and reading, which vanishes when it is closed.

    Raises:
        InputError: no folder for temporary files can be written.
    """
    path = Path(temporary_root(), f"{_TEMPORARY}{os.urandom(8).hex()}")
    vanishes = getattr(os, "O_TEMPORARY", 0)  # on Windows
    stream = open_binary(path, "x+", permissions=0o600, flags=vanishes)
    if not vanishes:
        path.unlink()
    return stream


def is_temporary(path: str) -> bool:
    """Return True for the path of a file of `temporary_folder` or `temporary_file`, which users do not know."""
    if tempfile.tempdir is None:  # none has been needed
        return False
    parts, root = Path(path).parts, Path(tempfile.tempdir).parts
    return parts[: len(root)] == root and parts[len(root) :] != () and parts[len(root)].startswith(_TEMPORARY)


@contextmanager
def open_writer(file: str | os.PathLike[str] | BinaryWriter) -> Iterator[BinaryWriter]:
    """Yield a writer: `atomic_writer` for a path, or the given binary file, which stays open.

    Raises:
        InputError: `file` is neither.
        OSError: as in `atomic_writer`.
    """
    if isinstance(file, (str, os.PathLike)):
        with atomic_writer(file) as stream:
            yield stream
    elif hasattr(file, "write"):
        yield file
    else:
        raise InputError(f"file is a {type(file).__name__}, expected a path or a binary file")


@contextmanager
def atomic_writer(path: str | os.PathLike[str], *, replace: bool = True, seekable: bool = False) -> Iterator[BinaryIO]:
    """Write a file that appears under its name only when complete.

    Bytes go to a temporary file in the same folder, which is renamed on success and removed on any error. The target
    of a symbolic link is replaced, not the link. A file that is replaced keeps its permissions, and if possible its
    owner and group. Other hard links keep the older content. Devices and pipes are written directly, if possible.

    Args:
        path: path of the file to write.
        seekable: the caller seeks; a device or pipe receives the bytes when they are complete.
        replace: replace an existing file; False also keeps a file that another process creates in the meantime.

    Yields:
        An empty binary file.

    Raises:
        FileExistsError: the file exists and `replace` is False.
        OSError: the folder does not exist, is full or is not writable.
    """
    if Path(path).exists() and not Path(path).is_file():  # not resolved: /dev/stdout may point to an unnamed pipe
        with open_binary(path, "w") as stream:
            if not seekable:
                yield stream
                return
            with temporary_file() as spool:  # the null device says that it can seek, and is always at 0
                yield spool
                spool.seek(0)
                shutil.copyfileobj(spool, stream, _PART_SIZE)
        return
    target = resolve_links(path)
    old = target.stat() if target.exists() else None
    temporary = _temporary_name(target)
    try:
        permissions = 0o666 if old is None else 0o600  # until it has the permissions of the old file
        with open_binary(temporary, "x", name=path, permissions=permissions) as stream:
            if old is not None:
                take_permissions(stream.fileno(), old)
            yield stream
            stream.flush()
            with named_errors(path):
                os.fsync(stream.fileno())  # the bytes must reach the disk before the name
        if replace:
            temporary.replace(target)
        else:
            _take_name(temporary, target)
    except BaseException as error:
        with suppress(OSError):
            temporary.unlink()
        _report_as(path, temporary, error)
        raise


def resolve_links(path: str | os.PathLike[str]) -> Path:
    """Return the absolute path of a file that may not exist yet, without symbolic links.

    Raises:
        OSError: the path cannot name a file: its links form a loop, a name is too long, or a parent is a file.
    """
    with suppress(FileNotFoundError):
        Path(path).stat()  # `exists` hides loops of links, for which `resolve` raises a RuntimeError, or nothing
    return Path(path).resolve()


def _temporary_name(target: Path) -> Path:
    """Return an unused name in the same folder, which is not longer than 255 bytes, with the number of the process."""
    return target.with_name(f".{target.name[:_NAME_PART]}.{os.getpid()}.{next(_numbers)}.tmp")


def remove_unfinished(path: str | os.PathLike[str], pid: int) -> None:
    """Remove the temporary files of a process that was killed while it wrote a file by `atomic_writer`.

    Args:
        path: path of the file.
        pid: number of the process.
    """
    target = Path(path)
    for file in target.parent.glob(f".{escape(target.name[:_NAME_PART])}.{pid}.*.tmp"):
        file.unlink(missing_ok=True)


def _report_as(path: str | os.PathLike[str], temporary: Path, error: BaseException) -> None:
    """Replace the name of a temporary file or folder in an error by the name that the caller knows."""
    if isinstance(error, OSError) and isinstance(error.filename, str):
        failed = Path(error.filename)
        if failed.is_relative_to(temporary):
            error.filename = str(Path(path, failed.relative_to(temporary)))


def work_folder(path: str | os.PathLike[str]) -> Path:
    """Return the folder for temporary files of an output: its own folder, or the system's for a device or pipe."""
    target = Path(path)
    return Path(temporary_root()) if target.exists() and not target.is_file() else target.parent


@contextmanager
def atomic_folder(path: str | os.PathLike[str]) -> Iterator[Path]:
    """Write a folder that appears under its name only when complete, in the place of an older folder.

    Args:
        path: path of the folder. An older folder is deleted with all its files, so the caller checks what it contains.

    Yields:
        An empty folder next to it, which is renamed on success and removed on any error.

    Raises:
        OSError: the parent folder does not exist, is full or is not writable.
    """
    target = resolve_links(path)
    temporary, old = _temporary_name(target), _temporary_name(target)
    try:
        temporary.mkdir()
        if target.exists():
            shutil.copymode(target, temporary)
        yield temporary
        if target.exists():
            target.rename(old)
        temporary.rename(target)
    except BaseException as error:
        shutil.rmtree(temporary, ignore_errors=True)
        if old.exists() and not target.exists():
            old.rename(target)
        _report_as(path, temporary, error)
        raise
    shutil.rmtree(old, ignore_errors=True)


def _take_name(temporary: Path, target: Path) -> None:
    """Move a complete file to its name.

    Raises:
        FileExistsError: another process created the file first.
    """
    try:
        os.link(temporary, target)
    except FileExistsError:
        raise
    except (OSError, AttributeError):  # no hard links: reserve the name with an empty file, then replace that
        os.close(os.open(target, os.O_CREAT | os.O_EXCL | os.O_WRONLY))
        temporary.replace(target)
    else:
        temporary.unlink()


def path_inside(folder: Path, name: str) -> Path | None:
    """Return the path of a file that another file names, with links resolved; `None` if it is outside the folder.

    Args:
        folder: folder of the file that names it.
        name: its name relative to the folder; not trusted.

    Raises:
        ValueError: the name contains a null character or half of a surrogate pair.
        OSError: a folder in the name cannot be read; before Python 3.13 `RuntimeError` for a loop of links.
    """
    folder = folder.resolve()
    target = (folder / name).resolve()
    return target if target.is_relative_to(folder) else None


def read_array(path: str | os.PathLike[str], *, most_bytes: int | None = None) -> NDArray[Any]:
    """Read an array from a .npy file.

    Args:
        path: path of the file.
        most_bytes: size from which a file is mapped instead of read; `None`: always read.

    Raises:
        InputError: the file is not a .npy file.
        OSError: the file cannot be read.
    """
    if Path(path).exists() and not Path(path).is_file():
        raise InputError(f"{path} is not a file")
    size = Path(path).stat().st_size
    with open_binary(path) as stream:
        if instead := describe_substitute(stream.read(64)):
            raise InputError(f"{path} is {instead}")
        stream.seek(0)
        try:
            if most_bytes is not None and size > most_bytes:
                return np.lib.format.open_memmap(path, mode="r")
            return parse_array(stream, size)
        except (InputError, *_NOT_AN_ARRAY) as error:
            reason = " ".join(str(error).split())
            raise InputError(f"{path} is not a NumPy array file (.npy): {reason}") from None


def parse_array(stream: io.BufferedIOBase, size: int) -> NDArray[Any]:
    """Read an array in NumPy's format; its size is compared with the file's before memory is allocated.

    Args:
        stream: the file from its beginning.
        size: its size in bytes.

    Raises:
        InputError: it is not an array, contains Python objects, or has more or fewer bytes than its shape requires.
    """
    try:
        with warnings.catch_warnings(action="ignore"):  # NumPy warns about headers that Python 2 wrote
            version = np.lib.format.read_magic(stream)
            if version not in _HEADER_READERS:
                raise InputError(f"it is an array file of version {version[0]}.{version[1]}, expected 1.0 or 2.0")
            shape, is_transposed, dtype = _HEADER_READERS[version](stream)
    except _NOT_AN_ARRAY as error:
        raise InputError(" ".join(str(error).split())) from None
    if dtype.hasobject or dtype.itemsize == 0:
        raise InputError(f"its values are of type {dtype}, expected numbers or text: pickled objects are not read")
    count = math.prod(shape)
    rest = size - stream.tell()
    if min(shape, default=0) < 0 or count * dtype.itemsize != rest:
        text = f"its shape is {', '.join(str(side)[:20] for side in shape[:4])}" if shape else "it is a single value"
        raise InputError(f"{text} of type {dtype}, which does not fit its {rest:,} bytes of values")
    data: NDArray[Any] = np.empty(rest, np.uint8)
    for start in range(0, rest, _PART_SIZE):
        part = data[start : start + _PART_SIZE].data
        if stream.readinto(part) != len(part):
            raise InputError("it is truncated")
    stream.read(1)  # at the end, zipfile compares the checksum
    array = data.view(dtype)
    return array.reshape(shape[::-1]).T if is_transposed else array.reshape(shape)

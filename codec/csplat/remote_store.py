"""Read byte ranges of files at URLs with fsspec, and choose the store of a file."""

from __future__ import annotations

import errno
import os
import re
import stat
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from csplat.byte_store import DiskStore, MemoryStore, Store
from csplat.errors import InputError, StoreError, missing_package
from csplat.file_source import File

_URL = re.compile(r"[A-Za-z][A-Za-z0-9+.-]*(://|::)")
#: A character of a URL before the next URL of a chain, as in `simplecache::https://host/file`.
_LINK = r"(?!::[A-Za-z][A-Za-z0-9+.-]*(?:://|::))"
#: A URL in any text: scheme, user and password, host and path, query and fragment.
_URL_IN_TEXT = re.compile(rf"([A-Za-z][A-Za-z0-9+.-]*://)(?:[^\s/?#]*@)?((?:{_LINK}[^\s?#])*)(?:[?#](?:{_LINK}\S)*)?")
#: Protocols of servers that may ignore a range request and send the whole file.
_WEB = {"http", "https"}
#: Fields that identify a version of a file, under the names of fsspec's file systems.
_VERSION = (
    "size", "ETag", "etag", "Last-Modified", "LastModified", "last_modified", "mtime", "created", "VersionId",
    "generation",
)  # fmt: skip
#: Errors of the operating system that HTTP status codes are reported as.
_STATUS = {401: errno.EACCES, 403: errno.EACCES, 404: errno.ENOENT, 410: errno.ENOENT}


def is_url(file: object) -> bool:
    """Return True if `file` is a URL such as `s3://bucket/scene.csplat`."""
    return isinstance(file, str) and _URL.match(file) is not None


def open_store(file: File, storage: Mapping[str, Any] | None = None) -> Store:
    """Open the store of a file.

    Args:
        file: a path, a URL, an open binary file, or bytes.
        storage: options of fsspec's file system, for a URL.

    Raises:
        InputError: `file` has another type, or is a URL of an unknown protocol.
        StoreError: the store does not answer.
        OSError: the file does not exist or cannot be read.
    """
    if isinstance(file, str) and is_url(file):
        return RemoteStore(file, storage or {})
    if storage:
        raise InputError("storage options require a URL, and the file is not one")
    if isinstance(file, (str, os.PathLike)) and stat.S_ISREG(Path(file).stat().st_mode):
        return DiskStore(Path(file))
    return MemoryStore(file)


class RemoteStore(Store):
    """A file at a URL. fsspec manages retries and connections, which it keeps for the next file."""

    def __init__(self, url: str, options: Mapping[str, Any]) -> None:
        self._fs, self._path = _file_system(url, options)
        self._shown = _redact(url)
        names = self._fs.protocol
        self._web = not _WEB.isdisjoint((names,) if isinstance(names, str) else names)
        self._supports_ranges = not self._web
        self._info = self._read_info()
        size = self._info.get("size")
        if self._info.get("type") == "directory":
            raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), self._shown)
        if size is None:
            raise StoreError(f"{self._shown}: the server does not report the size of the file, so no parts can be read")
        super().__init__(self._shown, size, requests=1)

    def _parts(self, ranges: Sequence[tuple[int, int]]) -> list[bytes]:
        parts: list[bytes] = []
        while not self._supports_ranges and len(parts) < len(ranges):
            parts.append(self._read_checked(*ranges[len(parts)]))
        rest = ranges[len(parts) :]
        # File systems without coroutines open files, which would read ahead.
        cache = {} if self._fs.async_impl else {"cache_type": "none"}
        starts, stops = [start for start, _ in rest], [stop for _, stop in rest]
        try:
            found: list[Any] = self._fs.cat_ranges([self._path] * len(rest), starts, stops, on_error="return", **cache)
        except Exception as error:  # noqa: BLE001  # stores raise the exceptions of their libraries
            raise self._failure(error) from None
        for one in found:
            if isinstance(one, BaseException):
                raise self._failure(one) from None
        return parts + found

    def _read_checked(self, start: int, stop: int) -> bytes:
        """Read a range from a server that may not support ranges, which fsspec's file object detects early."""
        try:
            with self._fs.open(self._path, "rb", cache_type="none", size=self.size) as stream:
                stream.seek(start)
                part: bytes = stream.read(stop - start)
        except ValueError:  # raised by fsspec
            raise StoreError(f"{self.name}: the server sends only whole files, no parts (HTTP Range)") from None
        except Exception as error:  # noqa: BLE001  # as above
            raise self._failure(error) from None
        self._supports_ranges = start > 0  # a server without ranges also returns the beginning
        return part

    def _read_info(self) -> dict[str, Any]:
        try:
            info: dict[str, Any] = self._fs.info(self._path)
        except Exception as error:  # noqa: BLE001  # as above
            raise self._failure(error) from None
        return info

    def _is_other(self) -> bool:
        self._fs.invalidate_cache(self._path)
        self.requests += 1
        now = self._read_info()
        return any(self._info.get(name) != now.get(name) for name in _VERSION)

    def _failure(self, error: BaseException) -> Exception:
        """Translate an exception of fsspec."""
        if isinstance(error, ModuleNotFoundError):
            return missing_package(error, extra="remote")
        if self._web and isinstance(error, FileNotFoundError) and error.__cause__ is not None:
            error = error.__cause__  # fsspec raises FileNotFoundError for any failure
        status = getattr(error, "status", 0)
        number = _STATUS.get(status, 0)
        if isinstance(error, FileNotFoundError):
            number = errno.ENOENT
        elif isinstance(error, PermissionError):
            number = errno.EACCES
        if number:
            return OSError(number, os.strerror(number), self._shown)  # creates the subclass for the number
        text = f"HTTP status {status}" if status else _message(error)
        return StoreError(f"{self._shown}: {text or type(error).__name__}")


def _file_system(url: str, options: Mapping[str, Any]) -> tuple[Any, str]:
    """Return fsspec's file system for a URL, and the path in it."""
    try:
        from fsspec.core import url_to_fs
    except ModuleNotFoundError as error:
        raise missing_package(error, extra="remote") from None
    if url.startswith(("http://", "https://")):  # ranges must refer to the file, not to compressed data
        options = {**options, "headers": {"Accept-Encoding": "identity", **options.get("headers", {})}}
    try:
        fs, path = url_to_fs(url, **options)
    except ImportError as error:  # fsspec's message names the package
        raise InputError(f"{_redact(url)}: {_message(error)}; for HTTP and S3: pip install 'csplat[remote]'") from None
    except (ValueError, TypeError) as error:
        raise InputError(f"{_redact(url)}: {_message(error)}") from None
    return fs, path


def _message(error: BaseException) -> str:
    """Return the text of a library's exception as one line; it may contain the URL."""
    return _redact(" ".join(str(error).split()))


def _redact(text: str) -> str:
    """Remove passwords and queries, which contain signatures, from all URLs in a text."""
    return _URL_IN_TEXT.sub(r"\1\2", text)

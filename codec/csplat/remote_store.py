# SPDX-License-Identifier: Apache-2.0
"""Read byte ranges of files at URLs with fsspec, and choose the store of a file."""

from __future__ import annotations

import errno
import os
import re
import stat
import time
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
_WEB = {"http", "https"}
_RANGE = re.compile(r"bytes=(\d+)-(\d+)")
_CONTENT_RANGE = re.compile(r"\s*bytes\s+(\d+)-\d+/", re.IGNORECASE)
#: Status codes of servers that are overloaded or being restarted.
_BUSY = {408, 429, 502, 503, 504}
_WHOLE, _PART, _FORBIDDEN = 200, 206, 403  # status codes of HTTP
_COMPRESSED = (
    "the server sends the file compressed (Content-Encoding{}), so no parts can be read: store it there without, or"
    " download it"
)
_SILENCE = 30.0  # seconds without a byte after which a connection counts as lost; proxies wait up to 60 s for others
_LONGEST_WAIT = 60.0  # seconds; a server that asks for a longer break has an error reported instead
_MAX_ROUNDS = 1000  # maximum number of answers that a range is joined from: 8 MiB in pieces of 8 KiB
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


class _BusyError(Exception):
    """A server is busy.

    Attributes:
        status: HTTP status.
        wait: seconds after which the server asks to try again; `None` if unspecified.
    """

    def __init__(self, status: int, wait: float | None) -> None:
        super().__init__(f"HTTP status {status}")
        self.status = status
        self.wait = wait


class RemoteStore(Store):
    """A file at a URL.

    fsspec manages connections, which it keeps for the next file. Requests to web servers are repeated after the breaks
    of `RequestSizes.waits`, and short answers are continued. The libraries of other stores repeat their own requests.
    """

    def __init__(self, url: str, options: Mapping[str, Any]) -> None:
        self._fs, self._path = _file_system(url, options)
        self._shown = _redact(url)
        names = self._fs.protocol
        self._web = not _WEB.isdisjoint((names,) if isinstance(names, str) else names)
        self._info = self._read_info(self.sizes.waits)
        size = self._info.get("size")
        if self._info.get("type") == "directory":
            raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), self._shown)
        if size is None:
            raise StoreError(f"{self._shown}: the server does not report the size of the file, so no parts can be read")
        super().__init__(self._shown, size, requests=1)

    def _parts(self, ranges: Sequence[tuple[int, int]]) -> list[bytes]:
        """Read each range, requesting what is missing of it until it is complete or nothing more arrives.

        A part may still be shorter than its range: `read` checks that.

        Raises:
            StoreError, OSError, InputError: as in `_wait`.
        """
        parts = [b""] * len(ranges)
        repeats = 0
        for round_ in range(_MAX_ROUNDS):
            missing = [at for at, (start, stop) in enumerate(ranges) if len(parts[at]) < stop - start]
            if not missing:
                break
            self.requests += len(missing) if round_ else 0  # `read` has counted the first requests
            lost: BaseException | None = None
            answers = self._answers([(ranges[at][0] + len(parts[at]), ranges[at][1]) for at in missing])
            for at, answer in zip(missing, answers, strict=True):
                if isinstance(answer, BaseException):
                    lost = answer
                else:
                    parts[at] += answer
            if lost is not None:
                self._wait(lost, repeats, self.sizes.waits)
                repeats += 1
            elif not (self._web and any(answers)):
                break
        return parts

    def _answers(self, ranges: Sequence[tuple[int, int]]) -> list[Any]:
        """Request one or more ranges, and return the bytes of each, which may be too few, or an exception."""
        starts, stops = zip(*ranges, strict=True)
        # File systems without coroutines open files, which would read ahead.
        cache = {} if self._fs.async_impl else {"cache_type": "none"}
        paths = [self._path] * len(ranges)
        try:
            answers: list[Any] = self._fs.cat_ranges(paths, list(starts), list(stops), on_error="return", **cache)
        except Exception as error:  # noqa: BLE001  # stores raise the exceptions of their libraries
            return [error] * len(ranges)
        return answers

    def _read_info(self, waits: Sequence[float]) -> dict[str, Any]:
        """Return fsspec's description of the file (`size`, `type` and others).

        Args:
            waits: break before each repetition, seconds; none are repeated if it is empty.

        Raises:
            StoreError, OSError, InputError: as in `_wait`.
        """
        repeats = 0
        while True:
            try:
                info: dict[str, Any] = self._fs.info(self._path)
            except Exception as error:  # noqa: BLE001  # as above
                self._wait(error, repeats, waits)
                repeats += 1
            else:
                return info

    def _wait(self, error: BaseException, repeats: int, waits: Sequence[float]) -> None:
        """Wait before a request is repeated.

        Args:
            error: an exception of fsspec.
            repeats: number of repetitions so far.
            waits: break before each repetition, seconds, unless the server specifies it.

        Raises:
            StoreError, OSError, InputError: the error, if it is permanent or no repetition is left.
        """
        cause = self._cause(error)
        if not (self._web and repeats < len(waits) and _is_transient(cause)):
            raise self._failure(error, repeats) from None
        wait = waits[repeats]
        if isinstance(cause, _BusyError) and cause.wait is not None:
            wait = cause.wait
        if wait > _LONGEST_WAIT:
            raise self._failure(error, repeats) from None
        time.sleep(wait)

    def _is_other(self) -> bool:
        """Request the description again, once, and return True if a field of `_VERSION` has changed since opening."""
        self._fs.invalidate_cache(self._path)
        self.requests += 1
        now = self._read_info(())
        return any(_strong(self._info.get(name)) != _strong(now.get(name)) for name in _VERSION)

    def _cause(self, error: BaseException) -> BaseException:
        """Return the exception of aiohttp: fsspec raises FileNotFoundError from it for any failure."""
        wrapped = self._web and isinstance(error, FileNotFoundError) and error.__cause__ is not None
        return error.__cause__ or error if wrapped else error

    def _failure(self, error: BaseException, repeats: int) -> Exception:
        """Return the error to raise for an exception of fsspec, after a number of repetitions.

        Returns:
            An `OSError` for a file that is absent or may not be read, an error that names a missing package, or a
            `StoreError` for anything else.
        """
        if isinstance(error, ModuleNotFoundError):
            return missing_package(error, extra="remote")
        error = self._cause(error)
        status = getattr(error, "status", 0)
        number = _STATUS.get(status, 0)
        if isinstance(error, FileNotFoundError):
            number = errno.ENOENT
        elif isinstance(error, PermissionError):
            number = errno.EACCES
        if number:
            text = os.strerror(number)
            if status == _FORBIDDEN:
                text += " (HTTP status 403: not public, or the signature of the URL has expired)"
            return OSError(number, text, self._shown)  # creates the subclass for the number
        if isinstance(error, TimeoutError):
            text = "the server sends nothing"
        elif "content-encoding" in getattr(error, "message", ""):  # aiohttp cannot unpack it
            text = _COMPRESSED.format("")
        else:
            text = f"HTTP status {status}" if status else _message(error) or type(error).__name__
        if isinstance(error, _BusyError) and error.wait is not None:
            text += f", try again after {error.wait:g} s"
        tried = f"; tried {repeats + 1} times" if repeats else ""
        return StoreError(f"{self._shown}: {text}{tried}")


def _strong(value: Any) -> Any:
    """Return an ETag without the mark of weak tags, which proxies add, and other values unchanged."""
    return value.removeprefix("W/") if isinstance(value, str) else value


def _is_transient(error: BaseException) -> bool:
    """Return True if a request to a web server may succeed when it is repeated."""
    if isinstance(error, _BusyError | TimeoutError):
        return True
    import aiohttp

    if isinstance(error, aiohttp.ClientConnectorError):  # a wrong name, a closed port, a wrong certificate
        return False
    return isinstance(error, aiohttp.ClientConnectionError | aiohttp.ClientPayloadError)


async def _check_answer(answer: Any) -> None:
    """Check the answer of a web server before its body is read (`raise_for_status` of aiohttp).

    Raises:
        _BusyError: the server is busy.
        StoreError: the file is compressed, or the body is not the range that was requested.
    """
    fault: Exception | None = None
    if answer.status in _BUSY:
        wait = answer.headers.get("Retry-After", "")
        fault = _BusyError(answer.status, float(wait) if wait.isdecimal() and len(wait) < 10 else None)
    elif answer.status in {_WHOLE, _PART}:
        text = _describe_fault(answer)
        fault = StoreError(text) if text else None
    if fault is not None:
        answer.close()  # the rest of the body may be long
        raise fault


def _describe_fault(answer: Any) -> str:
    """Return an error message if an answer of status 200 or 206 has other bytes than requested, otherwise ""."""
    asked = _RANGE.fullmatch(answer.request_info.headers.get("Range", ""))
    coding = answer.headers.get("Content-Encoding", "").strip().lower()
    if coding not in {"", "identity"} and (asked is None or answer.status == _WHOLE):
        # aiohttp unpacks parts that are compressed on the way; ranges of a file that is stored compressed are useless.
        return _COMPRESSED.format(f": {coding}")
    if asked is None:
        return ""
    start, size = int(asked[1]), int(asked[2]) + 1 - int(asked[1])
    sent = _CONTENT_RANGE.match(answer.headers.get("Content-Range", ""))
    if answer.status == _WHOLE and sent is None and answer.content_length != size:
        return "the server sends only whole files, no parts (HTTP Range): download it"
    if sent is not None and int(sent[1]) != start:
        return f"the server sent the part from byte {int(sent[1])}, requested was the one from byte {start}"
    return ""


def _file_system(url: str, options: Mapping[str, Any]) -> tuple[Any, str]:
    """Return fsspec's file system for a URL, and the path in it; raise an `InputError` if a package is missing."""
    try:
        from fsspec.core import url_to_fs
    except ModuleNotFoundError as error:
        raise missing_package(error, extra="remote") from None
    try:
        if url.startswith(("http://", "https://")):
            options = _web_options(options)
        fs, path = url_to_fs(url, **options)
    except ImportError as error:  # fsspec's message names the package
        raise InputError(f"{_redact(url)}: {_message(error)}; for HTTP and S3: pip install aiohttp s3fs") from None
    except (ValueError, TypeError) as error:
        raise InputError(f"{_redact(url)}: {_message(error)}") from None
    return fs, path


def _web_options(options: Mapping[str, Any]) -> dict[str, Any]:
    """Return options for a web server, with defaults for what the caller does not specify."""
    import aiohttp

    client: dict[str, Any] = {
        "timeout": aiohttp.ClientTimeout(total=None, sock_connect=_SILENCE, sock_read=_SILENCE),
        "raise_for_status": _check_answer,
        "trust_env": True,  # proxies in HTTP_PROXY, HTTPS_PROXY and NO_PROXY
        **options.get("client_kwargs", {}),
    }
    # Ranges must refer to the file, not to compressed data.
    headers = {"Accept-Encoding": "identity", **options.get("headers", {})}
    return {**options, "headers": headers, "client_kwargs": client}


def _message(error: BaseException) -> str:
    """Return the text of a library's exception as a single line; it may contain the URL."""
    return _redact(" ".join(str(error).split()))


def _redact(text: str) -> str:
    """Remove passwords and queries, which contain signatures, from all URLs in a text."""
    return _URL_IN_TEXT.sub(r"\1\2", text)

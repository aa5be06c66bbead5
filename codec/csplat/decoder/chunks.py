"""Chunks of the whole file, one at a time and without the splats."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from csplat import _spec
from csplat.decoder.container import check_length, read_file_header, view_of
from csplat.decoder.index import read_header
from csplat.decoder.jsontext import read_json
from csplat.decoder.limits import Limits
from csplat.decoder.stated import StatedErrors, read_serr

if TYPE_CHECKING:
    from csplat.inputs import File


def read_metadata(data: File, *, limits: Limits | None = None) -> dict[str, Any] | None:
    """Return what the META chunk holds, `None` where there is none."""
    value: dict[str, Any] | None = _read_text(data, _spec.CHUNK_METADATA, limits)
    return value


def read_cameras(data: File, *, limits: Limits | None = None) -> list[dict[str, Any]] | None:
    """Return what the CAMS chunk holds, `None` where there is none."""
    value: list[dict[str, Any]] | None = _read_text(data, _spec.CHUNK_CAMERAS, limits)
    return value


def read_options(data: File, *, limits: Limits | None = None) -> dict[str, Any] | None:
    """Return what the OPTS chunk holds, `None` where there is none."""
    value: dict[str, Any] | None = _read_text(data, _spec.CHUNK_OPTIONS, limits)
    return value


def read_stated_errors(data: File) -> StatedErrors | None:
    """Return what the SERR chunk states, `None` where there is none."""
    view = view_of(data)
    check_length(view, read_file_header(view).file_size)
    header = read_header(view)
    return read_serr(view, header)


def _read_text(data: File, kind: bytes, limits: Limits | None) -> Any:
    view = view_of(data)
    check_length(view, read_file_header(view).file_size)
    header = read_header(view)
    return read_json(view, header, kind, (limits or Limits()).json_bytes)

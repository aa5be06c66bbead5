"""Everything that a file says of itself without being decoded: for `csplat info`."""

from __future__ import annotations

from mmap import mmap
from typing import Any

from csplat.decoder import (
    StatedErrors,
    read_cameras,
    read_header,
    read_metadata,
    read_options,
    read_stated_errors,
)
from csplat_tools.inspect.layout import describe

__all__ = ["describe_file"]


def describe_file(data: bytes | mmap) -> dict[str, Any]:
    """Describe a file: scene, sizes, options, metadata, stated errors.

    Args:
        data: all of the file; of a memory-mapped one little is touched.

    Returns:
        JSON-compatible values.

    Raises:
        FormatError: header, index, block heads or one of the small chunks are not valid.
        LimitError: metadata, cameras or options are larger than the decoder's budget.
    """
    header = read_header(data)
    described = describe(data, header)
    cameras = read_cameras(data)
    described["cameras"] = None if cameras is None else len(cameras)
    described["options"] = read_options(data)
    described["metadata"] = read_metadata(data)
    stated = read_stated_errors(data)
    described["stated_errors"] = None if stated is None else _stated(stated)
    return described


def _stated(stated: StatedErrors) -> dict[str, Any]:
    return {
        "source_splats": stated.source_count,
        "pruned_splats": stated.pruned_count,
        "source_sh_degree": stated.source_sh_degree,
        "refitted": stated.refitted,
        "errors": {record.measure: {"max": record.max, "rms": record.rms} for record in stated.records},
    }

# SPDX-License-Identifier: Apache-2.0
"""Validate a file and verify its declared error bounds, as `csplat verify` does."""

from __future__ import annotations

from dataclasses import dataclass
from mmap import mmap
from typing import Any

from numpy.typing import NDArray

import csplat
from csplat.context import DEFAULT_CONTEXT, Context
from csplat.decoder import decode
from csplat.disk_files import read_array, size_on_disk
from csplat.errors import InputError
from csplat.model import MAX_SH_DEGREE
from csplat.splat_file import SplatFile
from csplat.system import available_memory_bytes
from csplat_conformance.declared_bounds import (
    BoundsVerification,
    Source,
    comparison_bytes,
    splats_in_memory,
    verify_bounds,
    verify_bounds_by_tile,
)
from csplat_conformance.validator import Validation, validate
from csplat_tools.file_streams import mapped_csplat, source_path

_INDEX_BYTES = 1 << 27  # largest size of a source index, which is read as a whole


@dataclass(frozen=True)
class Verification:
    """The outcome of verifying a file.

    Attributes:
        validation: violations of the spec, and the checks made.
        bounds: verification of the declared bounds; `None` without a source, or if the file violates the spec.
    """

    validation: Validation
    bounds: BoundsVerification | None

    @property
    def holds(self) -> bool:
        """True if the file conforms to the spec, and no declared bound was exceeded."""
        return self.validation.conforms and (self.bounds is None or self.bounds.holds)

    def as_json(self) -> dict[str, Any]:
        """Return everything as JSON-compatible values."""
        validation, bounds = self.validation, self.bounds
        return {
            "holds": self.holds,
            "conforms": validation.conforms,
            "violations": [
                {name: getattr(violation, name) for name in ("clause", "code", "offset", "field", "message")}
                for violation in validation.violations
            ],
            "remarks": list(validation.remarks),
            "not_looked_at": [{"field": unread.field, "reason": unread.reason} for unread in validation.unread],
            "splats": validation.splat_count,
            "tiles": validation.tile_count,
            "checks": list(validation.checks),
            "verification": None if bounds is None else bounds.as_json(),
        }


def verify_file(
    path: str,
    source: str | None = None,
    source_index: str | None = None,
    *,
    limit_splats: int | None = None,
    context: Context = DEFAULT_CONTEXT,
) -> Verification:
    """Find every violation in a file; if there is none and a source is given, verify its declared bounds.

    Args:
        path: the file, or `-`.
        source: its source.
        source_index: the .npy file that the encoder wrote.
        limit_splats: refuse a scene of more splats (LIM-1); `None`: no limit.
        context: threads, progress, and memory, by default all of it without an index; larger scenes are verified tile
            by tile, which requires a source index.

    Raises:
        CsplatError: source or index are not valid, or too large without an index.
        OSError: a file cannot be read.
    """
    rows = None if source_index is None else read_array(source_index, most_bytes=_INDEX_BYTES)
    with mapped_csplat(path) as data:
        validation = validate(data, splats_max=limit_splats, progress=context.progress)
        if source is None or not validation.conforms:
            return Verification(validation, None)
        return Verification(validation, _verify_bounds(data, source, rows, context))


def _verify_bounds(data: bytes | mmap, source: str, rows: NDArray[Any] | None, context: Context) -> BoundsVerification:
    """Verify the declared bounds against a source, in memory if both scenes fit, else tile by tile.

    Args:
        data: the file, which conforms.
        source: path of the source.
        rows: source index; `None`: pairs are searched, which takes both scenes in memory.
        context: threads, progress and memory.

    Raises:
        InputError: memory does not suffice without an index.
    """
    opened = SplatFile.open(data)
    header, bounds = opened.header, opened.declared_bounds
    degree = MAX_SH_DEGREE  # bands above have not been read by the encoder
    memory_bytes = context.memory_limit
    if context.memory is None and rows is None:
        memory_bytes = available_memory_bytes()
    with source_path(source) as local:
        needed = comparison_bytes(opened, bounds.source_count if bounds else 0, size_on_disk(local))
        if needed <= memory_bytes:
            model = csplat.read(local, keep_extra=bool(header.extras), sh_degree=degree)
            decoded = decode(data, context=context)
            return verify_bounds(Source.of(model), decoded, header, bounds, rows, context=context)
        if rows is None:
            raise InputError(
                f"the declared errors were not checked: this takes {needed / 1e6:,.0f} MB of memory, expected at most "
                f"{memory_bytes / 1e6:,.0f} MB; give --source-index, which takes less, or free more memory"
            )
        with csplat.open(local, sh_degree=degree) as scene:
            most = splats_in_memory(opened, memory_bytes)
            return verify_bounds_by_tile(scene, opened, rows, most, context=context)

"""Validate a file and verify its declared error bounds, as `csplat verify` does."""

from __future__ import annotations

from dataclasses import dataclass
from mmap import mmap
from typing import Any

from numpy.typing import NDArray

import csplat
from csplat.decoder import decode
from csplat.disk_files import read_array, size_on_disk
from csplat.errors import InputError
from csplat.model import MAX_SH_DEGREE
from csplat.splat_file import SplatFile
from csplat.system import available_memory_bytes, default_memory_bytes
from csplat.types import Progress
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
        proof: verification of the declared bounds; `None` without a source, or if the file violates the spec.
    """

    validation: Validation
    proof: BoundsVerification | None

    @property
    def holds(self) -> bool:
        """True if the file conforms to the spec, and no declared bound was exceeded."""
        return self.validation.conforms and (self.proof is None or self.proof.holds)

    def as_json(self) -> dict[str, Any]:
        """Return everything as JSON-compatible values."""
        validation, proof = self.validation, self.proof
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
            "proof": None if proof is None else proof.as_json(),
        }


def verify_file(
    path: str,
    source: str | None = None,
    source_index: str | None = None,
    *,
    max_splats: int | None = None,
    memory_bytes: int | None = None,
    progress: Progress | None = None,
) -> Verification:
    """Find every violation in a file; if there is none and a source is given, verify its declared bounds.

    Args:
        path: the file, or `-`.
        source: its source.
        source_index: the .npy file that the encoder wrote.
        max_splats: refuse a scene of more splats (LIM-1); `None`: no limit.
        memory_bytes: approximate limit of the memory; larger scenes are verified tile by tile, which requires a source
            index. `None`: half of the free memory, or all of it without an index.
        progress: progress callback for validating and matching.

    Raises:
        CsplatError: source or index are not valid, or too large without an index.
        OSError: a file cannot be read.
    """
    rows = None if source_index is None else read_array(source_index, most_bytes=_INDEX_BYTES)
    with mapped_csplat(path) as data:
        validation = validate(data, splats_max=max_splats, progress=progress)
        if source is None or not validation.conforms:
            return Verification(validation, None)
        return Verification(validation, _verify_bounds(data, source, rows, memory_bytes, progress))


def _verify_bounds(
    data: bytes | mmap, source: str, rows: NDArray[Any] | None, memory_bytes: int | None, progress: Progress | None
) -> BoundsVerification:
    opened = SplatFile.open(data)
    header, bounds = opened.header, opened.declared_bounds
    degree = MAX_SH_DEGREE  # bands above have not been read by the encoder
    if memory_bytes is None:
        memory_bytes = available_memory_bytes() if rows is None else default_memory_bytes()
    with source_path(source) as local:
        needed = comparison_bytes(opened, bounds.source_count if bounds else 0, size_on_disk(local))
        if needed <= memory_bytes:
            model = csplat.read(local, keep_extra=bool(header.extras), sh_degree=degree)
            return verify_bounds(Source.of(model), decode(data), header, bounds, rows, progress=progress)
        if rows is None:
            raise InputError(
                f"the declared errors were not checked: this takes {needed / 1e6:,.0f} MB of memory, expected at most "
                f"{memory_bytes / 1e6:,.0f} MB; give --source-index, which takes less, or free more memory"
            )
        with csplat.open(local, sh_degree=degree) as scene:
            most = splats_in_memory(opened, memory_bytes)
            return verify_bounds_by_tile(scene, opened, rows, most, progress=progress)

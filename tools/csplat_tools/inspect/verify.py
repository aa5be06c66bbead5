"""Check a file and prove what it states: what `csplat verify` does, apart from the command line."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from csplat.decoder import decode_scene
from csplat.ply import read_ply
from csplat_conformance.validator import Validation, Violation, validate
from csplat_tools.files.console import Progress
from csplat_tools.files.convert import limits_for
from csplat_tools.files.streams import mapped_csplat, ply_path, read_array
from csplat_tools.inspect.proof import Proof, prove

__all__ = ["Verified", "validation_as_json", "verify_file"]


@dataclass(frozen=True)
class Verified:
    """What became of a file.

    Attributes:
        validation: every violation of the spec, and what was looked at.
        proof: of its stated errors; `None` where no source was given, or where the file breaks a clause.
    """

    validation: Validation
    proof: Proof | None

    @property
    def holds(self) -> bool:
        """Whether the file conforms, and what it states was not disproved."""
        return self.validation.conforms and (self.proof is None or self.proof.holds)


def verify_file(
    path: str,
    source: str | None = None,
    source_index: str | None = None,
    *,
    max_splats: int | None = None,
    progress: Progress | None = None,
) -> Verified:
    """Look for every violation in a file; if there is none and a source is given, prove its stated errors.

    Args:
        path: the file, or `-`.
        source: the PLY that it was made from.
        source_index: the .npy file that the encoder wrote.
        max_splats: refuse more (LIM-1). Left out: none are too many for validating, which takes a tile at a time;
            for the proof the decoder's budget holds.
        progress: is told how far validating and matching have come.

    Raises:
        CsplatError: source or index cannot be read; or the proof wants more memory than the budget allows.
        OSError: a file cannot be read.
    """
    rows = None if source_index is None else read_array(source_index)
    with mapped_csplat(path) as data:
        validation = validate(data, splats_max=max_splats, progress=progress)
        if source is None or not validation.conforms:
            return Verified(validation, None)
        scene = decode_scene(data, limits=limits_for(max_splats))
    with ply_path(source) as ply:
        model = read_ply(ply, keep_extra=bool(scene.header.extras))
    return Verified(validation, prove(model, scene.model, scene.header, scene.stated_errors, rows, progress=progress))


def validation_as_json(validation: Validation) -> dict[str, Any]:
    """Return what was found as JSON-compatible values."""
    return {
        "conforms": validation.conforms,
        "violations": [_violation(one) for one in validation.violations],
        "remarks": list(validation.remarks),
        "not_looked_at": [{"field": one.field, "reason": one.reason} for one in validation.unread],
        "splats": validation.splat_count,
        "tiles": validation.tile_count,
        "checks": list(validation.checks),
    }


def _violation(one: Violation) -> dict[str, Any]:
    return {
        "clause": one.clause,
        "code": one.code,
        "offset": one.offset,
        "field": one.field,
        "message": one.message,
    }

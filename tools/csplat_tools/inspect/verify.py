"""Check a file and prove what it states: what `csplat verify` does, apart from the command line."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from csplat import formats
from csplat.decoder import decode_scene
from csplat.files import read_array
from csplat_conformance.stated import Proof, Source, prove
from csplat_conformance.validator import Validation, validate
from csplat_tools.files.console import Progress
from csplat_tools.files.streams import mapped_csplat, source_path

__all__ = ["Verified", "verify_file"]


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

    def as_json(self) -> dict[str, Any]:
        """Everything, JSON-compatible."""
        found, proof = self.validation, self.proof
        return {
            "holds": self.holds,
            "conforms": found.conforms,
            "violations": [
                {name: getattr(one, name) for name in ("clause", "code", "offset", "field", "message")}
                for one in found.violations
            ],
            "remarks": list(found.remarks),
            "not_looked_at": [{"field": one.field, "reason": one.reason} for one in found.unread],
            "splats": found.splat_count,
            "tiles": found.tile_count,
            "checks": list(found.checks),
            "proof": None if proof is None else proof.as_json(),
        }


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
        scene = decode_scene(data)
    with source_path(source) as path_of_source:
        model = formats.read(path_of_source, keep_extra=bool(scene.header.extras))
    proof = prove(Source.of(model), scene.model, scene.header, scene.stated_errors, rows, progress=progress)
    return Verified(validation, proof)

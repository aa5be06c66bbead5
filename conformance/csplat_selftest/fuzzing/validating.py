"""The strict validator against the Python decoder: two readings of the spec that share no code."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from pathlib import Path

from csplat import _spec, decoder
from csplat.errors import CsplatError
from csplat_conformance import validator
from csplat_selftest.fuzzing.targets import LIMITS, DecoderTarget


class ValidatorTarget(DecoderTarget):
    """A file is decoded if and only if the validator finds nothing; of refusals it names the clause, too."""

    name = "validator"
    watched: Sequence[Path] = (Path(validator.__file__).parent,)

    def attempt(self, data: bytes) -> tuple[str, str]:
        """Decode and validate."""
        error: CsplatError | None = None
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            try:
                decoder.decode(data, limits=LIMITS, threads=1)
            except CsplatError as caught:
                error = caught
            if error is not None and error.code == _spec.ERROR_LIMIT:  # a budget is no rule of the format
                return error.code, ""
            found = validator.validate(data, json_bytes_max=LIMITS.json_bytes, splats_max=LIMITS.splats)
        clauses = {one.clause for one in found.violations if one.code}  # SER-5 has none: no decoder can judge it
        if error is None:
            return (
                ("finding", f"decoded, but the validator names {', '.join(sorted(clauses))}")
                if clauses
                else ("decoded", "")
            )
        clause = getattr(error, "clause", "")
        if not clauses:
            return "finding", f"refused with {error.code} ({clause}), but the validator finds nothing"
        # If several clauses are broken, the validator may attribute the same damage to another one.
        return (error.code if clause in clauses else "another clause"), ""

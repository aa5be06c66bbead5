# SPDX-License-Identifier: CC0-1.0
"""The encoder suite: reference inputs, and checks of the files that an encoder writes for them (spec 9.3).

    >>> from csplat_conformance.encoders import run_encoder
    >>> run_encoder("my-encoder {ply} {out}").passed                                 # doctest: +SKIP
    True

There are four levels, each built on the previous level:

| level | the encoder |
|---|---|
| L1 | ends with the right status, and always writes the same valid file and nothing else |
| L2 | keeps every splat of the source, or declares how many it pruned; guesses no metadata |
| L3 | declares correct error bounds (SER-5) that are not absurdly large |
| L4 | preserves renders: PSNR compared with the source |

`encoder_run` runs the encoder and checks the run (L1). `file_checks` checks the file and its contents (L1, L2),
`error_checks` the bounds (L3), and `render_checks` the renders (L4).
"""

from __future__ import annotations

from csplat_conformance.encoders.encoder_inputs import PSNR_MIN, EncoderInput, all_inputs
from csplat_conformance.encoders.encoder_suite import LEVELS, EncoderSuiteOptions, run_encoder, write_inputs

__all__ = ["LEVELS", "PSNR_MIN", "EncoderInput", "EncoderSuiteOptions", "all_inputs", "run_encoder", "write_inputs"]

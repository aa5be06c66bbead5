"""Prove an encoder: reference inputs, and what becomes of them (spec 9.3).

    >>> from csplat_conformance.encoders import run_encoder
    >>> run_encoder("my-encoder {ply} {out}").passed                                 # doctest: +SKIP
    True

Four levels, each built on the one before:

| level | the encoder |
|---|---|
| L1 | ends as it should, the file it writes breaks no clause, is the same every time, and lies alone |
| L2 | keeps every splat of the source, or says how many it left out; nothing is guessed or wrapped |
| L3 | states its errors rightly (SER-5), and they are not absurd |
| L4 | keeps the picture: PSNR of renders against the source |

`trial` runs it, `ending` and `judge` look at what came (L1, L2), `mapping` at its source index, `proving` at the stated
errors (L3; what is only coarse is in `coarse` and `cut`), `picturing` at renders (L4).
"""

from __future__ import annotations

from csplat_conformance.encoders.encoder_inputs import PSNR_MIN, EncoderInput, all_inputs
from csplat_conformance.encoders.encoder_suite import LEVELS, EncoderSuiteOptions, run_encoder, write_inputs

__all__ = ["LEVELS", "PSNR_MIN", "EncoderInput", "EncoderSuiteOptions", "all_inputs", "run_encoder", "write_inputs"]

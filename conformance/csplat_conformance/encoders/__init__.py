"""Prove an encoder: reference inputs, and what becomes of them (spec 9.3).

    >>> from csplat_conformance.encoders import run_encoder
    >>> run_encoder("my-encoder {ply} {out}").passed                                 # doctest: +SKIP
    True

Four levels, each built on the one before:

| level | the encoder |
|---|---|
| L1 | ends as it should, and the file it writes breaks no clause |
| L2 | keeps every splat of the source, or says how many it left out; nothing is guessed or wrapped |
| L3 | states its errors rightly (SER-5) |
| L4 | keeps the picture: PSNR of renders against the source |
"""

from __future__ import annotations

from csplat_conformance.encoders.inputs import Input, all_inputs
from csplat_conformance.encoders.run import LEVELS, PSNR_MIN, EncoderChoice, run_encoder

__all__ = ["LEVELS", "PSNR_MIN", "EncoderChoice", "Input", "all_inputs", "run_encoder"]

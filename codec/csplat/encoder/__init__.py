"""The encoder: `encode()` reads like the list of its stages."""

from __future__ import annotations

from csplat.encoder.importance import Importance
from csplat.encoder.options import PRESETS, EncodeOptions
from csplat.encoder.pipeline import EncodeReport, EncodeResult, encode, encode_with_report

__all__ = ["PRESETS", "EncodeOptions", "EncodeReport", "EncodeResult", "Importance", "encode", "encode_with_report"]

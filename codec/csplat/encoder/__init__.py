"""The encoder: what whoever uses it may import is here.

`encode` and `encode_with_report` make a file in one go. `Draft` makes it in steps, for those who look at what became of
the scene before they choose its colours (`Draft.coded`), or tune all of its values (`Draft.frozen`). The last names are
parts of the encoder that serve others by themselves.
"""

from __future__ import annotations

from csplat.encoder.coded import Coded, EncodeReport, EncodeResult
from csplat.encoder.curvature import Curvatures
from csplat.encoder.draft import Draft, Origin
from csplat.encoder.frozen import DecodedValues, FreeValues, Frozen
from csplat.encoder.gauge import fix_gauge
from csplat.encoder.grades import most_grades
from csplat.encoder.importance import Importance, trusted
from csplat.encoder.kmeans import cluster
from csplat.encoder.options import PRESETS, Deflate, EncodeOptions, MeansCoding, PresetName, ShCoding
from csplat.encoder.pipeline import encode, encode_with_report

__all__ = [
    "PRESETS",
    "Coded",
    "Curvatures",
    "DecodedValues",
    "Deflate",
    "Draft",
    "EncodeOptions",
    "EncodeReport",
    "EncodeResult",
    "FreeValues",
    "Frozen",
    "Importance",
    "MeansCoding",
    "Origin",
    "PresetName",
    "ShCoding",
    "cluster",
    "encode",
    "encode_with_report",
    "fix_gauge",
    "most_grades",
    "trusted",
]

# SPDX-License-Identifier: Apache-2.0
"""Encode scenes to `.csplat` files.

`csplat.encode` encodes in one call, with the given options or to a `Target`. `EncodePlan` and `encode_tiles` encode in
steps, for callers that measure files; `fix_quantisation` is for callers that tune all values. `encode_levels` adds
levels of detail.
"""

from __future__ import annotations

from csplat.encoder.buckets import bucket_rows, sample_rows
from csplat.encoder.container import FileNode
from csplat.encoder.encode_options import (
    BUCKET_SPLATS,
    PRESETS,
    Deflate,
    EncodeOptions,
    MeansCoding,
    PresetName,
    ShCoding,
)
from csplat.encoder.encode_plan import EncodePlan, Origin
from csplat.encoder.error_bounds import covariance_entries
from csplat.encoder.error_targets import meet_bounds
from csplat.encoder.fixed_quantisation import DecodedValues, FixedQuantisation, FreeValues, fix_quantisation
from csplat.encoder.kmeans import cluster
from csplat.encoder.levels import LevelCoding, LevelNode, encode_levels
from csplat.encoder.pipeline import EncodedTiles, EncodeReport, EncodeResult, encode_tiles
from csplat.encoder.quantisation import canonicalise_shape
from csplat.encoder.quantisation_classes import max_class_count
from csplat.encoder.sh_codebook import FileCodebooks
from csplat.encoder.shape_codebook import mean_axes
from csplat.encoder.splat_importance import GaussNewtonBlocks, Importance, apply_weight_floor, project_sh
from csplat.encoder.target import SearchReport, Target, Views

__all__ = [
    "BUCKET_SPLATS",
    "PRESETS",
    "DecodedValues",
    "Deflate",
    "EncodeOptions",
    "EncodePlan",
    "EncodeReport",
    "EncodeResult",
    "EncodedTiles",
    "FileCodebooks",
    "FileNode",
    "FixedQuantisation",
    "FreeValues",
    "GaussNewtonBlocks",
    "Importance",
    "LevelCoding",
    "LevelNode",
    "MeansCoding",
    "Origin",
    "PresetName",
    "SearchReport",
    "ShCoding",
    "Target",
    "Views",
    "apply_weight_floor",
    "bucket_rows",
    "canonicalise_shape",
    "cluster",
    "covariance_entries",
    "encode_levels",
    "encode_tiles",
    "fix_quantisation",
    "max_class_count",
    "mean_axes",
    "meet_bounds",
    "project_sh",
    "sample_rows",
]

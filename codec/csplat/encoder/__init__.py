# SPDX-License-Identifier: Apache-2.0
"""Encode scenes to `.csplat` files.

`csplat.encode` encodes in one call, with the given options or to a `Target`. `EncodePlan` and `encode_tiles` encode in
steps, for callers that measure files; `fix_quantisation` is for callers that tune all values. `encode_levels` adds
levels of detail.

Names are imported on first use (PEP 562): commands that do not encode load only the options.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
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

_MODULE_OF = {
    "BUCKET_SPLATS": "csplat.encoder.encode_options",
    "DecodedValues": "csplat.encoder.fixed_quantisation",
    "Deflate": "csplat.encoder.encode_options",
    "EncodeOptions": "csplat.encoder.encode_options",
    "EncodePlan": "csplat.encoder.encode_plan",
    "EncodeReport": "csplat.encoder.pipeline",
    "EncodeResult": "csplat.encoder.pipeline",
    "EncodedTiles": "csplat.encoder.pipeline",
    "FileCodebooks": "csplat.encoder.sh_codebook",
    "FileNode": "csplat.encoder.container",
    "FixedQuantisation": "csplat.encoder.fixed_quantisation",
    "FreeValues": "csplat.encoder.fixed_quantisation",
    "GaussNewtonBlocks": "csplat.encoder.splat_importance",
    "Importance": "csplat.encoder.splat_importance",
    "LevelCoding": "csplat.encoder.levels",
    "LevelNode": "csplat.encoder.levels",
    "MeansCoding": "csplat.encoder.encode_options",
    "Origin": "csplat.encoder.encode_plan",
    "PRESETS": "csplat.encoder.encode_options",
    "PresetName": "csplat.encoder.encode_options",
    "SearchReport": "csplat.encoder.target",
    "ShCoding": "csplat.encoder.encode_options",
    "Target": "csplat.encoder.target",
    "Views": "csplat.encoder.target",
    "apply_weight_floor": "csplat.encoder.splat_importance",
    "bucket_rows": "csplat.encoder.buckets",
    "canonicalise_shape": "csplat.encoder.quantisation",
    "cluster": "csplat.encoder.kmeans",
    "covariance_entries": "csplat.encoder.error_bounds",
    "encode_levels": "csplat.encoder.levels",
    "encode_tiles": "csplat.encoder.pipeline",
    "fix_quantisation": "csplat.encoder.fixed_quantisation",
    "max_class_count": "csplat.encoder.quantisation_classes",
    "mean_axes": "csplat.encoder.shape_codebook",
    "meet_bounds": "csplat.encoder.error_targets",
    "project_sh": "csplat.encoder.splat_importance",
    "sample_rows": "csplat.encoder.buckets",
}


def __getattr__(name: str) -> object:
    """Import a public name; not by `csplat.lazy_exports`, since the encoder knows nothing of what `csplat` offers."""
    if name not in _MODULE_OF:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value: object = getattr(import_module(_MODULE_OF[name]), name)
    globals()[name] = value  # later accesses bypass this function
    return value

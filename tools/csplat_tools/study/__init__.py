"""Simple strategies, each a step on a scene: prune by opacity, take fewer SH bands, cluster attribute by attribute.

They serve comparisons with published studies. From the encoder they use `cluster` and
`canonicalise_shape`, so that k-means and the canonical axis order are those of the codec, and `EncodePlan`, whose
colours they replace.
"""

from __future__ import annotations

from csplat_tools.study.attribute_codebooks import (
    ATTRIBUTES,
    AttributeCodebook,
    Clustered,
    KMeans,
    attribute_floats,
    cluster_attributes,
    parse_kmeans,
    raw_bytes,
)
from csplat_tools.study.reductions import (
    ReducedScene,
    Reduction,
    encode_reduced,
    prune_opacity,
    prune_share,
    reduce_model,
)

__all__ = [
    "ATTRIBUTES",
    "AttributeCodebook",
    "Clustered",
    "KMeans",
    "ReducedScene",
    "Reduction",
    "attribute_floats",
    "cluster_attributes",
    "encode_reduced",
    "parse_kmeans",
    "prune_opacity",
    "prune_share",
    "raw_bytes",
    "reduce_model",
]

"""Simple strategies, each a step on a scene: prune by opacity, take fewer SH bands, cluster attribute by attribute.

They serve comparisons with published studies. From the encoder they use `cluster` and `fix_gauge`, so that k-means and
the canonical form of shapes are those of the codec, and `Draft`, whose colours they replace.
"""

from __future__ import annotations

from csplat_tools.study.clustering import ATTRIBUTES, Book, Clustered, KMeans, cluster_attributes, parse_kmeans
from csplat_tools.study.encoding import encode_reduced
from csplat_tools.study.pruning import prune_opacity, prune_share
from csplat_tools.study.reduction import Reduced, Reduction, reduce_model
from csplat_tools.study.sizes import attribute_floats, raw_bytes

__all__ = [
    "ATTRIBUTES",
    "Book",
    "Clustered",
    "KMeans",
    "Reduced",
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

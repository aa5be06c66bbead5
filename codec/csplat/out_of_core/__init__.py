"""Encode scenes that do not fit in memory bucket by bucket on disk, with the same bytes as in memory."""

from __future__ import annotations

from csplat.out_of_core.disk_encode import EncodingCost, OutOfCoreOptions, encode_scene, estimate_cost

__all__ = ["EncodingCost", "OutOfCoreOptions", "encode_scene", "estimate_cost"]

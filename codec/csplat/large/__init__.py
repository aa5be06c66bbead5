"""Scenes that do not fit the memory: encoded bucket by bucket, by way of the disk, to the same bytes."""

from __future__ import annotations

from csplat.large.encoding import Needs, encode_scene, needs_of

__all__ = ["Needs", "encode_scene", "needs_of"]

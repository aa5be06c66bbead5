# SPDX-License-Identifier: Apache-2.0
"""Encode scenes that do not fit in memory bucket by bucket on disk, with the same bytes as in memory."""

from __future__ import annotations

from csplat.out_of_core.disk_encode import EncodingCost, encode_on_disk, estimate_cost, working_folder

__all__ = ["EncodingCost", "encode_on_disk", "estimate_cost", "working_folder"]

# SPDX-License-Identifier: Apache-2.0
"""Helpers of the tests of damage, which several files share."""

from __future__ import annotations

from csplat import _spec
from csplat_authoring.builder import build
from csplat_authoring.samples import rich_scene, scene
from csplat_authoring.scene import Chunk
from csplat_conformance.manifest import VECTORS

SMALL = (VECTORS / "valid" / "worked_example.csplat").read_bytes()
BUILT = build(rich_scene())
RICH = BUILT.data


def flipped(data, bit):
    damaged = bytearray(data)
    damaged[bit // 8] ^= 1 << bit % 8
    return bytes(damaged)


def declared(source_count=2, pruned_count=0, flags=0, records=()):
    head = _spec.pack_declared_errors_head(_spec.DeclaredErrorsHead(source_count, pruned_count, 0, flags, len(records)))
    body = [
        _spec.pack_declared_error_record(_spec.DeclaredErrorRecord(measure, 0, 0, 0, largest, rms))
        for measure, largest, rms in records
    ]
    return build(scene(chunks=(Chunk(_spec.CHUNK_DECLARED_ERRORS, payload=head + b"".join(body)),))).data

# SPDX-License-Identifier: Apache-2.0
"""Helpers of the tests of validator, which several files share."""

import random
import zlib

from csplat import _spec
from csplat_authoring.builder import build
from csplat_authoring.coders import deflate_dynamic, deflate_fixed, deflate_stored
from csplat_authoring.recipes.deflate_streams import invalid_streams, valid_streams
from csplat_authoring.samples import scene
from csplat_conformance.manifest import load
from csplat_conformance.validator.inflate import CodedError, Inflater

VECTOR_LIST = load()
INVALID = [vector for vector in VECTOR_LIST if vector.error]
SMALL = build(scene())

#: Vectors whose arrays, at SH degree 3, fill the decoders' default budget.
SPLATS_MAX = _spec.BUDGET_BYTES // (4 * (11 + 48))
SIZE = 2000


def by_zlib(coded, size=SIZE):
    """Return output and bytes read, "refused", or "long" for more output than `size`."""
    inflater = zlib.decompressobj(-15)
    try:
        out = inflater.decompress(coded, size + 1)
    except zlib.error:
        return "refused"
    if len(out) > size:
        return "long"
    return (out, len(coded) - len(inflater.unused_data)) if inflater.eof else "refused"


def by_validator(coded, size=SIZE):
    inflater = Inflater(coded)
    try:
        out = inflater.inflate(size)
    except CodedError:
        return "refused"
    return "long" if len(out) > size else (out, inflater.used)


def damaged(count):
    """Yield streams with a few bits flipped, most of them in the header of the first block."""
    rng = random.Random(1)  # noqa: S311 - damage is no secret
    cases = [case.coded for case in valid_streams() + invalid_streams() if len(case.output) < SIZE]
    text = bytes(rng.choice(b"aaaabbcdefgh") for _ in range(300))
    packers = [zlib.compressobj(9, zlib.DEFLATED, -15, 9, way) for way in (0, 2, 3, 4)]
    texts = [packer.compress(text) + packer.flush() for packer in packers]
    texts += [deflate_dynamic(text), deflate_fixed(text), deflate_stored(text, 90)]
    for _ in range(count):
        coded = bytearray(rng.choice(rng.choice((cases, texts))))
        for _ in range(rng.choice((1, 1, 2, 3))):
            bit = rng.randrange(min(8 * len(coded), rng.choice((40, 120, 3000))))
            coded[bit >> 3] ^= 1 << (bit & 7)
        yield bytes(coded)

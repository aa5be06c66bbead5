"""Faults in blocks, streams and chunks, and what an encoder leaves to chance."""

import os
import random
import time
import zlib

from csplat import _spec
from csplat.encoder import container, entropy, pipeline, sh_codebook, tiling
from encoder_faults.fault import DEGREE_3, PLAIN, EncoderFault, Harm, replaced

CHANCE = (Harm.DETERMINISM, ("L1", ""))
BROKEN = Harm.VALIDITY
OF_CODEBOOK = {"sh_coding": "codebook", "codebook_size": 160}

# Blocks and streams ---------------------------------------------------------------------------------


def swapped_blocks(tile_payload):
    def run(layer, parts):
        order = [0, 2, 1, *range(3, len(parts))] if layer == 0 else range(len(parts))
        return tile_payload(layer, [parts[place] for place in order])

    return run


def with_zlib_header(_deflate):
    return lambda raw, _coding: zlib.compress(raw, 6)


def with_a_tail(deflate):
    return lambda raw, coding: deflate(raw, coding) + b"\0\0"


def reversed_transforms(pack):
    def run(head):
        steps = head.transforms.rstrip(b"\0")
        return pack(head._replace(transforms=steps[::-1].ljust(_spec.TRANSFORMS_MAX, b"\0")))

    return run


def payload_crc(_chunk_crc):
    return lambda _kind, payload: zlib.crc32(payload)


# Chance ---------------------------------------------------------------------------------------------


def seeded_by_chance(cluster):
    return lambda *args, **options: cluster(*args, **{**options, "seed": int.from_bytes(os.urandom(4), "little")})


def with_time(settings):
    return lambda *args: {**settings(*args), "encoded_ns": time.time_ns()}


def summed_in_any_order(stated):
    """Add up what threads measured in the order in which they end: digits differ that nobody looks at.

    They are more than the last bits: so few would be the same by chance once in some hundred runs.
    """

    def run(errors, origin):
        chance = random.SystemRandom().random()
        return {name: (most, rms * (1 + 1e-10 * chance)) for name, (most, rms) in stated(errors, origin).items()}

    return run


FAULTS = {
    "no_tile_limit": EncoderFault(
        "a tile may have any number of splats",
        BROKEN,
        ("L1", "TIL-1"),
        "ordinary/two_tiles",
        stage=replaced(tiling, "cut_tiles", lambda cut: lambda means, lattice, _: cut(means, lattice, len(means))),
        options={"means_coding": "axis"},
    ),
    # blocks and streams
    "morton_axes_reversed": EncoderFault(
        "bit 0 of a Morton code is that of z",
        BROKEN,
        ("L1", "TIL-10"),
        stage=replaced(tiling, "morton_codes", lambda codes: lambda q: codes(q[::-1])),
    ),
    "morton_signed_shift": EncoderFault(
        "codes count bits from 1",
        BROKEN,
        ("L1", "MOR-2"),
        stage=replaced(
            entropy, "morton_block", lambda block: lambda codes, bits, coding: block(codes * 2, bits, coding)
        ),
    ),
    "blocks_swapped": EncoderFault(
        "rotations come before scales",
        BROKEN,
        ("L1", "TLE-2"),
        stage=replaced(pipeline, "tile_payload", swapped_blocks),
    ),
    "zlib_for_deflate": EncoderFault(
        "DEFLATE is what zlib.compress gives",
        BROKEN,
        ("L1", "COD-2"),
        DEGREE_3,
        stage=replaced(entropy, "_deflate", with_zlib_header),
    ),
    "deflate_tail": EncoderFault(
        "an inflate stops by itself",
        BROKEN,
        ("L1", "COD-2"),
        DEGREE_3,
        stage=replaced(entropy, "_deflate", with_a_tail),
    ),
    "transforms_reversed": EncoderFault(
        "transforms are listed as a decoder needs them",
        BROKEN,
        ("L1", "STR-3"),
        stage=replaced(_spec, "pack_stream_head", reversed_transforms),
    ),
    "crc_of_payload": EncoderFault(
        "a chunk's CRC is that of its payload",
        BROKEN,
        ("L1", "CHK-1"),
        stage=replaced(container, "chunk_crc", payload_crc),
    ),
    # chance
    "seed_by_chance": EncoderFault(
        "any start of a k-means is as good as another",
        *CHANCE,
        DEGREE_3,
        stage=replaced(sh_codebook, "cluster", seeded_by_chance),
        options=OF_CODEBOOK,
    ),
    "time_in_options": EncoderFault(
        "a file says when it was made", *CHANCE, PLAIN, stage=replaced(pipeline, "encoding_settings", with_time)
    ),
    "sums_in_any_order": EncoderFault(
        "sums of threads may be added as they come",
        *CHANCE,
        PLAIN,
        stage=replaced(pipeline, "declared_errors", summed_in_any_order),
    ),
}

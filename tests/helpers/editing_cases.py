# SPDX-License-Identifier: Apache-2.0
"""Helpers of the tests of editing, which several files share."""

import io
import math

import numpy as np

import csplat


def extract(data, box):
    stream = io.BytesIO()
    part = csplat.extract(data, box, stream)
    assert part.size_bytes == len(stream.getvalue())
    return part, stream.getvalue()


def box_of(tile, header):
    step = math.ldexp(header.attributes[3].step, tile.exponent)
    far = np.add(tile.corner, tile.extent)
    return [[float(np.float32(n * step)) for n in corner] for corner in (np.array(tile.corner), far)]


STEPS = {
    "position_step": 0.001, "scale_step": 0.05, "opacity_levels": 63, "quat_levels": 127, "sh0_step": 0.02,
    "sh_step": 0.02, "chroma_shift": 1, "means_coding": "axis",
}  # fmt: skip


def merge(*files, **named):
    stream = io.BytesIO()
    done = csplat.merge(files, stream, **named)
    assert done.size_bytes == len(stream.getvalue())
    return done, stream.getvalue()

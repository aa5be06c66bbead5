"""Faults in converting values to integers. Errors are measured afterwards, so the files state them honestly."""

import contextlib
from unittest import mock

import numpy as np

from csplat.encoder import pipeline, quantisation, shape_codebook, tiling
from encoder_faults.fault import DEGREE_3, DENSE, EncoderFault, Harm, replaced

PICTURE = (Harm.PICTURE, ("L4", ""))
COARSE = (Harm.COARSE, ("L3", ""))


# Rotations and scales -------------------------------------------------------------------------------
def no_gauge(_fix):
    """Keep the axis order and make w positive; components beyond ±M are clipped later."""

    def run(quats, scales):
        return (quats * np.where(quats[:, :1] < 0, np.float32(-1), np.float32(1))).T, scales.T

    return run


def sign_of_w_lost(fix):
    """Store x, y, z of quaternions with negative w unchanged, although decoders return a positive w."""

    def run(quats, scales):
        rotation, ordered = fix(quats, scales)
        rotation[1:, quats[:, 0] < 0] *= -1
        return rotation, ordered

    return run


def sorted_alone(fix):
    """Sort the scales without exchanging the axes of the rotation."""

    def run(quats, scales):
        rotation, _ = fix(quats, np.zeros_like(scales))
        return rotation, -np.sort(-scales, axis=1).T

    return run


# Rounding -------------------------------------------------------------------------------------------
class OtherRounding:
    """NumPy with another `rint`."""

    def __init__(self, rint):
        self.rint = rint

    def __getattr__(self, name):
        return getattr(np, name)


def rounding(module, name, rint, where=(quantisation, shape_codebook)):
    """Return a stage that replaces `rint` of some modules while a function runs."""

    def make(function):
        def run(*args, **options):
            with contextlib.ExitStack() as stack:
                for one in where:
                    stack.enter_context(mock.patch.object(one, "np", OtherRounding(rint)))
                return function(*args, **options)

        return run

    return replaced(module, name, make)


def truncated(module, name, where=(quantisation, shape_codebook)):
    stage = rounding(module, name, np.trunc, where)
    return EncoderFault("a cast rounds", *COARSE, DEGREE_3, stage=stage, options={"sh_coding": "scalar", "threads": 1})


# Colours --------------------------------------------------------------------------------------------
def chroma_exchanged(integers):
    def run(*args):
        return integers(*args)[[0, 2, 1]]

    return run


def wrapped(bits):
    """Return a function that keeps the lowest `bits` bits of a signed integer, like a cast."""
    return lambda n: ((n + 2 ** (bits - 1)) % 2**bits) - 2 ** (bits - 1)


def wrapped_means(quantise_means):
    return lambda means, step: wrapped(16)(quantise_means(means, step))


def wrapped_opacities(levels):
    return lambda *args, **options: levels(*args, **options) & 255


FAULTS = {
    # rotations and scales
    "gauge_not_fixed": EncoderFault("w need not be the largest, and components beyond ±M can be clipped", *PICTURE,
        DENSE, stage=replaced(shape_codebook, "canonicalise_shape", no_gauge)),
    "w_sign_lost": EncoderFault("w follows from the unit length, including its sign", *PICTURE, DENSE,
        stage=replaced(shape_codebook, "canonicalise_shape", sign_of_w_lost)),
    "scales_sorted_alone": EncoderFault("scales can be sorted independently of rotations", *PICTURE,
        "ordinary/needles_and_discs", stage=replaced(shape_codebook, "canonicalise_shape", sorted_alone)),
    # rounding
    "means_truncated": truncated(tiling, "quantise_means"),
    "quats_truncated": truncated(shape_codebook, "quat_levels"),
    "all_truncated": truncated(pipeline, "encode_tile"),
    # colours
    "chroma_exchanged": EncoderFault("Cg comes before Co", *PICTURE, DEGREE_3,
        stage=replaced(quantisation, "colour_integers", chroma_exchanged), options={"sh_coding": "scalar"}),
    # range
    "means_wrapped": EncoderFault("16 bits are enough for every centre", Harm.PICTURE, ("L2", "CNF-6"),
        "nasty/outlier", stage=replaced(tiling, "quantise_means", wrapped_means)),
    "opacities_wrapped": EncoderFault("256 levels fit into a byte, including level 256", *PICTURE,
        "ordinary/transparent_and_opaque", stage=replaced(pipeline, "opacity_levels", wrapped_opacities),
        options={"opacity_levels": 256}),
}  # fmt: skip

"""Faults where values become integers. What is stated of them is measured after it: they are honest."""

import contextlib
from unittest import mock

import numpy as np

from csplat.encoder import pipeline, quantisation, sh_codebook, shape_codebook, tiling
from encoder_faults.fault import DEGREE_3, DENSE, EncoderFault, Harm, replaced

PICTURE = (Harm.PICTURE, ("L4", ""))
COARSE = (Harm.COARSE, ("L3", ""))

# Rotations and scales -------------------------------------------------------------------------------


def no_gauge(_fix):
    """Take rotations as they come, w made positive; what leaves ±M is clipped later on."""

    def run(quats, scales):
        return (quats * np.where(quats[:, :1] < 0, np.float32(-1), np.float32(1))).T, scales.T

    return run


def sign_of_w_lost(fix):
    """Store x, y, z; a decoder's w is positive."""

    def run(quats, scales):
        rotation, ordered = fix(quats, scales)
        rotation[1:, quats[:, 0] < 0] *= -1
        return rotation, ordered

    return run


def sorted_alone(fix):
    """Sort the scales, and make w the largest by leaving the rotation as it is where it is already."""

    def run(quats, scales):
        rotation, _ = fix(quats, np.zeros_like(scales))
        return rotation, -np.sort(-scales, axis=1).T

    return run


# Rounding -------------------------------------------------------------------------------------------


class OtherRounding:
    """NumPy, but for how it rounds."""

    def __init__(self, rint):
        self.rint = rint

    def __getattr__(self, name):
        return getattr(np, name)


def half_away(values, out=None):
    return np.multiply(np.sign(values), np.floor(np.abs(values) + 0.5), out=out, dtype=values.dtype)


def rounding(module, name, rint, where=(quantisation, shape_codebook)):
    """Round otherwise while a function runs."""

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


def real_matrix(integers):
    """Take Y, Co, Cg by the matrix, where lifting rounds in between."""

    def run(rgb, shift, coarse=None):
        columns = integers(rgb, shift, coarse)
        r, g, b = rgb.astype(np.float64)
        columns[0] = np.rint(r / 4 + g / 2 + b / 4)
        columns[1], columns[2] = np.rint((r - b) / 2 * 0.5**shift), np.rint((2 * g - r - b) / 4 * 0.5**shift)
        return columns

    return run


def wrapped(bits):
    """Return a function that keeps the lowest `bits` bits of a signed integer, as a cast does."""
    return lambda n: ((n + 2 ** (bits - 1)) % 2**bits) - 2 ** (bits - 1)


def wrapped_means(quantise_means):
    return lambda means, step: wrapped(16)(quantise_means(means, step))


def wrapped_opacities(levels):
    return lambda *args, **options: levels(*args, **options) & 255


FAULTS = {
    # rotations and scales
    "gauge_not_fixed": EncoderFault(
        "w need not be the largest, and what leaves ±M is clipped",
        *PICTURE,
        DENSE,
        stage=replaced(shape_codebook, "canonicalise_shape", no_gauge),
    ),
    "w_sign_lost": EncoderFault(
        "w is what is left of length 1",
        *PICTURE,
        DENSE,
        stage=replaced(shape_codebook, "canonicalise_shape", sign_of_w_lost),
    ),
    "scales_sorted_alone": EncoderFault(
        "the order of scales has nothing to do with rotations",
        *PICTURE,
        "ordinary/needles_and_discs",
        stage=replaced(shape_codebook, "canonicalise_shape", sorted_alone),
    ),
    # rounding
    "means_truncated": truncated(tiling, "quantise_means"),
    "scales_truncated": truncated(pipeline, "quantise_shape", (shape_codebook,)),
    "quats_truncated": truncated(shape_codebook, "quat_levels"),
    "opacities_truncated": truncated(pipeline, "opacity_levels"),
    "sh0_truncated": truncated(pipeline, "quantise_colour"),
    "sh_truncated": truncated(sh_codebook, "quantise_sh"),
    "all_truncated": truncated(pipeline, "encode_tile"),
    "half_away": EncoderFault(
        "halves are rounded away from zero",
        Harm.HARMLESS,
        stage=rounding(pipeline, "encode_tile", half_away),
        options={"threads": 1},
    ),
    # colours
    "chroma_exchanged": EncoderFault(
        "Cg comes before Co",
        *PICTURE,
        DEGREE_3,
        stage=replaced(quantisation, "colour_integers", chroma_exchanged),
        options={"sh_coding": "scalar"},
    ),
    "chroma_by_matrix": EncoderFault(
        "lifting is the matrix of YCoCg",
        *PICTURE,
        DEGREE_3,
        stage=replaced(quantisation, "colour_integers", real_matrix),
        options={"sh_coding": "scalar"},
    ),
    # range
    "means_wrapped": EncoderFault(
        "16 bits hold every centre",
        Harm.PICTURE,
        ("L2", "CNF-6"),
        "nasty/outlier",
        stage=replaced(tiling, "quantise_means", wrapped_means),
    ),
    "opacities_wrapped": EncoderFault(
        "256 levels and a byte for them",
        *PICTURE,
        "ordinary/transparent_and_opaque",
        stage=replaced(pipeline, "opacity_levels", wrapped_opacities),
        options={"opacity_levels": 256},
    ),
}

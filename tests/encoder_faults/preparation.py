"""Faults in preparing a scene for encoding: precision, range, pruning, coordinate frame, metadata."""

import numpy as np

from encoder_faults.fault import DEGREE_3, STRONG, EncoderFault, Harm, as_read, changed, floats, in_binary64

L3 = ("L3", "SER-5")
FAR, INVENTED = ("L2", "CNF-6"), ("L2", "SRC-3")


def merged(model):
    """Drop exact duplicates without counting them as pruned."""
    _, first = np.unique(model.means, axis=0, return_index=True)
    return model.select(np.sort(first))


def clipped(field, most):
    return changed(**{field: lambda m: np.clip(getattr(m, field), np.float32(-most), np.float32(most))})


def half(field):
    """Round values to float16, clipped to its finite range."""
    return changed(**{field: lambda m: np.clip(getattr(m, field), -65504, 65504).astype(np.float16).astype(np.float32)})


def own_origin(model):
    """Choose the median centre as the origin, in doubles, as 4.3 allows."""
    absolute = model.means.astype(np.float64) + model.origin
    middle = tuple(np.median(absolute, axis=0).tolist())
    return changed(means=lambda _: floats(absolute - middle), origin=lambda _: middle)(model)


def with_extra(model):
    return changed(extra=lambda m: {"confidence": m.opacities.copy()})(model)


def reversed_extra(model):
    return changed(extra=lambda m: {name: column[::-1].copy() for name, column in m.extra.items()})(model)


def of_degree_3(model):
    padded = np.zeros((len(model), 15, 3), np.float32)
    padded[:, : model.shN.shape[1]] = model.shN
    return changed(shN=lambda _: padded)(model)


FAULTS = {
    # precision and range
    "half_precision": EncoderFault("float16 is accurate enough, and errors are measured after rounding to it",
        Harm.PICTURE, FAR, "nasty/far_coordinates", scene=half("means")),
    "sh_half_precision": EncoderFault(
        "float16 is accurate enough for SH, and errors are measured after rounding to it", Harm.BOUND, L3, DEGREE_3,
        scene=half("shN")),
    "sh_clipped": EncoderFault("SH lie within ±1", Harm.PICTURE, L3, STRONG, scene=clipped("shN", 1)),
    "sh_clipped_honest": EncoderFault("SH lie within ±1; errors are stated honestly", Harm.PICTURE, ("L4", ""), STRONG,
        scene=clipped("shN", 1), honest=as_read),
    "scales_clipped": EncoderFault("scales lie within ±20", Harm.PICTURE, L3, "nasty/huge_scales",
        scene=clipped("scales", 20)),
    "needles_thickened_honest": EncoderFault(
        "axes thinner than a fiftieth of the longest can be widened; errors are stated honestly", Harm.HARMLESS,
        inputs="ordinary/needles_and_discs",
        scene=changed(scales=lambda m: np.maximum(m.scales, m.scales.max(axis=1, keepdims=True) - np.float32(4))),
        honest=as_read),
    # pruning
    "duplicates_merged": EncoderFault("equal splats can be merged", Harm.PICTURE, ("L2", "SRC-1"), "nasty/duplicates",
        scene=merged),
    "pruned_counted": EncoderFault("nearly transparent splats can be pruned if the file counts them", Harm.HARMLESS,
        keep=lambda m: np.flatnonzero(m.opacities >= 0.02)),
    "pruned_most": EncoderFault("any number of splats may be pruned if the file counts them", Harm.COARSE, ("L2", ""),
        keep=lambda m: np.flatnonzero(m.opacities >= np.quantile(m.opacities, 0.6))),
    "bands_dropped": EncoderFault("degree 1 is enough; errors are stated honestly", Harm.COARSE, ("L3", ""), DEGREE_3,
        options={"sh_degree": 1}),
    "alpha_of_three": EncoderFault("three levels of alpha are enough; errors are stated honestly", Harm.COARSE,
        ("L3", ""), options={"opacity_levels": 2}),
    "coarse": EncoderFault("errors may have any size if they are stated honestly", Harm.PICTURE, ("L4", ""),
        options={"attribute_psnr": 16.0, "sh_coding": "none"}),
    # frame
    "y_and_z_swapped": EncoderFault("z points up", Harm.PICTURE, FAR,
        scene=changed(means=lambda m: np.ascontiguousarray(m.means[:, [0, 2, 1]]))),
    "own_origin": EncoderFault("an encoder may choose the origin", Harm.HARMLESS,
        inputs="ordinary/degree_1,nasty/far_doubles", scene=own_origin, honest=in_binary64),
    # metadata
    "axes_guessed": EncoderFault("every scene is right-down-forward", Harm.FACTS, INVENTED,
        scene=changed(coordinate_system=lambda _: "RDF")),
    "degree_always_3": EncoderFault("every scene has degree 3", Harm.FACTS, INVENTED, scene=of_degree_3),
    "extra_invented": EncoderFault("an additional column does no harm", Harm.FACTS, INVENTED, scene=with_extra,
        options={"keep_extra": True}),
    "extra_garbled": EncoderFault("extra columns need not be sorted with the splats", Harm.FACTS, INVENTED,
        "ordinary/extra_columns", scene=reversed_extra, options={"keep_extra": True}),
}  # fmt: skip

"""Faults in what is made of a scene before it is coded: precision, range, choice, frame, facts."""

import os

import numpy as np

from csplat.model import SplatModel
from encoder_faults.fault import DEGREE_2, DEGREE_3, DENSE, STRONG, EncoderFault, Harm, changed, floats
from encoder_faults.source import as_read, in_binary64

L3 = ("L3", "SER-5")
FAR, INVENTED = ("L2", "CNF-6"), ("L2", "SRC-3")


def merged(model):
    """Drop exact duplicates and say nothing."""
    _, first = np.unique(model.means, axis=0, return_index=True)
    return model.select(np.sort(first))


def clipped(field, most):
    return changed(**{field: lambda m: np.clip(getattr(m, field), np.float32(-most), np.float32(most))})


def half(field):
    """Store values in float16, none of them infinite."""
    return changed(**{field: lambda m: np.clip(getattr(m, field), -65504, 65504).astype(np.float16).astype(np.float32)})


def own_origin(model):
    """Choose an origin in the middle, in doubles, as 4.3 allows."""
    absolute = model.means.astype(np.float64) + model.origin
    middle = tuple(np.median(absolute, axis=0).tolist())
    return changed(means=lambda _: floats(absolute - middle), origin=lambda _: middle)(model)


def origin_not_written(model):
    return changed(means=lambda m: m.means - m.means[0])(model)


def with_extra(model):
    return changed(extra=lambda m: {"confidence": m.opacities.copy()})(model)


def reversed_extra(model):
    return changed(extra=lambda m: {name: column[::-1].copy() for name, column in m.extra.items()})(model)


def of_degree_3(model):
    padded = np.zeros((len(model), 15, 3), np.float32)
    padded[:, : model.shN.shape[1]] = model.shN
    return changed(shN=lambda _: padded)(model)


def by_chance(model):
    """A permutation that comes from outside."""
    return np.argsort(np.frombuffer(os.urandom(8 * len(model)), "<u8"), kind="stable")


def from_a_temporary(model):
    name = f"/tmp/splats-{os.urandom(4).hex()}.ply"  # noqa: S108 - a name, no file
    return changed(metadata=lambda m: {**m.metadata, "source": name})(model)


def mirrored(model: SplatModel) -> SplatModel:
    """Turn y and z around in centres and colours' frame, and leave the rotations."""
    return changed(quats=lambda m: m.quats[:, [1, 0, 3, 2]] * np.float32([-1, 1, -1, 1]))(model)


FAULTS = {
    # precision and range
    "half_precision": EncoderFault(
        "float16 is enough, and errors are measured after it",
        Harm.PICTURE,
        FAR,
        "nasty/far_coordinates",
        scene=half("means"),
    ),
    "sh_half_precision": EncoderFault(
        "float16 is enough for SH, and errors are measured after it", Harm.BOUND, L3, DEGREE_3, scene=half("shN")
    ),
    "sh_half_precision_honest": EncoderFault(
        "the same, and errors are measured from the file",
        Harm.HARMLESS,
        inputs=DEGREE_3,
        scene=half("shN"),
        honest=as_read,
    ),
    "colours_clipped": EncoderFault("colours lie within ±2", Harm.PICTURE, L3, STRONG, scene=clipped("sh0", 2)),
    "colours_clipped_honest": EncoderFault(
        "colours lie within ±1, and errors say so",
        Harm.PICTURE,
        ("L4", ""),
        STRONG,
        scene=clipped("sh0", 1),
        honest=as_read,
    ),
    "sh_clipped": EncoderFault("SH lie within ±1", Harm.PICTURE, L3, STRONG, scene=clipped("shN", 1)),
    "sh_clipped_honest": EncoderFault(
        "SH lie within ±1, and errors say so", Harm.PICTURE, ("L4", ""), STRONG, scene=clipped("shN", 1), honest=as_read
    ),
    "scales_clipped": EncoderFault(
        "scales lie within ±20", Harm.PICTURE, L3, "nasty/huge_scales", scene=clipped("scales", 20)
    ),
    "needles_thickened_honest": EncoderFault(
        "no axis need be thinner than a fiftieth of the longest, and errors say so",
        Harm.HARMLESS,
        inputs="ordinary/needles_and_discs",
        scene=changed(scales=lambda m: np.maximum(m.scales, m.scales.max(axis=1, keepdims=True) - np.float32(4))),
        honest=as_read,
    ),
    # choice
    "duplicates_merged": EncoderFault(
        "equal splats are one", Harm.PICTURE, ("L2", "SRC-1"), "nasty/duplicates", scene=merged
    ),
    "pruned_uncounted": EncoderFault(
        "nobody misses what is nearly transparent",
        Harm.FACTS,
        ("L2", "SRC-1"),
        scene=lambda m: m.select(m.opacities >= 0.1),
    ),
    "pruned_counted": EncoderFault(
        "the same, and the file says how many",
        Harm.HARMLESS,
        keep=lambda m: np.flatnonzero(m.opacities >= 0.02),
    ),
    "pruned_most": EncoderFault(
        "whoever counts what is pruned may prune any",
        Harm.COARSE,
        ("L2", ""),
        keep=lambda m: np.flatnonzero(m.opacities >= np.quantile(m.opacities, 0.6)),
    ),
    "bands_dropped": EncoderFault(
        "degree 1 is enough, and errors say so", Harm.COARSE, ("L3", ""), DEGREE_3, options={"sh_degree": 1}
    ),
    "all_bands_dropped": EncoderFault(
        "colour is sh0, and errors say so", Harm.COARSE, ("L3", ""), DEGREE_2, options={"sh_degree": 0}
    ),
    "alpha_of_three": EncoderFault(
        "three levels of alpha will do, and errors say so", Harm.COARSE, ("L3", ""), options={"opacity_levels": 2}
    ),
    "coarse": EncoderFault(
        "honest errors may be of any size",
        Harm.PICTURE,
        ("L4", ""),
        options={"attribute_psnr": 16.0, "sh_coding": "none"},
    ),
    # frame
    "y_and_z_swapped": EncoderFault(
        "z points up",
        Harm.PICTURE,
        FAR,
        scene=changed(means=lambda m: np.ascontiguousarray(m.means[:, [0, 2, 1]])),
    ),
    "rotations_in_another_frame": EncoderFault(
        "y and z point the other way, and only rotations notice",
        Harm.PICTURE,
        ("L4", ""),
        DENSE,
        scene=mirrored,
        honest=as_read,
    ),
    "origin_not_written": EncoderFault(
        "a viewer centres the scene anyway", Harm.PICTURE, FAR, scene=origin_not_written
    ),
    "origin_not_subtracted": EncoderFault(
        "the origin says where the middle is",
        Harm.PICTURE,
        FAR,
        scene=changed(origin=lambda m: tuple((np.array(m.origin) + m.means.mean(axis=0) + 10.0).tolist())),
    ),
    "own_origin": EncoderFault(
        "an encoder chooses the origin",
        Harm.HARMLESS,
        inputs="ordinary/degree_1,nasty/far_doubles",
        scene=own_origin,
        honest=in_binary64,
    ),
    # facts
    "axes_guessed": EncoderFault(
        "every scene is right-down-forward", Harm.FACTS, INVENTED, scene=changed(coordinate_system=lambda _: "RDF")
    ),
    "unit_guessed": EncoderFault("a unit is a metre", Harm.FACTS, INVENTED, scene=changed(unit_metres=lambda _: 1.0)),
    "antialiased_guessed": EncoderFault(
        "trainers filter nowadays", Harm.FACTS, INVENTED, scene=changed(antialiased=lambda _: True)
    ),
    "flat_guessed": EncoderFault("discs are faster", Harm.FACTS, INVENTED, scene=changed(flat=lambda _: True)),
    "degree_always_3": EncoderFault("every scene has degree 3", Harm.FACTS, INVENTED, scene=of_degree_3),
    "extra_invented": EncoderFault(
        "a column more does no harm", Harm.FACTS, INVENTED, scene=with_extra, options={"keep_extra": True}
    ),
    "extra_garbled": EncoderFault(
        "extra columns need not be sorted with the splats",
        Harm.FACTS,
        INVENTED,
        "ordinary/extra_columns",
        scene=reversed_extra,
        options={"keep_extra": True},
    ),
    # chance
    "order_by_chance": EncoderFault(
        "the order of splats is nobody's business",
        Harm.DETERMINISM,
        ("L1", ""),
        keep=by_chance,
        options={"means_coding": "axis"},
    ),
    "temporary_name_kept": EncoderFault(
        "metadata say what was read", Harm.DETERMINISM, ("L1", ""), scene=from_a_temporary
    ),
}

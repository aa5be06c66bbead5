# SPDX-License-Identifier: CC0-1.0
"""Faults in reading a PLY and preparing the scene: columns, rows, numbers, header, range, frame, metadata."""

from dataclasses import replace

import numpy as np

from csplat.model import normalise_quats
from csplat.ply import columns as ply_columns
from encoder_faults.fault import (
    DEGREE_3,
    DENSE,
    STRONG,
    EncoderFault,
    Harm,
    as_read,
    change_columns,
    change_header,
    changed,
    drop_column,
    floats,
    in_binary64,
    keep_rows,
    read_columns,
    replaced,
)

L3 = ("L3", "SER-5")
QUATS = "ordinary/quaternions,*/*tiny*quat*,*/*huge*quat*,*/*quat*tiny*,*/*quat*huge*"


def coefficient_major(model):
    """Read f_rest as if red, green and blue of a coefficient were adjacent."""
    flat = model.shN.transpose(0, 2, 1).reshape(len(model), -1)
    return np.ascontiguousarray(flat.reshape(model.shN.shape))


def sigmoid(model):
    return floats(1.0 / (1.0 + np.exp(-model.opacities.astype(np.float64))))


def sigmoid_in_single(_alpha):
    return lambda logits: np.float32(1.0) / (np.float32(1.0) + np.exp(-logits.astype(np.float32)))


def identity_where(small):
    """Return a stage that replaces quaternions by the identity if `small` is true of their float32 squared length."""

    def make(_normalise):
        def run(quats):
            single = quats.astype(np.float32)
            with np.errstate(all="ignore"):
                squared = np.square(single).sum(axis=1)
                unit = single / np.sqrt(squared)[:, None]
            unit[small(squared)] = (1.0, 0.0, 0.0, 0.0)
            return normalise_quats(unit)

        return run

    return replaced(ply_columns, "normalise_quats", make)


def absolute_in_single(model):
    return floats(model.means.astype(np.float64) + model.origin)


def five_digits(column):
    return np.array([f"{value:.4e}" for value in column.tolist()]).astype(column.dtype)


def columns_by_place(head, body):
    """Rename the columns to the usual names in their positions."""
    lines = head.split(b"\n")
    at = [i for i, line in enumerate(lines) if line.startswith(b"property")]
    if lines[at[-1]].endswith(b" x"):
        lines[at[0] : at[-1] + 1] = lines[at[0] : at[-1] + 1][::-1]
    return b"\n".join(lines), body


def one_byte_early(head, body):
    """Treat the line feed of CRLF as the first byte of the data."""
    return (head.replace(b"\r\n", b"\n"), b"\n", body[:-1]) if b"\r\n" in head else (head, body)


def faces_forgotten(head, body):
    """Treat the data of an element before the splats as data of the splats."""
    lines, kept, own = head.split(b"\n"), [], True
    for line in lines:
        own = line.startswith(b"element vertex") or (own and not line.startswith(b"element"))
        kept += [line] if own or not line.startswith((b"element", b"property")) else []
    return b"\n".join(kept), body


def counted_by_size(head, body):
    """Compute the number of splats from the size of the file."""
    if b"format ascii" in head:
        return head, body
    count, width = len(read_columns(head + body)), read_columns(head + body).dtype.itemsize
    return head.replace(f"vertex {count}".encode(), f"vertex {len(body) // width}".encode()), body


def whole_bands(data):
    """Drop columns f_rest beyond the last complete band."""
    names = [name for name in read_columns(data).dtype.names if name.startswith("f_rest_")]
    names.sort(key=lambda name: int(name.removeprefix("f_rest_")))
    for name in names[max(k for k in (0, 9, 24, 45) if k <= len(names)) :]:
        data = drop_column(name)(data)
    return data


def little_endian(head, body):
    return head.replace(b"binary_big_endian", b"binary_little_endian"), body


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
    # columns
    "channel_order": EncoderFault("f_rest contains red, green, blue of one coefficient after the other", Harm.PICTURE,
        L3, scene=changed(shN=coefficient_major)),
    "quats_xyzw": EncoderFault("w is the last component", Harm.PICTURE, L3,
        scene=changed(quats=lambda m: np.roll(m.quats, 1, axis=1))),
    "sigmoid_twice": EncoderFault("opacities of a library are logits, too", Harm.PICTURE, L3,
        scene=changed(opacities=sigmoid)),
    "sigmoid_twice_honest": EncoderFault("the same, and errors are measured from the file", Harm.PICTURE, ("L4", ""),
        DENSE, scene=changed(opacities=sigmoid), honest=as_read),
    "scale_not_log": EncoderFault("scales are standard deviations", Harm.PICTURE, L3,
        scene=changed(scales=lambda m: np.exp(m.scales))),
    "rgb_for_sh0": EncoderFault("f_dc is a colour", Harm.PICTURE, L3,
        scene=changed(sh0=lambda m: np.float32(0.5) + np.float32(0.28209479) * m.sh0)),
    "columns_by_place": EncoderFault("columns always have the same order", Harm.PICTURE, ("L2", "CNF-6"),
        "ordinary/column_order", ply=change_header(columns_by_place)),
    "rest_cut_to_bands": EncoderFault("columns f_rest beyond the last complete band can be ignored", Harm.FILES,
        ("L1", ""), "*/*rest*", ply=whole_bands),
    # rotations
    "tiny_quats_identity": EncoderFault("a quaternion whose squared length vanishes in float32 has length 0",
        Harm.PICTURE, L3, QUATS, stage=identity_where(lambda squared: squared < 1e-30)),
    "huge_quats_identity": EncoderFault("a quaternion that gives NaN is invalid", Harm.PICTURE, L3, QUATS,
        stage=identity_where(lambda squared: (squared == 0.0) | ~np.isfinite(squared))),
    # rows
    "last_splat_dropped": EncoderFault("the header counts one splat too many", Harm.PICTURE, ("L2", "SRC-1"),
        scene=lambda model: model.select(slice(0, -1))),
    "nan_as_zero": EncoderFault("NaN can be read as 0", Harm.PICTURE, ("L2", "SRC-1"), "nasty/not_a_number",
        ply=change_columns("", lambda column: np.where(np.isnan(column), 0, column))),
    "zero_quats_dropped": EncoderFault("a splat without a rotation can be dropped", Harm.PICTURE, ("L2", "SRC-1"),
        "nasty/zero_quaternion", ply=keep_rows(lambda columns: columns["rot_0"] != 0)),
    "infinite_logits_dropped": EncoderFault("all rows with infinite numbers are dropped", Harm.PICTURE,
        ("L2", "SRC-1"), "nasty/infinite_logits", ply=keep_rows(lambda columns: np.isfinite(columns["opacity"]))),
    "flat_splats_dropped": EncoderFault("a row with a scale of -inf is no splat", Harm.PICTURE, ("L2", "SRC-1"),
        "nasty/infinite_scales", ply=keep_rows(lambda columns: np.isfinite(columns["scale_2"]))),
    "trailing_bytes_read": EncoderFault("the number of splats follows from the size of the file", Harm.FACTS,
        ("L2", "CNF-6"), "*/*trailing*", ply=change_header(counted_by_size)),
    # numbers
    "big_endian_ignored": EncoderFault("every PLY is little-endian", Harm.PICTURE, ("L2", "CNF-6"),
        "ordinary/big_endian", ply=change_header(little_endian)),
    "text_of_five_digits": EncoderFault("%g is enough for a float", Harm.BOUND, L3, "ordinary/ascii",
        ply=change_columns("", five_digits)),
    "doubles_as_single": EncoderFault("all columns are floats", Harm.PICTURE, ("L2", "CNF-6"), "nasty/far_doubles",
        scene=changed(means=absolute_in_single, origin=lambda _: (0.0, 0.0, 0.0))),
    "sigmoid_in_single": EncoderFault("float32 is accurate enough for a logistic function", Harm.HARMLESS,
        stage=replaced(ply_columns, "alpha_of_logits", sigmoid_in_single)),
    "logits_clipped": EncoderFault("logits beyond 10 can be clipped to 10", Harm.HARMLESS,
        inputs="ordinary/transparent_and_opaque",
        ply=change_columns("opacity", lambda column: np.clip(column, -10, 10)), honest=as_read),
    # header
    "crlf_header": EncoderFault("the data begin one byte after end_header", Harm.PICTURE, ("L2", "CNF-6"), "*/*crlf*",
        ply=change_header(one_byte_early)),
    "face_element_first": EncoderFault("splats are the first element of a PLY", Harm.PICTURE, ("L2", "CNF-6"),
        "*/*face*", ply=change_header(faces_forgotten)),
    # precision and range
    "half_precision": EncoderFault("float16 is accurate enough, and errors are measured after rounding to it",
        Harm.PICTURE, FAR, "nasty/far_coordinates", scene=half("means")),
    "sh_half_precision": EncoderFault(
        "float16 is accurate enough for SH, and errors are measured after rounding to it", Harm.BOUND, L3, DEGREE_3,
        scene=half("shN")),
    "sh_clipped": EncoderFault("SH lie within ±1", Harm.PICTURE, L3, STRONG, scene=clipped("shN", 1)),
    "sh_clipped_honest": EncoderFault("SH lie within ±1; errors are declared honestly", Harm.PICTURE, ("L4", ""),
        STRONG, scene=clipped("shN", 1), honest=as_read),
    "scales_clipped": EncoderFault("scales lie within ±20", Harm.PICTURE, L3, "nasty/huge_scales",
        scene=clipped("scales", 20)),
    "needles_thickened_honest": EncoderFault(
        "axes thinner than a fiftieth of the longest can be widened; errors are declared honestly", Harm.HARMLESS,
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
    "bands_dropped": EncoderFault("degree 1 is enough; errors are declared honestly", Harm.COARSE, ("L3", ""), DEGREE_3,
        options={"sh_degree": 1}),
    "alpha_of_three": EncoderFault("three levels of alpha are enough; errors are declared honestly", Harm.COARSE,
        ("L3", ""), options={"opacity_levels": 2}),
    "coarse": EncoderFault("errors may have any size if they are declared honestly", Harm.PICTURE, ("L4", ""),
        options={"attribute_psnr": 16.0, "sh_coding": "none"}),
    # frame
    "y_and_z_swapped": EncoderFault("z points up", Harm.PICTURE, FAR,
        scene=changed(means=lambda m: np.ascontiguousarray(m.means[:, [0, 2, 1]]))),
    "own_origin": EncoderFault("an encoder may choose the origin", Harm.HARMLESS,
        inputs="ordinary/degree_1,nasty/far_doubles", scene=own_origin, honest=in_binary64),
    # metadata
    "axes_guessed": EncoderFault("every scene is right-down-forward", Harm.FACTS, INVENTED,
        scene=changed(metadata=lambda m: replace(m.metadata, coordinate_system="RDF"))),
    "degree_always_3": EncoderFault("every scene has degree 3", Harm.FACTS, INVENTED, scene=of_degree_3),
    "extra_invented": EncoderFault("an additional column does no harm", Harm.FACTS, INVENTED, scene=with_extra,
        options={"keep_extra": True}),
    "extra_garbled": EncoderFault("extra columns need not be sorted with the splats", Harm.FACTS, INVENTED,
        "ordinary/extra_columns", scene=reversed_extra, options={"keep_extra": True}),
}  # fmt: skip

"""Faults in reading a PLY: columns, rows, numbers, header."""

import io

import numpy as np

from csplat import ply
from csplat.model import normalise_quats
from csplat.ply import columns as ply_columns
from encoder_faults import source
from encoder_faults.fault import DENSE, EncoderFault, Harm, changed, floats, replaced
from encoder_faults.source import as_read

QUATS = "ordinary/quaternions,*/*tiny*quat*,*/*huge*quat*,*/*quat*tiny*,*/*quat*huge*"


def coefficient_major(model):
    """Read f_rest as if red, green and blue of a coefficient stood together."""
    flat = model.shN.transpose(0, 2, 1).reshape(len(model), -1)
    return np.ascontiguousarray(flat.reshape(model.shN.shape))


def not_normalised(model):
    """Take x, y, z of a quaternion of length 1.6 as they are, and w from what is left."""
    vector = 1.6 * model.quats[:, 1:].astype(np.float64)
    w = np.sqrt(np.maximum(0.0, 1.0 - np.square(vector).sum(axis=1, keepdims=True)))
    return normalise_quats(np.concatenate([w, vector], axis=1).astype(np.float32))


def logits(model):
    alpha = np.clip(model.opacities.astype(np.float64), 1e-9, 1.0 - 1e-9)
    return np.clip(np.log(alpha / (1.0 - alpha)), 0.0, 1.0).astype(np.float32)


def sigmoid(model):
    return floats(1.0 / (1.0 + np.exp(-model.opacities.astype(np.float64))))


def sigmoid_in_single(_alpha):
    return lambda logits: np.float32(1.0) / (np.float32(1.0) + np.exp(-logits.astype(np.float32)))


def without_band_sign(model):
    changed_sign = model.shN.copy()
    changed_sign[:, :3] *= -1.0
    return changed_sign


def identity_where(small):
    """Return a normalisation that takes quaternions for the identity where their squares, in float32, say so."""

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


def in_half(quats):
    half = quats.astype(np.float16)
    return normalise_quats((half / np.sqrt(np.square(half).sum(axis=1, keepdims=True))).astype(np.float32))


def absolute_in_single(model):
    return floats(model.means.astype(np.float64) + model.origin)


def five_digits(column):
    return np.array([f"{value:.4e}" for value in column.tolist()]).astype(column.dtype)


def columns_by_place(head, body):
    """Give the columns the names that they usually have at their place."""
    lines = head.split(b"\n")
    at = [i for i, line in enumerate(lines) if line.startswith(b"property")]
    if lines[at[-1]].endswith(b" x"):
        lines[at[0] : at[-1] + 1] = lines[at[0] : at[-1] + 1][::-1]
    return b"\n".join(lines), body


def one_byte_early(head, body):
    """Take the line feed of CRLF for the first byte of the data."""
    return (head.replace(b"\r\n", b"\n"), b"\n", body[:-1]) if b"\r\n" in head else (head, body)


def faces_forgotten(head, body):
    """Take the data of another element, which come first, for the splats' data."""
    lines, kept, own = head.split(b"\n"), [], True
    for line in lines:
        own = line.startswith(b"element vertex") or (own and not line.startswith(b"element"))
        kept += [line] if own or not line.startswith((b"element", b"property")) else []
    return b"\n".join(kept), body


def counted_by_size(head, body):
    """Let the size of the file say how many splats there are."""
    if b"format ascii" in head:
        return head, body
    count, width = len(source.parsed(head + body)), source.parsed(head + body).dtype.itemsize
    return head.replace(f"vertex {count}".encode(), f"vertex {len(body) // width}".encode()), body


def whole_bands(data):
    """Take as many columns f_rest as make whole bands."""
    names = [name for name in source.parsed(data).dtype.names if name.startswith("f_rest_")]
    names.sort(key=lambda name: int(name.removeprefix("f_rest_")))
    for name in names[max(k for k in (0, 9, 24, 45) if k <= len(names)) :]:
        data = source.without(name)(data)
    return data


def little_endian(head, body):
    return head.replace(b"binary_big_endian", b"binary_little_endian"), body


def as_text(read):
    """Read through lines of text with six digits, as `np.savetxt` writes them."""

    def run(path, **options):
        model = read(path, **options)
        text = io.StringIO()
        np.savetxt(text, model.means, "%.6g")
        text.seek(0)
        return changed(means=lambda m: floats(np.loadtxt(text).reshape(m.means.shape)))(model)

    return run


L3 = ("L3", "SER-5")
FAULTS = {
    # columns
    "channel_order": EncoderFault(
        "f_rest holds red, green, blue of one coefficient after the other",
        Harm.PICTURE,
        L3,
        scene=changed(shN=coefficient_major),
    ),
    "quats_xyzw": EncoderFault(
        "w is the last component", Harm.PICTURE, L3, scene=changed(quats=lambda m: np.roll(m.quats, 1, axis=1))
    ),
    "logit_as_alpha": EncoderFault("the column opacity holds alpha", Harm.PICTURE, L3, scene=changed(opacities=logits)),
    "sigmoid_twice": EncoderFault(
        "a library's opacities are logits, too", Harm.PICTURE, L3, scene=changed(opacities=sigmoid)
    ),
    "sigmoid_twice_honest": EncoderFault(
        "the same, and errors are measured from the file",
        Harm.PICTURE,
        ("L4", ""),
        DENSE,
        scene=changed(opacities=sigmoid),
        honest=as_read,
    ),
    "scale_not_log": EncoderFault(
        "scales are standard deviations", Harm.PICTURE, L3, scene=changed(scales=lambda m: np.exp(m.scales))
    ),
    "band_sign": EncoderFault("band 1 has the other sign", Harm.PICTURE, L3, scene=changed(shN=without_band_sign)),
    "rgb_for_sh0": EncoderFault(
        "f_dc is a colour",
        Harm.PICTURE,
        L3,
        scene=changed(sh0=lambda m: np.float32(0.5) + np.float32(0.28209479) * m.sh0),
    ),
    "columns_by_place": EncoderFault(
        "columns stand where they always stand",
        Harm.PICTURE,
        ("L2", "CNF-6"),
        "ordinary/column_order",
        ply=source.header(columns_by_place),
    ),
    "rest_cut_to_bands": EncoderFault(
        "columns f_rest beyond the last whole band do not count",
        Harm.FILES,
        ("L1", ""),
        "*/*rest*",
        ply=whole_bands,
    ),
    # rotations
    "quats_not_normalised": EncoderFault(
        "quaternions in a PLY are unit length", Harm.PICTURE, L3, scene=changed(quats=not_normalised)
    ),
    "rotation_conjugated": EncoderFault(
        "a quaternion turns the world, not the splat",
        Harm.PICTURE,
        L3,
        scene=changed(quats=lambda m: m.quats * np.float32([1, -1, -1, -1])),
    ),
    "rotation_conjugated_honest": EncoderFault(
        "the same, and errors are measured from the file",
        Harm.PICTURE,
        ("L4", ""),
        DENSE,
        scene=changed(quats=lambda m: m.quats * np.float32([1, -1, -1, -1])),
        honest=as_read,
    ),
    "quats_half_precision": EncoderFault(
        "a rotation can be normalised in float16",
        Harm.BOUND,
        L3,
        scene=changed(quats=lambda m: in_half(m.quats)),
    ),
    "tiny_quats_identity": EncoderFault(
        "a quaternion whose squares vanish in float32 has length 0",
        Harm.PICTURE,
        L3,
        QUATS,
        stage=identity_where(lambda squared: squared < 1e-30),
    ),
    "huge_quats_identity": EncoderFault(
        "a quaternion that gives NaN is none",
        Harm.PICTURE,
        L3,
        QUATS,
        stage=identity_where(lambda squared: (squared == 0.0) | ~np.isfinite(squared)),
    ),
    # rows
    "last_splat_dropped": EncoderFault(
        "the header counts one splat too many",
        Harm.PICTURE,
        ("L2", "SRC-1"),
        scene=lambda model: model.select(slice(0, -1)),
    ),
    "nan_as_zero": EncoderFault(
        "what is not a number is 0",
        Harm.PICTURE,
        ("L2", "SRC-1"),
        "nasty/not_a_number",
        ply=source.each("", lambda column: np.where(np.isnan(column), 0, column)),
    ),
    "zero_quats_dropped": EncoderFault(
        "a splat without a rotation is none",
        Harm.PICTURE,
        ("L2", "SRC-1"),
        "nasty/zero_quaternion",
        ply=source.kept(lambda columns: columns["rot_0"] != 0),
    ),
    "infinite_logits_dropped": EncoderFault(
        "whatever is not finite is dropped",
        Harm.PICTURE,
        ("L2", "SRC-1"),
        "nasty/infinite_logits",
        ply=source.kept(lambda columns: np.isfinite(columns["opacity"])),
    ),
    "infinite_scales_kept": EncoderFault(
        "a scale of -inf is the smallest that float32 holds",
        Harm.FACTS,
        ("L2", "SRC-1"),
        "nasty/*inf*scale*,nasty/*scale*inf*,nasty/flat*",
        ply=source.each("scale_", lambda column: np.maximum(column, -88)),
    ),
    "trailing_bytes_read": EncoderFault(
        "the size of the file says how many splats there are",
        Harm.FACTS,
        ("L2", "CNF-6"),
        "*/*trailing*",
        ply=source.header(counted_by_size),
    ),
    # numbers
    "big_endian_ignored": EncoderFault(
        "every PLY is little-endian",
        Harm.PICTURE,
        ("L2", "CNF-6"),
        "ordinary/big_endian",
        ply=source.header(little_endian),
    ),
    "text_of_five_digits": EncoderFault(
        "%g is enough for a float", Harm.BOUND, L3, "ordinary/ascii", ply=source.each("", five_digits)
    ),
    "six_digits": EncoderFault(
        "positions can go through a text file",
        Harm.BOUND,
        L3,
        "nasty/far_coordinates",
        stage=replaced(ply, "read_ply", as_text),
    ),
    "doubles_as_single": EncoderFault(
        "all columns are floats",
        Harm.PICTURE,
        ("L2", "CNF-6"),
        "nasty/far_doubles",
        scene=changed(means=absolute_in_single, origin=lambda _: (0.0, 0.0, 0.0)),
    ),
    "sigmoid_in_single": EncoderFault(
        "float32 is enough for a logistic function",
        Harm.HARMLESS,
        stage=replaced(ply_columns, "alpha_of_logits", sigmoid_in_single),
    ),
    "logits_clipped": EncoderFault(
        "logits beyond 10 look like 10",
        Harm.HARMLESS,
        inputs="ordinary/transparent_and_opaque",
        ply=source.each("opacity", lambda column: np.clip(column, -10, 10)),
        honest=as_read,
    ),
    # header
    "crlf_header": EncoderFault(
        "data begin one byte after the word end_header",
        Harm.PICTURE,
        ("L2", "CNF-6"),
        "*/*crlf*",
        ply=source.header(one_byte_early),
    ),
    "face_element_first": EncoderFault(
        "splats are the first element of a PLY",
        Harm.PICTURE,
        ("L2", "CNF-6"),
        "*/*face*",
        ply=source.header(faces_forgotten),
    ),
}

"""Faults in what a file states of its errors, of its source, and of what it leaves out."""

import contextlib
from unittest import mock

import numpy as np

from csplat import _spec, ply
from csplat.encoder import encode_plan, error_bounds, pipeline
from encoder_faults.fault import DEGREE_3, DENSE, PLAIN, STRONG, EncoderFault, Harm, changed, replaced
from encoder_faults.file_bytes import counts, head, refitted, stated
from encoder_faults.ply_reader import without_band_sign
from encoder_faults.source import in_binary64

MEASURES = ("means", "covariance", "opacities", "sh0", "sh1", "sh2", "sh3")
COMPONENTS = {"sh0": 3, "sh1": 9, "sh2": 15, "sh3": 21}
L3 = ("L3", "SER-5")


def told(change):
    """Return a stage change: what is stated, by measure, is made of what would be."""
    return replaced(pipeline, "declared_errors", lambda states: lambda errors, origin: change(states(errors, origin)))


def scaled(only, kind, factor):
    """State one number of one measure, or of all, by a factor."""

    def run(bounds):
        return {
            name: (
                most * (factor if kind == "max" and name in only else 1.0),
                rms * (factor if kind == "rms" and name in only else 1.0),
            )
            for name, (most, rms) in bounds.items()
        }

    return told(run)


def in_single(_errors):
    """Measure in float32, sums and all."""

    def run(source, decoded):
        difference = decoded.astype(np.float32) - source.astype(np.float32)
        squares = np.square(difference)
        return float(np.abs(difference).max(initial=0.0)), float(np.add.accumulate(squares.reshape(-1))[-1])

    return run


def by_axis(distance):
    def run(source, decoded):
        _, squares = distance(source, decoded)
        return float(np.abs(decoded.astype(np.float64) - source).max()), squares

    return run


def not_relative(_errors):
    """Leave ‖Σj‖ out, but for the largest variance."""

    def run(source_quats, source_scales, quats, scales):
        wide = np.clip(source_scales, -88, 88).astype(np.float64)
        top = wide.max(axis=0)
        ours = error_bounds.covariance_entries(quats, np.exp(2.0 * (np.clip(scales, -88, 88) - top)))
        squared = np.square(ours - error_bounds.covariance_entries(source_quats, np.exp(2.0 * (wide - top))))
        squared[3:] *= 2.0
        return float(np.sqrt(squared.sum(axis=0).max())), float(squared.sum())

    return run


def with_w_of_the_source(errors):
    """Measure with the rotation's x, y, z as quantised and w as it was."""

    def run(source_quats, source_scales, quats, scales):
        mixed = quats.astype(np.float64)
        mixed[0] *= 1.0 + 1e-3
        return errors(source_quats, source_scales, mixed, scales)

    return run


def over_components(bounds):
    return {name: (most, rms / COMPONENTS.get(name, 1) ** 0.5) for name, (most, rms) in bounds.items()}


def over_the_source(states):
    """Divide by the splats of the source, pruned ones among them."""

    def run(errors, origin):
        share = (errors.count / origin.source_count) ** 0.5
        return {name: (most, rms * share) for name, (most, rms) in states(errors, origin).items()}

    return run


@contextlib.contextmanager
def dropped_rows_counted():
    """Count rows that the reader drops as splats that were pruned."""
    findings, read, pack = [], ply.read_ply, _spec.pack_stated_errors_head

    def with_dropped(head):
        count = sum(one.count for one in findings if one.id == "nonfinite-rows")
        return pack(head._replace(source_count=head.source_count + count, pruned_count=head.pruned_count + count))

    with (
        mock.patch.object(ply, "read_ply", lambda path, **options: read(path, report=findings, **options)),
        mock.patch.object(_spec, "pack_stated_errors_head", with_dropped),
    ):
        yield


def without_chunk(chunks):
    return lambda *args: [one for one in chunks(*args) if one.type != _spec.CHUNK_STATED_ERRORS]


def none_of(*names):
    return told(lambda bounds: {name: pair for name, pair in bounds.items() if name not in names})


@contextlib.contextmanager
def scales_without_bound():
    with mock.patch.object(error_bounds, "SCALE_MOST", 340.0), mock.patch.object(encode_plan, "SCALE_MOST", 340.0):
        yield


def one_number_less(measure_name, kind):
    words = {"max": "the largest error of a sample is the largest", "rms": "a sample says what the mean is"}
    return EncoderFault(words[kind], Harm.BOUND, L3, DEGREE_3, stage=scaled((measure_name,), kind, 0.99))


FAULTS = {
    # a little less, a little more
    **{f"{name}_{kind}_understated": one_number_less(name, kind) for name in MEASURES for kind in ("max", "rms")},
    "max_overstated": EncoderFault(
        "one percent more is on the safe side", Harm.BOUND, L3, DEGREE_3, stage=scaled(MEASURES, "max", 1.01)
    ),
    "rms_overstated": EncoderFault(
        "one percent more is on the safe side", Harm.BOUND, L3, DEGREE_3, stage=scaled(MEASURES, "rms", 1.01)
    ),
    "rounded_up": EncoderFault(
        "SER-5 leaves one part in ten thousand",
        Harm.HARMLESS,
        inputs=DEGREE_3,
        stage=told(lambda bounds: {name: (most * 1.00009, rms * 1.00009) for name, (most, rms) in bounds.items()}),
    ),
    "binary64_errors": EncoderFault(
        "errors are those of alpha and rotations that nobody rounded",
        Harm.HARMLESS,
        inputs=f"{DEGREE_3},ordinary/quaternions,ordinary/transparent_and_opaque",
        honest=in_binary64,
    ),
    "binary64_errors_fine": EncoderFault(
        "the same, with as many levels as there may be",
        Harm.HARMLESS,
        inputs=f"{DEGREE_3},ordinary/quaternions,ordinary/transparent_and_opaque",
        honest=in_binary64,
        options={"opacity_levels": _spec.OPACITY_LEVELS_MAX, "quat_levels": _spec.QUAT_LEVELS_MAX, "scale_step": 1e-5},
    ),
    "max_halved": EncoderFault(
        "an error of rounding is half a step",
        Harm.BOUND,
        L3,
        data=stated(lambda r: r._replace(max=r.max / 2, rms=r.rms / 2)),
    ),
    "rms_too_generous": EncoderFault(
        "a bound may be generous", Harm.BOUND, L3, data=stated(lambda r: r._replace(max=r.max * 1.5))
    ),
    # measured otherwise
    "measured_in_single": EncoderFault(
        "float32 is enough to measure",
        Harm.BOUND,
        L3,
        f"{DEGREE_3},ordinary/plane",
        stage=replaced(pipeline, "value_errors", in_single),
    ),
    "stated_in_single": EncoderFault(
        "an error can be a float32, rounded to the nearest",
        Harm.BOUND,
        L3,
        f"{DEGREE_3},{PLAIN}",
        data=stated(lambda r: r._replace(max=float(np.float32(r.max)), rms=float(np.float32(r.rms)))),
    ),
    "means_by_axis": EncoderFault(
        "max is over components, of means too", Harm.BOUND, L3, stage=replaced(pipeline, "distance_errors", by_axis)
    ),
    "covariance_not_relative": EncoderFault(
        "the error of a covariance is that of its entries",
        Harm.BOUND,
        L3,
        stage=replaced(pipeline, "covariance_errors", not_relative),
    ),
    "covariance_not_clipped": EncoderFault(
        "scales need no bound",
        Harm.BOUND,
        L3,
        "nasty/*scale*",
        stage=scales_without_bound,
    ),
    "covariance_not_normalised": EncoderFault(
        "w of the source is as good as the decoded one",
        Harm.BOUND,
        L3,
        inputs=f"{DEGREE_3},{STRONG}",
        stage=replaced(pipeline, "covariance_errors", with_w_of_the_source),
    ),
    "rms_over_components": EncoderFault("a mean is over all numbers", Harm.BOUND, L3, stage=told(over_components)),
    "rms_over_source": EncoderFault(
        "a mean is over all splats that there were",
        Harm.BOUND,
        L3,
        keep=lambda m: np.flatnonzero(m.opacities >= 0.5),
        stage=replaced(pipeline, "declared_errors", over_the_source),
    ),
    # statements about the source
    "pruned_invented": EncoderFault("counts are decoration", Harm.FACTS, ("L2", "SRC-1"), data=counts(3, 3)),
    "nan_rows_counted": EncoderFault(
        "rows with NaN are splats that were pruned",
        Harm.FACTS,
        ("L2", "SRC-1"),
        "nasty/not_a_number",
        stage=dropped_rows_counted,
    ),
    "degree_of_the_file": EncoderFault(
        "the source's SH degree is the file's",
        Harm.FACTS,
        ("L2", "SER-5"),
        DEGREE_3,
        options={"sh_degree": 1},
        stage=none_of("sh2", "sh3"),
        data=head(source_sh_degree=lambda _: 1),
    ),
    # not stated
    "refitted_halved": EncoderFault(
        "of what was fitted anew any error may be stated",
        Harm.BOUND,
        ("L3", "SER-5"),
        data=lambda data: refitted(stated(lambda r: r._replace(max=r.max / 2, rms=r.rms / 2))(data)),
    ),
    "refitted_claimed": EncoderFault(
        "whoever says that colours were fitted anew may write any",
        Harm.PICTURE,
        ("L4", ""),
        scene=changed(sh0=lambda m: m.sh0[:, ::-1].copy()),
        stage=none_of("sh0", "sh1"),
        data=refitted,
    ),
    "refitted_rotations": EncoderFault(
        "the flag is for rotations, too",
        Harm.PICTURE,
        ("L4", ""),
        DENSE,
        scene=changed(quats=lambda m: m.quats * np.float32([1, -1, -1, -1])),
        stage=none_of("covariance"),
        data=refitted,
    ),
    "errors_left_out": EncoderFault(
        "what nothing is stated of may be anything",
        Harm.PICTURE,
        ("L4", ""),
        DEGREE_3,
        scene=changed(shN=without_band_sign),
        stage=replaced(pipeline, "file_chunks", without_chunk),
    ),
    "some_errors_left_out": EncoderFault(
        "the others are stated",
        Harm.PICTURE,
        ("L3", "SER-6"),
        DEGREE_3,
        scene=changed(shN=without_band_sign),
        stage=none_of("sh1", "sh2", "sh3"),
    ),
}

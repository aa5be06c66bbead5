"""Faults in the errors that a file states, in its statements about the source, and in omitted statements."""

import contextlib
from unittest import mock

import numpy as np

from csplat import _spec, ply
from csplat.encoder import encode_plan, error_bounds, pipeline
from encoder_faults.fault import DEGREE_3, EncoderFault, Harm, changed, in_binary64, replaced
from encoder_faults.file_bytes import counts, head, refitted, stated

MEASURES = ("means", "covariance", "opacities", "sh0", "sh1", "sh2", "sh3")
#: Other faults understate the other numbers.
UNDERSTATED = (("means", "rms"), ("opacities", "max"), ("sh2", "max"), ("sh3", "rms"))
COMPONENTS = {"sh0": 3, "sh1": 9, "sh2": 15, "sh3": 21}
L3 = ("L3", "SER-5")


def restated(change):
    """Return a stage in which `change` maps the stated errors by measure to those to state instead."""
    return replaced(pipeline, "declared_errors", lambda states: lambda errors, origin: change(states(errors, origin)))


def scaled(only, kind, factor):
    """Return a stage that multiplies the max or the rms of some measures by a factor."""

    def run(bounds):
        return {
            name: (
                most * (factor if kind == "max" and name in only else 1.0),
                rms * (factor if kind == "rms" and name in only else 1.0),
            )
            for name, (most, rms) in bounds.items()
        }

    return restated(run)


def in_single(_errors):
    """Compute differences and sums in float32."""

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
    """Divide by the largest variance instead of ‖Σj‖."""

    def run(source_quats, source_scales, quats, scales):
        wide = np.clip(source_scales, -88, 88).astype(np.float64)
        top = wide.max(axis=0)
        ours = error_bounds.covariance_entries(quats, np.exp(2.0 * (np.clip(scales, -88, 88) - top)))
        squared = np.square(ours - error_bounds.covariance_entries(source_quats, np.exp(2.0 * (wide - top))))
        squared[3:] *= 2.0
        return float(np.sqrt(squared.sum(axis=0).max())), float(squared.sum())

    return run


def over_components(bounds):
    return {name: (most, rms / COMPONENTS.get(name, 1) ** 0.5) for name, (most, rms) in bounds.items()}


@contextlib.contextmanager
def dropped_rows_counted():
    """Count rows that the reader drops as pruned splats."""
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


def without_band_sign(model):
    changed_sign = model.shN.copy()
    changed_sign[:, :3] *= -1.0
    return changed_sign


def none_of(*names):
    return restated(lambda bounds: {name: pair for name, pair in bounds.items() if name not in names})


@contextlib.contextmanager
def scales_without_bound():
    with mock.patch.object(error_bounds, "SCALE_MOST", 340.0), mock.patch.object(encode_plan, "SCALE_MOST", 340.0):
        yield


def one_number_less(measure_name, kind):
    words = {"max": "the maximum of a sample is the maximum", "rms": "the mean of a sample is the mean"}
    return EncoderFault(words[kind], Harm.BOUND, L3, DEGREE_3, stage=scaled((measure_name,), kind, 0.99))


FAULTS = {
    # slightly too small or too large
    **{f"{name}_{kind}_understated": one_number_less(name, kind) for name, kind in UNDERSTATED},
    "max_overstated": EncoderFault("one percent more is on the safe side", Harm.BOUND, L3, DEGREE_3,
        stage=scaled(MEASURES, "max", 1.01)),
    "rms_overstated": EncoderFault("one percent more is on the safe side", Harm.BOUND, L3, DEGREE_3,
        stage=scaled(MEASURES, "rms", 1.01)),
    "rounded_up": EncoderFault("SER-5 permits an excess of one part in ten thousand", Harm.HARMLESS, inputs=DEGREE_3,
        stage=restated(lambda bounds: {name: (most * 1.00009, rms * 1.00009) for name, (most, rms) in bounds.items()})),
    "binary64_errors_fine": EncoderFault(
        "errors may be computed from alpha and rotations that are not rounded, even with the finest levels",
        Harm.HARMLESS, inputs=f"{DEGREE_3},ordinary/quaternions,ordinary/transparent_and_opaque", honest=in_binary64,
        options={"opacity_levels": _spec.OPACITY_LEVELS_MAX, "quat_levels": _spec.QUAT_LEVELS_MAX, "scale_step": 1e-5}),
    # other ways to measure
    "measured_in_single": EncoderFault("float32 is accurate enough to measure errors", Harm.BOUND, L3,
        f"{DEGREE_3},ordinary/plane", stage=replaced(pipeline, "value_errors", in_single)),
    "means_by_axis": EncoderFault("max is over components, of means too", Harm.BOUND, L3,
        stage=replaced(pipeline, "distance_errors", by_axis)),
    "covariance_not_relative": EncoderFault("the error of a covariance is that of its entries", Harm.BOUND, L3,
        stage=replaced(pipeline, "covariance_errors", not_relative)),
    "covariance_not_clipped": EncoderFault("scales need no bound", Harm.BOUND, L3, "nasty/*scale*",
        stage=scales_without_bound),
    "rms_over_components": EncoderFault("a mean is over all numbers", Harm.BOUND, L3, stage=restated(over_components)),
    # statements about the source
    "pruned_invented": EncoderFault("counts do not matter", Harm.FACTS, ("L2", "SRC-1"), data=counts(3, 3)),
    "nan_rows_counted": EncoderFault("rows with NaN are pruned splats", Harm.FACTS, ("L2", "SRC-1"),
        "nasty/not_a_number", stage=dropped_rows_counted),
    "degree_of_the_file": EncoderFault("the source's SH degree is the file's", Harm.FACTS, ("L2", "SER-5"), DEGREE_3,
        options={"sh_degree": 1}, stage=none_of("sh2", "sh3"), data=head(source_sh_degree=lambda _: 1)),
    # omitted statements
    "refitted_halved": EncoderFault("any error may be stated for refitted attributes", Harm.BOUND, ("L3", "SER-5"),
        data=lambda data: refitted(stated(lambda r: r._replace(max=r.max / 2, rms=r.rms / 2))(data))),
    "refitted_claimed": EncoderFault("with REFITTED, colours may have any values", Harm.PICTURE, ("L4", ""),
        scene=changed(sh0=lambda m: m.sh0[:, ::-1].copy()), stage=none_of("sh0", "sh1"), data=refitted),
    "errors_left_out": EncoderFault("without stated errors, values may be arbitrary", Harm.PICTURE, ("L4", ""),
        DEGREE_3, scene=changed(shN=without_band_sign), stage=replaced(pipeline, "file_chunks", without_chunk)),
    "some_errors_left_out": EncoderFault("some of the errors may be omitted", Harm.PICTURE, ("L3", "SER-6"), DEGREE_3,
        scene=changed(shN=without_band_sign), stage=none_of("sh1", "sh2", "sh3")),
}  # fmt: skip

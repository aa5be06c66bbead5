"""Check SERR, the declared error bounds (spec 5.5)."""

from __future__ import annotations

import math

from csplat import _spec
from csplat_conformance.tolerance import bound_tolerance, least_true_error
from csplat_conformance.validator.index import Index
from csplat_conformance.validator.violation_log import Payload, PlacedRecord, ViolationLog

_COMPONENTS = {"means": 1, "covariance": 1, "opacities": 1, "sh0": 3, "sh1": 9, "sh2": 15, "sh3": 21}
_ROUNDING = 1.0 + 2.0**-20  # SER-2


def check_declared_bounds(payload: Payload, index: Index) -> None:
    """Check SERR: SER-1 to SER-4, and SER-5 as far as it holds for every source."""
    log = payload.log
    head = payload.structure(
        _spec.unpack_stated_errors_head, _spec.STATED_ERRORS_HEAD_SIZE, _spec.STATED_ERRORS_HEAD_OFFSETS, "head"
    )
    stated = head.record
    unlisted = stated.error_flags & ~sum(_spec.ERROR_FLAG_NAMES)
    if unlisted:
        log.add_field("RES-1", head, "error_flags", f"bits {unlisted:#04x} are reserved")
    splats = index.head.record.splat_count
    if stated.source_count - stated.pruned_count != splats:
        message = f"{stated.source_count} splats less {stated.pruned_count} are not the {splats} of the file"
        log.add_field("SER-4", head, "source_count", message)
    last = 0
    for i in range(stated.record_count):
        name = _spec.MEASURE_NAMES.get(payload.view[payload.at] if payload.left else 0, str(i))
        record = payload.structure(
            _spec.unpack_stated_error_record,
            _spec.STATED_ERROR_RECORD_SIZE,
            _spec.STATED_ERROR_RECORD_OFFSETS,
            f"record[{name}]",
        )
        measure = record.record.measure
        if measure not in _spec.MEASURE_NAMES:
            log.add_field("SER-1", record, "measure", f"{measure} is no measure of the registry")
        elif measure <= last:
            log.add_field("SER-1", record, "measure", f"{measure} after {last}, expected ascending measures")
        last = max(last, measure)
        if _check_bound(log, record) and measure in _spec.MEASURE_NAMES:
            _check_bound_possible(log, record, index, stated.source_sh_degree)
    payload.finish()


def _check_bound(log: ViolationLog, record: PlacedRecord[_spec.StatedErrorRecord]) -> bool:
    """Check SER-2; return True if maximum and rms can be compared."""
    largest, rms = record.record.max, record.record.rms
    wrong = [key for key, value in (("max", largest), ("rms", rms)) if not 0.0 <= value < math.inf]
    for key in wrong:
        log.add_field("SER-2", record, key, f"{getattr(record.record, key)}, expected finite and not negative")
    if wrong:
        return False
    components = _COMPONENTS.get(_spec.MEASURE_NAMES.get(record.record.measure, ""))
    if components is not None and rms > largest * math.sqrt(components) * _ROUNDING:
        message = f"{largest:.9g}, and rms {rms:.9g} is more than that allows for {components} components"
        log.add_field("SER-2", record, "max", message)
        return False
    return True


def _check_bound_possible(
    log: ViolationLog, record: PlacedRecord[_spec.StatedErrorRecord], index: Index, source_degree: int
) -> None:
    """Check SER-5 without the source: whether any pair of scenes has errors that allow this bound.

    One splat has the true maximum, which the declared one exceeds by little. So the true rms is at least that maximum
    over √N, and the declared rms is hardly less (SER-7).
    """
    largest, rms = record.record.max, record.record.rms
    splats, measure = index.head.record.splat_count, _spec.MEASURE_NAMES[record.record.measure]
    least = least_true_error(measure, largest)
    if splats and rms * _ROUNDING + bound_tolerance(measure, rms, 0.0) < least / math.sqrt(splats):
        message = f"{rms:.9g} is too small for max {largest:.9g} over {splats} splats"
        log.add_field("SER-5", record, "rms", message)
    if measure == "opacities" and least > 1.0:
        log.add_field("SER-5", record, "max", f"alpha differs by at most 1, not by {largest:.9g}")
    band = record.record.measure - _spec.MEASURE_SH0
    degree = index.degree if index.degree is not None else _spec.SH_DEGREE_MAX
    if (band > max(degree, source_degree) or not splats) and least > 0.0:
        log.add_field("SER-5", record, "max", f"{largest:.9g} for {measure}, of which there is nothing to differ")

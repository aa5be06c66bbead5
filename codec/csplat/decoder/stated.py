"""Stated errors (spec 5.5)."""

from __future__ import annotations

import math
from dataclasses import dataclass

from csplat import _spec
from csplat.decoder.container import check_reserved, open_chunk
from csplat.decoder.header import SceneHeader
from csplat.errors import FormatError

_COMPONENTS = {
    _spec.MEASURE_MEANS: 1,
    _spec.MEASURE_COVARIANCE: 1,
    _spec.MEASURE_OPACITIES: 1,
    _spec.MEASURE_SH0: _spec.ATTRIBUTE_COLUMNS[_spec.ATTRIBUTE_SH0],
    _spec.MEASURE_SH1: _spec.ATTRIBUTE_COLUMNS[_spec.ATTRIBUTE_SH1],
    _spec.MEASURE_SH2: _spec.ATTRIBUTE_COLUMNS[_spec.ATTRIBUTE_SH2],
    _spec.MEASURE_SH3: _spec.ATTRIBUTE_COLUMNS[_spec.ATTRIBUTE_SH3],
}
_SLACK = 1.0 + 2.0**-20  # SER-2: room for the rounding of both numbers; the product from left to right


@dataclass(frozen=True)
class StatedError:
    """A declared error bound of a file, for one measure.

    Attributes:
        measure: name in the registry, `means`.
        max: largest error over the splats kept.
        rms: root of the mean square over the splats kept.
    """

    measure: str
    max: float
    rms: float


@dataclass(frozen=True)
class StatedErrors:
    """The errors that a file states, against the model its encoder was given.

    Attributes:
        source_count: splats of the source.
        pruned_count: splats of the source that the file does not hold.
        source_sh_degree: SH degree of the source.
        refitted: attributes were refitted; those without a record can only be judged by renders.
        records: declared errors by measure.
    """

    source_count: int
    pruned_count: int
    source_sh_degree: int
    refitted: bool
    records: tuple[StatedError, ...]


def read_serr(view: memoryview, header: SceneHeader) -> StatedErrors | None:
    """Return what the SERR chunk states, `None` if the file has none."""
    record = header.chunk(_spec.CHUNK_STATED_ERRORS)
    if record is None:
        return None
    cursor = open_chunk(view, record, record.type, record.flags, "SER-3")
    at = cursor.take(_spec.STATED_ERRORS_HEAD_SIZE)
    head = _spec.unpack_stated_errors_head(view, at)
    if head.error_flags & ~sum(_spec.ERROR_FLAG_NAMES):
        place = at + _spec.STATED_ERRORS_HEAD_OFFSETS["error_flags"]
        raise FormatError(_spec.ERROR_RESERVED, place, "RES-1", "error_flags", found=head.error_flags)
    if head.source_count - head.pruned_count != header.splat_count:
        raise FormatError(
            _spec.ERROR_VALUE,
            at,
            "SER-4",
            "source_count - pruned_count",
            found=head.source_count - head.pruned_count,
            wanted=header.splat_count,
        )
    records: list[StatedError] = []
    last = 0
    for _ in range(head.record_count):
        at = cursor.take(_spec.STATED_ERROR_RECORD_SIZE)
        item = _spec.unpack_stated_error_record(view, at)
        last = _check_record(item, at, last)
        records.append(StatedError(_spec.MEASURE_NAMES[item.measure], item.max, item.rms))
    cursor.finish()
    return StatedErrors(
        head.source_count,
        head.pruned_count,
        head.source_sh_degree,
        bool(head.error_flags & _spec.ERROR_FLAG_REFITTED),
        tuple(records),
    )


def _check_record(record: _spec.StatedErrorRecord, at: int, last: int) -> int:
    """SER-1, SER-2; return the measure."""
    places = _spec.STATED_ERROR_RECORD_OFFSETS
    check_reserved(record, at, places)
    if record.measure not in _spec.MEASURE_NAMES or record.measure <= last:
        raise FormatError(
            _spec.ERROR_VALUE, at, "SER-1", "measure", found=record.measure, wanted="registered, ascending"
        )
    bound = record.max * math.sqrt(_COMPONENTS[record.measure]) * _SLACK
    if not (0.0 <= record.max < math.inf and 0.0 <= record.rms < math.inf and record.rms <= bound):
        raise FormatError(
            _spec.ERROR_VALUE,
            at + places["max"],
            "SER-2",
            f"max and rms of {_spec.MEASURE_NAMES[record.measure]}",
            found=(record.max, record.rms),
        )
    return record.measure

"""Changes of the stated errors in a file that is written already."""

import dataclasses

from csplat import _spec
from csplat_selftest.mutate import mapped


def serr_at(data):
    """Return where the payload of the stated errors begins."""
    index = [
        entry for name, entry in mapped(data).fields.items() if name.startswith("directory[") and name.endswith("type")
    ]
    (record,) = (entry.offset for entry in index if data[entry.offset :].startswith(_spec.CHUNK_STATED_ERRORS))
    return _spec.unpack_directory_record(data, record).offset + _spec.CHUNK_HEADER_SIZE


def stated(change):
    """Return a change of every record of the stated errors."""

    def run(data):
        built, at, out = mapped(data), serr_at(data), bytearray(data)
        count = _spec.unpack_stated_errors_head(data, at).record_count
        for i in range(count):
            place = at + _spec.STATED_ERRORS_HEAD_SIZE + i * _spec.STATED_ERROR_RECORD_SIZE
            record = change(_spec.unpack_stated_error_record(data, place))
            out[place : place + _spec.STATED_ERROR_RECORD_SIZE] = _spec.pack_stated_error_record(record)
        return dataclasses.replace(built, data=bytes(out)).patched({})

    return run


def head(**fields):
    """Return a change of the head of the stated errors; each field is made of the one that stands there."""

    def run(data):
        built, at = mapped(data), serr_at(data)
        old = _spec.unpack_stated_errors_head(data, at)
        new = old._replace(**{name: make(getattr(old, name)) for name, make in fields.items()})
        packed = _spec.pack_stated_errors_head(new)
        return dataclasses.replace(built, data=data[:at] + packed + data[at + _spec.STATED_ERRORS_HEAD_SIZE :]).patched(
            {}
        )

    return run


def counts(source, pruned):
    return head(source_count=lambda old: old + source, pruned_count=lambda old: old + pruned)


refitted = head(error_flags=lambda _: _spec.ERROR_FLAG_REFITTED)


def bounded(bounds):
    """Return a change of the file: it states these, by measure."""

    def run(record):
        most, rms = bounds[_spec.MEASURE_NAMES[record.measure]]
        return record._replace(max=most, rms=rms)

    return stated(run)

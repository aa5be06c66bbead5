"""Files for tests: encoded with everything checked, or read along the axes of their format."""

from __future__ import annotations

import csplat
from csplat.disk_files import local_file
from csplat.encoder import EncodeOptions, encode_with_report
from csplat.encoder.error_bounds import measured_sums
from csplat.formats import detect_format
from csplat_conformance.validator import validate


def encoded(model, importance=None, **options):
    """Encode, and check what must hold of any file."""
    result = encode_with_report(model, EncodeOptions(**options), importance=importance)
    assert () == tuple(validate(result.data).violations)
    decoded = csplat.decode(result.data)
    for name, (largest, rms) in measure_errors(model, decoded, result.source_index).items():
        assert largest <= result.report.errors[name][0], name
        assert rms <= result.report.errors[name][1], name
    return result, decoded


def measure_errors(source, decoded, source_index):
    """(max, rms) by measure of the spec of a decoded model against its source."""
    return measured_sums(source, decoded, source_index).bounds()


def checked(file):
    """A scene along the axes of its file."""
    with local_file(file) as path, detect_format(path).open(path) as scene:
        return scene.model()

"""Files that were encoded for a test, with what must hold of any file checked."""

import csplat
from csplat.encoder import EncodeOptions, encode_with_report
from csplat.encoder.error_bounds import measure_errors
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

import pickle

import pytest

from csplat import errors


def test_a_format_error_names_code_place_clause_and_both_values():
    error = errors.FormatError("E_CRC", 12, "CRC-1", "found 0x1a2b3c4d, computed 0x5e6f7081")
    assert "E_CRC at byte 12 (CRC-1): found 0x1a2b3c4d, computed 0x5e6f7081" == str(error)
    assert ("E_CRC", 12, "CRC-1") == (error.code, error.offset, error.clause)


def test_found_and_wanted_make_the_message():
    error = errors.FormatError("E_COUNT", 40, "IDX-3", found=7, wanted="at most 5")
    assert "E_COUNT at byte 40 (IDX-3): found 7, wanted at most 5" == str(error)


def test_a_format_error_without_a_place_leaves_it_out():
    assert "E_HASH (SHA-1)" == str(errors.FormatError("E_HASH", None, "SHA-1"))


def test_an_unsupported_error_names_the_feature():
    error = errors.UnsupportedError("version 0.7")
    assert "E_UNSUPPORTED: version 0.7 is not supported" == str(error)
    assert ("E_UNSUPPORTED", "version 0.7") == (error.code, error.feature)


def test_a_limit_error_names_both_sides():
    error = errors.LimitError("max_splats", 10, 5)
    assert "E_LIMIT: max_splats: wanted 10, allowed 5" == str(error)
    assert ("max_splats", 10, 5) == (error.limit, error.wanted, error.allowed)


@pytest.mark.parametrize(
    "error",
    [
        errors.FormatError("E_CRC", 12, "CRC-1", found=1, wanted=2),
        errors.UnsupportedError("x", code="E_VERSION", offset=8, clause="VER-1"),
        errors.LimitError("x", 2, code="E_BUDGET", offset=3),
        errors.InputError("x"),
    ],
)
def test_errors_survive_another_process_and_have_a_code(error):
    again = pickle.loads(pickle.dumps(error))  # noqa: S301 -- our own bytes
    assert str(error) == str(again)
    assert error.code == again.code
    assert isinstance(error, errors.CsplatError)
    assert error.code.startswith("E_")

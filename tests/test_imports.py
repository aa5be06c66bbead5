"""Imports: the modules that each loads, and the classes of errors."""

from __future__ import annotations

import pickle
import subprocess
import sys

import pytest

import csplat
from csplat import errors


def modules_after(statement: str) -> set[str]:
    code = f"import sys\n{statement}\nprint(*sorted(sys.modules))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    return set(done.stdout.split())


def test_importing_csplat_loads_none_of_its_modules():
    assert set() == {one for one in modules_after("import csplat") if one.startswith("csplat.")}


def test_the_decoder_loads_no_other_part_and_works_without_plyfile():
    loaded = modules_after("sys.modules['plyfile'] = None; import csplat.decoder; from csplat import decode")
    assert "csplat.decoder" in loaded
    loaded.remove("plyfile")
    packages = {name.split(".")[0] for name in loaded}
    assert not packages & {"plyfile", "torch", "numba", "deflate", "typer", "rich", "csplat_tools"}
    foreign = ("csplat.encoder", "csplat.ply", "csplat.lint", "csplat.detect", "csplat.disk_files")
    assert not [name for name in loaded if name.startswith(foreign)]


def test_the_reader_loads_neither_encoder_nor_decoder():
    loaded = modules_after("from csplat import read_ply")
    assert not [name for name in loaded if name.startswith(("csplat.encoder", "csplat.decoder"))]


def test_every_public_name_resolves():
    assert [] == [name for name in csplat.__all__ if getattr(csplat, name, None) is None]


def test_dir_lists_the_public_names():
    assert sorted(csplat.__all__) == dir(csplat)


def test_an_unknown_name_is_an_attribute_error():
    with pytest.raises(AttributeError, match="no attribute 'nonsense'"):
        csplat.nonsense  # noqa: B018 -- the access is the test


@pytest.mark.slow
def test_the_renderer_requires_no_torch():
    """test_interface.py tests that cameras require no numba."""
    pytest.importorskip("numba", reason="the renderer requires the extra [render]")
    loaded = {
        name.split(".")[0]
        for name in modules_after("import csplat_render.rasteriser, csplat_render.reference_rasteriser")
    }
    assert not loaded & {"torch", "csplat_trainer", "csplat_tools", "plyfile"}  # numba itself may load scipy


def test_a_format_error_names_code_place_clause_and_both_values():
    error = errors.FormatError("E_CRC", 12, "CRC-1", "found 0x1a2b3c4d, computed 0x5e6f7081")
    assert "E_CRC at byte 12 (CRC-1): found 0x1a2b3c4d, computed 0x5e6f7081" == str(error)
    assert ("E_CRC", 12, "CRC-1") == (error.code, error.offset, error.clause)


def test_the_message_contains_the_values_found_and_expected():
    error = errors.FormatError("E_COUNT", 40, "IDX-3", found=7, wanted="at most 5")
    assert "E_COUNT at byte 40 (IDX-3): found 7, expected at most 5" == str(error)


def test_a_format_error_may_lack_a_place():
    assert "E_HASH (SHA-1)" == str(errors.FormatError("E_HASH", None, "SHA-1"))


def test_an_unsupported_error_names_the_feature():
    error = errors.UnsupportedError("version 0.7")
    assert "E_UNSUPPORTED: version 0.7 is not supported" == str(error)
    assert ("E_UNSUPPORTED", "version 0.7") == (error.code, error.feature)


def test_a_limit_error_names_both_sides():
    error = errors.LimitError("max_splats", 10, 5)
    assert "E_LIMIT: max_splats: needs 10, allowed 5" == str(error)
    assert ("max_splats", 10, 5) == (error.limit, error.wanted, error.allowed)


@pytest.mark.parametrize("error", [
    errors.FormatError("E_CRC", 12, "CRC-1", found=1, wanted=2),
    errors.UnsupportedError("x", code="E_VERSION", offset=8, clause="VER-1"),
    errors.LimitError("x", 2, code="E_BUDGET", offset=3),
    errors.InputError("x"),
])  # fmt: skip
def test_errors_survive_another_process_and_have_a_code(error):
    again = pickle.loads(pickle.dumps(error))  # noqa: S301 -- our own bytes
    assert str(error) == str(again)
    assert error.code == again.code
    assert isinstance(error, errors.CsplatError)
    assert error.code.startswith("E_")

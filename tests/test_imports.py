import subprocess
import sys

import pytest

import csplat


def modules_after(statement: str) -> set[str]:
    code = f"import sys\n{statement}\nprint(*sorted(sys.modules))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    return set(done.stdout.split())


def test_importing_csplat_loads_none_of_its_modules():
    assert set() == {one for one in modules_after("import csplat") if one.startswith("csplat.")}


def test_the_decoder_loads_nothing_of_the_others_and_works_where_plyfile_is_absent():
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
def test_the_renderer_needs_no_torch():
    """That cameras need no numba is tested in test_interface.py."""
    pytest.importorskip("numba", reason="the renderer wants the extra [render]")
    loaded = {
        name.split(".")[0]
        for name in modules_after("import csplat_render.rasteriser, csplat_render.reference_rasteriser")
    }
    assert not loaded & {"torch", "csplat_trainer", "csplat_tools", "plyfile"}  # numba itself may load scipy

"""Entry points of other packages: formats, and the display of a notebook."""

import os
import subprocess
import sys

import pytest

import csplat

PLUGIN = """
from csplat.formats import Format, format_by_name

FORMAT = Format("lcc", open=format_by_name("splat").open)


def html(model):
    return f"<p>{len(model)}</p>"
"""


@pytest.fixture
def installed(tmp_path):
    """Return a function that runs a statement where a distribution has these entry points; it returns the output."""

    def run(statement, name="other", **groups):
        metadata = tmp_path / f"{name}-1.dist-info"
        metadata.mkdir()
        (metadata / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: 1\n", "utf-8")
        lines = [f"[csplat.{group}]\n{line}\n" for group, line in groups.items()]
        (metadata / "entry_points.txt").write_text("".join(lines), "utf-8")
        (tmp_path / "other_plugin.py").write_text(PLUGIN, "utf-8")
        paths = os.pathsep.join([str(tmp_path), *filter(None, [os.environ.get("PYTHONPATH")])])
        code = f"import csplat, csplat.formats, sys, numpy as np\n{statement}"
        done = subprocess.run(
            [sys.executable, "-c", code],
            env={**os.environ, "PYTHONPATH": paths},
            capture_output=True,
            text=True,
            check=True,
        )
        return done.stdout.strip()

    return run


def test_a_format_of_another_package_is_listed_and_read(installed, tmp_path):
    (tmp_path / "a.lcc").write_bytes(bytes(32))
    statement = "print('lcc' in [one.name for one in csplat.formats.formats()]); "
    statement += f"print(len(csplat.read({str(tmp_path / 'a.lcc')!r})))"
    assert "True\n1" == installed(statement, formats="lcc = other_plugin:FORMAT")


def test_entry_points_are_read_only_for_formats_that_this_package_lacks(installed, tmp_path, make_model):
    csplat.write(tmp_path / "a.ply", make_model(3, 0))
    statement = f"csplat.read({str(tmp_path / 'a.ply')!r})\nprint('other_plugin' in sys.modules)"
    assert "False" == installed(statement, formats="lcc = other_plugin:FORMAT")


def test_notebooks_use_the_display_that_is_installed(installed):
    model = "csplat.SplatModel(np.zeros((2, 3), np.float32), np.array([[1, 0, 0, 0]] * 2, np.float32), "
    model += "np.zeros((2, 3), np.float32), np.ones(2, np.float32), np.zeros((2, 3), np.float32))"
    # A distribution of this name hides the metadata of the installed one, which has a display, too.
    assert "<p>2</p>" == installed(f"print({model}._repr_html_())", "csplat", display="html = other_plugin:html")


def test_without_entry_points_the_formats_are_those_of_the_codec(installed):
    statement = "print([one.name for one in csplat.formats.formats()][-1])"
    assert "gltf" == installed(statement, "csplat")

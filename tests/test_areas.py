"""Areas (areas.py): which tests `make test` leaves out, and that an edit of their sources brings them back."""

import re
from pathlib import Path

import areas
import pytest


@pytest.fixture
def project(tmp_path):
    """A project of one source in one area, recorded."""
    file = tmp_path / "areas.toml"
    file.write_text('# why\n[engines]\nguards = "drawing"\nsources = ["*.mjs"]\nhash = ""\n', encoding="utf-8")
    (tmp_path / "loader.mjs").write_text("draw();\n", encoding="utf-8")
    assert ["engines"] == areas.record(["engines"], file, tmp_path)
    return file, tmp_path


def test_an_area_runs_again_after_an_edit_of_its_sources(project):
    file, root = project
    assert "not area" == areas.expression(areas.load(file), root=root)
    (root / "loader.mjs").write_text("draw(1);\n", encoding="utf-8")
    assert "not area or area(name='engines')" == areas.expression(areas.load(file), root=root)


def test_a_new_file_and_another_name_are_edits(project):
    file, root = project
    (root / "loader.mjs").rename(root / "other.mjs")
    assert areas.load(file)[0].is_changed(root)


def test_line_ends_are_no_edit(project):
    file, root = project
    (root / "loader.mjs").write_bytes(b"draw();\r\n")
    assert not areas.load(file)[0].is_changed(root)


def test_recording_keeps_what_else_the_file_holds(project):
    file, root = project
    assert [] == areas.record(["engines"], file, root)
    assert file.read_text(encoding="utf-8").startswith('# why\n[engines]\nguards = "drawing"')


def test_a_pattern_without_files_is_an_error(project):
    file, root = project
    (root / "loader.mjs").unlink()
    with pytest.raises(ValueError, match=r"\*\.mjs matches no file"):
        areas.load(file)[0].digest(root)


def test_fast_tests_are_neither_slow_nor_of_an_area_and_want_no_shared_scenes():
    assert "not slow and not area and not shared_data" == areas.expression([], fast=True)


def test_markers_and_file_name_the_same_areas():
    texts = [path.read_text(encoding="utf-8") for path in Path(__file__).parent.glob("test_*.py")]
    used = {name for text in texts for name in re.findall(r'mark\.area\(name="(\w+)"\)', text)}
    assert used == {area.name for area in areas.load()}

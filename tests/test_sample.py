import hashlib
import importlib.util
from pathlib import Path

import pytest

from csplat import read_ply

RECIPE = Path(__file__).resolve().parent.parent / "tools" / "sample" / "make_sample.py"


@pytest.fixture(scope="module")
def recipe():
    spec = importlib.util.spec_from_file_location("make_sample", RECIPE)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_the_recipe_makes_the_sample_byte_for_byte(recipe, tmp_path, sample_path):
    made = tmp_path / "sample.ply"
    recipe.write_scene(made, recipe.make_scene())
    digest = [hashlib.sha256(path.read_bytes()).hexdigest() for path in (made, sample_path)]
    assert digest[1] == digest[0]


def test_the_sample_has_no_defects_and_says_whose_it_is(sample_path):
    report = []
    model = read_ply(sample_path, strict=True, report=report)
    assert [] == report
    assert (9000, 3) == (len(model), model.sh_degree)
    assert "RDF" == model.coordinate_system
    assert "CC0-1.0" == model.metadata["licence"]

# SPDX-License-Identifier: CC0-1.0
"""Recipes of all vectors, both declared (`declaration`) and computed."""

from __future__ import annotations

import math
from functools import cache, lru_cache
from typing import Any

from numpy.typing import NDArray

from csplat_authoring.boundaries import boundary_recipes
from csplat_authoring.declaration import declared_recipes
from csplat_authoring.recipe import Recipe
from csplat_authoring.recipes.deflate_streams import invalid_deflate_recipes, valid_deflate_recipes
from csplat_authoring.recipes.extreme import edge_recipes, extreme_stream_recipes
from csplat_authoring.recipes.invalid_bytes import invalid_bytes_recipes
from csplat_authoring.recipes.rendered import rendered_recipes
from csplat_authoring.recipes.resource_levels import invalid_level_recipes, valid_level_recipes
from csplat_authoring.recipes.texts import bad_text_recipes, good_text_recipes
from csplat_authoring.recipes.valid import combined_recipes, valid_recipes, valid_stream_recipes
from csplat_authoring.reference import expected
from csplat_authoring.scene import Scene
from csplat_conformance.manifest import load

__all__ = ["all_recipes", "exact_floats", "sound_recipes"]


def sound_recipes() -> list[Recipe]:
    """Return the recipes of valid files. This is much faster than `all_recipes`, which builds the invalid files."""
    makers = (
        valid_recipes,
        valid_stream_recipes,
        combined_recipes,
        extreme_stream_recipes,
        valid_deflate_recipes,
        edge_recipes,
        good_text_recipes,
        rendered_recipes,
        valid_level_recipes,
    )
    return _sort_by_manifest([*declared_recipes("valid", "extreme"), *(recipe for make in makers for recipe in make())])


def all_recipes() -> list[Recipe]:
    """Return every recipe, in the order of the manifest."""
    makers = (
        boundary_recipes, invalid_deflate_recipes, bad_text_recipes, invalid_bytes_recipes, invalid_level_recipes,
    )  # fmt: skip
    invalid = [*declared_recipes("invalid"), *(recipe for make in makers for recipe in make())]
    return _sort_by_manifest([*sound_recipes(), *invalid])


def _sort_by_manifest(recipes: list[Recipe]) -> list[Recipe]:
    """Return recipes in the order of the manifest, new ones last, so that changes of the manifest stay small."""
    positions = {vector.name: position for position, vector in enumerate(load())}
    return sorted(recipes, key=lambda recipe: positions.get(recipe.name, math.inf))


@lru_cache(maxsize=8)
def exact_floats(name: str) -> dict[str, NDArray[Any]]:
    """Return the float arrays of a vector; the manifest has only their hashes."""
    made = _scenes()[name]
    assert made is not None, f"{name} has no values"
    return expected(made, 0).floats


@cache
def _scenes() -> dict[str, Scene | None]:
    return {recipe.name: recipe.scene for recipe in sound_recipes()}

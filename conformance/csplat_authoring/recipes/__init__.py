"""Recipes of all vectors."""

from __future__ import annotations

from functools import cache, lru_cache
from typing import Any

from numpy.typing import NDArray

from csplat_authoring.boundaries import boundary_recipes
from csplat_authoring.recipes.deflate_streams import invalid_deflate_recipes, valid_deflate_recipes
from csplat_authoring.recipes.edges import edge_recipes
from csplat_authoring.recipes.extreme import extreme_recipes
from csplat_authoring.recipes.extreme_streams import extreme_stream_recipes
from csplat_authoring.recipes.growth import invalid_growth_recipes, valid_growth_recipes
from csplat_authoring.recipes.invalid_alone import alone_recipes
from csplat_authoring.recipes.invalid_alone_blocks import alone_block_recipes
from csplat_authoring.recipes.invalid_alone_books import alone_book_recipes
from csplat_authoring.recipes.invalid_alone_streams import alone_stream_recipes
from csplat_authoring.recipes.invalid_alone_tiles import alone_tile_recipes
from csplat_authoring.recipes.invalid_blocks import block_recipes
from csplat_authoring.recipes.invalid_chunks import chunk_recipes
from csplat_authoring.recipes.invalid_codebooks import codebook_recipes
from csplat_authoring.recipes.invalid_header import header_recipes
from csplat_authoring.recipes.invalid_index import index_recipes
from csplat_authoring.recipes.invalid_records import record_recipes
from csplat_authoring.recipes.invalid_streams import stream_recipes
from csplat_authoring.recipes.invalid_tiles import tile_recipes
from csplat_authoring.recipes.rendered import rendered_recipes
from csplat_authoring.recipes.texts import bad_text_recipes, good_text_recipes
from csplat_authoring.recipes.valid import valid_recipes
from csplat_authoring.recipes.valid_combined import combined_recipes
from csplat_authoring.recipes.valid_streams import valid_stream_recipes
from csplat_authoring.reference import expected
from csplat_authoring.samples import Recipe
from csplat_authoring.scene import Scene

__all__ = ["all_recipes", "exact_floats", "sound_recipes"]


def sound_recipes() -> list[Recipe]:
    """Return the recipes of valid files, in a twentieth of the time: the others build a file and break it."""
    makers = (
        valid_recipes,
        valid_stream_recipes,
        combined_recipes,
        extreme_recipes,
        extreme_stream_recipes,
        valid_deflate_recipes,
        edge_recipes,
        valid_growth_recipes,
        good_text_recipes,
        rendered_recipes,
    )
    return [recipe for make in makers for recipe in make()]


def all_recipes() -> list[Recipe]:
    """Return every recipe, in the order of the manifest."""
    makers = (
        header_recipes,
        boundary_recipes,
        index_recipes,
        record_recipes,
        tile_recipes,
        chunk_recipes,
        stream_recipes,
        invalid_deflate_recipes,
        block_recipes,
        codebook_recipes,
        alone_recipes,
        alone_tile_recipes,
        alone_stream_recipes,
        alone_block_recipes,
        alone_book_recipes,
        invalid_growth_recipes,
        bad_text_recipes,
    )
    return [*sound_recipes(), *(recipe for make in makers for recipe in make())]


@lru_cache(maxsize=8)
def exact_floats(name: str) -> dict[str, NDArray[Any]]:
    """Return the float arrays of a vector: the manifest has only their hashes."""
    made = _scenes()[name]
    assert made is not None, f"{name} has no values"
    return expected(made).floats


@cache
def _scenes() -> dict[str, Scene | None]:
    return {recipe.name: recipe.scene for recipe in sound_recipes()}

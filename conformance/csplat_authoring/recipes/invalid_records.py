"""Invalid files: records of codebooks and extra columns."""

from __future__ import annotations

from dataclasses import replace

from csplat import _spec
from csplat_authoring.broken import patched, rich, whole
from csplat_authoring.samples import Recipe, scene
from csplat_authoring.scene import Extra


def record_recipes() -> list[Recipe]:
    """Return the recipes of this module."""
    return [*_codebooks_and_extras()]


def _codebooks_and_extras() -> list[Recipe]:
    base = rich()
    two = scene(tiles=[], extras=())
    doubled = replace(two, extras=(_extra("same"), _extra("same")))
    return [
        patched(
            "codebook_ids_equal", "two codebooks of one id", "CBR-1", "E_INDEX", base, {"codebook[7].codebook_id": 2}
        ),
        patched(
            "codebook_ids_descending", "ids that descend", "CBR-1", "E_INDEX", base, {"codebook[7].codebook_id": 1}
        ),
        patched(
            "codebook_bands_swapped",
            "first band above the last",
            "CBR-2",
            "E_VALUE",
            base,
            {"codebook[7].band_last": 0},
            at="codebook[7].band_first",
        ),
        patched(
            "codebook_band_above_degree",
            "band 3 in a scene of degree 2",
            "CBR-2",
            "E_VALUE",
            base,
            {"codebook[7].band_last": 3},
            at="codebook[7].band_first",
        ),
        patched(
            "extra_name_latin",
            "a name that is not UTF-8",
            "EXR-2",
            "E_VALUE",
            base,
            {"extra[0].name": b"lab\xe9l".ljust(62, b"\0")},
            within=3,
        ),
        patched(
            "extra_name_control",
            "a line feed in the name",
            "EXR-2",
            "E_VALUE",
            base,
            {"extra[0].name": b"la\nel".ljust(62, b"\0")},
        ),
        patched(
            "extra_name_delete",
            "U+007F in the name",
            "EXR-2",
            "E_VALUE",
            base,
            {"extra[0].name": b"lab\x7fl".ljust(62, b"\0")},
        ),
        whole("extra_names_equal", "two columns of one name", "EXR-2", "E_VALUE", doubled, "extra[1].name"),
        patched(
            "extra_name_padding",
            "a byte behind the name is not 0",
            "EXR-3",
            "E_RESERVED",
            base,
            {"extra[0].name": b"label\0x".ljust(62, b"\0")},
            within=5,
        ),
    ]


def _extra(name: str) -> Extra:
    return Extra(name, _spec.EXTRA_DTYPE_U8)

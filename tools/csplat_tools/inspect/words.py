"""Describe the content of a file in words, for the text and the HTML page of `csplat info`."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from csplat.decoder import SceneHeader
from csplat.model import SplatModel
from csplat.training_record import TRAINING, VIEW, TrainingRecord
from csplat.upright import UP, up_of
from csplat_tools.files.console import format_bytes
from csplat_tools.inspect.info import AttributeFacts, FileFacts


def headline(facts: FileFacts) -> str:
    """Return a headline: format version, profile, size, bytes per splat."""
    header, per_splat = facts.header, facts.bytes_per_splat
    average = "" if per_splat is None else f", {per_splat:.2f} bytes per splat"
    version = f"csplat {header.version[0]}.{header.version[1]}"
    return f"{version}, profile {header.profile}, {format_bytes(header.file_size)}{average}"


def scene_words(facts: FileFacts) -> dict[str, str]:
    """Return descriptions of the scene, by title."""
    header = facts.header
    words = place_words(header, header.splat_count, facts.metadata or {})
    words["tiles"] = _tiles(facts)
    extras = ", ".join(f"{one.name} ({one.dtype or 'of a type not known here'})" for one in header.extras)
    if extras:
        words["extra"] = extras
    if facts.cameras is not None:
        words["cameras"] = str(facts.cameras)
    trained = TrainingRecord.of(facts.metadata or {})
    if trained is not None:
        words["trained on"] = str(trained)
    view = (facts.metadata or {}).get(VIEW)
    if view is not None:
        words["first view"] = "a camera of the metadata"
    return words


def place_words(said: SceneHeader | SplatModel, count: int, metadata: Mapping[str, Any]) -> dict[str, str]:
    """Return the number of splats, the axes, the up direction, the unit, the origin and flags in words, by title.

    Args:
        said: header of a .csplat file, or metadata of another one.
        count: number of splats.
        metadata: metadata of the scene.
    """
    flags = [name for name in ("antialiased", "flat") if getattr(said, name)]
    up = up_of(metadata, said.coordinate_system)
    return {
        "splats": f"{count:,}, SH degree {said.sh_degree}",
        "axes": str(said.coordinate_system),
        "up": "unknown" if up is None else " ".join(f"{value:g}" for value in up),
        "unit": "unknown" if said.unit_metres is None else f"{said.unit_metres:g} m",
        "origin": " ".join(f"{value:.17g}" for value in said.origin),
        "flags": ", ".join(flags) or "none",
    }


def other_metadata(facts: FileFacts) -> dict[str, object]:
    """Return the metadata that `scene_words` does not describe."""
    metadata = dict(facts.metadata or {})
    if TrainingRecord.of(metadata) is not None:
        del metadata[TRAINING]
    if up_of(metadata) is not None:
        del metadata[UP]
    metadata.pop(VIEW, None)
    return metadata


def coding_words(attribute: AttributeFacts) -> str:
    """Describe how an attribute is coded."""
    words = ["+".join(attribute.codings)]
    if attribute.step is not None:
        words.append(f"step {attribute.step:.4g}")
    if attribute.levels:
        words.append(f"{attribute.levels} levels")
    if attribute.mapping not in (None, "lattice", "unit_w"):
        words.append(str(attribute.mapping))
    if attribute.chroma_shift:
        words.append(f"chroma / {2**attribute.chroma_shift}")
    if attribute.codebook_bytes:
        words.append(f"codebook {format_bytes(attribute.codebook_bytes)}")
    if attribute.escaped_splats:
        words.append(f"{attribute.escaped_splats} escaped")
    words.append("+".join(attribute.coders))
    return ", ".join(word for word in words if word)


def _tiles(facts: FileFacts) -> str:
    words = {
        name: str(one.min) if one.min == one.max else f"{one.min} to {one.max}" for name, one in facts.spans.items()
    }
    if not words:
        return "0"
    count = len(facts.header.tiles)
    bits = f"{words['bits_per_axis']} bits per axis, exponents {words['exponents']}"
    return f"{count} of {words['splats']} splats, {bits}"

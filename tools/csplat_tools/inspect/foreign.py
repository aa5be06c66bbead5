"""Describe scenes in formats other than .csplat, for `csplat info`."""

from __future__ import annotations

import json
from typing import Any

from csplat.formats import named, open_scene
from csplat_tools.files.console import format_bytes
from csplat_tools.files.convert import findings_as_json
from csplat_tools.files.scenes import size_of
from csplat_tools.files.streams import local_path
from csplat_tools.inspect.words import place_words


def describe_foreign(source: str) -> tuple[dict[str, Any], str]:
    """Describe a file by what is known of it before its splats are read.

    Args:
        source: a scene in any format, or `-`.

    Returns:
        JSON-compatible values, and the same as text.

    Raises:
        InputError: the file is in no format that is read, or not whole.
        OSError: the file cannot be read.
    """
    with local_path(source) as path, open_scene(path) as scene:
        facts, size, count = scene.facts, size_of(path), scene.count
        per_splat = size / count if count else None
        said = {
            "format": scene.format,
            "size_bytes": size,
            "bytes_per_splat": per_splat,
            "splats": count,
            "levels": list(scene.levels),
            "sh_degree": facts.sh_degree,
            "coordinate_system": facts.coordinate_system,
            "origin": list(facts.origin),
            "unit_metres": facts.unit_metres,
            "antialiased": facts.antialiased,
            "flat": facts.flat,
            "extra": {name: str(column.dtype) for name, column in facts.extra.items()},
            "metadata": dict(facts.metadata),
            "defects": findings_as_json(scene.findings),
        }
        average = "" if per_splat is None else f", {per_splat:.2f} bytes per splat"
        words = place_words(facts, count, facts.metadata)
        if scene.levels:
            words["levels"] = f"{' / '.join(f'{one:,}' for one in scene.levels)} splats (csplat convert --level)"
        if facts.extra:
            words["extra"] = ", ".join(f"{name} ({column.dtype})" for name, column in facts.extra.items())
        if facts.metadata:
            words["metadata"] = json.dumps(facts.metadata, sort_keys=True)
        lines = [f"{named(scene.format).title}, {format_bytes(size)}{average}"]
        lines += [f"{name:12} {value}" for name, value in words.items()]
        lines += [str(one) for one in scene.findings if not one.usual]
    return said, "\n".join(lines)

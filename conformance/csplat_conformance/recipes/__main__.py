"""Write the vectors, the manifest, and annexes A and C of the spec.

Usage:
    python -m csplat_conformance.recipes           # write what is out of date, remove what no recipe makes
    python -m csplat_conformance.recipes --check   # write nothing, exit 1 and name what is out of date
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from csplat_conformance.clauses import clause_map, replaced
from csplat_conformance.example import annex
from csplat_conformance.manifest import VECTORS, describe, to_json
from csplat_conformance.recipes import all_recipes

#: The spec's text; only a checkout has it.
FORMAT = Path(__file__).parents[3] / "spec" / "format.md"


def main() -> int:
    """Compare or write; the exit status is 1 when --check finds a difference."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--check", action="store_true", help="write nothing, fail when out of date")
    check = parser.parse_args().check
    wanted = files()
    stale = [path for path, data in wanted.items() if not path.exists() or path.read_bytes() != data]
    extra = [path for path in sorted(VECTORS.rglob("*.csplat")) if path not in wanted]
    if not check:
        for path in stale:
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(wanted[path])
        for path in extra:
            path.unlink()
    if stale or extra:
        names = ", ".join(path.name for path in [*stale, *extra][:20])
        sys.stderr.write(f"{'out of date' if check else 'written'}: {len(stale) + len(extra)} files: {names}\n")
    return 1 if check and (stale or extra) else 0


def files() -> dict[Path, bytes]:
    """Return every generated file: the vectors, the manifest, the spec with its annexes."""
    result: dict[Path, bytes] = {}
    vectors = []
    for recipe in all_recipes():
        data = recipe.data()
        vector = describe(recipe, data)
        path = VECTORS / vector.file
        if path in result:
            raise SystemExit(f"two recipes make {vector.file}")
        result[path] = data
        vectors.append(vector)
    result[VECTORS / "manifest.json"] = to_json(vectors).encode()
    if FORMAT.exists():
        text = FORMAT.read_text(encoding="utf-8")
        text = replaced(text, "worked example", annex())
        text = replaced(text, "clause map", clause_map(text, vectors))
        result[FORMAT] = text.encode()
    return result


if __name__ == "__main__":
    sys.exit(main())

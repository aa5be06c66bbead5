# SPDX-License-Identifier: CC0-1.0
"""Write the vectors, the manifest, `spec/example.md`, `conformance/CLAUSES.md` and the assets of csplat in glTF.

Usage:
    python -m csplat_authoring           # write outdated files, remove files without a recipe
    python -m csplat_authoring --check   # write nothing, list outdated files and exit with 1

A picture is only outdated if it differs visibly, because exponentials may round differently on another machine.
"""

from __future__ import annotations

import argparse
import gc
import hashlib
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from csplat import _spec
from csplat_authoring.clauses import clause_map, specification
from csplat_authoring.gltf_assets import gltf_assets
from csplat_authoring.recipe import Recipe
from csplat_authoring.recipes import all_recipes
from csplat_authoring.reference import expected
from csplat_authoring.worked_example import worked_example
from csplat_conformance.manifest import VECTORS, Vector, load, picture_name, summarise, to_json
from csplat_conformance.reference_renders import psnr, read_png, reference_render, write_png

_ROOT = Path(__file__).parents[3]
#: Folder of the assets of csplat in glTF.
ASSETS = Path(__file__).parents[2] / "gltf"

_SAME_PICTURE = 60.0  # dB; one of 16 values differs by 1


def main() -> int:
    """Write or compare the generated files; return exit status 1 if --check finds a difference."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--check", action="store_true", help="write nothing, fail if a file is outdated")
    parser.add_argument("--renders", action="store_true", help="draw reference images, too: half a minute")
    args = parser.parse_args()
    gc.disable()  # half of the time, for millions of short lists without cycles
    check = args.check
    generated = files(renders=args.renders)
    stale = [path for path, data in generated.items() if not path.exists() or path.read_bytes() != data]
    found = sorted([*VECTORS.rglob("*.csplat"), *VECTORS.rglob("*.png"), *ASSETS.glob("*.glb")])
    extra = [path for path in found if path not in generated]
    if not check:
        for path in stale:
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(generated[path])
        for path in extra:
            path.unlink()
    if stale or extra:
        names = ", ".join(path.name for path in [*stale, *extra][:20])
        sys.stderr.write(f"{'out of date' if check else 'written'}: {len(stale) + len(extra)} files: {names}\n")
    return 1 if check and (stale or extra) else 0


def files(*, renders: bool = False) -> dict[Path, bytes]:
    """Return every generated file: the vectors, the manifest, the worked example, the map of clauses.

    Args:
        renders: draw reference images again; by default existing images stay.
    """
    result: dict[Path, bytes] = {}
    vectors = []
    for recipe in all_recipes():
        data = recipe.data()
        pictures = _pictures(recipe, renders)
        vector = describe(recipe, data, list(pictures.values()))
        result |= pictures
        path = VECTORS / vector.file
        if path in result:
            raise SystemExit(f"two recipes have the name {vector.file}")
        result[path] = data
        vectors.append(vector)
    result |= {ASSETS / name: data for name, data in gltf_assets().items()}
    result[VECTORS / "manifest.json"] = to_json(vectors).encode()
    result[_ROOT / "spec" / "example.md"] = worked_example().encode()
    result[_ROOT / "conformance" / "CLAUSES.md"] = clause_map(specification(), vectors).encode()
    return result


def describe(recipe: Recipe, data: bytes, pictures: Sequence[bytes] = ()) -> Vector:
    """Return the manifest entry of a recipe.

    Args:
        recipe: the recipe of the entry.
        data: the file.
        pictures: a PNG for each of the recipe's views.
    """
    known = {vector.name: vector.since for vector in load() if vector.since >= "1"}  # not those of drafts
    expect: dict[str, Any] = {}
    error: dict[str, Any] = {}
    if recipe.scene is not None:
        result = expected(recipe.scene, _spec.unpack_header(data).index_size)
        expect = {"header": result.header}
        for key in ("integers", "floats", "extra"):
            expect[key] = summarise(getattr(result, key))
        if result.cuts:
            expect["cuts"] = result.cuts
    else:
        error = {"code": recipe.code, "clause": recipe.clauses[0], "offset": recipe.offset}
        error |= {"also": list(recipe.also), "optional": recipe.optional}
    views = [
        {
            "camera": view.camera,
            "picture": picture_name(recipe.name, number),
            "sha256": hashlib.sha256(picture).hexdigest(),
            "psnr": view.psnr,
        }
        for number, (view, picture) in enumerate(zip(recipe.views, pictures, strict=True))
    ]
    return Vector(
        name=recipe.name,
        file=f"{recipe.name}.csplat",
        sha256=hashlib.sha256(data).hexdigest(),
        why=recipe.why,
        clauses=list(recipe.clauses),
        since=known.get(recipe.name, f"{_spec.VERSION_MAJOR}.{_spec.VERSION_MINOR}"),
        expect=expect,
        error=error,
        views=views,
    )


def _pictures(recipe: Recipe, renders: bool) -> dict[Path, bytes]:
    """Return the reference images of a recipe: existing ones, unless they are missing or, with `renders`, outdated."""
    result = {}
    for number, view in enumerate(recipe.views):
        path = VECTORS / picture_name(recipe.name, number)
        old = path.read_bytes() if path.exists() else b""
        if (renders or not old) and recipe.scene is not None:
            made = expected(recipe.scene, 0)
            antialiased = made.header["antialiasing"] == _spec.ANTIALIASING_MIP
            picture = reference_render(made.floats, view.camera, antialiased)
            if not old or psnr(picture, read_png(old)) < _SAME_PICTURE:
                old = write_png(picture)
        if not old:
            raise SystemExit(f"{path.name} is missing, and its recipe has no scene")
        result[path] = old
    return result


if __name__ == "__main__":
    sys.exit(main())

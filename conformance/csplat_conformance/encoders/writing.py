"""Write the inputs as files, for use without a run."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from csplat.files import atomic_writer
from csplat_conformance.encoders.inputs import PSNR_MIN, Input
from csplat_conformance.encoders.run import chosen_inputs

LIST = "inputs.json"


def write_inputs(folder: Path, pattern: str | None = None) -> dict[str, Any]:
    """Write the PLY of every input, `ordinary/degree_3.ply`, and a list of them, `inputs.json`.

    Args:
        folder: folder for the files; existing ones are replaced.
        pattern: shell patterns of the inputs' names; `None` for all.

    Returns:
        The list: `inputs`, each with `name`, `file`, `why`, `refusal` (`must`, `may` or `no`) and `expected`,
        `null` if it must be refused: `splats` of the source (SRC-1), `rows` of the PLY, `sh_degree`,
        `extra_columns`, `apart` (no two different centres are nearer), `renders` (whether pictures are compared) and
        `psnr_min` (dB, unless another is asked for; `null` if they are not).

    Raises:
        InputError: the pattern matches no input.
    """
    entries = []
    for one in chosen_inputs(pattern):
        file = folder / f"{one.name}.ply"
        file.parent.mkdir(parents=True, exist_ok=True)
        data = one.make()
        with atomic_writer(file) as stream:
            stream.write(data)
        entries.append(_entry(one, data))
    result = {"inputs": entries}
    with atomic_writer(folder / LIST) as stream:
        stream.write((json.dumps(result, indent=2) + "\n").encode())
    return result


def _entry(one: Input, data: bytes) -> dict[str, Any]:
    return {
        "name": one.name,
        "file": f"{one.name}.ply",
        "why": one.why,
        "refusal": "must" if one.must_refuse else "may" if one.may_refuse else "no",
        "expected": _expected(one, data),
    }


def _expected(one: Input, data: bytes) -> dict[str, Any] | None:
    if one.source is None:
        return None
    source = one.source()
    return {
        "splats": len(source),
        "rows": _rows(data),
        "sh_degree": source.sh_degree,
        "extra_columns": sorted(source.extra),
        "apart": one.apart,
        "renders": one.renders,
        "psnr_min": one.psnr_wanted(PSNR_MIN) if one.renders else None,
    }


def _rows(data: bytes) -> int:
    """Return the number of rows in the header: 64 for `element vertex 64`."""
    # A comment may say anything, `end_header` and `element vertex 9` too.
    for line in data.split(b"\n"):
        words = line.split()
        if words[:2] == [b"element", b"vertex"]:
            return int(words[2])
    raise ValueError("the input has no element vertex")

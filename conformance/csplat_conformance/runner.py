"""Run a decoder over the vectors and compare what it returns with the manifest.

    >>> from csplat_conformance.runner import run_builtin
    >>> [result.name for result in run_builtin("valid/*") if not result.passed]
    []

`run_builtin` calls `csplat.decoder` in this process. `run_command` starts another decoder for each vector:

    my-decoder INPUT OUTDIR

It exits 0 and leaves in OUTDIR `header.json` (the header facts of the manifest) and one file of raw little-endian
values in C order for each array, `integers.NAME.bin`, `floats.NAME.bin`, `extra.NAME.bin` (NAME of an extra column
in percent-encoding); or it exits 1 and its last line on stdout is JSON, `{"code": "E_CRC"}`. It may leave out
integer arrays; everything else is compared.
"""

from __future__ import annotations

import fnmatch
import hashlib
import json
import shlex
import subprocess
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import quote

from csplat import _spec
from csplat.errors import CsplatError
from csplat_conformance.manifest import VECTORS, Vector, load, summarise

__all__ = ["Result", "run_builtin", "run_command"]

_FLOATS = ("means", "quats", "scales", "opacities", "sh0", "shN")
_TIMEOUT_SECONDS = 60


@dataclass(frozen=True)
class Result:
    """What became of one vector.

    Attributes:
        name: of the vector.
        passed: whether the decoder did what the manifest says.
        message: what it did instead; for a refusal with another clause or offset a remark.
        clauses: ids that the vector covers.
    """

    name: str
    passed: bool
    message: str = ""
    clauses: tuple[str, ...] = ()


def run_builtin(filter: str | None = None) -> list[Result]:
    """Run this package's own decoder over the vectors: optional refusals, clauses and offsets are demanded of it.

    Args:
        filter: shell pattern of the names, `invalid/*`; None for all.

    Returns:
        A result for each vector, in the order of the manifest.
    """
    return [_run_ours(vector) for vector in _chosen(filter)]


def run_command(command: str, filter: str | None = None) -> list[Result]:
    """Run another decoder over the vectors.

    Args:
        command: its command line, with `{input}` and `{outdir}` where they belong.
        filter: shell pattern of the names; None for all.

    Returns:
        A result for each vector; a crash, a hang or another exit status is a failure.
    """
    return [_run_one(command, vector) for vector in _chosen(filter)]


def _chosen(pattern: str | None) -> Iterator[Vector]:
    return (vector for vector in load() if pattern is None or fnmatch.fnmatchcase(vector.name, pattern))


def _run_ours(vector: Vector) -> Result:
    """Decode one vector to floats and to integers; both ways must do what the manifest says."""
    clauses, data = tuple(vector.clauses), vector.data
    if not vector.error:
        try:
            message = _difference(vector.expect, _decoded(data))
        except CsplatError as error:
            message = str(error)
        return Result(vector.name, not message, message, clauses)
    from csplat import decoder

    wanted = vector.error
    message = ""
    for decode in (decoder.decode, decoder.decode_integers):
        try:
            decode(data)
        except CsplatError as error:
            found = (error.code, getattr(error, "clause", None), getattr(error, "offset", None))
            # Of our own decoder the suite wants clause and offset too, and no other code.
            if found != (wanted["code"], wanted["clause"], wanted["offset"]):
                planted = f"{wanted['code']} at byte {wanted['offset']} ({wanted['clause']})"
                message = f"planted {planted}, reported {error}"
        else:
            message = f"{decode.__name__} accepted it"
    return Result(vector.name, not message, message, clauses)


def _decoded(data: bytes) -> dict[str, Any]:
    """Return what our decoder makes of a file, in the form of the manifest."""
    from csplat import decoder

    model = decoder.decode(data)
    integers = decoder.decode_integers(data)
    header = decoder.read_header(data)
    flags = {_spec.SCENE_FLAG_ANTIALIASED: header.antialiased, _spec.SCENE_FLAG_FLAT: header.flat}
    facts = {
        "profile": header.profile,
        "splat_count": header.splat_count,
        "tile_count": len(header.tiles),
        "sh_degree": header.sh_degree,
        "scene_flags": [_spec.SCENE_FLAG_NAMES[bit] for bit, is_set in flags.items() if is_set],
        "axes": "" if header.coordinate_system == "unspecified" else header.coordinate_system,
        "unit_metres": header.unit_metres or 0.0,
        "origin": list(header.origin),
    }
    floats = summarise({name: getattr(model, name) for name in _FLOATS})
    return {"header": facts, "integers": summarise(integers), "floats": floats, "extra": summarise(model.extra)}


def _difference(expect: dict[str, Any], found: dict[str, Any]) -> str:
    """Return the names of what differs, or an empty string."""
    wrong = []
    for part, values in expect.items():
        have = found.get(part, {})
        wrong += [
            f"{part}.{name}: {have.get(name)} for {value}" for name, value in values.items() if have.get(name) != value
        ]
        wrong += [f"{part}.{name}: not asked for" for name in have if name not in values]
    return "; ".join(wrong)


def _run_one(command: str, vector: Vector) -> Result:
    clauses = tuple(vector.clauses)
    with tempfile.TemporaryDirectory() as outdir:
        words = [word.format(input=VECTORS / vector.file, outdir=outdir) for word in shlex.split(command)]
        try:
            run = subprocess.run(words, capture_output=True, timeout=_TIMEOUT_SECONDS, check=False)  # noqa: S603 - the caller's command
        except subprocess.TimeoutExpired:
            return Result(vector.name, False, f"hang: {_TIMEOUT_SECONDS} s", clauses)
        if run.returncode not in (0, 1):
            return Result(vector.name, False, f"crash: exit status {run.returncode}", clauses)
        if run.returncode == 1:
            return _refused(vector, run.stdout)
        if vector.error:
            optional = vector.error["optional"]
            return Result(vector.name, optional, "accepted" + " (optional)" * optional, clauses)
        message = _outdir_difference(vector, Path(outdir))
        return Result(vector.name, not message, message, clauses)


def _refused(vector: Vector, stdout: bytes) -> Result:
    try:
        code = json.loads(stdout.splitlines()[-1])["code"]
    except (ValueError, LookupError, TypeError):
        return Result(vector.name, False, "exit status 1 without a JSON line", tuple(vector.clauses))
    if not vector.error:
        return Result(vector.name, False, f"refused: {code}", tuple(vector.clauses))
    # Another order of checks may find another code first: a refusal is what counts.
    message = "" if code == vector.error["code"] else f"planted {vector.error['code']}, reported {code}"
    return Result(vector.name, True, message, tuple(vector.clauses))


def _outdir_difference(vector: Vector, outdir: Path) -> str:
    wrong = []
    try:
        header = json.loads((outdir / "header.json").read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return "no header.json"
    wrong += [f"header.{key}" for key, value in vector.expect["header"].items() if header.get(key) != value]
    for part in ("integers", "floats", "extra"):
        for name, (_, _, digest) in vector.expect[part].items():
            path = outdir / f"{part}.{quote(name, safe='')}.bin"
            if path.exists() and hashlib.sha256(path.read_bytes()).hexdigest() == digest:
                continue
            if path.exists() or part != "integers":
                wrong.append(f"{part}.{name}")
    return "; ".join(wrong)

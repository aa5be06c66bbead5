"""The protocol by which any decoder can be tested: one process for each vector.

    my-decoder INPUT OUTDIR

It exits with status 0 and leaves in OUTDIR `header.json` and a file of raw values for each array, little-endian, in
C order: `integers.NAME.bin`, `floats.NAME.bin`, `extra.NAME.bin` (NAME of a column percent-encoded). Or it exits
with status 1, its last line on standard output is JSON, `{"code": "E_CRC"}`, and OUTDIR stays empty.
"""

from __future__ import annotations

import hashlib
import json
import tempfile
from pathlib import Path
from typing import Any
from urllib.parse import unquote

from csplat_conformance.answers import Answer, whole_number
from csplat_conformance.process import Ended, run_program
from csplat_conformance.report import Status

_WORDS_MAX = 200  # characters of a program's own message
_PARTS = ("integers", "floats", "extra")


def ask(command: str, path: Path, timeout: float, *, keep_floats: bool = False) -> Answer:
    """Let a decoder have one file.

    Args:
        command: command line with `{input}` and `{outdir}`.
        path: the file.
        timeout: seconds after which the process and its children are killed.
        keep_floats: the answer holds the values of the float arrays too, not their hashes alone.
    """
    with tempfile.TemporaryDirectory(prefix="csplat-conformance-") as folder:
        outdir = Path(folder) / "out"
        outdir.mkdir()
        ended = run_program(command, {"input": str(path), "outdir": str(outdir)}, timeout)
        return answered(ended, outdir, keep_floats=keep_floats)


def answered(ended: Ended, outdir: Path, *, keep_floats: bool = False) -> Answer:
    """Read what a decoder left.

    Args:
        ended: how the process ended.
        outdir: the folder it was given.
        keep_floats: as for `ask`.
    """
    if ended.status is not None:
        return Answer(ended.status, ended.message + last_words(ended), seconds=ended.seconds)
    left = sorted(entry.name for entry in outdir.iterdir())
    if ended.returncode == 1:
        return _refusal(ended, left)
    return _decoded(outdir, left, ended.seconds, keep_floats=keep_floats)


def _refusal(ended: Ended, left: list[str]) -> Answer:
    try:
        facts: dict[str, Any] = dict(json.loads((ended.stdout.splitlines() or [b""])[-1]))
        code, clause, offset = facts["code"], facts.get("clause"), facts.get("offset")
        if not isinstance(code, str):
            raise TypeError
    except (ValueError, LookupError, TypeError, RecursionError):
        text = f"exit status 1 without a line of JSON that has a code{last_words(ended)}"
        return Answer(Status.WRONG_ANSWER, text, seconds=ended.seconds)
    if left:
        return Answer(Status.PARTIAL_OUTPUT, f"refused, but left {', '.join(left)}", code=code, seconds=ended.seconds)
    return Answer(Status.REFUSED, "refused", code=code, clause=clause, offset=offset, seconds=ended.seconds)


def last_words(ended: Ended) -> str:
    """Return the last line of standard error as the end of a sentence, or nothing."""
    lines = ended.stderr.decode("utf-8", "replace").split("\n")
    words = next((line.strip() for line in reversed(lines) if line.strip()), "")
    return f": {words[:_WORDS_MAX]}" if words else ""


def _decoded(outdir: Path, left: list[str], seconds: float, *, keep_floats: bool) -> Answer:
    header: dict[str, Any] = {}
    arrays, floats = {}, {}
    for name in left:
        path = outdir / name
        part, _, rest = name.partition(".")
        if name == "header.json":
            try:
                header = json.loads(path.read_bytes(), parse_int=whole_number)
            except (ValueError, RecursionError, OSError):
                header = {}
            if not isinstance(header, dict) or not header:
                return Answer(Status.WRONG_ANSWER, "header.json is not a JSON object", seconds=seconds)
        elif part in _PARTS and rest.endswith(".bin") and path.is_file():
            with path.open("rb") as stream:
                digest = hashlib.file_digest(stream, "sha256").hexdigest()
            array = unquote(rest.removesuffix(".bin"))
            arrays[f"{part}.{array}"] = (path.stat().st_size, digest)
            if keep_floats and part == "floats":
                floats[array] = path.read_bytes()
        else:
            return Answer(Status.WRONG_ANSWER, f"{name} is no file of the protocol", seconds=seconds)
    return Answer(Status.PASSED, header=header, arrays=arrays, floats=floats, seconds=seconds)

# SPDX-License-Identifier: CC0-1.0
"""Run csplat's Python decoder by the protocol of the suite (`protocol`), or in this process.

csplat conformance decoder --cmd 'python -m csplat_conformance.adapter {input} {outdir}'
csplat conformance decoder --cmd 'python -m csplat_conformance.adapter --cuts {input} {cuts}'
"""

from __future__ import annotations

import argparse
import hashlib
import json
import sys
import time
from collections.abc import Sequence
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import quote

import numpy as np
from numpy.typing import NDArray

from csplat import _spec
from csplat.context import DEFAULT_CONTEXT, Context
from csplat.errors import CsplatError, LimitError
from csplat_conformance.answers import Answer
from csplat_conformance.conformance_report import Status
from csplat_conformance.manifest import load, summarise

if TYPE_CHECKING:
    from csplat.decoder import Limits


_FLOATS = ("means", "quats", "scales", "opacities", "sh0", "shN")


def answer(data: bytes, limits: Limits | None = None, *, context: Context = DEFAULT_CONTEXT) -> Answer:
    """Decode a file to floats and to integers; both must accept it, or refuse it with the same error.

    Only integers are decoded at all levels, so they alone may reveal damage in a coarser level.

    Args:
        data: the file.
        limits: budgets; default: the registry's budgets.
        context: threads.
    """
    began = time.monotonic()
    try:
        header, arrays = _decode(data, limits, context)
    except CsplatError as error:
        code, clause, offset = _error_place(error)
        seconds = time.monotonic() - began
        return Answer(Status.REFUSED, str(error), code=code, clause=clause, offset=offset, seconds=seconds)
    except _DifferError as error:
        return Answer(Status.FAILED, str(error), seconds=time.monotonic() - began)
    sums = {key: (len(raw), hashlib.sha256(raw).hexdigest()) for key, raw in arrays.items()}
    floats = {key.removeprefix("floats."): raw for key, raw in arrays.items() if key.startswith("floats.")}
    return Answer(Status.PASSED, "", header, sums, floats, seconds=time.monotonic() - began)


def cuts_of(data: bytes, lines: Sequence[str]) -> list[list[int] | str]:
    """Select the tiles of cuts.

    Args:
        data: the file.
        lines: the cuts: `level 1`, `pixel_size 0.5`, `pixel_size 0.5 0.25`, `splats 100`, `level 0 box 0 0 0 1 1 1`.

    Returns:
        For each cut, the indices of its tiles or an error code.

    Raises:
        CsplatError: the file is refused.
    """
    from csplat import decoder  # not needed to read the manifest
    from csplat.decoder.tree import read_nodes, select_tiles

    header = decoder.read_header(data)
    nodes = read_nodes(memoryview(data), header)
    result: list[list[int] | str] = []
    for line in lines:
        cut, _, corners = line.partition(" box ")
        name, *words = cut.split()
        sizes = [float(word) for word in words] if name == "pixel_size" else None
        pixel_size = sizes[0] if sizes is not None and len(sizes) == 1 else sizes
        level = int(words[0]) if name == "level" else None
        max_splats = int(words[0]) if name == "splats" else None
        box = np.array(corners.split(), np.float64).reshape(2, 3) if corners else None
        try:
            tiles = select_tiles(header, nodes, level=level, pixel_size=pixel_size, max_splats=max_splats, box=box)
            result.append([tile.index for tile in tiles])
        except LimitError as error:
            result.append(error.code)
    return result


@lru_cache(maxsize=8)
def exact_floats(name: str) -> dict[str, NDArray[np.float32]]:
    """Decode the float arrays of a valid vector, whose hashes are in the manifest.

    Raises:
        AssertionError: a hash differs, which is a defect of csplat's decoder.
    """
    from csplat import decoder

    vector = next(vector for vector in load() if vector.name == name)
    model = decoder.decode(vector.data)
    floats = {key: getattr(model, key) for key in vector.expect["floats"]}
    assert summarise(floats) == vector.expect["floats"], f"csplat's decoder gives other floats for {name}"
    return floats


class _DifferError(Exception):
    """Raised if the two ways of decoding disagree, which is a defect of the decoder."""


def _decode(data: bytes, limits: Limits | None, context: Context) -> tuple[dict[str, Any], dict[str, bytes]]:
    """Decode a file twice, to values and to integers; return header fields, and raw values by `part.name`.

    Raises:
        CsplatError: the file is refused.
        _DifferError: only one of the functions refuses it, or they report different errors.
    """
    from csplat import decoder  # not needed to read the manifest

    results: list[Any] = []
    for decode in (decoder.decode, decoder.decode_integers):
        try:
            results.append(decode(data, limits=limits, context=context))
        except CsplatError as error:
            results.append(error)
    model, integers = results
    if isinstance(integers, CsplatError) and _has_levels(data):
        raise integers  # `decode` leaves coarser payloads unread, so it may report another fault
    if isinstance(model, CsplatError) or isinstance(integers, CsplatError):
        # A budget counts the bytes of the returned arrays, which differ between the two functions.
        if _error_place(model) != _error_place(integers) and not any(
            isinstance(result, LimitError) for result in results
        ):
            words = [str(result) if isinstance(result, CsplatError) else "accepted" for result in results]
            raise _DifferError(f"decode and decode_integers differ: {words[0]}; {words[1]}")
        raise model if isinstance(model, CsplatError) else integers
    arrays = {f"floats.{name}": _raw_bytes(getattr(model, name)) for name in _FLOATS}
    arrays |= {f"integers.{name}": _raw_bytes(array) for name, array in integers.items()}
    arrays |= {f"extra.{name}": _raw_bytes(array) for name, array in model.extra.items()}
    return _manifest_header(decoder.read_header(data)), arrays


def _has_levels(data: bytes) -> bool:
    """Return True if a file has coarser levels; False if its header cannot be read."""
    from csplat import decoder

    try:
        return bool(decoder.read_header(data).coarse_tiles)
    except CsplatError:
        return False


def _error_place(result: Any) -> tuple[str, str | None, int | None]:
    """Return code, clause and offset of an error; empty values for other results."""
    return getattr(result, "code", ""), getattr(result, "clause", None), getattr(result, "offset", None)


def _raw_bytes(array: NDArray[Any]) -> bytes:
    """Return the values little-endian in C order."""
    return np.ascontiguousarray(array, array.dtype.newbyteorder("<")).tobytes()


def _manifest_header(header: Any) -> dict[str, Any]:
    """Return the header fields in the form of the manifest."""
    flags = {_spec.SCENE_FLAG_FLAT: header.flat}
    return {
        "profile": header.profile,
        "resource_level": header.resource_level,
        "splat_count": header.splat_count,
        "tile_count": len(header.all_tiles),
        "sh_degree": header.sh_degree,
        "scene_flags": [_spec.SCENE_FLAG_NAMES[bit] for bit, is_set in flags.items() if is_set],
        "axes": "" if header.coordinate_system == "unspecified" else header.coordinate_system,
        "unit_metres": header.unit_metres or 0.0,
        "origin": list(header.origin),
        "kernel": header.kernel,
        "projection": header.projection,
        "antialiasing": header.antialiasing,
        "colour_space": header.colour_space,
        "extra_columns": [[column.name, column.semantic] for column in header.extras if column.dtype is not None],
    }


def main(words: Sequence[str] | None = None) -> int:
    """Decode a file by the protocol: write files and return 0, or print a line of JSON and return 1.

    Args:
        words: command-line arguments; default: this process's arguments.
    """
    parser = argparse.ArgumentParser(prog="csplat_conformance.adapter", description=__doc__)
    parser.add_argument("input", type=Path)
    parser.add_argument("outdir", type=Path, help="with --cuts, the file of cuts")
    parser.add_argument("--cuts", action="store_true", help="print the tiles of cuts")
    args = parser.parse_args(words)
    try:
        if args.cuts:
            lines = args.outdir.read_text(encoding="ascii").splitlines()
            for tiles in cuts_of(args.input.read_bytes(), lines):
                sys.stdout.write((tiles if isinstance(tiles, str) else " ".join(map(str, tiles))) + "\n")
            return 0
        header, arrays = _decode(args.input.read_bytes(), None, DEFAULT_CONTEXT)
    except CsplatError as error:
        code, clause, offset = _error_place(error)
        sys.stdout.write(json.dumps({"code": code, "offset": offset, "clause": clause}) + "\n")
        return 1
    (args.outdir / "header.json").write_text(json.dumps(header), encoding="utf-8")
    for key, raw in arrays.items():
        part, name = key.split(".", 1)
        (args.outdir / f"{part}.{quote(name, safe='')}.bin").write_bytes(raw)
    return 0


if __name__ == "__main__":
    sys.exit(main())

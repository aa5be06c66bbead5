"""Compare the two decoders bit by bit: SHA-256 of every array, floats and integers, of any files.

    python tools/benchmarks/decoders.py scene.csplat other.ply ...      # a PLY is encoded with every preset
    python tools/benchmarks/decoders.py ../shared/data/ply/*.ply --presets fast,small

Python decodes each file with `csplat.decoder`, Node.js with `codec/js`; the float arrays of spec 3, the integer arrays
of spec 9.2 and the extra columns must have the same bytes, and what one refuses the other must refuse with the same
code. Status 1 where something differs. The profile archive is Python's alone.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import struct
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from machine import describe_machine
from scenes import ROOT

from csplat import EncodeOptions, decoder, encode, read_ply
from csplat._spec import ERROR_UNSUPPORTED, PROFILE_ARCHIVE
from csplat.errors import CsplatError
from csplat_tools.files.console import format_table
from csplat_tools.files.streams import is_csplat

_ADAPTER = ROOT / "codec" / "js" / "test" / "adapter.mjs"
_PRESETS = "fast,balanced,small"
_PROFILE_AT = 12  # in the header
_FLOATS = ("means", "quats", "scales", "opacities", "sh0", "shN")


@dataclass(frozen=True)
class Compared:
    """One file, decoded twice.

    Attributes:
        arrays: how many arrays both gave.
        size_bytes: of these arrays.
        different: names of arrays whose bytes differ, or that one decoder alone gave; or what a decoder said.
        sums: SHA-256 by array, of the Python decoder; `refused` and the code where both refuse the file; nothing where
            JavaScript alone does, because of its profile.
    """

    arrays: int
    size_bytes: int
    different: tuple[str, ...]
    sums: dict[str, str]


def main() -> None:
    """Compare the files of the command line, and print a table."""
    args = _arguments()
    print("\n".join(f"{key}: {value}" for key, value in describe_machine().items()))
    rows, wrong, document = [], 0, {}
    command = [args.node, str(_ADAPTER), "--serve"]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as node:
        for path in args.files:
            for label, data in _files(path, args.presets.split(",")):
                compared = compare(data, node)
                splats = _splats(data)
                wrong += bool(compared.different)
                verdict = _verdict(compared)
                rows.append((label, splats, len(data), compared.arrays, compared.size_bytes, verdict))
                document[label] = {"splats": splats, "size_bytes": len(data), "sha256": compared.sums}
                print(f"{label}: {verdict}", file=sys.stderr, flush=True)
        assert node.stdin is not None
        node.stdin.close()
    print(format_table(("file", "splats", "bytes", "arrays", "array bytes", "SHA-256 of all arrays"), rows))
    print(f"{len(rows) - wrong} of {len(rows)} files agree")
    if args.json is not None:
        args.json.write_text(json.dumps(document, indent=2) + "\n")
    sys.exit(1 if wrong or not rows else 0)


def compare(data: bytes, node: subprocess.Popen[bytes]) -> Compared:
    """Decode a file with both decoders.

    Args:
        data: a .csplat file.
        node: the JavaScript decoder behind `adapter.mjs --serve`.
    """
    ours = _python(data)
    theirs = _javascript(data, node)
    if "arrays" not in ours and ours.get("code") == theirs.get("code"):
        return Compared(0, 0, (), {"refused": ours["code"]})
    if theirs.get("code") == ERROR_UNSUPPORTED and data[_PROFILE_AT] == PROFILE_ARCHIVE:
        return Compared(0, 0, (), {})
    if "arrays" not in ours or "arrays" not in theirs:
        said = (("Python", ours), ("JavaScript", theirs))
        return Compared(0, 0, tuple(f"{who} {_refusal(one)}" for who, one in said if "arrays" not in one), {})
    first, second = ours["arrays"], theirs["arrays"]
    different = tuple(name for name in sorted({*first, *second}) if first.get(name) != second.get(name))
    size_bytes = sum(size for size, _ in first.values())
    return Compared(len(first), size_bytes, different, {name: digest for name, (_, digest) in first.items()})


def _python(data: bytes) -> dict[str, Any]:
    """What `csplat.decoder` makes of a file, in the words of `codec/js/test/adapter.mjs`."""
    try:
        model, integers = decoder.decode(data), decoder.decode_integers(data)
    except CsplatError as error:
        return {"code": error.code}
    arrays = {f"floats.{name}": getattr(model, name) for name in _FLOATS}
    arrays |= {f"integers.{name}": array for name, array in integers.items()}
    arrays |= {f"extra.{name}": array for name, array in model.extra.items()}
    sums = {}
    for name, array in arrays.items():
        raw = np.ascontiguousarray(array, array.dtype.newbyteorder("<")).tobytes()
        sums[name] = [len(raw), hashlib.sha256(raw).hexdigest()]
    return {"arrays": sums}


def _javascript(data: bytes, node: subprocess.Popen[bytes]) -> dict[str, Any]:
    assert node.stdin is not None
    assert node.stdout is not None
    node.stdin.write(struct.pack("<I", len(data)) + data)
    node.stdin.flush()
    line = node.stdout.readline()
    if not line:
        sys.exit(f"error: the JavaScript decoder ended with status {node.wait()}")
    return dict(json.loads(line))


def _verdict(compared: Compared) -> str:
    if compared.different:
        return "DIFFERENT: " + ", ".join(compared.different)
    if "refused" in compared.sums:
        return f"both refuse it, {compared.sums['refused']}"
    return "equal" if compared.sums else "profile archive, which JavaScript refuses"


def _refusal(said: dict[str, Any]) -> str:
    return f"refused with {said['code']}" if "code" in said else f"failed: {said.get('defect', '')}".partition("\n")[0]


def _files(path: Path, presets: list[str]) -> Iterator[tuple[str, bytes]]:
    """A .csplat file as it is, a PLY once per preset."""
    if is_csplat(path):
        yield path.name, path.read_bytes()
        return
    try:
        model = read_ply(path)
    except CsplatError as error:
        sys.exit(f"error: {error}")
    for preset in presets:
        yield f"{path.stem} {preset}", encode(model, EncodeOptions(preset=preset))


def _splats(data: bytes) -> int | str:
    try:
        return decoder.read_header(data).splat_count
    except CsplatError:
        return "-"


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("files", type=Path, nargs="+", metavar="FILE", help=".csplat or PLY")
    parser.add_argument("--presets", default=_PRESETS, help="for each PLY, default: %(default)s")
    parser.add_argument("--node", default="node", metavar="PROGRAM", help="Node.js 20 or newer, default: %(default)s")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write all sums, for programs")
    return parser.parse_args()


if __name__ == "__main__":
    main()

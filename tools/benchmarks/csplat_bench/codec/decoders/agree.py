"""Compare the two decoders bit by bit: SHA-256 of every array, floats and integers, of any files.

    python -m csplat_bench.codec.decoders.agree scene.csplat other.ply ...      # a PLY is encoded with every preset
    python -m csplat_bench.codec.decoders.agree ../shared/data/ply/*.ply --presets fast,small

Python decodes each file with `csplat.decoder`, Node.js with `codec/js`; the float arrays of spec 3, the integer arrays
of spec 9.2 and the extra columns must have the same bytes, and what one refuses the other must refuse with the same
code. Status 1 if something differs.
"""

from __future__ import annotations

import hashlib
import json as format_json
import struct
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, TypedDict

import numpy as np
import typer

from csplat import EncodeOptions, decoder, encode, read_ply
from csplat.errors import CsplatError
from csplat_bench.common.command import JSON, PRESETS, listed, preset_of, run
from csplat_bench.common.making import ARRAYS
from csplat_bench.common.report import describe, table, write_json
from csplat_bench.common.scenes import ROOT
from csplat_tools.console import note
from csplat_tools.file_streams import is_csplat

_ADAPTER = ROOT / "codec" / "js" / "test" / "adapter.mjs"


class Said(TypedDict, total=False):
    """A decoder's result for a file, as reported by `codec/js/test/adapter.mjs`.

    Attributes:
        arrays: size in bytes and SHA-256 of each array, by name.
        code: code of the error with which it refuses the file.
        defect: any other failure.
    """

    arrays: dict[str, tuple[int, str]]
    code: str
    defect: str


@dataclass(frozen=True)
class Compared:
    """One file, decoded twice.

    Attributes:
        verdict: in words; begins with DIFFERENT if they differ.
        size_bytes: total size of all arrays.
        sums: SHA-256 by array, of the Python decoder.
    """

    verdict: str
    size_bytes: int = 0
    sums: dict[str, str] = field(default_factory=dict)

    @property
    def differs(self) -> bool:
        """True if the decoders disagree."""
        return self.verdict.startswith("DIFFERENT")


def main(
    files: Annotated[list[Path], typer.Argument(metavar="FILE", help=".csplat or PLY")],
    *,
    presets: PRESETS = "fast,balanced,small",
    node: Annotated[str, typer.Option(metavar="PROGRAM", help="Node.js 20 or newer")] = "node",
    json: JSON = None,
) -> int:
    """Compare the files of the command line, and print a table."""
    print("\n".join(f"{key}: {value}" for key, value in describe().items()))
    rows, sums, wrong = [], {}, 0
    command = [node, str(_ADAPTER), "--serve"]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as process:
        for path in files:
            for label, data in _files(path, listed(presets)):
                one = compare(data, process)
                wrong += one.differs
                rows.append((label, _splats(data), len(data), len(one.sums), one.size_bytes, one.verdict))
                sums[label] = one.sums
                note(f"{label}: {one.verdict}")
        assert process.stdin is not None
        process.stdin.close()
    print(table(("file", "splats", "bytes", "arrays", "array bytes", "SHA-256 of all arrays"), rows))
    print(f"{len(rows) - wrong} of {len(rows)} files agree")
    if json is not None:
        write_json(json, sums)
    return 1 if wrong or not rows else 0


def compare(data: bytes, node: subprocess.Popen[bytes]) -> Compared:
    """Decode a file with both decoders.

    Args:
        data: a .csplat file.
        node: the JavaScript decoder behind `adapter.mjs --serve`.
    """
    ours, theirs = _python(data), _javascript(data, node)
    if "arrays" not in ours and ours.get("code") == theirs.get("code"):
        return Compared(f"both refuse it, {ours['code']}")
    if "arrays" not in ours or "arrays" not in theirs:
        said = (("Python", ours), ("JavaScript", theirs))
        return Compared("DIFFERENT: " + ", ".join(f"{who} {_refusal(one)}" for who, one in said if "arrays" not in one))
    first, second = ours["arrays"], theirs["arrays"]
    different = [name for name in sorted({*first, *second}) if first.get(name) != second.get(name)]
    verdict = f"DIFFERENT: {', '.join(different)}" if different else "equal"
    sums = {name: digest for name, (_, digest) in first.items()}
    return Compared(verdict, sum(size for size, _ in first.values()), sums)


def _python(data: bytes) -> Said:
    try:
        model, integers = decoder.decode(data), decoder.decode_integers(data)
    except CsplatError as error:
        return {"code": error.code}
    arrays = {f"floats.{name}": getattr(model, name) for name in ARRAYS}
    arrays |= {f"integers.{name}": array for name, array in integers.items()}
    arrays |= {f"extra.{name}": array for name, array in model.extra.items()}
    sums = {}
    for name, array in arrays.items():
        raw = np.ascontiguousarray(array, array.dtype.newbyteorder("<")).tobytes()
        sums[name] = len(raw), hashlib.sha256(raw).hexdigest()
    return {"arrays": sums}


def _javascript(data: bytes, node: subprocess.Popen[bytes]) -> Said:
    assert node.stdin is not None
    assert node.stdout is not None
    node.stdin.write(struct.pack("<I", len(data)) + data)
    node.stdin.flush()
    line = node.stdout.readline()
    if not line:
        raise OSError(f"the JavaScript decoder ended with status {node.wait()}")
    said: Said = format_json.loads(line)
    if "arrays" in said:
        said["arrays"] = {name: (size, digest) for name, (size, digest) in said["arrays"].items()}
    return said


def _refusal(said: Said) -> str:
    return f"refused with {said['code']}" if "code" in said else f"failed: {said.get('defect', '')}".partition("\n")[0]


def _files(path: Path, presets: list[str]) -> Iterator[tuple[str, bytes]]:
    """A .csplat file as it is, a PLY once per preset."""
    if is_csplat(path):
        yield path.name, path.read_bytes()
        return
    model = read_ply(path)
    for preset in presets:
        yield f"{path.stem} {preset}", encode(model, EncodeOptions(preset=preset_of(preset)))


def _splats(data: bytes) -> int | str:
    try:
        return decoder.read_header(data).splat_count
    except CsplatError:
        return "-"


if __name__ == "__main__":
    sys.exit(run(main))

# SPDX-License-Identifier: Apache-2.0
"""The Python and the JavaScript decoder, compared bit by bit: SHA-256 of every array, floats and integers.

A scene is a PLY, encoded with the case's `preset`, or the path of a .csplat file. The float arrays of spec 3, the
integer arrays of spec 9.2 and the extra columns must have the same bytes, and a file that one decoder refuses the other
must refuse with the same code. A case that differs fails. Option `node`: the program. Default: node.
"""

from __future__ import annotations

import hashlib
import json
import struct
import subprocess
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TypedDict

import numpy as np

from csplat import EncodeOptions, decoder, encode
from csplat.errors import CsplatError
from csplat.ply import read_ply
from csplat_bench.made_scenes import ARRAYS
from csplat_bench.protocol import Measure, Setup
from csplat_bench.scenes import ROOT, find_scene
from csplat_bench.suites import Case

_ADAPTER = ROOT / "codec" / "js" / "test" / "adapter.mjs"


class Decoded(TypedDict, total=False):
    """A decoder's result for a file, as reported by `codec/js/test/adapter.mjs`.

    Attributes:
        arrays: size in bytes and SHA-256 of each array, by name.
        code: code of the error with which it refuses the file.
        defect: any other failure.
    """

    arrays: dict[str, tuple[int, str]]
    code: str
    defect: str


@contextmanager
def compare_decoders(setup: Setup, name: str, _: Sequence[Case]) -> Iterator[Measure]:
    """Yield the function that decodes a file with both decoders."""
    is_file = name.endswith(".csplat")
    path = Path(name) if is_file else find_scene(name, setup.data, setup.work).path
    command = [setup.options.get("node", "node"), str(_ADAPTER), "--serve"]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as process:

        def measure(case: Case) -> Mapping[str, Any]:
            data = path.read_bytes() if is_file else encode(read_ply(path), EncodeOptions(preset=case["preset"]))
            return {"size_bytes": len(data), **compare(data, process)}

        try:
            yield measure
        finally:
            assert process.stdin is not None
            process.stdin.close()


def compare(data: bytes, node: subprocess.Popen[bytes]) -> dict[str, Any]:
    """Decode a file with both decoders.

    Args:
        data: a .csplat file.
        node: the JavaScript decoder behind `adapter.mjs --serve`.

    Raises:
        OSError: the results differ.
    """
    ours, theirs = _python(data), _javascript(data, node)
    if "arrays" not in ours and ours.get("code") == theirs.get("code"):
        return {"verdict": f"both refuse it, {ours['code']}", "arrays": 0, "array_bytes": 0}
    if "arrays" not in ours or "arrays" not in theirs:
        named = (("Python", ours), ("JavaScript", theirs))
        text = ", ".join(f"{name} {_refusal(one)}" for name, one in named if "arrays" not in one)
        raise OSError(f"the decoders differ: {text}")
    first, second = ours["arrays"], theirs["arrays"]
    different = [name for name in sorted({*first, *second}) if first.get(name) != second.get(name)]
    if different:
        raise OSError(f"the decoders differ: {', '.join(different)}")
    return {"verdict": "equal", "arrays": len(first), "array_bytes": sum(size for size, _ in first.values())}


def _python(data: bytes) -> Decoded:
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


def _javascript(data: bytes, node: subprocess.Popen[bytes]) -> Decoded:
    assert node.stdin is not None
    assert node.stdout is not None
    node.stdin.write(struct.pack("<I", len(data)) + data)
    node.stdin.flush()
    line = node.stdout.readline()
    if not line:
        raise OSError(f"the JavaScript decoder ended with status {node.wait()}")
    found: Decoded = json.loads(line)
    if "arrays" in found:
        found["arrays"] = {name: (size, digest) for name, (size, digest) in found["arrays"].items()}
    return found


def _refusal(found: Decoded) -> str:
    if "code" in found:
        return f"refuses it with {found['code']}"
    return f"fails: {found.get('defect', '')}".partition("\n")[0]

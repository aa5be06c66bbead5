# SPDX-License-Identifier: Apache-2.0
"""Measure what the readers need for the worst inputs that we know: bytes of memory and microseconds of CPU per byte.

    python tools/lab/budgets.py              # a table in Markdown
    python tools/lab/budgets.py ply sog      # the inputs whose names contain one of these

Each input has about two megabytes, unless a limit refuses it, and is read by a process of its own that has read a small
file before. Memory is the difference between the peak and the memory before reading; it includes a mapped file.
"""

from __future__ import annotations

import base64
import gzip
import io
import json
import os
import struct
import subprocess
import sys
import tempfile
import time
import zipfile
import zlib
from collections.abc import Callable
from importlib import import_module
from pathlib import Path

import numpy as np

_SIZE = 2_000_000  # bytes of an input
_ADDRESS_SPACE = 12 << 30  # bytes; a reader without a limit fails instead of the machine
_SECONDS = 120.0
_GROUPS = {"": "xyz", "f_dc_": "012", "opacity": [""], "scale_": "012", "rot_": "0123"}  # columns of a splat
_PROPERTIES = "".join(f"property float {group}{end}\n" for group, ends in _GROUPS.items() for end in ends)
_ONE = "element vertex 1\n" + _PROPERTIES
_ROW = struct.pack("<14f", *[0.1] * 14)
_TEXT_ROW = b"0.1 " * 13 + b"0.1\n"

Files = dict[str, bytes]


def _ply(head: str, body: bytes, form: str = "binary_little_endian") -> Files:
    return {"a.ply": f"ply\nformat {form} 1.0\n{head}end_header\n".encode() + body}


def _zip(members: dict[str, bytes], way: int = zipfile.ZIP_DEFLATED) -> bytes:
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w", way) as archive:
        for name, data in members.items():
            archive.writestr(name, data)
    return out.getvalue()


def _array(data: np.ndarray) -> bytes:
    out = io.BytesIO()
    np.save(out, data)
    return out.getvalue()


def _gltf(text: str, binary: bytes = b"") -> Files:
    data = text.encode()
    data += b" " * (-len(data) % 4)
    binary += b"\0" * (-len(binary) % 4)
    chunks = struct.pack("<II", len(data), 0x4E4F534A) + data
    chunks += struct.pack("<II", len(binary), 0x004E4942) + binary if binary else b""
    return {"a.glb": struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks}


def _nodes(count: int) -> str:
    nodes = ",".join(f'{{"children":[{index + 1}]}}' for index in range(count - 1))
    return f'{{"asset":{{"version":"2.0"}},"scenes":[{{"nodes":[0]}}],"nodes":[{nodes},{{}}]}}'


def _webp(side: int) -> bytes:
    from PIL import Image

    out = io.BytesIO()
    Image.new("RGBA", (side, side)).save(out, "WEBP", lossless=True, method=0)
    return out.getvalue()


def _sog() -> Files:
    side = 9000
    names = ("means_l", "means_u", "scales", "quats", "sh0")
    table = [0.0] * 256
    meta = {
        "version": 2, "count": side * side, "scales": {"codebook": table, "files": ["scales.webp"]},
        "means": {"mins": [0, 0, 0], "maxs": [1, 1, 1], "files": ["means_l.webp", "means_u.webp"]},
        "quats": {"files": ["quats.webp"]}, "sh0": {"codebook": table, "files": ["sh0.webp"]},
    }  # fmt: skip
    image = _webp(side)
    return {"a.sog": _zip({"meta.json": json.dumps(meta).encode(), **{f"{name}.webp": image for name in names}})}


def _csplat(text: bytes, *, deflates: bool = True) -> Files:
    from csplat import _spec
    from csplat_authoring.builder import build
    from csplat_authoring.samples import scene
    from csplat_authoring.scene import Chunk, Stream

    coder = zlib.compressobj(9, zlib.DEFLATED, -15)
    coding = Stream(coder="deflate", coded=coder.compress(text) + coder.flush()) if deflates else Stream()
    return {"a.csplat": build(scene(chunks=(Chunk(_spec.CHUNK_METADATA, text, coding),))).data}


def _values(opening: bytes, value: bytes, closing: bytes, size: int) -> bytes:
    return opening + b",".join([value] * (size // (len(value) + 1))) + closing


_POSE = "1 0 0 0 0 0 0"
#: The file to read is the first one; a data set is read as a folder.
INPUTS: dict[str, Callable[[], Files]] = {
    "PLY: empty lists before the splats": lambda: _ply(
        f"element a {_SIZE}\nproperty list uchar int a\n{_ONE}", bytes(_SIZE) + _ROW
    ),
    "PLY: 200 empty lists per splat": lambda: _ply(
        f"element vertex {_SIZE // 256}\n{_PROPERTIES}"
        + "".join(f"property list uchar int a{index}\n" for index in range(200)),
        (_ROW + bytes(200)) * (_SIZE // 256),
    ),
    "PLY: bytes before the splats": lambda: _ply(f"element a {_SIZE}\nproperty char a\n{_ONE}", bytes(_SIZE) + _ROW),
    "PLY: header of comments": lambda: _ply("comment\n" * 130_000 + _ONE, _ROW),
    "PLY: header of properties": lambda: _ply(
        "element a 0\n" + "".join(f"property char {index}\n" for index in range(47_000)) + _ONE, _ROW
    ),
    "PLY: count of 900,000 digits": lambda: _ply(f"element a {'9' * 900_000}\n{_ONE}", _ROW),
    "PLY, text: empty lists": lambda: _ply(
        f"element a {_SIZE // 2}\nproperty list uchar int a\n{_ONE}", b"0\n" * (_SIZE // 2) + _TEXT_ROW, "ascii"
    ),
    "PLY, text: blank lines": lambda: _ply(_ONE, b"\n" * _SIZE + _TEXT_ROW, "ascii"),
    "PLY, text: one line": lambda: _ply(
        f"element a {_SIZE // 2}\nproperty char a\n{_ONE}", b"0 " * (_SIZE // 2) + b"\n" + _TEXT_ROW, "ascii"
    ),
    "PLY, text: splats": lambda: _ply(
        f"element vertex {_SIZE // 28}\n{_PROPERTIES}", (b"0 " * 13 + b"0\n") * (_SIZE // 28), "ascii"
    ),
    "PLY, text: lists of splats": lambda: _ply(
        f"element vertex {_SIZE // 30}\n{_PROPERTIES}property list uchar int a\n",
        (b"0 " * 14 + b"0\n") * (_SIZE // 30),
        "ascii",
    ),
    "PLY, text: decimal commas": lambda: _ply(
        f"element vertex {_SIZE // 56}\n{_PROPERTIES}", (b"0,0 " * 13 + b"0,0\n") * (_SIZE // 56), "ascii"
    ),
    "PLY, text: exponents of Fortran": lambda: _ply(
        f"element vertex {_SIZE // 56}\n{_PROPERTIES}", (b"0d0 " * 13 + b"0d0\n") * (_SIZE // 56), "ascii"
    ),
    ".npz: deflated zeros": lambda: {"a.npz": _zip({"facts.npy": _array(np.zeros(400_000_000, np.uint8))})},
    ".npz: bzip2": lambda: {"a.npz": _zip({"facts.npy": _array(np.zeros(10**8, np.uint8))}, zipfile.ZIP_BZIP2)},
    ".npz: arrays of one byte": lambda: {
        "a.npz": _zip({f"{index}.npy": _array(np.zeros(1, np.uint8)) for index in range(4000)}, zipfile.ZIP_STORED)
    },
    ".npz: header of 2 MB": lambda: {
        "a.npz": _zip({"facts.npy": b"\x93NUMPY\2\0" + struct.pack("<I", _SIZE) + b"{" + b"[" * (_SIZE - 1)})
    },
    "zip: 40,000 names": lambda: {"a.sog": _zip({f"{index}": b"" for index in range(40_000)}, zipfile.ZIP_STORED)},
    "SPZ: zeros in gzip": lambda: {
        "a.spz": gzip.compress(struct.pack("<4sIIBBBB", b"NGSP", 2, 40_000_000 // 19, 0, 12, 0, 0) + bytes(40_000_000))
    },
    "SOG: images of one colour": _sog,
    "SOG: JSON of empty arrays": lambda: {"meta.json": _values(b'{"a":[', b"[]", b"]}", _SIZE)},
    "SOG: lod-meta.json of files": lambda: {
        "lod-meta.json": _values(b'{"lodLevels":1,"tree":{},"filenames":[', b'"a"', b"]}", _SIZE)
    },
    ".splat: zeros": lambda: {"a.splat": bytes(_SIZE // 32 * 32)},
    "glTF: nodes in nodes": lambda: _gltf(_nodes(_SIZE // 20)),
    "glTF: scene of empty nodes": lambda: _gltf(
        '{"asset":{"version":"2.0"},"scenes":[{"nodes":['
        + ",".join(map(str, range(_SIZE // 10)))
        + ']}],"nodes":['
        + ",".join(["{}"] * (_SIZE // 10))
        + "]}"
    ),
    "glTF: buffer as base64": lambda: {
        "a.gltf": json.dumps(
            {
                "asset": {"version": "2.0"},
                "buffers": [
                    {"byteLength": 3, "uri": "data:;base64," + base64.b64encode(bytes(_SIZE)).decode("ascii")}
                ],
            }
        ).encode()
    },
    ".csplat: text of empty arrays": lambda: _csplat(_values(b'{"a":[', b"[]", b"]}", 2_700_000)),
    ".csplat: text of empty arrays, stored": lambda: _csplat(_values(b'{"a":[', b"[]", b"]}", _SIZE), deflates=False),
    ".csplat: text of keys": lambda: _csplat(
        b"{" + b",".join(b'"%d":0' % index for index in range(_SIZE // 11)) + b"}", deflates=False
    ),
    ".csplat: text of 17 MB": lambda: _csplat(_values(b'{"a":[', b"[]", b"]}", 17_000_000)),
    "cameras: empty objects": lambda: {"cameras.json": _values(b"[", b"{}", b"]", _SIZE)},
    "cameras: numbers": lambda: {
        "cameras.json": _values(
            b"[",
            b'{"K":[[1,0,1],[0,1,1],[0,0,1]],"viewmat":[[1,0,0,0],[0,1,0,0],[0,0,1,0],[0,0,0,1]],"W":2,"H":2}',
            b"]",
            _SIZE,
        )
    },
    "transforms.json: frames": lambda: {
        "transforms.json": _values(b'{"w":2,"h":2,"fl_x":1,"frames":[', b'{"file_path":"a"}', b"]}", _SIZE)
    },
    "COLMAP, text: blank lines": lambda: {
        "images.txt": f"1 {_POSE} 1 a\n".encode() + b"\n" * _SIZE, "cameras.txt": b"1 SIMPLE_PINHOLE 2 2 1 1 1\n",
    },
    "COLMAP, text: images": lambda: {
        "images.txt": "".join(f"{index} {_POSE} 1 {index}\n\n" for index in range(_SIZE // 28)).encode(),
        "cameras.txt": b"1 SIMPLE_PINHOLE 2 2 1 1 1\n",
    },
    "COLMAP, text: points": lambda: {"points3D.txt": b"1 0 0 0 0 0 0 0\n" * (_SIZE // 16)},
    "COLMAP: images": lambda: {
        "images.bin": struct.pack("<Q", _SIZE // 74)
        + b"".join(struct.pack("<I7dI", index, 1, *[0] * 6, 1) + b"a\0" + bytes(8) for index in range(_SIZE // 74))
    },
    "COLMAP: points": lambda: {
        "points3D.bin": struct.pack("<Q", _SIZE // 51) + bytes(51) * (_SIZE // 51)
    },
}  # fmt: skip


def _read(path: Path) -> None:
    """Read a file as commands do, whole."""
    from csplat.archives import read_archive

    name = path.name
    if name.endswith(".npz"):
        read_archive(path, "a checkpoint").facts()
    elif name == "cameras.json":
        from csplat_render.camera_files import load_cameras

        load_cameras(path)
    elif name == "transforms.json":
        from csplat_trainer.data.loader import load

        load(path.parent)
    elif name.startswith("images"):
        from csplat_trainer.data.colmap import read_images

        read_images(path)
    elif name.startswith("points3D"):
        from csplat_trainer.data.colmap import read_points

        read_points(path)
    elif name.endswith(".csplat"):
        import csplat

        csplat.decode(path.read_bytes())
    else:
        with csplat.open(path) as scene:
            for _ in scene.blocks():
                pass


def _measure(path: Path) -> None:
    """Print the bytes, microseconds and result of reading a file, as JSON; runs in a process of its own."""
    import_module("csplat_render.camera_files")
    import_module("csplat_trainer.data.colmap")
    import_module("csplat_trainer.data.loader")
    from csplat.errors import CsplatError

    with tempfile.TemporaryDirectory() as folder:  # what is loaded at first use does not count
        for name, data in {**_ply(_ONE, _ROW), "a.splat": struct.pack("<8f", *[0.5] * 8)}.items():
            (Path(folder) / name).write_bytes(data)
            _read(Path(folder) / name)
    Path("/proc/self/clear_refs").write_text("5", encoding="ascii")  # resets the peak
    before, begun = _status("VmRSS"), time.process_time()
    try:
        _read(path)
        result = "read"
    except CsplatError as error:
        result = "refused" if error.code != "E_LIMIT" else "limit"
        print(error, file=sys.stderr)
    except Exception as error:  # noqa: BLE001 -- the fault that this program looks for
        result = f"**{type(error).__name__}**"
    print(json.dumps([max(0, _status("VmHWM") - before), (time.process_time() - begun) * 1e6, result]))


def _status(name: str) -> int:
    lines = Path("/proc/self/status").read_text(encoding="ascii").splitlines()
    return 1024 * next(int(line.split()[1]) for line in lines if line.startswith(f"{name}:"))


def main(words: list[str]) -> None:
    """Print the table."""
    if words[:1] == ["--measure"]:
        import resource

        resource.setrlimit(resource.RLIMIT_AS, (_ADDRESS_SPACE, _ADDRESS_SPACE))
        _measure(Path(words[1]))
        return
    print("| input | size, kB | memory, MB | bytes per byte | µs per byte | result |\n|---|---|---|---|---|---|")
    for title, make in INPUTS.items():
        if words and not any(word in title for word in words):
            continue
        with tempfile.TemporaryDirectory() as folder:
            files = make()
            for name, data in files.items():
                (Path(folder) / name).write_bytes(data)
            first = next(iter(files))
            command = [sys.executable, __file__, "--measure", str(Path(folder) / first)]
            size = len(files[first])
            try:
                done = subprocess.run(command, capture_output=True, timeout=_SECONDS, check=True, text=True)
            except (subprocess.TimeoutExpired, subprocess.CalledProcessError) as error:
                print(f"| {title} | {size / 1e3:,.0f} | | | | **{type(error).__name__}** |", flush=True)
                continue
            memory, micros, result = json.loads(done.stdout.splitlines()[-1])
            cells = f"{size / 1e3:,.0f} | {memory / 1e6:,.0f} | {memory / size:,.1f} | {micros / size:,.2f} | {result}"
            print(f"| {title} | {cells} |", flush=True)
            if "CSPLAT_SHOW" in os.environ:
                print(done.stderr.strip()[:200], file=sys.stderr)


if __name__ == "__main__":
    main(sys.argv[1:])

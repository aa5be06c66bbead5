# SPDX-License-Identifier: Apache-2.0
"""Identify files: a table of the formats that csplat reads and of other files that users pass by mistake.

Content takes precedence over the file name. Only the first bytes and the names in a zip are examined; nothing is
parsed. The readers of `csplat.formats` have the names of this table. The table is separate from them because the PLY
reader uses it to refuse other formats, which it must not import.
"""

from __future__ import annotations

import struct
import zipfile
import zlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from csplat._spec import MAGIC
from csplat.archives import folder_refusal, zip_refusal
from csplat.errors import InputError
from csplat.file_source import describe_substitute, open_binary

#: Size of the beginning of a file that identifies it, bytes.
HEAD_SIZE = 512

_SPLAT_TRANSFORM = "splat-transform (npm package @playcanvas/splat-transform)"
_NOT_READ = "which csplat does not read: convert it to PLY first, with"
_NO_SPLATS = "not a scene of splats"
_PROJECT = "not a scene: export the splats as PLY in that program"
_PLY_HEADER_SIZE = 1 << 16  # bytes within which a compressed PLY declares its packed columns
_KSPLAT_HEAD = 44  # used bytes of .ksplat's header; the rest are 0
_SPLAT_ROW_SIZE = 32  # bytes per splat of a .splat file
_SAFETENSORS_HEAD = 100_000_000  # maximum size of the JSON header of safetensors, bytes
_LCC_PARTS = {"data.bin", "index.bin", "shcoef.bin", "environment.bin", "attrs.lcp"}  # files next to an LCC's index
_MANIFESTS = {"meta.json", "lod-meta.json"}  # manifests in a SOG file
_PLY, _CSPLAT = "ply", "csplat"


@dataclass(frozen=True)
class FileKind:
    """A kind of file.

    Attributes:
        name: id of the kind; for a format that csplat reads, the name of its `csplat.formats.format.Format`.
        title: name in prose: `SPZ 4`.
        suffixes: file name suffixes in lower case with their dots, the usual suffix first.
        matches: returns True if the path and the first bytes (empty for a folder) are of this kind.
        remedy: advice to the user that follows "<file> is <title>, "; "" if csplat has a reader.
    """

    name: str
    title: str
    suffixes: tuple[str, ...] = ()
    matches: Callable[[Path, bytes], bool] = lambda _path, _head: False
    remedy: str = ""

    @property
    def is_scene(self) -> bool:
        """True for every splat format, including formats that csplat does not read."""
        return not self.remedy or self.remedy.startswith(_NOT_READ)


def detect_content(path: Path, head: bytes) -> FileKind | None:
    """Identify a file or folder by its content; return `None` if its kind is unknown.

    Args:
        path: path of the file; zips, folders and PLYs are opened.
        head: the first `HEAD_SIZE` bytes, or all of a shorter file; empty for a folder.

    Raises:
        InputError: the content is a placeholder such as a Git LFS pointer or an HTML page.
    """
    instead = describe_substitute(head)
    if instead:
        raise InputError(f"{path.name} is {instead}")
    return next((kind for kind in KINDS.values() if kind.matches(path, head)), None)


def detect_name(path: Path) -> FileKind | None:
    """Identify a file by its name; return `None` if the suffix is unknown."""
    name = path.name.lower()
    matches = [(len(suffix), kind) for kind in KINDS.values() for suffix in kind.suffixes if name.endswith(suffix)]
    return max(matches, key=lambda match: match[0])[1] if matches else None


def read_head(path: Path) -> bytes:
    """Return the first bytes of a file for `detect_content`; b"" for a folder.

    Raises:
        OSError: the file cannot be read.
    """
    if path.is_dir():
        return b""
    with open_binary(path) as stream:
        return stream.read(HEAD_SIZE)


def refusal(path: Path, head: bytes, *, wanted: str = "", shown: str = "") -> InputError:
    """Return the error for a file of the wrong kind; it names the kind and a remedy.

    Args:
        path: path of the file.
        head: as in `detect_content`.
        wanted: name of the only kind that the caller reads; "" if it reads all formats of csplat.
        shown: name of the file, if it is a copy; "": `path`.
    """
    if path.is_dir() and wanted and not detect_content(path, head):
        return InputError(f"{path.name} is a folder, expected a {KINDS[wanted].title}")
    if path.is_dir() and not wanted and not detect_content(path, head):
        return InputError(folder_refusal(path))
    if not (head or path.is_dir()):
        return InputError(f"{path.name} is empty" + (f", expected a {KINDS[wanted].title}" if wanted else ""))
    try:
        kind = detect_content(path, head) or detect_name(path)
    except InputError as error:
        return error
    if kind is not None and kind.name == "zip":
        return InputError(zip_refusal(path))
    begin = f"it begins with {head[:8]!r}"
    if kind is not None and kind.remedy:
        return InputError(f"{path.name} is {kind.title}, {kind.remedy}")
    if kind is None or kind.name == wanted:
        if path.stat().st_size % _SPLAT_ROW_SIZE == 0 and not head[:_SPLAT_ROW_SIZE].isascii():
            tool = "convert it to PLY first, with `csplat convert --from splat`" if wanted else "--from splat reads it"
            begin = f"its size, a multiple of {_SPLAT_ROW_SIZE} bytes, fits a .splat file: if it is one, {tool}"
        state = f"not a {KINDS[wanted].title}" if wanted else "in no format that csplat knows"
        return InputError(f"{path.name} is {state}: {begin}" + ("; expected Gaussian splats" if wanted else ""))
    if wanted == _CSPLAT:
        title = f"a {kind.title}" if kind.name == _PLY else kind.title
        return InputError(f"{shown or path} is {title}, expected a .csplat file: convert it with `csplat encode`")
    tool = "`csplat decode`" if kind.name == _CSPLAT else "`csplat convert`, or use csplat.read, which reads it"
    return InputError(f"{path.name} is {kind.title}, not a plain PLY: convert it to PLY first, with {tool}")


def _starts_with(*magics: bytes) -> Callable[[Path, bytes], bool]:
    """Return a test for files that start with one of some byte strings."""
    return lambda _path, head: head.startswith(magics)


def is_ply(head: bytes) -> bool:
    """Return True if a file begins like a PLY; a byte order mark, capitals and spaces are accepted."""
    head = head.removeprefix(b"\xef\xbb\xbf")
    return head[:3].lower() == b"ply" and head[3:].lstrip(b" \t")[:1] in (b"\n", b"\r")


def _declares(word: bytes) -> Callable[[Path, bytes], bool]:
    """Return a test for PLYs with a word in their headers."""

    def matches(path: Path, head: bytes) -> bool:
        if not is_ply(head):
            return False
        if b"end_header" not in head and path.is_file():  # packed columns are declared after bounds and comments
            with open_binary(path) as stream:
                head = stream.read(_PLY_HEADER_SIZE)
        return word in head.partition(b"end_header")[0]

    return matches


def _is_spz(_path: Path, head: bytes) -> bool:
    """Return True for the magic number of SPZ, plain (version 4) or at the start of gzip data (1 to 3)."""
    if head[:2] == b"\x1f\x8b":
        try:
            head = zlib.decompressobj(wbits=31).decompress(head, 4)
        except zlib.error:
            return False
    return head[:4] == b"NGSP"


def _is_gzip(path: Path, head: bytes) -> bool:
    """Return True for a gzip file under another name than .spz, for which the SPZ reader reports the damage."""
    return head[:3] == b"\x1f\x8b\x08" and path.suffix.lower() != ".spz"  # the SPZ reader reports the damage


def _is_ksplat(_path: Path, head: bytes) -> bool:
    """Return True if a file begins with version 0.1 and `head` is zeros after the fields of the header."""
    return head[:4] == b"\0\1\0\0" and len(head) > _KSPLAT_HEAD and not any(head[_KSPLAT_HEAD:])


def _is_sog(path: Path, head: bytes) -> bool:
    """Return True for a folder, zip or JSON with a manifest of SOG; a damaged zip counts if it is named .sog."""
    if path.is_dir():
        return any((path / name).is_file() for name in _MANIFESTS)
    if head[:4] == b"PK\x03\x04":
        names = _names_in_zip(path)
        if names is None:
            return path.suffix.lower() == ".sog"
        return any(name.replace("\\", "/").rsplit("/", 1)[-1].lower() in _MANIFESTS for name in names)
    return _is_json(path, head) and path.name.lower().endswith("meta.json")


def _zip_with(ending: str) -> Callable[[Path, bytes], bool]:
    """Return a test for zips with a member whose name has this suffix."""

    def matches(path: Path, head: bytes) -> bool:
        return head[:4] == b"PK\x03\x04" and any(name.endswith(ending) for name in _names_in_zip(path) or ())

    return matches


def _names_in_zip(path: Path) -> list[str] | None:
    """Return the names of the members of a zip; `None` if it is damaged or cannot be read."""
    try:
        with zipfile.ZipFile(path) as archive:
            return archive.namelist()
    except (OSError, zipfile.BadZipFile, NotImplementedError, ValueError, struct.error):  # the archive is damaged
        return None


def _is_gltf(path: Path, head: bytes) -> bool:
    """Return True for .glb by its magic number, and for JSON that is named .gltf or has an "asset"."""
    return head[:4] == b"glTF" or (_is_json(path, head) and (path.suffix.lower() == ".gltf" or b'"asset"' in head))


def _is_tileset(path: Path, head: bytes) -> bool:
    """Return True for a JSON of 3D Tiles, by its name or by "geometricError"."""
    return _is_json(path, head) and (path.name.lower() == "tileset.json" or b'"geometricError"' in head)


def _is_json(_path: Path, head: bytes) -> bool:
    """Return True if the content is text that begins like JSON; a lone brace may also begin a binary file."""
    text = head.removeprefix(b"\xef\xbb\xbf").lstrip()
    begins = text[:1] == b"[" or (text[:1] == b"{" and text[1:].lstrip()[:1] in (b'"', b"}", b""))
    return begins and not any(byte < 32 and byte not in b"\t\n\r" for byte in text)


def _is_lcc(path: Path, head: bytes) -> bool:
    """Return True for the index of an LCC scene, its folder, or another file of it."""
    if path.is_dir():
        return _holds(path, ".lcc")
    if path.name.lower() in _LCC_PARTS:
        return _holds(path.parent, ".lcc")
    return _is_json(path, head) and (path.suffix.lower() == ".lcc" or b'"cellLengthX"' in head)


def _is_lcc2(path: Path, head: bytes) -> bool:
    """Return True for a folder with an .lcc2, or for JSON by that suffix or by "splatType"."""
    if path.is_dir():
        return _holds(path, ".lcc2")
    return _is_json(path, head) and (path.suffix.lower() == ".lcc2" or b'"splatType"' in head)


def _holds(folder: Path, suffix: str) -> bool:
    """Return True if a folder contains a file with a suffix; False if it cannot be listed."""
    try:
        return any(entry.suffix.lower() == suffix for entry in folder.iterdir())
    except OSError:
        return False


def _is_safetensors(_path: Path, head: bytes) -> bool:
    """Return True for a plausible length of the head, 8 bytes, and the start of its JSON."""
    return head[8:10] == b'{"' and 0 < int.from_bytes(head[:8], "little") < _SAFETENSORS_HEAD


def _is_usd(path: Path, head: bytes) -> bool:
    """Return True for USD in binary or text, or a zip with a layer of USD."""
    return head.startswith((b"PXR-USDC", b"#usda")) or _zip_with(".usdc")(path, head) or _zip_with(".usda")(path, head)


#: All kinds by name. If several match, the first counts.
KINDS: dict[str, FileKind] = {
    kind.name: kind
    for kind in (
        FileKind("compressed-ply", "compressed PLY", (".compressed.ply",), _declares(b"packed_position")),
        FileKind(
            "codebook-ply",
            "a PLY with codebooks (Reducing the Memory Footprint of 3D Gaussian Splatting)",
            (),
            _declares(b"element codebook_centers"),
            "which csplat does not read: save it there without quantisation",
        ),
        FileKind(_PLY, "PLY", (".ply",), lambda _path, head: is_ply(head)),
        FileKind(_CSPLAT, "csplat", (".csplat",), _starts_with(MAGIC)),
        FileKind("spz", "SPZ", (".spz",), _is_spz),
        FileKind("spz4", "SPZ 4", (".v4.spz",)),
        FileKind("splat", ".splat", (".splat",)),
        FileKind("ksplat", ".ksplat", (".ksplat",), _is_ksplat),
        FileKind("lcc", "LCC", (".lcc",), _is_lcc, f"{_NOT_READ} {_SPLAT_TRANSFORM}, which takes the .lcc file"),
        FileKind(
            "lcc2",
            "LCC2",
            (".lcc2",),
            _is_lcc2,
            "which csplat does not read: its splats are .sog or .spz files in data/3dgs, which csplat reads one by one",
        ),
        FileKind("sog", "SOG", (".sog", "meta.json", "lod-meta.json"), _is_sog),
        FileKind(
            "tileset", "a tileset of 3D Tiles", (), _is_tileset, "which csplat does not read: its tiles are .glb files"
        ),
        FileKind("gltf", "glTF", (".glb", ".gltf"), _is_gltf),
        FileKind("gltf-csplat", "glTF with csplat", (".csplat.glb",)),
        FileKind("checkpoint", "a checkpoint of gsplat, splatfacto or INRIA", (".pt", ".ckpt"), _zip_with("/data.pkl")),
        FileKind("spx", ".spx", (".spx",), _starts_with(b"spx\1", b"spx\2", b"spx\3"), f"{_NOT_READ} gsbox"),
        FileKind("parquet", "Parquet", (".parquet",), _starts_with(b"PAR1"), f"{_NOT_READ} the program that wrote it"),
        FileKind(
            "splatv",
            ".splatv of splaTV",
            (".splatv",),
            _starts_with(b"\x4b\x67\0\0"),
            "splats that move, which csplat does not read",
        ),
        FileKind("psht", "a project of Postshot", (".psht",), remedy=_PROJECT),
        FileKind("licht", "a project of LichtFeld Studio", (".licht",), remedy=_PROJECT),
        FileKind("blend", "a file of Blender", (".blend",), _starts_with(b"BLENDER"), _PROJECT),
        FileKind("draco", "Draco", (".drc",), _starts_with(b"DRACO"), f"a mesh or point cloud, {_NO_SPLATS}"),
        FileKind(
            "rad",
            "RAD of Spark",
            (".rad",),
            _starts_with(b"RAD0"),
            f"{_NOT_READ} Spark, or use the file it was made from",
        ),
        FileKind("usd", "USD", (".usdz", ".usdc", ".usda", ".usd"), _is_usd, f"{_NOT_READ} the program that wrote it"),
        FileKind(
            "3d-tiles",
            "a tile of 3D Tiles",
            (".b3dm", ".i3dm", ".pnts", ".cmpt"),
            _starts_with(b"b3dm", b"i3dm", b"pnts", b"cmpt"),
            "which csplat does not read: tiles of splats are .glb files",
        ),
        FileKind("gzip", "gzip", (".gz",), _is_gzip, "unpack it first, with gunzip"),
        FileKind("zip", "zip", (".zip",), _starts_with(b"PK\x03\x04"), "unzip it first"),
        FileKind("7z", "7z", (".7z",), _starts_with(b"7z\xbc\xaf\x27\x1c"), "unpack it first"),
        FileKind("rar", "RAR", (".rar",), _starts_with(b"Rar!\x1a\x07"), "unpack it first"),
        FileKind("zstd", "zstd", (".zst",), _starts_with(b"\x28\xb5\x2f\xfd"), "unpack it first, with unzstd"),
        FileKind("xz", "xz", (".xz",), _starts_with(b"\xfd7zXZ\0"), "unpack it first, with unxz"),
        FileKind(
            "bzip2",
            "bzip2",
            (".bz2",),
            lambda _path, head: head[:3] == b"BZh" and head[4:10] == b"1AY&SY",
            "unpack it first, with bunzip2",
        ),
        FileKind("tar", "tar", (".tar",), lambda _path, head: head[257:262] == b"ustar", "unpack it first"),
        FileKind("png", "a PNG", (".png",), _starts_with(b"\x89PNG\r\n"), f"an image, {_NO_SPLATS}"),
        FileKind("jpeg", "a JPEG", (".jpg", ".jpeg"), _starts_with(b"\xff\xd8\xff"), f"an image, {_NO_SPLATS}"),
        FileKind("pdf", "a PDF", (".pdf",), _starts_with(b"%PDF-"), _NO_SPLATS),
        FileKind("las", "LAS", (".las", ".laz"), _starts_with(b"LASF"), f"a point cloud, {_NO_SPLATS}"),
        FileKind("e57", "E57", (".e57",), _starts_with(b"ASTM-E57"), f"a point cloud, {_NO_SPLATS}"),
        FileKind("obj", "OBJ", (".obj",), remedy=f"a mesh, {_NO_SPLATS}"),
        FileKind("fbx", "FBX", (".fbx",), _starts_with(b"Kaydara FBX"), f"a mesh, {_NO_SPLATS}"),
        FileKind(
            "safetensors",
            "safetensors",
            (".safetensors",),
            _is_safetensors,
            "which csplat does not read: csplat.from_gsplat converts tensors under gsplat's names",
        ),
        FileKind(
            "npy",
            "a NumPy array",
            (".npy",),
            _starts_with(b"\x93NUMPY"),
            "not a scene: csplat.from_gsplat converts arrays under gsplat's names",
        ),
        FileKind("rtf", "RTF", (".rtf",), _starts_with(b"{\\rtf"), f"a text document, {_NO_SPLATS}"),
        FileKind("json", "JSON", (), _is_json, _NO_SPLATS),
    )
}

# SPDX-License-Identifier: Apache-2.0
"""Open the files, standard input and standard output of commands.

`-` is standard input or output. A file appears under its name only when it is complete, and an existing file
is replaced only with `force`.
"""

from __future__ import annotations

import errno
import io
import json
import os
import shutil
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from mmap import mmap
from pathlib import Path
from typing import Any, BinaryIO, cast

import numpy as np
from numpy.typing import NDArray

from csplat._spec import MAGIC
from csplat.detect import detect_content, detect_name, read_head, refusal
from csplat.disk_files import FOLDER_NAMES, atomic_writer, local_file, resolve_links, temporary_file
from csplat.errors import CsplatError, InputError
from csplat.file_source import File, map_file, named_errors, open_binary, read_bytes
from csplat.formats import formats
from csplat.model import SplatModel
from csplat.ply import write_ply, write_scene_ply
from csplat.remote_store import is_url
from csplat.scene import Scene
from csplat_tools.console import STANDARD_OUTPUT

STANDARD_STREAM = "-"
STANDARD_INPUT = "standard input"  # its name in messages

_OWN_FORMATS = ("ply", "csplat")  # formats that commands other than `convert` write
_PLY_MAGICS = (b"ply\n", b"ply\r")

#: Commands by the file name endings of their input and output; `*`: any.
_MAKERS = {
    (".csplat", ".ply"): "decode",
    (".ply", ".csplat"): "encode",
    ("*", ".html"): "export-html",
    ("*", ".npz"): "sensitivity",
}

#: File name endings of files that are not scenes.
_NO_SCENES = {".csv", ".gif", ".jpg", ".json", ".mp4", ".npy", ".pdf", ".png", ".svg", ".txt", ".webp", ".xml"}


class _Spooled(io.BytesIO):
    """The contents of standard input or of a pipe."""

    def __init__(self, data: bytes, name: str) -> None:
        super().__init__(data)
        self.name = name


class _StandardOutput:
    """Standard output as a binary file, whose errors have its name."""

    def write(self, data: bytes | memoryview, /) -> int:
        with named_errors(STANDARD_OUTPUT):
            return sys.stdout.buffer.write(data)

    def flush(self) -> None:
        with named_errors(STANDARD_OUTPUT):
            sys.stdout.buffer.flush()


_free: set[Path] = set()  # paths without a file when checked; a file that appeared since is not replaced


def check_output(path: str, *, force: bool, inputs: tuple[str, ...] = ()) -> None:
    """Refuse an unusable output before any work is done for it.

    Args:
        path: the file to be written, or `-`.
        force: an existing file may be replaced.
        inputs: files that the command reads; the output may not be one of them, even with `force`.

    Raises:
        InputError: the file exists, is an input, or is a terminal.
        OSError: its folder does not exist.
    """
    if path == STANDARD_STREAM:
        if sys.stdout.isatty():
            raise InputError("binary data are not written to a terminal: name a file, or use a pipe")
        return
    target, resolved = Path(path), resolve_links(path)
    if target.is_dir():
        raise InputError(f"{path or 'an empty name'} is a folder, expected the name of a file")
    _free.discard(resolved)
    if not target.exists():
        target.parent.stat()  # raises an OSError that names the folder
        if not resolved.parent.exists():  # a link to a file in a folder that is absent
            raise FileNotFoundError(errno.ENOENT, os.strerror(errno.ENOENT), path)
        if not force:
            _free.add(resolved)
        return
    for source in inputs:
        if source != STANDARD_STREAM and Path(source).exists():
            is_folder = Path(source).is_dir() and target.name in FOLDER_NAMES
            if (target.parent if is_folder else target).samefile(source):
                raise InputError(f"{path} is the input: name another output")
    if target.is_file() and not force:
        raise InputError(f"{path} exists: --force replaces it")


def check_outputs(paths: Sequence[str | None], *, force: bool, inputs: Sequence[str | None] = ()) -> None:
    """Refuse unusable outputs before any work is done for them; see `check_output`.

    Args:
        paths: the files to be written, or `-`; `None` is ignored.
        force: existing files may be replaced.
        inputs: files, folders and URLs that the command reads; `None` is ignored.

    Raises:
        InputError: as for `check_output`; or two paths name the same file.
        OSError: an input does not exist, or the folder of an output.
    """
    outputs = [path for path in paths if path is not None]
    places = [path if path == STANDARD_STREAM else resolve_links(path) for path in outputs]
    for number, place in enumerate(places):
        if place in places[:number]:
            raise InputError(f"{outputs[number]} is given for two outputs: name a file for each")
    read = tuple(path for path in inputs if path is not None and not is_url(path))
    for path in read:
        if path != STANDARD_STREAM:
            Path(path).stat()  # raises an OSError that names it
    for path in outputs:
        check_output(path, force=force, inputs=read)


def check_name(path: str, wanted: str, writer: str, source: str = "") -> None:
    """Refuse an output with the name of another kind of file.

    Args:
        path: the output, or `-`.
        wanted: file name ending of the output.
        writer: the command whose argument it is, or the option whose value it is.
        source: the input of that command, for suggesting a command that makes such a file.

    Raises:
        InputError: the name has the ending of another kind of file; the message suggests a remedy.
    """
    target, suffix = Path(path), Path(path).suffix.lower()
    if suffix == wanted:
        return
    others = [
        scene_format
        for scene_format in formats()
        if scene_format.write is not None and scene_format.name not in _OWN_FORMATS
    ]
    converts = any(target.name.lower().endswith(scene_format.suffixes) for scene_format in others)
    kind = None if converts else detect_name(target)
    known = None if kind is None or kind.name in _OWN_FORMATS or not kind.is_scene else kind.title
    maker = _MAKERS.get((Path(source).suffix.lower(), suffix)) or _MAKERS.get(("*", suffix)) or converts * "convert"
    if known is None and not maker and suffix not in {kind for pair in _MAKERS for kind in pair} | _NO_SCENES:
        return
    what = f"csplat does not write {known} yet, and" if known else f"the name is that of a {suffix} file, and"
    line = writer if writer.startswith("-") else f"csplat {writer}"
    meant = " ".join(filter(None, [line, source * (line != writer), str(target.with_suffix(wanted))]))
    if maker and source:
        meant = f"csplat {maker} {source} {path}"
    raise InputError(f"{path}: {what} `{line}` writes a {wanted} file: did you mean `{meant}`?")


@contextmanager
def local_path(file: File) -> Iterator[Path]:
    """Yield the path of a file that can be read twice. `-`, named pipes, open files and bytes are copied.

    Raises:
        InputError: `file` is not a file.
        OSError: the file cannot be read.
    """
    with naming(file), kept_path(file) as path:
        yield path


def kept_path(file: File) -> AbstractContextManager[Path]:
    """Return a context like `local_path` that does not attribute errors to this file."""
    if isinstance(file, str) and file == STANDARD_STREAM:
        return local_file(sys.stdin.buffer, STANDARD_INPUT)
    return local_file(file)


@contextmanager
def naming(file: object) -> Iterator[None]:
    """Set the path of errors that name no file to this file's."""
    try:
        yield
    except CsplatError as error:
        if error.path is None and isinstance(file, (str, os.PathLike)):
            error.path = STANDARD_INPUT if file == STANDARD_STREAM else os.fspath(file)
        raise


@contextmanager
def source_path(file: File) -> Iterator[Path]:
    """Yield the path of a scene to be encoded. Streams and bytes are copied to a temporary file first.

    Raises:
        InputError: the scene is a .csplat file.
        OSError: the scene cannot be read.
    """
    with local_path(file) as local:
        if is_csplat(local):
            _refuse_other_formats(local)
            raise InputError(
                f"{local.name} is a .csplat file already: `csplat decode {local.name} {local.stem}.ply` makes a PLY,"
                " `csplat info` describes it"
            )
        yield local


def is_csplat(path: Path) -> bool:
    """Return True for a .csplat file, by its first bytes, or by its name if they are damaged.

    A PLY with such a name is not a .csplat file, nor is a folder (an unbundled SOG).

    Raises:
        OSError: the file cannot be read.
    """
    if path.is_dir():
        return False
    with open_binary(path) as stream:
        head = stream.read(max(len(MAGIC), 4))
    return head.startswith(MAGIC) or (path.suffix.lower() == ".csplat" and not head.startswith(_PLY_MAGICS))


@contextmanager
def mapped_csplat(path: str, shown: str | None = None) -> Iterator[bytes | mmap]:
    """Yield the bytes of a .csplat file, memory-mapped if possible. They are not validated.

    Args:
        path: the path of a file or a pipe, or `-`.
        shown: name for messages; `None`: `path`.

    Raises:
        InputError: the file is in another format.
        OSError: the file cannot be read.
    """
    with naming(path if shown is None else shown), kept_path(path) as local:
        data = map_file(local)
        try:
            _refuse_other_formats(local, path if shown is None else shown)
            yield data
        finally:
            if isinstance(data, mmap):
                _close_map(data)


def csplat_file(path: str) -> File:
    """Return the argument of `csplat.open` for a .csplat file given by a path, a URL, or `-`.

    Raises:
        InputError: the file is in another format.
        OSError: the file cannot be read.
    """
    if path == STANDARD_STREAM or (not is_url(path) and Path(path).is_fifo()):
        with naming(path), kept_path(path) as local:
            _refuse_other_formats(local, path)
            return _Spooled(read_bytes(local), STANDARD_INPUT if path == STANDARD_STREAM else path)
    if not is_url(path) and Path(path).is_file():
        _refuse_other_formats(Path(path))
    return path


def write_array(path: str, array: NDArray[Any]) -> None:
    """Write a .npy file."""
    buffer = io.BytesIO()
    np.save(buffer, array, allow_pickle=False)
    write_bytes(path, buffer.getvalue())


def write_bytes(path: str, data: bytes) -> None:
    """Write to a file or to standard output. Devices and named pipes are written directly."""
    with _output_stream(path) as stream:
        stream.write(data)


def write_text(path: str, text: str) -> None:
    """Write text in UTF-8; names of files that are not UTF-8 keep their bytes."""
    write_bytes(path, text.encode("utf-8", "surrogateescape"))


@contextmanager
def _output_stream(path: str) -> Iterator[BinaryIO]:
    """Yield standard output for `-`, else the stream of `open_output`."""
    if path == STANDARD_STREAM:
        output = _StandardOutput()
        yield cast(BinaryIO, output)  # writers of streams need nothing else
        output.flush()
    else:
        with open_output(path) as stream:
            yield stream


@contextmanager
def whole_output(path: str) -> Iterator[BinaryIO]:
    """Yield a stream like `_output_stream`. Data reaches standard output only when it is complete."""
    if path != STANDARD_STREAM:
        with open_output(path) as stream:
            yield stream
        return
    with temporary_file() as spool, _output_stream(path) as stream:
        yield spool
        spool.seek(0)
        shutil.copyfileobj(spool, stream)


@contextmanager
def open_output(path: str) -> Iterator[BinaryIO]:
    """Open a file that gets its name when it is complete.

    Raises:
        InputError: another program has written a file of that name since `check_output`.
        OSError: the file cannot be written.
    """
    target = resolve_links(path)
    try:
        with atomic_writer(path, replace=target not in _free) as stream:
            yield stream
    except FileExistsError:
        raise InputError(
            f"{path} exists: another program wrote it meanwhile, and it was not replaced; --force replaces it"
        ) from None
    _free.discard(target)


def write_json(path: str, value: Any) -> None:
    """Write a value as JSON. NaN and infinities are refused, since JSON has none."""
    write_bytes(path, (json.dumps(value, indent=2, allow_nan=False) + "\n").encode())


def write_model(path: str, model: SplatModel | Scene, *, absolute: bool) -> None:
    """Write a PLY to a file, or to standard output for `-`; `absolute` adds the origin and writes doubles."""
    write: Callable[..., None] = write_scene_ply if isinstance(model, Scene) else write_ply
    with _output_stream(path) as stream:
        write(stream, model, absolute=absolute)


def is_one_way(path: str) -> bool:
    """Return True for a path from which data cannot be withdrawn: standard output, a device, a named pipe."""
    return path == STANDARD_STREAM or (Path(path).exists() and not Path(path).is_file())


def _refuse_other_formats(path: Path, shown: str = "") -> None:
    """Refuse a file of a known format other than .csplat; `shown` is its name in the message, or `-`.

    Raises:
        InputError: it has another format, which the message names.
    """
    head = read_head(path)
    kind = detect_content(path, head) or detect_name(path)
    if kind is not None and kind.name != "csplat":
        raise refusal(path, head, wanted="csplat", shown=STANDARD_INPUT if shown == STANDARD_STREAM else shown)


def _close_map(data: mmap) -> None:
    """Close a map, now or, if something still refers to its data, later."""
    try:
        data.close()
    except BufferError:
        return  # an error in flight holds a view of the data; the garbage collector will close it

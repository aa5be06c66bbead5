# SPDX-License-Identifier: CC0-1.0
"""Run the decoders in C and JavaScript, which are only in a checkout, in processes that decode many files."""

from __future__ import annotations

import json
import mmap
import os
import queue
import select
import shlex
import shutil
import struct
import subprocess
import tempfile
import threading
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import IO, Any, Self

from csplat.errors import InputError
from csplat_conformance.answers import Answer, cuts_of_vector, whole_number
from csplat_conformance.conformance_report import Status
from csplat_conformance.manifest import VECTORS, Vector
from csplat_conformance.protocol import ProcessEnd, ask_cuts, read_answer

_READ_BYTES = 1 << 16


class DecoderProcess:
    """A decoder process. It is started for the first file and restarted after a crash.

    Args:
        words: command line.
        timeout: time limit for one file, seconds.
        environment: environment of the process; None: that of this process.
    """

    def __init__(self, words: Sequence[str], timeout: float, environment: Mapping[str, str] | None = None) -> None:
        self._words = words
        self._timeout = timeout
        self._environment = environment
        self._process: subprocess.Popen[bytes] | None = None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def ask(self, data: bytes) -> Answer:
        """Decode a file to floats and to integers."""
        raise NotImplementedError

    def close(self) -> None:
        """End the process."""
        if self._process is not None and self._process.stdin:
            self._process.stdin.close()
            try:
                self._process.wait(self._timeout)
            except subprocess.TimeoutExpired:
                self._process.kill()
                self._process.wait()
            if self._process.stdout:
                self._process.stdout.close()
        self._process = None

    def resident_bytes(self) -> int:
        """Return the current resident memory of the process, 0 if unknown."""
        if self._process is None:
            return 0
        try:
            pages = int(Path(f"/proc/{self._process.pid}/statm").read_text(encoding="ascii").split()[1])
        except OSError:
            return 0
        return pages * mmap.PAGESIZE

    def _request(self, request: bytes) -> bytes | Answer:
        """Send a request; return the line of the answer, or the failure."""
        began = time.monotonic()
        process = self._start()
        assert process.stdin
        try:
            process.stdin.write(request)
            process.stdin.flush()
            line = self._line(process, began)
        except OSError:  # a broken pipe; Windows reports an invalid argument
            line = b""
        if line is None:
            self._end(process)
            return Answer(Status.HUNG, f"no answer after {self._timeout:g} s", seconds=time.monotonic() - began)
        if not line.endswith(b"\n"):
            self._end(process)
            return Answer(Status.CRASHED, f"the process ended with status {process.returncode}")
        return line

    def _start(self) -> subprocess.Popen[bytes]:
        if self._process is None:
            self._process = subprocess.Popen(  # noqa: S603 - the decoder's own adapter
                self._words,
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=subprocess.DEVNULL,
                env=self._environment,
            )
        return self._process

    def _line(self, process: subprocess.Popen[bytes], began: float) -> bytes | None:
        """Read a line. Return only its beginning if the process ended, or None after the time limit."""
        assert process.stdout
        if not hasattr(select, "poll"):
            return _read_line_in_thread(process.stdout, began + self._timeout - time.monotonic())
        line = b""
        while not line.endswith(b"\n"):
            left = began + self._timeout - time.monotonic()
            if left <= 0 or not select.select([process.stdout], [], [], left)[0]:
                return None
            part = os.read(process.stdout.fileno(), _READ_BYTES)
            if not part:
                return line
            line += part
        return line

    def _end(self, process: subprocess.Popen[bytes]) -> None:
        process.kill()
        process.wait()
        for stream in (process.stdin, process.stdout):
            try:
                if stream:
                    stream.close()
            except OSError:  # as above
                continue
        self._process = None


def _read_line_in_thread(stream: IO[bytes], seconds: float) -> bytes | None:
    """Read a line like `DecoderProcess._line`, on systems that cannot wait for pipes (Windows)."""
    lines: queue.SimpleQueue[bytes] = queue.SimpleQueue()
    threading.Thread(target=lambda: lines.put(stream.readline()), daemon=True).start()
    try:
        return lines.get(timeout=max(0.0, seconds))
    except queue.Empty:
        return None


C_ADAPTER = Path("tools", "adapter.c")
C_SOURCES = ("csplat.c", "inflate.c")  # sources of the decoder without libraries
_C_MEMORY_KIB = 3_000_000  # limit of the address space, KiB: unbounded allocations fail at once


def c_folder() -> Path:
    """Return the folder of the C decoder.

    Raises:
        InputError: neither this package nor the working folder belongs to a checkout.
    """
    for root in (Path(__file__).parents[3], Path.cwd()):
        folder = root / "codec" / "c"
        if (folder / C_ADAPTER).is_file():
            return folder
    raise InputError("the C decoder is missing: only a checkout has it and its adapter")


def missing_c() -> str:
    """Return the reason why the C decoder cannot run here, or an empty string."""
    if shutil.which("cc") is None:
        return "cc, a C compiler, is not installed"
    try:
        c_folder()
    except InputError as error:
        return str(error)
    return ""


def compile_c(out: Path, *words: str | Path) -> None:
    """Compile sources or link objects.

    Args:
        out: the file to write.
        words: further arguments.

    Raises:
        InputError: the compiler is missing, or reports an error.
    """
    missing = missing_c()
    if missing:
        raise InputError(missing)
    command = ["cc", "-std=c99", "-O1", "-w", "-DCSPLAT_NO_ZLIB", f"-I{c_folder()}", *map(str, words), "-o", str(out)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)  # noqa: S603 - our own sources
    if done.returncode:
        raise InputError(f"cc cannot compile the C decoder: {done.stderr.strip().splitlines()[:1]}")


class CDecoder(DecoderProcess):
    """A process of the C decoder's adapter.

    Args:
        program: the compiled adapter; None: compile that of the checkout for the first file.
        limits: budgets of splats, bytes, and bytes of a text; default: those of the registry.
        timeout: time limit for one file, seconds.
    """

    def __init__(self, program: Path | None = None, limits: Sequence[int] = (), timeout: float = 20.0) -> None:
        self._folder = tempfile.TemporaryDirectory(prefix="csplat-c-")
        home = Path(self._folder.name)
        self._input, self._outdir = home / "input", home / "out"
        self._program = program or home / "adapter"
        shell = f'ulimit -v {_C_MEMORY_KIB}; exec "$0" "$@"'
        super().__init__(["sh", "-c", shell, str(self._program), *map(str, limits)], timeout)

    def ask(self, data: bytes) -> Answer:
        """Decode a file to floats and to integers.

        Raises:
            InputError: the adapter cannot be compiled.
        """
        if not self._program.exists():
            compile_c(self._program, *(c_folder() / name for name in (C_ADAPTER, *C_SOURCES)), "-lm")
        began = time.monotonic()
        self._input.write_bytes(data)
        self._outdir.mkdir()
        try:
            line = self._request(f"{self._input}\n{self._outdir}\n".encode())
            if isinstance(line, Answer):
                return line
            ended = ProcessEnd(None, line != b"{}\n", line, b"", time.monotonic() - began)
            return read_answer(ended, self._outdir)
        finally:
            shutil.rmtree(self._outdir)

    def close(self) -> None:
        """End the process and remove its files."""
        super().close()
        self._folder.cleanup()


_JS_ADAPTER = Path("test", "adapter.mjs")
_JS_HEAP_MB = 512


def js_folder() -> Path:
    """Return the folder of the JavaScript decoder.

    Raises:
        InputError: neither this package nor the working folder belongs to a checkout.
    """
    for root in (Path(__file__).parents[3], Path.cwd()):
        folder = root / "codec" / "js"
        if (folder / _JS_ADAPTER).is_file():
            return folder
    raise InputError("the JavaScript decoder is missing: only a checkout has it and its adapter")


def missing_javascript() -> str:
    """Return the reason why the JavaScript decoder cannot run here, or an empty string."""
    if shutil.which("node") is None:
        return "node is not installed"
    try:
        js_folder()
    except InputError as error:
        return str(error)
    return ""


def select_in_javascript(folder: Path, vector: Vector, timeout: float = 20.0) -> Answer:
    """Select the cuts of a vector in a process of the JavaScript decoder whose modules are in a folder."""
    command = f"env CSPLAT_JS={shlex.quote(str(folder))} node {shlex.quote(str(js_folder() / _JS_ADAPTER))}"
    path = VECTORS / vector.file
    return ask_cuts(f"{command} --cuts {{input}} {{cuts}}", path, cuts_of_vector(vector), timeout)


class JsDecoder(DecoderProcess):
    """A Node process of the JavaScript decoder.

    Args:
        folder: folder of the decoder's modules, such as a modified copy; None: that of the checkout.
        limits: budgets by their names in JavaScript; default: those of the registry.
        timeout: time limit for one file, seconds.
        coverage: folder to which Node writes its coverage at exit.
    """

    def __init__(
        self,
        folder: Path | None = None,
        limits: dict[str, int] | None = None,
        timeout: float = 20.0,
        coverage: Path | None = None,
    ) -> None:
        missing = missing_javascript()
        if missing:
            raise InputError(missing)
        home = js_folder()
        options = {"limits": limits} if limits else {}
        node = shutil.which("node") or "node"
        words = [node, f"--max-old-space-size={_JS_HEAP_MB}", str(home / _JS_ADAPTER), "--serve", json.dumps(options)]
        environment = os.environ | {"CSPLAT_JS": str(folder or home)}
        if coverage is not None:
            environment["NODE_V8_COVERAGE"] = str(coverage)
        super().__init__(words, timeout, environment)

    def ask(self, data: bytes) -> Answer:
        """Decode a file to floats and to integers."""
        began = time.monotonic()
        line = self._request(struct.pack("<I", len(data)) + data)
        if isinstance(line, Answer):
            return line
        return _js_answer(json.loads(line, parse_int=whole_number), time.monotonic() - began)


def _js_answer(found: dict[str, Any], seconds: float) -> Answer:
    if "defect" in found:
        return Answer(Status.CRASHED, " | ".join(found["defect"].splitlines()[:3]), seconds=seconds)
    if "code" in found:
        code, clause, offset = found["code"], found.get("clause"), found.get("offset")
        return Answer(Status.REFUSED, "refused", code=code, clause=clause, offset=offset, seconds=seconds)
    arrays = {key: (size, digest) for key, (size, digest) in found["arrays"].items()}
    return Answer(Status.PASSED, "", found["header"], arrays, seconds=seconds)

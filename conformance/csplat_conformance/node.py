"""The JavaScript decoder in a long-lived Node process, asked file after file."""

from __future__ import annotations

import json
import os
import select
import shutil
import struct
import subprocess
import time
from pathlib import Path
from typing import Any, Self

from csplat.errors import InputError
from csplat_conformance.answers import Answer, whole_number
from csplat_conformance.report import Status

__all__ = ["JsDecoder", "js_folder", "missing_javascript"]

_ADAPTER = Path("test", "adapter.mjs")
_READ = 1 << 16
_HEAP_MB = 512


def js_folder() -> Path:
    """Return the folder of the JavaScript decoder, whose tests hold the adapter: only a checkout has them.

    Raises:
        InputError: neither this package nor the working folder belongs to a checkout.
    """
    for root in (Path(__file__).parents[2], Path.cwd()):
        folder = root / "codec" / "js"
        if (folder / _ADAPTER).is_file():
            return folder
    raise InputError("the JavaScript decoder is not here: only a checkout has it and its adapter")


def missing_javascript() -> str:
    """Return why the JavaScript decoder cannot run here, or an empty string."""
    if shutil.which("node") is None:
        return "node is not installed"
    try:
        js_folder()
    except InputError as error:
        return str(error)
    return ""


class JsDecoder:
    """A Node process that decodes what it is sent; started when it is first asked, and anew after a crash.

    Args:
        folder: of the decoder's modules, a copy that may have been changed; None for the checkout's.
        limits: budgets, by their names in JavaScript; the registry's if left out.
        timeout: seconds for one file.
        coverage: folder to which Node writes its coverage when it ends.
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
        self._words = [node, f"--max-old-space-size={_HEAP_MB}", str(home / _ADAPTER), "--serve", json.dumps(options)]
        self._environment = os.environ | {"CSPLAT_JS": str(folder or home)}
        if coverage is not None:
            self._environment["NODE_V8_COVERAGE"] = str(coverage)
        self._timeout = timeout
        self._process: subprocess.Popen[bytes] | None = None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Let the process end."""
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

    def ask(self, data: bytes) -> Answer:
        """Decode one file, as floats and as integers."""
        began = time.monotonic()
        process = self._started()
        assert process.stdin
        try:
            process.stdin.write(struct.pack("<I", len(data)) + data)
            process.stdin.flush()
            line = self._line(process, began)
        except BrokenPipeError:
            line = b""
        if line is None:
            self._end(process)
            return Answer(Status.HUNG, f"no answer after {self._timeout:g} s", seconds=time.monotonic() - began)
        if not line.endswith(b"\n"):
            self._end(process)
            return Answer(Status.CRASHED, f"the process ended with status {process.returncode}")
        return _answer(json.loads(line, parse_int=whole_number), time.monotonic() - began)

    def resident_bytes(self) -> int:
        """Return what the process holds in memory now; 0 where nobody can tell."""
        if self._process is None:
            return 0
        try:
            pages = int(Path(f"/proc/{self._process.pid}/statm").read_text(encoding="ascii").split()[1])
        except OSError:
            return 0
        return pages * os.sysconf("SC_PAGE_SIZE")

    def _started(self) -> subprocess.Popen[bytes]:
        if self._process is None:
            self._process = subprocess.Popen(  # noqa: S603 - node, found on the path, and our adapter
                self._words,
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=subprocess.DEVNULL,
                env=self._environment,
            )
        return self._process

    def _line(self, process: subprocess.Popen[bytes], began: float) -> bytes | None:
        """Return a line, what there is of it when the process ended, or None when it takes too long."""
        assert process.stdout
        line = b""
        while not line.endswith(b"\n"):
            left = began + self._timeout - time.monotonic()
            if left <= 0 or not select.select([process.stdout], [], [], left)[0]:
                return None
            part = os.read(process.stdout.fileno(), _READ)
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
            except BrokenPipeError:
                continue
        self._process = None


def _answer(found: dict[str, Any], seconds: float) -> Answer:
    if "defect" in found:
        return Answer(Status.CRASHED, " | ".join(found["defect"].splitlines()[:3]), seconds=seconds)
    if "code" in found:
        code, clause, offset = found["code"], found.get("clause"), found.get("offset")
        return Answer(Status.REFUSED, "refused", code=code, clause=clause, offset=offset, seconds=seconds)
    arrays = {key: (size, digest) for key, (size, digest) in found["arrays"].items()}
    return Answer(Status.PASSED, "", found["header"], arrays, seconds=seconds)

"""The C decoder in a long-lived process, asked file after file."""

from __future__ import annotations

import shutil
import subprocess
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

from csplat.errors import InputError
from csplat_conformance.answers import Answer
from csplat_conformance.process import Ended
from csplat_conformance.protocol import answered
from csplat_conformance.serving import Served

ADAPTER = Path("tools", "adapter.c")
SOURCES = ("csplat.c", "inflate.c")  # sources of the decoder, which then needs no library
_MEMORY = 3_000_000  # kibibytes of address space: an allocation without bound fails at once


def c_folder() -> Path:
    """Return the folder of the C decoder: only a checkout has it.

    Raises:
        InputError: neither this package nor the working folder belongs to a checkout.
    """
    for root in (Path(__file__).parents[2], Path.cwd()):
        folder = root / "codec" / "c"
        if (folder / ADAPTER).is_file():
            return folder
    raise InputError("the C decoder is not here: only a checkout has it and its adapter")


def missing_c() -> str:
    """Return why the C decoder cannot run here, or an empty string."""
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
        words: further arguments of the command line.

    Raises:
        InputError: the compiler is not here, or does not take them.
    """
    missing = missing_c()
    if missing:
        raise InputError(missing)
    command = ["cc", "-std=c99", "-O1", "-w", "-DCSPLAT_NO_ZLIB", f"-I{c_folder()}", *map(str, words), "-o", str(out)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)  # noqa: S603 - our own sources
    if done.returncode:
        raise InputError(f"cc cannot compile the C decoder: {done.stderr.strip().splitlines()[:1]}")


class CDecoder(Served):
    """A process of the adapter that decodes the files it is given.

    Args:
        program: the adapter, compiled; None for the checkout's, which is compiled when it is first asked.
        limits: budgets: splats, bytes, bytes of a text; the registry's if left out.
        timeout: seconds for one file.
    """

    def __init__(self, program: Path | None = None, limits: Sequence[int] = (), timeout: float = 20.0) -> None:
        self._folder = tempfile.TemporaryDirectory(prefix="csplat-c-")
        home = Path(self._folder.name)
        self._input, self._outdir = home / "input", home / "out"
        self._program = program or home / "adapter"
        shell = f'ulimit -v {_MEMORY}; exec "$0" "$@"'
        super().__init__(["sh", "-c", shell, str(self._program), *map(str, limits)], timeout)

    def ask(self, data: bytes) -> Answer:
        """Decode one file, as floats and as integers.

        Raises:
            InputError: the adapter cannot be compiled.
        """
        if not self._program.exists():
            compile_c(self._program, *(c_folder() / name for name in (ADAPTER, *SOURCES)), "-lm")
        began = time.monotonic()
        self._input.write_bytes(data)
        self._outdir.mkdir()
        try:
            line = self._answered(f"{self._input}\n{self._outdir}\n".encode())
            if isinstance(line, Answer):
                return line
            ended = Ended(None, line != b"{}\n", line, b"", time.monotonic() - began)
            return answered(ended, self._outdir)
        finally:
            shutil.rmtree(self._outdir)

    def close(self) -> None:
        """Let the process end, and remove what it wrote."""
        super().close()
        self._folder.cleanup()

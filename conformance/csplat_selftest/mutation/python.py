"""Mutants of the Python decoder, each in a forked process with modules of its own."""

from __future__ import annotations

import os
import select
import signal
import sys
import time
import warnings
from collections.abc import Mapping, Sequence
from importlib.abc import Loader, MetaPathFinder
from importlib.machinery import ModuleSpec
from importlib.util import spec_from_loader
from pathlib import Path
from types import CodeType, ModuleType
from typing import Any

from csplat import decoder
from csplat.errors import InputError
from csplat_conformance import adapter
from csplat_conformance.answers import Answer
from csplat_conformance.conformance_report import Status
from csplat_selftest.fuzzing.decoder_targets import LIMITS
from csplat_selftest.mutation.mutants import Fate, Mutant, MutantResult, difference, failing, verdict
from csplat_selftest.mutation.operators import python_mutants

NO_FORK = "this system cannot copy processes, in which mutants run: use Linux or macOS"

_PROCESSOR_SECONDS = 30  # the right decoder takes five
_SECONDS = 300.0  # seconds of wall time, for a mutant that waits; other processes may be busy
_ADDRESS_SPACE = 3_000_000_000  # bytes beyond what the process has: an allocation without bound fails at once


class PythonDecoder:
    """The Python decoder and its mutants.

    Attributes:
        texts: its modules by the names of their files.

    Args:
        files: fuzzed ones.
        processor_seconds: CPU time that a mutant may take for all vectors and files.
    """

    def __init__(self, files: Sequence[bytes], processor_seconds: int = _PROCESSOR_SECONDS) -> None:
        self._files = files
        self._processor_seconds = processor_seconds
        self._mutants: list[Mutant] = []
        self._folder = Path(decoder.__file__).parent
        self.texts = {path.name: path.read_text(encoding="utf-8") for path in sorted(self._folder.glob("*.py"))}
        self._codes = {file: self._compiled(file, text) for file, text in self.texts.items()}
        self._wanted = [verdict(_fuzzed_answer(data)) for data in files]

    @property
    def mutants(self) -> Sequence[Mutant]:
        """All of them."""
        if not self._mutants:
            self._mutants = [mutant for name, text in self.texts.items() for mutant in python_mutants(name, text)]
        return self._mutants

    def valid(self, mutant: Mutant) -> bool:
        """Return True if the mutant compiles."""
        try:
            self._compiled(mutant.file, mutant.apply(self.texts[mutant.file]))
        except SyntaxError:
            return False
        return True

    def attempt(self, mutant: Mutant) -> MutantResult:
        """Run the vectors, then the fuzzed files; what hangs is noticed."""
        if sys.platform == "win32":
            raise InputError(NO_FORK)
        reading, writing = os.pipe()
        child = os.fork()
        if child == 0:
            os.close(reading)
            try:
                self._in_child(mutant, writing)
            finally:
                os._exit(0)
        os.close(writing)
        try:
            caught = _line(reading, "hangs, or ends the process")
            if caught:
                return MutantResult(mutant, Fate.CAUGHT, caught)
            missed = _line(reading, "a file: hangs, or ends the process")
            return MutantResult(mutant, Fate.MISSED if missed else Fate.SAME, missed)
        finally:
            os.close(reading)
            os.kill(child, signal.SIGKILL)
            os.waitpid(child, 0)

    def _in_child(self, mutant: Mutant, writing: int) -> None:
        """Write two lines: the vector that fails, the file that differs; empty ones for none."""
        _limit(self._processor_seconds)
        warnings.simplefilter("ignore")
        try:
            self._load(mutant)
        except Exception as error:  # noqa: BLE001 - a mutant may fail in any way
            _tell(writing, f"the import: {type(error).__name__}")
            return
        # Most of it without threads, which is five times as fast; they have code of their own.
        caught = next((name for threads in (1, None) if (name := failing(_asked(threads)))), "")
        _tell(writing, caught)
        if not caught:
            _tell(writing, difference(_fuzzed_answer, self._files, self._wanted))

    def _compiled(self, file: str, text: str) -> CodeType:
        return compile(text, str(self._folder / file), "exec", dont_inherit=True)

    def _load(self, mutant: Mutant) -> None:
        """Import the decoder anew, with the change in it."""
        package = decoder.__name__
        for name in [name for name in sys.modules if name == package or name.startswith(f"{package}.")]:
            del sys.modules[name]
        codes = {}
        for file, code in self._codes.items():
            name = package if file == "__init__.py" else f"{package}.{file.removesuffix('.py')}"
            codes[name] = self._compiled(file, mutant.apply(self.texts[file])) if file == mutant.file else code
        sys.meta_path.insert(0, _Finder(codes, package))
        __import__(package)


def _asked(threads: int | None) -> Any:
    def ask(data: bytes) -> Answer:
        try:
            return adapter.answer(data, threads=threads)
        except Exception as error:  # noqa: BLE001 - a mutant may fail in any way
            return Answer(Status.CRASHED, f"{type(error).__name__}: {error}")

    return ask


def _fuzzed_answer(data: bytes) -> Answer:
    try:
        return adapter.answer(data, LIMITS, threads=1)
    except Exception as error:  # noqa: BLE001 - a mutant may fail in any way
        return Answer(Status.CRASHED, f"{type(error).__name__}: {error}")


class _Finder(MetaPathFinder, Loader):
    """Gives modules from code."""

    def __init__(self, codes: Mapping[str, CodeType], package: str) -> None:
        self.codes = codes
        self.package = package

    def find_spec(self, name: str, path: Any, target: Any = None) -> ModuleSpec | None:  # noqa: ARG002 - the interface
        return spec_from_loader(name, self, is_package=name == self.package) if name in self.codes else None

    def create_module(self, spec: ModuleSpec) -> None:
        """Leave it to the interpreter."""

    def exec_module(self, module: ModuleType) -> None:
        exec(self.codes[module.__name__], module.__dict__)  # noqa: S102 - code of our own


def _limit(processor_seconds: int) -> None:
    """Let loops without end be ended, and allocations without bound fail."""
    import resource  # Windows has none

    if sys.platform == "win32":
        return
    resource.setrlimit(resource.RLIMIT_CPU, (processor_seconds, processor_seconds))
    statm = Path("/proc/self/statm")
    if statm.exists():
        held = int(statm.read_text(encoding="ascii").split()[0]) * resource.getpagesize()
        resource.setrlimit(resource.RLIMIT_AS, (held + _ADDRESS_SPACE, resource.RLIM_INFINITY))


def _tell(writing: int, line: str) -> None:
    os.write(writing, f"{' '.join(line.split())}\n".encode())


def _line(reading: int, otherwise: str) -> str:
    """Return the next line, or other words if none comes in time."""
    line, end = b"", time.monotonic() + _SECONDS
    while not line.endswith(b"\n"):
        ready = select.select([reading], [], [], max(0.0, end - time.monotonic()))[0]
        part = os.read(reading, 1) if ready else b""
        if not part:
            return otherwise
        line += part
    return line.decode().strip()

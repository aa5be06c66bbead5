# SPDX-License-Identifier: CC0-1.0
"""Our decoders and their mutants: Python, JavaScript and C."""

from __future__ import annotations

import json
import os
import select
import signal
import subprocess
import sys
import tempfile
import time
import warnings
from collections.abc import Callable, Mapping, Sequence
from importlib.abc import Loader, MetaPathFinder
from importlib.machinery import ModuleSpec
from importlib.util import spec_from_loader
from pathlib import Path
from types import CodeType, ModuleType
from typing import Any, Final

from csplat import decoder
from csplat.context import Context
from csplat.errors import InputError
from csplat_conformance import adapter
from csplat_conformance.answers import Answer, cuts_of_vector
from csplat_conformance.conformance_report import Status
from csplat_conformance.manifest import VECTORS, Vector
from csplat_conformance.protocol import ask_cuts
from csplat_selftest.decoder_processes import (
    C_ADAPTER,
    C_SOURCES,
    CDecoder,
    JsDecoder,
    c_folder,
    compile_c,
    js_folder,
    select_in_javascript,
)
from csplat_selftest.fuzzing.decoder_targets import C_LIMITS, JS_LIMITS, LIMITS
from csplat_selftest.mutation.mutants import (
    Fate,
    Mutant,
    MutantResult,
    difference,
    failing,
    failing_cuts,
    verdict,
)
from csplat_selftest.mutation.operators import c_mutants, python_mutants

NO_FORK = "this system cannot fork processes, which mutants require: use Linux or macOS"

_PROCESSOR_SECONDS = 30  # CPU time of a mutant for all files; the original decoder takes five
_WALL_SECONDS = 300.0  # wall-clock limit, for mutants that wait without using CPU time
_ADDRESS_SPACE = 3_000_000_000  # additional bytes of a mutant: unbounded allocations fail at once
_FILE_SECONDS = 5.0  # time limit for one file; a hundred times that of the largest


class PythonDecoder:
    """The Python decoder and its mutants. Each mutant runs in a forked process with its own modules.

    Attributes:
        texts: its source files by name.

    Args:
        files: fuzzed files.
        processor_seconds: CPU time limit of a mutant for all vectors and files.
    """

    def __init__(self, files: Sequence[bytes], processor_seconds: int = _PROCESSOR_SECONDS) -> None:
        self._files = files
        self._processor_seconds = processor_seconds
        self._mutants: list[Mutant] = []
        self._folder = Path(decoder.__file__).parent
        self.texts = {path.name: path.read_text(encoding="utf-8") for path in sorted(self._folder.glob("*.py"))}
        self._codes = {file: self._compile(file, text) for file, text in self.texts.items()}
        self._expected = [verdict(_fuzzed_answer(data)) for data in files]

    @property
    def mutants(self) -> Sequence[Mutant]:
        """All mutants."""
        if not self._mutants:
            self._mutants = [mutant for name, text in self.texts.items() for mutant in python_mutants(name, text)]
        return self._mutants

    def valid(self, mutant: Mutant) -> bool:
        """Return True if the mutant compiles."""
        try:
            self._compile(mutant.file, mutant.apply(self.texts[mutant.file]))
        except SyntaxError:
            return False
        return True

    def attempt(self, mutant: Mutant) -> MutantResult:
        """Run the vectors, then the fuzzed files, with time limits."""
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
        """Write two lines: the vector that fails and the file that differs, each empty if there is none."""
        _limit(self._processor_seconds)
        warnings.simplefilter("ignore")
        try:
            self._load(mutant)
        except Exception as error:  # noqa: BLE001 - a mutant may fail in any way
            _tell(writing, f"the import: {type(error).__name__}")
            return
        # One thread is five times faster; then use all threads, which have separate code.
        caught = next((name for threads in (1, None) if (name := failing(_ask(Context(threads=threads))))), "")
        caught = caught or failing_cuts(_ask_cuts)
        _tell(writing, caught)
        if not caught:
            _tell(writing, difference(_fuzzed_answer, self._files, self._expected))

    def _compile(self, file: str, text: str) -> CodeType:
        return compile(text, str(self._folder / file), "exec", dont_inherit=True)

    def _load(self, mutant: Mutant) -> None:
        """Import the decoder again with the change."""
        package = decoder.__name__
        for name in [name for name in sys.modules if name == package or name.startswith(f"{package}.")]:
            del sys.modules[name]
        codes = {}
        for file, code in self._codes.items():
            name = package if file == "__init__.py" else f"{package}.{file.removesuffix('.py')}"
            codes[name] = self._compile(file, mutant.apply(self.texts[file])) if file == mutant.file else code
        sys.meta_path.insert(0, _Finder(codes, package))
        __import__(package)


def _ask(context: Context) -> Any:
    def ask(data: bytes) -> Answer:
        try:
            return adapter.answer(data, context=context)
        except Exception as error:  # noqa: BLE001 - a mutant may fail in any way
            return Answer(Status.CRASHED, f"{type(error).__name__}: {error}")

    return ask


def _ask_cuts(vector: Vector) -> Answer:
    try:
        return Answer(Status.PASSED, cuts=adapter.cuts_of(vector.data, cuts_of_vector(vector)))
    except Exception as error:  # noqa: BLE001 - a mutant may fail in any way
        return Answer(Status.CRASHED, f"{type(error).__name__}: {error}")


def _run_cuts(command: str) -> Callable[[Vector], Answer]:
    """Return a function that runs a command with `{input}` and `{cuts}` on a vector."""
    return lambda vector: ask_cuts(command, VECTORS / vector.file, cuts_of_vector(vector), _FILE_SECONDS)


def _fuzzed_answer(data: bytes) -> Answer:
    try:
        return adapter.answer(data, LIMITS, context=Context(threads=1))
    except Exception as error:  # noqa: BLE001 - a mutant may fail in any way
        return Answer(Status.CRASHED, f"{type(error).__name__}: {error}")


class _Finder(MetaPathFinder, Loader):
    """A finder and loader of modules from code objects."""

    def __init__(self, codes: Mapping[str, CodeType], package: str) -> None:
        self.codes = codes
        self.package = package

    def find_spec(self, name: str, path: Any, target: Any = None) -> ModuleSpec | None:  # noqa: ARG002 - the interface
        return spec_from_loader(name, self, is_package=name == self.package) if name in self.codes else None

    def create_module(self, spec: ModuleSpec) -> None:
        """Use the default."""

    def exec_module(self, module: ModuleType) -> None:
        exec(self.codes[module.__name__], module.__dict__)  # noqa: S102 - code of the checkout


def _limit(processor_seconds: int) -> None:
    """Limit CPU time and address space of this process."""
    import resource  # absent on Windows

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
    """Return the next line, or `otherwise` if none arrives in time."""
    line, end = b"", time.monotonic() + _WALL_SECONDS
    while not line.endswith(b"\n"):
        ready = select.select([reading], [], [], max(0.0, end - time.monotonic()))[0]
        part = os.read(reading, 1) if ready else b""
        if not part:
            return otherwise
        line += part
    return line.decode().strip()


# JavaScript ----------------------------------------------------------------------------------------

_OPERATORS = Path("test", "operators.mjs")
_CUTS: Final = (
    "tree.mjs",
    "options.mjs",
    "tile_records.mjs",
)  # modules of cuts; starting a process for each vector takes a second
#: Modules that are not part of decoding whole files, WebAssembly, or generated tables.
_OTHERS: Final = (
    "spec.mjs",
    "reader.mjs",
    "source.mjs",
    "whole_sources.mjs",
    "packed_layers.mjs",
    "wasm_decoder.mjs",
    "wasm_binary.mjs",
    "csplat-worker.mjs",
    "workers.mjs",
)


class JavaScriptDecoder:
    """The JavaScript decoder and its mutants. Each mutant is a copy of the modules in a separate Node process.

    Attributes:
        texts: its source files by name.

    Args:
        files: fuzzed files.

    Raises:
        InputError: Node or the decoder is missing.
    """

    def __init__(self, files: Sequence[bytes]) -> None:
        self._files = files
        self._mutants: list[Mutant] = []
        paths = sorted(js_folder().glob("*.mjs"))
        self.texts = {path.name: path.read_text(encoding="utf-8") for path in paths}
        with JsDecoder(limits=JS_LIMITS) as right:
            self._expected = [verdict(right.ask(data)) for data in files]

    @property
    def mutants(self) -> Sequence[Mutant]:
        """All mutants.

        Raises:
            InputError: the parser is missing.
        """
        if not self._mutants:
            paths = [str(js_folder() / name) for name in self.texts if name not in _OTHERS]
            words = ["node", str(js_folder() / _OPERATORS), str(_typescript()), *paths]
            done = subprocess.run(words, capture_output=True, check=True)  # noqa: S603 - a script of the checkout
            self._mutants = [Mutant(*one) for one in json.loads(done.stdout)]
        return self._mutants

    def valid(self, mutant: Mutant) -> bool:  # noqa: ARG002 - the interface
        """Return True: the operators replace whole expressions, so every mutant is a valid program."""
        return True

    def attempt(self, mutant: Mutant) -> MutantResult:
        """Run the vectors, then the fuzzed files with smaller budgets."""
        with tempfile.TemporaryDirectory(prefix="csplat-mutant-") as name:
            folder = Path(name)
            for file, text in self.texts.items():
                changed = mutant.apply(text) if file == mutant.file else text
                (folder / file).write_text(changed, encoding="utf-8")
            with JsDecoder(folder, timeout=_FILE_SECONDS) as decoder:
                caught = failing(decoder.ask)
            if not caught and mutant.file in _CUTS:
                caught = failing_cuts(lambda vector: select_in_javascript(folder, vector, _FILE_SECONDS))
            if caught:
                return MutantResult(mutant, Fate.CAUGHT, caught)
            with JsDecoder(folder, JS_LIMITS, _FILE_SECONDS) as decoder:
                missed = difference(decoder.ask, self._files, self._expected)
            return MutantResult(mutant, Fate.MISSED if missed else Fate.SAME, missed)


def _typescript() -> Path:
    parser = Path("node_modules", "typescript", "lib", "typescript.js")
    found = [parent / parser for parent in js_folder().parents if (parent / parser).exists()]
    if not found:
        raise InputError("typescript, which parses the modules, is missing: run `npm ci` in the checkout")
    return found[0]


# C -------------------------------------------------------------------------------------------------


class NativeDecoder:
    """The C decoder and its mutants. Each mutant is compiled and runs in a separate process.

    Attributes:
        texts: its source files by name.
        mutants: all mutants.

    Args:
        files: fuzzed files.

    Raises:
        InputError: the compiler or the decoder is missing.
    """

    def __init__(self, files: Sequence[bytes]) -> None:
        self._files = files
        self.texts = {name: (c_folder() / name).read_text(encoding="utf-8") for name in C_SOURCES}
        self.mutants = [mutant for name, text in self.texts.items() for mutant in c_mutants(name, text)]
        self._objects: dict[str, bytes] = {}
        with CDecoder(limits=C_LIMITS) as right:
            self._expected = [verdict(right.ask(data)) for data in files]

    def valid(self, mutant: Mutant) -> bool:
        """Return True if the mutant compiles."""
        with tempfile.TemporaryDirectory(prefix="csplat-mutant-") as name:
            try:
                compile_c(Path(name) / "nothing", "-fsyntax-only", self._written(mutant, Path(name)))
            except InputError:
                return False
        return True

    def attempt(self, mutant: Mutant) -> MutantResult:
        """Run the vectors, then the fuzzed files with smaller budgets."""
        with tempfile.TemporaryDirectory(prefix="csplat-mutant-") as name:
            program, objects = Path(name) / "adapter", []
            for other in {str(C_ADAPTER), *C_SOURCES} - {mutant.file}:
                objects.append(Path(name) / f"{Path(other).stem}.o")
                objects[-1].write_bytes(self._object(other))
            compile_c(program, self._written(mutant, Path(name)), *objects, "-lm")
            with CDecoder(program, timeout=_FILE_SECONDS) as decoder:
                caught = failing(decoder.ask)
            caught = caught or failing_cuts(_run_cuts(f"{program} --cuts {{input}} {{cuts}}"))
            if caught:
                return MutantResult(mutant, Fate.CAUGHT, caught)
            with CDecoder(program, C_LIMITS, _FILE_SECONDS) as decoder:
                missed = difference(decoder.ask, self._files, self._expected)
            return MutantResult(mutant, Fate.MISSED if missed else Fate.SAME, missed)

    def _object(self, name: str) -> bytes:
        if name not in self._objects:
            with tempfile.TemporaryDirectory(prefix="csplat-object-") as folder:
                path = Path(folder) / "object"
                compile_c(path, "-c", c_folder() / name)
                self._objects[name] = path.read_bytes()
        return self._objects[name]

    def _written(self, mutant: Mutant, folder: Path) -> Path:
        path = folder / mutant.file
        path.write_text(mutant.apply(self.texts[mutant.file]), encoding="utf-8")
        return path

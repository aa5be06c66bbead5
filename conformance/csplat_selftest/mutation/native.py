"""Mutants of the C decoder, each compiled and asked in a process of its own."""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from pathlib import Path

from csplat.errors import InputError
from csplat_selftest.decoder_processes import C_ADAPTER, C_SOURCES, CDecoder, c_folder, compile_c
from csplat_selftest.fuzzing.decoder_targets import C_LIMITS
from csplat_selftest.mutation.mutants import Fate, Mutant, MutantResult, difference, failing, verdict
from csplat_selftest.mutation.operators import c_mutants

_SECONDS = 5.0  # for one file: more than a hundred times what the largest takes


class NativeDecoder:
    """The C decoder and its mutants.

    Attributes:
        texts: its sources by the names of their files.
        mutants: all of them.

    Args:
        files: fuzzed ones.

    Raises:
        InputError: the compiler or the decoder is not here.
    """

    def __init__(self, files: Sequence[bytes]) -> None:
        self._files = files
        self.texts = {name: (c_folder() / name).read_text(encoding="utf-8") for name in C_SOURCES}
        self.mutants = [mutant for name, text in self.texts.items() for mutant in c_mutants(name, text)]
        self._objects: dict[str, bytes] = {}
        with CDecoder(limits=C_LIMITS) as right:
            self._wanted = [verdict(right.ask(data)) for data in files]

    def valid(self, mutant: Mutant) -> bool:
        """Return True if the mutant compiles."""
        with tempfile.TemporaryDirectory(prefix="csplat-mutant-") as name:
            try:
                compile_c(Path(name) / "nothing", "-fsyntax-only", self._written(mutant, Path(name)))
            except InputError:
                return False
        return True

    def attempt(self, mutant: Mutant) -> MutantResult:
        """Run the vectors, then the fuzzed files, which have smaller budgets."""
        with tempfile.TemporaryDirectory(prefix="csplat-mutant-") as name:
            program, objects = Path(name) / "adapter", []
            for other in {str(C_ADAPTER), *C_SOURCES} - {mutant.file}:
                objects.append(Path(name) / f"{Path(other).stem}.o")
                objects[-1].write_bytes(self._object(other))
            compile_c(program, self._written(mutant, Path(name)), *objects, "-lm")
            with CDecoder(program, timeout=_SECONDS) as decoder:
                caught = failing(decoder.ask)
            if caught:
                return MutantResult(mutant, Fate.CAUGHT, caught)
            with CDecoder(program, C_LIMITS, _SECONDS) as decoder:
                missed = difference(decoder.ask, self._files, self._wanted)
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

"""Mutants of the JavaScript decoder, each a copy of its modules in a Node process of its own."""

from __future__ import annotations

import json
import subprocess
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Final

from csplat.errors import InputError
from csplat_selftest.decoder_processes import JsDecoder, js_folder
from csplat_selftest.fuzzing.decoder_targets import JS_LIMITS
from csplat_selftest.mutation.mutants import Fate, Mutant, MutantResult, difference, failing, verdict

_SECONDS = 5.0  # for one file: more than a hundred times what the largest takes
_OPERATORS = Path("test", "operators.mjs")
#: Not of the decoder of whole files, which is what vectors ask, or not in JavaScript; or tables that are generated.
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
    """The JavaScript decoder and its mutants.

    Attributes:
        texts: its modules by the names of their files.

    Args:
        files: fuzzed ones.

    Raises:
        InputError: Node or the decoder is not here.
    """

    def __init__(self, files: Sequence[bytes]) -> None:
        self._files = files
        self._mutants: list[Mutant] = []
        paths = sorted(js_folder().glob("*.mjs"))
        self.texts = {path.name: path.read_text(encoding="utf-8") for path in paths}
        with JsDecoder(limits=JS_LIMITS) as right:
            self._wanted = [verdict(right.ask(data)) for data in files]

    @property
    def mutants(self) -> Sequence[Mutant]:
        """All of them.

        Raises:
            InputError: the parser cannot be had.
        """
        if not self._mutants:
            paths = [str(js_folder() / name) for name in self.texts if name not in _OTHERS]
            words = ["node", str(js_folder() / _OPERATORS), str(_typescript()), *paths]
            done = subprocess.run(words, capture_output=True, check=True)  # noqa: S603 - our own script
            self._mutants = [Mutant(*one) for one in json.loads(done.stdout)]
        return self._mutants

    def valid(self, mutant: Mutant) -> bool:  # noqa: ARG002 - as for Python
        """Return True: the operators change whole expressions of a parser, so every mutant is a program."""
        return True

    def attempt(self, mutant: Mutant) -> MutantResult:
        """Run the vectors, then the fuzzed files, which have smaller budgets."""
        with tempfile.TemporaryDirectory(prefix="csplat-mutant-") as name:
            folder = Path(name)
            for file, text in self.texts.items():
                changed = mutant.apply(text) if file == mutant.file else text
                (folder / file).write_text(changed, encoding="utf-8")
            with JsDecoder(folder, timeout=_SECONDS) as decoder:
                caught = failing(decoder.ask)
            if caught:
                return MutantResult(mutant, Fate.CAUGHT, caught)
            with JsDecoder(folder, JS_LIMITS, _SECONDS) as decoder:
                missed = difference(decoder.ask, self._files, self._wanted)
            return MutantResult(mutant, Fate.MISSED if missed else Fate.SAME, missed)


def _typescript() -> Path:
    parser = Path("node_modules", "typescript", "lib", "typescript.js")
    found = [parent / parser for parent in js_folder().parents if (parent / parser).exists()]
    if not found:
        raise InputError("typescript, whose parser finds what to change, is absent: run `npm ci` in the checkout")
    return found[0]

"""Planted faults: ways to make a decoder wrong on purpose, and the findings of the conformance suite."""

from __future__ import annotations

import inspect
import shutil
import sys
import tempfile
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from unittest import mock

from csplat import _spec, decoder
from csplat_authoring.recipes import exact_floats
from csplat_conformance.adapter import answer
from csplat_conformance.answers import PARTS, Answer, check_payload_consistency, compare_answer
from csplat_conformance.conformance_report import Outcome, Status
from csplat_conformance.manifest import Vector, load
from csplat_conformance.tolerance import EXACT, RENDERER
from csplat_selftest.decoder_processes import JsDecoder, js_folder

#: Takes the right function, then its arguments.
Wrong = Callable[..., Any]
#: Makes the Python decoder wrong until the stack is closed.
Plant = Callable[[ExitStack], None]

_SHOWN_CLAUSES = 4


@dataclass(frozen=True)
class ModuleEdit:
    """A change of the JavaScript decoder's text.

    Attributes:
        file: module.
        edits: pieces of its text, each of which occurs once, and their replacements.
    """

    file: str
    edits: Mapping[str, str]


@dataclass(frozen=True)
class DecoderFault:
    """One fault of a decoder.

    Attributes:
        name: short name.
        what: the mistake that a hurried implementer might make.
        clause: the clause of the specification that it breaks.
        plant: plants it, in the Python decoder or in the JavaScript decoder.
        by: class of decoders (spec 9.2) that the decoder is tested as.
    """

    name: str
    what: str
    clause: str
    plant: Plant | ModuleEdit
    by: str = EXACT

    @property
    def language(self) -> str:
        """Language of the decoder."""
        return "JavaScript" if isinstance(self.plant, ModuleEdit) else "Python"


@dataclass(frozen=True)
class Finding:
    """The suite's findings about a decoder with a fault."""

    fault: DecoderFault
    failed: Sequence[Outcome]

    @property
    def vectors(self) -> list[str]:
        """Names of the vectors that failed."""
        return list(dict.fromkeys(outcome.name for outcome in self.failed))

    @property
    def clauses(self) -> list[str]:
        """Clauses that the failed vectors name, the most frequent first."""
        by_vector = {outcome.name: outcome.clauses for outcome in self.failed}
        counts = Counter(clause for clauses in by_vector.values() for clause in clauses)
        return [clause for clause, _ in counts.most_common()]


def find(fault: DecoderFault, vectors: Iterable[Vector] | None = None) -> Finding:
    """Run a decoder with a fault over the vectors, or over some of them.

    The code of a refusal does not count, as for any decoder that is not ours.

    Raises:
        InputError: Node or the JavaScript decoder is absent.
    """
    outcomes: list[Outcome] = []
    with ExitStack() as stack:
        if isinstance(fault.plant, ModuleEdit):
            ask = stack.enter_context(_edited_javascript(stack, fault.plant)).ask
        else:
            fault.plant(stack)
            ask = _answer
        near = exact_floats if fault.by == RENDERER else None
        for vector in load() if vectors is None else vectors:
            outcomes += compare_answer(vector, ask(vector.data), tuple(PARTS), near=near)
    return Finding(fault, [one for one in check_payload_consistency(outcomes)[0] if not one.good])


def _answer(data: bytes) -> Answer:
    try:
        return answer(data)
    except Exception as error:  # noqa: BLE001 - a wrong decoder may fail in any way
        return Answer(Status.CRASHED, f"{type(error).__name__}: {error}")


def _edited_javascript(stack: ExitStack, edit: ModuleEdit) -> JsDecoder:
    folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="csplat-fault-")))
    for path in js_folder().glob("*.mjs"):
        shutil.copy(path, folder)
    (folder / edit.file).write_text(edited_module(edit), encoding="utf-8")
    return JsDecoder(folder)


def table(findings: Sequence[Finding]) -> str:
    """Return the faults as a table in Markdown."""
    lines = [
        "| decoder | fault | what it does | vectors failed | for example | clauses |",
        "|---|---|---|---|---|---|",
    ]
    for one in findings:
        fault, clauses = one.fault, one.clauses
        named = [fault.clause, *(clause for clause in clauses if clause != fault.clause)]
        more = f" and {len(named) - _SHOWN_CLAUSES} more" if len(named) > _SHOWN_CLAUSES else ""
        example = next((o.name for o in one.failed if fault.clause in o.clauses), "none")
        cells = (fault.language, fault.name, fault.what, str(len(one.vectors)), f"`{example}`")
        lines.append(f"| {' | '.join(cells)} | {', '.join(named[:_SHOWN_CLAUSES])}{more} |")
    return "\n".join(lines)


# Ways to plant a fault -----------------------------------------------------------------------------


def replaced(name: str, wrong: Wrong, owner: object = None) -> Plant:
    """Return what replaces a function, of an owner or wherever the decoder has imported it."""

    def plant(stack: ExitStack) -> None:
        owners = _owners(name) if owner is None else [owner]
        assert owners, f"the decoder has no {name}"
        for one in owners:
            stack.enter_context(mock.patch.object(one, name, _bound(wrong, getattr(one, name))))

    return plant


def edited(name: str, edits: Mapping[str, str]) -> Plant:
    """Return what replaces pieces of the text of a function, each of which it has to hold once."""

    def plant(stack: ExitStack) -> None:
        (right,) = {getattr(module, name) for module in _owners(name)}
        made: dict[str, Any] = {}
        exec(_edited_text(name, inspect.getsource(right), edits), right.__globals__, made)  # noqa: S102 - our own text
        replaced(name, lambda _right, *args, **options: made[name](*args, **options))(stack)

    return plant


def edited_module(edit: ModuleEdit) -> str:
    """Return the text of a JavaScript module with the fault in it."""
    text = (js_folder() / edit.file).read_text(encoding="utf-8")
    return _edited_text(edit.file, text, edit.edits)


def constants(**values: int) -> Plant:
    """Return what gives constants of the format other values."""
    return together(
        *(lambda stack, k=k, v=v: stack.enter_context(mock.patch.object(_spec, k, v)) for k, v in values.items())
    )


def together(*plants: Plant) -> Plant:
    """Return what plants several faults."""

    def plant(stack: ExitStack) -> None:
        for one in plants:
            one(stack)

    return plant


def nothing(_right: Wrong, *_args: Any, **_options: Any) -> None:
    """Do nothing in the place of a function."""


def _owners(name: str) -> list[object]:
    prefix = decoder.__name__ + "."
    modules = [module for key, module in list(sys.modules.items()) if key.startswith(prefix)]
    return [module for module in modules if hasattr(module, name)]


def _bound(wrong: Wrong, right: Wrong) -> Wrong:
    def replacement(*args: Any, **options: Any) -> Any:
        return wrong(right, *args, **options)

    return replacement


def _edited_text(name: str, text: str, edits: Mapping[str, str]) -> str:
    for old, new in edits.items():
        if text.count(old) != 1:
            raise ValueError(f"{name} has {old!r} {text.count(old)} times, expected once: mend the fault")
        text = text.replace(old, new)
    return text

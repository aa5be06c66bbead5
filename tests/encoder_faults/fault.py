"""The type of a fault, and ways of making one."""

import contextlib
import dataclasses
from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager
from dataclasses import dataclass, field
from enum import StrEnum
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np

import csplat

PLAIN, DEGREE_2, DEGREE_3 = "ordinary/degree_1", "ordinary/degree_2", "ordinary/degree_3"
STRONG = "ordinary/strong_colours"
#: An input with many slender splats, which shows defects of every splat.
DENSE = "ordinary/surfaces"

Scene = csplat.SplatModel
Bytes = Callable[[bytes], bytes]


class Harm(StrEnum):
    """The harm that a fault does to users of the file."""

    VALIDITY = "validity"  #: a decoder refuses it, or there is no file
    PICTURE = "picture"  #: it looks wrong
    BOUND = "bound"  #: a stated error does not hold, or cannot be relied on
    FACTS = "facts"  #: it makes false statements about the source or its splats
    DETERMINISM = "determinism"  #: the same input gives other bytes
    FILES = "files"  #: files of the user are changed or left about, or cannot be encoded
    COARSE = "coarse"  #: legal and honest, and far worse than need be, or refused though it need not: worth a warning
    HARMLESS = "harmless"  #: no fault at all: a freedom that encoders have, and that the suite must leave them


@dataclass(frozen=True)
class EncoderFault:
    """One fault.

    Attributes:
        why: the author's wrong belief.
        harm: the harm that it does.
        caught: level and clause that ought to find it; the clause is empty if no clause is broken, and
            both are empty if there is nothing to find.
        inputs: patterns of the reference inputs that show it; a pattern without a match is not an error.
        ply: changes the bytes of the input before they are read.
        scene: changes what was read.
        keep: indices of the splats to encode, in order; the others count as pruned.
        stage: changes reader and encoder until it is left.
        options: options of the encoder.
        honest: the errors that the file states are measured at the end against this scene of the input.
        data: changes the file.
        index: changes the mapping from splats of the file to splats of the source.
        end: takes input and output, the encoder's bytes, and ends the process as it pleases.
        starts: it needs a process of its own to end in.
    """

    why: str
    harm: Harm
    caught: tuple[str, str] = ("", "")
    inputs: str = PLAIN
    ply: Bytes | None = None
    scene: Callable[[Scene], Scene] | None = None
    keep: Callable[[Scene], Any] | None = None
    stage: Callable[[], AbstractContextManager[object]] = contextlib.nullcontext
    options: Mapping[str, Any] = field(default_factory=dict)
    honest: Callable[[Path], Any] | None = None
    data: Bytes | None = None
    index: Callable[[Any], Any] | None = None
    end: Callable[[Path, Path, bytes], None] | None = None
    starts: bool = False

    @property
    def is_late(self) -> bool:
        """True if the fault is made after our encoder has finished."""
        early = (self.ply, self.scene, self.keep)
        return all(change is None for change in early) and self.stage is contextlib.nullcontext


def changed(**fields: Callable[[Scene], Any]) -> Callable[[Scene], Scene]:
    """Return a change of a scene: each field is made of the scene as it was."""
    return lambda model: dataclasses.replace(model, **{name: make(model) for name, make in fields.items()})


def replaced(module, name, make):
    """Return a stage change: `make` is given the original function."""
    return lambda: mock.patch.object(module, name, make(getattr(module, name)))


def floats(values):
    return np.ascontiguousarray(values, dtype=np.float32)

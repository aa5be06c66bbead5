# SPDX-License-Identifier: Apache-2.0
"""Checkpoints of a `Fitter`, from which a training or a tuning continues exactly."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from csplat.archives import DAMAGED, read_archive
from csplat.disk_files import atomic_writer, parse_json
from csplat.errors import InputError
from csplat.types import F32
from csplat_trainer.parameters import Parameters

Kind = Literal["train", "finetune"]  # the command of a run

_VERSION = 2
_FACTS = {
    "kind": str, "iteration": int, "has_ended": bool, "rng_state": dict, "queue": list, "gains": list,
    "options": dict, "log": dict, "own": dict,
}  # fmt: skip
_PARTS = ("values", "first", "second")  # attributes of `Parameters`, prefixes of array names


@dataclass
class FitCheckpoint:
    """A run between two steps.

    Attributes:
        kind: `train` or `finetune`.
        iteration: number of steps so far.
        has_ended: the run ended, perhaps before its last step.
        rng_state: state of the random generator, JSON-compatible.
        queue: indices of the images that remain in this epoch.
        gains: corrections of the images, see `ImageGains.as_json`; empty if they are not trained.
        options: options of the run, as a dictionary.
        log: log so far.
        parameters: the values, with Adam's moments.
        own: state that only this kind of run has, JSON-compatible.
        arrays: its arrays.
    """

    kind: Kind
    iteration: int
    has_ended: bool
    rng_state: dict[str, Any]
    queue: list[int]
    gains: list[list[float]]
    options: dict[str, Any]
    log: dict[str, Any]
    parameters: Parameters
    own: dict[str, Any] = field(default_factory=dict)
    arrays: dict[str, F32] = field(default_factory=dict)


def save_checkpoint(path: str | Path, checkpoint: FitCheckpoint) -> None:
    """Write a checkpoint; the file gets its name only when it is complete."""
    facts = {"version": _VERSION, "step": checkpoint.parameters.step}
    facts |= {name: getattr(checkpoint, name) for name in _FACTS}
    arrays: dict[str, NDArray[Any]] = {"facts": np.frombuffer(json.dumps(facts).encode(), np.uint8)}
    for part in _PARTS:
        arrays |= {f"{part}_{name}": array for name, array in getattr(checkpoint.parameters, part).items()}
    with atomic_writer(str(path)) as stream:
        np.savez(stream, allow_pickle=False, **arrays, **checkpoint.arrays)


def load_checkpoint(path: str | Path, kind: Kind = "train") -> FitCheckpoint:
    """Read a checkpoint.

    Args:
        path: the file.
        kind: expected kind of run.

    Raises:
        InputError: the file is not a checkpoint, or is of another version or kind.
        OSError: the file cannot be read.
    """
    stored = read_archive(path, f"a checkpoint of csplat {kind}")
    facts = stored.facts()
    stored.check(facts, {"version": int})
    if facts["version"] != _VERSION:
        raise InputError(f"{path} is a checkpoint of version {facts['version']}, expected {_VERSION}: begin a new run")
    stored.check(facts, {**_FACTS, "step": int})
    if facts["kind"] != kind:
        stored.refuse(f"it is of csplat {facts['kind']}")
    del stored["facts"]
    values, first, second = (
        {name.removeprefix(part): stored.pop(name) for name in list(stored) if name.startswith(part)}
        for part in (f"{part}_" for part in _PARTS)
    )
    for moments in (first, second):
        check_arrays(path, moments, {name: array.shape for name, array in values.items()})
    parameters = Parameters(values, first, second, facts["step"])
    return FitCheckpoint(**{name: facts[name] for name in _FACTS}, parameters=parameters, arrays=dict(stored))


def count_steps(path: str | Path) -> tuple[int, int] | None:
    """Return the number of finished steps of a checkpoint, and of all steps; `None` if it has neither.

    Only these facts are read, not the parameters.
    """
    try:
        with np.load(path, allow_pickle=False) as archive:
            facts = parse_json(archive["facts"].tobytes())
        return int(facts["iteration"]), int(facts["options"]["iterations"])
    except DAMAGED:
        return None


def check_arrays(path: str | Path, arrays: Mapping[str, NDArray[Any]], shapes: Mapping[str, tuple[int, ...]]) -> None:
    """Check the arrays of a checkpoint.

    Raises:
        InputError: an array is missing, has another shape, or is not finite float32.
    """
    for name, shape in shapes.items():
        array = arrays.get(name, np.empty(0))
        if array.shape != shape or array.dtype != np.float32 or not np.isfinite(array).all():
            raise InputError(f"{path}: {name} is {array.dtype} {list(array.shape)}, expected finite float32 {shape}")

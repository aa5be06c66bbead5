"""Checkpoints of fine-tuning: everything a run needs to go on as if it had not stopped."""

from __future__ import annotations

import hashlib
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from csplat.archives import read_archive
from csplat.encoder import FreeValues, Frozen
from csplat.errors import InputError
from csplat.files import atomic_writer
from csplat_trainer.parameters import GROUPS, Parameters

_VERSION = 1
_FACTS = {
    "frozen": str, "iteration": int, "step": int, "rng_state": dict, "queue": list, "options": dict, "log": dict,
    "best": list,
}  # fmt: skip
_BEST = 4  # numbers of the best look
_KIND = "csplat finetune"
_HELD = ("means", "quats", "scales", "opacities", "sh0", "sh", "sizes")
_GROUPS = (*GROUPS, "sizes")


@dataclass
class FinetuneCheckpoint:
    """A run between two steps.

    Attributes:
        iteration: steps that were made.
        parameters: the values, with Adam's memory.
        rng_state: of the generator of the order of pictures, JSON-compatible.
        queue: pictures that are still to come in this round.
        options: of the run, as a dictionary.
        log: what was logged so far.
        best_held: the best values so far.
        costs: slopes of the costs of bytes by attribute, as they were last counted; empty if they never were.
        best: their score and PSNR on the validation views, the step that they stood at, how many looks came after.
    """

    iteration: int
    parameters: Parameters
    rng_state: dict[str, Any]
    queue: list[int]
    options: dict[str, Any]
    log: dict[str, Any]
    best_held: FreeValues
    costs: dict[str, NDArray[np.float32]]
    best: tuple[float, float, int, int]


def save_finetune(path: str | Path, checkpoint: FinetuneCheckpoint, frozen: Frozen) -> None:
    """Write a checkpoint; the file appears under its name only when it is complete."""
    facts = {
        "kind": _KIND,
        "version": _VERSION,
        "frozen": fingerprint(frozen),
        "iteration": checkpoint.iteration,
        "step": checkpoint.parameters.step,
        "rng_state": checkpoint.rng_state,
        "queue": checkpoint.queue,
        "options": checkpoint.options,
        "log": checkpoint.log,
        "best": list(checkpoint.best),
    }
    arrays: dict[str, NDArray[Any]] = {"facts": np.frombuffer(json.dumps(facts).encode(), np.uint8)}
    for kind in ("values", "first", "second"):
        arrays |= {f"{kind}_{name}": getattr(checkpoint.parameters, kind)[name] for name in _GROUPS}
    arrays |= {f"best_{name}": getattr(checkpoint.best_held, name) for name in _HELD}
    arrays |= {f"costs_{name}": table for name, table in checkpoint.costs.items()}
    with atomic_writer(str(path)) as stream:
        np.savez(stream, allow_pickle=False, **arrays)


def load_finetune(path: str | Path, frozen: Frozen) -> FinetuneCheckpoint:
    """Read a checkpoint of a frozen scene.

    Raises:
        InputError: the file is no checkpoint, was written by another version, or for another scene or other options
            of the encoder.
        OSError: it cannot be read.
    """
    stored = read_archive(path, "a checkpoint of csplat finetune")
    facts = stored.facts()
    if facts.get("kind") != _KIND:
        stored.refuse("it is of another kind")
    if facts.get("version") != _VERSION:
        raise InputError(f"{path} is a checkpoint of version {facts.get('version')}, wanted {_VERSION}")
    stored.check(facts, _FACTS)
    if facts["frozen"] != fingerprint(frozen):
        raise InputError(f"{path} belongs to another scene, or to other options of the encoder")
    if len(facts["best"]) != _BEST or not all(isinstance(one, (int, float)) for one in facts["best"]):
        stored.refuse(f"its best look is {facts['best']}")
    parts = [{name: stored[f"{kind}_{name}"] for name in _GROUPS} for kind in ("values", "first", "second")]
    best = FreeValues(*(stored[f"best_{name}"] for name in _HELD))
    costs = {name.removeprefix("costs_"): array for name, array in stored.items() if name.startswith("costs_")}
    if any(table.ndim != 2 or table.dtype != np.float32 or not np.isfinite(table).all() for table in costs.values()):
        stored.refuse("its costs are no tables of float32")
    score, psnr, iteration, since = facts["best"]
    checkpoint = FinetuneCheckpoint(
        facts["iteration"],
        Parameters(parts[0], parts[1], parts[2], facts["step"]),
        facts["rng_state"],
        facts["queue"],
        facts["options"],
        facts["log"],
        best,
        costs,
        (score, psnr, iteration, since),
    )
    _check(path, checkpoint, frozen.start())
    return checkpoint


def fingerprint(frozen: Frozen) -> str:
    """A digest of all that was decided, and of the values that it was decided for."""
    digest, start = hashlib.sha256(repr(frozen.plan).encode()), frozen.start()
    index = () if frozen.book is None else (frozen.book.index,)
    for array in (frozen.source_index, *index, *(getattr(start, name) for name in _HELD)):
        digest.update(np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()


def _check(path: str | Path, checkpoint: FinetuneCheckpoint, start: FreeValues) -> None:
    shapes = {name: getattr(start, name).shape for name in _HELD}
    found: dict[str, list[NDArray[Any]]] = {name: [getattr(checkpoint.best_held, name)] for name in _HELD}
    parameters = checkpoint.parameters
    for part in (parameters.values, parameters.first, parameters.second):
        for name in _GROUPS:
            found[{"logits": "opacities", "shN": "sh"}.get(name, name)].append(part[name])
    for name, arrays in found.items():
        for array in arrays:
            if array.shape != shapes[name] or array.dtype != np.float32 or not np.isfinite(array).all():
                raise InputError(f"{path}: {name} is {array.dtype} {list(array.shape)}, wanted float32 {shapes[name]}")

"""Checkpoints: everything a training run needs to go on as if it had not stopped."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from csplat.archives import read_archive
from csplat.errors import InputError
from csplat.files import atomic_writer
from csplat_trainer.parameters import GROUPS, Parameters, Splats

_VERSION = 1
_FACTS = {"iteration": int, "step": int, "rng_state": dict, "queue": list, "options": dict, "log": dict}


@dataclass
class Checkpoint:
    """A training run between two steps.

    Attributes:
        iteration: steps that were made.
        parameters: of the splats, with Adam's memory.
        rng_state: of the generator of every random choice, JSON-compatible.
        queue: pictures that are still to come in this round.
        options: of the run, as a dictionary.
        log: what was logged so far.
        origin: what the means are relative to.
    """

    iteration: int
    parameters: Parameters
    rng_state: dict[str, Any]
    queue: list[int]
    options: dict[str, Any]
    log: dict[str, Any]
    origin: tuple[float, float, float] = (0.0, 0.0, 0.0)


def save_checkpoint(path: str | Path, checkpoint: Checkpoint) -> None:
    """Write a checkpoint; the file appears under its name only when it is complete."""
    facts = {
        "version": _VERSION,
        "iteration": checkpoint.iteration,
        "step": checkpoint.parameters.step,
        "rng_state": checkpoint.rng_state,
        "queue": checkpoint.queue,
        "options": checkpoint.options,
        "log": checkpoint.log,
        "origin": checkpoint.origin,
    }
    arrays: dict[str, NDArray[Any]] = {"facts": np.frombuffer(json.dumps(facts).encode(), np.uint8)}
    for kind in ("values", "first", "second"):
        part: Splats = getattr(checkpoint.parameters, kind)
        arrays |= {f"{kind}_{name}": part[name] for name in GROUPS}
    with atomic_writer(str(path)) as stream:
        np.savez(stream, allow_pickle=False, **arrays)


def load_checkpoint(path: str | Path) -> Checkpoint:
    """Read a checkpoint.

    Raises:
        InputError: the file is not one, or was written by another version.
        OSError: it cannot be read.
    """
    stored = read_archive(path, "a checkpoint of csplat train")
    facts = stored.facts()
    if facts.get("version") != _VERSION:
        raise InputError(f"{path} is a checkpoint of version {facts.get('version')}, wanted {_VERSION}")
    stored.check(facts, _FACTS)
    parts = [{name: stored[f"{kind}_{name}"] for name in GROUPS} for kind in ("values", "first", "second")]
    _check(path, parts)
    return Checkpoint(
        facts["iteration"],
        Parameters(parts[0], parts[1], parts[2], facts["step"]),
        facts["rng_state"],
        facts["queue"],
        facts["options"],
        facts["log"],
        _origin(path, facts),
    )


def _origin(path: str | Path, facts: dict[str, Any]) -> tuple[float, float, float]:
    """Return the origin that a checkpoint states; those of older versions state none, and had 0."""
    try:
        x, y, z = (float(value) for value in facts.get("origin", (0.0, 0.0, 0.0)))
    except (TypeError, ValueError):
        x = y = z = math.nan
    if not (math.isfinite(x) and math.isfinite(y) and math.isfinite(z)):
        raise InputError(f"{path}: origin is {facts['origin']!r}, expected three numbers")
    return x, y, z


def _check(path: str | Path, parts: list[Splats]) -> None:
    count = len(parts[0]["means"]) if parts[0]["means"].ndim else -1
    coefficients = parts[0]["shN"].shape[1] if parts[0]["shN"].ndim == 3 else -1
    shapes: dict[str, tuple[int, ...]] = {
        "means": (count, 3),
        "quats": (count, 4),
        "scales": (count, 3),
        "logits": (count,),
        "sh0": (count, 3),
        "shN": (count, coefficients, 3),
    }
    for part in parts:
        for name, shape in shapes.items():
            array = part[name]
            if array.shape != shape or array.dtype != np.float32 or not np.isfinite(array).all():
                raise InputError(f"{path}: {name} is {array.dtype} {list(array.shape)}, wanted finite float32 {shape}")

"""Checkpoints of training, from which a run continues exactly, or with other options."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from csplat.archives import read_archive
from csplat.disk_files import atomic_writer
from csplat.errors import InputError
from csplat_trainer.parameters import GROUPS, ParameterArrays, Parameters
from csplat_trainer.strategies import grow
from csplat_trainer.training_options import TrainOptions

_VERSION = 1
_FACTS = {"iteration": int, "step": int, "rng_state": dict, "queue": list, "options": dict, "log": dict}


@dataclass
class TrainingCheckpoint:
    """A training run between two steps.

    Attributes:
        iteration: number of steps so far.
        parameters: parameters of the splats, with Adam's moments.
        rng_state: state of the random generator, JSON-compatible.
        queue: indices of the images that remain in this epoch.
        options: options of the run, as a dictionary.
        log: log so far.
        origin: the point that means are relative to.
    """

    iteration: int
    parameters: Parameters
    rng_state: dict[str, Any]
    queue: list[int]
    options: dict[str, Any]
    log: dict[str, Any]
    origin: tuple[float, float, float] = (0.0, 0.0, 0.0)


def save_checkpoint(path: str | Path, checkpoint: TrainingCheckpoint) -> None:
    """Write a checkpoint; the file gets its name only when it is complete."""
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
        part: ParameterArrays = getattr(checkpoint.parameters, kind)
        arrays |= {f"{kind}_{name}": part[name] for name in GROUPS}
    with atomic_writer(str(path)) as stream:
        np.savez(stream, allow_pickle=False, **arrays)


def load_checkpoint(path: str | Path) -> TrainingCheckpoint:
    """Read a checkpoint.

    Raises:
        InputError: the file is not a checkpoint, or is of another version.
        OSError: the file cannot be read.
    """
    stored = read_archive(path, "a checkpoint of csplat train")
    facts = stored.facts()
    if facts.get("version") != _VERSION:
        raise InputError(f"{path} is a checkpoint of version {facts.get('version')}, expected {_VERSION}")
    stored.check(facts, _FACTS)
    parts = [{name: stored[f"{kind}_{name}"] for name in GROUPS} for kind in ("values", "first", "second")]
    _check(path, parts)
    return TrainingCheckpoint(
        facts["iteration"],
        Parameters(parts[0], parts[1], parts[2], facts["step"]),
        facts["rng_state"],
        facts["queue"],
        facts["options"],
        facts["log"],
        _origin(path, facts),
    )


def _origin(path: str | Path, facts: dict[str, Any]) -> tuple[float, float, float]:
    """Return the origin of a checkpoint; 0 if it has none, as in older versions."""
    try:
        x, y, z = (float(value) for value in facts.get("origin", (0.0, 0.0, 0.0)))
    except (TypeError, ValueError):
        x = y = z = math.nan
    if not (math.isfinite(x) and math.isfinite(y) and math.isfinite(z)):
        raise InputError(f"{path}: origin is {facts['origin']!r}, expected three numbers")
    return x, y, z


def _check(path: str | Path, parts: list[ParameterArrays]) -> None:
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
                raise InputError(
                    f"{path}: {name} is {array.dtype} {list(array.shape)}, expected finite float32 {shape}"
                )


def fit_to_options(parameters: Parameters, options: TrainOptions, rng: Generator) -> Parameters:
    """Adapt the parameters of a checkpoint to another number of splats and another SH degree.

    If there are too many splats, those with the least opacity times area of the two longer axes are pruned. If there
    are too few for a fixed count, splats are added as by growth. SH bands are truncated, or extended by zeros.

    Args:
        parameters: parameters of a checkpoint; changed in place.
        options: options of the continued run.
        rng: source of random choices.

    Returns:
        `parameters`.
    """
    for part in (parameters.values, parameters.first, parameters.second):
        _fit_degree(part, options.sh_degree)
    if len(parameters) > options.max_splats:
        parameters.keep(_most_visible(parameters, options.max_splats))
    elif options.strategy == "fixed":
        while 0 < len(parameters) < options.max_splats:
            grow(parameters, 2.0, options.max_splats, options.dead_opacity, rng)
    return parameters


def _fit_degree(part: ParameterArrays, degree: int) -> None:
    coefficients = (degree + 1) ** 2 - 1
    old = part["shN"]
    if old.shape[1] == coefficients:
        return
    fitted = np.zeros((len(old), coefficients, 3), np.float32)
    common = min(coefficients, old.shape[1])
    fitted[:, :common] = old[:, :common]
    part["shN"] = fitted


def _most_visible(parameters: Parameters, count: int) -> np.ndarray[tuple[int], np.dtype[np.int64]]:
    longer = np.sort(parameters.values["scales"].astype(np.float64), axis=1)[:, 1:]
    weight = parameters.alphas * np.exp(np.minimum(longer.sum(axis=1), 700.0))  # the exponential fits float64
    return np.sort(np.argsort(-weight, kind="stable")[:count])

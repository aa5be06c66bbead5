"""A checkpoint under other options than it was made with: another number of splats, another SH degree."""

from __future__ import annotations

import numpy as np
from numpy.random import Generator

from csplat_trainer.mcmc import grow
from csplat_trainer.options import TrainOptions
from csplat_trainer.parameters import Parameters, Splats


def adapt(parameters: Parameters, options: TrainOptions, rng: Generator) -> Parameters:
    """Make parameters fit the options.

    Too many splats: those that show least (opacity times the area of their two longer axes) go.
    Too few for a fixed count: splats are added beside others, as growth does. SH bands are cut off,
    or added as zeros.

    Args:
        parameters: of a checkpoint; changed in place.
        options: of the run that goes on.
        rng: chooses where splats are added.

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


def _fit_degree(part: Splats, degree: int) -> None:
    wanted = (degree + 1) ** 2 - 1
    old = part["shN"]
    if old.shape[1] == wanted:
        return
    fitted = np.zeros((len(old), wanted, 3), np.float32)
    common = min(wanted, old.shape[1])
    fitted[:, :common] = old[:, :common]
    part["shN"] = fitted


def _most_visible(parameters: Parameters, count: int) -> np.ndarray[tuple[int], np.dtype[np.int64]]:
    longer = np.sort(parameters.values["scales"].astype(np.float64), axis=1)[:, 1:]
    weight = parameters.alphas * np.exp(np.minimum(longer.sum(axis=1), 700.0))  # below the end of float64
    return np.sort(np.argsort(-weight, kind="stable")[:count])

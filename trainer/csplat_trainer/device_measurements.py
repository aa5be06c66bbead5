# SPDX-License-Identifier: Apache-2.0
"""Measure splats exactly on the CPU, or estimate on a GPU; make the rasteriser that torch uses on a device."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from csplat.context import DEFAULT_CONTEXT, Context
from csplat.encoder import Importance
from csplat.errors import InputError, missing_package
from csplat.model import SplatModel
from csplat.types import F32
from csplat_render.camera import Camera
from csplat_render.pruning_error import PruningError, measure_pruning_error
from csplat_trainer.sensitivity import measure_sensitivity
from csplat_trainer.sensitivity_file import StoredSensitivity
from csplat_trainer.training_options import Device


def measure_importance(
    model: SplatModel,
    cameras: Sequence[Camera],
    background: F32,
    device: Device,
    *,
    context: Context = DEFAULT_CONTEXT,
) -> Importance:
    """Measure the importance of each splat.

    Args:
        model: the scene.
        cameras: the views, at least one; relative to the scene's origin.
        background: [3].
        device: `cpu` or `cuda`.
        context: threads and progress.

    Raises:
        InputError: no view shows any splat, or the device is not usable.
    """
    if device == "cpu":
        sensitivity = measure_sensitivity(
            model, cameras, background=background, metric=True, magnitudes=False, context=context
        )
    else:
        rasteriser = make_rasteriser(device, antialiased=model.metadata.antialiased)
        from csplat_trainer.gsplat_derivatives import estimate_sensitivity

        sensitivity = estimate_sensitivity(rasteriser, model, cameras, background, progress=context.progress)
    if not sensitivity.seen.any():
        raise InputError("no view shows any splat: check that the cameras belong to the scene")
    return StoredSensitivity.of(model, sensitivity).importance()


def measure_pruning(
    model: SplatModel,
    cameras: Sequence[Camera],
    background: F32,
    device: Device,
    *,
    context: Context = DEFAULT_CONTEXT,
) -> PruningError:
    """Measure the pruning error of each splat; arguments and errors as for `measure_importance`."""
    if device == "cpu":
        return measure_pruning_error(model, cameras, background=background, context=context)
    rasteriser = make_rasteriser(device, antialiased=model.metadata.antialiased)
    from csplat_trainer.gsplat_derivatives import estimate_pruning

    return estimate_pruning(rasteriser, model, cameras, background)


def make_rasteriser(device: Device, *, antialiased: bool, context: Context = DEFAULT_CONTEXT) -> Any:
    """Return the rasteriser for torch on a device, a `CpuRasteriser` or a `GsplatRasteriser`.

    Raises:
        InputError: torch, gsplat or the GPU is absent.
    """
    try:
        from csplat_trainer.gsplat_rasteriser import GsplatRasteriser
        from csplat_trainer.torch_rasteriser import CpuRasteriser
    except ModuleNotFoundError as error:
        raise missing_package(error, extra="train" if device == "cpu" else "cuda") from None
    if device == "cpu":
        return CpuRasteriser(antialiased=antialiased, context=context)
    return GsplatRasteriser(antialiased=antialiased)

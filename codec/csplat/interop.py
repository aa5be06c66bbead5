# SPDX-License-Identifier: Apache-2.0
# torch may be absent:
# pyright: reportMissingImports=false
"""Convert models to and from dicts of arrays or tensors with gsplat's names.

| name | `form="parameters"`, as in training and checkpoints | `form="activated"`, as in `gsplat.rasterization` |
|---|---|---|
| `means` | [N, 3] scene units | the same |
| `quats` | [N, 4] w x y z, any length | the same |
| `scales` | [N, 3] natural logarithms | [N, 3] standard deviations, scene units |
| `opacities` | [N] logits | [N] alpha, 0 to 1 |
| `sh0` | [N, 1, 3] coefficient of degree 0 | the same |
| `shN` | [N, K, 3] higher coefficients, K = 0, 3, 8, 15 or 24 | the same |

A `SplatModel` mixes the two forms: it holds log scales and alpha. torch is imported only if tensors are requested.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, Literal, get_args, overload

import numpy as np

from csplat.errors import InputError
from csplat.model import SplatModel, check_model, normalise_quats
from csplat.ply.columns import alpha_of_logits, flatten_scales, logits_of_alpha
from csplat.portable_math import log
from csplat.types import F32

if TYPE_CHECKING:
    from torch import Tensor


Form = Literal["parameters", "activated"]

_REQUIRED = ("means", "quats", "scales", "opacities", "sh0")
#: Names in checkpoints of gsplat's simple_trainer with `app_opt`, and of splatfacto-w.
_APPEARANCE = ("features", "appearance_features")
_SPLATS = "splats"  # key of the splats in gsplat's checkpoints


def from_gsplat(splats: Mapping[str, Any], *, form: Form = "parameters") -> SplatModel:
    """Make a model from a dict with gsplat's names.

    Args:
        splats: arrays, or torch tensors on any device, with or without gradients: `means` [N, 3], `quats` [N, 4]
            w x y z of any length, `scales` [N, 3], `opacities` [N], `sh0` [N, 1, 3], and optionally `shN` [N, K, 3].
            For a checkpoint of gsplat's trainer, its member `splats` is used.
        form: "parameters", as trained: log scales and logits of opacities; or "activated", as
            `gsplat.rasterization` expects them: standard deviations in scene units and alpha.

    Returns:
        The scene, with copies of the arrays as float32 and normalised rotations. Other fields have their defaults; for
        a scene trained with antialiasing, use `dataclasses.replace(model, antialiased=True)`.

    Examples:
        >>> import csplat, numpy as np
        >>> splats = {
        ...     "means": np.zeros((2, 3)), "quats": np.ones((2, 4)), "scales": np.log(np.full((2, 3), 0.01)),
        ...     "opacities": np.zeros(2), "sh0": np.zeros((2, 1, 3)),
        ... }
        >>> csplat.from_gsplat(splats).opacities  # sigmoid of the logits
        array([0.5, 0.5], dtype=float32)

    Raises:
        InputError: a name is missing, or an array has the wrong shape, is not finite, or is out of range.
    """
    _check_form(form)
    if not any(name in splats for name in _REQUIRED) and _SPLATS in splats:
        splats = splats[_SPLATS]
    missing = [name for name in _REQUIRED if name not in splats]
    if missing:
        learnt = any(name in splats for name in _APPEARANCE)
        hint = "; it was trained with appearance features, which are not SH" if learnt else ""
        raise InputError(f"the splats have no {', '.join(missing)}, expected gsplat's names{hint}")
    means, quats, scales, opacities, sh0 = (_array(name, splats[name]) for name in _REQUIRED)
    count = len(means) if means.ndim else 0
    shN = _array("shN", splats["shN"]) if "shN" in splats else np.zeros((count, 0, 3), np.float32)
    if quats.shape != (count, 4):
        raise InputError(f"quats has shape {list(quats.shape)}, expected [{count}, 4]")
    if not np.isfinite(quats).all():
        raise InputError("quats contains NaN or infinity")
    opacities = _reshape("opacities", opacities, (count,), (count, 1))
    if form == "parameters":
        opacities = alpha_of_logits(opacities)
    elif (scales >= 0.0).all():
        scales = log(scales).astype(np.float32)
    else:
        raise InputError('scales are not all at least 0: use form="parameters" for logarithms')
    flatten_scales(scales.reshape(-1, 1))  # a view
    sh0 = _reshape("sh0", sh0, (count, 3), (count, 1, 3))
    return SplatModel(means, normalise_quats(quats), scales, opacities, sh0, shN)


@overload
def to_gsplat(model: SplatModel, *, form: Form = ..., device: None = None) -> dict[str, F32]: ...
@overload
def to_gsplat(model: SplatModel, *, form: Form = ..., device: str) -> dict[str, Tensor]: ...
def to_gsplat(
    model: SplatModel, *, form: Form = "parameters", device: str | None = None
) -> dict[str, F32] | dict[str, Tensor]:
    """Convert a model to a dict with gsplat's names.

    To render with gsplat: `s = to_gsplat(model, form="activated", device="cuda")`, then
    `rasterization(s["means"], s["quats"], s["scales"], s["opacities"], torch.cat([s["sh0"], s["shN"]], 1), viewmats,
    Ks, width, height, sh_degree=model.sh_degree)`. Cameras are relative to `model.origin`, as the means are.

    Args:
        model: the scene.
        form: as in `from_gsplat`.
        device: device of the torch tensors, "cpu" or "cuda"; `None`: NumPy arrays.

    Returns:
        `means` [N, 3], `quats` [N, 4] w x y z, `scales` [N, 3], `opacities` [N], `sh0` [N, 1, 3], `shN` [N, K, 3]:
        float32 copies. Logits are finite for alpha 0 and 1, too.

    Examples:
        >>> import csplat
        >>> splats = csplat.to_gsplat(csplat.decode("scene.csplat"), form="activated")
        >>> splats["sh0"].shape, splats["shN"].shape, bool(splats["scales"].min() > 0.0)
        ((1000, 1, 3), (1000, 15, 3), True)

    Raises:
        InputError: `model` is not a model, the form is unknown, or torch is not installed.
    """
    check_model("to_gsplat", model)
    _check_form(form)
    activated = form == "activated"
    with np.errstate(over="ignore", under="ignore"):
        scales = np.exp(model.scales.astype(np.float64)).astype(np.float32) if activated else model.scales.copy()
    arrays = {
        "means": model.means.copy(),
        "quats": model.quats.copy(),
        "scales": scales,
        "opacities": model.opacities.copy() if activated else logits_of_alpha(model.opacities),
        "sh0": model.sh0[:, None, :].copy(),
        "shN": model.shN.copy(),
    }
    if device is None:
        return arrays
    try:
        import torch
    except ModuleNotFoundError:
        raise InputError("tensors require torch, which is not installed; use device=None for NumPy arrays") from None
    return {name: torch.from_numpy(array).to(device) for name, array in arrays.items()}


def _array(name: str, value: Any) -> F32:
    """Copy an array or a tensor of any device to float32; raise an `InputError` for other values."""
    if hasattr(value, "detach"):
        value = value.detach().cpu().float().numpy()  # float: NumPy has no bfloat16
    try:
        with np.errstate(over="ignore"):
            return np.array(value, np.float32)
    except (TypeError, ValueError) as error:
        raise InputError(f"{name} is a {type(value).__name__}, expected an array or a tensor: {error}") from None


def _reshape(name: str, array: F32, shape: tuple[int, ...], also: tuple[int, ...]) -> F32:
    """Reshape an array of shape `shape` or `also` to `shape`; raise an `InputError` for another shape."""
    if array.shape not in (shape, also):
        raise InputError(f"{name} has shape {list(array.shape)}, expected {list(also)}")
    return array.reshape(shape)


def _check_form(form: str) -> None:
    """Raise an `InputError` unless `form` is a value of `Form`."""
    if form not in get_args(Form):
        raise InputError(f"form is {form!r}, expected one of {', '.join(get_args(Form))}")

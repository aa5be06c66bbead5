# torch may be absent:
# pyright: reportMissingImports=false
"""Checkpoints of gsplat's simple_trainer and of nerfstudio's splatfacto, read as scenes.

Both are pickles of torch; nothing in them is run: `weights_only` admits tensors, containers and plain numbers alone.
What they do not say, such as whether a scene was trained antialiased, stands in the files of their trainers.
"""

from __future__ import annotations

import math
import pickle
import warnings
import zipfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, nullcontext
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from csplat.bridges import from_gsplat
from csplat.errors import InputError, missing
from csplat.formats import Format
from csplat.lint import too_many_bands
from csplat.model import MAX_SH_DEGREE, SplatModel
from csplat.scene import Scene, scene_of

__all__ = ["FORMAT"]

_SH_C0 = 0.28209479177387814
_SPLATFACTO = "gauss_params."  # in the names of splatfacto's tensors, after those of what holds the model
_NAMES = {
    "means": "means",
    "quats": "quats",
    "scales": "scales",
    "opacities": "opacities",
    "features_dc": "sh0",
    "features_rest": "shN",
}


@contextmanager
def _open(path: Path, sh_degree: int | None = None) -> Iterator[Scene]:
    yield scene_of(_read(path, sh_degree))


def _read(path: Path, sh_degree: int | None) -> SplatModel:
    try:
        import torch
    except ModuleNotFoundError as error:
        raise InputError(f"{path.name} is a checkpoint of torch: {missing(error, extra='train')}") from None
    try:
        with _plain_numbers(torch), warnings.catch_warnings(action="ignore"):
            # Mapped: of a checkpoint of splatfacto two thirds are Adam's memory.
            said = torch.load(path, map_location="cpu", weights_only=True, mmap=zipfile.is_zipfile(path))
    except OSError:
        raise
    except Exception as error:  # noqa: BLE001 -- an unpickler raises whatever a damaged file makes of it
        if isinstance(error, pickle.UnpicklingError) and "eights only" in str(error):
            reason = "holds objects of a program, which could do anything: save tensors alone, as state_dict gives them"
        else:  # what torch says of it goes on for twenty lines
            reason = "is no whole checkpoint of torch: copy it again, or save its splats as PLY where it was trained"
        raise InputError(f"{path.name} {reason}") from None
    try:
        return _model_of(said, path.stat().st_size, sh_degree)
    except InputError as error:
        raise InputError(f"{path.name}: {error}") from None


def _plain_numbers(torch: Any) -> Any:
    """Let numbers of NumPy through, which the schedules of splatfacto leave among learning rates."""
    if tuple(map(int, torch.__version__.split(".")[:2])) < (2, 6):
        return nullcontext()  # it has no names for what older versions of NumPy wrote
    make = np.float64(0.0).__reduce__()[0]
    kinds = [type(np.dtype(kind)) for kind in (np.float64, np.float32)]
    return torch.serialization.safe_globals([make, (make, "numpy.core.multiarray.scalar"), np.dtype, *kinds])


def _model_of(said: object, size: int, sh_degree: int | None) -> SplatModel:
    if not isinstance(said, Mapping):
        raise InputError(f"it holds a {type(said).__name__}, wanted a checkpoint of gsplat or splatfacto")
    if isinstance(said.get("splats"), Mapping):
        return _bounded(said["splats"], size, sh_degree)
    pipeline = said.get("pipeline")
    parts = pipeline.items() if isinstance(pipeline, Mapping) else ()
    found = {str(name).rpartition(_SPLATFACTO)[2]: value for name, value in parts if _SPLATFACTO in str(name)}
    if not found:
        names = ", ".join(map(str, list(said)[:5]))
        raise InputError(f"it holds {names or 'nothing'}: neither splats of gsplat nor a pipeline of splatfacto")
    model = _bounded({_NAMES.get(name, name): value for name, value in found.items()}, size, sh_degree)
    if model.sh_degree or "features_rest" not in found:
        return model
    # Without SH splatfacto trains logits of colours.
    colours = 1.0 / (1.0 + np.exp(-model.sh0.astype(np.float64)))
    return replace(model, sh0=((colours - 0.5) / _SH_C0).astype(np.float32))


def _bounded(splats: Mapping[str, Any], size: int, sh_degree: int | None) -> SplatModel:
    """A model of tensors, none of which has more numbers than the file has bytes: one may be said to be many."""
    for name in _NAMES.values():
        numbers = getattr(splats.get(name), "numel", None)
        if name in splats and (numbers is None or numbers() > size):
            raise InputError(f"{name} is no tensor that the file can hold")
    shN = splats.get("shN")
    if shN is not None and shN.ndim == 3:  # others are refused below
        degree = math.isqrt(shN.shape[1] + 1) - 1
        if degree > MAX_SH_DEGREE and (degree + 1) ** 2 - 1 == shN.shape[1]:
            if sh_degree is None:
                raise InputError(f"shN is of {too_many_bands(degree)}")
            splats = {**splats, "shN": shN[:, : (MAX_SH_DEGREE + 1) ** 2 - 1]}
    return from_gsplat(splats)


FORMAT = Format(
    name="checkpoint",
    open=_open,
    open_bands=_open,
    exact=frozenset({"means", "quats", "scales", "sh0", "shN"}),
)

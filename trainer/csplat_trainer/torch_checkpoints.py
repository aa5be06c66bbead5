# SPDX-License-Identifier: Apache-2.0
# torch may be absent:
# pyright: reportMissingImports=false
"""Checkpoints of gsplat's simple_trainer, nerfstudio's splatfacto, INRIA's trainer and others, read as scenes.

All are pickles of torch. No code in them is run: `weights_only` admits only tensors, containers and plain numbers. Some
facts, such as antialiased training, are not in the checkpoint, but in other files of the trainer.

Tensors with a row for each splat that are no splat attributes are listed as left out. Networks, cameras, statistics of
gradients and the state of optimisers are not: they serve the training, and an exported PLY has none of them, either.
"""

from __future__ import annotations

import io
import math
import pickle
import pickletools
import re
import warnings
import zipfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, nullcontext
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from csplat.archives import DAMAGED, member_refusal, unpacked_limit
from csplat.detect import detect_content, read_head
from csplat.errors import InputError, counted, missing_package
from csplat.file_source import open_binary
from csplat.formats import Format
from csplat.interop import from_gsplat
from csplat.lint import Finding, list_names, too_many_bands
from csplat.model import MAX_SH_DEGREE, SplatModel
from csplat.ply.columns import (
    AttributeArrays,
    RowStatistics,
    choose_thickness,
    is_rounded,
    list_findings,
    rounded_doubles,
    survey_arrays,
)
from csplat.ply.comments import CommentMetadata, split_origin
from csplat.scene import Scene, join_blocks
from csplat.scene_metadata import SceneMetadata
from csplat.spherical_harmonics import SH_C0

_MAGICS = (b"PK\x03\x04", b"\x80")  # a zip, or a pickle as written by torch before 1.6
_NAMES_SHOWN = 5  # names in a message
_NAME_LENGTH_MAX = 80  # maximum number of characters of a name in a message
_PICKLE_SIZE_MAX = 1 << 22  # bytes; checkpoints have up to 100 kB, and a byte may become an object of 72
# Pickles at the beginning of a file written by torch before 1.6; the tensors follow (torch/serialization.py).
_LEGACY_PICKLES = 5
#: Values returned by INRIA's `GaussianModel.capture` after the active SH degree (scene/gaussian_model.py).
_INRIA = ("means", "sh0", "shN", "scales", "quats", "opacities")
_HOLDERS = ("pipeline", "state_dict", "model")  # keys that may hold splatfacto's tensors; else the top level does
#: gsplat writes a file per GPU with a part of the splats (simple_trainer.py).
_RANK = re.compile(r"(?P<run>.*_rank)(?P<rank>\d{1,4})(?P<ending>\.pt)")
#: Tensors of INRIA's trainer, and of those derived from it, that decide which splats are cloned and pruned.
_STATISTICS = re.compile(r"max_radii2D|denom|(xyz|means2D)_gradient_accum.*")
_FILTER = "filter_3D"  # name of Mip-Splatting's tensor of filter sizes
#: gsplat's names of tensors, by the names in gsplat and splatfacto, in Gaussian Splatting Lightning, and of attributes
#: in INRIA's `GaussianModel`, which trainers derived from it save as a state.
_NAMES = {
    "means": "means",
    "quats": "quats",
    "scales": "scales",
    "opacities": "opacities",
    "features_dc": "sh0",
    "features_rest": "shN",
    "rotations": "quats",
    "shs_dc": "sh0",
    "shs_rest": "shN",
    "_xyz": "means",
    "_rotation": "quats",
    "_scaling": "scales",
    "_opacity": "opacities",
    "_features_dc": "sh0",
    "_features_rest": "shN",
}


@contextmanager
def _open_checkpoint(path: Path, sh_degree: int | None = None) -> Iterator[Scene]:
    """Read a checkpoint, with the parts of other GPUs next to it, as a scene in memory.

    Args:
        path: the file, or the file of one of several GPUs.
        sh_degree: `None` refuses bands beyond `MAX_SH_DEGREE`; any number drops them.

    Raises:
        InputError: a file is no checkpoint of splats, is damaged or missing; or parts have different SH degrees.
    """
    paths, findings = _find_rank_files(path)
    parts = [_read_part(file, sh_degree) for file in paths]
    models = [part.model for part in parts]
    degrees = sorted({model.sh_degree for model in models})
    if len(degrees) > 1:
        raise InputError(f"{path.name}: the files of its GPUs have SH degrees {degrees[0]} and {degrees[1]}")
    model, counts = join_blocks(models[0], models), RowStatistics()
    for part in parts:
        survey_arrays(part.arrays, part.scale_count, counts)
    findings += [finding for part in parts for finding in part.findings] + list_findings(counts, len(model))
    if any(part.arrays.means.dtype == np.float64 for part in parts):
        positions = np.concatenate([part.arrays.means.astype(np.float64) for part in parts])
        means, origin, doubles = split_origin(positions, CommentMetadata())
        model = replace(model, means=means, origin=origin, means_double=doubles)
        text = f"positions are in doubles: {len(means)} means are float32 relative to {origin}"
        findings.append(Finding("double-means", len(means), text, "note"))
    yield Scene.of(model).changed(findings=findings)


class _CheckpointPart(NamedTuple):
    """The splats of one file.

    Attributes:
        model: the splats, with means in float32.
        arrays: the arrays of the file: opacities are logits; means may be float64.
        scale_count: scales per splat; 2 for discs.
        findings: lint findings.
    """

    model: SplatModel
    arrays: AttributeArrays
    scale_count: int
    findings: list[Finding]


def _find_rank_files(path: Path) -> tuple[list[Path], list[Finding]]:
    """Return the files of all GPUs of a run of gsplat, given the file of a GPU.

    Raises:
        InputError: a file is missing.
    """
    named = _RANK.fullmatch(path.name)
    if named is None:
        return [path], []
    by_rank = {}
    for file in path.parent.iterdir():
        match = _RANK.fullmatch(file.name)
        if match and (match["run"], match["ending"]) == (named["run"], named["ending"]):
            by_rank[int(match["rank"])] = file
    absent = sorted(set(range(max(by_rank))) - set(by_rank))
    if absent:
        missing = ", ".join(f"{named['run']}{rank}{named['ending']}" for rank in absent[:_NAMES_SHOWN])
        raise InputError(
            f"{path.name} has the splats of one of several GPUs, expected the others' files next to it: no {missing}"
        )
    paths = [by_rank[rank] for rank in sorted(by_rank)]
    if len(paths) == 1:
        text = "the splats of GPU 0; complete if no other GPU was used"
        return paths, [Finding("ranks", 1, text, "note", usual=True)]
    text = f"the splats of {len(paths)} GPUs, from {', '.join(file.name for file in paths)}"
    return paths, [Finding("ranks", len(paths), text, "note")]


def _read_part(path: Path, sh_degree: int | None) -> _CheckpointPart:
    """Read the splats of one file; `sh_degree` as for `_open_checkpoint`.

    Raises:
        InputError: the file is no checkpoint of splats, could run code, or is damaged; or torch is not installed.
        OSError: the file cannot be read.
    """
    head = read_head(path)
    kind = detect_content(path, head)
    if not head.startswith(_MAGICS):
        reason = "it begins with" if kind is None else f"it is {kind.title}, and begins with"
        raise InputError(f"{path.name} is not a checkpoint of torch: {reason} {head[:8]!r}")
    _check_pickles(path)
    try:
        import torch
    except ModuleNotFoundError as error:
        raise InputError(f"{path.name} is a checkpoint of torch: {missing_package(error, extra='train')}") from None
    try:
        with _admit_plain_numbers(torch), warnings.catch_warnings(action="ignore"):
            # Memory-mapped, since two thirds of a checkpoint of splatfacto are Adam's moments.
            content = torch.load(path, map_location="cpu", weights_only=True, mmap=zipfile.is_zipfile(path))
    except OSError:
        raise
    except Exception as error:  # noqa: BLE001 -- an unpickler raises whatever a damaged file makes of it
        if isinstance(error, pickle.UnpicklingError) and "eights only" in str(error):
            reason = "contains objects that could run code: save only tensors, as from state_dict"
        else:  # torch's message has twenty lines
            reason = "is a truncated or damaged checkpoint of torch: copy it again, or export its splats as PLY"
        raise InputError(f"{path.name} {reason}") from None
    try:
        return _read_content(content, path.stat().st_size, sh_degree)
    except InputError as error:
        raise InputError(f"{path.name}: {error}") from None


def _check_pickles(path: Path) -> None:
    """Refuse compressed parts that expand too far, and large pickles: each of their bytes may become an object.

    Raises:
        InputError: a part of the zip, or a pickle, exceeds its limit.
        OSError: the file cannot be read.
    """
    refusal = f"{path.name} has a pickle of more than {_PICKLE_SIZE_MAX:,} bytes, expected tensors next to a small one"
    if zipfile.is_zipfile(path):
        try:
            with zipfile.ZipFile(path) as archive:
                members = archive.infolist()
        except DAMAGED:
            return  # torch reports the damage
        for info in members:
            if info.filename.endswith(".pkl") and info.file_size > _PICKLE_SIZE_MAX:
                raise InputError(refusal)
            if reason := member_refusal(info, unpacked_limit(info.compress_size)):
                raise InputError(f"{path.name}: its part {info.filename[:_NAME_LENGTH_MAX]} {reason}")
        return
    with open_binary(path) as stream:
        begin = io.BytesIO(stream.read(_PICKLE_SIZE_MAX))
    try:
        for _ in range(_LEGACY_PICKLES):
            for _ in pickletools.genops(begin):
                pass
    except (ValueError, IndexError, OverflowError, MemoryError):  # damaged, which torch reports, or cut off here
        if begin.getbuffer().nbytes == _PICKLE_SIZE_MAX == begin.tell():
            raise InputError(refusal) from None


def _admit_plain_numbers(torch: Any) -> Any:
    """Admit NumPy scalars, which the schedules of splatfacto store among learning rates."""
    if tuple(map(int, torch.__version__.split(".")[:2])) < (2, 6):
        return nullcontext()  # cannot name the types that older versions of NumPy wrote
    make = np.float64(0.0).__reduce__()[0]
    kinds = [type(np.dtype(kind)) for kind in (np.float64, np.float32)]
    return torch.serialization.safe_globals([make, (make, "numpy.core.multiarray.scalar"), np.dtype, *kinds])


def _read_content(content: object, size: int, sh_degree: int | None) -> _CheckpointPart:
    """Find the splats in an unpickled checkpoint.

    Args:
        content: what torch loaded.
        size: size of the file in bytes, an upper limit of the values of a tensor.
        sh_degree: as for `_open_checkpoint`.

    Raises:
        InputError: there are no splats, several models, or tensors that are no splats.
    """
    inria = _inria_tensors(content)
    if inria is not None:
        return _checked_part(inria, size, sh_degree)
    if not isinstance(content, Mapping):
        raise InputError(f"it holds a {type(content).__name__}, expected a checkpoint of gsplat, splatfacto or INRIA")
    if isinstance(content.get("splats"), Mapping):
        return _checked_part({**content, **content["splats"]}, size, sh_degree)
    holder = next((content[name] for name in _HOLDERS if isinstance(content.get(name), Mapping)), content)
    named = {str(name): value for name, value in holder.items()}
    models = _find_models(named)
    if len(models) > 1:
        listed = list(models.items())[:_NAMES_SHOWN]
        shown = ", ".join(f"{prefix}* ({_describe_count(means)})" for prefix, means in listed)
        raise InputError(f"it holds {len(models)} models of splats, expected one: {shown}; save only one of them")
    if not models:
        names = ", ".join(map(str, list(content)[:_NAMES_SHOWN]))
        raise InputError(f"it holds {names or 'nothing'}: neither splats of gsplat nor a pipeline of splatfacto")
    (prefix,) = models
    tensors = {name.removeprefix(prefix): value for name, value in named.items() if name.startswith(prefix)}
    tensors = {_NAMES.get(name, name): value for name, value in tensors.items()}
    # Other modules next to the splats have tensors of images and networks.
    known = {**{str(name): value for name, value in content.items()}, **named}
    outer = {name: value for name, value in known.items() if prefix.startswith(name[: name.rfind(".") + 1])}
    others = {name: value for name, value in outer.items() if not name.startswith(prefix)}
    part = _checked_part({**others, **tensors}, size, sh_degree)
    if part.model.sh_degree or f"{prefix}features_rest" not in named:
        return part
    # Without SH splatfacto trains logits of colours.
    colours = 1.0 / (1.0 + np.exp(-part.model.sh0.astype(np.float64)))
    return part._replace(model=replace(part.model, sh0=((colours - 0.5) / SH_C0).astype(np.float32)))


def _inria_tensors(content: object) -> dict[str, Any] | None:
    """Return the splats of a checkpoint of INRIA's trainer, a pair of `capture`'s result and the iteration.

    Returns:
        Tensors by gsplat's names, others by their index; `None` for contents of another form.
    """
    captured = content[0] if isinstance(content, tuple) and len(content) == 2 else None
    if not isinstance(captured, tuple) or len(captured) <= len(_INRIA) or not hasattr(captured[1], "numel"):
        return None
    tensors = dict(zip(_INRIA, captured[1:], strict=False))
    rest = {at: value for at, value in enumerate(captured) if at > len(_INRIA)}
    optimiser = next((at for at, value in rest.items() if isinstance(value, Mapping)), 0)
    radii = [at for at, value in rest.items() if at < optimiser and getattr(value, "ndim", 0) == 1]
    statistics = range(radii[-1], optimiser) if radii else ()  # from max_radii2D on
    return tensors | {f"item {at}": value for at, value in rest.items() if at not in statistics}


def _find_models(named: Mapping[str, Any]) -> dict[str, Any]:
    """Return the means of each model of splats, by the prefix of the names of its tensors.

    It is `_model.gauss_params.` in splatfacto, `_model.` before nerfstudio 1.1, `gaussian_model.gaussians.` in Gaussian
    Splatting Lightning, and empty in a bare state_dict.
    """
    models: dict[str, dict[str, Any]] = {}
    for name, value in named.items():
        prefix, dot, last = name.rpartition(".")
        if last in _NAMES:
            models.setdefault(prefix + dot, {})[_NAMES[last]] = value
    return {
        prefix: tensors["means"]
        for prefix, tensors in models.items()
        if "means" in tensors and {"scales", "quats"} & set(tensors)
    }


def _describe_count(means: Any) -> str:
    """Return the number of splats in words, for a message; means may be anything, since they are not yet checked."""
    shape = getattr(means, "shape", None)
    return counted(shape[0], "splat") if shape else "no tensor"


def _checked_part(splats: Mapping[str, Any], size: int, sh_degree: int | None) -> _CheckpointPart:
    """Check tensors named as in gsplat, and return their splats; one or two scales per splat are completed to three.

    Args:
        splats: the tensors; those of other names with a row for each splat are left out with a finding.
        size: size of the file in bytes; an expanded tensor may claim more values.
        sh_degree: as for `_open_checkpoint`.

    Raises:
        InputError: a tensor is absent, is larger than the file, or has another shape or too many bands.
    """
    for name in _NAMES.values():
        numbers = getattr(splats.get(name), "numel", None)
        if name in splats and (numbers is None or numbers() > size):
            raise InputError(f"{name} is not a tensor, or larger than the file")
    shN = splats.get("shN")
    if shN is not None and shN.ndim == 3:  # other shapes are refused below
        degree = math.isqrt(shN.shape[1] + 1) - 1
        if degree > MAX_SH_DEGREE and (degree + 1) ** 2 - 1 == shN.shape[1]:
            if sh_degree is None:
                raise InputError(f"shN has {too_many_bands(degree)}")
            splats = {**splats, "shN": shN[:, : (MAX_SH_DEGREE + 1) ** 2 - 1]}
    findings = []
    splats = {name: _to_array(value) if name in _NAMES.values() else value for name, value in splats.items()}
    doubles = [name for name in sorted({*_NAMES.values()} - {"means"}) if is_rounded(splats.get(name, np.zeros(0)))]
    findings += [rounded_doubles(doubles)] if doubles else []
    scales = splats.get("scales")
    if scales is not None and scales.ndim in (1, 2) and scales.size == len(scales):
        splats["scales"] = scales = np.repeat(scales.reshape(-1, 1), 3, axis=1)
        text = "splats have one scale: all axes of a splat have this size"
        findings.append(Finding("one-scale", 1, text, "note"))
    is_flat = scales is not None and scales.ndim == 2 and scales.shape[1] == 2
    if scales is not None and is_flat:
        third = np.full((len(scales), 1), choose_thickness(scales) if len(scales) else 0.0, np.float32)
        splats["scales"] = np.concatenate([scales, third], axis=1)
        findings.append(Finding("flat-scales", 1, "splats have two scales: they are discs (2DGS)", "note"))
    if _FILTER in splats:
        text = f"{_FILTER} of Mip-Splatting is ignored, not fused: export the scene as PLY, which fuses it"
        findings.append(Finding("filter-3d", 1, text, "repair", lost=(_FILTER,)))
    model = replace(from_gsplat(splats), metadata=SceneMetadata(flat=is_flat))
    arrays = AttributeArrays(
        splats["means"], splats["quats"], splats["scales"], splats["opacities"].reshape(-1), model.sh0, model.shN
    )
    return _CheckpointPart(model, arrays, 2 if is_flat else 3, findings + _other_tensors(splats, len(model)))


def _other_tensors(tensors: Mapping[str, Any], count: int) -> list[Finding]:
    """Return the finding about tensors with a row for each of `count` splats that are not read, if there are any."""
    shapes = {str(name): tuple(getattr(value, "shape", ())) for name, value in tensors.items()}
    names = [
        f"{name} ({' × '.join(map(str, shape))})"
        for name, shape in shapes.items()
        if count and shape[:1] == (count,) and name not in {*_NAMES.values(), _FILTER}
        if not _STATISTICS.fullmatch(name.rpartition(".")[2])
    ]
    what = f"tensors {list_names(names)}"
    return [Finding("extra-columns", len(names), f"{what}: dropped", "note", lost=(what,))] if names else []


def _to_array(value: Any) -> Any:
    """Return a tensor as an array: float64 if it is, else float32."""
    if hasattr(value, "detach"):
        value = value.detach().cpu()
        value = (value.double() if str(value.dtype) == "torch.float64" else value.float()).numpy()
    return np.asarray(value, np.float64 if value.dtype == np.float64 else np.float32)


FORMAT = Format(
    name="checkpoint",
    open=_open_checkpoint,
    open_bands=_open_checkpoint,
    degree=MAX_SH_DEGREE,
    exact=frozenset({"means", "quats", "scales", "sh0", "shN"}),
)

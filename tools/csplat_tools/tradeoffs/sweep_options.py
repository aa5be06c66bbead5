"""Options of a sweep, and its scene and views."""

from __future__ import annotations

import math
import os
import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from csplat.encoder import PRESETS, PresetName
from csplat.errors import InputError
from csplat.file_source import File
from csplat.lint import Finding
from csplat.model import SplatModel
from csplat_render import Mode
from csplat_render.conventions import MODES
from csplat_render.lpips import load_lpips
from csplat_render.metrics import Distance
from csplat_tools.console import parse_size_bytes
from csplat_tools.scene_files import LoadedModel, load_model, read_source
from csplat_tools.views import Colour, DataOptions, ViewSet, find_view_set

#: Groups of points, in the order in which they are measured: quick ones first.
FAMILIES = ("presets", "precision", "strategies", "targets", "simplify", "finetune")
#: Groups that are measured by default: all but fine-tuning, which takes minutes per point.
USUAL = FAMILIES[:-1]

_VALUES = {"precision": "attribute_psnr", "strategies": "opacities", "targets": "psnr", "simplify": "keep"}
_NUMBER = re.compile(r"[0-9]*\.?[0-9]+(?:[eE][-+]?[0-9]+)?")


@dataclass(frozen=True)
class SweepOptions:
    """The points to measure, and their options.

    Attributes:
        what: groups to measure, from `FAMILIES`.
        preset: preset of all points outside the group `presets`.
        attribute_psnr: values of `EncodeOptions.attribute_psnr`, dB.
        psnr: target PSNRs, dB.
        sizes: target sizes, bytes.
        keep: fractions of the splats that simplification keeps.
        opacities: thresholds; splats of at most this alpha are pruned.
        kmeans: entries of a codebook for each attribute.
        modes: modes of the renderer that are timed.
        iterations: largest number of steps of fine-tuning.
        threads: number of threads; `None` for all.

    Raises:
        InputError: a value is out of its range.
    """

    what: tuple[str, ...] = USUAL
    preset: PresetName = "balanced"
    attribute_psnr: tuple[float, ...] = (32.0, 36.0, 40.0, 44.0, 48.0, 56.0)
    psnr: tuple[float, ...] = (36.0, 40.0, 44.0)
    sizes: tuple[int, ...] = ()
    keep: tuple[float, ...] = (0.7, 0.5, 0.3)
    opacities: tuple[float, ...] = (0.005, 0.02, 0.1)
    kmeans: tuple[float, ...] = (256, 4096)
    modes: tuple[Mode, ...] = ("standard", "fast")
    iterations: int = 1_000
    threads: int | None = None

    def __post_init__(self) -> None:
        for one in self.what:
            if one not in FAMILIES:
                raise InputError(f"{one!r} cannot be swept, expected some of {', '.join(FAMILIES)}")
        if not self.what:
            raise InputError(f"no group to sweep, expected some of {', '.join(FAMILIES)}")
        if self.preset not in PRESETS:
            raise InputError(f"the preset is {self.preset!r}, expected one of {', '.join(PRESETS)}")
        _check("the PSNR of an attribute", self.attribute_psnr, 10.0, 120.0, "dB")
        _check("a target PSNR", self.psnr, 1.0, 99.0, "dB")
        _check("a target size", self.sizes, 1, math.inf, "bytes")
        _check("an opacity", self.opacities, 0.0, 1.0, "")
        _check("the number of entries", self.kmeans, 1, 65536, "")
        for share in self.keep:
            if not 0.0 < share <= 1.0:
                raise InputError(f"a fraction of the splats is {share:g}, expected above 0 and at most 1")
        if not self.modes or not {*self.modes} <= {*MODES}:
            raise InputError(f"the modes are {', '.join(map(repr, self.modes))}, expected some of {', '.join(MODES)}")


def parse_sweep(text: str, **how: Any) -> SweepOptions:
    """Parse the points of a sweep from `presets,precision=36:44,targets=40:2MB`.

    Args:
        text: groups, and values of some; `usual` means all of `USUAL`. A group without `=` has default values.
        how: other fields of `SweepOptions`.

    Raises:
        InputError: a group is unknown, or a value is invalid.
    """
    parts = [word.strip().split("=", 1) for word in text.split(",") if word.strip()]
    words = {name: values for name, *values in parts}
    if len([name for name, *values in parts if values]) > len([name for name, values in words.items() if values]):
        raise InputError("a group has values twice: separate them by colons")
    what = [one for name in words for one in (USUAL if name == "usual" else (name,))]
    values: dict[str, Any] = {}
    for name, listed in words.items():
        if not listed:
            continue
        found = tuple(dict.fromkeys(one.strip() for one in listed[0].split(":") if one.strip()))
        if name not in _VALUES:
            raise InputError(f"{name} takes no values; only {', '.join(_VALUES)} do")
        if name == "targets":
            values["sizes"] = tuple(parse_size_bytes(one) for one in found if not _NUMBER.fullmatch(one))
            found = tuple(one for one in found if _NUMBER.fullmatch(one))
        numbers = tuple(_number(one) for one in found)
        if name == "strategies":
            values["kmeans"] = tuple(one for one in numbers if one >= 1.0)
            numbers = tuple(one for one in numbers if one < 1.0)
        values[_VALUES[name]] = numbers
    return SweepOptions(what=tuple(dict.fromkeys(what)), **values, **how)


def _number(word: str) -> float:
    if not _NUMBER.fullmatch(word):
        raise InputError(f"{word!r} is not a number, expected numbers separated by colons")
    return float(word)


def _check(what: str, values: tuple[float, ...], low: float, high: float, unit: str) -> None:
    for value in values:
        if not low <= value <= high:
            most = f"to {high:g}" if math.isfinite(high) else "or more"
            raise InputError(f"{what} is {value:g}, expected {low:g} {most} {unit}".rstrip())


@dataclass(frozen=True, eq=False)
class SweepSetting:
    """A scene and its views.

    Attributes:
        path: path of the PLY as given by the caller; `scene.ply` for a model in memory.
        name: name of the file.
        source: its splats.
        source_bytes: its size.
        findings: lint findings in it.
        views: the views; all files are scored on the same test views.
        cameras, data, background: arguments of `find_view_set` that gave the views.
        distance: computes LPIPS; `None`: LPIPS is not computed.
    """

    path: str
    name: str
    source: SplatModel
    source_bytes: int
    findings: Sequence[Finding]
    views: ViewSet
    cameras: str | None = None
    data: DataOptions | None = None
    background: Colour | None = None
    distance: Distance | None = None


def read_setting(
    scene: SplatModel | LoadedModel | File,
    *,
    cameras: str | None = None,
    data: DataOptions | None = None,
    background: Colour | None = None,
    lpips: str | None = None,
) -> SweepSetting:
    """Read the scene, and find its views.

    Args:
        scene: a model, or a file; the path `-` is standard input.
        cameras, data, background: as for `find_view_set`.
        lpips: a file of LPIPS weights, or `auto`; `None`: LPIPS is not computed.

    Raises:
        CsplatError: a file is not valid, the scene has no splats, or there are no test views.
        OSError: a file cannot be read.
    """
    distance = None if lpips is None else load_lpips(None if lpips == "auto" else lpips)
    source = load_model(scene) if isinstance(scene, (SplatModel, LoadedModel)) else read_source(scene)
    path = os.fspath(scene) if isinstance(scene, (str, os.PathLike)) else "scene.ply"
    if not len(source.model):
        raise InputError("the scene has no splats")
    views = find_view_set(source.model, cameras=cameras, data=data, background=background)
    if not views.test:
        raise InputError(f"{views.name} has no test images")
    return SweepSetting(
        path, source.name, source.model, source.size_bytes, source.findings, views, cameras, data, background, distance
    )

# SPDX-License-Identifier: Apache-2.0
"""Define the options of the encoder and its presets."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields, replace
from numbers import Integral, Real
from typing import Any, Literal, get_args

from csplat import _spec
from csplat.errors import InputError

PresetName = Literal["fast", "balanced", "small"]
MeansCoding = Literal["auto", "morton", "axis"]
ShCoding = Literal["auto", "codebook", "scalar", "none"]
Deflate = Literal["auto", "libdeflate", "zlib"]

#: Default of `EncodeOptions.bucket_splats`.
BUCKET_SPLATS = 1 << 19


@dataclass(frozen=True)
class EncodeOptions:
    """Options of the encoder. `None` leaves the choice to the preset.

    Attributes:
        preset: "fast", "balanced" or "small".
        attribute_psnr: PSNR of renders, dB, if a single attribute were quantised; the file's PSNR is 5 to 12 dB lower.
            Sets all steps, instead of the preset.
        position_bits: bits per axis of a tile's box, 2 to 16; instead of the step chosen by quality.
        position_step: lattice step of the means, scene units, > 0; overrides `position_bits`. Distant splats may get a
            coarser step; see the declared errors.
        position_error: maximum displacement of a mean, scene units, > 0; overrides `position_step`. Tiles are split
            until none exceeds it; an `InputError` if float32 or the lattices of the format do not allow it.
        means_coding: "auto", "morton" or "axis".
        scale_step: step of the log scales, > 0.
        opacity_levels: M, 1 to 65535; 255 keeps the alpha of a model read from SPZ or SOG 2.
        quat_levels: M, 3 to 32767; 511 keeps the rotations of SPZ 3 and 4, 255 those of SOG.
        sh0_step: step of the degree-0 colour, > 0.
        sh_step: step of the higher SH bands, > 0.
        chroma_shift: chroma is coarser than luma by 2**chroma_shift, 0 to 16.
        sh_degree: SH degree to keep, 0 to 4; `None` keeps all bands. Higher bands are projected onto the others if the
            importance says in which directions splats are seen (`csplat encode` measures that), and cut off otherwise.
        sh_coding: "auto", "codebook", "scalar" or "none".
        codebook_size: number of entries of the SH codebook.
        escape_fraction: fraction of the splats to escape from the SH codebook, 0 to 1; the splats with the largest
            weighted errors escape.
        shape_codebook_size: maximum number of entries of the codebook of shapes (rotation, and scales up to a common
            factor), which is used only if it makes the file smaller. Default: 0, no codebook.
        shape_escape_fraction: fraction of the splats to escape from the shape codebook; the splats with the largest
            weighted errors escape. Default: chosen by rate and distortion if the importance has a metric of shapes,
            otherwise 0.05.
        adaptive: how much coarser the SH of unimportant splats is, from 0 (not coarser) to 1 (squared error inversely
            proportional to importance). Default: 0 without an importance.
        max_classes: maximum number of quantisation classes, 1 to 5: splats whose errors are equally visible share
            steps. Requires an importance with Gauss-Newton blocks. Default: one per 2,500 splats; 1 with "fast".
        tile_splats: maximum number of splats per tile, 1 to 65536. Viewers show each tile as it arrives, and decoders
            distribute tiles over cores; 16384 takes up to 1.2 % more bytes than 65536, 4096 takes 3 to 6 % more.
            Default: an eighth of the splats, at least 16384; 65536 for quantisation classes and for targets.
        bucket_splats: maximum number of splats of a bucket. Larger scenes are planned on a sample of that size, and
            encoded bucket by bucket. A smaller number takes less memory and leads to worse steps and codebooks.
        deflate_level: level of DEFLATE, 1 to 12 for libdeflate, 1 to 9 for zlib.
        deflate: "auto", "libdeflate" or "zlib".
        keep_extra: write the model's extra columns, and prune no splats for targets. Otherwise a note of the report
            names the columns.

    Examples:
        >>> import csplat
        >>> csplat.EncodeOptions(preset="small", sh_degree=2).preset
        'small'
        >>> csplat.EncodeOptions(preset="tiny")
        Traceback (most recent call last):
        csplat.errors.InputError: preset is 'tiny', expected one of fast, balanced, small

    Raises:
        InputError: a value is not in the list above, or out of range.
    """

    preset: PresetName = "balanced"
    attribute_psnr: float | None = None
    position_bits: int | None = None
    position_step: float | None = None
    position_error: float | None = None
    means_coding: MeansCoding = "auto"
    scale_step: float | None = None
    opacity_levels: int | None = None
    quat_levels: int | None = None
    sh0_step: float | None = None
    sh_step: float | None = None
    chroma_shift: int | None = None
    sh_degree: int | None = None
    sh_coding: ShCoding = "auto"
    codebook_size: int | None = None
    escape_fraction: float | None = None
    shape_codebook_size: int | None = None
    shape_escape_fraction: float | None = None
    adaptive: float | None = None
    max_classes: int | None = None
    tile_splats: int | None = None
    bucket_splats: int = BUCKET_SPLATS
    deflate_level: int | None = None
    deflate: Deflate = "auto"
    keep_extra: bool = False

    def __post_init__(self) -> None:
        for name, words in _WORDS.items():
            if getattr(self, name) not in words:
                raise InputError(f"{name} is {getattr(self, name)!r}, expected one of {', '.join(words)}")
        for name, (kind, low, high) in _RANGES.items():
            value = getattr(self, name)
            if value is None and name not in _NEVER_NONE:
                continue
            number = _number(value, kind)
            if number is None or not low <= number <= high:
                what = "an integer, " if kind is int else ""
                raise InputError(f"{name} is {value!r}, expected {what}{low:g} to {high:g}")
            object.__setattr__(self, name, number)  # json cannot write NumPy's numbers

    def kept_degree(self, source_degree: int) -> int:
        """Return the SH degree of the file of a scene."""
        return source_degree if self.sh_degree is None else min(self.sh_degree, source_degree)

    def chosen(self) -> dict[str, Any]:
        """Return the options that the caller set."""
        return {
            field.name: getattr(self, field.name)
            for field in fields(self)
            if field.name == "preset" or getattr(self, field.name) != field.default
        }


@dataclass(frozen=True)
class Preset:
    """Settings of a preset.

    Attributes:
        quality: `attribute_psnr` for scenes with and without SH, dB.
        sh_quality: the same for the bands from 1 on, which take more bits.
        sh_coding, adaptive, deflate_level, escape_fraction: as in `EncodeOptions`.
        codebook_share: number of entries of the SH codebook per splat.
        codebook_most: maximum number of its entries.
        codebook_finer: its step is the scalar step divided by 2**codebook_finer.
    """

    quality: tuple[float, float]
    sh_quality: float
    sh_coding: ShCoding
    adaptive: float
    deflate_level: int
    codebook_share: float = 1 / 16
    codebook_most: int = 1 << 13
    codebook_finer: int = 1
    escape_fraction: float = 0.02


PRESETS: dict[PresetName, Preset] = {
    # 255 entries and the escape fit one byte and are searched fast; more escapes make up for the small codebook.
    "fast": Preset((55.0, 63.5), 44.0, "auto", 0.5, 1, codebook_most=255, escape_fraction=0.2),
    "balanced": Preset((53.5, 53.2), 43.0, "auto", 0.5, 12),
    "small": Preset((48.6, 47.2), 39.0, "auto", 0.5, 12, 1 / 32),
}

#: The presets for scenes read from SPZ or SOG (`SceneMetadata.quantised`). Their SH vectors are few and noisy: escapes
#: cost 1.5 to 2 % of the bytes, for 0 to 0.3 dB, and entries are found in a fraction of the time. So "fast" has more
#: of them, and the steps of "balanced", than which files of quantised scenes are to be no larger.
QUANTISED_PRESETS: dict[PresetName, Preset] = {
    "fast": Preset((52.5, 51.8), 43.0, "auto", 0.5, 1, codebook_most=1 << 10, escape_fraction=0.0),
    "balanced": replace(PRESETS["balanced"], escape_fraction=0.0),
    "small": replace(PRESETS["small"], escape_fraction=0.0),
}

_WORDS = {
    "preset": get_args(PresetName),
    "means_coding": get_args(MeansCoding),
    "sh_coding": get_args(ShCoding),
    "deflate": get_args(Deflate),
}
_TINY, _HUGE = 1e-250, 1e250  # a float32 / _TINY and _HUGE / a float32 are within float64
_RANGES: dict[str, tuple[type[int | float], float, float]] = {
    "attribute_psnr": (float, 10, 120),
    "position_bits": (int, 2, 16),
    "position_step": (float, _TINY, _HUGE),
    "position_error": (float, _TINY, _HUGE),
    "scale_step": (float, 1e-6, 1e3),
    "opacity_levels": (int, 1, _spec.OPACITY_LEVELS_MAX),
    "quat_levels": (int, _spec.QUAT_LEVELS_MIN, _spec.QUAT_LEVELS_MAX),
    "sh0_step": (float, 1e-6, 1e3),
    "sh_step": (float, 1e-6, 1e3),
    "chroma_shift": (int, 0, _spec.CHROMA_SHIFT_MAX),
    "sh_degree": (int, 0, _spec.SH_DEGREE_MAX),
    "codebook_size": (int, 1, _spec.CODEBOOK_ENTRIES_MAX),
    "escape_fraction": (float, 0, 1),
    "shape_codebook_size": (int, 0, _spec.CODEBOOK_ENTRIES_MAX),
    "shape_escape_fraction": (float, 0, 1),
    "adaptive": (float, 0, 1),
    "max_classes": (int, 1, 5),
    "tile_splats": (int, 1, _spec.TILE_SPLATS_MAX),
    "bucket_splats": (int, 100, math.inf),
    "deflate_level": (int, 1, 12),
}
_NEVER_NONE = ("bucket_splats",)


def _number(value: Any, kind: type[int | float]) -> int | float | None:
    """Return the value as a Python int or float, `None` if it is not of that kind."""
    if kind is int:
        return int(value) if isinstance(value, Integral) else None
    return float(value) if isinstance(value, Real) else None

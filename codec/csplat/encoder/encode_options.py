"""Options of the encoder, and the presets that supply their defaults."""

from __future__ import annotations

import math
import os
from dataclasses import dataclass, fields
from numbers import Integral, Real
from typing import Any, Literal, get_args

from csplat import _spec
from csplat.errors import InputError

PresetName = Literal["fast", "balanced", "small"]
MeansCoding = Literal["auto", "morton", "axis"]
ShCoding = Literal["auto", "codebook", "scalar", "none"]
Deflate = Literal["auto", "libdeflate", "zlib"]


@dataclass(frozen=True)
class EncodeOptions:
    """Options of the encoder. `None` leaves the choice to the preset.

    Attributes:
        preset: "fast", "balanced" or "small".
        attribute_psnr: PSNR in dB of a scene with one quantised attribute; the file's is 5 to 12 dB lower. All steps
            follow from it; overrides the preset's.
        position_bits: bits per axis of a tile's box, 2 to 16; overrides the step that follows from the quality.
        position_step: lattice step of the means in scene units, > 0; overrides `position_bits`.
        position_error: largest displacement of a mean, scene units, > 0; overrides both. The step follows from it, and
            tiles are cut until none needs a coarser one.
        means_coding: "auto", "morton" or "axis".
        scale_step: step of the log scales, > 0.
        opacity_levels: M, 1 to 65535.
        quat_levels: M, 3 to 32767.
        sh0_step: step of the degree-0 colour, > 0.
        sh_step: step of the higher SH bands, > 0.
        chroma_shift: chroma is coarser than luma by 2**chroma_shift, 0 to 16.
        sh_degree: SH degree to keep, 0 to 3; `None` keeps all bands.
        sh_coding: "auto", "codebook", "scalar" or "none".
        codebook_size: entries of the SH codebook.
        escape_fraction: fraction of the splats, with the largest weighted errors, that bypass the SH codebook, 0 to 1.
        shape_codebook_size: maximum number of entries of a codebook of shapes (rotation, and scales up to a common
            factor); 0, the default: no codebook. It is used only if the file becomes smaller.
        shape_escape_fraction: fraction of the splats, with the largest weighted errors, that bypass the shape codebook.
            Default: those whose error would grow by more than the saved bits are worth, if an importance holds a
            metric of shapes, otherwise 0.05.
        adaptive: how much coarser the SH of unimportant splats is, 0 (not at all) to 1 (their error grows as their
            importance falls). Default: 0 unless an importance is given.
        max_classes: maximum number of quantisation classes, 1 to 5: splats whose errors are equally visible share
            steps. Requires an importance with Gauss-Newton blocks. Default: one per 2,500 splats; 1 with "fast".
        tile_splats: maximum number of splats per tile, 1 to 65536. Decoders spread tiles over cores: 16384 decodes
            scenes of few tiles 1.2 to 3.6 times as fast on four cores, for up to 1.2 % more bytes; 4096 costs 3 to 6 %.
        deflate_level: level of DEFLATE, 1 to 12 for libdeflate, 1 to 9 for zlib.
        deflate: "auto", "libdeflate" or "zlib".
        keep_extra: write the model's extra columns.
        seed: seed of the k-means.
        threads: number of threads; `None`: all cores. The bytes do not depend on it.

    Examples:
        >>> import csplat
        >>> csplat.EncodeOptions(preset="small", sh_degree=2).preset
        'small'
        >>> csplat.EncodeOptions(preset="tiny")
        Traceback (most recent call last):
        csplat.errors.InputError: preset is 'tiny', expected one of fast, balanced, small

    Raises:
        InputError: a word is not one of those listed, or a number is out of range.
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
    tile_splats: int = _spec.TILE_SPLATS_MAX
    deflate_level: int | None = None
    deflate: Deflate = "auto"
    keep_extra: bool = False
    seed: int = 0
    threads: int | None = None

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
            object.__setattr__(self, name, number)  # JSON does not know NumPy's numbers

    @property
    def thread_count(self) -> int:
        """`threads`, or the number of cores."""
        return self.threads or os.cpu_count() or 1

    def chosen(self) -> dict[str, Any]:
        """Return the options that the caller set, without `threads`, which cannot change the bytes."""
        return {
            field.name: getattr(self, field.name)
            for field in fields(self)
            if field.name != "threads" and (field.name == "preset" or getattr(self, field.name) != field.default)
        }


@dataclass(frozen=True)
class Preset:
    """Settings of a preset.

    Attributes:
        quality: `attribute_psnr` for scenes with SH and for scenes without; steps follow from it and from the scene
            (coding_parameters.py).
        sh_quality: the same for the bands 1 to 3, whose bits are expensive.
        sh_coding: as in `EncodeOptions`.
        adaptive: as in `EncodeOptions`.
        deflate_level: as in `EncodeOptions`.
        codebook_share: entries of an SH codebook per splat.
        codebook_most: maximum number of its entries.
        codebook_finer: its lattice is finer than that of scalar coding by 2**codebook_finer.
        escape_fraction: as in `EncodeOptions`.
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
    # 255 entries and the escape fit a byte and are searched fast; escapes make up for the small number.
    "fast": Preset((55.0, 63.5), 44.0, "auto", 0.5, 1, codebook_most=255, escape_fraction=0.2),
    "balanced": Preset((53.5, 53.2), 43.0, "auto", 0.5, 12),
    "small": Preset((48.6, 47.2), 39.0, "auto", 0.5, 12, 1 / 32),
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
    "deflate_level": (int, 1, 12),
    "seed": (int, 0, math.inf),
    "threads": (int, 1, math.inf),
}
_NEVER_NONE = ("tile_splats", "seed")


def _number(value: Any, kind: type[int | float]) -> int | float | None:
    """Return a Python number of that kind, or None if the value is not one."""
    if kind is int:
        return int(value) if isinstance(value, Integral) else None
    return float(value) if isinstance(value, Real) else None

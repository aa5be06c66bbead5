"""What is swept, as a command line says it; nothing heavy is imported here."""

from __future__ import annotations

import math
from dataclasses import dataclass

from csplat.encoder import PRESETS
from csplat.errors import InputError

__all__ = ["FAMILIES", "USUAL", "Wanted", "parse_numbers", "parse_sizes", "parse_words"]

#: Groups of points, in the order in which they are measured: what is quick comes first.
FAMILIES = ("presets", "precision", "strategies", "targets", "simplify", "finetune")
#: Those that are measured unless others are asked for: fine-tuning takes minutes for each point.
USUAL = FAMILIES[:-1]


@dataclass(frozen=True)
class Wanted:
    """Which points are measured, and how.

    Attributes:
        what: some of `FAMILIES`.
        preset: of what is coded once splats, bands or colours have been left out, and of the targets.
        attribute_psnr: of `EncodeOptions`, dB.
        psnr: targets, dB.
        sizes: targets, bytes.
        keep: shares of the splats that simplification leaves.
        opacities: splats of at most so much alpha are left out.
        kmeans: entries of a codebook for each attribute.
        modes: of the renderer, which are timed.
        iterations: steps of fine-tuning.
        threads: how many; `None` for all.

    Raises:
        InputError: a value is out of its range.
    """

    what: tuple[str, ...] = USUAL
    preset: str = "balanced"
    attribute_psnr: tuple[float, ...] = (32.0, 36.0, 40.0, 44.0, 48.0, 56.0)
    psnr: tuple[float, ...] = (36.0, 40.0, 44.0)
    sizes: tuple[int, ...] = ()
    keep: tuple[float, ...] = (0.7, 0.5, 0.3)
    opacities: tuple[float, ...] = (0.005, 0.02, 0.1)
    kmeans: tuple[float, ...] = (256, 4096)
    modes: tuple[str, ...] = ("standard", "fast")
    iterations: int = 1_000
    threads: int | None = None

    def __post_init__(self) -> None:
        for one in self.what:
            if one not in FAMILIES:
                raise InputError(f"{one!r} cannot be swept, wanted some of {', '.join(FAMILIES)}")
        if not self.what:
            raise InputError(f"nothing is to be swept, wanted some of {', '.join(FAMILIES)}")
        if self.preset not in PRESETS:
            raise InputError(f"the preset is {self.preset!r}, wanted one of {', '.join(PRESETS)}")
        _check("the PSNR of an attribute", self.attribute_psnr, 10.0, 120.0, "dB")
        _check("a target PSNR", self.psnr, 1.0, 99.0, "dB")
        _check("a target size", self.sizes, 1, math.inf, "bytes")
        _check("an opacity", self.opacities, 0.0, 1.0, "")
        _check("the number of entries", self.kmeans, 1, 65536, "")
        for share in self.keep:
            if not 0.0 < share <= 1.0:
                raise InputError(f"a share of the splats is {share:g}, wanted above 0, at most 1")
        if not self.modes:
            raise InputError("no mode of the renderer is given")


def parse_words(text: str) -> tuple[str, ...]:
    """Words from `a,b`, each once, in the order given."""
    words = [word.strip() for word in text.split(",")]
    return tuple(dict.fromkeys(word for word in words if word))


def parse_numbers(text: str) -> tuple[float, ...]:
    """Numbers from `0.7,0.5`, each once, in the order given; none from an empty text.

    Raises:
        InputError: one is no finite number.
    """
    found = []
    for word in parse_words(text):
        try:
            found.append(float(word))
        except ValueError:
            found.append(math.nan)
        if not math.isfinite(found[-1]):
            raise InputError(f"{word!r} is no number, wanted some with commas between them")
    return tuple(dict.fromkeys(found))


def parse_sizes(text: str) -> tuple[int, ...]:
    """Bytes from `2MB,800kB`, see `csplat_tools.optimise.target.parse_size_bytes`.

    Raises:
        InputError: one is no size.
    """
    from csplat_tools.optimise.target import parse_size_bytes

    return tuple(dict.fromkeys(parse_size_bytes(word) for word in parse_words(text)))


def _check(what: str, values: tuple[float, ...], low: float, high: float, unit: str) -> None:
    for value in values:
        if not low <= value <= high:
            most = f"to {high:g}" if math.isfinite(high) else "or more"
            raise InputError(f"{what} is {value:g}, wanted {low:g} {most} {unit}".rstrip())

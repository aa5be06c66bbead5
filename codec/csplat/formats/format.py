# SPDX-License-Identifier: Apache-2.0
"""Describe a file format: its reader, its writer, and the parts of a scene that it can store."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from csplat.detect import KINDS
from csplat.errors import InputError
from csplat.lint import Finding, list_names
from csplat.scene import Scene
from csplat.scene_metadata import SRGB, UNSPECIFIED, SceneMetadata

#: Splat attributes common to all formats.
ARRAYS = ("means", "quats", "scales", "opacities", "sh0", "shN")

# Opening a file raises InputError if it is incomplete or of another format, OSError if it cannot be read. Reading its
# blocks raises the same errors; it is possible until the context ends.
OpenScene = Callable[[Path], AbstractContextManager[Scene]]
# A level of detail, 0 is the finest; or, if it is given, the best version of at most this number of splats.
OpenLevel = Callable[[Path, int, int | None], AbstractContextManager[Scene]]
OpenBands = Callable[[Path, int], AbstractContextManager[Scene]]  # highest SH degree to read
# Writing raises InputError if the format cannot represent the scene (too many splats, positions out of range), OSError
# if the file cannot be written. The path appears when the file is complete. Returns findings about values that the
# format stores badly, apart from values outside `Format.ranges`; or nothing.
WriteScene = Callable[[Path, Scene], Sequence[Finding] | None]
WriteLevels = Callable[[Path, Sequence[Scene]], Sequence[Finding] | None]  # the levels of a scene, finest first


@dataclass(frozen=True)
class ValueRange:
    """The range of the values of an attribute that a format stores; its writer clamps others.

    Attributes:
        low, high: the range, in the units of `SplatModel`.
        step: difference of neighbouring values at its ends. Values beyond an end by half a step are rounded to it,
            which is as accurate as elsewhere.
    """

    low: float
    high: float
    step: float = 0.0

    def holds(self, least: float, most: float) -> bool:
        """Return True if values from `least` to `most` are rounded at worst, not clamped."""
        return least >= self.low - self.step / 2.0 and most <= self.high + self.step / 2.0


@dataclass(frozen=True)
class Format:
    """A file format.

    Attributes:
        name: name for `--from` and `--to`, a key of `csplat.detect.KINDS`, for example `spz`.
        open: opens a file; `None`: csplat does not read the format.
        open_level: opens a level of detail; `None`: scenes have only one level.
        open_bands: opens a file without the SH bands above a degree; `None`: `open` reads all bands.
        write: writes a file; `None`: csplat does not write the format.
        keeps: returns True if `write` copies the splats of a scene from its file without a change.
        write_levels: writes all levels of detail to a file of the name `levels_name`; `None`: one level only.
        levels_name: name of files with levels, in lower case; "" if there are none.
        doubt: for formats identified by the file name alone: returns the reason why the content is unlikely to be of
            this format, "" if it may be.
        degree: highest SH degree that the format stores; the writer gets no higher bands.
        axes: directions of +x, +y and +z in every file of this format, and in the scenes that `open` returns; "" if
            files specify their axes or leave them open.
        ranges: the range of attributes whose values the writer clamps, by name.
        exact: names of the arrays that are stored losslessly; opacities stored as logits come back within an ulp.
        splat_bytes: approximate bytes per splat by SH degree, from 0 to `degree`; empty if that depends on the scene.
        presets: the same format with another precision, by preset; "balanced" is the format itself.
        carries: the fields among `antialiased`, `origin`, `extra`, `metadata`, `coordinate_system`, `unit_metres`,
            `flat`, `colour_space` and `cameras` that the format stores.
        unwritten: returns the keys of the entries of the metadata that the format does not store although it carries
            `metadata`.
    """

    name: str
    open: OpenScene | None = None
    open_level: OpenLevel | None = None
    open_bands: OpenBands | None = None
    write: WriteScene | None = None
    keeps: Callable[[Scene], bool] = lambda _scene: False
    write_levels: WriteLevels | None = None
    levels_name: str = ""
    doubt: Callable[[Path], str] = lambda _path: ""
    degree: int = 3
    axes: str = ""
    ranges: Mapping[str, ValueRange] = field(default_factory=dict)
    exact: frozenset[str] = frozenset()
    splat_bytes: tuple[float, ...] = ()
    presets: Mapping[str, Format] = field(default_factory=dict)
    carries: frozenset[str] = frozenset()
    unwritten: Callable[[SceneMetadata], Sequence[str]] = lambda _metadata: ()

    def at(self, preset: str) -> Format:
        """Return the format at the precision of a preset; raise an `InputError` if it has no such preset."""
        if preset != "balanced" and preset not in self.presets:
            encode = f"run `csplat encode IN OUT.csplat --preset {preset}`"
            remedy = encode if self.name == "csplat" else "SPZ has small"
            raise InputError(f"{self.title} cannot be written with the preset {preset}: {remedy}")
        return self.presets.get(preset, self)

    @property
    def title(self) -> str:
        """Name for messages, for example `SPZ 4`."""
        return KINDS[self.name].title

    @property
    def suffixes(self) -> tuple[str, ...]:
        """File name suffixes with their dots, in lower case, the usual suffix first."""
        return KINDS[self.name].suffixes

    def takes_levels(self, path: Path) -> bool:
        """Return True if a file of this name holds all levels of detail of a scene."""
        return self.write_levels is not None and path.name.lower() == self.levels_name

    def expected_bytes(self, scene: Scene) -> int | None:
        """Return the approximate size of a file; `None` if it depends on the scene."""
        if self.keeps(scene):
            return scene.size_bytes
        return round(scene.count * self.splat_bytes[min(scene.sh_degree, self.degree)]) if self.splat_bytes else None

    def losses(self, scene: Scene) -> tuple[str, ...]:
        """Describe the parts of a scene that this format cannot store, in a few words each; precision is not listed."""
        lost = []
        if scene.sh_degree > self.degree:
            bands = range(self.degree + 1, scene.sh_degree + 1)
            lost.append(f"SH band{'s' if len(bands) > 1 else ''} {' and '.join(map(str, bands))}")
        for name, (words, is_there) in _PARTS.items():
            if name not in self.carries and is_there(scene):
                lost.append(f"{words} {', '.join(scene.extra)}" if name == "extra" else words)
        if "metadata" in self.carries and (keys := self.unwritten(scene.metadata)):
            lost.append(f"metadata {list_names(keys)}")
        return tuple(lost)


_PARTS: dict[str, tuple[str, Callable[[Scene], Any]]] = {
    "antialiased": ("that it is antialiased", lambda scene: scene.metadata.antialiased),
    "origin": ("the origin", lambda scene: any(scene.origin)),
    "coordinate_system": ("the axes", lambda scene: scene.metadata.coordinate_system != UNSPECIFIED),
    "unit_metres": ("the length of a unit", lambda scene: scene.metadata.unit_metres is not None),
    "flat": ("that splats are discs", lambda scene: scene.metadata.flat),
    "colour_space": ("the colour space", lambda scene: scene.metadata.colour_space != SRGB),
    "cameras": ("cameras", lambda scene: scene.metadata.cameras),
    "metadata": ("metadata", lambda scene: scene.metadata.entries),
    "extra": ("extra columns", lambda scene: scene.extra),
}

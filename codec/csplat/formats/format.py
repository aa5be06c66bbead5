"""A file format: how it is read and written, and which parts of a scene it can store."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

from csplat.detect import KINDS
from csplat.model import UNSPECIFIED, SplatModel
from csplat.scene import Scene

#: Splat attributes of every format.
ARRAYS = ("means", "quats", "scales", "opacities", "sh0", "shN")


class Reader(Protocol):
    """Opens a file."""

    def __call__(self, path: Path, /) -> AbstractContextManager[Scene]:
        """Give the scene, whose blocks can be read as long as the context lasts.

        Raises:
            InputError: the file is not whole, or none of this format. Blocks raise it, too.
            OSError: it cannot be read.
        """
        ...


class LevelReader(Protocol):
    """Opens a file of a scene that it has several times."""

    def __call__(self, path: Path, level: int, /) -> AbstractContextManager[Scene]:
        """As `Reader`: 0 is the finest level, that of `Reader`, and 1 the next coarser one."""
        ...


class BandReader(Protocol):
    """Opens a file without its higher SH bands."""

    def __call__(self, path: Path, sh_degree: int, /) -> AbstractContextManager[Scene]:
        """As `Reader`, without the bands above a degree; the file may have more than models have."""
        ...


class Writer(Protocol):
    """Writes a file, or the files of a folder."""

    def __call__(self, path: Path, scene: Scene, /) -> None:
        """Write all of a scene; `path` takes its name when it is complete.

        Raises:
            InputError: the format cannot hold it at all: too many splats, positions out of its reach.
            OSError: it cannot be written.
        """
        ...


@dataclass(frozen=True)
class Format:
    """A format of files.

    Attributes:
        name: as `csplat formats` and `--from` have it, a key of `csplat.detect.KINDS`: `spz`.
        open: reads it; `None`: it is not read.
        open_level: reads a level of it; `None`: scenes have one level.
        open_bands: reads it without the SH bands above a degree; `None`: `open` reads all bands that a model may have.
        write: writes it; `None`: it is not written.
        doubt: for formats known by the file name alone: why a file is hardly of this format, "" if it may well be.
        degree: highest SH degree that it holds.
        axes: directions of +x, +y and +z in every file of this format; "" if a file may specify nothing or anything.
            `open` gives the scene along them.
        exact: names of the arrays of a model that come back bit for bit; opacities kept as logits within an ulp.
        splat_bytes: about how many bytes a splat takes at SH degrees 0 to 3; empty if that depends on the scene.
        carries: those of `antialiased`, `origin`, `extra`, `metadata`, `coordinate_system`, `unit_metres`, `flat`,
            `cameras` that it can store.
    """

    name: str
    open: Reader | None = None
    open_level: LevelReader | None = None
    open_bands: BandReader | None = None
    write: Writer | None = None
    doubt: Callable[[Path], str] = lambda _path: ""
    degree: int = 3
    axes: str = ""
    exact: frozenset[str] = frozenset()
    splat_bytes: tuple[float, ...] = ()
    carries: frozenset[str] = frozenset()

    @property
    def title(self) -> str:
        """As people write it: `SPZ 4`."""
        return KINDS[self.name].title

    @property
    def suffixes(self) -> tuple[str, ...]:
        """Endings of file names, the usual one first; with their dots, in small letters."""
        return KINDS[self.name].suffixes

    def expected_bytes(self, facts: SplatModel, count: int) -> int | None:
        """About how large a file gets; `None` if that depends on the scene."""
        return round(count * self.splat_bytes[min(facts.sh_degree, self.degree)]) if self.splat_bytes else None

    def losses(self, facts: SplatModel) -> tuple[str, ...]:
        """List the parts of a scene that this format cannot store, a few words each; precision is not among them.

        Args:
            facts: `facts` of a `Scene`, or a model.
        """
        lost = []
        if facts.sh_degree > self.degree:
            bands = range(self.degree + 1, facts.sh_degree + 1)
            lost.append(f"SH band{'s' if len(bands) > 1 else ''} {' and '.join(map(str, bands))}")
        for name, (words, is_there) in _PARTS.items():
            if name not in self.carries and is_there(facts):
                lost.append(f"{words} {', '.join(facts.extra)}" if name == "extra" else words)
        return tuple(lost)


_PARTS: dict[str, tuple[str, Callable[[SplatModel], Any]]] = {
    "antialiased": ("that it is antialiased", lambda facts: facts.antialiased),
    "origin": ("the origin", lambda facts: any(facts.origin)),
    "coordinate_system": ("the axes", lambda facts: facts.coordinate_system != UNSPECIFIED),
    "unit_metres": ("the length of a unit", lambda facts: facts.unit_metres is not None),
    "flat": ("that splats are discs", lambda facts: facts.flat),
    "cameras": ("cameras", lambda facts: facts.cameras),
    "metadata": ("metadata", lambda facts: facts.metadata),
    "extra": ("extra columns", lambda facts: facts.extra),
}

"""A scene that is read some splats at a time.

What is known before the first splat comes first, then blocks: a block is a `SplatModel` of a bounded number of splats
that says the same of the scene as all others. Who writes a scene may go through its blocks several times, and needs no
more memory than a block wants.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from csplat.errors import InputError
from csplat.lint import Finding
from csplat.model import SplatModel

#: Splats of a block, at most.
BLOCK = 65_536


@dataclass(frozen=True)
class Scene:
    """A scene that is read some splats at a time.

    Attributes:
        count: N.
        facts: the scene without its splats: SH degree, axes, origin, antialiasing, metadata, names and types of extra
            columns.
        blocks: begins at the first splat whenever it is called, and gives all of them in order, in models of `BLOCK`
            splats at most, whose facts are `facts`.
        findings: what was noticed so far; grows while the first blocks are read.
        format: name of the format that it is read from; "" of a scene in memory.
        levels: splats of each level, the finest first, of a file that has the scene several times; this is one of them.
    """

    count: int
    facts: SplatModel
    blocks: Callable[[], Iterator[SplatModel]]
    findings: list[Finding] = field(default_factory=list)
    format: str = ""
    levels: tuple[int, ...] = ()

    def numbered(self) -> Iterator[tuple[slice, SplatModel]]:
        """Each block, and which splats of the scene it has."""
        start = 0
        for block in self.blocks():
            yield slice(start, start + len(block)), block
            start += len(block)

    def model(self) -> SplatModel:
        """All of it in memory."""
        return joined(self.facts, list(self.blocks()))


def scene_of(model: SplatModel) -> Scene:
    """A scene that is in memory already."""

    def blocks() -> Iterator[SplatModel]:
        for start in range(0, len(model), BLOCK):
            yield model.select(slice(start, start + BLOCK))

    return Scene(len(model), model.select(slice(0, 0)), blocks)


def joined(facts: SplatModel, blocks: Sequence[SplatModel]) -> SplatModel:
    """Blocks of a scene, one after the other."""
    if len(blocks) < 2:
        return blocks[0] if blocks else facts
    arrays: dict[str, Any] = {
        name: np.concatenate([getattr(one, name) for one in blocks])
        for name in ("means", "quats", "scales", "opacities", "sh0", "shN")
    }
    doubles = [one.means_double for one in blocks]
    return replace(
        facts,
        **arrays,
        extra={name: np.concatenate([one.extra[name] for one in blocks]) for name in facts.extra},
        means_double=None if doubles[0] is None else np.concatenate([one for one in doubles if one is not None]),
    )


def without_bands(model: SplatModel, sh_degree: int) -> SplatModel:
    """Leave out the SH bands above a degree."""
    if sh_degree >= model.sh_degree:
        return model
    return replace(model, shN=np.ascontiguousarray(model.shN[:, : (sh_degree + 1) ** 2 - 1]))


def watched(scene: Scene, stage: str, progress: Callable[[str, float], object]) -> Scene:
    """The same scene; who goes through its blocks tells how far it has come.

    Its blocks raise InputError where they are not as many splats as they were: somebody changed the file.
    """

    def blocks() -> Iterator[SplatModel]:
        done = 0
        for model in scene.blocks():
            progress(stage, done / max(1, scene.count))
            yield model
            done += len(model)
        if done != scene.count:
            raise InputError(f"{done:,} splats came where {scene.count:,} were announced: did the file change?")
        progress(stage, 1.0)

    return replace(scene, blocks=blocks)

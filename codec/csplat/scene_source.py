"""Read a scene in blocks of bounded size.

A block is a `SplatModel` with the metadata of the whole scene. Blocks may be read several times, one in memory at a
time.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from csplat.errors import InputError
from csplat.lint import Finding
from csplat.model import SplatModel
from csplat.types import Progress

#: Maximum number of splats of a block.
BLOCK_SPLATS = 65_536


@dataclass(frozen=True)
class SceneSource:
    """A scene that is read in blocks.

    Attributes:
        count: N.
        metadata_model: the scene without its splats: SH degree, axes, origin, antialiasing, metadata, names and types
            of extra columns.
        blocks: returns an iterator over all splats in order, in models of at most `BLOCK_SPLATS` splats that equal
            `metadata_model` in everything else.
        findings: findings so far; the first iteration over the blocks may add some.
        format: name of the format that the scene is read from; "" if it is in memory.
        levels: number of splats of each level of detail, finest first, if the file has several; this scene is one.
        file_axes: axes of the coordinates in the file, if the scene was converted from them while it was opened.
    """

    count: int
    metadata_model: SplatModel
    blocks: Callable[[], Iterator[SplatModel]]
    findings: list[Finding] = field(default_factory=list)
    format: str = ""
    levels: tuple[int, ...] = ()
    file_axes: str = ""

    def numbered(self) -> Iterator[tuple[slice, SplatModel]]:
        """Yield each block with the range of its splats in the scene."""
        start = 0
        for block in self.blocks():
            yield slice(start, start + len(block)), block
            start += len(block)

    def model(self) -> SplatModel:
        """Read all blocks into one model."""
        return join_blocks(self.metadata_model, list(self.blocks()))


def source_from_model(model: SplatModel) -> SceneSource:
    """Make a source of a scene in memory."""

    def blocks() -> Iterator[SplatModel]:
        for start in range(0, len(model), BLOCK_SPLATS):
            yield model.select(slice(start, start + BLOCK_SPLATS))

    return SceneSource(len(model), model.select(slice(0, 0)), blocks)


def join_blocks(metadata_model: SplatModel, blocks: Sequence[SplatModel]) -> SplatModel:
    """Concatenate blocks of a scene."""
    if len(blocks) < 2:
        return blocks[0] if blocks else metadata_model
    arrays: dict[str, Any] = {
        name: np.concatenate([getattr(one, name) for one in blocks])
        for name in ("means", "quats", "scales", "opacities", "sh0", "shN")
    }
    doubles = [one.means_double for one in blocks]
    return replace(
        metadata_model,
        **arrays,
        extra={name: np.concatenate([one.extra[name] for one in blocks]) for name in metadata_model.extra},
        means_double=None if doubles[0] is None else np.concatenate([one for one in doubles if one is not None]),
    )


def drop_bands(model: SplatModel, sh_degree: int) -> SplatModel:
    """Drop the SH bands above a degree."""
    if sh_degree >= model.sh_degree:
        return model
    return replace(model, shN=np.ascontiguousarray(model.shN[:, : (sh_degree + 1) ** 2 - 1]))


def with_progress(scene: SceneSource, stage: str, progress: Progress) -> SceneSource:
    """Return a source whose blocks report progress, and raise an `InputError` if their number of splats is not N."""

    def blocks() -> Iterator[SplatModel]:
        done = 0
        for model in scene.blocks():
            progress(stage, done / max(1, scene.count))
            yield model
            done += len(model)
        if done != scene.count:
            raise InputError(f"the scene has {done:,} splats, expected {scene.count:,}: did the file change?")
        progress(stage, 1.0)

    return replace(scene, blocks=blocks)

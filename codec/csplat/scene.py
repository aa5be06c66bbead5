# SPDX-License-Identifier: Apache-2.0
"""Read a scene in blocks of bounded size: `Scene`.

A block is a `SplatModel` with the metadata of the whole scene. Blocks may be read several times, with a single block
in memory at a time.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, Self

import numpy as np

from csplat.errors import InputError
from csplat.lint import Finding
from csplat.model import SplatModel, splat_dtype
from csplat.scene_metadata import SceneMetadata
from csplat.types import Progress

#: Maximum number of splats of a block.
BLOCK_SPLATS = 65_536

#: Attributes that blocks lack.
_ABOUT_THE_FILE = {"findings", "format", "levels", "file_axes", "name", "size_bytes", "modified_ns"}


@dataclass(eq=False)
class Scene:
    """A scene whose splats are read when they are needed; a context manager, which closes its file.

    Attributes:
        count: N.
        sh_degree: spherical-harmonics degree, 0 to 4.
        reader: returns an iterator over all splats in order, in models of at most `BLOCK_SPLATS` splats with the
            metadata of the scene.
        metadata: metadata of the scene.
        origin: as in `SplatModel`.
        extra: dtypes of the extra columns, by name; with a shape for several values of a splat.
        has_doubles: models have `means_double`.
        findings: findings so far; the first iteration over the blocks may add some.
        format: name of the format that the scene is read from; "" if it is in memory.
        levels: number of splats of each level of detail, finest first, if the file has several; this scene is one.
        file_axes: axes of the coordinates in the file, if the scene was converted from them while it was opened.
        in_memory: the splats, if the scene was made from a model.
        name: name of the file, for messages.
        size_bytes: size of the file; of the tiles, for a coarser version in a .csplat file.
        modified_ns: time of the last change of the file, nanoseconds; 0 if unknown.
    """

    count: int
    sh_degree: int
    reader: Callable[[], Iterator[SplatModel]]
    metadata: SceneMetadata = field(default_factory=SceneMetadata)
    origin: tuple[float, float, float] = (0.0, 0.0, 0.0)
    extra: Mapping[str, np.dtype[Any]] = field(default_factory=dict)
    has_doubles: bool = False
    findings: list[Finding] = field(default_factory=list)
    format: str = ""
    levels: tuple[int, ...] = ()
    file_axes: str = ""
    in_memory: SplatModel | None = None
    name: str = ""
    size_bytes: int = 0
    modified_ns: int = 0

    @classmethod
    def of(cls, model: SplatModel) -> Scene:
        """Return the scene of a model in memory."""

        def reader() -> Iterator[SplatModel]:
            for start in range(0, len(model), BLOCK_SPLATS):
                yield model.select(slice(start, start + BLOCK_SPLATS))

        return cls.like(model, len(model), reader).changed(in_memory=model)

    @classmethod
    def like(
        cls, model: SplatModel, count: int, reader: Callable[[], Iterator[SplatModel]], findings: Sequence[Finding] = ()
    ) -> Scene:
        """Return a scene with everything that a model has besides splats.

        Args:
            model: a model, perhaps without splats.
            count, reader, findings: as above.
        """
        extra = {name: splat_dtype(column) for name, column in model.extra.items()}
        doubles = model.means_double is not None
        listed = findings if isinstance(findings, list) else list(findings)
        return cls(count, model.sh_degree, reader, model.metadata, model.origin, extra, doubles, listed)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def __len__(self) -> int:
        return self.count

    def close(self) -> None:
        """Close the file, from which no more blocks can be read."""
        self._resources.close()

    def changed(self, **fields: Any) -> Scene:
        """Return the scene with other values of some attributes; the caller still has to close this scene."""
        kept = {attribute.name: getattr(self, attribute.name) for attribute in dataclasses.fields(Scene)}
        if not fields.keys() <= _ABOUT_THE_FILE:
            kept["in_memory"] = None
        return Scene(**{**kept, **fields})

    def blocks(self, splats_max: int = BLOCK_SPLATS) -> Iterator[SplatModel]:
        """Yield all splats in order, at most `splats_max` at a time; `BLOCK_SPLATS` may be in memory."""
        if splats_max < 1:
            raise InputError(f"splats_max is {splats_max}, expected at least 1")
        for block in self.reader():
            if len(block) <= splats_max:
                yield block
            else:
                yield from (block.select(slice(at, at + splats_max)) for at in range(0, len(block), splats_max))

    def numbered(self) -> Iterator[tuple[slice, SplatModel]]:
        """Yield each block with the range of its splats in the scene."""
        start = 0
        for block in self.blocks():
            yield slice(start, start + len(block)), block
            start += len(block)

    def model(self) -> SplatModel:
        """Read all blocks into one model, or return the model that is in memory."""
        return join_blocks(self.empty(), list(self.blocks())) if self.in_memory is None else self.in_memory

    def loaded(self) -> Scene:
        """Return the scene with all splats in memory, whose file may be closed."""
        return (
            self
            if self.in_memory is not None
            else Scene.of(self.model()).changed(**{name: getattr(self, name) for name in _ABOUT_THE_FILE})
        )

    @cached_property
    def _resources(self) -> ExitStack:
        """Resources that are closed with the scene; created empty on first use."""
        return ExitStack()

    def keep_open(self, resources: ExitStack) -> Self:
        """Close these resources with the scene, which is returned."""
        self._resources.push(resources)
        return self

    def empty(self) -> SplatModel:
        """Return a model without splats that has everything else of the scene."""
        three = np.zeros((0, 3), np.float32)
        return SplatModel(
            means=three,
            quats=np.zeros((0, 4), np.float32),
            scales=three,
            opacities=np.zeros(0, np.float32),
            sh0=three,
            shN=np.zeros((0, (self.sh_degree + 1) ** 2 - 1, 3), np.float32),
            origin=self.origin,
            metadata=self.metadata,
            extra={name: np.zeros(0, dtype) for name, dtype in self.extra.items()},
            means_double=np.zeros((0, 3), np.float64) if self.has_doubles else None,
        )

    def map(self, change: Callable[[SplatModel], SplatModel]) -> Scene:
        """Return the scene with each block changed, but not its number of splats.

        Args:
            change: returns the changed block; also called with no splats, for everything else.
        """
        model = change(self.empty())
        return self.changed(
            sh_degree=model.sh_degree,
            metadata=model.metadata,
            origin=model.origin,
            extra={name: splat_dtype(column) for name, column in model.extra.items()},
            has_doubles=model.means_double is not None,
            reader=lambda: map(change, self.blocks()),
        )

    def with_sh_degree(self, sh_degree: int) -> Scene:
        """Return the scene without the SH bands above a degree."""
        return self if sh_degree >= self.sh_degree else self.map(lambda block: drop_bands(block, sh_degree))

    def without_extra(self) -> Scene:
        """Return the scene without extra columns."""
        return self.map(lambda block: replace(block, extra={})) if self.extra else self

    def with_progress(self, stage: str, progress: Progress) -> Scene:
        """Return a scene whose blocks report progress, and raise an `InputError` if their number of splats is not N."""

        def reader() -> Iterator[SplatModel]:
            done = 0
            for block in self.blocks():
                progress(stage, done / max(1, self.count))
                yield block
                done += len(block)
            if done != self.count:
                raise InputError(f"the scene has {done:,} splats, expected {self.count:,}: did the file change?")
            progress(stage, 1.0)

        return self.changed(reader=reader)


def join_blocks(empty: SplatModel, blocks: Sequence[SplatModel]) -> SplatModel:
    """Concatenate blocks of a scene; `empty` is the scene without splats."""
    if len(blocks) < 2:
        return blocks[0] if blocks else empty
    arrays: dict[str, Any] = {
        name: np.concatenate([getattr(block, name) for block in blocks])
        for name in ("means", "quats", "scales", "opacities", "sh0", "shN")
    }
    doubles = [block.means_double for block in blocks]
    return replace(
        empty,
        **arrays,
        extra={name: np.concatenate([block.extra[name] for block in blocks]) for name in empty.extra},
        means_double=None if doubles[0] is None else np.concatenate([means for means in doubles if means is not None]),
    )


def drop_bands(model: SplatModel, sh_degree: int) -> SplatModel:
    """Drop the SH bands above a degree."""
    if sh_degree >= model.sh_degree:
        return model
    return replace(model, shN=np.ascontiguousarray(model.shN[:, : (sh_degree + 1) ** 2 - 1]))

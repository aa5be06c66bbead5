"""A scene along a Z curve, on which neighbours stay together, sorted outside of memory."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from csplat.encoder.entropy import morton_codes
from csplat.errors import InputError
from csplat.formats.format import ARRAYS
from csplat.model import SplatModel
from csplat.scene import BLOCK, Scene
from csplat.types import F32, F64, I64

_STEPS = 1 << 21  # steps along each axis
_SAMPLE = 1 << 16  # splats that determine where the curve runs
_IN_MEMORY = 1 << 24  # bytes that need no file


@contextmanager
def along_curve(scene: Scene, folder: Path) -> Iterator[Scene]:
    """Sort a scene along a Z curve; splats in one place keep their order.

    Args:
        scene: the scene; its blocks are read twice.
        folder: has space for an unnamed file of 56 bytes a splat, and 12 more for each coefficient of SH. Memory
            is needed for few blocks only.

    Yields:
        The scene in its new order, without extra columns; all of its blocks but the last are full.

    Raises:
        InputError: the blocks of the scene raise it.
        OSError: the folder is full.
    """
    curve = _Curve.through(scene)
    facts = replace(scene.facts, extra={}, means_double=None)
    dtype = np.dtype([(name, "<f4", getattr(facts, name).shape[1:]) for name in ARRAYS])
    with tempfile.SpooledTemporaryFile(_IN_MEMORY, dir=str(folder)) as spool:
        runs = []  # for each block written, where its parts begin
        for model in scene.blocks():
            codes = curve.codes(model.means)
            order = np.argsort(codes, kind="stable")
            rows = np.empty(len(model), dtype)
            for name in ARRAYS:
                rows[name] = getattr(model, name)[order]
            parts = np.searchsorted(codes[order], curve.splits)
            runs.append(spool.tell() + dtype.itemsize * np.concatenate([[0], parts, [len(model)]]))
            spool.write(rows.tobytes())
        yield replace(scene, facts=facts, blocks=lambda: _full_blocks(facts, _merged(spool, runs, dtype, curve)))


def _merged(spool: IO[bytes], runs: Sequence[I64], dtype: np.dtype[Any], curve: _Curve) -> Iterator[NDArray[Any]]:
    """Rows in their order, about a block at a time: the parts of all runs that lie between two splits."""
    for part in range(len(curve.splits) + 1):
        pieces = []
        for run in runs:
            spool.seek(run[part])
            pieces.append(np.frombuffer(spool.read(run[part + 1] - run[part]), dtype))
        rows = np.concatenate(pieces) if pieces else np.empty(0, dtype)
        yield rows[np.argsort(curve.codes(rows["means"]), kind="stable")]


def _full_blocks(facts: SplatModel, parts: Iterator[NDArray[Any]]) -> Iterator[SplatModel]:
    left: list[NDArray[Any]] = []
    for rows in parts:
        left = [np.concatenate([*left, rows])]
        while len(left[0]) >= BLOCK:
            yield _model(facts, left[0][:BLOCK])
            left = [left[0][BLOCK:]]
    if left and len(left[0]):
        yield _model(facts, left[0])


def _model(facts: SplatModel, rows: NDArray[Any]) -> SplatModel:
    arrays: dict[str, Any] = {name: np.ascontiguousarray(rows[name]) for name in ARRAYS}
    return replace(facts, **arrays)


@dataclass(frozen=True)
class _Curve:
    """A Z curve through a scene.

    Attributes:
        low, high: [3], the ends of its axes, those of a sample; what lies beyond is on its border.
        splits: codes that part the scene into about equal blocks.
    """

    low: F64
    high: F64
    splits: I64

    @classmethod
    def through(cls, scene: Scene) -> _Curve:
        stride = -(-scene.count // _SAMPLE) or 1
        taken, at = [np.zeros((0, 3), np.float32)], 0
        for model in scene.blocks():
            taken.append(model.means[-at % stride :: stride])
            at += len(model)
        sample = np.concatenate(taken)
        if at != scene.count:
            raise InputError(f"the scene has {at:,} splats, {scene.count:,} were announced")
        if not len(sample):
            return cls(np.zeros(3), np.ones(3), np.zeros(0, np.int64))
        low, high = sample.min(0).astype(np.float64), sample.max(0).astype(np.float64)
        curve = cls(low, np.where(high > low, high, low + 1.0), np.zeros(0, np.int64))
        codes = np.sort(curve.codes(sample))
        blocks = -(-scene.count // BLOCK)
        return replace(curve, splits=codes[np.arange(1, blocks) * len(codes) // blocks])

    def codes(self, means: F32) -> I64:
        """Return how far along the curve the places [N, 3] are, as Morton codes."""
        steps = (means - self.low) * (_STEPS / (self.high - self.low))
        return morton_codes(np.clip(steps, 0, _STEPS - 1).astype(np.int64).T)

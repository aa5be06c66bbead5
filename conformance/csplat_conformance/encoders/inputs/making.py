"""The type of an input, and the cloud of splats on which most inputs are based."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache

import numpy as np

from csplat_conformance.encoders.plyfile import Layout, Splats, meaning, write
from csplat_conformance.stated import Source

PSNR_MIN = 30.0  #: dB that renders must reach, unless an input sets another value
PITCH = 0.1  #: scene units between neighbours
_JITTER = 0.2  # fraction of the pitch, to either side
APART = PITCH * (1.0 - 2.0 * _JITTER)  #: smallest distance between neighbours of a cloud, scene units


@dataclass(frozen=True)
class Input:
    """A PLY, and what an encoder may make of it.

    Attributes:
        name: group and name, `ordinary/degree_3`.
        why: one line: what it shows, why it hurts.
        make: gives the bytes of the PLY.
        source: gives the scene that it holds; `None` if there is nothing to encode.
        apart: no two different splats are nearer to each other than this.
        may_refuse: status 1 and a line are as good as a file.
        renders: whether renders of it are meaningful.
        psnr_min: dB that renders of it must reach at the default quality. Renders of csplat's
            coarsest preset exceed it by at least 1 dB; defects that harm renders fall below it.
    """

    name: str
    why: str
    make: Callable[[], bytes]
    source: Callable[[], Source] | None
    apart: float = APART
    may_refuse: bool = False
    renders: bool = True
    psnr_min: float = PSNR_MIN

    @property
    def must_refuse(self) -> bool:
        """True if there is nothing to encode."""
        return self.source is None

    def psnr_wanted(self, psnr_min: float) -> float:
        """Return the lowest PSNR of renders of it, dB, if `psnr_min` replaces `PSNR_MIN`; all inputs shift alike."""
        return self.psnr_min + psnr_min - PSNR_MIN


def made(
    name: str,
    why: str,
    splats: Callable[[], Splats],
    layout: Layout | None = None,
    *,
    apart: float = APART,
    renders: bool = True,
    psnr_min: float = PSNR_MIN,
) -> Input:
    """Return an input of rows; those called `nasty/…` may be refused."""
    kept = cache(splats)
    may_refuse = name.startswith("nasty/")
    return Input(
        name, why, lambda: write(kept(), layout), lambda: meaning(kept()), apart, may_refuse, renders, psnr_min
    )


def cloud(count: int, degree: int, seed: int = 0) -> Splats:
    """Return splats on a jittered grid, with colours that vary smoothly and a little at random."""
    rng = np.random.default_rng(seed)
    side = int(np.ceil(count ** (1.0 / 3.0)))
    grid = np.stack(np.unravel_index(np.arange(count), (side, side, side)), axis=1)
    means = PITCH * (grid - side / 2 + rng.uniform(-_JITTER, _JITTER, (count, 3)))
    waves = np.sin(means @ rng.normal(0.0, 2.0, (3, 3)))
    coefficients = (degree + 1) ** 2 - 1
    decay = np.concatenate([np.full(2 * band + 1, 0.2 / band) for band in range(1, degree + 1)] or [np.zeros(0)])
    return Splats(
        means=means.astype(np.float32),
        quats=rng.normal(0.0, 1.0, (count, 4)).astype(np.float32),
        scales=np.log(PITCH * rng.uniform(0.2, 0.6, (count, 3))).astype(np.float32),
        logits=rng.normal(1.0, 2.0, count).astype(np.float32),
        sh0=(waves + rng.normal(0.0, 0.2, (count, 3))).astype(np.float32),
        shN=(rng.normal(0.0, 1.0, (count, coefficients, 3)) * decay[:, None]).astype(np.float32),
    )

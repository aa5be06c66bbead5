"""Reference inputs for encoders: PLY files made by recipe, and the sources that they stand for.

`ordinary/` an encoder must take; `nasty/` it may refuse, with status 1 and a line that says why, but must not get
wrong; `broken/` it must refuse. Splats keep a distance of `apart` from one another, so that a decoded splat has one
source alone.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np

from csplat_conformance.encoders.plyfile import Splats, meaning, write
from csplat_conformance.stated import Source

__all__ = ["Input", "all_inputs"]

_PITCH = 0.1  # scene units between neighbours
_JITTER = 0.2  # of the pitch, to either side
_APART = _PITCH * (1.0 - 2.0 * _JITTER)
_MANY = 65_536 + 600  # more than one tile holds


@dataclass(frozen=True)
class Input:
    """A PLY, and what an encoder may make of it.

    Attributes:
        name: group and name, `ordinary/degree_3`.
        why: one line: what it shows, why it hurts.
        make: gives the bytes of the PLY.
        source: gives what it stands for; `None` where there is nothing to encode.
        apart: no two different splats are nearer to each other than this.
        may_refuse: status 1 and a line are as good as a file.
        renders: whether pictures of it say something.
        psnr_room: dB by which the pictures may fall below what is wanted of the others.
    """

    name: str
    why: str
    make: Callable[[], bytes]
    source: Callable[[], Source] | None
    apart: float = _APART
    may_refuse: bool = False
    renders: bool = True
    psnr_room: float = 0.0

    @property
    def must_refuse(self) -> bool:
        """Whether there is nothing to encode."""
        return self.source is None


def all_inputs() -> list[Input]:
    """Return every input, in the order of a run."""
    return [*_ordinary(), *_nasty(), *_broken()]


def cloud(count: int, degree: int, seed: int = 0) -> Splats:
    """Return splats on a jittered grid, with colours that vary smoothly and a little at random."""
    rng = np.random.default_rng(seed)
    side = int(np.ceil(count ** (1.0 / 3.0)))
    grid = np.stack(np.unravel_index(np.arange(count), (side, side, side)), axis=1)
    means = _PITCH * (grid - side / 2 + rng.uniform(-_JITTER, _JITTER, (count, 3)))
    waves = np.sin(means @ rng.normal(0.0, 2.0, (3, 3)))
    coefficients = (degree + 1) ** 2 - 1
    decay = np.concatenate([np.full(2 * band + 1, 0.2 / band) for band in range(1, degree + 1)] or [np.zeros(0)])
    return Splats(
        means=means.astype(np.float32),
        quats=rng.normal(0.0, 1.0, (count, 4)).astype(np.float32),
        scales=np.log(_PITCH * rng.uniform(0.2, 0.6, (count, 3))).astype(np.float32),
        logits=rng.normal(1.0, 2.0, count).astype(np.float32),
        sh0=(waves + rng.normal(0.0, 0.2, (count, 3))).astype(np.float32),
        shN=(rng.normal(0.0, 1.0, (count, coefficients, 3)) * decay[:, None]).astype(np.float32),
    )


def _made(name: str, why: str, splats: Callable[[], Splats], **rest: Any) -> Input:
    """Return an input of rows; `rest` is for `Input` and for `write`."""
    fields = {key: rest.pop(key) for key in ("apart", "may_refuse", "renders", "psnr_room") if key in rest}
    kept = cache(splats)
    return Input(name, why, lambda: write(kept(), **rest), lambda: meaning(kept()), **fields)


# Ordinary ------------------------------------------------------------------------------------------


def _ordinary() -> list[Input]:
    def degree(number: int) -> Callable[[], Splats]:
        return lambda: cloud(216, number, number)

    few = lambda: cloud(64, 1, 9)  # noqa: E731 - one of many recipes, used by several inputs
    return [
        *(_made(f"ordinary/degree_{d}", f"SH degree {d}", degree(d)) for d in range(4)),
        _made("ordinary/one_splat", "a scene of one", lambda: cloud(1, 3, 5), renders=False),
        _made("ordinary/ascii", "numbers as text", few, format="ascii"),
        _made("ordinary/big_endian", "bytes in the other order", few, format="binary_big_endian"),
        _made("ordinary/double", "all columns as doubles", few, dtype="f8"),
        _made("ordinary/no_normals", "without the columns nx, ny, nz", few, normals=False),
        _made("ordinary/column_order", "columns in the opposite order", few, reverse=True),
        _made("ordinary/comments", "comments that name axes and more", few, comments=("up is Y", "", "x" * 300)),
        _made("ordinary/extra_columns", "columns that splats do not have", _with_extra),
        _made("ordinary/quaternions", "lengths from 0.001 to 1000, w below 0", _long_quats),
        _made("ordinary/transparent_and_opaque", "logits of ±30 and beyond float32's alpha", _clear),
        # A small turn moves the tip of a needle out of its pixels.
        _made("ordinary/needles_and_discs", "one axis a thousand times the others", _needles, psnr_room=4.0),
        _made("ordinary/plane", "all centres in one plane", _plane),
        _made("ordinary/strong_colours", "coefficients of ±20", _strong),
        _made("ordinary/two_tiles", f"{_MANY} splats, more than a tile holds", lambda: cloud(_MANY, 0, 3)),
    ]


def _with_extra() -> Splats:
    splats, rng = cloud(64, 1, 11), np.random.default_rng(11)
    splats.extra = {
        "object_id": rng.integers(-5, 5, 64).astype("<i4"),
        "red": rng.integers(0, 256, 64).astype("u1"),
        "confidence": rng.random(64).astype("<f4"),
    }
    return splats


def _long_quats() -> Splats:
    splats, rng = cloud(125, 0, 12), np.random.default_rng(12)
    splats.quats *= (10.0 ** rng.uniform(-3.0, 3.0, (125, 1))).astype(np.float32)
    splats.quats[:60, 0] = -np.abs(splats.quats[:60, 0])
    return splats


def _clear() -> Splats:
    splats = cloud(125, 0, 13)
    splats.logits = np.linspace(-40.0, 40.0, 125).astype(np.float32)
    return splats


def _needles() -> Splats:
    splats, rng = cloud(125, 1, 14), np.random.default_rng(14)
    thin = np.log(np.float32(_PITCH * 5e-4))
    long = rng.integers(0, 3, 125)
    disc = np.arange(125) % 2 == 0
    splats.scales[~disc] = thin
    splats.scales[~disc, long[~disc]] = np.log(np.float32(_PITCH * 0.8))
    splats.scales[disc] = np.log(np.float32(_PITCH * 0.6))
    splats.scales[disc, long[disc]] = thin
    return splats


def _plane() -> Splats:
    splats = cloud(125, 0, 15)
    side = 12
    grid = np.stack(np.unravel_index(np.arange(125), (side, side)), axis=1) * _PITCH
    splats.means = np.concatenate([grid, np.full((125, 1), 0.7)], axis=1).astype(np.float32)
    return splats


def _strong() -> Splats:
    splats = cloud(125, 2, 16)
    splats.sh0[::7] *= 20.0
    splats.shN[::11] *= 40.0
    return splats


# Nasty ---------------------------------------------------------------------------------------------


def _nasty() -> list[Input]:
    seen: dict[str, Any] = {"may_refuse": True}
    nasty: dict[str, Any] = {**seen, "renders": False}
    return [
        _made("nasty/empty", "no splats", lambda: cloud(1, 0).select(np.zeros(0, np.intp)), **nasty),
        _made(
            "nasty/empty_degree_3", "no splats of degree 3", lambda: cloud(1, 3).select(np.zeros(0, np.intp)), **nasty
        ),
        _made("nasty/infinite_logits", "logits of ±infinity: alpha 1 and 0", _infinite_logits, **seen),
        _made("nasty/zero_quaternion", "rotations of length 0", _zero_quats, **seen),
        _made("nasty/huge_scales", "logarithms of ±60", _huge_scales, **nasty),
        _made("nasty/far_coordinates", "centres about 1,000,000", _far, apart=30.0, **seen),
        _made("nasty/outlier", "one splat 100,000 times as far as the others", _outlier, **nasty),
        _made("nasty/duplicates", "every third splat four times", _duplicates, **seen),
        _made("nasty/tiny_scene", "a scene of a millionth of a unit", _tiny, apart=_APART * 1e-6, **seen),
        _made("nasty/huge_colours", "coefficients of ±1e6 beside small ones", _huge_colours, **nasty),
        _made("nasty/not_a_number", "NaN in three rows", _with_nan, **nasty),
    ]


def _infinite_logits() -> Splats:
    splats = cloud(64, 0, 21)
    splats.logits[::3], splats.logits[1::3] = np.inf, -np.inf
    return splats


def _zero_quats() -> Splats:
    splats = cloud(64, 0, 22)
    splats.quats[::5] = 0.0
    return splats


def _huge_scales() -> Splats:
    splats = cloud(64, 0, 23)
    splats.scales[0], splats.scales[1], splats.scales[2] = 60.0, -60.0, (60.0, 0.0, -60.0)
    return splats


def _far() -> Splats:
    splats = cloud(64, 0, 24)
    splats.means = (splats.means.astype(np.float64) * 1000.0 + [1e6, -1e6, 1e6]).astype(np.float32)
    splats.scales += np.float32(np.log(1000.0))
    return splats


def _outlier() -> Splats:
    splats = cloud(125, 0, 25)
    splats.means[77] = (1e5, 0.0, -1e5)
    return splats


def _duplicates() -> Splats:
    splats = cloud(64, 1, 26)
    return splats.select(np.repeat(np.arange(64), np.where(np.arange(64) % 3, 1, 4)))


def _tiny() -> Splats:
    splats = cloud(64, 0, 27)
    splats.means *= np.float32(1e-6)
    splats.scales += np.float32(np.log(1e-6))
    return splats


def _huge_colours() -> Splats:
    splats = cloud(64, 1, 28)
    splats.sh0[3], splats.sh0[4], splats.shN[5] = 1e6, -1e6, 1e6
    return splats


def _with_nan() -> Splats:
    splats = cloud(64, 1, 29)
    splats.means[3, 1], splats.logits[17], splats.shN[40, 2, 2] = np.nan, np.nan, np.nan
    return splats


# Broken --------------------------------------------------------------------------------------------


def _broken() -> list[Input]:
    whole = cache(lambda: write(cloud(64, 1, 31)))
    return [
        Input("broken/nothing", "no bytes at all", lambda: b"", None),
        Input("broken/no_ply", "a text that is no PLY", lambda: b"splats, but not here\n" * 9, None),
        Input("broken/cut", "the last splats are missing", lambda: whole()[:-400], None),
        Input("broken/no_colour", "a PLY of points, not of splats", _points, None),
    ]


def _points() -> bytes:
    head = "ply\nformat binary_little_endian 1.0\nelement vertex 9\n"
    head += "".join(f"property float {axis}\n" for axis in "xyz") + "end_header\n"
    return head.encode("ascii") + np.arange(27, dtype="<f4").tobytes()

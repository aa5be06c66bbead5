"""Inputs that an encoder must accept."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from csplat_conformance.encoders.inputs.making import PITCH, Input, cloud, made
from csplat_conformance.encoders.plyfile import Layout, Splats

_MANY = 65_536 + 600  # more than one tile holds


def ordinary() -> list[Input]:
    """Return them, in the order of a run."""

    def degree(number: int) -> Callable[[], Splats]:
        return lambda: cloud(216, number, number)

    few = lambda: cloud(64, 1, 9)  # noqa: E731 - one of many recipes, used by several inputs
    return [
        *(made(f"ordinary/degree_{d}", f"SH degree {d}", degree(d)) for d in range(4)),
        made("ordinary/one_splat", "a scene of one", lambda: cloud(1, 3, 5), renders=False),
        made("ordinary/ascii", "numbers as text", few, Layout(format="ascii")),
        made("ordinary/big_endian", "bytes in the other order", few, Layout(format="binary_big_endian")),
        made("ordinary/double", "all columns as doubles that binary32 holds", few, Layout(dtype="f8")),
        made("ordinary/no_normals", "without the columns nx, ny, nz", few, Layout(normals=False)),
        made("ordinary/normals", "columns nx, ny, nz that are not zero", _with_normals),
        made("ordinary/column_order", "columns in the opposite order", few, Layout(reverse=True)),
        made("ordinary/comments", "comments that name axes and more", few, Layout(comments=("up is Y", "", "x" * 300))),
        made("ordinary/obj_info", "lines obj_info, the other kind of comment", few, Layout(obj_info=("num 64", ""))),
        made("ordinary/extra_columns", "columns that splats do not have", _with_extra),
        made("ordinary/quaternions", "lengths from 0.001 to 1000, w below 0 and at −0", _long_quats),
        made("ordinary/transparent_and_opaque", "logits from −200 to 200: alpha 0, denormal, 1", _clear),
        # A small turn moves the tip of a needle out of its pixels.
        made("ordinary/needles_and_discs", "one axis a thousand times the others", _needles, psnr_min=28.0),
        made("ordinary/plane", "all centres in one plane", _plane),
        made(
            "ordinary/elongated",
            "a row of splats, thousands of times as long as wide",
            _elongated,
            apart=10.0,
            renders=False,
        ),
        made("ordinary/all_alike", "one size, rotation, opacity and base colour for all", _alike),
        made("ordinary/strong_colours", "coefficients of ±20", _strong),
        made("ordinary/two_tiles", f"{_MANY} splats, more than a tile holds", lambda: cloud(_MANY, 0, 3)),
    ]


def _with_normals() -> Splats:
    splats = cloud(64, 1, 10)
    splats.normals = np.random.default_rng(10).normal(0.0, 1.0, (64, 3)).astype(np.float32)
    return splats


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
    splats.quats[60:64, 0] = -0.0
    splats.quats[64:66] = [[-0.0, -3.0, -0.0, 4.0], [-1.0, -0.0, 0.0, -0.0]]
    return splats


def _clear() -> Splats:
    splats = cloud(125, 0, 13)
    splats.logits = np.linspace(-40.0, 40.0, 125).astype(np.float32)
    # Alpha leaves binary32's normal numbers at −87.3 and becomes 0 at −104; 1 it is from 17.3.
    splats.logits[::8] = [-200, -105, -103, -100, -90, -88, -50, -20, 16.5, 17, 17.3, 18, 20, 50, 100, 200]
    return splats


def _needles() -> Splats:
    splats, rng = cloud(125, 1, 14), np.random.default_rng(14)
    thin = np.log(np.float32(PITCH * 5e-4))
    long = rng.integers(0, 3, 125)
    disc = np.arange(125) % 2 == 0
    splats.scales[~disc] = thin
    splats.scales[~disc, long[~disc]] = np.log(np.float32(PITCH * 0.8))
    splats.scales[disc] = np.log(np.float32(PITCH * 0.6))
    splats.scales[disc, long[disc]] = thin
    return splats


def _plane() -> Splats:
    splats = cloud(125, 0, 15)
    side = 12
    grid = np.stack(np.unravel_index(np.arange(125), (side, side)), axis=1) * PITCH
    splats.means = np.concatenate([grid, np.full((125, 1), 0.7)], axis=1).astype(np.float32)
    return splats


def _elongated() -> Splats:
    splats = cloud(216, 1, 17)
    splats.means[:, 1] = np.arange(216) * np.float32(10.0)
    return splats


def _alike() -> Splats:
    splats = cloud(216, 2, 18)
    for array in (splats.quats, splats.scales, splats.logits, splats.sh0):
        array[:] = array[0]
    return splats


def _strong() -> Splats:
    splats = cloud(125, 2, 16)
    splats.sh0[::7] *= 20.0
    splats.shN[::11] *= 40.0
    return splats

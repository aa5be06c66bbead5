# SPDX-License-Identifier: CC0-1.0
"""Reference inputs for encoders: generated PLY files and their sources.

An encoder must accept `ordinary/`. It may refuse `nasty/` with status 1 and a line with the reason, but must not encode
them incorrectly. It must refuse `broken/`. Splats are at least `separation` apart, so that only one source splat is
near each decoded splat.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache

import numpy as np

from csplat_conformance.declared_bounds import Source
from csplat_conformance.encoders.reference_ply import PlyLayout, PlyRows, source_of_rows, write_ply
from csplat_conformance.encoders.surface_scenes import SPACING_MIN, surface_scene

PSNR_MIN = 30.0  #: lowest PSNR of renders, dB, unless an input sets another limit
PITCH = 0.1  #: scene units between neighbours
_JITTER = 0.2  # fraction of the pitch, in each direction
SEPARATION = PITCH * (1.0 - 2.0 * _JITTER)  #: smallest distance between neighbours of a cloud, scene units

_MANY = 65_536 + 600  # splats; more than a tile holds


@dataclass(frozen=True)
class EncoderInput:
    """A PLY, its source, and the results that an encoder may give for it.

    Attributes:
        name: group and name, `ordinary/degree_3`.
        why: its purpose or difficulty, one line.
        make: returns the bytes of the PLY.
        source: returns its scene; `None` if there is nothing to encode.
        separation: smallest distance between distinct centres, scene units.
        may_refuse: whether an encoder may refuse it, with status 1 and a line with the reason.
        renders: whether renders of it are informative.
        psnr_min: lowest PSNR of renders at the default quality, dB. csplat's coarsest preset exceeds it by at least
            1 dB; defects that harm renders fall below it.
    """

    name: str
    why: str
    make: Callable[[], bytes]
    source: Callable[[], Source] | None
    separation: float = SEPARATION
    may_refuse: bool = False
    renders: bool = True
    psnr_min: float = PSNR_MIN

    @property
    def must_refuse(self) -> bool:
        """True if there is nothing to encode."""
        return self.source is None

    def psnr_required(self, psnr_min: float) -> float:
        """Return the lowest PSNR of renders, dB, if `psnr_min` replaces `PSNR_MIN`: all inputs shift equally."""
        return self.psnr_min + psnr_min - PSNR_MIN


def all_inputs() -> list[EncoderInput]:
    """Return every input, in the order of a run."""
    return [*ordinary_inputs(), *surface_inputs(), *unusual_value_inputs(), *unusual_inputs(), *invalid_inputs()]


def rows_input(
    name: str,
    why: str,
    splats: Callable[[], PlyRows],
    layout: PlyLayout | None = None,
    *,
    separation: float = SEPARATION,
    renders: bool = True,
    psnr_min: float = PSNR_MIN,
    origin: tuple[float, float, float] | None = None,
) -> EncoderInput:
    """Return an input with the given rows; encoders may refuse it if its name begins with `nasty/`.

    With an origin, the header has the comment `csplat origin`, and the centres are relative to it.
    """
    kept = cache(splats)
    if origin is not None:
        layout = PlyLayout(comments=(f"csplat origin {' '.join(map(repr, origin))}",))
    may_refuse = name.startswith("nasty/")
    return EncoderInput(
        name,
        why,
        lambda: write_ply(kept(), layout),
        lambda: replace(source_of_rows(kept()), origin=origin or (0.0, 0.0, 0.0)),
        separation,
        may_refuse,
        renders,
        psnr_min,
    )


def cloud(count: int, degree: int, seed: int = 0) -> PlyRows:
    """Return splats on a jittered grid, with smooth colours plus noise."""
    rng = np.random.default_rng(seed)
    side = int(np.ceil(count ** (1.0 / 3.0)))
    grid = np.stack(np.unravel_index(np.arange(count), (side, side, side)), axis=1)
    means = PITCH * (grid - side / 2 + rng.uniform(-_JITTER, _JITTER, (count, 3)))
    waves = np.sin(means @ rng.normal(0.0, 2.0, (3, 3)))
    coefficients = (degree + 1) ** 2 - 1
    decay = np.concatenate([np.full(2 * band + 1, 0.2 / band) for band in range(1, degree + 1)] or [np.zeros(0)])
    return PlyRows(
        means=means.astype(np.float32),
        quats=rng.normal(0.0, 1.0, (count, 4)).astype(np.float32),
        scales=np.log(PITCH * rng.uniform(0.2, 0.6, (count, 3))).astype(np.float32),
        logits=rng.normal(1.0, 2.0, count).astype(np.float32),
        sh0=(waves + rng.normal(0.0, 0.2, (count, 3))).astype(np.float32),
        shN=(rng.normal(0.0, 1.0, (count, coefficients, 3)) * decay[:, None]).astype(np.float32),
    )


def ordinary_inputs() -> list[EncoderInput]:
    """Return the inputs that an encoder must accept, in the order of a run."""

    def degree(number: int) -> Callable[[], PlyRows]:
        return lambda: cloud(216, number, number)

    few = lambda: cloud(64, 1, 9)  # noqa: E731 - shared by several inputs
    return [
        *(rows_input(f"ordinary/degree_{d}", f"SH degree {d}", degree(d)) for d in range(5)),
        rows_input("ordinary/one_splat", "one splat", lambda: cloud(1, 3, 5), renders=False),
        rows_input("ordinary/ascii", "numbers as text", few, PlyLayout(format="ascii")),
        rows_input("ordinary/big_endian", "big-endian numbers", few, PlyLayout(format="binary_big_endian")),
        rows_input("ordinary/double", "all columns as doubles, with binary32 values", few, PlyLayout(dtype="f8")),
        rows_input("ordinary/no_normals", "without the columns nx, ny, nz", few, PlyLayout(normals=False)),
        rows_input("ordinary/normals", "columns nx, ny, nz that are not zero", _with_normals),
        rows_input("ordinary/column_order", "columns in reverse order", few, PlyLayout(reverse=True)),
        rows_input(
            "ordinary/comments", "comments that name axes and more", few, PlyLayout(comments=("up is Y", "", "x" * 300))
        ),
        rows_input("ordinary/origin", "a comment with the origin of the centres", few, origin=(4.5e6, -1e7, 12.25)),
        rows_input(
            "ordinary/obj_info", "obj_info lines, which are like comments", few, PlyLayout(obj_info=("num 64", ""))
        ),
        rows_input("ordinary/extra_columns", "columns that splats do not use", _with_extra_columns),
        rows_input("ordinary/quaternions", "lengths from 0.001 to 1000, negative w and w of −0", _long_quats),
        rows_input(
            "ordinary/transparent_and_opaque", "logits from −200 to 200: alpha 0, denormal, 1", _transparent_and_opaque
        ),
        # A small rotation moves the tip of a needle by more than a pixel.
        rows_input("ordinary/needles_and_discs", "one axis a thousand times the others", _needles, psnr_min=28.0),
        rows_input("ordinary/plane", "all centres in one plane", _plane),
        rows_input(
            "ordinary/elongated",
            "a row of splats, thousands of times longer than wide",
            _elongated,
            separation=10.0,
            renders=False,
        ),
        rows_input("ordinary/all_alike", "the same size, rotation, opacity and base colour for all splats", _all_alike),
        rows_input("ordinary/strong_colours", "coefficients of ±20", _strong_colours),
        rows_input("ordinary/two_tiles", f"{_MANY} splats, more than a tile holds", lambda: cloud(_MANY, 0, 3)),
    ]


def _with_normals() -> PlyRows:
    """Return splats with normals of any length, which encoders may drop or keep."""
    splats = cloud(64, 1, 10)
    splats.normals = np.random.default_rng(10).normal(0.0, 1.0, (64, 3)).astype(np.float32)
    return splats


def _with_extra_columns() -> PlyRows:
    """Return splats with extra columns of a signed, an unsigned and a floating-point type."""
    splats, rng = cloud(64, 1, 11), np.random.default_rng(11)
    splats.extra = {
        "object_id": rng.integers(-5, 5, 64).astype("<i4"),
        "red": rng.integers(0, 256, 64).astype("u1"),
        "confidence": rng.random(64).astype("<f4"),
    }
    return splats


def _long_quats() -> PlyRows:
    """Return splats with quaternions scaled by 0.001 to 1000, some with negative w or with components of −0."""
    splats, rng = cloud(125, 0, 12), np.random.default_rng(12)
    splats.quats *= (10.0 ** rng.uniform(-3.0, 3.0, (125, 1))).astype(np.float32)
    splats.quats[:60, 0] = -np.abs(splats.quats[:60, 0])
    splats.quats[60:64, 0] = -0.0
    splats.quats[64:66] = [[-0.0, -3.0, -0.0, 4.0], [-1.0, -0.0, 0.0, -0.0]]
    return splats


def _transparent_and_opaque() -> PlyRows:
    """Return splats with logits from −40 to 40, and in every eighth row from −200 to 200."""
    splats = cloud(125, 0, 13)
    splats.logits = np.linspace(-40.0, 40.0, 125).astype(np.float32)
    # In binary32, alpha is subnormal below −87.3, 0 below −104, and 1 above 17.3.
    splats.logits[::8] = [-200, -105, -103, -100, -90, -88, -50, -20, 16.5, 17, 17.3, 18, 20, 50, 100, 200]
    return splats


def _needles() -> PlyRows:
    """Return splats with a random axis that is long in every other splat, a needle, and short in the rest, discs."""
    splats, rng = cloud(125, 1, 14), np.random.default_rng(14)
    thin = np.log(np.float32(PITCH * 5e-4))
    long = rng.integers(0, 3, 125)
    disc = np.arange(125) % 2 == 0
    splats.scales[~disc] = thin
    splats.scales[~disc, long[~disc]] = np.log(np.float32(PITCH * 0.8))
    splats.scales[disc] = np.log(np.float32(PITCH * 0.6))
    splats.scales[disc, long[disc]] = thin
    return splats


def _plane() -> PlyRows:
    """Return splats on a jitterless grid with z = 0.7."""
    splats = cloud(125, 0, 15)
    side = 12
    grid = np.stack(np.unravel_index(np.arange(125), (side, side)), axis=1) * PITCH
    splats.means = np.concatenate([grid, np.full((125, 1), 0.7)], axis=1).astype(np.float32)
    return splats


def _elongated() -> PlyRows:
    """Return splats at steps of 10 along y, which spread by less than a unit along x and z."""
    splats = cloud(216, 1, 17)
    splats.means[:, 1] = np.arange(216) * np.float32(10.0)
    return splats


def _all_alike() -> PlyRows:
    """Return splats that differ only in their centres and in the bands above 0."""
    splats = cloud(216, 2, 18)
    for array in (splats.quats, splats.scales, splats.logits, splats.sh0):
        array[:] = array[0]
    return splats


def _strong_colours() -> PlyRows:
    """Return splats of which some have 20 times the base colour, some 40 times the other coefficients."""
    splats = cloud(125, 2, 16)
    splats.sh0[::7] *= 20.0
    splats.shN[::11] *= 40.0
    return splats


def surface_inputs() -> list[EncoderInput]:
    """Return the inputs whose renders reveal every mistake, in the order of a run."""

    def surfaces(name: str, why: str, scene: Callable[[], PlyRows]) -> EncoderInput:
        return rows_input(f"ordinary/{name}", why, scene, separation=SPACING_MIN, psnr_min=32.0)

    return [
        surfaces(
            "surfaces",
            "discs on a torus, a ball and a box, like a trained scene: reveals mistakes in any attribute",
            lambda: surface_scene(0.9, 0.02, 51),
        ),
        surfaces(
            "glossy",
            "the same with view-dependent highlights: SH far beyond ±1",
            lambda: surface_scene(4.5, 0.0, 52),
        ),
    ]


def unusual_value_inputs() -> list[EncoderInput]:
    """Return inputs with extreme values, which an encoder may refuse, in the order of a run."""
    no_splats = np.zeros(0, np.intp)
    return [
        rows_input("nasty/empty", "no splats", lambda: cloud(1, 0).select(no_splats), renders=False),
        rows_input(
            "nasty/empty_degree_3", "no splats of degree 3", lambda: cloud(1, 3).select(no_splats), renders=False
        ),
        rows_input("nasty/infinite_logits", "logits of ±infinity: alpha 1 and 0", _infinite_logits),
        rows_input("nasty/zero_quaternion", "rotations of length 0", _zero_quats),
        rows_input(
            "nasty/tiny_and_huge_quaternions", "lengths of 1e−45 to 6e38, with squares beyond binary32", _extreme_quats
        ),
        rows_input("nasty/huge_scales", "logarithms of ±60", _huge_scales, renders=False),
        rows_input(
            "nasty/scales_beyond_88", "logarithms beyond ±88, which count as ±88", _scales_beyond_88, renders=False
        ),
        rows_input("nasty/scales_of_float", "logarithms of ±1e4 and ±3e38", _scales_of_float, renders=False),
        rows_input("nasty/needles", "one axis 1e5 to 1e30 times the others", _extreme_needles, renders=False),
        rows_input("nasty/far_coordinates", "centres about 1,000,000", _far_coordinates, separation=30.0),
        rows_input(
            "nasty/far_doubles",
            "centres about 4,000,000 in doubles, not exact in binary32 relative to any origin",
            _far_doubles,
            PlyLayout(means_dtype="f8"),
        ),
        rows_input("nasty/outlier", "one splat 100,000 times farther than the others", _outlier, renders=False),
        rows_input(
            "nasty/edge_of_float",
            "one centre at 3e38 and −3e38, near the limit of binary32",
            _edge_of_float,
            renders=False,
        ),
        rows_input("nasty/duplicates", "every third splat four times", _duplicates),
        rows_input("nasty/one_place", "one splat 20,000 times", _one_place, renders=False),
        rows_input("nasty/tiny_scene", "a scene of a millionth of a unit", _tiny_scene, separation=SEPARATION * 1e-6),
        rows_input("nasty/huge_colours", "coefficients of ±1e6 next to small ones", _huge_colours, renders=False),
        rows_input("nasty/not_a_number", "NaN in three rows", _with_nan, renders=False),
        rows_input(
            "nasty/infinities", "infinite centres, rotations and colours: four rows are not splats", _infinities
        ),
        rows_input(
            "nasty/infinite_scales", "scales of ±infinity: three rows are flat, one is no splat", _infinite_scales
        ),
        rows_input(
            "nasty/beyond_float",
            "doubles beyond binary32: two rows are not splats",
            _beyond_float,
            PlyLayout(dtype="f8"),
        ),
    ]


def _infinite_logits() -> PlyRows:
    """Return splats of which a third has alpha 1 and a third alpha 0."""
    splats = cloud(64, 0, 21)
    splats.logits[::3], splats.logits[1::3] = np.inf, -np.inf
    return splats


def _zero_quats() -> PlyRows:
    """Return splats of which every fifth has a quaternion of zeros, half of these with a −0."""
    splats = cloud(64, 0, 22)
    splats.quats[::5] = 0.0
    splats.quats[::10, 2] = -0.0
    return splats


def _extreme_quats() -> PlyRows:
    """Return splats with quaternions whose squares overflow or vanish in binary32."""
    splats = cloud(64, 0, 32)
    factors = np.array([1e-30, 1e30, 1e-38, 1e37, 1e-20, 1e20, 1e-10, 1e10], np.float32)
    splats.quats[:56] *= np.repeat(factors, 7)[:, None]
    splats.quats[56:60] = np.array([[1, -1, 1, 1], [1, 1, 1, -1], [-1, 0, 1, 0], [0, 0, -1, 1]]) * np.float32(3e38)
    splats.quats[60:64] = np.array([[1, 0, 0, 0], [0, 1, -1, 0], [-2, 3, 1, 1], [3, 1, 1, 9]]) * np.float32(1.4e-45)
    return splats


def _huge_scales() -> PlyRows:
    """Return splats of which three have logarithms of ±60."""
    splats = cloud(64, 0, 23)
    splats.scales[0], splats.scales[1], splats.scales[2] = 60.0, -60.0, (60.0, 0.0, -60.0)
    return splats


def _scales_beyond_88() -> PlyRows:
    """Put all scales of half of the splats beyond ±88, so that their errors are 0 for any stored scales beyond it."""
    splats = cloud(64, 0, 33)
    ends = np.array([88.0, 88.5, 88.7229, 89.0, 104.0], np.float32)
    splats.scales[:5, 0], splats.scales[5:10, 1] = ends, -ends
    splats.scales[32:48] += np.float32(94.0)
    splats.scales[48:] -= np.float32(94.0)
    return splats


def _scales_of_float() -> PlyRows:
    """Return splats with scales whose exponentials overflow or vanish even in binary64."""
    splats = cloud(64, 0, 33)
    ends = np.array([1e4, 3e38], np.float32)
    splats.scales[:2, 0], splats.scales[2:4, 1] = ends, -ends
    splats.scales[4:6], splats.scales[6:8] = ends[:, None], -ends[:, None]
    return splats


def _extreme_needles() -> PlyRows:
    """Return needles with a random long axis, 1e30 times the others in every eighth splat, 1e5 times in the rest."""
    splats, rng = cloud(64, 0, 34), np.random.default_rng(34)
    long = rng.integers(0, 3, 64)
    ratio = np.where(np.arange(64) % 8, 1e5, 1e30)
    splats.scales[:] = (np.log(0.05) - np.log(ratio))[:, None]
    splats.scales[np.arange(64), long] = np.log(0.05)
    return splats


def _far_coordinates() -> PlyRows:
    """Return a cloud a thousand times as large around (1e6, −1e6, 1e6)."""
    splats = cloud(64, 0, 24)
    splats.means = (splats.means.astype(np.float64) * 1000.0 + [1e6, -1e6, 1e6]).astype(np.float32)
    splats.scales += np.float32(np.log(1000.0))
    return splats


def _far_doubles() -> PlyRows:
    """Return splats far from 0, with low bits that binary32 cannot represent relative to any of the centres."""
    splats, rng = cloud(216, 1, 35), np.random.default_rng(35)
    low_bits = rng.uniform(-1e-8, 1e-8, (216, 3))
    splats.means = splats.means.astype(np.float64) + np.array((500_123.4, 4_012_345.6, -123.4)) + low_bits
    return splats


def _outlier() -> PlyRows:
    """Return splats with one centre at a distance of 1.4e5."""
    splats = cloud(125, 0, 25)
    splats.means[77] = (1e5, 0.0, -1e5)
    return splats


def _edge_of_float() -> PlyRows:
    """Return splats with one centre near the largest binary32."""
    splats = cloud(125, 0, 36)
    splats.means[77] = (3e38, 0.0, -3e38)
    return splats


def _duplicates() -> PlyRows:
    """Return splats of which every third row occurs four times."""
    splats = cloud(64, 1, 26)
    return splats.select(np.repeat(np.arange(64), np.where(np.arange(64) % 3, 1, 4)))


def _one_place() -> PlyRows:
    return cloud(1, 1, 37).select(np.zeros(20_000, np.intp))


def _tiny_scene() -> PlyRows:
    """Return a cloud shrunk to a millionth."""
    splats = cloud(64, 0, 27)
    splats.means *= np.float32(1e-6)
    splats.scales += np.float32(np.log(1e-6))
    return splats


def _huge_colours() -> PlyRows:
    """Return splats of which four have coefficients of ±1e6."""
    splats = cloud(64, 1, 28)
    splats.sh0[3], splats.sh0[4], splats.shN[5] = 1e6, -1e6, 1e6
    splats.sh0[6] = (1e6, -1e6, 1e6)  # large chroma; the rows above are grey
    return splats


def _with_nan() -> PlyRows:
    """Return splats with three rows that contain a NaN each."""
    splats = cloud(64, 1, 29)
    splats.means[3, 1], splats.logits[17], splats.shN[40, 2, 2] = np.nan, np.nan, np.nan
    return splats


def _infinities() -> PlyRows:
    """Return splats with four rows that contain an infinity each."""
    splats = cloud(64, 1, 38)
    splats.means[3, 1], splats.quats[17, 0], splats.sh0[20, 1], splats.shN[40, 2, 2] = np.inf, -np.inf, np.inf, -np.inf
    return splats


def _infinite_scales() -> PlyRows:
    """Return splats with three flat rows, scales of −infinity, and one invalid row."""
    splats = cloud(64, 1, 39)
    splats.scales[5:7, 2], splats.scales[30], splats.scales[50, 0] = -np.inf, -np.inf, np.inf
    return splats


def _beyond_float() -> PlyRows:
    """Return splats with one centre and one colour that are finite in binary64 but not in binary32."""
    splats = cloud(64, 1, 40)
    splats.means, splats.sh0 = splats.means.astype(np.float64), splats.sh0.astype(np.float64)
    splats.means[9, 0], splats.sh0[33, 2] = 1e39, -1e300
    return splats


_FACES = (
    ("element face 3", "property list uchar int vertex_indices"),
    b"".join(bytes((count,)) + bytes(4 * count) for count in (3, 4, 0)),
)
_CAMERA = (("element camera 1", "property double x", "property uchar kind"), bytes(range(9)))


def unusual_inputs() -> list[EncoderInput]:
    """Return inputs with an unusual layout, which an encoder may refuse, in the order of a run."""
    few = lambda: cloud(64, 1, 41)  # noqa: E731 - shared by several inputs
    lists = [bytes(range(row % 4)) for row in range(64)]
    return [
        rows_input(
            "nasty/face_first", "elements before the splats, one with rows of variable length", few, _face_first()
        ),
        rows_input("nasty/camera_last", "an element after the splats", few, PlyLayout(after=_CAMERA)),
        rows_input(
            "nasty/list_property", "a list property of splats: rows of variable length", few, PlyLayout(lists=lists)
        ),
        rows_input("nasty/crlf_header", "header lines end in CR LF, rows are binary", few, PlyLayout(line_end="\r\n")),
        rows_input(
            "nasty/trailing_bytes",
            "trailing bytes after the last row, more than a row long",
            few,
            PlyLayout(after=((), b"\n\0not a row " * 16)),
        ),
        rows_input(
            "nasty/foreign_comments",
            "comments in UTF-8 and in bytes that are not UTF-8",
            few,
            PlyLayout(comments=("Größe: 3 µm, 雪", "\udcff\udcfe caf\udce9", "element vertex 5", "end_header?")),
        ),
        rows_input(
            "nasty/degree_5",
            "105 columns f_rest: csplat's highest degree is 4, and the file has to declare the source's",
            lambda: cloud(64, 5, 42),
            renders=False,
        ),
        rows_input(
            "nasty/double_means", "x, y, z in doubles, other columns in floats", few, PlyLayout(means_dtype="f8")
        ),
        rows_input("nasty/nan_normals", "NaN and infinities in normals, which splats do not use", _nan_normals),
        rows_input("nasty/nan_extra", "NaN in a column that splats do not use", _nan_extra),
    ]


def _face_first() -> PlyLayout:
    return PlyLayout(before=((*_FACES[0], *_CAMERA[0]), _FACES[1] + _CAMERA[1]))


def _nan_normals() -> PlyRows:
    """Return splats with normals that are NaN or infinite in some rows."""
    splats = cloud(64, 1, 43)
    splats.normals = np.zeros((64, 3), np.float32)
    splats.normals[5:20], splats.normals[30:33] = np.nan, -np.inf
    return splats


def _nan_extra() -> PlyRows:
    """Return splats with an extra column that is NaN in every fifth row."""
    splats = cloud(64, 1, 44)
    splats.extra = {"confidence": np.where(np.arange(64) % 5, 0.5, np.nan).astype("<f4")}
    return splats


def invalid_inputs() -> list[EncoderInput]:
    """Return the inputs that an encoder must refuse, in the order of a run."""
    whole = cache(lambda: write_ply(cloud(64, 1, 31)))

    def of(layout: PlyLayout) -> bytes:
        return write_ply(cloud(64, 1, 31), layout)

    ten = PlyLayout(renamed={"nx": "f_rest_9"})
    hole = PlyLayout(renamed={"f_rest_4": "f_rest_9"})
    return [
        EncoderInput("broken/nothing", "an empty file", lambda: b"", None),
        EncoderInput("broken/no_ply", "a text that is not a PLY", lambda: b"splats, but not here\n" * 9, None),
        EncoderInput(
            "broken/header_without_end", "a header without an end", lambda: whole().partition(b"end_h")[0], None
        ),
        EncoderInput("broken/cut", "the last splats are missing", lambda: whole()[:-400], None),
        EncoderInput(
            "broken/countless", "10^12 splats are declared, 64 are present", lambda: of(PlyLayout(count=10**12)), None
        ),
        EncoderInput("broken/negative_count", "a negative count is declared", lambda: of(PlyLayout(count=-64)), None),
        EncoderInput("broken/no_colour", "a PLY of points, not of splats", _point_cloud, None),
        EncoderInput("broken/no_opacity", "no column opacity", lambda: of(PlyLayout(renamed={"opacity": ""})), None),
        EncoderInput("broken/no_rotation", "no column rot_3", lambda: of(PlyLayout(renamed={"rot_3": ""})), None),
        EncoderInput("broken/ten_f_rest", "ten columns f_rest, which match no SH degree", lambda: of(ten), None),
        EncoderInput("broken/hole_in_f_rest", "nine columns f_rest without number 4", lambda: of(hole), None),
        EncoderInput("broken/no_number", "a word instead of a number", _word_for_number, None),
    ]


def _point_cloud() -> bytes:
    """Return a PLY of nine points with coordinates only."""
    head = "ply\nformat binary_little_endian 1.0\nelement vertex 9\n"
    head += "".join(f"property float {axis}\n" for axis in "xyz") + "end_header\n"
    return head.encode("ascii") + np.arange(27, dtype="<f4").tobytes()


def _word_for_number() -> bytes:
    """Return an ASCII PLY with a word as the last value of one row."""
    lines = write_ply(cloud(64, 1, 31), PlyLayout(format="ascii")).split(b"\n")
    lines[-9] = b" ".join([*lines[-9].split()[:-1], b"mean"])
    return b"\n".join(lines)

"""Invalid files: stream heads and coded bytes."""

from __future__ import annotations

from dataclasses import replace

from csplat import _spec
from csplat_authoring.broken import patched, small, whole
from csplat_authoring.builder import build
from csplat_authoring.deflate import deflate_fixed, deflate_stored
from csplat_authoring.samples import (
    MEANS,
    OPACITIES,
    SCALES,
    Recipe,
    axis,
    levels,
    morton,
    offset,
    rows_of,
    scene,
    tile,
)
from csplat_authoring.scene import Attribute, Block, Scene, Stream

_RUNS = (_spec.TRANSFORM_RUN_LENGTH,)
_STREAM = "TILE.0.0/opacities.stream"
_VALUES = [7, 8]


def stream_recipes() -> list[Recipe]:
    """Return the recipes of this module."""
    return [*_heads(), *_coders()]


def _heads() -> list[Recipe]:
    base = small()
    runs = build(_opacities(Stream(1, _RUNS)))
    five = Stream(1, _RUNS, packed=bytes([7, 8, 0, 0, 0]))
    nine = Stream(1, _RUNS, packed=bytes([7, 8, 8, 0, 0, 0, 0, 0, 0]))

    def transforms(name: str, why: str, values: tuple[int, ...]) -> Recipe:
        changes = {f"{_STREAM}.transforms": bytes(values).ljust(_spec.TRANSFORMS_MAX, b"\0")}
        return patched(f"transforms_{name}", why, "STR-3", "E_STREAM", base, changes)

    return [
        patched("count", "one element more than splats", "STR-1", "E_STREAM", base, {f"{_STREAM}.count": 3}),
        patched("count_zero", "no elements", "STR-1", "E_STREAM", base, {f"{_STREAM}.count": 0}),
        patched("count_huge", "2^32 − 1 elements", "STR-1", "E_STREAM", base, {f"{_STREAM}.count": 2**32 - 1}),
        whole(
            "width_3_of_levels",
            "opacities of three bytes",
            "STR-2",
            "E_STREAM",
            _opacities(Stream(3)),
            f"{_STREAM}.width",
        ),
        patched(
            "width_zero",
            "elements of no bytes",
            "STR-2",
            "E_STREAM",
            base,
            {f"{_STREAM}.width": 0, f"{_STREAM}.packed_size": 0},
        ),
        whole(
            "width_5_of_offset",
            "lattice integers of five bytes",
            "STR-2",
            "E_STREAM",
            _with({SCALES: offset(rows_of(1, 2, 3, 0, 9), Stream(5))}),
            "TILE.0.0/scales.stream.width",
        ),
        whole(
            "width_8_of_morton",
            "codes of eight bytes",
            "STR-2",
            "E_STREAM",
            _with({MEANS: morton([[0, 1, 0], [1, 0, 1]], 1, Stream(8))}),
            "TILE.0.0/means.stream.width",
        ),
        whole(
            "width_4_of_axis",
            "columns of four bytes",
            "STR-2",
            "E_STREAM",
            _with({MEANS: axis([[0, 1, 0], [1, 0, 1]], Stream(4))}),
            "TILE.0.0/means.stream.width",
        ),
        patched(
            "transforms_unknown",
            "a transform that no registry lists, behind two in the wrong order",
            "RES-2",
            "E_UNSUPPORTED",
            base,
            {f"{_STREAM}.transforms": bytes((_spec.TRANSFORM_ZIGZAG, _spec.TRANSFORM_DELTA, 5, 0))},
        ),
        transforms("descending", "zigzag before delta", (2, 1)),
        transforms("twice", "delta twice", (1, 1)),
        transforms("gap", "NONE before delta", (0, 1)),
        patched(
            "packed_size",
            "one byte too many without runs",
            "STR-4",
            "E_STREAM",
            base,
            {f"{_STREAM}.packed_size": 3, f"{_STREAM}.coded_size": 2},
        ),
        patched(
            "packed_size_huge",
            "4 GiB between transforms and coder",
            "STR-4",
            "E_STREAM",
            base,
            {f"{_STREAM}.packed_size": 2**32 - 1},
        ),
        whole("runs_not_thirds", "runs of five bytes", "STR-5", "E_STREAM", _opacities(five), f"{_STREAM}.packed_size"),
        whole(
            "runs_empty",
            "no runs",
            "STR-5",
            "E_STREAM",
            _opacities(Stream(1, _RUNS, packed=b"")),
            f"{_STREAM}.packed_size",
        ),
        whole(
            "runs_too_many", "three runs for two bytes", "STR-5", "E_STREAM", _opacities(nine), f"{_STREAM}.packed_size"
        ),
        patched(
            "coded_size_beyond",
            "more coded bytes than the payload has left",
            "STR-6",
            "E_STREAM",
            base,
            {f"{_STREAM}.coded_size": 60000},
        ),
        patched(
            "coded_size_huge", "4 GiB of coded bytes", "STR-6", "E_STREAM", runs, {f"{_STREAM}.coded_size": 2**32 - 1}
        ),
    ]


def _coders() -> list[Recipe]:
    plain = bytes(_VALUES)
    whole_block = deflate_fixed(plain)
    deflate = {
        "garbage": (b"\xff\xff\xff\xff", "the reserved block type"),
        "empty": (b"", "no coded bytes"),
        "not_final": (b"\x00" + deflate_stored(plain)[1:], "no final block"),
        "cut": (whole_block[:-1], "the last byte is missing"),
        "short": (deflate_fixed(plain[:1]), "a byte too few comes out"),
        "long": (deflate_fixed(plain + b"\0"), "a byte too many comes out"),
        "bomb": (deflate_fixed(bytes(200_000)), "200,000 bytes come out instead of two"),
        "trailing": (whole_block + b"\0", "a byte after the final block"),
        "two_streams": (whole_block + whole_block, "a second stream after the first"),
        "stored_length": (b"\x01\x02\x00\xfe\xff" + plain, "a stored block whose length is not its complement"),
        "zlib": (b"\x78\x9c" + whole_block + b"\x00\x18\x00\x10", "the header of zlib before the stream"),
    }
    short = Stream(1, _RUNS, packed=bytes([7, 0, 0]))
    long = Stream(1, _RUNS, packed=bytes([7, 8, 0, 1, 0, 0]))
    far = Stream(1, _RUNS, packed=bytes([7, 255, 255]))
    result = [
        whole(
            f"deflate_{name}",
            why,
            "COD-2 COD-4" if name == "bomb" else "COD-2",
            "E_CODER",
            _opacities(Stream(coder="deflate", coded=data)),
            f"{_STREAM}.coded",
            within=len(whole_block) if name in ("trailing", "two_streams") else 0,
        )
        for name, (data, why) in deflate.items()
    ]
    return [
        *result,
        whole(
            "stored_short",
            "a stored byte too few",
            "COD-1",
            "E_CODER",
            _opacities(Stream(coded=plain[:1])),
            f"{_STREAM}.coded",
        ),
        whole(
            "stored_long",
            "a stored byte too many",
            "COD-1",
            "E_CODER",
            _opacities(Stream(coded=plain + b"\0")),
            f"{_STREAM}.coded",
        ),
        whole("runs_short", "runs of one byte for two", "TRF-1", "E_CODER", _opacities(short), f"{_STREAM}.coded"),
        whole("runs_long", "runs of three bytes for two", "TRF-1", "E_CODER", _opacities(long), f"{_STREAM}.coded"),
        whole("runs_far", "a run of 65,536 for two bytes", "TRF-1", "E_CODER", _opacities(far), f"{_STREAM}.coded"),
    ]


def _with(changes: dict[int, Block], records: dict[int, Attribute] | None = None) -> Scene:
    made = scene(tiles=[tile(changes=changes)])
    return replace(made, attributes=made.attributes | (records or {}))


def _opacities(how: Stream) -> Scene:
    return scene(tiles=[tile(changes={OPACITIES: levels(_VALUES, how)})])

"""Splats of SOG's pictures, versions 1 and 2.

Both are tables: a byte of a picture is looked up, in version 1 between two bounds, in version 2 in a codebook. Read in
the sources of splat-transform (MIT), `read-sog.ts` and `read-sog-v1.ts`. The frame is that of the PLY it was made of.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from csplat.formats.packing import all_three, crossed
from csplat.formats.sog_files import Json, Parts, picture_of
from csplat.ply.columns import alpha_of_logits
from csplat.scene import BLOCK
from csplat.types import F32, U8, U16

COEFFICIENTS = (0, 3, 8, 15)  #: number of SH coefficients, for each degree
ENTRIES = 64  #: palette entries in a row of their picture
LEAST_TAG = 252  #: the fourth byte of a rotation tells which component is left out, from here on
_MOST = 1 << 28  # splats: no WebP image has more pixels
_PALETTE = 1 << 16
_FREE = 1 << 20  # splats that may come out of any number of bytes
_SPLATS_PER_BYTE = 8
_LARGEST_LOG = 88.0  # logarithm whose exponential float32 still holds
_SPARE = 1 << 16  # pixels beyond four for each splat


@dataclass(frozen=True)
class Unit:
    """The checked JSON of one SOG; no image has been read.

    Attributes:
        count: N.
        degree: SH degree; `None` if only the width of an image determines it.
        antialiased, flat: as in `SplatModel`.
        bounds: [2, 3] float64, bounds of the signed logarithms of 1 + means.
        scales, sh0: [3, 256] float32, NaN for codes beyond a shorter codebook.
        alpha: [256] float32.
        shN: [256] float32; `None`: no SH.
        palette: entries; `None` if only the height of an image determines it.
    """

    parts: Parts
    meta: Json
    count: int
    degree: int | None
    antialiased: bool
    flat: bool
    bounds: NDArray[np.float64]
    scales: F32
    sh0: F32
    alpha: F32
    shN: F32 | None
    palette: int | None


def unit_of(parts: Parts, name: str) -> Unit:
    """Look at the JSON of a SOG.

    Raises:
        InputError: the JSON is not as expected.
        OSError: it cannot be read.
    """
    meta = parts.json(name)
    version = meta["version"].whole(1 << 30) if "version" in meta else 1
    if version not in (1, 2):
        parts.refuse(f"it is of version {version} of SOG, wanted 1 or 2")
    old = version == 1
    if old and not meta["means"]["shape"].list():
        parts.refuse(f"{name} means shape is empty")
    count = (meta["means"]["shape"].list()[0] if old else meta["count"]).whole(_MOST)
    shN: F32 | None = None
    degree: int | None = 0
    palette: int | None = None
    if "shN" in meta:
        sh = meta["shN"]
        if old:
            shN, degree = _between(sh, 1)[0], None
        else:
            degree, palette = sh["bands"].whole(3), sh["count"].whole(_PALETTE)
            shN = _codebook(sh) if degree else None
    model = meta["model"].text() if "model" in meta else ""
    sh0 = _between(meta["sh0"], 4) if old else np.repeat(_codebook(meta["sh0"])[None], 3, 0)
    return Unit(
        parts=parts,
        meta=meta,
        count=count,
        degree=degree,
        antialiased=model == "antialiased" or ("antialias" in meta and meta["antialias"].value is True),
        flat=model == "2dgs",
        bounds=_bounds(meta["means"]),
        scales=_between(meta["scales"], 3) if old else np.repeat(_codebook(meta["scales"])[None], 3, 0),
        sh0=sh0[:3],
        alpha=alpha_of_logits(sh0[3]) if old else (np.arange(256) / 255.0).astype(np.float32),
        shN=shN,
        palette=palette,
    )


def _bounds(means: Json) -> NDArray[np.float64]:
    bounds = np.stack(_ends(means, 3))
    if np.abs(bounds).max() > _LARGEST_LOG:
        means.parts.refuse(f"{means.place} reaches beyond what float32 holds")
    return bounds


def _ends(section: Json, channels: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    low, high = (section[name].numbers(channels, channels) for name in ("mins", "maxs"))
    for channel in np.flatnonzero(crossed(low, high))[:1]:
        said = f"mins {low[channel]:.6g} above maxs {high[channel]:.6g}, expected at most that"
        section.parts.refuse(f"{section.place} has {said}")
    return low, high


def _between(section: Json, channels: int) -> F32:
    low, high = (ends[:, None] for ends in _ends(section, channels))
    return (low + (high - low) * (np.arange(256) / 255.0)).astype(np.float32)


def _codebook(section: Json) -> F32:
    values = section["codebook"].value
    if isinstance(values, list) and len(values) == 256 and values[0] is None:
        # Early writers lost the first entry; PlayCanvas' engine continues the others, too.
        after = Json(section.parts, section.place, values[1:]).numbers(255, 255)
        section.value["codebook"] = [float(after[0] + (after[0] - after[-1]) / 255), *values[1:]]
    codebook = np.full(256, np.nan, np.float32)
    numbers = section["codebook"].numbers(1, 256)
    codebook[: len(numbers)] = numbers
    return codebook


@dataclass(frozen=True)
class Pictures:
    """The codes of all splats, 19 bytes of each.

    Attributes:
        means: [N, 3]; quats: [N, 4]; scales: [N, 3]; sh0: [N, 4]; labels: [N].
        palette: [P, K, 3] float32, the SH of each label.
        zeros: rotations that were none, the identity.
    """

    unit: Unit
    means: U16
    quats: U8
    scales: U8
    sh0: U8
    labels: U16
    palette: F32
    zeros: int

    @classmethod
    def of(cls, unit: Unit) -> Pictures:
        """Take all pictures of a SOG out.

        Raises:
            InputError: one is damaged, has another size, or codes without a meaning.
            OSError: one cannot be read.
        """
        parts, count = unit.parts, unit.count
        names = [_files(unit.meta[name], wanted) for name, wanted in (("means", 2), ("quats", 1), ("scales", 1))]
        names += [_files(unit.meta["sh0"], 1)] + ([_files(unit.meta["shN"], 2)] if unit.shN is not None else [])
        data = {name: parts.read(name) for group in names for name in group}
        bytes_ = sum(map(len, data.values()))
        if count > max(_FREE, _SPLATS_PER_BYTE * bytes_):
            parts.refuse(f"{count:,} splats are declared, the pictures have {bytes_:,} bytes")
        size: list[tuple[int, int]] = []

        def fits(width: int, height: int) -> bool:
            size.append((width, height))
            return size[0] == (width, height) and count <= width * height <= 4 * count + _SPARE

        def codes(name: str, channels: int) -> U8:
            pixels = picture_of(parts, name, data.pop(name), fits).reshape(-1, 4)
            return np.ascontiguousarray(pixels[:count, :channels])

        low, high = (codes(name, 3).astype(np.uint16) for name in names[0])
        quats, scales, sh0 = codes(names[1][0], 4), codes(names[2][0], 3), codes(names[3][0], 4)
        labels, palette = np.zeros(count, np.uint16), np.zeros((1, 0, 3), np.float32)
        if unit.shN is not None:
            palette = _palette(unit, names[4][0], data[names[4][0]])
            pair = codes(names[4][1], 2).astype(np.uint16)
            labels = pair[:, 0] | pair[:, 1] << np.uint16(8)
            if count and labels.max() >= len(palette):
                worst = int(labels.argmax())
                parts.refuse(f"splat {worst} has SH {labels[worst]} of a palette of {len(palette):,}")
        for what, table, used in (("scales", unit.scales, scales), ("sh0", unit.sh0, sh0)):
            if count and np.isnan(table[0, used[:, :3].max()]):
                parts.refuse(f"a splat has code {used[:, :3].max()} of {what}, whose codebook is shorter")
        none = quats[:, 3] < LEAST_TAG
        return cls(unit, low | high << np.uint16(8), quats, scales, sh0, labels, palette, int(none.sum()))

    def blocks(self, degree: int) -> Iterator[dict[str, Any]]:
        """The arrays of a model, some splats at a time, with zeros up to a degree of SH."""
        unit, missing = self.unit, COEFFICIENTS[degree] - self.palette.shape[1]
        for start in range(0, unit.count, BLOCK):
            yield self._block(slice(start, start + BLOCK), missing)

    def _block(self, part: slice, missing: int) -> dict[str, Any]:
        unit, codes = self.unit, self.quats[part]
        three = (codes[:, :3].astype(np.float32) / np.float32(255) * 2 - 1) * np.float32(0.5**0.5)
        quats = all_three(codes[:, 3] & 3, three)
        quats[codes[:, 3] < LEAST_TAG] = 1, 0, 0, 0
        logs = unit.bounds[0] + (unit.bounds[1] - unit.bounds[0]) * (self.means[part] / 65535.0)
        shN = np.take(self.palette, self.labels[part], 0)
        return {
            "means": (np.sign(logs) * np.expm1(np.abs(logs))).astype(np.float32),
            "quats": quats,
            "scales": _looked_up(unit.scales, self.scales[part]),
            "opacities": unit.alpha[self.sh0[part, 3]],
            "sh0": _looked_up(unit.sh0, self.sh0[part, :3]),
            "shN": np.pad(shN, ((0, 0), (0, missing), (0, 0))) if missing else shN,
        }


def degree_of(unit: Unit) -> int:
    """Return the SH degree of a SOG, from its JSON or else from its palette."""
    if unit.degree is not None:
        return unit.degree
    name = _files(unit.meta["shN"], 2)[0]
    return COEFFICIENTS.index(_palette(unit, name, unit.parts.read(name)).shape[1])


def _looked_up(tables: F32, codes: NDArray[Any]) -> F32:
    found = np.empty(codes.shape, np.float32)
    for axis in range(3):
        found[:, axis] = tables[axis][codes[:, axis]]
    return found


def _files(section: Json, count: int) -> list[str]:
    names = [one.text() for one in section["files"].list()]
    if len(names) != count or len(set(names)) != count:
        section.parts.refuse(f"{section.place} files: {len(set(names))} names, wanted {count}")
    return names


def _palette(unit: Unit, name: str, data: bytes) -> F32:
    def fits(width: int, height: int) -> bool:
        wanted = [unit.degree] if unit.degree is not None else [1, 2, 3]
        rows = 1 if unit.palette is None else -(-unit.palette // ENTRIES)
        return width in [ENTRIES * COEFFICIENTS[one] for one in wanted] and rows <= height <= _PALETTE // ENTRIES

    codes = picture_of(unit.parts, name, data, fits)
    entries = codes[:, :, :3].reshape(len(codes) * ENTRIES, -1, 3)[: unit.palette]
    assert unit.shN is not None, "whoever has a palette has its values"
    found = unit.shN[entries]
    if np.isnan(found).any():
        unit.parts.refuse(f"{name} has codes beyond the codebook of shN")
    return np.ascontiguousarray(found)

"""Tables of what `distortion.py` measured, and the figures that others are known by."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from distortion_curves import Point, Rate, Series, front, psnr_at, rate_at
from printing import laid_out

__all__ = ["FIGURES", "GRADED", "Figure", "Measured", "aims", "tables"]

#: What names of series begin with whose splats are graded by what views say.
GRADED = "graded"

#: Share of SPZ's bytes at equal PSNR that is aimed at, without and with simplification.
_AIMS = (0.7, 0.4)
_AIMS_SYNTHETIC = (0.8, 0.55)
_NEAR = 1.0  # dB
_SYNTHETIC = ("lego60k",)  # rendered from a mesh, with SH


@dataclass(frozen=True)
class Figure:
    """What a format was found to take on other scenes: bytes per splat, and PSNR where it was taken."""

    name: str
    bytes_per_splat: tuple[float, float]
    psnr: tuple[float, float] | None = None

    @property
    def short(self) -> str:
        """The name, as a plot has room for it."""
        return self.name.replace("splat-transform", "s.-t.")


#: By whether the scenes had SH; taken with the tools named, on scenes of 9 to 300 thousand splats.
FIGURES = {
    True: (
        Figure("SPZ v4", (15.7, 23.7), (36.0, 45.0)),
        Figure("SOG by gsbox", (12.6, 21.0), (34.0, 41.0)),
        Figure("SOG by splat-transform", (37.0, 50.0), (48.0, 56.0)),
        Figure(".spx", (11.4, 12.4)),
        Figure("compressed.ply", (61.0, 61.0)),
    ),
    False: (
        Figure("SPZ v4", (14.7, 14.7)),
        Figure("SOG by splat-transform", (12.0, 13.0), (46.0, 55.0)),
        Figure(".spx", (10.5, 11.0)),
        Figure("compressed.ply", (16.3, 16.3)),
    ),
}


@dataclass(frozen=True, eq=False)
class Measured:
    """What is known of a scene, as `distortion.py` keeps it."""

    values: Mapping[str, Any]

    @property
    def splats(self) -> int:
        """Splats of the source: what bytes are divided by everywhere."""
        return int(self.values["splats"])

    @property
    def has_sh(self) -> bool:
        """Whether there is more than degree 0."""
        return int(self.values["sh_degree"]) > 0

    def plain(self) -> Series:
        """Files of the whole scene, by preset and coding of SH."""
        return {how: [Point(**one) for one in points] for how, points in self.values.get("plain", {}).items()}

    def unmeasured(self) -> Series:
        """Those of them that the encoder made without having seen a picture."""
        return {how: points for how, points in self.plain().items() if not how.startswith(GRADED)}

    def simplified(self) -> Series:
        """Files of simplified scenes, by number of splats, coding of SH, and PSNR that was looked for."""
        return {
            f"{one['splats']} {one['sh_coding']} for {one['goal']:.1f}": [Point(one["psnr"], one["size_bytes"])]
            for one in self.values.get("simplified", {}).values()
            if "psnr" in one
        }

    def simplified_rate(self, psnr: float) -> Rate | None:
        """What files of a PSNR take where splats may go; to leave a scene whole is one way of simplifying.

        `None` where none was simplified to that PSNR.
        """
        simplified = self.simplified()
        if rate_at(simplified, psnr) is None:
            return None
        return rate_at({**simplified, **self.plain()}, psnr)

    def peers(self) -> dict[str, Point]:
        """Files of others that were judged."""
        known = self.values.get("peers", {})
        return {name: Point(**one) for name, one in known.items() if "psnr" in one}

    def per_splat(self, size_bytes: float) -> float:
        """Bytes per splat of the source."""
        return size_bytes / self.splats


def aims(scene: str) -> tuple[float, float]:
    """Shares of SPZ's bytes that are aimed at for a scene, without and with simplification."""
    return _AIMS_SYNTHETIC if scene in _SYNTHETIC else _AIMS


def tables(results: Mapping[str, Measured], *, markdown: bool = False) -> str:
    """Everything that is known, as text."""
    parts = [
        _peer_table(results, "SPZ", markdown=markdown),
        _peer_table(results, "SOG", markdown=markdown),
        _share_table(results, markdown=markdown),
        _figure_table(results, markdown=markdown),
        _simplified_table(results, markdown=markdown),
        _cost_table(results, markdown=markdown),
    ]
    return "\n\n".join(part for part in parts if part)


def _peer_table(results: Mapping[str, Measured], name: str, *, markdown: bool) -> str:
    """Bytes at the PSNR of a peer; beside SPZ, whether the aims are met."""
    judged = name == "SPZ"
    rows = []
    for scene, one in results.items():
        peer = one.peers().get(name)
        if peer is None:
            continue
        row = [scene, f"{one.splats:,}, {one.values['sh_degree']}"]
        row.append(f"{one.per_splat(peer.size_bytes):.2f} at {peer.psnr:.1f}")
        blind = rate_at(one.unmeasured(), peer.psnr)
        row += ["-" if blind is None else f"{one.per_splat(blind.size_bytes):.2f}", _ratio(blind, peer.size_bytes)]
        rates = rate_at(one.plain(), peer.psnr), one.simplified_rate(peer.psnr)
        for rate, aim in zip(rates, aims(scene), strict=True):
            row += [_bytes(one, rate), _ratio(rate, peer.size_bytes)]
            row += [_met(rate, peer.size_bytes, aim)] if judged else []
        rows.append(row)
    aim = ["aim"] if judged else []
    beside = f"of {name}'s bytes"
    blind = ["without a look", beside]
    header = ["B/splat at dB", "splats, SH", name, *blind, "csplat", beside, *aim, "simplified", beside, *aim]
    return laid_out(header, rows, markdown=markdown)


def _bytes(one: Measured, rate: Rate | None) -> str:
    if rate is None:
        return "-"
    return f"{one.per_splat(rate.size_bytes):.2f} ({rate.how})"


def _ratio(rate: Rate | None, size_bytes: int) -> str:
    return "-" if rate is None else f"{rate.size_bytes / size_bytes:.3f}"


def _met(rate: Rate | None, size_bytes: int, aim: float) -> str:
    if rate is None:
        return "-"
    return f"{aim:g}: {'met' if rate.size_bytes <= aim * size_bytes else 'missed'}"


def _share_table(results: Mapping[str, Measured], *, markdown: bool) -> str:
    """PSNR with the shares of SPZ's bytes that are aimed at, beside that of SPZ with all of them."""
    rows = []
    for scene, one in results.items():
        peer = one.peers().get("SPZ")
        if peer is None:
            continue
        whole, fewer = (aim * one.per_splat(peer.size_bytes) for aim in aims(scene))
        either = {**one.plain(), **one.simplified()}
        cells = _reached(one, one.plain(), whole), _reached(one, one.plain(), fewer), _reached(one, either, fewer)
        rows.append((scene, f"{peer.psnr:.1f}", f"{whole:.2f}", cells[0], f"{fewer:.2f}", *cells[1:]))
    header = ("PSNR, dB", "SPZ", "whole: B/splat", "csplat", "simplified: B/splat", "whole", "whole or simplified")
    return laid_out(header, rows, markdown=markdown)


def _figure_table(results: Mapping[str, Measured], *, markdown: bool) -> str:
    """What csplat reaches with as many bytes as others took on other scenes; at their PSNR where it is known."""
    rows = []
    for scene, one in results.items():
        plain = one.plain()
        for figure in FIGURES[one.has_sh] if plain else ():
            low, high = figure.bytes_per_splat
            reached = [_reached(one, plain, size) for size in sorted({low, high})]
            rates = [_near(rate_at(plain, psnr), psnr) for psnr in figure.psnr or ()]
            rows.append(
                (
                    scene, figure.name, _range(low, high), "-" if figure.psnr is None else _range(*figure.psnr),
                    " to ".join(dict.fromkeys(reached)),
                    " to ".join(dict.fromkeys(_plain_bytes(one, rate) for rate in rates)) or "-",
                )
            )  # fmt: skip
    header = ("elsewhere", "format", "B/splat", "dB", "csplat at these bytes, dB", "at these dB, B/splat")
    return laid_out(header, rows, markdown=markdown)


def _reached(one: Measured, series: Series, bytes_per_splat: float) -> str:
    """PSNR at so many bytes; that of the largest file where it has fewer."""
    size = bytes_per_splat * one.splats
    psnr = psnr_at(series, size)
    if psnr is None:
        return "-"
    return f"{'above ' if size > front(series)[-1].size_bytes else ''}{psnr:.1f}"


def _near(rate: Rate | None, psnr: float) -> Rate | None:
    """The rate, where it is that of files near a PSNR and not of one that is far better."""
    return None if rate is None or (rate.measured or psnr) > psnr + _NEAR else rate


def _range(low: float, high: float) -> str:
    return f"{low:g}" if low == high else f"{low:g} to {high:g}"


def _plain_bytes(one: Measured, rate: Rate | None) -> str:
    return "-" if rate is None else f"{one.per_splat(rate.size_bytes):.2f}"


def _simplified_table(results: Mapping[str, Measured], *, markdown: bool) -> str:
    """Files of simplified scenes beside files of the whole ones of the same PSNR."""
    rows = []
    for scene, one in results.items():
        found = one.values.get("simplified", {})
        for file in sorted(found.values(), key=lambda file: float(file["goal"])):
            psnr = file.get("psnr", file["goal"])
            whole, seconds = rate_at(one.plain(), psnr), f"{file['seconds']:.0f}"
            if "remark" in file:
                rows.append((scene, f"{psnr:.1f}", "-", "-", "-", _plain_bytes(one, whole), "-", "-", seconds))
                continue
            share = "-" if whole is None else f"{file['size_bytes'] / whole.size_bytes:.3f}"
            rows.append(
                (
                    scene, f"{psnr:.1f}", f"{one.per_splat(file['size_bytes']):.2f}", file["sh_coding"],
                    f"{100.0 * file['splats'] / one.splats:.0f}", _plain_bytes(one, whole), share,
                    f"{file['encodes']}", seconds,
                )
            )  # fmt: skip
    header = ("simplified", "dB", "B/splat of the source", "SH", "splats %", "whole", "of that", "encodes", "s")
    return laid_out(header, rows, markdown=markdown)


def _cost_table(results: Mapping[str, Measured], *, markdown: bool) -> str:
    """How much was encoded for the curves, and how long an encode took."""
    rows = []
    for scene, one in results.items():
        points = [point for points in one.plain().values() for point in points]
        if not points:
            continue
        seconds = sorted(point.seconds for point in points)
        peers = one.peers()
        rows.append(
            (
                scene, f"{len(points)}", f"{sum(seconds):.0f}", f"{seconds[len(seconds) // 2]:.1f}",
                *(f"{peers[name].seconds:.1f}" if name in peers else "-" for name in ("SPZ", "SOG")),
            )
        )  # fmt: skip
    header = ("cost", "encodes", "s in all", "s median", "SPZ s", "SOG s")
    return laid_out(header, rows, markdown=markdown)

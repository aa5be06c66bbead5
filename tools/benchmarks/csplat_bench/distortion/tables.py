"""Tables of what was measured of curves: bytes at the PSNR of others, and what is aimed at."""

from __future__ import annotations

from collections.abc import Mapping

from csplat_bench.common.curves import Rate, Series, front, psnr_at, rate_at
from csplat_bench.common.report import Table, laid_out, optional
from csplat_bench.distortion.known import Measured

#: Share of SPZ's bytes at equal PSNR that is aimed at, without and with simplification.
_AIMS = (0.7, 0.4)
_AIMS_SYNTHETIC = (0.8, 0.55)
_SYNTHETIC = ("lego60k",)  # rendered from a mesh, with SH

Results = Mapping[str, Measured]


def aims(scene: str) -> tuple[float, float]:
    """Shares of SPZ's bytes that are aimed at for a scene, without and with simplification."""
    return _AIMS_SYNTHETIC if scene in _SYNTHETIC else _AIMS


def tables(results: Results, *, markdown: bool = False) -> str:
    """Everything that is known, as text."""
    parts = [
        _peer_table(results, "SPZ"),
        _peer_table(results, "SOG"),
        _share_table(results),
        _simplified_table(results),
    ]
    return laid_out(parts, markdown=markdown)


def _peer_table(results: Results, name: str) -> Table:
    """Return a table of bytes at the PSNR of a peer and, for SPZ, whether the aims are met."""
    judged = name == "SPZ"
    rows = []
    for scene, one in results.items():
        peer = one.peers().get(name)
        if peer is None:
            continue
        row = [scene, f"{one.splats:,}, {one.values['sh_degree']}"]
        row.append(f"{one.per_splat(peer.size_bytes):.2f} at {peer.psnr:.1f}")
        blind = rate_at(one.unmeasured(), peer.psnr)
        row += [_bytes(one, blind), _ratio(blind, peer.size_bytes)]
        rates = rate_at(one.plain(), peer.psnr), one.simplified_rate(peer.psnr)
        for rate, aim in zip(rates, aims(scene), strict=True):
            row.append(_bytes(one, rate) + (f" ({rate.how})" if rate else ""))
            row.append(_ratio(rate, peer.size_bytes))
            row += [_met(rate, peer.size_bytes, aim)] if judged else []
        rows.append(row)
    aim_title = ["aim"] if judged else []
    beside = f"of {name}'s bytes"
    ways = ["without a look", beside, "csplat", beside, *aim_title, "simplified", beside, *aim_title]
    return Table(("B/splat at dB", "splats, SH", name, *ways), rows)


def _bytes(one: Measured, rate: Rate | None) -> str:
    return "-" if rate is None else f"{one.per_splat(rate.size_bytes):.2f}"


def _ratio(rate: Rate | None, size_bytes: int) -> str:
    return "-" if rate is None else f"{rate.size_bytes / size_bytes:.3f}"


def _met(rate: Rate | None, size_bytes: int, aim: float) -> str:
    if rate is None:
        return "-"
    return f"{aim:g}: {'met' if rate.size_bytes <= aim * size_bytes else 'missed'}"


def _share_table(results: Results) -> Table:
    """Return a table of PSNR with the aimed-at shares of SPZ's bytes, next to that of SPZ with all of them."""
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
    return Table(header, rows)


def _reached(one: Measured, series: Series, bytes_per_splat: float) -> str:
    """Return the PSNR at a number of bytes; that of the largest file if it is smaller."""
    size = bytes_per_splat * one.splats
    above = "above " if any(series.values()) and size > front(series)[-1].size_bytes else ""
    return optional(psnr_at(series, size), lambda psnr: f"{above}{psnr:.1f}")


def _simplified_table(results: Results) -> Table:
    """Return a table of files of simplified scenes, compared with files of whole scenes of the same PSNR."""
    rows = []
    for scene, one in results.items():
        for file in sorted(one.values.get("simplified", {}).values(), key=lambda file: file["goal"]):
            psnr = file.get("psnr", file["goal"])
            whole, cells = rate_at(one.plain(), psnr), ["-"] * 3
            if "remark" not in file:
                share = f"{100.0 * file['splats'] / one.splats:.0f}"
                cells = [f"{one.per_splat(file['size_bytes']):.2f}", file["sh_coding"], share]
            share = "-" if whole is None or "remark" in file else f"{file['size_bytes'] / whole.size_bytes:.3f}"
            cells += [_bytes(one, whole), share, f"{file.get('encodes', '-')}", f"{file['seconds']:.0f}"]
            rows.append((scene, f"{psnr:.1f}", *cells))
    header = ("simplified", "dB", "B/splat of the source", "SH", "splats %", "whole", "of that", "encodes", "s")
    return Table(header, rows)

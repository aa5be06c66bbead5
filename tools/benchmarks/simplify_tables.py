"""Tables of what `simplify.py` measured."""

from __future__ import annotations

from typing import Any

from csplat_tools.files.console import format_table

__all__ = ["tables"]

_TWIN = (("never finished", "largest"), ("finished", "median"), ("finished", "sum"))
_COLUMNS = ("opacity", "opacity-area", "exact", "rounds")

_HEADER = (
    "PSNR, dB", *_COLUMNS, "+ colours", "+ shapes", "used views", "check views", "far: rounds", "+ colours", "views",
    "rounds s", "colours s", "all s",
)  # fmt: skip

Results = dict[str, dict[str, Any]]


def tables(results: Results) -> str:
    """Everything that is known, as text."""
    parts = [
        _pass_table(results),
        *(_removal_table(name, one["removal"]) for name, one in results.items() if "removal" in one),
    ]
    parts.append(_bands_table(results))
    return "\n\n".join(part for part in parts if part)


def _removal_table(name: str, measured: dict[str, Any]) -> str:
    percents = sorted({int(key.split()[0]) for key in measured})
    rows = []
    for percent in percents:
        found = [measured.get(f"{percent} {method}") for method in _COLUMNS]
        row = [f"{name} {percent} %", *("-" if one is None else f"{one['psnr']:.1f}" for one in found)]
        last = found[-1]
        if last is not None:
            row += [f"{last[key]:.1f}" for key in ("fit_psnr", "adjusted_psnr", "adjusted_used", "adjusted_check")]
            far = measured.get(f"{percent} far")
            row += ["-"] * 2 if far is None else [f"{far['psnr']:.1f}", f"{far['fit_psnr']:.1f}"]
            row.append(f"{last['views']}")
            row += [f"{last[key]:.0f}" for key in ("seconds", "fit_seconds", "adjusted_seconds")]
        rows.append([*row, *["-"] * (len(_HEADER) - len(row))])
    return format_table(_HEADER, rows)


def _pass_table(results: Results) -> str:
    rows = []
    for name, one in results.items():
        if "pass" not in one:
            continue
        seconds, twin = one["pass"].get("seconds", {}), one["pass"].get("twin", {})
        views = seconds.get("views", 1)
        rows.append(
            (
                name, *(f"{1000.0 * seconds.get(key, 0.0) / views:.1f}" for key in ("render", "pass", "step")),
                *(f"{twin[rule][key]:.1e}" for rule, key in _TWIN if rule in twin),
            )
        )  # fmt: skip
    header = (
        "the pass, per view",
        "render ms",
        "pass ms",
        "step of a fit ms",
        "off twin: largest",
        "with stop: median",
        "of the sum",
    )
    return format_table(header, rows) if rows else ""


def _bands_table(results: Results) -> str:
    ways = ("values for all", "as runs", "tile cut", "zero codebooks", "k-means codebook")
    rows = []
    for name, one in results.items():
        for found in one.get("bands", {}).values():
            absent = " ".join(f"{100.0 * share:.0f}" for share in found["absent"])
            rows.append((name, absent, *(f"{found[way] / found['splats']:.2f}" for way in ways)))
    return format_table(("SH bytes per splat", "% without band", *ways), rows) if rows else ""

# SPDX-License-Identifier: Apache-2.0
"""Rules that turn measurements into results: medians, paired ratios, sizes at equal PSNR, means over scenes."""

from __future__ import annotations

import math
import statistics
from collections.abc import Mapping, Sequence
from typing import Any

Row = Mapping[str, Any]

_BYTES_PER_DB = 0.045  # fraction of the bytes that a decibel costs, if it cannot be taken from two files
_SMALLER, _BETTER = 0.01, 0.1  # fraction of the bytes, and dB, by which one file beats another


def summarise_turns(turns: Sequence[Row], repeats: int = 1) -> dict[str, Any]:
    """Return a row: the median over the last turns of every number that varies, other values as they are.

    Args:
        turns: fields by turn. A field that only some turns have counts with all its values: a size is measured once.
        repeats: number of turns that count.

    Returns:
        The row. `turns` holds the values of numbers that vary, turn by turn.
    """
    counted, row, each = turns[-repeats:], dict[str, Any](), dict[str, list[float]]()
    for key in dict.fromkeys(key for turn in turns for key in turn):
        values = [turn[key] for turn in counted if key in turn] or [turn[key] for turn in turns if key in turn]
        numeric = all(isinstance(value, int | float) and not isinstance(value, bool) for value in values)
        if numeric and len(set(values)) > 1:
            row[key], each[key] = statistics.median(values), values
        else:
            row[key] = values[-1]
    return {**row, "turns": each} if each else row


def paired_ratio(reference: Sequence[Row], own: Sequence[Row], key: str) -> float:
    """Return the median over turns of the reference's value divided by the own one."""
    return float(statistics.median(theirs[key] / ours[key] for theirs, ours in zip(reference, own, strict=True)))


def bytes_at(points: Sequence[tuple[float, float]], psnr: float) -> float | None:
    """Interpolate a size: log(bytes) is linear in PSNR between the nearest points on either side.

    Args:
        points: PSNR in dB and size in bytes of files of one kind.
        psnr: dB.

    Returns:
        `None` if one side has no point: nothing is extrapolated.
    """
    below = max((point for point in points if point[0] <= psnr), default=None)
    above = min((point for point in points if point[0] >= psnr), default=None)
    if below is None or above is None:
        return None
    if above[0] == below[0]:
        return min(below[1], above[1])
    share = (psnr - below[0]) / (above[0] - below[0])
    return math.exp((1.0 - share) * math.log(below[1]) + share * math.log(above[1]))


def size_ratios(before: Sequence[Row], now: Sequence[Row]) -> list[dict[str, Any]]:
    """Return the rows of now with `ratio`: bytes now over bytes before, at the PSNR of before.

    Files are compared within a scene and a `kind`: a case's field for cases that differ in their target alone. If all
    files of now lie on one side of that PSNR, a decibel counts 4.5 % of the bytes, and `estimated` is true.
    """
    rows = []
    for row in now:
        old = _find(before, row["scene"], row["case"])
        if old is None or "error" in row or "error" in old:
            rows.append({**row, "ratio": None})
            continue
        points = [
            (one["psnr"], one["size_bytes"])
            for one in now
            if one["scene"] == row["scene"] and one.get("kind") == row.get("kind") and "error" not in one
        ]
        size = bytes_at(points, old["psnr"])
        estimated = size is None
        if size is None:
            psnr, near = min(points, key=lambda point: abs(point[0] - old["psnr"]))
            size = near * math.exp(_BYTES_PER_DB * (old["psnr"] - psnr))
        rows.append({**row, "ratio": size / old["size_bytes"], "estimated": estimated})
    return rows


def mark_beaten(rows: Sequence[Row]) -> list[dict[str, Any]]:
    """Return the rows with `beaten_by`: the smallest file of the scene that is smaller by 1 % and better by 0.1 dB.

    A file that holds every splat (`all_splats`) is only beaten by others that do; `None` if no file beats it.
    """
    made = [row for row in rows if None not in (row.get("psnr"), row.get("size_bytes"))]

    def beats(other: Row, row: Row) -> bool:
        return bool(
            other["scene"] == row["scene"]
            and other["size_bytes"] < (1.0 - _SMALLER) * row["size_bytes"]
            and other["psnr"] > row["psnr"] + _BETTER
            and (other.get("all_splats", True) or not row.get("all_splats", True))
        )

    marked = []
    for row in rows:
        better = [other for other in made if beats(other, row)] if any(row is one for one in made) else []
        smallest = min(better, key=lambda other: other["size_bytes"], default=None)
        marked.append({**row, "beaten_by": None if smallest is None else smallest["case"]})
    return marked


def mean_rows(rows: Sequence[Row], group: str, keys: Sequence[str]) -> list[dict[str, Any]]:
    """Return the mean over scenes for every group and case.

    Args:
        rows: results.
        group: a field, such as the name of a benchmark set.
        keys: fields to average; a mean is `None` unless every scene has a value.
    """
    found: dict[tuple[Any, str], list[Row]] = {}
    for row in rows:
        if row.get(group) is not None:
            found.setdefault((row[group], row["case"]), []).append(row)
    means = []
    for (value, case), members in found.items():
        mean: dict[str, Any] = {"scene": f"mean of {len(members)}", "case": case, group: value}
        for key in keys:
            values = [row[key] for row in members if row.get(key) is not None]
            mean[key] = statistics.fmean(values) if len(values) == len(members) else None
        means.append(mean)
    return means


def _find(rows: Sequence[Row], scene: str, case: str) -> Row | None:
    return next((row for row in rows if (row["scene"], row["case"]) == (scene, case)), None)

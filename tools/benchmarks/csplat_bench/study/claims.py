"""What the published study claims, looked up in our rows, scene by scene."""

from __future__ import annotations

from typing import Literal, TypedDict

from csplat_bench.common.report import Table, laid_out
from csplat_bench.study.records import Known, Results

__all__ = ["CLAIMS", "claims", "format_claims"]

#: What is looked up by title, and under `holds` whether the claim does.
Numbers = dict[str, float]


class Claim(TypedDict):
    """Where a claim holds, in words, and what was looked up, by scene."""

    holds_where: str
    scenes: dict[str, Numbers]


#: Decibels against photographs that count as nothing.
FREE_DB = 0.1

#: PSNR against the source's own renders from which a change is hardly seen.
FREE_PSNR = 40.0

_MOST_GONE = 0.7  # of the splats: "80 %"
_FAILS_DB = 1.0

CLAIMS = {
    "SH 0 is free": "loss of SH 0 at most 0.1 dB against photographs, or 40 dB against the source",
    "τ = 0.005 removes 80 %": "more than 70 % of the splats are gone",
    "more pruning up to 0.02 costs nothing": "at SH 0, from τ 0.005 on, at most 0.1 dB, or 40 dB against the source",
    "SH 0 + pruning has the best ratio": "of the study's own rows, by its rule",
    "k-means fails without pruning": "its loss is above 1 dB against photographs, or below 40 dB against the source",
    "SH is the first place to save": "no other step saves as many bytes for less",
}


def claims(results: Results) -> dict[str, Claim]:
    """Look every claim up."""
    looks = (_sh_free, _most_gone, _more_is_free, _best_ratio, _kmeans_fails, _sh_first)
    found: dict[str, Claim] = {}
    for (claim, holds_where), look in zip(CLAIMS.items(), looks, strict=True):
        scenes = {name: look(one) for name, one in results.items() if "baseline" in one["rows"]}
        known = {name: numbers for name, numbers in scenes.items() if numbers is not None}
        found[claim] = {"holds_where": holds_where, "scenes": known}
    return found


def format_claims(found: dict[str, Claim], *, markdown: bool = False) -> str:
    """A table for each claim, or two: scenes with photographs have other figures than those without."""
    parts: list[Table] = []
    for claim, one in found.items():
        kinds: dict[tuple[str, ...], list[list[str]]] = {}
        for name, numbers in one["scenes"].items():
            titles = tuple(title for title in numbers if title != "holds")
            line = [name, *(_shown(numbers[title]) for title in titles), "yes" if numbers["holds"] else "no"]
            kinds.setdefault(titles, []).append(line)
        title = f"Claim: {claim} (holds where: {one['holds_where']})"
        for titles, lines in kinds.items():
            parts.append(Table(("", *titles, "holds"), lines, title))
            title = ""
    return laid_out(parts, markdown=markdown)


def _shown(value: float) -> str:
    return f"{value:.3g}" if abs(value) < 1.0 else f"{value:.2f}"


def _by_photographs(one: Known) -> bool:
    return "photographs" in one["facts"]["judged_by"]


def _loss(one: Known, name: str) -> tuple[str, float]:
    """What a row costs, and how to call it: decibels against photographs, or PSNR against the source."""
    row = one["rows"][name]
    if _by_photographs(one):
        return "dB lost", one["rows"]["baseline"]["psnr_mean"] - row["psnr_mean"]
    return "PSNR", float(row["psnr_mean"])


def _is_free(one: Known, name: str) -> bool:
    _, value = _loss(one, name)
    return value <= FREE_DB if _by_photographs(one) else value >= FREE_PSNR


def _has(one: Known, *names: str) -> bool:
    return all(name in one["rows"] for name in names)


def _named(one: Known, name: str, word: str) -> Numbers:
    title, value = _loss(one, name)
    return {f"{word}: {title}": value}


def _sh_free(one: Known) -> Numbers | None:
    if not _has(one, "SH 0", "SH 0 distilled"):
        return None
    rows = one["rows"]
    numbers = {**_named(one, "SH 0", "truncated"), **_named(one, "SH 0 distilled", "distilled")}
    scores: tuple[Literal["ssim", "lpips"], ...] = ("ssim", "lpips")
    for score in scores:
        before, after = rows["baseline"][score], rows["SH 0"][score]
        if before is not None and after is not None:
            numbers[f"{score.upper()} lost"] = abs(before - after)
    return {**numbers, "holds": _is_free(one, "SH 0")}


def _most_gone(one: Known) -> Numbers | None:
    if not _has(one, "SH 0, τ 0.005"):
        return None
    gone = {
        f"% gone at {tau}": 100.0 * (1.0 - one["rows"][f"SH 0, τ {tau}"]["splats"] / one["facts"]["splats"])
        for tau in ("0.005", "0.01", "0.02")
    }
    return {**gone, "holds": gone["% gone at 0.005"] > 100.0 * _MOST_GONE}


def _more_is_free(one: Known) -> Numbers | None:
    if not _has(one, "SH 0, τ 0.005"):
        return None
    before = "SH 0" if _has(one, "SH 0") else "baseline"
    psnr = {name: float(one["rows"][name]["psnr_mean"]) for name in (before, "SH 0, τ 0.005", "SH 0, τ 0.02")}
    step, more = psnr[before] - psnr["SH 0, τ 0.005"], psnr["SH 0, τ 0.005"] - psnr["SH 0, τ 0.02"]
    at = psnr["SH 0, τ 0.02"]
    unseen = not _by_photographs(one) and at >= FREE_PSNR
    numbers = {"dB lost up to 0.005": step, "dB lost from 0.005 to 0.02": more, "PSNR at 0.02": at}
    return {**numbers, "holds": more <= FREE_DB or unseen}


def _best_ratio(one: Known) -> Numbers | None:
    names = [name for name in ("SH 0", "SH 0, τ 0.005", "SH 0, τ 0.02", "k-means") if _has(one, name)]
    if "SH 0, τ 0.02" not in names or "k-means" not in names:
        return None
    whole, rows = one["facts"]["bytes"], one["rows"]
    ratios = {name: whole / rows[name]["study_bytes"] for name in names}
    numbers: Numbers = {}
    for name in ("SH 0, τ 0.02", "k-means"):
        numbers |= {f"{name}: ratio": ratios[name], **_named(one, name, name)}
    for name in ("file, small", "SH 0, τ 0.02, file, small"):
        if _has(one, name):
            numbers |= {f"{name}: ratio": whole / rows[name]["csplat_bytes"], **_named(one, name, name)}
    return {**numbers, "holds": ratios["SH 0, τ 0.02"] == max(ratios.values())}


def _kmeans_fails(one: Known) -> Numbers | None:
    if not _has(one, "k-means", "τ 0.02", "τ 0.02, k-means"):
        return None
    numbers = _named(one, "k-means", "alone")
    numbers |= _named(one, "τ 0.02, k-means", "after τ 0.02")
    numbers |= _named(one, "τ 0.02", "τ 0.02 alone")
    _, value = _loss(one, "k-means")
    return {**numbers, "holds": value > _FAILS_DB if _by_photographs(one) else value < FREE_PSNR}


def _sh_first(one: Known) -> Numbers | None:
    """SH 0 beside steps that leave SH alone: the share of the bytes that each takes away, and what it costs."""
    if not _has(one, "SH 0"):
        return None
    whole, rows = one["facts"]["bytes"], one["rows"]
    sizes = {"SH 0": rows["SH 0"]["study_bytes"]}
    sizes |= {name: rows[name]["study_bytes"] for name in ("τ 0.02",) if _has(one, name)}
    sizes |= {name: rows[name]["csplat_bytes"] for name in ("file, balanced", "file, small") if _has(one, name)}
    numbers: Numbers = {}
    for name, size in sizes.items():
        numbers |= {f"{name}: % saved": 100.0 * (1.0 - size / whole), **_named(one, name, name)}
    sign = 1.0 if _by_photographs(one) else -1.0
    cost = {name: sign * _loss(one, name)[1] for name in sizes}
    better = [name for name in sizes if name != "SH 0" and sizes[name] <= sizes["SH 0"] and cost[name] < cost["SH 0"]]
    return {**numbers, "holds": not better}

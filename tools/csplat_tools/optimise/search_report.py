# SPDX-License-Identifier: Apache-2.0
"""Make the report of a search for a target, and format it."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from csplat.encoder import SearchReport, Target
from csplat.errors import counted
from csplat.types import F64
from csplat_render.metrics import psnr_of_mse
from csplat_render.scorer import Scorer
from csplat_tools.console import format_bytes
from csplat_tools.optimise.candidates import Candidate, CandidatePool
from csplat_tools.views import VIRTUAL, describe_views

_NOTABLE = 0.5  # dB; more above the target is explained, and less on other views is pointed out


def format_search(report: SearchReport) -> tuple[str, ...]:
    """Format the report of a search as sentences for users."""
    goal = report.goal
    asked = [f"{name} within {bound:g}" for name, bound in goal.get("max_error", {}).items()]
    if "size" in goal:
        percentage = 100.0 * report.size_bytes / goal["size"]
        asked.append(f"{format_bytes(goal['size'])}; the file uses {percentage:.1f} %")
    if "psnr" in goal:
        asked.append(f"{goal['psnr']:g} dB on the validation views; the file has {report.validation_psnr:.2f} dB")
    if "keep" in goal:
        asked.append(f"{100.0 * goal['keep']:g} % of {counted(report.splats_before, 'splat')}")
    if "max_psnr_drop" in goal:
        asked.append(f"a drop of {goal['max_psnr_drop']:g} dB on the validation images")
    lines = [f"target: {'; '.join(asked)}"]
    if report.images:
        file, source = report.images["file"], report.images["source"]
        lines.append(f"test images: {file:.2f} dB, the source {source:.2f} dB")
    lines += [f"chosen: {line}" for line in report.why]
    if report.psnr is not None:
        lines.append(f"PSNR {report.psnr:.2f} dB on the test views, {report.sure}")
        is_virtual = report.views_of == VIRTUAL
        views = "virtual views that were not used in the search" if is_virtual else "views off the path of the cameras"
        lines += _format_elsewhere(report.psnr, report.elsewhere, views)
    cost = f"{counted(report.encodes, 'file')} tried"
    if report.renders:
        cost += f", {counted(report.renders, 'render')} scored"
    if report.sensitivity_views:
        cost += f", sensitivity measured in {counted(report.sensitivity_views, 'render')}"
    if report.pruning_views:
        cost += f", pruning error measured in {counted(report.pruning_views, 'small render')}"
    return (*lines, cost)


def _format_elsewhere(psnr: float, elsewhere: Mapping[str, float], views: str) -> list[str]:
    """Return a line on the PSNR by kind of other views, compared with `psnr` on test views; no line without any."""
    if not elsewhere:
        return []
    scores = ", ".join(f"{score:.2f} {kind}" for kind, score in elsewhere.items())
    less = psnr - min(elsewhere.values())
    worse = f": up to {less:.1f} dB less than on the test views" if less > _NOTABLE else ""
    return [f"PSNR on {views}: {scores}{worse}"]


def make_report(
    target: Target,
    found: Candidate,
    candidates: CandidatePool,
    test_scorer: Scorer,
    *,
    splats_before: int,
    views_of: str,
    remarks: Sequence[str],
    **numbers: Any,
) -> SearchReport:
    """Build the report of a search.

    Args:
        target: the target.
        found: the chosen file.
        candidates: all candidates.
        test_scorer: scorer on the test views.
        splats_before: number of splats of the scene.
        views_of: source of the test views: `virtual`, or a name.
        remarks: additional sentences for `why`.
        numbers: the other fields of `SearchReport`.
    """
    errors = test_scorer.errors(candidates.decode(found.result.data))
    found.test_psnr = psnr = psnr_of_mse(test_scorer.pooled(errors))
    spread = psnr_spread(errors)
    worst = min(psnr_of_mse(float(error)) for error in errors)
    many = describe_views(len(errors), views_of)
    sure = f"measured on the file itself, in {many}, which chose nothing: the worst has {worst:.2f} dB"
    if not math.isnan(spread):
        sure += f"; other such views would change the {psnr:.2f} dB by about {spread:.1f} (one standard deviation)"
    return SearchReport(
        goal=target.as_json(),
        size_bytes=found.size_bytes,
        splats=found.splats,
        splats_before=splats_before,
        psnr=psnr,
        validation_psnr=found.validation_psnr,
        worst_psnr=worst,
        spread=None if math.isnan(spread) else round(spread, 3),
        views=len(errors),
        views_of=views_of,
        renders=candidates.renders + len(errors),
        chosen=found.as_json(),
        tried=tuple(candidate.as_json() for candidate in candidates.made),
        why=(*_explain_choice(target, found, candidates, splats_before), *remarks),
        sure=sure,
        **numbers,
    )


def _explain_choice(target: Target, found: Candidate, candidates: CandidatePool, splats_before: int) -> list[str]:
    """Return sentences on the coding of SH, the alternatives, a PSNR above the target, and the pruned splats."""
    codings = list(
        dict.fromkeys(_describe_coding(candidate) for candidate in candidates.made if candidate.subset is found.subset)
    )
    if found.quality is None:
        lines = [f"{_describe_coding(found)}, at the precision of the preset {found.options.preset}"]
    else:
        attributes = f"each attribute keeps {found.quality:.1f} dB by itself: all steps follow from that"
        lines = [f"{_describe_coding(found)}; {attributes}"]
    if found.class_count > 1:
        lines.append(
            f"splats are sorted into {found.class_count} quantisation classes by importance, each with its own steps"
        )
    others = [coding for coding in codings if coding != _describe_coding(found)]
    if others:
        expected = "look worse" if target.size_bytes is not None else "take more"
        lines.append(f"tried for these splats, too, and expected to {expected}: {'; '.join(others)}")
    if target.psnr is not None and found.validation_psnr > target.psnr + _NOTABLE:
        lines.append("no smaller file of those tried reaches the target")
    pruned_count = splats_before - found.splats
    if pruned_count:
        percentage = 100.0 * pruned_count / splats_before
        splats = f"{counted(pruned_count, 'splat')} ({percentage:.0f} %)"
        lines.append(f"{splats} pruned, the others refitted to renders of the source")
    return lines


def _describe_coding(candidate: Candidate) -> str:
    """Describe how a candidate codes SH: bands, and codebook or single values."""
    options = candidate.result.report.options
    if options["sh_coding"] == "none":
        return "no SH bands" if candidate.subset.model.sh_degree else "no SH to code"
    bands = f"SH degree {options['sh_degree']}"
    if options["sh_coding"] == "codebook":
        return f"{bands} by a codebook of {options['codebook_size']}"
    adaptive = " by importance" if options["adaptive"] == 1.0 else ""
    return f"{bands} value by value{adaptive}"


def psnr_spread(errors: F64) -> float:
    """Return the standard deviation of a PSNR over other choices of views, in dB, by jackknife.

    Args:
        errors: [V] mean squared error by view.
    """
    if len(errors) < 2 or errors.sum() == 0.0:
        return math.nan
    without = (errors.sum() - errors) / (len(errors) - 1)
    decibels = 10.0 * np.log10(np.maximum(without, np.finfo(np.float64).tiny))
    return float(np.sqrt((len(errors) - 1) * np.mean(np.square(decibels - decibels.mean()))))

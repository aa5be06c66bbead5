"""Build the report of a search: the results, the files tried, the reasons for the choice, and its reliability."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

from csplat.errors import counted
from csplat_render.metrics import psnr_of_mse
from csplat_tools.optimise.report import Report
from csplat_tools.optimise.target import Target
from csplat_tools.optimise.trials import Trial, Trials, spread_of
from csplat_tools.views import counted_views

_FAR = 0.3  # dB: a PSNR that exceeds the target by more is explained


def reported(
    target: Target, found: Trial, trials: Trials, *, splats_before: int, views_of: str, remarks: Sequence[str],
    **numbers: Any,
) -> Report:  # fmt: skip
    """Build the report of a search.

    Args:
        target: the target.
        found: the chosen file.
        trials: all files that were tried.
        splats_before: number of splats of the scene.
        views_of: source of the test views: `virtual`, or a name.
        remarks: further sentences for `why`.
        numbers: the other fields of `Report`.
    """
    errors, spread = found.errors, spread_of(found.errors)
    worst = min(psnr_of_mse(float(error)) for error in errors)
    many = counted_views(len(errors), views_of)
    sure = (
        f"measured on the file itself, in {many}, which chose nothing but the precision: the worst has {worst:.2f} dB"
    )
    if not math.isnan(spread):
        sure += (
            f"; other such views would change the {found.psnr:.2f} dB by about {spread:.1f} (one standard deviation)"
        )
    return Report(
        goal=target.as_json(),
        size_bytes=found.size_bytes,
        splats=found.splats,
        splats_before=splats_before,
        psnr=found.psnr,
        worst_psnr=worst,
        spread=None if math.isnan(spread) else round(spread, 3),
        views=len(errors),
        views_of=views_of,
        renders=trials.renders,
        chosen=found.as_json(),
        tried=tuple(trial.as_json() for trial in trials.made),
        why=(*_why(target, found, trials, splats_before), *remarks),
        sure=sure,
        **numbers,
    )


def _why(target: Target, found: Trial, trials: Trials, splats_before: int) -> list[str]:
    """Return sentences on the coding of SH, the alternatives, and the number of pruned splats."""
    codings = list(dict.fromkeys(_coding(trial) for trial in trials.made if trial.part is found.part))
    if found.quality is None:
        lines = [f"{_coding(found)}, at the precision of the preset {found.options.preset}"]
    else:
        lines = [f"{_coding(found)}; each attribute keeps {found.quality:.1f} dB by itself: all steps follow from that"]
    if found.grades > 1:
        lines.append(f"splats are sorted into {found.grades} grades by what pictures lose, each with steps of its own")
    others = [coding for coding in codings if coding != _coding(found)]
    if others:
        expected = "look worse" if target.size_bytes is not None else "take more"
        lines.append(f"tried for these splats, too, and expected to {expected}: {'; '.join(others)}")
    if target.psnr is not None and found.psnr > target.psnr + _FAR:
        lines.append("no smaller file of those tried reaches the target")
    gone = splats_before - found.splats
    if gone:
        share = 100.0 * gone / splats_before
        lines.append(
            f"{counted(gone, 'splat')} ({share:.0f} %) left out, the others fitted to what the source looks like"
        )
    return lines


def _coding(trial: Trial) -> str:
    options = trial.result.report.options
    if options["sh_coding"] == "none":
        return "no SH bands" if trial.part.model.sh_degree else "no SH to code"
    bands = f"SH degree {options['sh_degree']}"
    if options["sh_coding"] == "codebook":
        return f"{bands} by a codebook of {options['codebook_size']}"
    adaptive = " by importance" if options["adaptive"] == 1.0 else ""
    return f"{bands} value by value{adaptive}"

"""What a search for a target has to say: what was asked, reached and tried, why this file, and how sure it is."""

from __future__ import annotations

import math
from typing import Any

from csplat.model import SplatModel
from csplat_render.metrics import psnr_of_mse
from csplat_tools.rate.targets import RateTarget
from csplat_tools.rate.trials import Trial, Trials, spread_of

__all__ = ["summary"]

_FAR = 0.3  # dB above a target


def summary(
    target: RateTarget,
    found: Trial,
    trials: Trials,
    source: SplatModel,
    *,
    removal_views: int,
    sensitivity_views: int,
    virtual: bool,
) -> dict[str, Any]:
    """Report a search, JSON-compatible.

    Args:
        target: what was asked.
        found: the file.
        trials: all that were tried.
        source: the scene.
        removal_views: small views in which the removal of splats was measured, counted pass by pass.
        sensitivity_views: views in which it was measured how precise splats have to be.
        virtual: the views are the virtual ones of `psnr`.
    """
    goal: dict[str, Any] = {"size_bytes": target.size_bytes, "psnr": target.psnr, "max_error": dict(target.max_error)}
    errors, spread = found.errors, spread_of(found.errors)
    each = [psnr_of_mse(float(error)) for error in errors]
    views = f"{len(errors)} {'virtual' if virtual else 'given'} view{'s' if len(errors) > 1 else ''}"
    sure = f"measured on the file itself, in {views}: the worst has {min(each):.2f} dB"
    if not math.isnan(spread):
        sure += (
            f", other such views would change the {found.psnr:.2f} dB by about {spread:.1f} (one standard deviation)"
        )
    return {
        "goal": {name: value for name, value in goal.items() if value},
        "size_bytes": found.size_bytes,
        "psnr": found.psnr,
        "splats": len(found.part.model),
        "splats_before": len(source),
        "chosen": found.as_json(),
        "why": _why(target, found, trials, source),
        "sure": sure,
        "spread": None if math.isnan(spread) else round(spread, 3),
        "worst_psnr": min(each),
        "views": len(errors),
        "renders": trials.renders,
        "removal_views": removal_views,
        "sensitivity_views": sensitivity_views,
        "tried": [trial.as_json() for trial in trials.made],
    }


def _why(target: RateTarget, found: Trial, trials: Trials, source: SplatModel) -> list[str]:
    """Sentences: how SH is coded and among what that was chosen, and how many splats went."""
    codings = list(dict.fromkeys(_coding(trial) for trial in trials.made if trial.part is found.part))
    lines = [f"{_coding(found)}, quality {found.quality:.1f}: all steps follow from it"]
    if found.grades > 1:
        lines.append(f"splats are sorted into {found.grades} grades by what pictures lose, each with steps of its own")
    others = [coding for coding in codings if coding != _coding(found)]
    if others:
        expected = "take more" if target.psnr is not None else "look worse"
        lines.append(f"tried for these splats, too, and expected to {expected}: {'; '.join(others)}")
    if target.psnr is not None and found.psnr > target.psnr + _FAR:
        lines.append("no smaller file of those tried reaches the target")
    gone = len(source) - len(found.part.model)
    if gone:
        share = 100.0 * gone / len(source)
        lines.append(f"{gone} splats ({share:.0f} %) are left out: their bits buy more elsewhere than pictures lose")
    return lines


def _coding(trial: Trial) -> str:
    options = trial.result.report.options
    if options["sh_coding"] == "none":
        return "no SH bands" if trial.part.model.sh_degree else "no SH to code"
    bands = f"SH degree {options['sh_degree']}"
    if options["sh_coding"] == "codebook":
        return f"{bands} by a codebook of {'+'.join(map(str, options['codebook_sizes']))}"
    adaptive = " by importance" if options["adaptive"] == 1.0 else ""
    return f"{bands} value by value{adaptive}"

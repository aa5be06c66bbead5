"""L4: renders of a file compared with those of its source."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

from csplat.decoder import DecodedScene
from csplat.model import SplatModel
from csplat_conformance.encoders.figures import beside, figures_of
from csplat_conformance.encoders.inputs import Input
from csplat_conformance.encoders.matching import Pairs
from csplat_conformance.encoders.verdict import Verdict
from csplat_conformance.report import Status
from csplat_conformance.stated import Source

#: PSNR in dB of a decoded scene against its source; the source comes first.
PictureJudge = Callable[[SplatModel, SplatModel], float]


def judge_pictures(
    one: Input,
    source: Source,
    scene: DecodedScene,
    pairs: Pairs,
    size_bytes: int,
    pictures: PictureJudge,
    psnr_min: float,
) -> Verdict:
    """Judge L4: renders of the file look like those of the source.

    Args:
        one: the input.
        source: the scene of the input.
        scene: the decoded scene.
        pairs: the source splat of each decoded splat.
        size_bytes: size of the file.
        pictures: compares.
        psnr_min: lowest PSNR to pass, dB; an input shifts it by its own difference from the default.
    """
    model, decoded = source.model(scene.model.origin), scene.model
    psnr = pictures(model, decoded)
    figures, wanted = figures_of(one.name), one.psnr_wanted(psnr_min)
    details = {"psnr": psnr, "wanted": wanted, "bytes": size_bytes, "beside": figures}
    size = f"in {size_bytes:,} bytes{beside(figures)}"
    if not psnr >= wanted:
        details["exact"] = exact = _exact(model, decoded, pairs, pictures)
        cost = ", ".join(f"{name} {value:.1f}" for name, value in exact.items())
        blame = f"; with the source's {cost}" if cost else ""
        return Verdict(Status.FAILED, f"{psnr:.2f} dB, wanted {wanted:g} at least, {size}{blame}", details=details)
    return Verdict(Status.PASSED, f"{psnr:.2f} dB {size}", details=details)


def _exact(source: SplatModel, decoded: SplatModel, pairs: Pairs, pictures: PictureJudge) -> dict[str, float]:
    """Return the PSNR with one attribute as exact as the source has it: what gains most is what costs most."""
    if pairs.strays or pairs.surplus:
        return {}
    theirs = source.select(pairs.source_index)
    changes: dict[str, dict[str, Any]] = {
        "means": {"means": theirs.means},
        "shapes": {"quats": theirs.quats, "scales": theirs.scales},
        "opacities": {"opacities": theirs.opacities},
        "colours": {"sh0": theirs.sh0, "shN": theirs.shN},
    }
    return {name: pictures(source, replace(decoded, **arrays)) for name, arrays in changes.items()}

"""L4: how a file looks, beside its source."""

from __future__ import annotations

from collections.abc import Callable

from csplat.decoder import Scene
from csplat.model import SplatModel
from csplat_conformance.encoders.figures import beside, figures_of
from csplat_conformance.encoders.inputs import Input
from csplat_conformance.encoders.verdict import Verdict
from csplat_conformance.report import Status
from csplat_conformance.stated import Source

__all__ = ["PictureJudge", "judge_pictures"]

#: PSNR in dB of a decoded scene against its source; the source comes first.
PictureJudge = Callable[[SplatModel, SplatModel], float]


def judge_pictures(
    one: Input, source: Source, scene: Scene, size_bytes: int, pictures: PictureJudge, psnr_min: float
) -> Verdict:
    """Judge L4: renders of the file look like those of the source.

    Args:
        one: the input.
        source: what it stands for.
        scene: what the file holds.
        size_bytes: of the file.
        pictures: compares.
        psnr_min: dB, that is asked; an input may want more or less by so much.
    """
    psnr = pictures(source.model(scene.model.origin), scene.model)
    figures, wanted = figures_of(one.name), one.psnr_wanted(psnr_min)
    details = {"psnr": psnr, "wanted": wanted, "bytes": size_bytes, "beside": figures}
    size = f"in {size_bytes:,} bytes{beside(figures)}"
    if not psnr >= wanted:
        return Verdict(Status.FAILED, f"{psnr:.2f} dB, wanted {wanted:g} at least, {size}", details=details)
    return Verdict(Status.PASSED, f"{psnr:.2f} dB {size}", details=details)

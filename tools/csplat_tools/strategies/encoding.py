"""Reduce and encode in one go, and state what that did to the source.

Bands that are distilled are fitted to the geometry as a decoder will see it. A clustered scene is written twice: the
errors that its file states are those against the source, which the encoder has not seen.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from csplat.decoder import decode
from csplat.encoder import EncodeOptions, EncodeResult
from csplat.encoder.between import Between
from csplat.encoder.measure import measured_sums
from csplat.encoder.pipeline import decide, write_decided
from csplat.model import SplatModel
from csplat_tools.strategies.reduction import Reduction, find_teacher, reduced_by, target_degree

if TYPE_CHECKING:
    from csplat_tools.strategies.distilling import Teacher
    from csplat_tools.views import ViewSet

__all__ = ["encode_reduced"]

F32 = NDArray[np.float32]
Progress = Callable[[str, float], None]

_KEY = "reduced"


def encode_reduced(
    source: SplatModel,
    reduction: Reduction,
    encoding: EncodeOptions | None = None,
    *,
    views: ViewSet | None = None,
    progress: Progress | None = None,
) -> EncodeResult:
    """Prune, take SH bands away, cluster, encode.

    Args:
        source: the scene.
        reduction: what is done to it. Its `sh_degree`, where it is None, is that of `encoding`.
        encoding: of the encoder.
        views: those that teach and those that check what is distilled; None for virtual ones.
        progress: is told the stages.

    Returns:
        The file, and which splat of the source each of its splats is. The file states its errors against the source;
        colours that were distilled have none, and the options say how good renders are.

    Raises:
        InputError: as `reduce_model` and the encoder.
    """
    encoding = encoding or EncodeOptions()
    if reduction.sh_degree is None:
        reduction = replace(reduction, sh_degree=encoding.sh_degree)
    degree = target_degree(source, reduction)
    encoding = replace(encoding, sh_degree=degree)
    teacher = find_teacher(source, reduction, views)
    clusters = reduction.kmeans is not None
    reduced = reduced_by(source, reduction, teacher if clusters else None, progress)
    between = Between(len(source), reduced.source_index, said=reduced.said, key=_KEY, refitted=teacher is not None)
    model = _with_bands(reduced.model, source.sh_degree) if clusters else source.select(reduced.source_index)
    if teacher is not None:
        between = _taught(between, teacher, None if clusters else degree, progress)
    decided = decide(model, encoding, between=between, progress=progress)
    if not clusters:
        return write_decided(decided, between=between, progress=progress)
    first = write_decided(decided, between=replace(between, figures=None), progress=progress)
    measured = measured_sums(source, decode(first.data), first.source_index)
    return write_decided(decided, between=between, measured=measured, progress=progress)


def _taught(between: Between, teacher: Teacher, degree: int | None, progress: Progress | None) -> Between:
    """Colours that are fitted to the quantised geometry, if a degree is given, and renders that are judged."""

    def colours(seen: SplatModel) -> tuple[F32, F32]:
        if degree is None:
            return seen.sh0, seen.shN
        taught = _with_bands(teacher.taught(seen, degree, progress), seen.sh_degree)
        return taught.sh0, taught.shN

    def figures(data: bytes) -> dict[str, Any]:
        return {"check_psnr": round(teacher.check.psnr(decode(data)), 3)}

    said = {**between.said, "views": len(teacher.cameras)}
    return replace(between, colours=colours, figures=figures, said=said)


def _with_bands(model: SplatModel, sh_degree: int) -> SplatModel:
    """The scene with zeros in further SH bands: the encoder is told of which degree the source was."""
    missing = (sh_degree + 1) ** 2 - 1 - model.shN.shape[1]
    zeros = np.zeros((len(model), missing, 3), np.float32)
    return replace(model, shN=np.concatenate([model.shN, zeros], axis=1))

"""Reduce and encode in one go, and state what that did to the source.

Bands that are distilled are fitted to the geometry as a decoder will see it. The errors that the file of a clustered
scene states are those against the source, which the encoder has not seen.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from csplat.decoder import decode
from csplat.encoder import Draft, EncodeOptions, EncodeResult, Origin
from csplat.model import SplatModel
from csplat_tools.files.console import Progress
from csplat_tools.study.reduction import Reduction, find_teacher, reduced_by, target_degree

if TYPE_CHECKING:
    from csplat_tools.views import ViewSet

__all__ = ["encode_reduced"]

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
    said, origin = dict(reduced.said), Origin(len(source), reduced.source_index, refitted=teacher is not None)
    model = _with_bands(reduced.model, source.sh_degree) if clusters else source.select(reduced.source_index)
    draft = Draft.of(model, encoding, origin=origin, progress=progress)
    if teacher is not None and not clusters:
        taught = _with_bands(teacher.taught(draft.scene, degree, progress), source.sh_degree)
        draft = draft.with_colours(taught.sh0, taught.shN)
    coded = draft.coded(progress)
    if teacher is not None or clusters:
        decoded = decode(coded.write().data)
        coded = coded.against(source, decoded) if clusters else coded
        if teacher is not None:
            said |= {"views": len(teacher.cameras), "check_psnr": round(teacher.check.psnr(decoded), 3)}
    return coded.write({_KEY: said})


def _with_bands(model: SplatModel, sh_degree: int) -> SplatModel:
    """The scene with zeros in further SH bands: the encoder is told of which degree the source was."""
    missing = (sh_degree + 1) ** 2 - 1 - model.shN.shape[1]
    zeros = np.zeros((len(model), missing, 3), np.float32)
    return replace(model, shN=np.concatenate([model.shN, zeros], axis=1))

"""Reduce and encode a scene in one step, with error bounds that refer to the source.

Distilled bands are fitted to the quantised geometry. The errors that the file of a clustered scene declares are those
against the source, which the encoder has not seen.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from csplat.decoder import decode
from csplat.encoder import Draft, EncodeOptions, EncodeResult, Origin
from csplat.model import SplatModel
from csplat.types import Progress
from csplat_tools.study.reduction import Reduction, find_teacher, reduced_by, target_degree

if TYPE_CHECKING:
    from csplat_tools.views import ViewSet


_KEY = "reduced"


def encode_reduced(
    source: SplatModel,
    reduction: Reduction,
    encoding: EncodeOptions | None = None,
    *,
    views: ViewSet | None = None,
    progress: Progress | None = None,
) -> EncodeResult:
    """Prune, leave out SH bands, cluster, and encode.

    Args:
        source: the scene.
        reduction: the steps. If its `sh_degree` is None, that of `encoding` is used.
        encoding: options of the encoder.
        views: training and validation views for distilling; None for virtual ones.
        progress: progress callback.

    Returns:
        The file, with the source splat of each of its splats. The file declares its errors against the source;
        distilled colours have none, and the options give the PSNR of renders.

    Raises:
        InputError: as for `reduce_model` and the encoder.
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
    """Return the scene with zeros in further SH bands, so that the encoder records the source's degree."""
    missing = (sh_degree + 1) ** 2 - 1 - model.shN.shape[1]
    zeros = np.zeros((len(model), missing, 3), np.float32)
    return replace(model, shN=np.concatenate([model.shN, zeros], axis=1))

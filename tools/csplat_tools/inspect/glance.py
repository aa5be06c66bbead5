"""Estimate the PSNR of `csplat compare` in a second, from smaller renders."""

from __future__ import annotations

from csplat.decoder import decode
from csplat.errors import CsplatError
from csplat.model import SplatModel
from csplat_render.camera import resized
from csplat_render.scorer import Scorer
from csplat_tools.views import comparison_cameras

#: Width and height of the renders, pixels; smaller ones average errors away: half of 640×480 gives 0.4 dB too much,
#: this 0.2 at most.
SIZE = (480, 360)
#: Largest number of splats: more take longer to render than a remark is worth.
SPLATS_MAX = 1_000_000


def glance(
    source: SplatModel, data: bytes, *, threads: int | None = None, splats_max: int = SPLATS_MAX
) -> float | None:
    """Return the approximate PSNR of a file against its source.

    The views are those of `csplat compare`, at another size.

    Args:
        source: the scene that was encoded.
        data: the file.
        threads: number of threads; `None` for all.
        splats_max: scenes of more splats are not rendered.

    Returns:
        PSNR in dB; `None` if there are no splats or too many, if the renderer is not compiled yet, which takes longer
        than the encoding, or if it cannot draw them.
    """
    from csplat_render.warmup import is_compiled  # requires numba

    if not 0 < len(source) <= splats_max or not is_compiled():
        return None
    try:
        cameras = [resized(camera, *SIZE) for camera in comparison_cameras(source)]
        return Scorer.of_source(source, cameras, threads=threads).psnr(decode(data, threads=threads))
    except (CsplatError, MemoryError):  # the file is written: this is a remark on it
        return None

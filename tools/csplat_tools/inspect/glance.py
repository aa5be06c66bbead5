"""What an encoding looks like, in a second: the PSNR of `csplat compare`, from smaller renders."""

from __future__ import annotations

from csplat.decoder import decode
from csplat.errors import CsplatError
from csplat.model import SplatModel
from csplat_render.cameras import resized
from csplat_render.judge import Judge
from csplat_tools.views import comparison_cameras

__all__ = ["SIZE", "SPLATS_MAX", "glance"]

#: Of the renders; smaller ones average what is wrong away: half of 640×480 says 0.4 dB more, this 0.2 at most.
SIZE = (480, 360)
#: More splats take longer to render than anybody wants to wait for a remark.
SPLATS_MAX = 1_000_000


def glance(
    source: SplatModel, data: bytes, *, threads: int | None = None, splats_max: int = SPLATS_MAX
) -> float | None:
    """About the PSNR of a file against its source.

    The views are those of `csplat compare`; only their size is another one.

    Args:
        source: what was encoded.
        data: the file.
        threads: how many; `None` for all.
        splats_max: larger scenes are not rendered.

    Returns:
        dB; `None` if there are no splats or too many, or if the renderer is not compiled yet, which takes longer than
        the encoding, or cannot draw them.
    """
    from csplat_render.warmup import is_compiled  # wants numba

    if not 0 < len(source) <= splats_max or not is_compiled():
        return None
    try:
        cameras = [resized(camera, *SIZE) for camera in comparison_cameras(source)]
        return Judge.of_source(source, cameras, threads=threads).psnr(decode(data, threads=threads))
    except (CsplatError, MemoryError):  # the file is written: this is a remark on it
        return None

"""Draw small renders of scenes."""

from __future__ import annotations

import io
from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np

from csplat.errors import CsplatError
from csplat.formats import format_of, open_scene
from csplat.model import SplatModel
from csplat.scene import joined
from csplat.training_record import TrainingRecord
from csplat_tools.files.extras import need_pictures, prepare_renderer
from csplat_tools.files.pictures import to_bytes
from csplat_tools.files.streams import write_bytes

#: Width and height of a thumbnail, pixels.
THUMBNAIL_SIZE = (128, 96)

_FINER = 2  # factor by which a thumbnail is drawn larger before it is averaged down
_JPEG_QUALITY = 85
_SPLATS_MAX = 300_000  # of scenes with more splats every Nth is drawn, scaled up to cover the same area


@cache
def prepare_thumbnails() -> bool:
    """Load the renderer; compile it, which takes up to a minute, if that was not done before.

    Returns:
        True if thumbnails can be drawn here; this requires the extra `render`.
    """
    try:
        need_pictures()
        prepare_renderer(quiet=True)
    except CsplatError:
        return False
    return True


def write_thumbnail(path: Path, scenes: Sequence[Path]) -> bool:
    """Draw a JPEG of the first of several files that is a scene.

    Returns:
        True if a thumbnail was written; it is optional, and no error is raised without one.
    """
    for scene in scenes:
        try:
            if scene.is_file():
                format_of(scene)
                path.parent.mkdir(parents=True, exist_ok=True)
                write_bytes(str(path), _jpeg(_thinned(scene)))
                return True
        except (CsplatError, OSError, MemoryError, ValueError, ArithmeticError):
            continue
    return False


def _jpeg(model: SplatModel) -> bytes:
    from PIL import Image

    from csplat_render import render
    from csplat_render.camera_paths import orbit_cameras

    width, height = THUMBNAIL_SIZE
    camera = orbit_cameras(model, 1, _FINER * width, _FINER * height)[0]
    said = TrainingRecord.of(model.metadata)
    picture = to_bytes(render(model, camera, background=said.background if said else (0.0, 0.0, 0.0), mode="fast").rgb)
    buffer = io.BytesIO()
    Image.fromarray(picture).resize(THUMBNAIL_SIZE, Image.Resampling.BOX).save(
        buffer, "JPEG", quality=_JPEG_QUALITY, optimize=True
    )
    return buffer.getvalue()


def _thinned(path: Path) -> SplatModel:
    """Read a scene, or every Nth splat of a large one, scaled up to cover as much."""
    with open_scene(path) as scene:
        step = max(1, -(-scene.count // _SPLATS_MAX))
        facts = replace(scene.facts, extra={}) if scene.facts.extra else scene.facts
        blocks = []
        for place, block in scene.numbered():
            first = -place.start % step
            kept = block.select(slice(first, None, step))
            blocks.append(replace(kept, extra={}, scales=kept.scales + np.float32(0.5 * np.log(step))))
        return joined(facts, blocks)

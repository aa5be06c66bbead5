"""The HTML report of a batch, `index.html`, and its thumbnails."""

from __future__ import annotations

import base64
import io
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from csplat.errors import CsplatError
from csplat.formats import detect_format, open_scene
from csplat.model import SplatModel
from csplat.scene_source import join_blocks
from csplat.training_record import TrainingRecord
from csplat_tools import html_report as html
from csplat_tools.batches.journal import JOURNAL, Record
from csplat_tools.batches.scene_job import THUMBNAILS
from csplat_tools.console import format_bytes, format_seconds
from csplat_tools.file_streams import write_bytes
from csplat_tools.optional_packages import prepare_renderer, require_images
from csplat_tools.render_files import to_uint8

PAGE = "index.html"
_THUMBNAILS_MAX = 1000  # thumbnails on the page, 4 kB each
_NUMBERS = ("splats", "source, kB", "output, kB", "output, %", "bytes per splat", "seconds", "memory, MB")


def write_batch_page(records: Sequence[Record], folder: Path) -> None:
    """Write the report into the folder of outputs.

    Raises:
        OSError: the report cannot be written.
    """
    write_bytes(str(folder / PAGE), make_batch_page(records, folder).encode())


def make_batch_page(records: Sequence[Record], folder: Path) -> str:
    """Return the report: totals, failed scenes, and a table of the others, with thumbnails."""
    done = [one for one in records if one.state == "done"]
    failed = [(one.path, one.code, one.error) for one in records if one.state == "failed"]
    failures = html.table(("scene", "code", "error"), failed, words=(1, 2)) if failed else ""
    title = f"{folder.resolve().name}: {len(records):,} scenes"
    parts = [
        html.definitions(_totals(records, done)),
        f'<p class="quiet">The same as JSON: {JOURNAL}.</p>',
        html.section("Failed", failures),
        html.section("Done", _scenes(done, folder)),
    ]
    return html.document(title, parts)


def _totals(records: Sequence[Record], done: Sequence[Record]) -> dict[str, str]:
    source, output = (sum(getattr(one, name) or 0 for one in done) for name in ("source_bytes", "output_bytes"))
    commands = sorted({" ".join(("csplat", *one.command)) for one in records})
    return {
        "done": f"{len(done):,} of {len(records):,}",
        "command": "; ".join(commands[:3]) + ("; ..." if len(commands) > 3 else ""),
        "splats": f"{sum(one.splats or 0 for one in done):,}",
        "bytes": f"{format_bytes(source)} -> {format_bytes(output)}" + (f", {output / source:.1%}" if source else ""),
        "time of all processes": format_seconds(sum(one.seconds or 0.0 for one in done)),
        "peak memory of a process": format_bytes(max((one.memory_bytes or 0 for one in done), default=0)),
        "version": ", ".join(sorted({one.version for one in records})),
    }


def _scenes(done: Sequence[Record], folder: Path) -> str:
    if not done:
        return ""
    thumbnails = [_thumbnail_image(one, folder) for one in done[:_THUMBNAILS_MAX]] + [""] * len(done[_THUMBNAILS_MAX:])
    heads = [html.Head("", kind="html"), html.Head("scene", kind="name"), *map(html.Head, _NUMBERS)]
    rows: list[list[Any]] = [
        [thumbnail, (one.output, one.path), *_numbers(one)] for one, thumbnail in zip(done, thumbnails, strict=True)
    ]
    if not any(thumbnails):
        heads, rows = heads[1:], [row[1:] for row in rows]
    return f"{html.paragraph('A click on a heading sorts.')}\n{html.sortable_table(heads, rows)}"


def _numbers(one: Record) -> list[tuple[str, float | None]]:
    """Return text and value of the columns `_NUMBERS`."""
    source, output, splats = one.source_bytes, one.output_bytes, one.splats
    numbers = (
        (splats, "{:,.0f}"),
        (None if source is None else source / 1e3, "{:,.1f}"),
        (None if output is None else output / 1e3, "{:,.1f}"),
        (100.0 * output / source if source and output is not None else None, "{:.1f}"),
        (output / splats if splats and output is not None else None, "{:.2f}"),
        (one.seconds, "{:.2f}"),
        (None if one.memory_bytes is None else one.memory_bytes / 1e6, "{:,.0f}"),
    )
    return [("" if value is None else form.format(value), value) for value, form in numbers]


def _thumbnail_image(one: Record, folder: Path) -> str:
    with suppress(OSError):
        data = base64.b64encode((folder / THUMBNAILS / f"{one.output}.jpg").read_bytes()).decode()
        width, height = THUMBNAIL_SIZE
        return f'<img src="data:image/jpeg;base64,{data}" width="{width}" height="{height}" alt="" loading="lazy">'
    return ""


#: Width and height of a thumbnail, pixels.
THUMBNAIL_SIZE = (128, 96)

_FINER = 2  # factor by which a thumbnail is drawn larger before it is averaged down
_JPEG_QUALITY = 85
_SPLATS_MAX = 300_000  # splats to draw; of larger scenes every Nth, scaled up to cover the same area


@cache
def prepare_thumbnails() -> bool:
    """Load the renderer, and compile it if necessary, which takes up to a minute.

    Returns:
        True if thumbnails can be drawn here; this requires the extra `render`.
    """
    try:
        require_images()
        prepare_renderer(quiet=True)
    except CsplatError:
        return False
    return True


def write_thumbnail(path: Path, scenes: Sequence[Path]) -> bool:
    """Draw a JPEG of the first of several files that is a valid scene.

    Returns:
        True if a thumbnail was written. Errors are not raised, since thumbnails are optional.
    """
    for scene in scenes:
        try:
            if scene.is_file():
                detect_format(scene)
                path.parent.mkdir(parents=True, exist_ok=True)
                write_bytes(str(path), _jpeg(_read_every_nth(scene)))
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
    training = TrainingRecord.of(model.metadata)
    background = training.background if training else (0.0, 0.0, 0.0)
    thumbnail = to_uint8(render(model, camera, background=background, mode="fast").rgb)
    buffer = io.BytesIO()
    Image.fromarray(thumbnail).resize(THUMBNAIL_SIZE, Image.Resampling.BOX).save(
        buffer, "JPEG", quality=_JPEG_QUALITY, optimize=True
    )
    return buffer.getvalue()


def _read_every_nth(path: Path) -> SplatModel:
    """Read a scene, or every Nth splat of a large one, scaled up to cover the same area."""
    with open_scene(path) as scene:
        step = max(1, -(-scene.count // _SPLATS_MAX))
        metadata_model = replace(scene.metadata_model, extra={}) if scene.metadata_model.extra else scene.metadata_model
        blocks = []
        for place, block in scene.numbered():
            first = -place.start % step
            kept = block.select(slice(first, None, step))
            blocks.append(replace(kept, extra={}, scales=kept.scales + np.float32(0.5 * np.log(step))))
        return join_blocks(metadata_model, blocks)

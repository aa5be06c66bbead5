"""Write `index.html`, the HTML report of a batch, and draw the thumbnails that it shows."""

from __future__ import annotations

import base64
import io
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from functools import cache
from html import escape
from pathlib import Path

import numpy as np

from csplat.errors import CsplatError
from csplat.formats import detect_format, open_scene
from csplat.model import SplatModel
from csplat.scene_source import join_blocks
from csplat.training_record import TrainingRecord
from csplat_tools.batches.journal import JOURNAL, Record
from csplat_tools.batches.scene_job import THUMBNAILS
from csplat_tools.console import format_bytes, format_seconds
from csplat_tools.file_streams import write_bytes
from csplat_tools.html_report import definitions, document, table
from csplat_tools.optional_packages import prepare_renderer, require_images
from csplat_tools.render_files import to_uint8

PAGE = "index.html"
_THUMBNAILS_MAX = 1000  # thumbnails on the page, 4 kB each
_HEADS = ("scene", "splats", "source, kB", "output, kB", "share, %", "bytes per splat", "seconds", "memory, MB")


def write_batch_page(records: Sequence[Record], folder: Path) -> None:
    """Write the page of a folder of outputs.

    Raises:
        OSError: it cannot be written.
    """
    write_bytes(str(folder / PAGE), make_batch_page(records, folder).encode())


def make_batch_page(records: Sequence[Record], folder: Path) -> str:
    """Return the page: totals, scenes that failed, and a table of all scenes that are done, with thumbnails."""
    done = [one for one in records if one.state == "done"]
    title = f"{folder.resolve().name}: {len(records):,} scenes"
    return document(
        title, [f"<h1>{escape(title)}</h1>", _totals(records, done), _failures(records), _scenes(done, folder)]
    )


def _totals(records: Sequence[Record], done: Sequence[Record]) -> str:
    source, output = (sum(getattr(one, name) or 0 for one in done) for name in ("source_bytes", "output_bytes"))
    seconds = sum(one.seconds or 0.0 for one in done)
    commands = sorted({" ".join(("csplat", *one.command)) for one in records})
    entries = {
        "done": f"{len(done):,} of {len(records):,}",
        "command": "; ".join(commands[:3]) + ("; ..." if len(commands) > 3 else ""),
        "splats": f"{sum(one.splats or 0 for one in done):,}",
        "bytes": f"{format_bytes(source)} -> {format_bytes(output)}" + (f", {output / source:.1%}" if source else ""),
        "work": f"{format_seconds(seconds)}, of all processes together",
        "most memory of one": format_bytes(max((one.memory_bytes or 0 for one in done), default=0)),
        "version": ", ".join(sorted({one.version for one in records})),
    }
    return definitions(entries) + f'\n<p class="quiet">All of it, for programs: {JOURNAL}.</p>'


def _failures(records: Sequence[Record]) -> str:
    rows = [(one.path, one.code, one.error) for one in records if one.state == "failed"]
    return f"<h2>Failed</h2>\n{table(('scene', 'code', 'why'), rows, words=(1, 2))}" if rows else ""


def _scenes(done: Sequence[Record], folder: Path) -> str:
    if not done:
        return ""
    thumbnails = [_thumbnail_image(one, folder) for one in done[:_THUMBNAILS_MAX]] + [""] * len(done[_THUMBNAILS_MAX:])
    heads = '<th scope="col"></th>' * any(thumbnails) + "".join(
        f'<th scope="col"{_kind(place)}><button type="button">{escape(head)}</button></th>'
        for place, head in enumerate(_HEADS)
    )
    rows = "\n".join(
        f"<tr>{f'<td>{thumbnail}</td>' * any(thumbnails)}{_cells(one)}</tr>"
        for one, thumbnail in zip(done, thumbnails, strict=True)
    )
    return (
        "<h2>Done</h2>\n<p>A click on a heading sorts.</p>\n"
        f'<div class="scroll"><table class="sortable"><thead><tr>{heads}</tr></thead><tbody>\n{rows}\n'
        "</tbody></table></div>"
    )


def _kind(place: int) -> str:
    return "" if place else ' class="name" data-kind="text"'


def _cells(one: Record) -> str:
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
    name = f'<td class="name" data-value="{escape(one.output)}" title="{escape(one.path)}">{escape(one.output)}</td>'
    return name + "".join(
        f'<td data-value="{"" if value is None else f"{value:.6g}"}">{"" if value is None else form.format(value)}</td>'
        for value, form in numbers
    )


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
_SPLATS_MAX = 300_000  # of scenes with more splats every Nth is drawn, scaled up to cover the same area


@cache
def prepare_thumbnails() -> bool:
    """Load the renderer; compile it, which takes up to a minute, if that was not done before.

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
    """Draw a JPEG of the first of several files that is a scene.

    Returns:
        True if a thumbnail was written; it is optional, and no error is raised without one.
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
    """Read a scene, or every Nth splat of a large one, scaled up to cover as much."""
    with open_scene(path) as scene:
        step = max(1, -(-scene.count // _SPLATS_MAX))
        metadata_model = replace(scene.metadata_model, extra={}) if scene.metadata_model.extra else scene.metadata_model
        blocks = []
        for place, block in scene.numbered():
            first = -place.start % step
            kept = block.select(slice(first, None, step))
            blocks.append(replace(kept, extra={}, scales=kept.scales + np.float32(0.5 * np.log(step))))
        return join_blocks(metadata_model, blocks)

# SPDX-License-Identifier: Apache-2.0
"""The HTML report on a file: `csplat info --page`."""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from html import escape
from mmap import mmap
from pathlib import PurePath

from csplat.context import DEFAULT_CONTEXT, Context
from csplat.decoder import DeclaredBounds, decode
from csplat.types import null_progress
from csplat_tools import html_report as html
from csplat_tools.console import format_bytes
from csplat_tools.file_streams import STANDARD_STREAM, write_text
from csplat_tools.inspect.file_description import (
    FileDescription,
    describe_coding,
    describe_scene,
    format_headline,
    other_metadata,
)
from csplat_tools.scene_files import load_scene

_ATTRIBUTES = {
    "opacities": "opacity of each splat",
    "scales": "size along its three axes",
    "quats": "rotation",
    "means": "position of its centre",
    "sh0": "colour, independent of the view direction",
    "sh1": "change of colour with the view direction, coarse",
    "sh2": "the same, finer",
    "sh3": "the same, finer still",
    "sh4": "the same, finest",
    "overhead": "header, index, frames and metadata",
}
_LAYERS = {
    "geometry": "everything but view-dependent colour: a viewer shows the scene when it has this layer",
    "sh1": "first band of view-dependent colour, fetched afterwards",
    "sh2": "second band",
    "sh3": "third band",
    "sh4": "fourth band",
}
_MEASURES = {
    "means": "distance between the centres, in scene units",
    "covariance": "relative change of the shape: 0.01 is one per cent",
    "opacities": "change of alpha, 0 to 1",
    "sh0": "base colour; times 0.28 it is brightness, 0 to 1: 0.014 is one step of an 8-bit image",
    "sh1": "first band of the change of colour with the view direction",
    "sh2": "second band",
    "sh3": "third band",
    "sh4": "fourth band",
}
_CHECK = "<code>csplat verify FILE --source SCENE</code> checks them."
_SCENE = {
    "axes": "directions of +x, +y and +z: Right, Left, Up, Down, Forward, Back",
    "up": "the up direction",
    "unit": "length of one unit of the scene",
    "origin": "reference of positions",
    "tiles": "parts that decode independently",
    "first view": "camera from which a viewer first shows the scene",
}


@dataclass(frozen=True)
class _SourceComparison:
    """The comparison with the source, as text and HTML."""

    measurements: dict[str, str]
    images: str


def write_page(
    path: str,
    name: str,
    data: bytes | mmap,
    description: FileDescription,
    source: str | None = None,
    *,
    context: Context = DEFAULT_CONTEXT,
) -> None:
    """Write the report.

    Args:
        path: path of the report.
        name: name of the described file, or `-`.
        data: its bytes.
        description: its description.
        source: a scene to compare it with, which requires the renderer.
        context: threads and progress of the comparison.

    Raises:
        CsplatError: the file or the source is not valid.
        OSError: the source cannot be read, or the report cannot be written.
    """
    title = "standard input" if name == STANDARD_STREAM else PurePath(name).name
    comparison = None if source is None else _compare_with_source(data, source, context)
    write_text(path, make_page(title, description, comparison))


def make_page(title: str, description: FileDescription, comparison: _SourceComparison | None = None) -> str:
    """Return the report as HTML: the same for the same file and source."""
    parts = [
        _bytes_section(description),
        _layers_section(description),
        _bounds_section(description.declared_bounds),
        _scene_section(description),
    ]
    if comparison is not None:
        measured, images = html.definitions(comparison.measurements), comparison.images
        parts.insert(0, html.section("Comparison with the source", measured, "<h3>The hardest place</h3>", images))
    summary = f"{description.header.splat_count:,} splats; {format_headline(description)}"
    return html.document(f"{title}: content", parts, summary)


def _compare_with_source(data: bytes | mmap, source: str, context: Context) -> _SourceComparison:
    """Score renders of the file on the views of `psnr`, and find the hardest place in views that show the scene.

    Args:
        data: bytes of the file.
        source: path of the source, or `-`.
        context: threads and progress.

    Raises:
        CsplatError: the file or the source is not valid.
        OSError: the source cannot be read.
    """
    from csplat_render.scorer import Scorer
    from csplat_tools.views import display_cameras, find_view_set

    loaded, model = load_scene(source), decode(data, context=context)
    views = find_view_set(loaded.model(), count=0)
    hardest, shown = html.HardestPlaceSearch(), display_cameras(loaded.model(), views)
    scores = views.test_scorer(loaded.model(), context=context).scores(model, progress=context.progress)
    quiet = replace(context, progress=null_progress)
    showing = Scorer.of_source(loaded.model(), shown, views.test_background, context=quiet)
    showing.scores(model, ssim=False, on_view=hardest.examine)
    place = hardest.found()
    assert place is not None
    name = "standard input" if source == STANDARD_STREAM else PurePath(source).name
    measurements = {
        "source": f"{name}: {len(loaded.model()):,} splats, {format_bytes(loaded.size_bytes)},"
        f" {loaded.size_bytes / len(data):.1f} times the bytes of the file",
        "PSNR": f"{scores.psnr:.2f} dB: similarity of renders of the file and of the source, from"
        f" {len(scores.each)} views all around; at 30 dB a difference is visible, at 40 dB hardly",
        "worst view": f"{scores.psnr_worst:.2f} dB",
        "SSIM": f"{scores.ssim:.4f}: structural similarity, 1 at best",
    }
    images = f"{html.paragraph(html.IMAGES_NOTE)}\n{html.piece_images(place, 'the file')}"
    return _SourceComparison(measurements, images)


def _bytes_section(description: FileDescription) -> str:
    """Return the section on the bytes of each attribute, and of everything else as "overhead"."""
    sizes = {name: attribute.size_bytes for name, attribute in description.attributes.items()}
    sizes["overhead"] = sum(description.overhead.values())
    rows = [
        (
            name,
            _ATTRIBUTES.get(name, ""),
            f"{attribute.size_bytes:,}",
            _format_bits(attribute.bits_per_splat),
            describe_coding(attribute),
        )
        for name, attribute in description.attributes.items()
    ]
    overhead = ", ".join(f"{name} {number}" for name, number in description.overhead.items())
    rows.append(("overhead", _ATTRIBUTES["overhead"], f"{sizes['overhead']:,}", "", overhead))
    head = ("attribute", "meaning", "bytes", "bits per splat", "coding")
    return html.section("Bytes by attribute", html.attribute_figure(sizes), html.table(head, rows, words=(1, 4)))


def _layers_section(description: FileDescription) -> str:
    """Return the section on the layers; empty if the file has none."""
    size = description.header.file_size
    rows = [
        (name, _LAYERS.get(name, ""), f"{layer.size_bytes:,}", f"{100.0 * layer.size_bytes / size:.1f} %")
        for name, layer in description.layers.items()
    ]
    head = ("layer", "content", "bytes", "share of the file")
    return html.section("Layers, in order of arrival", html.table(head, rows, words=(1,)) if rows else "")


def _bounds_section(bounds: DeclaredBounds | None) -> str:
    """Return the section on declared error bounds; empty if there are none."""
    if bounds is None:
        return ""
    text = (
        f"The file was made from a source of {bounds.source_count:,} splats of SH degree {bounds.source_sh_degree};"
        f" {bounds.pruned_count:,} of them were pruned. For the others it declares error bounds: the largest error of"
        " any splat, and the root mean square (rms)."
    )
    if bounds.refitted:
        text += " Some attributes were refitted to renders of the source: they have no bounds."
    rows = [
        (record.measure, _MEASURES.get(record.measure, ""), f"{record.max:.4g}", f"{record.rms:.4g}")
        for record in bounds.records
    ]
    errors = html.table(("error of", "meaning", "largest", "rms"), rows, words=(1,)) if rows else ""
    return html.section("Declared error bounds", f"<p>{escape(text)} {_CHECK}</p>", errors)


def _scene_section(description: FileDescription) -> str:
    """Return the section on the scene, its options and other metadata."""
    words = {
        (f"{name} ({_SCENE[name]})" if name in _SCENE else name): value
        for name, value in describe_scene(description).items()
    }
    for title, value in (("options of the encoder", description.options), ("metadata", other_metadata(description))):
        if value:
            words[title] = json.dumps(value, sort_keys=True, ensure_ascii=False)
    return html.section("The scene", html.definitions(words))


def _format_bits(value: float | None) -> str:
    """Format a number of bits to two decimals; empty if it is unknown."""
    return "" if value is None else f"{value:.2f}"

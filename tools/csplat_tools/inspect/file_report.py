"""Write the HTML report on a file: `csplat info --page`."""

from __future__ import annotations

import json
from dataclasses import dataclass
from html import escape
from mmap import mmap
from pathlib import PurePath

from csplat.decoder import DeclaredBounds, decode
from csplat.types import Progress
from csplat_tools.console import format_bytes
from csplat_tools.file_streams import STANDARD_STREAM, write_bytes
from csplat_tools.html_report import attribute_figure, definitions, document, table
from csplat_tools.inspect.file_description import (
    FileDescription,
    describe_coding,
    describe_scene,
    format_headline,
    other_metadata,
)
from csplat_tools.scene_files import LoadedModel, load_model

_ATTRIBUTES = {
    "opacities": "opacity of each splat",
    "scales": "size along its three axes",
    "quats": "rotation",
    "means": "position of its centre",
    "sh0": "its colour, independent of the view direction",
    "sh1": "change of colour with the view direction, coarse",
    "sh2": "the same, finer",
    "sh3": "the same, finest",
    "overhead": "header, index, frames, and metadata of the file",
}
_LAYERS = {
    "geometry": "everything but view-dependent colour: a viewer shows the scene when it has arrived",
    "sh1": "first band of view-dependent colour, fetched afterwards",
    "sh2": "second band",
    "sh3": "third band",
}
_MEASURES = {
    "means": "distance by which a centre has moved, in scene units",
    "covariance": "relative change of a splat's shape: 0.01 is one per cent",
    "opacities": "change of its alpha, 0 to 1",
    "sh0": "its base colour; times 0.28 it is brightness, 0 to 1: 0.014 is one step of an 8-bit image",
    "sh1": "first band of the change of colour with the view direction",
    "sh2": "second band",
    "sh3": "third band",
}
_CHECK = "<code>csplat verify FILE --source SCENE</code> checks that."
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
    progress: Progress | None = None,
) -> None:
    """Write the report.

    Args:
        path: path of the report.
        name: name of the file that it describes, or `-`.
        data: the file.
        description: the file's description of itself.
        source: a scene to compare it with, which requires the renderer.
        progress: progress callback of the comparison.

    Raises:
        CsplatError: the file or the source is not valid.
        OSError: the source cannot be read, or the report cannot be written.
    """
    title = "standard input" if name == STANDARD_STREAM else PurePath(name).name
    comparison = None if source is None else _compare(data, source, progress)
    write_bytes(path, make_page(title, description, comparison).encode())


def make_page(title: str, description: FileDescription, comparison: _SourceComparison | None = None) -> str:
    """Return the report as HTML: the same for the same file and source."""
    summary = f"{description.header.splat_count:,} splats; {format_headline(description)}"
    return document(
        f"{title}: content",
        [
            f'<h1>{escape(title)}</h1>\n<p class="quiet">{escape(summary)}</p>',
            _source(comparison),
            _bytes(description),
            _layers(description),
            "" if description.declared_bounds is None else _bounds(description.declared_bounds),
            _scene(description),
        ],
    )


def _compare(data: bytes | mmap, source: str, progress: Progress | None) -> _SourceComparison:
    """Render file and source: from the views of `psnr` for scores, and from others to find the hardest place."""
    from csplat_render.scorer import Scorer
    from csplat_tools.hardest_place import IMAGES_NOTE, HardestPlaceSearch, piece_images
    from csplat_tools.views import display_cameras, find_view_set

    loaded, model = load_model(source), decode(data)
    views = find_view_set(loaded.model, count=0)
    hardest, shown = HardestPlaceSearch(), display_cameras(loaded.model, views)
    scores = views.test_scorer(loaded.model).scores(model, progress=progress)
    showing = Scorer.of_source(loaded.model, shown, views.test_background)
    showing.scores(model, ssim=False, on_view=hardest.examine)
    place = hardest.found()
    assert place is not None
    measurements = {
        "source": _source_text(source, loaded, len(data)),
        "PSNR": f"{scores.psnr:.2f} dB: likeness of renders of the file and of the source, from"
        f" {len(scores.each)} views all around; at 30 a difference is visible, at 40 hardly",
        "worst view": f"{scores.psnr_worst:.2f} dB",
        "SSIM": f"{scores.ssim:.4f}: likeness of structure, 1 at best",
    }
    return _SourceComparison(measurements, f"<p>{escape(IMAGES_NOTE)}</p>\n{piece_images(place, 'the file')}")


def _source_text(path: str, source: LoadedModel, size_bytes: int) -> str:
    name = "standard input" if path == STANDARD_STREAM else PurePath(path).name
    times = f"{source.size_bytes / size_bytes:.1f} times as many bytes"
    return f"{name}: {len(source.model):,} splats, {format_bytes(source.size_bytes)}, {times}"


def _source(comparison: _SourceComparison | None) -> str:
    if comparison is None:
        return ""
    measurements = definitions(comparison.measurements)
    return f"<h2>Compared with its source</h2>\n{measurements}\n<h3>The hardest place</h3>\n{comparison.images}"


def _bytes(description: FileDescription) -> str:
    sizes = {name: one.size_bytes for name, one in description.attributes.items()}
    sizes["overhead"] = sum(description.overhead.values())
    rows = [
        (name, _ATTRIBUTES.get(name, ""), f"{one.size_bytes:,}", _bits(one.bits_per_splat), describe_coding(one))
        for name, one in description.attributes.items()
    ]
    overhead = ", ".join(f"{name} {number}" for name, number in description.overhead.items())
    rows.append(("overhead", _ATTRIBUTES["overhead"], f"{sizes['overhead']:,}", "", overhead))
    head = ("attribute", "meaning", "bytes", "bits per splat", "coding")
    return f"<h2>Bytes by attribute</h2>\n{attribute_figure(sizes)}\n{table(head, rows, words=(1, 4))}"


def _layers(description: FileDescription) -> str:
    rows = [
        (
            name,
            _LAYERS.get(name, ""),
            f"{one.size_bytes:,}",
            f"{100.0 * one.size_bytes / description.header.file_size:.1f} %",
        )
        for name, one in description.layers.items()
    ]
    head = ("layer", "content", "bytes", "share of the file")
    return f"<h2>Layers, in order of arrival</h2>\n{table(head, rows, words=(1,))}" if rows else ""


def _bounds(bounds: DeclaredBounds) -> str:
    text = (
        f"The file was made from a source of {bounds.source_count:,} splats of SH degree {bounds.source_sh_degree};"
        f" {bounds.pruned_count:,} of them were pruned. For the others it declares error bounds:"
        " no splat has more than the largest error; rms is the root of the mean square."
    )
    if bounds.refitted:
        text += (
            " Some attributes were refitted to renders of the source: they have no bounds, and are checked by renders."
        )
    rows = [(one.measure, _MEASURES.get(one.measure, ""), f"{one.max:.4g}", f"{one.rms:.4g}") for one in bounds.records]
    errors = table(("error of", "meaning", "largest", "rms"), rows, words=(1,)) if rows else ""
    return f"<h2>Declared error bounds</h2>\n<p>{escape(text)} {_CHECK}</p>\n{errors}"


def _scene(description: FileDescription) -> str:
    words = {
        (f"{name} ({_SCENE[name]})" if name in _SCENE else name): value
        for name, value in describe_scene(description).items()
    }
    for title, value in (("options of the encoder", description.options), ("metadata", other_metadata(description))):
        if value:
            words[title] = json.dumps(value, sort_keys=True, ensure_ascii=False)
    return f"<h2>The scene</h2>\n{definitions(words)}"


def _bits(value: float | None) -> str:
    return "" if value is None else f"{value:.2f}"

"""The HTML report on a file: `csplat info --page`."""

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
    "opacities": "how dense each splat is",
    "scales": "how large along its three axes",
    "quats": "how it is turned",
    "means": "where its centre is",
    "sh0": "its colour, the same from everywhere",
    "sh1": "how the colour changes with the direction of view, coarsely",
    "sh2": "the same, finer",
    "sh3": "the same, finest",
    "overhead": "header, index, frames, and what is said of the whole file",
}
_LAYERS = {
    "geometry": "everything but how colours change: a viewer shows the scene as soon as it is there",
    "sh1": "first band of that change, fetched afterwards",
    "sh2": "second band",
    "sh3": "third band",
}
_MEASURES = {
    "means": "how far a centre has moved, in units of the scene",
    "covariance": "how much a splat's shape has changed, as a share of itself: 0.01 is one per cent",
    "opacities": "how much its alpha, 0 to 1, has changed",
    "sh0": "its base colour; times 0.28 it is brightness, 0 to 1: 0.014 is one step of an 8-bit picture",
    "sh1": "first band of the change of colour with the direction of view",
    "sh2": "second band",
    "sh3": "third band",
}
_CHECK = "<code>csplat verify FILE --source SCENE</code> checks that."
_SCENE = {
    "axes": "where +x, +y and +z point: Right, Left, Up, Down, Forward, Back",
    "up": "the direction that is up",
    "unit": "length of one unit of the scene",
    "origin": "what positions are relative to",
    "tiles": "parts that decode on their own",
    "first view": "where a viewer shows the scene from at first",
}


@dataclass(frozen=True)
class _SourceComparison:
    """The results of a comparison with the source, as text and HTML."""

    facts: dict[str, str]
    pictures: str


def write_page(
    path: str,
    name: str,
    data: bytes | mmap,
    facts: FileDescription,
    source: str | None = None,
    *,
    progress: Progress | None = None,
) -> None:
    """Write the page.

    Args:
        path: path of the page.
        name: name of the file that it describes, or `-`.
        data: the file.
        facts: the file's description of itself.
        source: a scene with which it is compared; this requires the renderer.
        progress: progress callback of the comparison.

    Raises:
        CsplatError: the file or the source is not valid.
        OSError: the source cannot be read, or the page cannot be written.
    """
    title = "standard input" if name == STANDARD_STREAM else PurePath(name).name
    beside = None if source is None else _compared(data, source, progress)
    write_bytes(path, make_page(title, facts, beside).encode())


def make_page(title: str, facts: FileDescription, beside: _SourceComparison | None = None) -> str:
    """Return the page as HTML: the same for the same file and source."""
    count = facts.header.splat_count
    return document(
        f"{title}: what is in it",
        [
            f'<h1>{escape(title)}</h1>\n<p class="quiet">{escape(f"{count:,} splats; {format_headline(facts)}")}</p>',
            _source(beside),
            _bytes(facts),
            _layers(facts),
            "" if facts.declared_bounds is None else _stated(facts.declared_bounds),
            _scene(facts),
        ],
    )


def _compared(data: bytes | mmap, source: str, progress: Progress | None) -> _SourceComparison:
    """Render file and source: from the views of `psnr` for the scores, and from others to show the hardest place."""
    from csplat_render.scorer import Scorer
    from csplat_tools.hardest_place import IMAGES_NOTE, HardestPlaceSearch, piece_images
    from csplat_tools.views import display_cameras, find_view_set

    loaded, model = load_model(source), decode(data)
    views = find_view_set(loaded.model, count=0)
    hardest, shown = HardestPlaceSearch(), display_cameras(loaded.model, views)
    scores = views.test_scorer(loaded.model).scores(model, progress=progress)
    showing = Scorer.of_source(loaded.model, shown, views.test_background)
    showing.scores(model, ssim=False, on_view=hardest.look)
    place = hardest.found()
    assert place is not None
    facts = {
        "source": _source_words(source, loaded, len(data)),
        "PSNR": f"{scores.psnr:.2f} dB: how near pictures of the file come to those of the source, from"
        f" {len(scores.each)} views all around; at 30 people see a difference, at 40 they hardly do",
        "worst view": f"{scores.psnr_worst:.2f} dB",
        "SSIM": f"{scores.ssim:.4f}: likeness of structure, 1 at best",
    }
    return _SourceComparison(facts, f"<p>{escape(IMAGES_NOTE)}</p>\n{piece_images(place, 'the file')}")


def _source_words(path: str, source: LoadedModel, size_bytes: int) -> str:
    name = "standard input" if path == STANDARD_STREAM else PurePath(path).name
    times = f"{source.size_bytes / size_bytes:.1f} times as many bytes"
    return f"{name}: {len(source.model):,} splats, {format_bytes(source.size_bytes)}, {times}"


def _source(beside: _SourceComparison | None) -> str:
    if beside is None:
        return ""
    return f"<h2>Beside its source</h2>\n{definitions(beside.facts)}\n<h3>The hardest place</h3>\n{beside.pictures}"


def _bytes(facts: FileDescription) -> str:
    sizes = {name: one.size_bytes for name, one in facts.attributes.items()}
    sizes["overhead"] = sum(facts.overhead.values())
    rows = [
        (name, _ATTRIBUTES.get(name, ""), f"{one.size_bytes:,}", _bits(one.bits_per_splat), describe_coding(one))
        for name, one in facts.attributes.items()
    ]
    overhead = ", ".join(f"{name} {number}" for name, number in facts.overhead.items())
    rows.append(("overhead", _ATTRIBUTES["overhead"], f"{sizes['overhead']:,}", "", overhead))
    head = ("attribute", "what it says", "bytes", "bits per splat", "how it is coded")
    return f"<h2>Where the bytes are</h2>\n{attribute_figure(sizes)}\n{table(head, rows, words=(1, 4))}"


def _layers(facts: FileDescription) -> str:
    rows = [
        (name, _LAYERS.get(name, ""), f"{one.size_bytes:,}", f"{100.0 * one.size_bytes / facts.header.file_size:.1f} %")
        for name, one in facts.layers.items()
    ]
    head = ("layer", "what it is for", "bytes", "of the file")
    return f"<h2>In which order it arrives</h2>\n{table(head, rows, words=(1,))}" if rows else ""


def _stated(stated: DeclaredBounds) -> str:
    text = (
        f"The file stands for a source of {stated.source_count:,} splats of SH degree {stated.source_sh_degree};"
        f" {stated.pruned_count:,} of them it leaves out. Of the others it states how far they are from the source's:"
        " no splat is farther than the largest error, and rms says how far they usually are."
    )
    if stated.refitted:
        text += (
            " Some attributes were fitted anew to what the source looks like: they have no error here, pictures judge."
        )
    rows = [(one.measure, _MEASURES.get(one.measure, ""), f"{one.max:.4g}", f"{one.rms:.4g}") for one in stated.records]
    errors = table(("error of", "what it is", "largest", "rms"), rows, words=(1,)) if rows else ""
    return f"<h2>How exact it says it is</h2>\n<p>{escape(text)} {_CHECK}</p>\n{errors}"


def _scene(facts: FileDescription) -> str:
    words = {
        (f"{name} ({_SCENE[name]})" if name in _SCENE else name): value for name, value in describe_scene(facts).items()
    }
    for title, value in (("options of the encoder", facts.options), ("metadata", other_metadata(facts))):
        if value:
            words[title] = json.dumps(value, sort_keys=True, ensure_ascii=False)
    return f"<h2>The scene</h2>\n{definitions(words)}"


def _bits(value: float | None) -> str:
    return "" if value is None else f"{value:.2f}"

"""The HTML report on a training and the file that was tuned after it: `--page` of train and finetune."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from html import escape
from pathlib import PurePath
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from csplat.errors import counted
from csplat.model import SplatModel
from csplat.types import U8
from csplat_tools.console import format_bytes
from csplat_tools.file_streams import write_bytes
from csplat_tools.hardest_place import image_row
from csplat_tools.html_report import INK, attribute_figure, definitions, document, draw_svg, table
from csplat_tools.render_files import to_uint8
from csplat_tools.training.tuning_report import SCORES, score_rows
from csplat_tools.views import ViewSet, evenly_spaced

if TYPE_CHECKING:
    from matplotlib.figure import Figure


_VIEWS = 3  # number of views that are shown
_WIDE, _HIGH = 7.0, 3.4  # width and height of a plot, inches
_LINE, _OTHER = "#2f83c9", "#d55e00"


@dataclass(frozen=True, eq=False)
class ShownView:
    """Images of a test view.

    Attributes:
        name: name of the photograph, or number of the view.
        images: [H, W, 3] uint8 each, by caption.
    """

    name: str
    images: Mapping[str, U8]


def show_views(
    source: SplatModel, models: Mapping[str, SplatModel], views: ViewSet, threads: int | None
) -> list[ShownView]:
    """Render a few of the test views, and return the renders next to the reference images.

    Args:
        source: the scene, whose renders are the reference if there are no photographs.
        models: models to render, by caption.
        views: a few of its test views are shown, evenly spread.
        threads: number of threads; `None` for all.
    """
    if not views.test:
        return []
    places = evenly_spaced(range(len(views.test)), _VIEWS)
    views = replace(views, test=[views.test[place] for place in places])
    scorer = views.image_test_scorer(threads=threads) if views.images else views.test_scorer(source, threads=threads)
    reference = "photograph" if views.images else "the source"
    rows: list[dict[str, U8]] = [{} for _ in places]
    for name, model in models.items():
        if model is source and not views.images:
            continue  # it is the reference itself

        def add(at: int, image: NDArray[np.float32], render: NDArray[np.float32], name: str = name) -> None:
            rows[at].setdefault(reference, to_uint8(image))
            rows[at][name] = to_uint8(render)

        scorer.scores(model, ssim=False, on_view=add)
    names = [camera.image or f"view {place}" for place, camera in zip(places, scorer.cameras, strict=True)]
    return [ShownView(name, row) for name, row in zip(names, rows, strict=True)]


def write_training_page(
    path: str, name: str, training: Mapping[str, Any] | None, file: Mapping[str, Any] | None, shown: Sequence[ShownView]
) -> None:
    """Write the page; the other arguments are as for `make_training_page`.

    Raises:
        OSError: the page cannot be written.
    """
    write_bytes(path, make_training_page(PurePath(name).name, training, file, shown).encode())


def make_training_page(
    title: str, training: Mapping[str, Any] | None, file: Mapping[str, Any] | None, shown: Sequence[ShownView]
) -> str:
    """Return the page as HTML.

    Args:
        title: name of the scene or file.
        training: log of the training, if there was one.
        file: report of the file, if there is one, with its log.
        shown: images of test views.
    """
    parts = [
        _head(title, training, file),
        _scores(training, file),
        _images(shown),
        _steps(training),
        _tuning(file),
        _bytes(file),
        _options(training, file),
    ]
    return document(title, parts)


def _head(title: str, training: Mapping[str, Any] | None, file: Mapping[str, Any] | None) -> str:
    words = []
    if file is not None:
        words += [counted(file["splats"], "splat"), format_bytes(file["size_bytes"])]
        words.append(f"{file['ratio']:.1f} times smaller than the PLY")
    elif training is not None:
        words.append(counted(training["splat_count"], "splat"))
    seconds = training["seconds"] if training else 0.0
    if file is not None:
        tuning = file["seconds"]["tuning"]
        seconds += file["seconds_without_judging"] - tuning + max(tuning, file["log"]["seconds"])  # if it was resumed
    words.append(f"{seconds / 60:.1f} minutes")
    return f'<h1>{escape(title)}</h1>\n<p class="quiet">{escape("; ".join(words))}</p>'


def _scores(training: Mapping[str, Any] | None, file: Mapping[str, Any] | None) -> str:
    if file is not None and file["scores"]:
        scores, views, by = file["scores"], file["test_view_count"], file["test_reference"]
    elif training is not None and training["metrics"]:
        scores, views, by = {"trained scene": training["metrics"]}, training["metrics"]["views"], "held-out photographs"
    else:
        return ""
    text = (
        f"By {views} {by}, from which nothing was learnt. psnr is of the error over all their pixels, dB; psnr_mean the"
        " mean of the views' own, as papers have it; ssim is 1 at best, lpips 0."
    )
    return f"<h2>How near it comes</h2>\n<p>{escape(text)}</p>\n{table(('', *SCORES), score_rows(scores))}"


def _images(shown: Sequence[ShownView]) -> str:
    blocks = [f"<h3>{escape(one.name)}</h3>\n{image_row(one.images, one.name)}" for one in shown]
    text = "Views from which nothing was learnt, evenly spread. They are compressed for this page."
    return f"<h2>What it looks like</h2>\n<p>{text}</p>\n" + "\n".join(blocks) if blocks else ""


def _steps(training: Mapping[str, Any] | None) -> str:
    if training is None or len(training["entries"]) < 2:
        return ""
    entries, tests = training["entries"], training["evaluations"]

    def draw(figure: Figure) -> None:
        axes = figure.add_subplot()
        steps = [one["iteration"] for one in entries]
        axes.plot(steps, [one["psnr"] for one in entries], color=_LINE, label="photographs that teach")
        if tests:
            at, found = [one["iteration"] for one in tests], [one["psnr"] for one in tests]
            axes.plot(at, found, "o", color=_OTHER, label="photographs held out")
        axes.set(xlabel="step", ylabel="PSNR, dB")
        axes.legend(loc="lower right")
        right = axes.twinx()
        right.plot(steps, [one["splat_count"] for one in entries], ":", color=INK)
        right.set_ylabel("splats (dotted)")
        right.set_ylim(bottom=0)
        right.grid(visible=False)

    small = training["options"]["half_size"]
    text = f"<p>The first {small:.0%} of the steps saw photographs of half the size.</p>\n" if small else ""
    return f"<h2>The training</h2>\n{text}{_plot(draw, 'training')}"


def _tuning(file: Mapping[str, Any] | None) -> str:
    validations = [] if file is None else file["log"]["validations"]
    if len(validations) < 2:
        return ""

    def draw(figure: Figure) -> None:
        axes = figure.add_subplot()
        steps = [one["iteration"] for one in validations]
        axes.plot(steps, [one["psnr"] for one in validations], "o-", color=_LINE, markersize=3)
        axes.set(xlabel="step", ylabel="PSNR of validation views, dB")
        right = axes.twinx()
        right.plot(steps, [one["size_bytes"] / 1e6 for one in validations], ":", color=INK)
        right.set_ylabel("MB of the file (dotted)")
        right.grid(visible=False)

    text = "Values move, seen through the encoder's quantisers; what looked best for its bytes was kept."
    return f"<h2>The tuning</h2>\n<p>{escape(text)}</p>\n{_plot(draw, 'tuning')}"


def _plot(draw: Any, name: str) -> str:
    plot = draw_svg(draw, (_WIDE, _HIGH), name, inline=True)
    return f'<figure class="plot"><div class="scroll">{plot}</div></figure>'


def _bytes(file: Mapping[str, Any] | None) -> str:
    if file is None:
        return ""
    sizes = {**file["bytes_by_attribute"], "overhead": file["overhead_bytes"]}
    return f"<h2>Where the bytes are</h2>\n{attribute_figure(sizes)}"


def _options(training: Mapping[str, Any] | None, file: Mapping[str, Any] | None) -> str:
    words = {}
    if training is not None:
        words["training"] = _words(training["options"])
    if file is not None:
        words |= {"encoding": _words(file["encoding"]), "tuning": _words(file["log"]["options"])}
        words["seconds"] = _words(file["seconds"])
    memory = (file["log"] if file else training or {}).get("peak_memory_bytes")
    if memory is not None:
        words["memory at most"] = format_bytes(memory)
    return f"<h2>How it was made</h2>\n{definitions(words)}"


def _words(options: Mapping[str, Any]) -> str:
    return ", ".join(f"{name} {value}" for name, value in options.items() if isinstance(value, str | int | float))

# SPDX-License-Identifier: Apache-2.0
"""Compare a scene with its source: sizes, errors of splats, and scores of renders."""

from __future__ import annotations

import os
import time
from collections.abc import Iterator, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from csplat.context import DEFAULT_CONTEXT, Context
from csplat.disk_files import check_free_space, finite_or_none, temporary_root
from csplat.errors import InputError, counted
from csplat.model import SplatModel
from csplat.scene import Scene
from csplat.splat_file import SplatFile
from csplat.types import F32, Progress, null_progress
from csplat_conformance.declared_bounds import (
    Source,
    find_partners,
    lattice_radii,
    measure_pairs,
    measure_pairs_by_tile,
    splats_in_memory,
)
from csplat_conformance.declared_bounds.measurement import merge_errors
from csplat_render import Backend, Mode
from csplat_render.camera import Camera
from csplat_render.gpu.device import Device, find_device
from csplat_render.gpu.renderer import GpuScene
from csplat_render.gpu.scoring import compare_scenes
from csplat_render.lpips import load_lpips
from csplat_render.metrics import Distance, Scores, ViewScore
from csplat_render.neighbours import nearest_neighbours
from csplat_render.scorer import OnView, Renderable, Scorer
from csplat_tools.console import format_bytes
from csplat_tools.file_streams import check_output, write_text
from csplat_tools.optional_packages import require_images, require_renderer
from csplat_tools.render_files import image_names, make_output_folder, removed_if_unfinished, side_by_side, write_png
from csplat_tools.scene_files import SceneLike, open_scenes, sample_scene, scene_sizes
from csplat_tools.slider_page import Panel, is_page, slider_page
from csplat_tools.views import VIRTUAL, Colour, DataOptions, ViewSet, find_view_set, views_off_path
from csplat_tools.views.sliced_renderer import SlicedScene

Pairing = Literal["index", "order", "search"]
_PAIRED = 0.95  # least fraction of splats in the same order that are nearer to their partner than to other splats
_NEAR, _SAME_PLACE = 0.01, 1e-5  # fractions of the scene's spread; limits of that distance: splats may coincide
#: Name that searches LPIPS weights in the usual places, instead of a file.
AUTO_WEIGHTS = "auto"
_SHOWN = 8  # views of a page, which has a quarter of a megabyte for each
_PIXEL_BYTES = 13  # bytes per pixel of the renders of the source, which are kept in memory


@dataclass(frozen=True)
class AttributeErrors:
    """Errors of splats against their source.

    Attributes:
        pairing: origin of the pairs. `index`: a source index. `order`: both scenes have the same number of splats, in
            the same order by their centres. `search`: some source splat is within the declared error bounds.
        matched: number of splats with a partner; only these are measured.
        unmatched: number of splats without a partner.
        errors: largest and rms error by measure, in the order of the registry.
    """

    pairing: Pairing
    matched: int
    unmatched: int
    errors: dict[str, tuple[float, float]]

    def as_json(self) -> dict[str, Any]:
        """Return everything as JSON-compatible values; overflowed errors are `null`."""
        return {
            "pairing": self.pairing,
            "matched": self.matched,
            "unmatched": self.unmatched,
            "errors": {
                name: {"max": finite_or_none(largest), "rms": finite_or_none(rms)}
                for name, (largest, rms) in self.errors.items()
            },
        }


@dataclass(frozen=True, eq=False, repr=False)
class Comparison:
    """The outcome of comparing two scenes.

    Attributes:
        a, b: the source, and the scene compared with it; not in memory if they do not fit together.
        attributes: errors of B's splats; `None` if pairs of splats cannot be found, which is usual out of core without
            a source index.
        quality: scores of B's renders against A's.
        elsewhere: PSNR of B's renders against A's in views off the path of given cameras, dB, by kind
            (`views_off_path`); empty with virtual views and out of core.
        ignored: number of splats of A that were not drawn because they hold NaN or infinities.
        cameras: source of the views: the name of a camera file or of a data set, or `virtual`.
        images: scores of A's and B's renders against the images of a data set, as JSON of `Scores`, by the
            keys `split`, `a` and `b`; `None` without a data set.
        background, mode: background colour and renderer mode.
        notes: remarks about the views.
        seconds: time of reading, matching, rendering and writing.
    """

    a: Scene
    b: Scene
    attributes: AttributeErrors | None
    quality: Scores
    elsewhere: dict[str, float]
    ignored: int
    cameras: str
    images: dict[str, Any] | None
    background: Colour
    mode: Mode
    notes: tuple[str, ...]
    seconds: float

    def __repr__(self) -> str:
        return f"Comparison({self.a.size_bytes:,} -> {self.b.size_bytes:,} bytes, {self.psnr:.2f} dB)"

    @property
    def psnr(self) -> float:
        """PSNR of B's renders, dB, pooled over all views."""
        return self.quality.psnr

    @property
    def ssim(self) -> float | None:
        """SSIM of B's renders, mean over the views."""
        return self.quality.ssim

    @property
    def lpips(self) -> float | None:
        """LPIPS of B's renders, mean over the views; `None` without weights."""
        return self.quality.lpips

    @property
    def ratio(self) -> float:
        """Size of A divided by the size of B."""
        return self.a.size_bytes / self.b.size_bytes

    def as_json(self) -> dict[str, Any]:
        """Return everything as JSON-compatible values."""
        return {
            "a": scene_sizes(self.a),
            "b": scene_sizes(self.b),
            "ratio": self.ratio,
            "attributes": None if self.attributes is None else self.attributes.as_json(),
            "cameras": self.cameras,
            "background": list(self.background),
            "mode": self.mode,
            "images": self.images,
            **self.quality.as_json(),
            "elsewhere": {kind: finite_or_none(psnr) for kind, psnr in self.elsewhere.items()},
            "ignored": {"a": self.ignored, "b": self.quality.ignored},
            "views": [
                {name: getattr(score, name) for name in ("image", "psnr", "ssim", "lpips", "cover")}
                for score in self.quality.each
            ],
            "seconds": round(self.seconds, 3),
        }


def compare(
    a: SceneLike,
    b: SceneLike,
    *,
    cameras: str | os.PathLike[str] | None = None,
    data: str | os.PathLike[str] | DataOptions | None = None,
    views: ViewSet | None = None,
    source_index: NDArray[np.integer[Any]] | None = None,
    lpips: str | None = None,
    pictures: str | os.PathLike[str] | None = None,
    amplification: float = 10.0,
    background: Colour | None = None,
    mode: Mode = "standard",
    backend: Backend = "cpu",
    force: bool = False,
    context: Context = DEFAULT_CONTEXT,
) -> Comparison:
    """Compare a scene with its source, as `csplat compare` does.

    Args:
        a, b: the source, and the scene compared with it: models, open scenes, or files in any
            format.
        cameras: a camera file with the views.
        data: a data set, whose test images are the views; A and B are scored against them, too.
        views: the views, found already (`find_view_set`), without `cameras` and `data`. Default without any of the
            three: the eight virtual views of `psnr`, 640×480, on black.
        source_index: [N] the index in A of each splat of B.
        lpips: a file of LPIPS weights, or `auto` for the usual places; `None`: LPIPS is not computed.
        pictures: a folder for one PNG per view: the image, if any, A, B, and their amplified difference; or PAGE.html,
            a page that shows at most eight of the views with borders between A, B and the difference.
        amplification: factor of the difference.
        background: red, green, blue, 0..1; `None`: the background of the views.
        mode: mode of the renderer.
        backend: what renders, as in `csplat_render.render`. A GPU computes PSNR alone, unless images are needed for
            something else: `pictures`, `lpips`, or the images of a data set. Both scenes have to fit in memory.
        force: existing files in `pictures` may be replaced.
        context: threads, progress, and memory, without images of a data set; scenes that do not fit together are
            compared out of core.

    Examples:
        >>> import csplat
        >>> comparison = csplat.compare("scene.ply", "scene.csplat")  # doctest: +SKIP
        >>> comparison.ratio, comparison.psnr, comparison.attributes.errors["means"]  # doctest: +SKIP
        (12.3, 41.2, (0.00021, 0.00009))

    Raises:
        CsplatError: a file is not valid, or an output exists; there are no test views, or views are given twice; the
            renderer is not installed; the disk is full, or too little memory is allowed.
        OSError: a file cannot be read or written.
    """
    start = time.perf_counter()
    bound = context.memory_limit
    if views is not None and (cameras is not None or data is not None):
        raise InputError("views are given, and cameras or data, expected only one of them")
    require_renderer()
    if pictures is not None:
        require_images()
    distance = None if lpips is None else load_lpips(None if lpips == AUTO_WEIGHTS else lpips)
    with open_scenes((a, b), context) as (source, other):
        views = views or _views(source, cameras, data, background, context)
        if not views.test:
            raise InputError(f"{views.name} has no {views.split} views")
        image_scorer = views.image_test_scorer(mode=mode, context=context) if views.images else None
        viewers: list[OnView] = []
        page: _Page | None = None
        writer: _ImageWriter | None = None
        if pictures is not None:
            names = image_names([camera.image for camera in views.test])
            folder = os.fspath(pictures)
            if is_page(folder):
                page = _Page(folder, names, amplification, force=force)
                viewers.append(page)
            else:
                writer = _ImageWriter(folder, names, image_scorer, amplification, force=force)
                viewers.append(writer)
        first: SplatModel | Renderable
        second: SplatModel | Renderable
        first, second, errors = _prepare_scenes(source, other, views.test, bound, source_index, context)
        image_scores = None if image_scorer is None else _ImageScores(image_scorer, distance)
        viewers += [] if image_scores is None else [image_scores]
        device, _ = find_device(backend)
        if device is not None:
            first, second = (_on_gpu(scene, device) for scene in (first, second))
        if isinstance(first, GpuScene) and isinstance(second, GpuScene) and not viewers and distance is None:
            colour = background or views.test_background
            quality = compare_scenes(first, second, views.test, colour, progress=context.progress)
            ignored = first.ignored
        else:
            scorer = views.test_scorer(first, mode=mode, background=background, context=context)
            with nullcontext() if writer is None else removed_if_unfinished(writer.files, writer.new_folder):
                quality = scorer.scores(second, lpips=distance, on_view=_all_of(viewers), progress=context.progress)
            ignored = scorer.reference(0).ignored
        if page is not None:
            page.write(source, other, quality)
        elsewhere = {}
        if views.name != VIRTUAL and source.in_memory is not None and other.in_memory is not None:
            elsewhere = _psnr_off_path(source.in_memory, first, second, views, background, mode, context)
        return Comparison(
            source, other, errors, quality, elsewhere, ignored, views.name,
            None if image_scores is None else {"split": views.split, **image_scores.as_json()},
            views.background, mode, views.notes, time.perf_counter() - start,
        )  # fmt: skip


def attribute_errors(
    source: Scene,
    other: Scene,
    source_index: NDArray[Any] | None = None,
    *,
    context: Context = DEFAULT_CONTEXT,
) -> AttributeErrors | None:
    """Measure the errors of a scene's splats against the splats of its source.

    Args:
        source: the source, in memory.
        other: the scene whose errors are measured, in memory.
        source_index: [N] integers, the index in the source of each splat of `other`; `None`: unknown.
        context: threads, and progress of a search.

    Returns:
        The errors; `None` if pairs of splats cannot be found.

    Raises:
        InputError: `source_index` is not one index of a source splat for each splat of `other`.
    """
    model, theirs = source.model(), other.model()
    ours = Source.of(model)
    if source_index is not None:
        return AttributeErrors("index", len(theirs), 0, _errors(ours, theirs, source_index, context))
    if _same_order(model, theirs):
        return AttributeErrors("order", len(theirs), 0, _errors(ours, theirs, np.arange(len(theirs)), context))
    declared = other.declared_bounds if isinstance(other, SplatFile) else None
    if declared is None or not isinstance(other, SplatFile) or not len(theirs):
        return None
    bounds = {record.measure: record.max for record in declared.records}
    if not bounds.keys() >= {"means", "opacities", "sh0"}:
        return None
    partners = find_partners(ours, theirs, bounds, lattice_radii(theirs, other.header), context=context)
    matched = np.flatnonzero(partners >= 0)
    if not len(matched):
        return None
    errors = _errors(ours, theirs.select(matched), partners[matched], context)
    return AttributeErrors("search", len(matched), len(theirs) - len(matched), errors)


def attribute_errors_out_of_core(
    source: Scene,
    other: Scene,
    memory_bytes: int,
    source_index: NDArray[Any] | None = None,
    *,
    context: Context = DEFAULT_CONTEXT,
) -> AttributeErrors | None:
    """Measure errors as `attribute_errors` does, out of core, without search; an index requires a .csplat file."""
    if source_index is not None:
        if not isinstance(other, SplatFile):
            return None
        most = splats_in_memory(other, memory_bytes)
        pairs = measure_pairs_by_tile(source, other, source_index, most, context=context)
        errors = {name: (measured.max, measured.rms) for name, measured in pairs.measured.items()}
        return AttributeErrors("index", other.count, 0, errors)
    if source.count != other.count or not _same_order(
        *(sample_scene(scene, progress=context.progress)[0] for scene in (source, other))
    ):
        return None
    parts = [
        (start, len(theirs), measure_pairs(Source.of(ours), theirs, np.arange(len(theirs)), context=context))
        for start, ours, theirs in _paired_blocks(source, other, context.progress)
    ]
    errors = {name: (measured.max, measured.rms) for name, measured in merge_errors(parts).items()}
    return AttributeErrors("order", other.count, 0, errors)


def _paired_blocks(a: Scene, b: Scene, progress: Progress) -> Iterator[tuple[int, SplatModel, SplatModel]]:
    """Yield blocks of two scenes that have the same number of splats in the same order.

    Args:
        a, b: the scenes, whose own blocks may differ in size.
        progress: receives the progress of `a`.

    Yields:
        The index of the first splat, and as many splats of `a` as of `b`, at least one.
    """
    blocks_a = a.with_progress("measuring splats", progress).blocks()
    blocks_b = b.with_progress("", null_progress).blocks()
    start, part_a, part_b = 0, a.empty(), b.empty()  # splats that were read, but not yielded
    while start < a.count:
        part_a = part_a if len(part_a) else next(blocks_a)
        part_b = part_b if len(part_b) else next(blocks_b)
        count = min(len(part_a), len(part_b))
        if count:  # a block may be empty
            yield start, part_a.select(slice(0, count)), part_b.select(slice(0, count))
        part_a, part_b = part_a.select(slice(count, None)), part_b.select(slice(count, None))
        start += count


def _errors(source: Source, other: SplatModel, index: NDArray[Any], context: Context) -> dict[str, tuple[float, float]]:
    """Return the largest and the rms error by measure; `index`, [N], has each splat's index in the source."""
    measured = measure_pairs(source, other, index, context=context)
    return {name: (error.max, error.rms) for name, error in measured.items()}


def _same_order(source: SplatModel, other: SplatModel) -> bool:
    """Return True if both scenes seem to have the same order: almost all pairs are nearer than the next splat is.

    Return False for scenes of different numbers of splats, and without splats.
    """
    if len(source) != len(other) or not len(source):
        return False
    means, theirs = source.means.astype(np.float64), other.means.astype(np.float64)
    finite = np.isfinite(means).all(axis=1) & np.isfinite(theirs).all(axis=1)
    means, theirs = means[finite], theirs[finite] + np.subtract(other.origin, source.origin)
    if not len(means):
        return False
    distances = np.linalg.norm(theirs - means, axis=1)
    spread = float(np.median(np.linalg.norm(means - np.median(means, axis=0), axis=1)))
    spacings = np.clip(nearest_neighbours(means, 1)[1][:, 0], _SAME_PLACE * spread, _NEAR * spread)
    return float(np.mean(distances <= spacings)) >= _PAIRED


def _views(
    source: Scene,
    cameras: str | os.PathLike[str] | None,
    data: str | os.PathLike[str] | DataOptions | None,
    background: Colour | None,
    context: Context,
) -> ViewSet:
    """Return the views of a scene, of which only a sample is read; none are for training."""
    model, every = sample_scene(source, progress=context.progress)
    return find_view_set(
        model,
        cameras=None if cameras is None else os.fspath(cameras),
        data=DataOptions(os.fspath(data)) if isinstance(data, (str, os.PathLike)) else data,
        background=background,
        count=0,
        every=every,
    )


def _prepare_scenes(
    source: Scene,
    other: Scene,
    cameras: Sequence[Camera],
    memory_bytes: int,
    source_index: NDArray[np.integer[Any]] | None,
    context: Context,
) -> tuple[SplatModel | SlicedScene, SplatModel | SlicedScene, AttributeErrors | None]:
    """Return both scenes in a form to render, sliced on disk unless both are in memory, and the errors of B's splats.

    Args:
        source, other: scenes A and B.
        cameras: the views, whose renders of A are kept in memory.
        memory_bytes: memory for splats and renders.
        source_index: [N], the index in A of each splat of B; `None`: by order, if it is the same.
        context: threads and progress.

    Returns:
        A, B and the errors; `None` for errors if the splats cannot be paired.

    Raises:
        InputError: memory or disk space do not suffice to render the scenes.
    """
    if source.in_memory is not None and other.in_memory is not None:
        return source.in_memory, other.in_memory, attribute_errors(source, other, source_index, context=context)
    render_bytes = sum(_PIXEL_BYTES * camera.W * camera.H for camera in cameras)
    first, second = (
        SlicedScene(scene, *sample_scene(scene, progress=context.progress), memory_bytes - render_bytes)
        for scene in (source, other)
    )
    for scene in (first, second):
        if scene.memory_bytes < scene.least_bytes:
            bound, least = (scene.memory_bytes + render_bytes) / 1e6, (scene.least_bytes + render_bytes) / 1e6
            raise InputError(f"the memory is {bound:,.0f} MB, expected at least {least:,.0f} MB to draw these scenes")
    check_free_space(
        temporary_root(),
        max(first.disk_bytes, second.disk_bytes),
        "scenes are rendered: TMPDIR sets another folder",
    )
    return first, second, attribute_errors_out_of_core(source, other, memory_bytes, source_index, context=context)


def _psnr_off_path(
    source: SplatModel,
    first: SplatModel | Renderable,
    second: SplatModel | Renderable,
    views: ViewSet,
    background: Colour | None,
    mode: Mode,
    context: Context,
) -> dict[str, float]:
    """Return the PSNR in views off the path of the cameras, dB, by kind.

    Args:
        source: scene A in memory.
        first, second: A and B in a form to render, both for a GPU or neither.
        views, background, mode, context: as for `compare`.
    """
    quiet, found = replace(context, progress=null_progress), dict[str, float]()
    path = () if views.virtual else [*views.training, *views.validation]
    for kind, cameras in views_off_path(source, views.test, path).items():
        if isinstance(first, GpuScene) and isinstance(second, GpuScene):
            quality = compare_scenes(first, second, cameras, background or views.test_background)
        else:
            shown = replace(views, training=(), validation=(), test=cameras, images=())
            quality = shown.test_scorer(first, mode=mode, background=background, context=quiet).scores(second)
        found[kind] = quality.psnr
    return found


def _on_gpu(scene: SplatModel | Renderable, device: Device) -> GpuScene:
    """Return a scene in memory for a GPU.

    Raises:
        InputError: the scene is not in memory.
    """
    if not isinstance(scene, SplatModel):
        raise InputError("a GPU renders scenes in memory, and they do not fit: use the backend cpu")
    return GpuScene(device, [scene])


class _ImageScores:
    """The scores of A's and B's renders against the images."""

    def __init__(self, scorer: Scorer, distance: Distance | None) -> None:
        self._scorer, self._distance = scorer, distance
        self._each: dict[str, list[ViewScore]] = {"a": [], "b": []}

    def __call__(self, number: int, a: F32, b: F32) -> None:
        for scores, render in zip(self._each.values(), (a, b), strict=True):
            scores.append(self._scorer.score(number, render, lpips=self._distance))

    def as_json(self) -> dict[str, Any]:
        return {name: Scores.of(scores).as_json() for name, scores in self._each.items()}


class _ImageWriter:
    """A writer of one PNG per view, named after its image."""

    def __init__(
        self, folder: str, names: Sequence[str], image_scorer: Scorer | None, amplification: float, *, force: bool
    ) -> None:
        self._names, is_new = [f"{name}.png" for name in names], not Path(folder).exists()
        self._target = make_output_folder(folder, self._names, force=force)
        self.new_folder = self._target if is_new else None
        self.files: list[Path] = []  # written so far
        self._image_scorer, self._amplification = image_scorer, amplification

    def __call__(self, number: int, a: F32, b: F32) -> None:
        shown = None if self._image_scorer is None else self._image_scorer.reference(number).rgb
        file = self._target / self._names[number]
        write_png(file, side_by_side(a, b, self._amplification, shown))
        self.files.append(file)


class _Page:
    """A page of at most `_SHOWN` of the views, spread evenly over all."""

    def __init__(self, path: str, names: Sequence[str], amplification: float, *, force: bool) -> None:
        check_output(path, force=force)
        self._path, self._names, self._amplification = path, names, amplification
        chosen = np.linspace(0, len(names) - 1, min(len(names), _SHOWN)).round()
        self._views: dict[int, list[Panel]] = {int(number): [] for number in chosen}

    def __call__(self, number: int, a: F32, b: F32) -> None:
        if number in self._views:
            pixels = np.split(side_by_side(a, b, self._amplification), 3, axis=1)
            self._views[number] = [Panel.of("", "", one) for one in pixels]

    def write(self, source: Scene, other: Scene, quality: Scores) -> None:
        """Write the page, with the sizes of A and B and the PSNR of each view."""
        remarks = [f"{format_bytes(scene.size_bytes)}, {counted(scene.count, 'splat')}" for scene in (source, other)]
        views = []
        for number, panels in self._views.items():
            titles = (
                f"source, {self._names[number]}",
                f"file, {quality.each[number].psnr:.1f} dB",
                f"difference × {self._amplification:g}",
            )
            described = zip(panels, titles, [*remarks, ""], strict=True)
            views.append([replace(panel, title=title, remark=remark) for panel, title, remark in described])
        about = "Images are compressed for this page; scores are not measured on them."
        write_text(self._path, slider_page(Path(self._path).stem, about, views))


def _all_of(viewers: Sequence[OnView]) -> OnView:
    """Return a callback that calls these callbacks in turn."""

    def show(number: int, a: F32, b: F32) -> None:
        for viewer in viewers:
            viewer(number, a, b)

    return show

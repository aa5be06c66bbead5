"""Measure the files of a sweep: bytes, quality and seconds; and find the Pareto front."""

from __future__ import annotations

import hashlib
import statistics
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from csplat import _spec
from csplat.decoder import SceneHeader, decode, read_header
from csplat.model import SplatModel
from csplat.types import F32, Progress
from csplat_render import Mode
from csplat_render.camera import relative_to
from csplat_render.metrics import Scores, ViewScore, psnr_of_mse, squared_error
from csplat_render.scorer import Scorer, renderer
from csplat_tools.html_report import HardestPlaceSearch, ImagePiece
from csplat_tools.inspect.file_description import bytes_by_attribute
from csplat_tools.tradeoffs.sweep_options import SweepSetting
from csplat_tools.views import display_cameras, evenly_spaced

_QUALITY = ("psnr", "psnr_mean", "psnr_worst", "worst_view", "ssim", "lpips")


@dataclass(frozen=True, eq=False)
class SweepFile:
    """A file that has not been measured yet.

    Attributes:
        data: the bytes of the file.
        settings: settings with which it was made, JSON-compatible.
        stages: seconds by stage; empty if unknown.
    """

    data: bytes
    settings: Mapping[str, Any] = field(default_factory=dict)
    stages: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class ModeTime:
    """Time and quality of a mode of the renderer.

    Attributes:
        milliseconds: time of a render, median over views.
        psnr: PSNR against the source's renders in mode `standard`, pooled over the timed views, dB.
    """

    milliseconds: float
    psnr: float

    def as_json(self) -> dict[str, Any]:
        """Return everything as JSON-compatible values."""
        return {"ms": round(self.milliseconds, 3), "psnr": self.psnr}


@dataclass(frozen=True)
class PartialFetch:
    """Results for a file whose SH layers above a degree are not fetched.

    Attributes:
        sh_degree: the highest band that is fetched.
        size_bytes: bytes of header, index, and the layers up to this band with their codebooks.
        quality: scores against the source's renders.
        decode_seconds: time of decoding, median of `DECODE_RUNS`.
        render_milliseconds: time of a render in mode `standard`, median over views.
    """

    sh_degree: int
    size_bytes: int
    quality: Scores
    decode_seconds: float
    render_milliseconds: float

    def as_json(self) -> dict[str, Any]:
        """Return everything as JSON-compatible values."""
        return {
            "sh_degree": self.sh_degree,
            "size_bytes": self.size_bytes,
            **{name: getattr(self.quality, name) for name in ("psnr", "psnr_worst", "ssim")},
            "decode_seconds": round(self.decode_seconds, 5),
            "render_ms": round(self.render_milliseconds, 3),
        }


@dataclass(frozen=True)
class SweepFailure:
    """A point that could not be measured.

    Attributes:
        name, family: as in `SweepPoint`.
        error: the error in one line.
    """

    name: str
    family: str
    error: str

    def as_json(self) -> dict[str, Any]:
        """Return everything as JSON-compatible values."""
        return {"name": self.name, "family": self.family, "error": self.error}


@dataclass(frozen=True, eq=False)
class SweepPoint:
    """A measured file.

    Attributes:
        name: unique among the points.
        family: its group, one of `FAMILIES`.
        command: the command that makes the same file.
        settings: settings with which the file was made, JSON-compatible.
        size_bytes: size of the file.
        sha256: hash of its bytes, in hexadecimal digits.
        splats, sh_degree: number of splats and SH degree of the file.
        source_splats, source_bytes: number of splats of the scene, and size of its PLY.
        quality: scores against the source's renders.
        image_scores: scores against test images; `None` without images.
        encode_seconds: time from the splats to the bytes.
        stages: seconds by stage, as far as known.
        decode_seconds: time from the bytes to the splats, median of `DECODE_RUNS`.
        modes: render times by mode.
        attribute_bytes: bytes by attribute, and everything else as `overhead`.
        first_picture_bytes: bytes of header, index, and everything but the SH bands.
        partial: results with fewer SH layers, if they were measured.
        hardest: the place where it differs most from the source.
    """

    name: str
    family: str
    command: str
    settings: Mapping[str, Any]
    size_bytes: int
    sha256: str
    splats: int
    sh_degree: int
    source_splats: int
    source_bytes: int
    quality: Scores
    image_scores: Scores | None
    encode_seconds: float
    stages: Mapping[str, float]
    decode_seconds: float
    modes: Mapping[str, ModeTime]
    attribute_bytes: Mapping[str, int]
    first_picture_bytes: int
    partial: Sequence[PartialFetch] = ()
    hardest: ImagePiece | None = field(default=None, repr=False)

    @property
    def ratio(self) -> float:
        """Size of the source divided by that of the file."""
        return self.source_bytes / self.size_bytes

    @property
    def bytes_per_source_splat(self) -> float | None:
        """Bytes of the file per splat of the source; `None` if the source has no splats."""
        return self.size_bytes / self.source_splats if self.source_splats else None

    @property
    def psnr(self) -> float:
        """PSNR against the source's renders, dB."""
        return self.quality.psnr

    @property
    def image_psnr(self) -> float | None:
        """PSNR pooled over test images, dB; `None` without images."""
        return None if self.image_scores is None else self.image_scores.psnr

    def as_json(self) -> dict[str, Any]:
        """Return everything as JSON-compatible values."""
        return {
            "name": self.name,
            "family": self.family,
            "error": None,
            "command": self.command,
            "settings": dict(self.settings),
            "size_bytes": self.size_bytes,
            "sha256": self.sha256,
            "bytes_per_source_splat": self.bytes_per_source_splat,
            "ratio": self.ratio,
            "splats": self.splats,
            "sh_degree": self.sh_degree,
            **{name: getattr(self.quality, name) for name in _QUALITY},
            "photographs": None if self.image_scores is None else self.image_scores.as_json(),
            "seconds": {
                "encode": round(self.encode_seconds, 4),
                "stages": {name: round(seconds, 4) for name, seconds in self.stages.items()},
                "decode": round(self.decode_seconds, 5),
            },
            "render": {name: one.as_json() for name, one in self.modes.items()},
            "attribute_bytes": dict(self.attribute_bytes),
            "first_picture_bytes": self.first_picture_bytes,
            "partial": [one.as_json() for one in self.partial],
        }


def pareto_front(points: Sequence[tuple[float, float]]) -> list[int]:
    """Return the indices of the points that no other point dominates.

    Args:
        points: (size, quality) each. A point dominates another one if it is neither larger nor worse, and better in
            one of the two. Of equal points only the first is returned.

    Returns:
        Indices, the smallest size first.
    """
    front: list[int] = []
    best = -np.inf
    for place in sorted(range(len(points)), key=lambda at: (points[at][0], -points[at][1], at)):
        if points[place][1] > best:
            front.append(place)
            best = points[place][1]
    return front


#: Number of timed runs of decoding, which takes milliseconds: the median is reported.
DECODE_RUNS = 3
#: Largest number of views from which rendering is timed.
TIMED_VIEWS = 8


@dataclass
class StageClock:
    """Seconds by stage, measured between the calls of a progress callback, which come from any thread.

    Attributes:
        clock: returns seconds.
        seconds: seconds by stage.
    """

    clock: Callable[[], float] = time.perf_counter
    seconds: dict[str, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self._lock = threading.Lock()
        self._last = self.clock()

    def listening(self, report: Progress) -> Progress:
        """Return a callback that records times and forwards calls. Time before a stage's 0 is not counted."""

        def relay(stage: str, done: float) -> None:
            with self._lock:
                now = self.clock()
                if done > 0.0:
                    self.seconds[stage] = self.seconds.get(stage, 0.0) + now - self._last
                self._last = now
            report(stage, done)

        return relay


@dataclass(frozen=True, eq=False)
class PlannedPoint:
    """A point that has not been measured yet.

    Attributes:
        name, family, command: as in `SweepPoint`.
        make: makes the file; called with a progress callback.
        is_partial: measure it with fewer SH layers, too.
        cost: kind of point in the estimates of time; `None`: the family.
    """

    name: str
    family: str
    command: str
    make: Callable[[Progress], SweepFile]
    is_partial: bool = False
    cost: str | None = None


class Measurer:
    """Measures files of one scene on its test views. Owns the renders of the source.

    Args:
        setting: the scene and its views.
        modes: modes of the renderer that are timed.
        threads: number of threads; `None` for all.

    Attributes:
        source_modes: render times of the source, by mode.
        source_image_scores: the source's scores against images; `None` without images.
    """

    def __init__(self, setting: SweepSetting, modes: Sequence[Mode], threads: int | None) -> None:
        self._setting, self._modes, self._threads = setting, modes, threads
        views = setting.views
        self._scorer = views.test_scorer(setting.source, threads=threads)
        shown = display_cameras(setting.source, views)
        self._shown_scorer = (
            None
            if shown is views.test
            else Scorer.of_source(setting.source, shown, views.test_background, threads=threads)
        )
        self._image_scorer = views.image_test_scorer(threads=threads) if views.images else None
        places = evenly_spaced(range(len(views.test)), TIMED_VIEWS)
        self._timed = [(views.test[place], self._scorer.reference(place).rgb) for place in places]
        self.source_modes: dict[str, ModeTime] = {mode: self._mode_time(setting.source, mode) for mode in modes}
        self.source_image_scores = self._source_scores()

    def measure(self, point: PlannedPoint, progress: Progress) -> SweepPoint:
        """Make a file and measure it.

        Raises:
            CsplatError: the file cannot be made.
        """
        clock, start = StageClock(), time.perf_counter()
        made = point.make(clock.listening(progress))
        encode_seconds = time.perf_counter() - start
        setting, header = self._setting, read_header(made.data)
        decoded, decode_seconds = self._decode(made.data, None)
        hardest = HardestPlaceSearch()
        quality, image_scores = self._compare(decoded, hardest)
        if self._shown_scorer is not None:
            self._shown_scorer.scores(decoded, ssim=False, on_view=hardest.examine)
        modes: dict[str, ModeTime] = {mode: self._mode_time(decoded, mode) for mode in self._modes}
        return SweepPoint(
            name=point.name,
            family=point.family,
            command=point.command,
            settings=made.settings,
            size_bytes=len(made.data),
            sha256=hashlib.sha256(made.data).hexdigest(),
            splats=header.splat_count,
            sh_degree=header.sh_degree,
            source_splats=len(setting.source),
            source_bytes=setting.source_bytes,
            quality=quality,
            image_scores=image_scores,
            encode_seconds=encode_seconds,
            stages=made.stages or clock.seconds,
            decode_seconds=decode_seconds,
            modes=modes,
            attribute_bytes=bytes_by_attribute(made.data, header),
            first_picture_bytes=fetched_bytes(header, 0),
            partial=self._partial(made, header) if point.is_partial else (),
            hardest=hardest.found(),
        )

    def _partial(self, made: SweepFile, header: SceneHeader) -> list[PartialFetch]:
        return [self._part(made.data, header, degree) for degree in range(header.sh_degree + 1)]

    def _part(self, data: bytes, header: SceneHeader, degree: int) -> PartialFetch:
        decoded, seconds = self._decode(data, degree)
        quality, _ = self._compare(decoded, None)
        return PartialFetch(
            sh_degree=degree,
            size_bytes=fetched_bytes(header, degree),
            quality=quality,
            decode_seconds=seconds,
            render_milliseconds=self._mode_time(decoded, "standard").milliseconds,
        )

    def _decode(self, data: bytes, sh_degree: int | None) -> tuple[SplatModel, float]:
        """Decode the file, and return the scene and the median time in seconds; the first run is included."""
        seconds, models = [], list[SplatModel]()
        for _ in range(DECODE_RUNS):
            start = time.perf_counter()
            models[:] = [decode(data, sh_degree=sh_degree, threads=self._threads)]
            seconds.append(time.perf_counter() - start)
        return models[0], statistics.median(seconds)

    def _compare(self, decoded: SplatModel, hardest: HardestPlaceSearch | None) -> tuple[Scores, Scores | None]:
        """Score against the source's renders; with a `HardestPlaceSearch`, also by LPIPS and against images."""
        distance = None if hardest is None else self._setting.distance
        each = list[ViewScore]()

        def compare(number: int, source: F32, other: F32) -> None:
            if hardest is not None:
                if self._shown_scorer is None:
                    hardest.examine(number, source, other)
                if self._image_scorer is not None:
                    each.append(self._image_scorer.score(number, other, lpips=distance))

        quality = self._scorer.scores(decoded, lpips=distance, on_view=compare)
        return quality, Scores.of(each) if each else None

    def _source_scores(self) -> Scores | None:
        scorer, distance = self._image_scorer, self._setting.distance
        if scorer is None:
            return None
        each = [
            scorer.score(number, self._scorer.reference(number).rgb, lpips=distance)
            for number in range(len(scorer.cameras))
        ]
        return Scores.of(each)

    def _mode_time(self, model: SplatModel, mode: Mode) -> ModeTime:
        """Measure the renders of a model from the timed views."""
        shift = np.subtract(model.origin, self._setting.source.origin)
        views = [(relative_to(shift, camera), reference) for camera, reference in self._timed]
        draw = renderer(model, self._scorer.background, mode=mode, threads=self._threads)
        if mode != "exact":  # `exact` takes seconds per render, and keeps no buffers
            draw(views[0][0])  # not timed: allocates buffers
        seconds, error, count = [], 0.0, 0
        for camera, reference in views:
            start = time.perf_counter()
            render = draw(camera).rgb
            seconds.append(time.perf_counter() - start)
            squares = squared_error(reference, render)
            error, count = error + float(np.sum(squares)), count + squares.size
        return ModeTime(1000.0 * statistics.median(seconds), psnr_of_mse(error / count))


def fetched_bytes(header: SceneHeader, sh_degree: int) -> int:
    """Return the bytes that a viewer fetches for the SH bands up to a degree.

    Args:
        header: header and index of the file.
        sh_degree: the highest band; 0 for the first render.

    Returns:
        Bytes of header, index, the layers of all tiles up to this band and their codebooks. Chunks of the whole file,
        such as declared error bounds and options, are not fetched, nor are extra columns.
    """
    layers = {id_ for id_ in _spec.LAYER_NAMES if id_ <= sh_degree}  # layer d holds band d, layer 0 everything else
    tiles = sum(layer.size for tile in header.tiles for id_, layer in tile.layers.items() if id_ in layers)
    codebooks = sum(
        chunk.size for chunk in header.directory if chunk.type == _spec.CHUNK_CODEBOOK and chunk.layer in layers
    )
    return _spec.HEADER_SIZE + header.index_size + tiles + codebooks

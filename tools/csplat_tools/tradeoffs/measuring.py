"""Measure one file of a sweep: bytes, quality of renders, and seconds."""

from __future__ import annotations

import hashlib
import statistics
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np

from csplat import _spec
from csplat.decoder import SceneHeader, decode, read_header
from csplat.model import SplatModel
from csplat.types import F32, Progress
from csplat_render import Mode
from csplat_render.camera import relative_to
from csplat_render.metrics import Scores, ViewScore, psnr_of_mse, squared_error
from csplat_render.scorer import Scorer, renderer
from csplat_tools.inspect.info import byte_shares
from csplat_tools.pages.hardest import HardestPlace
from csplat_tools.tradeoffs.points import ModeTime, Partial, Point, TriedFile
from csplat_tools.tradeoffs.setting import Setting
from csplat_tools.tradeoffs.sweep import Candidate
from csplat_tools.views import evenly, showing_cameras

#: Number of runs of decoding, which takes milliseconds: the median is reported.
DECODE_RUNS = 3
#: Largest number of views from which rendering is timed.
TIMED_VIEWS = 8


@dataclass
class StageClock:
    """Seconds between the calls of a progress callback, by the name of the stage; calls come from any thread.

    Attributes:
        clock: returns the seconds that have passed.
        seconds: by stage.
    """

    clock: Callable[[], float] = time.perf_counter
    seconds: dict[str, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self._lock = threading.Lock()
        self._last = self.clock()

    def listening(self, report: Progress) -> Progress:
        """Return a callback that passes calls on, and records their times. Time before a stage's 0 is not counted."""

        def told(stage: str, done: float) -> None:
            with self._lock:
                now = self.clock()
                if done > 0.0:
                    self.seconds[stage] = self.seconds.get(stage, 0.0) + now - self._last
                self._last = now
            report(stage, done)

        return told


class Measurer:
    """Measures files of one scene, all on the same test views. Owns the renders of the source.

    Args:
        setting: the scene and its views.
        modes: modes of the renderer that are timed.
        threads: number of threads; `None` for all.

    Attributes:
        source_modes: times of rendering the source, by mode.
        source_photographs: the source's scores against photographs, if there are any.
    """

    def __init__(self, setting: Setting, modes: Sequence[Mode], threads: int | None) -> None:
        self._setting, self._modes, self._threads = setting, modes, threads
        views = setting.views
        self._judge = views.judge(setting.source, threads=threads)
        shown = showing_cameras(setting.source, views)
        self._showing = (
            None
            if shown is views.judges
            else Scorer.of_source(setting.source, shown, views.judging_background, threads=threads)
        )
        self._photographs = views.photograph_judge(threads=threads) if views.photographs else None
        places = evenly(range(len(views.judges)), TIMED_VIEWS)
        self._timed = [(views.judges[place], self._judge.look(place).picture) for place in places]
        self.source_modes: dict[str, ModeTime] = {mode: self._mode_time(setting.source, mode) for mode in modes}
        self.source_photographs = self._source_scores()

    def measure(self, candidate: Candidate, progress: Progress) -> Point:
        """Make a file and measure it.

        Raises:
            CsplatError: the file cannot be made.
        """
        clock, start = StageClock(), time.perf_counter()
        made = candidate.make(clock.listening(progress))
        encode_seconds = time.perf_counter() - start
        setting, header = self._setting, read_header(made.data)
        decoded, decode_seconds = self._decoded(made.data, None)
        hardest = HardestPlace()
        quality, photographs = self._compared(decoded, hardest)
        if self._showing is not None:
            self._showing.scores(decoded, ssim=False, on_view=hardest.look)
        modes: dict[str, ModeTime] = {mode: self._mode_time(decoded, mode) for mode in self._modes}
        return Point(
            name=candidate.name,
            family=candidate.family,
            command=candidate.command,
            settings=made.settings,
            size_bytes=len(made.data),
            sha256=hashlib.sha256(made.data).hexdigest(),
            splats=header.splat_count,
            sh_degree=header.sh_degree,
            source_splats=len(setting.source),
            source_bytes=setting.source_bytes,
            quality=quality,
            photographs=photographs,
            encode_seconds=encode_seconds,
            stages=made.stages or clock.seconds,
            decode_seconds=decode_seconds,
            modes=modes,
            attribute_bytes=byte_shares(made.data, header),
            first_picture_bytes=fetched_bytes(header, 0),
            partial=self._partial(made, header) if candidate.is_partial else (),
            hardest=hardest.found(),
        )

    def _partial(self, made: TriedFile, header: SceneHeader) -> list[Partial]:
        return [self._part(made.data, header, degree) for degree in range(header.sh_degree + 1)]

    def _part(self, data: bytes, header: SceneHeader, degree: int) -> Partial:
        decoded, seconds = self._decoded(data, degree)
        quality, _ = self._compared(decoded, None)
        return Partial(
            sh_degree=degree,
            size_bytes=fetched_bytes(header, degree),
            quality=quality,
            decode_seconds=seconds,
            render_milliseconds=self._mode_time(decoded, "standard").milliseconds,
        )

    def _decoded(self, data: bytes, sh_degree: int | None) -> tuple[SplatModel, float]:
        """Decode the file, and return the scene and the median of the seconds; the first run is included."""
        seconds, models = [], list[SplatModel]()
        for _ in range(DECODE_RUNS):
            start = time.perf_counter()
            models[:] = [decode(data, sh_degree=sh_degree, threads=self._threads)]
            seconds.append(time.perf_counter() - start)
        return models[0], statistics.median(seconds)

    def _compared(self, decoded: SplatModel, hardest: HardestPlace | None) -> tuple[Scores, Scores | None]:
        """Score against the source's renders; LPIPS and photographs are used only with a `HardestPlace`."""
        distance = None if hardest is None else self._setting.distance
        each = list[ViewScore]()

        def look(number: int, source: F32, other: F32) -> None:
            if hardest is not None:
                if self._showing is None:
                    hardest.look(number, source, other)
                if self._photographs is not None:
                    each.append(self._photographs.score(number, other, lpips=distance))

        quality = self._judge.scores(decoded, lpips=distance, on_view=look)
        return quality, Scores.of(each) if each else None

    def _source_scores(self) -> Scores | None:
        judge, distance = self._photographs, self._setting.distance
        if judge is None:
            return None
        each = [
            judge.score(number, self._judge.look(number).picture, lpips=distance)
            for number in range(len(judge.cameras))
        ]
        return Scores.of(each)

    def _mode_time(self, model: SplatModel, mode: Mode) -> ModeTime:
        """Time the renders of a model, after one that is not timed because it allocates."""
        shift = np.subtract(model.origin, self._setting.source.origin)
        views = [(relative_to(shift, camera), wanted) for camera, wanted in self._timed]
        draw = renderer(model, self._judge.background, mode=mode, threads=self._threads)
        if mode != "exact":  # a render takes seconds, and buffers are not kept from one to the next
            draw(views[0][0])
        seconds, error, count = [], 0.0, 0
        for camera, wanted in views:
            start = time.perf_counter()
            picture = draw(camera).rgb
            seconds.append(time.perf_counter() - start)
            squares = squared_error(wanted, picture)
            error, count = error + float(np.sum(squares)), count + squares.size
        return ModeTime(1000.0 * statistics.median(seconds), psnr_of_mse(error / count))


def fetched_bytes(header: SceneHeader, sh_degree: int) -> int:
    """Return the bytes that a decoder needs for a scene with the SH bands up to a degree.

    Args:
        header: header and index of the file.
        sh_degree: the highest band; 0 for the first picture of a viewer.

    Returns:
        Bytes of header, index, the layers of all tiles up to this band and the codebooks that they need. Chunks of the
        whole file, such as declared errors and options, are not fetched, nor are extra columns.
    """
    wanted = {id_ for id_ in _spec.LAYER_NAMES if id_ <= sh_degree}  # layer d holds band d, layer 0 everything before
    tiles = sum(layer.size for tile in header.tiles for id_, layer in tile.layers.items() if id_ in wanted)
    codebooks = sum(
        chunk.size for chunk in header.directory if chunk.type == _spec.CHUNK_CODEBOOK and chunk.layer in wanted
    )
    return _spec.HEADER_SIZE + header.index_size + tiles + codebooks

"""Assign views their roles: training, validation and test."""

from __future__ import annotations

import time
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, get_args

import numpy as np
from numpy.typing import NDArray

from csplat.errors import InputError, counted
from csplat.model import SplatModel
from csplat.training_record import TrainingRecord
from csplat_render import Camera, Mode
from csplat_render.camera import relative_to, resized
from csplat_render.camera_files import load_cameras
from csplat_render.scorer import Renderable, Scorer, renderer
from csplat_render.virtual_cameras import (
    HIDING,
    detail,
    farthest_points,
    sample_cloud,
    scene_frame,
    virtual_cameras,
    with_estimated_up,
)
from csplat_tools.optional_packages import require_photographs
from csplat_tools.views import virtual_views
from csplat_tools.views.virtual_views import HELD_OUT_COUNT, camera_sequence, default_views, evenly_spaced

if TYPE_CHECKING:
    from csplat_trainer.posed_images import PosedImage


Colour = tuple[float, float, float]

BLACK: Colour = (0.0, 0.0, 0.0)
WHITE: Colour = (1.0, 1.0, 1.0)

#: Name of a set whose test views are virtual: those of `psnr`.
VIRTUAL = "virtual"

#: Parts of a data set: the photographs that were held out of training, and the others.
Split = Literal["test", "train"]
SPLITS: tuple[Split, ...] = get_args(Split)


@dataclass(frozen=True, eq=False)
class ViewSet:
    """The views of a scene by role. No view has two roles: a choice made by a view looks better there than elsewhere.

    Attributes:
        name: source of the test views: `virtual`, or the name of a camera file or of a data set.
        background: red, green, blue behind training and validation views; behind test views, too, unless they are
            virtual: `psnr` is on black.
        training: training views, to which values are fitted, and from which importance is measured.
        validation: validation views, by which the number of splats, the best step and the end of a search are chosen.
        test: test views, to which the scores in reports refer.
        photographs: photographs of a data set, in its order; each has its camera, one of those above.
        virtual: training and validation views were placed around the scene by csplat.
        origin: the scene's origin, to which all cameras are relative.
        notes: remarks for the user on the choice of views, a line each.
        split: the photographs of a data set that are test views: the held-out ones, or those of the training.

    Raises:
        InputError: a view has two roles.
    """

    name: str
    background: Colour
    training: Sequence[Camera]
    validation: Sequence[Camera]
    test: Sequence[Camera]
    photographs: Sequence[PosedImage] = ()
    virtual: bool = False
    origin: tuple[float, float, float] = (0.0, 0.0, 0.0)
    notes: tuple[str, ...] = ()
    split: Split = "test"

    def __post_init__(self) -> None:
        seen: dict[bytes, str] = {}
        for role in ("training", "validation", "test"):
            for camera in getattr(self, role):
                other = seen.setdefault(pose_key(camera), role)
                if other != role:
                    raise InputError(f"{self.name}: a view is both a {other} and a {role} view")

    @property
    def test_background(self) -> Colour:
        """Background colour of the test views."""
        return BLACK if self.name == VIRTUAL else self.background

    def test_scorer(
        self,
        source: SplatModel | Renderable,
        *,
        background: Colour | None = None,
        mode: Mode = "standard",
        threads: int | None = None,
        progress: Callable[[str, float], None] | None = None,
    ) -> Scorer:
        """Return the scorer by the source's renders in the test views.

        Args:
            source: the scene.
            background: a background colour instead of `test_background`.
            mode, threads: mode of the renderer, and its number of threads.
            progress: progress callback of rendering the source.

        Raises:
            InputError: there are no test views.
        """
        colour = background or self.test_background
        return Scorer.of_source(source, self.test, colour, mode=mode, threads=threads, progress=progress)

    def validation_scorer(self, source: SplatModel, *, threads: int | None = None) -> Scorer:
        """Return the scorer by the source's renders in the validation views.

        Raises:
            InputError: there are no validation views.
        """
        return Scorer.of_source(source, self.validation, self.background, threads=threads)

    def photograph_test_scorer(self, *, mode: Mode = "standard", threads: int | None = None) -> Scorer:
        """Return the scorer by the photographs of the test views.

        Raises:
            InputError: there are no photographs, or no test views.
        """
        return self._by_photographs(self.test, mode, threads)

    def photograph_validation_scorer(self, *, threads: int | None = None) -> Scorer:
        """Return the scorer by the photographs of the validation views.

        Raises:
            InputError: there are no photographs, or no validation views.
        """
        return self._by_photographs(self.validation, "standard", threads)

    def pictures(self, cameras: Sequence[Camera]) -> list[PosedImage]:
        """Return the photographs that the given cameras took, in the order of the cameras."""
        taken = {id(one.camera): one for one in self.photographs}
        return [taken[id(camera)] for camera in cameras]

    def read(self) -> None:
        """Read all photographs now, so that a damaged one is found before minutes are spent on the others.

        Raises:
            InputError: a file is not an image, or is truncated.
        """
        for photograph in self.photographs:
            _ = photograph.pixels, photograph.mask

    def _by_photographs(self, cameras: Sequence[Camera], mode: Mode, threads: int | None) -> Scorer:
        from csplat_trainer.posed_images import photograph_scorer

        if not self.photographs:
            raise InputError("there are no photographs: name a data set")
        shown = self.pictures(cameras)
        return photograph_scorer(shown, self.background, mode=mode, threads=threads, origin=self.origin)


def describe_views(count: int, name: str) -> str:
    """Describe the number of views and their source: `8 virtual views`, `8 views of lego`.

    Args:
        count: number of views.
        name: name of the set.
    """
    return counted(count, "virtual view") if name == VIRTUAL else f"{counted(count, 'view')} of {name}"


def pose_key(camera: Camera) -> bytes:
    """Return bytes that identify a view at any image size: its pose and its field of view."""
    lens = camera.K[:2] / np.array([[camera.W], [camera.H]])
    return (np.round(np.concatenate([camera.viewmat[:3].ravel(), lens.ravel()]), 9) + 0.0).tobytes()


_ENOUGH = 40  # number of cameras of a file from which they are split into all three roles
_JUDGE_EVERY, _MOST_JUDGES = 4, 24  # every Nth of them is a test view, up to this number
_DECIDE_EVERY = 8  # every Nth of the others is a validation view
_MOST_DECIDING = 16  # largest number of a data set's validation photographs that are used
_DECIDING_SEED = 1000  # seed of virtual validation views, added to the user's
_TEST_EVERY = 8  # every Nth photograph is held out if nothing else is specified


@dataclass(frozen=True)
class DataOptions:
    """A data set, as a command line specifies it. For `None` the scene's own metadata is used, else the default.

    Attributes:
        path: the set's folder, or its transforms.json.
        size: width and height to which photographs are scaled; default: no scaling.
        images: folder of images of a COLMAP set; default: chosen by the reader.
        test_every: every Nth photograph is held out if the set does not specify test images; default: 8.
        near: near plane of the cameras, scene units; default: one that suits the set.
    """

    path: str
    size: tuple[int, int] | None = None
    images: str | None = None
    test_every: int | None = None
    near: float | None = None


def comparison_cameras(source: SplatModel, every: int = 1) -> list[Camera]:
    """Return the cameras of `psnr`: virtual ones, chosen by the source alone, or by every Nth of its splats."""
    return virtual_cameras(source, *virtual_views.VIRTUAL_SIZES.judging, seed=0, every=every)


def find_view_set(
    source: SplatModel,
    *,
    cameras: str | None = None,
    data: DataOptions | None = None,
    background: Colour | None = None,
    count: int | None = None,
    size: tuple[int, int] | None = None,
    seed: int = 0,
    validation_count: int | None = None,
    split: Split = "test",
    every: int = 1,
) -> ViewSet:
    """Read or place views, and assign each a role; see the table above.

    Args:
        source: the scene.
        cameras: a camera file, see `csplat_render.camera_files.load_cameras`.
        data: a data set, instead of a camera file.
        background: background colour; `None`: that of the scene's training if known, else black.
        count: number of virtual training views, to which 16 are added that pruning holds out to check its choice; 0: no
            virtual training or validation views. `None`: by the number of splats (`default_views`).
        size: width and height of virtual training views, pixels; `None`: by the number of splats.
        seed: seed of virtual training and validation views.
        validation_count: number of validation views; `None`: as in the table; 0: none that could be training views.
        split: the photographs of a data set that are test views. With `train`, no view has another role.
        every: the source is every Nth splat of the scene, by which virtual test views are placed; 1: all splats.

    Raises:
        InputError: both are given, or one is not valid, or has too few views.
        OSError: a file cannot be read.
    """
    if cameras is not None and data is not None:
        raise InputError("wanted cameras of a file or of a data set, not both")
    if split not in SPLITS:
        raise InputError(f"the split is {split!r}, wanted one of {', '.join(SPLITS)}")
    usual = default_views(every * len(source))
    count, size = usual[0] if count is None else count, size or usual[1]
    if data is not None:
        return _of_data(source, data, background, validation_count, split)
    if cameras is None:
        test = comparison_cameras(source, every)
        judging = {pose_key(camera) for camera in test}  # in a scene without splats all views are alike
        training, validation = (
            _without(judging, part) for part in _virtual(source, count, size, seed, validation_count)
        )
        notes = (
            () if every < 2 else (f"the scene is not in memory: one in {every} of its splats says where views stand",)
        )
        colour = background or BLACK
        return ViewSet(VIRTUAL, colour, training, validation, test, virtual=True, origin=source.origin, notes=notes)
    return _of_file(source, cameras, background, (count, size, seed), validation_count)


def with_validation_views(views: ViewSet) -> ViewSet:
    """Return the views; if there are no validation views, every eighth training view becomes one."""
    if views.validation:
        return views
    validation, training = _apart(views.training, None)
    return replace(views, training=training, validation=validation)


def _of_file(
    source: SplatModel,
    path: str,
    background: Colour | None,
    virtual: tuple[int, tuple[int, int], int],
    validation_count: int | None,
) -> ViewSet:
    report: list[str] = []
    given = list({pose_key(camera): camera for camera in load_cameras(path, report, source.origin)}.values())
    said = TrainingRecord.of(source.metadata)
    colour, notes = _colour(background, said)
    few = len(given) < _ENOUGH
    if few:
        judging = {pose_key(camera) for camera in given}
        test = given
        training, validation = (_without(judging, part) for part in _virtual(source, *virtual, validation_count))
    else:
        every = range(0, len(given), _JUDGE_EVERY)
        test, rest = _parted(given, evenly_spaced(every, _MOST_JUDGES))
        validation, training = _apart(rest, validation_count)
    return ViewSet(
        _named_file(path), colour, training, validation, test, virtual=few, origin=source.origin,
        notes=(*report, *notes),
    )  # fmt: skip


def _of_data(
    source: SplatModel, data: DataOptions, background: Colour | None, validation_count: int | None, split: Split
) -> ViewSet:
    require_photographs()
    from csplat_trainer.data import load

    said = TrainingRecord.of(source.metadata)
    wanted, notes = _settled(data, said)
    every = _TEST_EVERY if wanted.test_every is None else wanted.test_every
    found = load(wanted.path, wanted.size, images=wanted.images, test_every=every, near=wanted.near)
    shift = np.subtract(source.origin, found.origin)
    parts = (found.train, found.test, evenly_spaced(found.val, _MOST_DECIDING))
    train, test, val = (_moved(part, shift) for part in parts)
    colour, more = _colour(background, said, photographs=True)
    if split == "train":
        train, test, val = [], train, []
    judging = {pose_key(one.camera) for one in test}
    apart = _without(judging, [one.camera for one in train])
    if len(apart) < len(train):
        more.append(f"{len(train) - len(apart)} training photographs stand where others judge, and are left out")
    validation, training = (
        _without(judging | {pose_key(camera) for camera in apart}, [one.camera for one in val]),
        apart,
    )
    if validation_count or not validation:
        validation, training = _apart(apart, validation_count)
    return ViewSet(
        _named_file(data.path), colour, training, validation, [one.camera for one in test], [*train, *val, *test],
        origin=source.origin, notes=(*found.report, *notes, *more), split=split,
    )  # fmt: skip


def _settled(data: DataOptions, said: TrainingRecord | None) -> tuple[DataOptions, list[str]]:
    """Return the user's options, completed by the scene's metadata, with remarks on contradictions."""
    values: dict[str, Any] = {}
    notes = []
    for name in (field.name for field in fields(data) if field.name != "path"):
        asked, known = getattr(data, name), getattr(said, name, None)
        values[name] = known if asked is None else asked
        if None not in (asked, known) and asked != known:
            notes.append(f"{name} is {asked}, but the scene was trained with {known}")
    return replace(data, **values), notes


def _colour(
    background: Colour | None, said: TrainingRecord | None, *, photographs: bool = False
) -> tuple[Colour, list[str]]:
    """Return the background colour, with remarks on it, which matter most if photographs are compared."""
    if background is not None:
        if said is not None and said.background != background:
            return background, [
                f"background is {_named(background)}, but the scene was trained on {_named(said.background)}"
            ]
        return background, []
    if said is not None:
        return said.background, []
    note = "the scene does not say in front of what it was trained: black is behind it, --background changes that"
    return BLACK, [note] if photographs else []


def _named_file(path: str) -> str:
    """Return the name of a file or a folder, changed if it is that of virtual views."""
    name = Path(path).resolve().name
    return f"./{name}" if name == VIRTUAL else name


def _named(colour: Colour) -> str:
    return {BLACK: "black", WHITE: "white"}.get(colour) or ",".join(f"{value:g}" for value in colour)


def _moved(pictures: Sequence[PosedImage], shift: NDArray[np.float64]) -> list[PosedImage]:
    return [replace(one, camera=relative_to(shift, one.camera)) for one in pictures]


def _virtual(
    source: SplatModel, count: int, size: tuple[int, int], seed: int, validation_count: int | None
) -> tuple[list[Camera], list[Camera]]:
    """Return virtual training and validation views; the latter are like the test views of `psnr`, at other places."""
    if count < 1:
        return [], []
    usual, width, height = virtual_views.VIRTUAL_SIZES.deciding
    kept = usual if validation_count is None else validation_count
    validation = virtual_cameras(source, kept, width, height, seed=_DECIDING_SEED + seed) if kept else []
    return camera_sequence(source, count + HELD_OUT_COUNT, size, seed=seed), validation


def _apart(cameras: Sequence[Camera], validation_count: int | None) -> tuple[list[Camera], list[Camera]]:
    """Split cameras into validation views, evenly spread, and training views without those of the same pose."""
    count = len(cameras)
    if validation_count is None:
        every = min(_DECIDE_EVERY, count)
        places: Collection[int] = range(every // 2, count, every) if count > 1 else ()
    elif validation_count and validation_count >= count:
        raise InputError(f"{validation_count} of {count} views to decide by leave none to learn from")
    else:
        places = [(2 * number + 1) * count // (2 * validation_count) for number in range(validation_count)]
    validation, others = _parted(cameras, places)
    return validation, _without({pose_key(camera) for camera in validation}, others)


def _parted(cameras: Sequence[Camera], places: Collection[int]) -> tuple[list[Camera], list[Camera]]:
    chosen = set(places)
    return [cameras[i] for i in sorted(chosen)], [one for i, one in enumerate(cameras) if i not in chosen]


def _without(judging: Collection[bytes], cameras: Sequence[Camera]) -> list[Camera]:
    """Return the cameras whose pose is not in `judging`."""
    return [one for one in cameras if pose_key(one) not in judging]


_SAMPLES = 2  # largest number of cameras that are rendered
_SMALLER = 8  # divisor of width and height in mode `exact`, in which a render takes a minute: time grows with pixels


def total_render_seconds(source: SplatModel, cameras: Sequence[Camera], *, mode: Mode = "standard") -> float:
    """Estimate the seconds that renders from all cameras take, from some of them; 0 without splats or cameras."""
    return len(cameras) * render_seconds(source, cameras, mode=mode) if len(source) and cameras else 0.0


def render_seconds(
    source: SplatModel | Renderable,
    cameras: Sequence[Camera],
    *,
    mode: Mode = "standard",
    threads: int | None = None,
    clock: Callable[[], float] = time.perf_counter,
) -> float:
    """Measure the seconds that a render takes, from some that are discarded.

    Args:
        source: the scene.
        cameras: the views, at least one.
        mode, threads: mode of the renderer, and its number of threads.
        clock: returns the seconds that have passed.
    """
    draw = renderer(source, (0.0, 0.0, 0.0), mode=mode, threads=threads)
    tried, times = cameras[:: max(1, len(cameras) // _SAMPLES)][:_SAMPLES], 1
    if mode == "exact":
        times = _SMALLER**2
        tried = [resized(one, max(1, one.W // _SMALLER), max(1, one.H // _SMALLER)) for one in tried[:1]]
    else:
        draw(tried[0])  # not timed: allocates buffers and loads kernels
    start = clock()
    for camera in tried:
        draw(camera)
    return times * (clock() - start) / len(tried)


_COUNT, _SIZE = 6, (640, 480)  # largest number of views; their width and height, pixels
_TRIED, _POINTS, _SEED = 64, 40_000, 0  # candidates; points sampled from the scene; seed of both
_GOOD_DETAIL = 0.8  # least detail as a fraction of the best view's


def display_cameras(source: SplatModel, views: ViewSet) -> Sequence[Camera]:
    """Return the views to show.

    Args:
        source: the scene.
        views: the user's own test views are shown; if they are virtual, others are searched.

    Returns:
        Cameras relative to the scene's origin: the test views, or virtual ones far apart from each other that show fine
        splats with nothing in front of them.
    """
    if views.name != VIRTUAL or not len(source):
        return views.test
    told = with_estimated_up(source)
    own = views.test if told is source else ()  # else they would show it lying on its side
    cameras = [*own, *camera_sequence(told, _TRIED, _SIZE, seed=_SEED)]
    cloud, nearest = sample_cloud(source, _POINTS, np.random.default_rng(_SEED)), HIDING * scene_frame(source).extent
    details = np.array([detail(cloud, camera, nearest) for camera in cameras])
    good = np.flatnonzero(details >= _GOOD_DETAIL * details.max())
    positions = np.stack([cameras[i].position for i in good])
    chosen = farthest_points(positions, int(np.argmax(details[good])), min(_COUNT, len(good)))
    return [cameras[good[i]] for i in chosen]

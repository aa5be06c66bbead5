# SPDX-License-Identifier: Apache-2.0
"""Assign the views of a scene their roles: training, validation and test.

Values are fitted to training views. Validation views decide how many splats are kept, which step is best and when a
search ends. Reports contain scores on test views. No view has two roles.

| views | training | validation | test |
|---|---|---|---|
| virtual | `count` + 16 small views, all around | 48 like the test views | the eight of `psnr` |
| camera file, 40 or more | the others | every 8th of the others | every 4th, 24 at most |
| camera file, fewer | virtual views | virtual views | all |
| data set | training images | 16 for validation at most, else every 8th training image | held-out images |
"""

from __future__ import annotations

import time
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, field, fields, replace
from typing import TYPE_CHECKING, Any, Literal, get_args

import numpy as np
from numpy.typing import NDArray

from csplat.context import DEFAULT_CONTEXT, Context
from csplat.disk_files import resolve_links
from csplat.errors import InputError, counted
from csplat.model import SplatModel
from csplat.scene_metadata import TrainingRecord
from csplat_render import Camera, Mode
from csplat_render.camera import relative_to, resized
from csplat_render.camera_files import load_cameras
from csplat_render.scene_frame import detail, sample_cloud, scene_frame
from csplat_render.scorer import Renderable, Scorer, renderer
from csplat_render.up_estimate import with_estimated_up
from csplat_render.virtual_cameras import HIDING, farthest_points, virtual_cameras
from csplat_tools.optional_packages import require_data_sets
from csplat_tools.views import virtual_views
from csplat_tools.views.set_fit import NORMALISATION, measure_fit, normalised_images
from csplat_tools.views.virtual_views import HELD_OUT_COUNT, camera_sequence, default_views, evenly_spaced

if TYPE_CHECKING:
    from csplat_trainer.data import DataSet
    from csplat_trainer.posed_images import PosedImage

Colour = tuple[float, float, float]

BLACK: Colour = (0.0, 0.0, 0.0)
WHITE: Colour = (1.0, 1.0, 1.0)

#: Name of a set whose test views are virtual: the views of `psnr`.
VIRTUAL = "virtual"

#: Parts of a data set: its test images, and the others.
Split = Literal["test", "train"]
SPLITS: tuple[Split, ...] = get_args(Split)

_SPLIT_FROM = 40  # cameras; a file with at least this number is split into all three roles
_TEST_EVERY, _TEST_MAX = 4, 24  # every Nth camera of a file is a test view, up to this number
_VALIDATION_EVERY = 8  # every Nth view that is not a test view is a validation view
_VALIDATION_MAX = 16  # validation images of a data set, at most
_VALIDATION_SEED, _SET_SEEDS = 1000, 10_000  # added to the user's seed, for validation views and for each set of them
_POSE_DIGITS = 9  # decimals of pose and field of view by which views are told apart
_HOLD_OUT_EVERY = 8  # every Nth image is a test image by default

_TIMED_MAX = 2  # timed renders, at most
_TIMED_DIVISOR = 8  # divisor of width and height for timing mode `exact`, whose time is proportional to pixels

_DISPLAY_MAX, _DISPLAY_SIZE = 6, (640, 480)  # views to display, at most; width and height, pixels
_DISPLAY_CANDIDATES, _DISPLAY_POINTS, _DISPLAY_SEED = 64, 40_000, 0  # candidate views; points of the scene; seed
_DISPLAY_DETAIL = 0.8  # least detail of a view to display, as a fraction of the largest detail


@dataclass(frozen=True, eq=False)
class ViewSet:
    """The views of a scene by role. No view has two roles, since scores on views that were fitted to are too good.

    Attributes:
        name: source of the test views: `virtual`, or the name of a camera file or of a data set.
        background: background colour of training and validation views, and of test views unless they are virtual:
            `psnr` is on black.
        training: training views, to which values are fitted, and in which importance is measured.
        validation: validation views, which choose the number of splats, the best step and the end of a search.
        test: test views, to which the scores in reports refer.
        images: images of a data set, in its order; each has its camera, which is in a role above.
        virtual: csplat placed training and validation views around the scene.
        origin: the scene's origin, to which all cameras are relative.
        notes: remarks for the user on the choice of views, a line each.
        split: part of the data set that the test views are.
        misfit: why the scene does not fit the images, a sentence that is among the notes, too; empty if it fits.

    Raises:
        InputError: a view has two roles.
    """

    name: str
    background: Colour
    training: Sequence[Camera] = field(repr=False)
    validation: Sequence[Camera] = field(repr=False)
    test: Sequence[Camera] = field(repr=False)
    images: Sequence[PosedImage] = field(default=(), repr=False)
    virtual: bool = False
    origin: tuple[float, float, float] = (0.0, 0.0, 0.0)
    notes: tuple[str, ...] = ()
    split: Split = "test"
    misfit: str = ""

    def __post_init__(self) -> None:
        """Refuse views of one pose in several roles.

        Raises:
            InputError: a view has two roles.
        """
        seen: dict[bytes, str] = {}
        for role in ("training", "validation", "test"):
            for camera in getattr(self, role):
                known_role = seen.setdefault(pose_key(camera), role)
                if known_role != role:
                    raise InputError(f"{self.name}: a view is both a {known_role} and a {role} view")

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
        context: Context = DEFAULT_CONTEXT,
    ) -> Scorer:
        """Return the scorer on the test views, against the source's renders.

        Args:
            source: the scene.
            background: background colour; `None`: `test_background`.
            mode: mode of the renderer.
            context: threads and progress.

        Raises:
            InputError: there are no test views.
        """
        colour = background or self.test_background
        return Scorer.of_source(source, self.test, colour, mode=mode, context=context)

    def validation_scorer(self, source: SplatModel, *, context: Context = DEFAULT_CONTEXT) -> Scorer:
        """Return the scorer on the validation views, against the source's renders.

        Raises:
            InputError: there are no validation views.
        """
        return Scorer.of_source(source, self.validation, self.background, context=context)

    def image_test_scorer(self, *, mode: Mode = "standard", context: Context = DEFAULT_CONTEXT) -> Scorer:
        """Return the scorer on the test views, against their images.

        Raises:
            InputError: there are no images, or no test views.
        """
        return self._image_scorer(self.test, mode, context)

    def image_validation_scorer(self, *, context: Context = DEFAULT_CONTEXT) -> Scorer:
        """Return the scorer on the validation views, against their images.

        Raises:
            InputError: there are no images, or no validation views.
        """
        return self._image_scorer(self.validation, "standard", context)

    def require_fit(self) -> None:
        """Refuse to prune, tune or weigh splats by images that the scene does not show.

        Raises:
            InputError: the scene does not fit the images.
        """
        if self.misfit:
            raise InputError(self.misfit)

    def images_of(self, cameras: Sequence[Camera]) -> list[PosedImage]:
        """Return the images of the given cameras, in their order."""
        taken = {id(image.camera): image for image in self.images}
        return [taken[id(camera)] for camera in cameras]

    def read_images(self) -> None:
        """Read all images, to find damaged images early.

        Raises:
            InputError: a file is not an image, or is truncated.
        """
        for image in self.images:
            _ = image.pixels, image.mask

    def _image_scorer(self, cameras: Sequence[Camera], mode: Mode, context: Context) -> Scorer:
        """Return the scorer on some views, against their images.

        Raises:
            InputError: the views have no images.
        """
        from csplat_trainer.posed_images import image_scorer

        if not self.images:
            raise InputError("the views have no images: name a data set")
        shown = self.images_of(cameras)
        return image_scorer(shown, self.background, mode=mode, context=context, origin=self.origin)


def require_visible(views: ViewSet, scorer: Scorer) -> None:
    """Refuse given views in which the scene cannot be seen, so that every file would have a perfect score.

    Args:
        views: the views.
        scorer: scorer on some of them, against the source's renders.

    Raises:
        InputError: every render has a single colour.
    """
    renders = (scorer.reference(number).rgb for number in range(len(scorer.cameras)))
    if views.name != VIRTUAL and all(np.ptp(render, axis=(0, 1)).max() == 0.0 for render in renders):
        raise InputError("no splat is visible in the given views: check that the cameras belong to the scene")


def describe_views(count: int, name: str) -> str:
    """Describe the number of views and their source: `8 virtual views`, `8 views of lego`."""
    return counted(count, "virtual view") if name == VIRTUAL else f"{counted(count, 'view')} of {name}"


def pose_key(camera: Camera) -> bytes:
    """Return bytes that identify a view at any image size: its pose and its field of view."""
    lens = camera.K[:2] / np.array([[camera.W], [camera.H]])
    values = np.round(np.concatenate([camera.viewmat[:3].ravel(), lens.ravel()]), _POSE_DIGITS)
    return (values + 0.0).tobytes()  # -0.0 becomes 0.0, which has other bytes


@dataclass(frozen=True)
class DataOptions:
    """A data set of images. `None` means the value in the scene's metadata, else the default.

    Attributes:
        path: the set's folder, its transforms.json, or a folder of images in it.
        size: width and height to which images are scaled; default: no scaling.
        images: folder of images of a COLMAP set; default: chosen by the reader.
        test_every: every Nth image is a test image if the set does not specify any; default: 8.
        near: near plane of the cameras, scene units; default: chosen by the reader.
        trust_paths: read files outside of the set's folder that it names or links to.
    """

    path: str
    size: tuple[int, int] | None = None
    images: str | None = None
    test_every: int | None = None
    near: float | None = None
    trust_paths: bool = False


def comparison_cameras(source: SplatModel, every: int = 1) -> list[Camera]:
    """Return the virtual cameras of `psnr`, which depend only on the source, or on every Nth of its splats."""
    return virtual_cameras(source, *virtual_views.VIRTUAL_SIZES.test, seed=0, every=every)


def find_view_set(
    source: SplatModel,
    *,
    cameras: str | None = None,
    data: DataOptions | DataSet | None = None,
    background: Colour | None = None,
    count: int | None = None,
    size: tuple[int, int] | None = None,
    seed: int = 0,
    validation_count: int | None = None,
    split: Split = "test",
    every: int = 1,
    path: str | None = None,
    check_fit: bool = True,
) -> ViewSet:
    """Read or place views, and assign each a role; see the table at the head of the module.

    Args:
        source: the scene.
        cameras: a camera file, see `csplat_render.camera_files.load_cameras`.
        data: a data set, to be opened or opened already, instead of a camera file.
        background: background colour; `None`: the colour of the scene's training if known, else black.
        count: number of virtual training views, in addition to 16 that pruning holds out; 0: no virtual training or
            validation views. `None`: by the number of splats (`default_views`).
        size: width and height of virtual training views, pixels; `None`: by the number of splats.
        seed: seed of virtual training and validation views.
        validation_count: number of validation views; `None`: as in the table; 0: keep all others as training views.
        split: the part of a data set that becomes test views. With `train`, there are no other views.
        every: the source is every Nth splat of the scene; used to place virtual test views.
        path: the scene's file. A `dataparser_transforms.json` next to it, which nerfstudio writes, is used if the
            scene fits the data set with it, and not without.
        check_fit: find out if the scene fits the data set (`set_fit`), unless it is a part of the scene; False for a
            scene that was trained on it just now.

    Raises:
        InputError: both `cameras` and `data` are given, or the given views are not valid, or too few.
        OSError: a file cannot be read.
    """
    if cameras is not None and data is not None:
        raise InputError("cameras and data exclude each other")
    if split not in SPLITS:
        raise InputError(f"the split is {split!r}, expected one of {', '.join(SPLITS)}")
    usual = default_views(every * len(source))
    count, size = usual[0] if count is None else count, size or usual[1]
    if data is not None:
        checked_path = (path or "",) if check_fit and every == 1 and len(source) else ()
        return _views_of_data(source, data, background, validation_count, split, *checked_path)
    if cameras is None:
        test = comparison_cameras(source, every)
        test_poses = {pose_key(camera) for camera in test}  # in an empty scene all views are equal
        training, validation = (
            _without(test_poses, part) for part in _place_virtual(source, count, size, seed, validation_count)
        )
        notes = () if every < 2 else (f"the scene is not in memory: views are placed by 1 in {every} of its splats",)
        colour = background or BLACK
        return ViewSet(VIRTUAL, colour, training, validation, test, virtual=True, origin=source.origin, notes=notes)
    return _views_of_file(source, cameras, background, (count, size, seed), validation_count)


def with_validation_views(views: ViewSet) -> ViewSet:
    """Return the views; if there are no validation views, every eighth training view becomes a validation view."""
    if views.validation:
        return views
    validation, training = _split_validation(views.training, None)
    return replace(views, training=training, validation=validation)


def display_cameras(source: SplatModel, views: ViewSet) -> Sequence[Camera]:
    """Choose views for showing renders to users.

    The views of `psnr` are spread all around a scene. Some see the back of objects, or a wall from nearby, and a scene
    without a known up direction may lie on its side. This is fair for scores, but not instructive.

    Args:
        source: the scene.
        views: its test views are shown; if they are virtual, other views are searched.

    Returns:
        Cameras relative to the scene's origin: the test views, or virtual cameras far from each other that show
        much detail with nothing in front of it.
    """
    if views.name != VIRTUAL or not len(source):
        return views.test
    upright = with_estimated_up(source)
    own = views.test if upright is source else ()  # otherwise they would show the scene lying on its side
    cameras = [*own, *camera_sequence(upright, _DISPLAY_CANDIDATES, _DISPLAY_SIZE, seed=_DISPLAY_SEED)]
    cloud = sample_cloud(source, _DISPLAY_POINTS, np.random.default_rng(_DISPLAY_SEED))
    nearest = HIDING * scene_frame(source).extent
    details = np.array([detail(cloud, camera, nearest) for camera in cameras])
    good = np.flatnonzero(details >= _DISPLAY_DETAIL * details.max())
    positions = np.stack([cameras[i].position for i in good])
    chosen = farthest_points(positions, int(np.argmax(details[good])), min(_DISPLAY_MAX, len(good)))
    return [cameras[good[i]] for i in chosen]


def total_render_seconds(source: SplatModel, cameras: Sequence[Camera], *, mode: Mode = "standard") -> float:
    """Estimate the seconds for renders from all cameras, by timing some; 0 without splats or cameras."""
    return len(cameras) * render_seconds(source, cameras, mode=mode) if len(source) and cameras else 0.0


def render_seconds(
    source: SplatModel | Renderable,
    cameras: Sequence[Camera],
    *,
    mode: Mode = "standard",
    context: Context = DEFAULT_CONTEXT,
    clock: Callable[[], float] = time.perf_counter,
) -> float:
    """Measure the seconds for a render.

    Args:
        source: the scene.
        cameras: the views, at least one.
        mode: mode of the renderer.
        context: threads.
        clock: returns seconds.
    """
    draw = renderer(source, (0.0, 0.0, 0.0), mode=mode, context=context)
    tried, times = cameras[:: max(1, len(cameras) // _TIMED_MAX)][:_TIMED_MAX], 1
    if mode == "exact":
        times = _TIMED_DIVISOR**2
        tried = [
            resized(camera, max(1, camera.W // _TIMED_DIVISOR), max(1, camera.H // _TIMED_DIVISOR))
            for camera in tried[:1]
        ]
    else:
        draw(tried[0])  # not timed: allocates buffers and loads kernels
    start = clock()
    for camera in tried:
        draw(camera)
    return times * (clock() - start) / len(tried)


def _views_of_file(
    source: SplatModel,
    path: str,
    background: Colour | None,
    virtual: tuple[int, tuple[int, int], int],
    validation_count: int | None,
) -> ViewSet:
    """Return views of a camera file, in which each pose counts once.

    With `_SPLIT_FROM` or more cameras, the file is split into all three roles. With fewer, all are test views, and the
    others are virtual.

    Args:
        source: the scene.
        path: the camera file.
        background: background colour; `None`: as in the scene's metadata, or black.
        virtual: number, size (width and height) and seed of virtual training views.
        validation_count: number of validation views; `None`: as usual.

    Raises:
        InputError: the file is invalid, or no view would be left for training.
    """
    report: list[str] = []
    # Of cameras with one pose, the last is kept, at the place of the first.
    cameras = list({pose_key(camera): camera for camera in load_cameras(path, report, source.origin)}.values())
    record = source.metadata.training
    colour, notes = _choose_background(background, record)
    is_virtual = len(cameras) < _SPLIT_FROM
    if is_virtual:
        test_poses = {pose_key(camera) for camera in cameras}
        test = cameras
        training, validation = (
            _without(test_poses, part) for part in _place_virtual(source, *virtual, validation_count)
        )
    else:
        test_places = evenly_spaced(range(0, len(cameras), _TEST_EVERY), _TEST_MAX)
        test, others = _split_at(cameras, test_places)
        validation, training = _split_validation(others, validation_count)
    return ViewSet(
        _view_set_name(path), colour, training, validation, test, virtual=is_virtual, origin=source.origin,
        notes=(*report, *notes),
    )  # fmt: skip


def _views_of_data(
    source: SplatModel,
    data: DataOptions | DataSet,
    background: Colour | None,
    validation_count: int | None,
    split: Split,
    checked_path: str | None = None,
) -> ViewSet:
    """Return the views of a data set, with cameras relative to the scene's origin.

    Validation views are the set's own, evenly spaced, or are taken from its training images if it has none or
    `validation_count` is given. Training views with the pose of a test view
    are dropped, and validation views with the pose of either.

    Args:
        source: the scene.
        data: the data set, or how to open it.
        background: background colour; `None`: as in the scene's metadata, or black.
        validation_count: number of validation views; `None`: as usual.
        split: `train` scores on the training images, instead of training on them.
        checked_path: the scene's file, or an empty name, if it is to be checked that the scene fits; else `None`.

    Raises:
        InputError: the data set is invalid, or no view would be left for training.
    """
    record = source.metadata.training
    name, data_set, notes = (
        _open_data_set(data, record) if isinstance(data, DataOptions) else (data.name, data, list[str]())
    )
    parts = (data_set.train, data_set.test, evenly_spaced(data_set.val, _VALIDATION_MAX))
    colour, colour_notes = _choose_background(background, record, images=True)
    images = _shift_origin([image for part in parts for image in part], np.subtract(source.origin, data_set.origin))
    misfit = ""
    if checked_path is not None:
        folder = data.path if isinstance(data, DataOptions) else ""
        images, misfit, fit_note = _fitting_images(source, images, colour, name, checked_path, folder)
        notes = [*notes, *fit_note]
    train, test, val = (
        images[: len(parts[0])],
        images[len(parts[0]) :][: len(parts[1])],
        images[len(images) - len(parts[2]) :],
    )
    if split == "train":
        train, test, val = [], train, []
    pose_notes = list[str]()
    test_poses = {pose_key(image.camera) for image in test}
    training = _without(test_poses, [image.camera for image in train])
    if len(training) < len(train):
        pose_notes.append(
            f"{len(train) - len(training)} training images are dropped: they have the pose of a test view"
        )
    taken = test_poses | {pose_key(camera) for camera in training}
    validation = _without(taken, [image.camera for image in val])
    if validation_count or not validation:
        validation, training = _split_validation(training, validation_count)
    return ViewSet(
        name, colour, training, validation, [image.camera for image in test], [*train, *val, *test],
        origin=source.origin, notes=(*data_set.report, *notes, *colour_notes, *pose_notes), split=split, misfit=misfit,
    )  # fmt: skip


def _fitting_images(
    source: SplatModel, images: list[PosedImage], background: Colour, name: str, path: str, data: str
) -> tuple[list[PosedImage], str, list[str]]:
    """Return images in coordinates that the scene fits; else as they are, and why it does not fit; and remarks.

    Args:
        source: the scene.
        images: the images of the set, at least one.
        background: background colour.
        name: name of the set.
        path: the scene's file; empty: unknown.
        data: path of the set.
    """
    fit = measure_fit(source, images, background)
    if fit.fits:
        return images, "", []
    origin = np.array(source.origin)
    for others in normalised_images(_shift_origin(images, -origin), path, data) if path else []:
        moved = _shift_origin(others, origin)
        if measure_fit(source, moved, background).fits:
            return moved, "", [f"cameras are in the scene's coordinates by the {NORMALISATION} next to it"]
    misfit = fit.describe(name)
    return images, misfit, [misfit]


def _open_data_set(data: DataOptions, record: TrainingRecord | None) -> tuple[str, DataSet, list[str]]:
    """Return the name of a data set, the set, and remarks if the options contradict the scene's metadata."""
    require_data_sets()
    from csplat_trainer.data.loader import find_image_folder, load

    user_path = data.path
    folder, images = find_image_folder(user_path)
    if images is not None:
        data = replace(data, path=str(folder), images=images)
    options, notes = _complete_options(data, record)
    every = _HOLD_OUT_EVERY if options.test_every is None else options.test_every
    if images is not None:  # the user named the folder of images, which may therefore be a link to anywhere
        options = replace(options, path=user_path, images=None)
    data_set = load(
        options.path, options.size, images=options.images, test_every=every, near=options.near,
        trust_paths=options.trust_paths,
    )  # fmt: skip
    return _view_set_name(data.path), data_set, notes


def _complete_options(data: DataOptions, record: TrainingRecord | None) -> tuple[DataOptions, list[str]]:
    """Return the user's options, completed from the scene's metadata, and remarks on contradictions."""
    values: dict[str, Any] = {}
    notes = []
    for name in (one.name for one in fields(data) if one.name != "path"):
        option, recorded = getattr(data, name), getattr(record, name, None)
        values[name] = recorded if option is None else option
        if option is not None and recorded is not None and option != recorded:
            notes.append(f"{name} is {option}, but the scene was trained with {recorded}")
    return replace(data, **values), notes


def _choose_background(
    background: Colour | None, record: TrainingRecord | None, *, images: bool = False
) -> tuple[Colour, list[str]]:
    """Return the background colour: the user's, the training's, or black; and remarks.

    A remark points out a colour that is not the training's and, with `images`, that the training's is unknown.
    """
    if background is not None:
        if record is None or record.background == background:
            return background, []
        names = [_colour_name(colour) for colour in (background, record.background)]
        return background, [f"background is {names[0]}, but the scene was trained on {names[1]}"]
    if record is not None:
        return record.background, []
    return BLACK, ["the training background is unknown: black is used, set --background to change it"] if images else []


def _view_set_name(path: str) -> str:
    """Return the name of a file or folder, changed if it equals the name of virtual views."""
    name = resolve_links(path).name
    return f"./{name}" if name == VIRTUAL else name


def _colour_name(colour: Colour) -> str:
    """Format a colour as `black`, `white` or `0.5,0.5,0.5`."""
    return {BLACK: "black", WHITE: "white"}.get(colour) or ",".join(f"{value:g}" for value in colour)


def _shift_origin(images: Sequence[PosedImage], shift: NDArray[np.float64]) -> list[PosedImage]:
    """Return the images with cameras relative to a new origin, [3], in coordinates of the old one."""
    return [replace(image, camera=relative_to(shift, image.camera)) for image in images]


def _place_virtual(
    source: SplatModel, count: int, size: tuple[int, int], seed: int, validation_count: int | None
) -> tuple[list[Camera], list[Camera]]:
    """Return virtual training views, and validation views like the views of `psnr` at other positions.

    Training views are `count` and `HELD_OUT_COUNT` more, of `size` (width and height). None are returned for count 0.
    """
    if count < 1:
        return [], []
    sizes = virtual_views.VIRTUAL_SIZES
    usual, width, height = sizes.validation
    kept, sets = (
        (usual, sizes.validation_sets) if validation_count is None else (validation_count, min(1, validation_count))
    )
    validation = [
        camera
        for part in range(sets)
        for camera in virtual_cameras(source, kept, width, height, seed=_VALIDATION_SEED + seed + part * _SET_SEEDS)
    ]
    return camera_sequence(source, count + HELD_OUT_COUNT, size, seed=seed), validation


def _split_validation(cameras: Sequence[Camera], validation_count: int | None) -> tuple[list[Camera], list[Camera]]:
    """Split cameras into validation views, evenly spread, and training views of other poses.

    Args:
        cameras: the cameras.
        validation_count: number of validation views; `None`: one of `_VALIDATION_EVERY` cameras, but at least one of
            two, and none of a single camera.

    Raises:
        InputError: `validation_count` is above 0, and not less than the number of cameras.
    """
    count = len(cameras)
    if validation_count is None:
        every = min(_VALIDATION_EVERY, count)
        places: Collection[int] = range(every // 2, count, every) if count > 1 else ()
    elif validation_count and validation_count >= count:
        raise InputError(f"validation_count is {validation_count}, which leaves none of {count} views for training")
    else:
        # The middles of equal parts.
        places = [(2 * number + 1) * count // (2 * validation_count) for number in range(validation_count)]
    validation, others = _split_at(cameras, places)
    return validation, _without({pose_key(camera) for camera in validation}, others)


def _split_at(cameras: Sequence[Camera], places: Collection[int]) -> tuple[list[Camera], list[Camera]]:
    """Return the cameras at some places, in ascending order, and the others."""
    chosen = set(places)
    return [cameras[i] for i in sorted(chosen)], [camera for i, camera in enumerate(cameras) if i not in chosen]


def _without(poses: Collection[bytes], cameras: Sequence[Camera]) -> list[Camera]:
    """Return the cameras whose pose is not among `poses`."""
    return [camera for camera in cameras if pose_key(camera) not in poses]

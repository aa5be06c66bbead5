"""`find_view_set`: assign views their roles: training (teach), validation (decide), and test (judge).

| views | teach | decide | judge |
|---|---|---|---|
| virtual | `count` small ones and 16 more, all around | twelve like those of `psnr` | the eight of `psnr` |
| camera file, 40 or more | the others | every 8th of the others | every 4th, 24 at most |
| camera file, fewer | virtual ones | virtual ones | all |
| data set | training photographs | 16 for validation at most, else every 8th that teaches | held-out ones |
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from csplat.errors import InputError
from csplat.model import SplatModel
from csplat.training_record import TrainingRecord
from csplat_render import Camera
from csplat_render.camera import relative_to
from csplat_render.camera_files import load_cameras
from csplat_render.virtual_cameras import virtual_cameras
from csplat_tools.files.extras import need_photographs
from csplat_tools.views import placing
from csplat_tools.views.placing import CHECKS, camera_sequence, evenly, usual_views
from csplat_tools.views.viewset import BLACK, SPLITS, VIRTUAL, WHITE, Colour, Split, ViewSet, pose

if TYPE_CHECKING:
    from csplat_trainer.posed_images import PosedImage


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
    return virtual_cameras(source, *placing.VIRTUAL_SIZES.judging, seed=0, every=every)


def find_view_set(
    source: SplatModel,
    *,
    cameras: str | None = None,
    data: DataOptions | None = None,
    background: Colour | None = None,
    count: int | None = None,
    size: tuple[int, int] | None = None,
    seed: int = 0,
    aside: int | None = None,
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
            virtual training or validation views. `None`: by the number of splats (`usual_views`).
        size: width and height of virtual training views, pixels; `None`: by the number of splats.
        seed: seed of virtual training and validation views.
        aside: number of validation views; `None`: as in the table; 0: none that could be training views.
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
    usual = usual_views(every * len(source))
    count, size = usual[0] if count is None else count, size or usual[1]
    if data is not None:
        return _of_data(source, data, background, aside, split)
    if cameras is None:
        judges = comparison_cameras(source, every)
        judging = {pose(camera) for camera in judges}  # in a scene without splats all views are alike
        teaches, decides = (_without(judging, part) for part in _virtual(source, count, size, seed, aside))
        notes = (
            () if every < 2 else (f"the scene is not in memory: one in {every} of its splats says where views stand",)
        )
        colour = background or BLACK
        return ViewSet(VIRTUAL, colour, teaches, decides, judges, virtual=True, origin=source.origin, notes=notes)
    return _of_file(source, cameras, background, (count, size, seed), aside)


def with_deciders(views: ViewSet) -> ViewSet:
    """Return the views; if there are no validation views, every eighth training view becomes one."""
    if views.decides:
        return views
    decides, teaches = _apart(views.teaches, None)
    return replace(views, teaches=teaches, decides=decides)


def _of_file(
    source: SplatModel,
    path: str,
    background: Colour | None,
    virtual: tuple[int, tuple[int, int], int],
    aside: int | None,
) -> ViewSet:
    report: list[str] = []
    given = list({pose(camera): camera for camera in load_cameras(path, report, source.origin)}.values())
    said = TrainingRecord.of(source.metadata)
    colour, notes = _colour(background, said)
    few = len(given) < _ENOUGH
    if few:
        judging = {pose(camera) for camera in given}
        judges = given
        teaches, decides = (_without(judging, part) for part in _virtual(source, *virtual, aside))
    else:
        every = range(0, len(given), _JUDGE_EVERY)
        judges, rest = _parted(given, evenly(every, _MOST_JUDGES))
        decides, teaches = _apart(rest, aside)
    return ViewSet(
        _named_file(path), colour, teaches, decides, judges, virtual=few, origin=source.origin,
        notes=(*report, *notes),
    )  # fmt: skip


def _of_data(
    source: SplatModel, data: DataOptions, background: Colour | None, aside: int | None, split: Split
) -> ViewSet:
    need_photographs()
    from csplat_trainer.data import load

    said = TrainingRecord.of(source.metadata)
    wanted, notes = _settled(data, said)
    every = _TEST_EVERY if wanted.test_every is None else wanted.test_every
    found = load(wanted.path, wanted.size, images=wanted.images, test_every=every, near=wanted.near)
    shift = np.subtract(source.origin, found.origin)
    parts = (found.train, found.test, evenly(found.val, _MOST_DECIDING))
    train, test, val = (_moved(part, shift) for part in parts)
    colour, more = _colour(background, said, photographs=True)
    if split == "train":
        train, test, val = [], train, []
    judging = {pose(one.camera) for one in test}
    apart = _without(judging, [one.camera for one in train])
    if len(apart) < len(train):
        more.append(f"{len(train) - len(apart)} training photographs stand where others judge, and are left out")
    decides, teaches = _without(judging | {pose(camera) for camera in apart}, [one.camera for one in val]), apart
    if aside or not decides:
        decides, teaches = _apart(apart, aside)
    return ViewSet(
        _named_file(data.path), colour, teaches, decides, [one.camera for one in test], [*train, *val, *test],
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
    source: SplatModel, count: int, size: tuple[int, int], seed: int, aside: int | None
) -> tuple[list[Camera], list[Camera]]:
    """Return virtual training and validation views; the latter are like the test views of `psnr`, at other places."""
    if count < 1:
        return [], []
    usual, width, height = placing.VIRTUAL_SIZES.deciding
    kept = usual if aside is None else aside
    decides = virtual_cameras(source, kept, width, height, seed=_DECIDING_SEED + seed) if kept else []
    return camera_sequence(source, count + CHECKS, size, seed=seed), decides


def _apart(cameras: Sequence[Camera], aside: int | None) -> tuple[list[Camera], list[Camera]]:
    """Split cameras into validation views, evenly spread, and training views without those of the same pose."""
    count = len(cameras)
    if aside is None:
        every = min(_DECIDE_EVERY, count)
        places: Collection[int] = range(every // 2, count, every) if count > 1 else ()
    elif aside and aside >= count:
        raise InputError(f"{aside} of {count} views to decide by leave none to learn from")
    else:
        places = [(2 * number + 1) * count // (2 * aside) for number in range(aside)]
    decides, others = _parted(cameras, places)
    return decides, _without({pose(camera) for camera in decides}, others)


def _parted(cameras: Sequence[Camera], places: Collection[int]) -> tuple[list[Camera], list[Camera]]:
    chosen = set(places)
    return [cameras[i] for i in sorted(chosen)], [one for i, one in enumerate(cameras) if i not in chosen]


def _without(judging: Collection[bytes], cameras: Sequence[Camera]) -> list[Camera]:
    """Return the cameras whose pose is not in `judging`."""
    return [one for one in cameras if pose(one) not in judging]

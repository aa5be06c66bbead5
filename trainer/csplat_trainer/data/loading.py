"""`load`: recognise a data set, find its pictures and cameras, say what was found."""

from __future__ import annotations

import math
import os
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from csplat.errors import InputError, counted
from csplat.model import UNSPECIFIED
from csplat.upright import Direction, up_of_axes
from csplat_render.camera import MAX_IMAGE_SIZE
from csplat_trainer.data.checks import check_shots, notes_on_images, notes_on_lenses, notes_on_poses
from csplat_trainer.data.colmap import find_model, read_colmap
from csplat_trainer.data.dataset import DataSet, Found, Shot, near_plane
from csplat_trainer.data.image_pixels import opaque_images, read_head
from csplat_trainer.data.level import find_level
from csplat_trainer.data.pixels import picture_of
from csplat_trainer.data.placement import centre, describe_outliers
from csplat_trainer.data.transforms import read_blender, read_transforms

_NAMED = 3  # folders in a message, at most
_AGREES = math.cos(math.radians(30.0))  # of the custom of a kind of set with its cameras


def load(
    path: str | os.PathLike[str],
    size: tuple[int, int] | None = None,
    *,
    images: str | None = None,
    test_every: int = 8,
    near: float | None = None,
) -> DataSet:
    """Find the posed pictures of a data set. Their pixels are read when they are asked for, or by `DataSet.read`.

    | recognised by | kind |
    |---|---|
    | `transforms_train.json` | NeRF-synthetic, made with Blender; RGBA |
    | `transforms.json` | instant-ngp, nerfstudio |
    | `sparse/0/cameras.bin` or `.txt` | COLMAP, as Mip-NeRF 360, Tanks and Temples, Deep Blending are laid out |

    What files state is checked against what they hold: `checks`. Lenses are straightened: `lens`.

    Args:
        path: its folder, or the `transforms.json`.
        size: width and height to bring all pictures to, each axis by itself; `None`: as they are.
        images: the folder of images, `images_4`; `None`: as the set says, of COLMAP sets with `size` the smallest
            that is large enough.
        test_every: which share is held out where the set names no test pictures; 0: none.
        near: near plane of the cameras, scene units; `None`: one that suits the set.

    Returns:
        All pictures, undistorted, with their cameras.

    Raises:
        InputError: there is no data set, it is damaged, or it holds no pictures.
    """
    path = Path(path)
    if size is not None and not all(1 <= side <= MAX_IMAGE_SIZE for side in size):
        raise InputError(f"pictures of {size[0]}×{size[1]} pixels, wanted 1 to {MAX_IMAGE_SIZE} each way")
    found = _find(path, size, images, test_every)
    if not found.train:
        raise InputError(f"{path} leaves no images to train on")
    doubts = notes_on_poses([*found.train, *found.test], found.points)
    found, origin = centre(found)
    shots = [*found.train, *found.test]
    heads = {shot.path: read_head(shot.path) for shot in (*shots, *found.val)}
    check_shots([*shots, *found.val], heads)
    opaque = opaque_images(heads.values())
    heads |= {head.path: replace(head, has_alpha=False) for head in opaque}
    near = near_plane(shots, found.points) if near is None else near
    train, test, val = (
        [picture_of(shot, heads[shot.path], size, near) for shot in part]
        for part in (found.train, found.test, found.val)
    )
    name = f"{found.kind} {path}"
    sizes = sorted({(picture.camera.W, picture.camera.H) for picture in (*train, *test)})
    shown = ", ".join(f"{width}×{height}" for width, height in sizes[:3]) + (", …" if len(sizes) > 3 else "")
    points = "" if found.points is None else f", {counted(len(found.points), 'point')}"
    counts = f"{len(found.train)} training and {counted(len(found.test), 'test image')}"
    counts += f", {len(found.val)} for validation," if found.val else ""
    report = [f"{name}: {counts} of {shown} pixels{points}", *found.report]
    masked = sum(shot.mask is not None for shot in shots)
    if masked:
        report.append(f"masks hide parts of {counted(masked, 'image')}: they do not count")
    if opaque:
        report.append(f"alpha is 1 all over {counted(len(opaque), 'image')}: they count as images without alpha")
    report += [*notes_on_lenses(shots), *notes_on_images(shots, heads), *doubts]
    with_alpha = sum(heads[shot.path].has_alpha for shot in shots)
    if 0 < with_alpha < len(shots):
        background = "white" if 2 * with_alpha >= len(shots) else "black"
        report.append(f"{with_alpha} of {len(shots)} images have transparency: the background of all is {background}")
    taught = {shot.path for shot in found.train}
    both = sum(shot.path in taught for shot in found.test)
    if both:
        report.append(f"{counted(both, 'test image')} used for training, too: they do not show what new views are like")
    if found.points is None and not any(picture.has_alpha for picture in train):
        report.append("there are no points: splats start anywhere in view")
    colours = found.points_rgb
    if colours is not None and len(colours) and (colours == colours[0]).all():
        shade = " ".join(f"{value:.3g}" for value in colours[0].tolist())
        report.append(f"all points have the colour {shade}: splats start with the colours of the images there")
        colours = None
    axes, up, said = _upright(found.coordinate_system, shots)
    data = DataSet(
        name,
        train,
        test,
        None if found.points is None else found.points.astype(np.float32),
        colours,
        tuple(line for line in (*report, said) if line),
        axes,
        up,
        found.test_every,
        size,
        images,
        val,
        origin,
    )
    outliers = describe_outliers(data)
    return replace(data, report=(*data.report, outliers)) if outliers else data


def _upright(custom: str, shots: Sequence[Shot]) -> tuple[str, Direction | None, str]:
    """The axes of a set, which way is up, and that in words.

    Args:
        custom: axes that sets of this kind have. Some people keep other coordinates in its files: then the cameras
            say up.
        shots: all of the set.
    """
    level, usual = find_level([shot.viewmat for shot in shots]), up_of_axes(custom)
    if level is None:
        return custom, usual, "" if usual else "which way is up is not known: the cameras were held at all angles"
    if usual is None:
        return custom, level.up, str(level)
    if sum(a * b for a, b in zip(usual, level.up, strict=True)) < _AGREES:
        return UNSPECIFIED, level.up, f"{level}; sets of this kind mostly have other axes"
    return custom, usual, ""


def _find(path: Path, size: tuple[int, int] | None, images: str | None, test_every: int) -> Found:
    if path.is_file() and path.suffix.lower() == ".json":
        if path.name == "transforms_train.json":
            return read_blender(path.parent, images)
        return read_transforms(path, test_every, images)
    if not path.is_dir():
        zipped = path.suffix.lower() == ".zip" and path.is_file()
        remedy = ": unpack it, and name the folder" if zipped else ""
        raise InputError(f"{path} is neither a folder nor a transforms.json{remedy}")
    model = find_model(path)
    if (path / "transforms_train.json").is_file():
        found = read_blender(path, images)
    elif (path / "transforms.json").is_file():
        found = read_transforms(path / "transforms.json", test_every, images)
    elif model is not None:
        found = read_colmap(path, model[0], size, images, test_every)
        return replace(found, report=[*model[1], *found.report])
    else:
        raise InputError(
            f"{path} is no data set: expected transforms_train.json (Blender), transforms.json (instant-ngp) "
            f"or sparse/0/cameras.bin (COLMAP){_hint(path)}"
        )
    if model is not None:
        found = replace(found, report=[*found.report, "there is a COLMAP model too, which is not read"])
    if found.kind == "Blender set" and (path / "transforms.json").is_file():
        found = replace(found, report=[*found.report, "there is a transforms.json too, which is not read"])
    return found


def _hint(path: Path) -> str:
    """Say where a data set is instead, as far as that is to be seen."""
    folders = [*sorted(path.glob("*/")), *sorted(path.glob("*/*/"))]
    names = ("transforms_train.json", "transforms.json")
    sets = [one for one in folders if any((one / name).is_file() for name in names) or find_model(one)]
    if sets:
        return (
            "; " + ", ".join(one.relative_to(path).as_posix() for one in sets[:_NAMED]) + " in it may be what you want"
        )
    if (path / "database.db").is_file():
        return "; it holds a database of COLMAP, but no model yet: run `colmap mapper`"
    return ""

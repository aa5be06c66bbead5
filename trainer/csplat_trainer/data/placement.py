"""Position of a data set: the origin of its coordinates, and the cameras that are far away from all others."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from csplat.errors import InputError, counted
from csplat.types import F64
from csplat_render.camera import camera_outliers, nearest_point
from csplat_trainer.data.dataset import DataSet, Found, Shot
from csplat_trainer.data.image_files import shown

Origin = tuple[float, float, float]

_NEAR_SIZES = 256.0  # sizes of the scene; farther from 0, a step of float32 is more than 1.5e-5 of that size


def centre(found: Found) -> tuple[Found, Origin]:
    """Choose an origin for a set, and measure its cameras and points from there.

    The origin is 0 if the set lies around 0 or near it. Else it is the middle of the cameras, rounded to a power of
    ten below the size of the scene: coordinates of maps (UTM, ECEF) are millions of metres, of which float32 holds
    halves.

    Args:
        found: result of a reader.

    Returns:
        The set relative to the origin, and the origin.

    Raises:
        InputError: a camera's position exceeds float32.
    """
    shots = [*found.train, *found.test, *found.val]
    viewmats = np.stack([shot.viewmat for shot in shots])
    for shot in shots:
        if not np.abs(shot.viewmat[:3, 3]).max() < np.finfo(np.float32).max:
            far = float(np.abs(shot.viewmat[:3, 3]).max())
            raise InputError(f"the camera of {shot.name} stands {far:.3g} units from 0, expected a place in the scene")
    viewmats = viewmats[~camera_outliers(viewmats, found.points)]
    positions = -np.einsum("nji,nj->ni", viewmats[:, :3, :3], viewmats[:, :3, 3])
    middle = np.median(positions, axis=0)
    if found.points is not None and len(found.points):
        subject = np.median(found.points, axis=0) - middle
    else:
        subject = nearest_point(positions - middle, viewmats[:, 2, :3])
    spread = float(np.median(np.linalg.norm(positions - middle, axis=1)))
    size = max(spread, float(np.linalg.norm(subject)))
    if size == 0.0 or np.abs(middle).max() <= _NEAR_SIZES * size:
        return found, (0.0, 0.0, 0.0)
    digits = -math.floor(math.log10(size))
    x, y, z = (round(value, digits) + 0.0 for value in middle.tolist())  # no negative zeros
    origin = np.array([x, y, z])
    train, test, val = ([_moved(shot, origin) for shot in part] for part in (found.train, found.test, found.val))
    points = None if found.points is None else found.points - origin
    words = " ".join(str(value).removesuffix(".0") for value in (x, y, z))
    report = f"coordinates lie far from 0: the scene is measured from its origin, {words}"
    return replace(found, train=train, test=test, val=val, points=points, report=[*found.report, report]), (x, y, z)


def describe_outliers(data: DataSet) -> str:
    """Name the cameras that are far away from all others, in a sentence; return "" if there are none.

    They stay training, validation or test images: a training image that shows nothing has no effect.
    """
    if not data.outliers:
        return ""
    positions = np.stack([image.camera.position for image in (*data.outliers, *data.train, *data.test, *data.val)])
    distances = np.linalg.norm(positions - np.median(positions[len(data.outliers) :], axis=0), axis=1)
    nearest, usual = float(distances[: len(data.outliers)].min()), float(np.median(distances[len(data.outliers) :]))
    times = f", {nearest / usual:,.4g} times the usual distance" if usual > 0.0 else ""
    names = [str(image.camera.image) for image in data.outliers]
    who = f"the camera of {names[0]} stands" if len(names) == 1 else f"the cameras of {shown(names)} stand"
    text = f"{who} {nearest:,.4g} units from the others{times}: not counted for the scene's extent; check the poses"
    tested = sum(image in data.test for image in data.outliers)
    return f"{text}, {counted(tested, 'test image')} will score badly" if tested else text


def _moved(shot: Shot, origin: F64) -> Shot:
    viewmat = shot.viewmat.copy()
    viewmat[:3, 3] += viewmat[:3, :3] @ origin
    return replace(shot, viewmat=viewmat)

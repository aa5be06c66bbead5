# SPDX-License-Identifier: Apache-2.0
"""Checks of a data set's consistency: sizes, lenses, poses; and notes on the interpretation of its files."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from csplat.errors import InputError, counted
from csplat.image_opener import open_image
from csplat_render.camera import camera_outliers, convergence, nearest_point
from csplat_render.camera_files import check_intrinsics
from csplat_trainer.data.dataset import Shot, shown_size
from csplat_trainer.data.image_pixels import ImageHeader, mask_values, value_range
from csplat_trainer.data.lens import Lens, undistorted_lens

_ROUNDING = 1.0  # pixels by which each side of a scaled-down image may be rounded
_NEARLY = 0.02  # relative difference of both scales, beyond which an image is turned or a mask belongs to another
_LARGER = 16  # pixels of an image per pixel of its camera, at most: four times its width and height
_FREE_PIXELS = 1 << 22  # images of at most this many pixels are read whatever the size of their camera
_MIDDLE = (0.25, 0.75)  # fractions of the image; principal points outside this range are reported
_SMALL_RANGE = 1.0 / 8.0  # fraction of the 16-bit range; 12-bit images use less
_SAME = 1e-9  # relative difference of positions; coordinates of maps are a million times the distance of cameras
_FEW = 4  # cameras; fewer need not have a common subject
_AIMED = 0.98  # median cosine, see `convergence`
_PARALLEL = 0.05  # least mean square across lines of sight that are not parallel
_MEETING = 0.1  # fraction of the distance to a point; lines of sight that pass it at less meet there
_SHOTS, _POINTS = 64, 4096  # largest numbers of shots and points to check for visibility


def check_shots(shots: Sequence[Shot], heads: Mapping[Path, ImageHeader]) -> None:
    """Check that lenses are plausible, and that images fit their cameras and masks their images.

    Args:
        shots: all shots of a set.
        heads: headers of their image files.

    Raises:
        InputError: the set is inconsistent.
    """
    for lens in {shot.lens: None for shot in shots}:
        check_intrinsics((lens.fx, lens.fy), (lens.cx, lens.cy), (lens.width, lens.height), lens.source)
    for shot in shots:
        lens, size = shot.lens, shown_size(shot.path, heads[shot.path].size, shot.lens)
        expected = (lens.width, lens.height)
        if _aspect_mismatch(size, expected) > _NEARLY >= _aspect_mismatch((size[1], size[0]), expected):
            source = f"given by {lens.source}" if lens.source else "that of its camera"
            remedy = "the sides are swapped: turn the images, or compute poses of the images as stored"
            raise _aspect_error(shot.path, size, expected, source, remedy)
        _check_size(shot.path, size, expected, "its camera")
        if shot.mask is not None:
            with open_image(shot.mask, budget=False) as image:
                mask_size = image.size
            _check_size(shot.mask, mask_size, size, f"its image ({shot.name})")
            mask_size = shown_size(shot.mask, mask_size, lens)
            if _aspect_mismatch(mask_size, size) > _NEARLY:
                remedy = "it is the mask of another image"
                raise _aspect_error(shot.mask, mask_size, size, f"that of its image ({shot.name})", remedy)


def describe_images(shots: Sequence[Shot], heads: Mapping[Path, ImageHeader]) -> list[str]:
    """Report pixel formats, orientations and masks with more than one interpretation.

    Raises:
        InputError: a file is damaged.
    """
    notes = []
    for stored_as in sorted({head.stored_as for head in heads.values()} - {""}):
        files = [path for path, head in heads.items() if head.stored_as == stored_as]
        low, high, white = value_range(files[0])
        line = f"{counted(len(files), 'image')} of {stored_as}: 0 to {white:g} is read as black to white"
        line += f"; the first, {files[0].name}, has {low:g} to {high:g}"
        notes.append(line + (": scale them if that is too dark" if high < _SMALL_RANGE * white else ""))
    several = [head for head in heads.values() if head.has_others]
    if several:
        what = f"{counted(len(several), 'file')} with several images: the first of each is read"
        notes.append(f"{what} (such as {several[0].path.name})")
    sizes = {shot.path: shown_size(shot.path, heads[shot.path].size, shot.lens) for shot in shots}
    misfits = [shot for shot in shots if _aspect_mismatch(sizes[shot.path], (shot.lens.width, shot.lens.height)) > 0.0]
    if misfits:
        (width, height), lens = sizes[misfits[0].path], misfits[0].lens
        notes.append(
            f"{counted(len(misfits), 'image')} with another aspect ratio than their cameras ({misfits[0].path.name}: "
            f"{width}×{height}, {lens.width:g}×{lens.height:g}): each side is scaled separately, as for squeezed "
            "images; cropped images require other intrinsics"
        )
    turned = [path for path, size in sizes.items() if size != heads[path].size]
    if turned:
        many = counted(len(turned), "image")
        notes.append(f"{many} turned as EXIF specifies, since their cameras have the size of turned images")
    as_stored = [head for path, head in heads.items() if path not in turned and _turn_is_undecided(head)]
    if as_stored:
        notes.append(
            f"EXIF turns {counted(len(as_stored), 'image')} ({as_stored[0].path.name}: orientation "
            f"{as_stored[0].orientation}): read as stored; if their poses are of turned images, turn the files"
        )
    mask = next((shot.mask for shot in shots if shot.mask is not None), None)
    if mask is not None:
        with open_image(mask, budget=False) as image:
            taken_as = mask_values(image, mask).taken_as
        if taken_as:
            notes.append(f"masks such as {mask.name}: {taken_as}")
    return notes


def describe_lenses(shots: Sequence[Shot]) -> list[str]:
    """Report distortions that are undone, and principal points far from the middle."""
    notes = []
    lenses = list({shot.lens: None for shot in shots})
    bent = [(lens, undistorted_lens(lens)) for lens in lenses if lens.distorts]
    if bent:
        zoom = max(straight.fx / lens.fx for lens, straight in bent)
        notes.append(f"lens distortion is undone, the images are enlarged by up to {100 * (zoom - 1):.1f} %")
    wide = [straight for lens, straight in bent if lens.projection == "equidistant"]
    if wide:
        angle = min(2.0 * math.degrees(math.atan(0.5 * straight.width / straight.fx)) for straight in wide)
        notes.append(f"fisheye images are cropped to the view of a pinhole: {angle:.0f} degrees across")
    off = [lens for lens in lenses if not _is_in_the_middle(lens)]
    if off:
        lens = off[0]
        notes.append(
            f"{lens.source}: the principal point is {lens.cx:g} {lens.cy:g} in {lens.width:g}×{lens.height:g} pixels, "
            "far from the middle: is it that of another size?"
        )
    return notes


def describe_poses(shots: Sequence[Shot], points: NDArray[np.floating[Any]] | None) -> list[str]:
    """Report cameras that are all at one place, see none of the points, or seem to be inverted poses.

    Args:
        shots: all training and test images.
        points: [P, 3], points of the set, or `None`.
    """
    notes = []
    places = np.stack([-shot.viewmat[:3, :3].T @ shot.viewmat[:3, 3] for shot in shots])
    spread = np.ptp(places, axis=0).max()
    if len(shots) > 1 and spread <= _SAME * (1.0 + np.abs(places).max()):
        notes.append(f"all {len(shots)} cameras are at one place: these images do not determine depth")
    if points is not None and len(points):
        some_shots, some_points = shots[:: -(-len(shots) // _SHOTS)], points[:: -(-len(points) // _POINTS)]
        blind = [shot for shot in some_shots if not _sees_any(shot, some_points)]
        if 2 * len(blind) > len(some_shots):
            inverted = [replace(shot, viewmat=np.asarray(np.linalg.inv(shot.viewmat))) for shot in blind]
            cause = "check that poses and points belong to the same scene"
            if 2 * sum(_sees_any(shot, some_points) for shot in inverted) > len(blind):
                cause = "with inverted poses they would: invert the poses in the file"
            what = f"{len(blind)} of {len(some_shots)} cameras ({blind[0].name}, …) see none of the points"
            return [*notes, f"{what}: {cause}"]
        return notes
    viewmats = np.stack([shot.viewmat for shot in shots])
    if len(shots) >= _FEW and _is_panorama(viewmats[~camera_outliers(viewmats)]):
        notes.append(
            "all cameras look outwards, as in a panorama: if that is wrong, the poses are inverted, or have other axes"
            " than files of this kind"
        )
    return notes


def _is_panorama(viewmats: NDArray[np.float64]) -> bool:
    """Return True if the lines of sight of cameras [V, 4, 4] meet in a point behind the cameras."""
    axes = viewmats[:, 2, :3]
    positions = -np.einsum("nji,nj->ni", viewmats[:, :3, :3], viewmats[:, :3, 3])
    positions = positions - positions.mean(axis=0)
    across = np.eye(3) - axes[:, :, None] * axes[:, None, :]
    if np.linalg.eigvalsh(across.mean(axis=0))[0] < _PARALLEL:
        return False
    towards = nearest_point(positions, axes) - positions
    missed = np.linalg.norm(np.einsum("nij,nj->ni", across, towards), axis=1)
    distance = float(np.median(np.linalg.norm(towards, axis=1)))
    return convergence(positions, axes) < -_AIMED and float(np.median(missed)) < _MEETING * distance


def _sees_any(shot: Shot, points: NDArray[np.floating[Any]]) -> bool:
    """Return True if any point of [M, 3] is in front of a camera, and within twice the size of its image."""
    x, y, z = (points @ shot.viewmat[:3, :3].T + shot.viewmat[:3, 3]).T
    lens = shot.lens
    across, down = np.abs(x) * lens.fx <= lens.width * z, np.abs(y) * lens.fy <= lens.height * z
    return bool(((z > 0.0) & across & down).any())


def _check_size(path: Path, size: tuple[int, int], expected: tuple[float, float], of: str) -> None:
    """Refuse an image that is much larger than expected, before it is decoded: a few bytes can be a billion pixels."""
    most = max(_FREE_PIXELS, _LARGER * expected[0] * expected[1])
    if size[0] * size[1] > most:
        raise InputError(
            f"{path} has {size[0]}×{size[1]} pixels, expected about {expected[0]:g}×{expected[1]:g} as {of}: scale it"
        )


def _aspect_error(
    path: Path, size: tuple[int, int], expected: tuple[float, float], source: str, remedy: str
) -> InputError:
    """Return the error for an image whose aspect ratio is not that expected by `source`, a phrase for the message."""
    actual, shape = f"{size[0]}×{size[1]}", f"{expected[0]:g}×{expected[1]:g}"
    return InputError(f"{path} has {actual} pixels, expected the aspect ratio of {shape}, {source}: {remedy}")


def _aspect_mismatch(size: tuple[int, int], expected: tuple[float, float]) -> float:
    """Return the relative difference of an image's scales along both sides; 0 if rounding explains it."""

    def scale_range(side: int, expected_side: float) -> tuple[float, float]:
        """Return the least and the largest scale that rounding of both sides allows."""
        least_side = max(expected_side - _ROUNDING, 0.5)  # above 0
        return (side - _ROUNDING) / (expected_side + _ROUNDING), (side + _ROUNDING) / least_side

    low_x, high_x = scale_range(size[0], expected[0])
    low_y, high_y = scale_range(size[1], expected[1])
    if max(low_x, low_y) <= min(high_x, high_y):
        return 0.0
    across, down = size[0] / expected[0], size[1] / expected[1]
    return max(across / down, down / across) - 1.0


def _is_in_the_middle(lens: Lens) -> bool:
    """Return True if the principal point is within `_MIDDLE` of both sides."""
    low, high = _MIDDLE
    return low <= lens.cx / lens.width <= high and low <= lens.cy / lens.height <= high


def _turn_is_undecided(head: ImageHeader) -> bool:
    """Return True if EXIF turns an image, and its camera's size does not show if poses are of the turned image."""
    width, height = head.size
    return head.orientation in (2, 3, 4) or (head.orientation in (5, 6, 7, 8) and width == height)

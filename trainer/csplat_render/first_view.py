# SPDX-License-Identifier: Apache-2.0
"""Choose the first view of a scene, which files store for all viewers (key `view` of META, spec 5.4).

It depends on the source alone, so that every encoding of a scene has the same. A view that the scene has already
stays. *Surroundings* with training cameras get the most typical of these. Otherwise the view is an estimate: an
*object* is shown whole, from the front if its axes name one, else from the side that shows most detail. A closed *room*
is seen from inside, and other surroundings from the place around their dense middle that shows most detail.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from csplat.errors import InputError
from csplat.model import SplatModel
from csplat.scene_metadata import ESTIMATE, TRAINED, UNSPECIFIED, VIEW, SceneMetadata
from csplat.types import F64
from csplat_render.camera import Camera, central_camera, direction_at, intrinsics, look_at
from csplat_render.camera_paths import ELEVATION, main_parts, orbit_framing
from csplat_render.scene_frame import Cloud, SceneFrame, detail, object_body, sample_cloud, viewing_frame
from csplat_render.up_estimate import POINTS_PER_SPLAT, estimate_up
from csplat_render.virtual_cameras import HIDING

#: Largest number of splats that the choice considers; all of a million would take 1.4 CPU s.
SAMPLE_SPLATS = 50_000

_POINTS = 16_000  # cloud points, but at most POINTS_PER_SPLAT for each splat
_FIELD_OF_VIEW = 50.0  # degrees, of a square image: viewers fit all of it into their canvas, wide or tall
_SIDE = 640  # pixels of the image's side
_TURNS = 24  # number of azimuths to try
_ASIDE = math.degrees(0.4)  # from the front, where an object looks less flat
_BESIDE = 0.8  # weight of the detail of other sides than the front of unnamed axes, which is a guess
_DISTANCES = (1.7, 1.3, 0.8, 0.5)  # extents, from the middle of surroundings
_ELEVATIONS = (3.0, 15.0, 35.0)  # degrees, in surroundings
_NEARER = 0.9  # weight of the detail of a view of surroundings, next to that of the next farther one
_ROOM_ELEVATION = 7.0  # degrees
_ROOM_DISTANCE = 0.5  # from the middle of a room, as a fraction of the way to the wall
_WALL = 0.08  # depth of a wall, as a fraction of a box's side
_WALL_CELLS = 6  # per side of a wall
_WALL_COVER = 0.9  # minimum fraction of a wall's cells with points
_WALLS = 3  # minimum number of closed sides of a room, of four
_INNER = 0.15  # maximum fraction of a room's points that are in the inner half of its box along each axis
_BOX_QUANTILES = (0.01, 0.99)  # quantiles of a room's points, per axis, that bound its box
_TINY = 1e-9  # avoids divisions by 0
_DIGITS = 6  # significant digits of the values in files; hides rounding, which differs between machines


def viewing_metadata(model: SplatModel, cameras: Sequence[Camera] = (), *, every: int = 1) -> SceneMetadata:
    """Return the metadata of a scene with a first view and, if an up direction is missing, its estimate.

    Args:
        model: the scene, or every Nth of its splats.
        cameras: its training cameras. Default: those of its metadata.
        every: number of splats of the full scene that each splat of the model represents.

    Returns:
        Metadata with the keys `view` and, unless the estimate is uncertain, `up`. A scene without splats, or so large
        that float32 does not hold its camera, gets no view.

    Examples:
        >>> import csplat
        >>> from csplat_render.first_view import viewing_metadata
        >>> model = csplat.read("scene.ply")
        >>> csplat.encode(model.with_metadata(viewing_metadata(model)), out="small.csplat")
    """
    step = max(1, -(-len(model) // SAMPLE_SPLATS))
    model, every = model.select(slice(None, None, step)), every * step
    metadata = model.metadata.with_up(estimate_up(model, every), estimated=True)
    if VIEW in metadata.entries or not len(model):
        return metadata
    frame = viewing_frame(model.with_metadata(metadata))
    known = [] if frame.kind == "object" else cameras or _cameras_of(metadata)
    if known:
        return metadata.with_entries(view=view_entry(central_camera(known), TRAINED))
    body = object_body(model, frame)
    cloud = sample_cloud(body, min(_POINTS, POINTS_PER_SPLAT * len(body)), np.random.default_rng(0), every)
    try:
        return metadata.with_entries(view=view_entry(_estimate(metadata, cloud, frame), ESTIMATE))
    except InputError:
        return metadata


def first_view(model: object) -> Camera:
    """Return the first view of a `SplatModel`: the one that its metadata state, or that `viewing_metadata` chooses.

    Raises:
        InputError: it has none, or is not a `SplatModel`.
    """
    view = viewing_metadata(model).entries.get(VIEW) if isinstance(model, SplatModel) else None
    if not isinstance(view, dict):
        raise InputError("no camera is given, and what is to be rendered has no first view")
    return Camera.from_json(view)


def _cameras_of(metadata: SceneMetadata) -> list[Camera]:
    """Return the cameras of the metadata; none if one is invalid."""
    try:
        return [Camera.from_json(entry) for entry in metadata.cameras or ()]
    except InputError:
        return []


def view_entry(camera: Camera, source: str) -> dict[str, Any]:
    """Return a camera as the entry `view`, with the principal point in the middle of its image.

    Args:
        camera: the camera.
        source: `TRAINED`, `ESTIMATE` or `AUTHOR`.
    """
    entry = {key: value for key, value in camera.as_json().items() if key != "image"}
    entry["K"][0][2], entry["K"][1][2] = camera.W / 2, camera.H / 2  # engines have no other principal point
    for name in ("K", "viewmat"):
        entry[name] = [[_rounded(value) for value in row] for row in entry[name]]
    return {**entry, "near": _rounded(camera.near), "from": source}


def _rounded(value: float) -> float:
    """Round to significant digits; whole numbers become int, and −0 becomes 0, which makes their JSON shorter."""
    value = float(f"{value:.{_DIGITS}g}")
    return int(value) if value == int(value) else value


def _estimate(metadata: SceneMetadata, cloud: Cloud, frame: SceneFrame) -> Camera:
    """Return the view with the most detail among those that suit the kind of scene."""
    azimuths, nearest = _azimuths(metadata, frame), 0.0
    if frame.kind == "surrounding":
        nearest = HIDING * frame.extent
        views = [
            (_NEARER**step, _view(frame, frame.centre, azimuth, elevation, distance * frame.extent))
            for step, distance in enumerate(_DISTANCES)
            for elevation in _ELEVATIONS
            for azimuth in azimuths
        ]
    elif _is_room(cloud.points, frame.up):
        low, high = _box(cloud.points)
        views = []
        for azimuth in azimuths:
            way = np.abs(direction_at(frame.up, azimuth, _ROOM_ELEVATION))
            to_wall = float(np.min((high - low) / 2.0 / np.maximum(way, _TINY)))
            views.append((1.0, _view(frame, (low + high) / 2.0, azimuth, _ROOM_ELEVATION, _ROOM_DISTANCE * to_wall)))
    else:
        K = intrinsics(_SIDE, _SIDE, _FIELD_OF_VIEW)
        centre, distance = orbit_framing(main_parts(cloud, frame), frame, ELEVATION, K, _SIDE, _SIDE)
        if metadata.coordinate_system != UNSPECIFIED:
            azimuths = azimuths[:1]
        views = [
            (_BESIDE if place else 1.0, _view(frame, centre, azimuth, ELEVATION, distance))
            for place, azimuth in enumerate(azimuths)
        ]
    scores = [weight * detail(cloud, view, nearest) for weight, view in views]
    return views[int(np.argmax(scores))][1]


def _view(frame: SceneFrame, centre: F64, azimuth: float, elevation: float, distance: float) -> Camera:
    """Return a camera with a square image that looks at `centre`; angles in degrees, distance in scene units."""
    eye = centre + distance * direction_at(frame.up, azimuth, elevation)
    K = intrinsics(_SIDE, _SIDE, _FIELD_OF_VIEW)
    return look_at(eye, centre, frame.up, K, _SIDE, _SIDE, frame.near)


def _azimuths(metadata: SceneMetadata, frame: SceneFrame) -> list[float]:
    """Return azimuths all around, degrees, the first one slightly beside the front: that of the axes, or of RDF."""
    axes = "RDF" if metadata.coordinate_system == UNSPECIFIED else metadata.coordinate_system
    behind = np.array([{"F": -1.0, "B": 1.0}.get(letter, 0.0) for letter in axes])
    first, second = (direction_at(frame.up, azimuth, 0.0) for azimuth in (0.0, 90.0))
    x, y = float(np.sum(behind * first)), float(np.sum(behind * second))
    front = math.degrees(math.atan2(y, x)) if math.hypot(x, y) > _TINY else 0.0
    return [front + _ASIDE + turn * 360.0 / _TURNS for turn in range(_TURNS)]


def _box(points: F64) -> tuple[F64, F64]:
    """Return the lower and the upper corner of the box of points [P, 3], without a hundredth on each side."""
    low, high = np.quantile(points, _BOX_QUANTILES, axis=0)
    return low, high


def _is_room(points: F64, up: F64) -> bool:
    """Return True for a closed room: with floor, ceiling and three walls, and almost hollow.

    Objects rarely have a bottom, and rarely fill the corners of their box.

    Args:
        points: [P, 3].
        up: [3], unit length.
    """
    low, high = _box(points)
    with np.errstate(over="ignore", invalid="ignore"):
        places = np.clip((points - low) / np.maximum(high - low, _TINY), -1.0, 2.0)  # 0 to 1 in the box
        cells = np.nan_to_num(np.clip(places * _WALL_CELLS, 0, _WALL_CELLS - 1)).astype(np.int64)
    closed = np.zeros((3, 2), bool)
    for axis in range(3):
        u, v = (k for k in range(3) if k != axis)
        for side in range(2):
            near = np.abs(places[:, axis] - side) <= _WALL
            covered = np.unique(cells[near, u] * _WALL_CELLS + cells[near, v])
            closed[axis, side] = len(covered) >= _WALL_COVER * _WALL_CELLS**2
    vertical = int(np.argmax(np.abs(up)))
    inner = float(np.mean(np.all(np.abs(places - 0.5) < 0.25, axis=1)))
    sides = int(np.sum(np.delete(closed, vertical, axis=0)))
    return bool(closed[vertical].all()) and sides >= _WALLS and inner < _INNER

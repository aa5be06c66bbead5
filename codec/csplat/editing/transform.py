# SPDX-License-Identifier: Apache-2.0
"""Transform scenes: rotate, mirror, scale, translate, stretch, and convert axes.

The mirror image of a Gaussian is a Gaussian: its covariance M Σ Mᵀ is the same for M and -M, and either M or -M is a
rotation. Colours change by the parity of their SH bands. So axes can be converted to axes of either handedness.

Extra columns change with the scene if they mean normals or displacements (`SceneMetadata.semantic_of`).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import replace
from typing import Any, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from csplat import _spec
from csplat.errors import InputError
from csplat.model import SplatModel, normalise_quats, sh_degree_of, splat_dtype
from csplat.scene import Scene
from csplat.scene_metadata import UNSPECIFIED, VIEW, Direction, SceneMetadata, check_axes, unit_up, up_of_axes
from csplat.spherical_harmonics import evaluate_sh
from csplat.types import F32, F64

_Rows = TypeVar("_Rows", F32, F64)

_OPPOSITE = dict(zip("RLUDFB", "LRDUBF", strict=True))
#: Axes assumed for a scene that does not specify any; COLMAP and OpenCV use them.
DEFAULT_AXES = "RDF"
_ORTHOGONAL = 1e-6  # tolerance for the entries of M Mᵀ - 1
_HALF_TURN = 1e-12  # the cosine of half a turn is -1 within this; other rotations divide by 1 + cosine
_WHOLE = 1e-9  # entries of a computed rotation within this distance of an integer are rounded
_DIRECTIONS = 40  # number of directions in which rotated SH bands are fitted
_EVEN = 1e-6  # relative difference up to which a stretch counts as uniform: files store it in float32
_ROWS = 1024  # rows converted to float64 at a time, which fit in the cache


def axes_rotation(before: str, after: str) -> F64:
    """Return the matrix that converts coordinates from some axes to others.

    Args:
        before: directions of +x, +y and +z before, three letters as in `SplatModel`.
        after: directions of +x, +y and +z after.

    Returns:
        [3, 3] float64 of 0, 1 and -1; a reflection if the handedness changes.

    Examples:
        >>> import csplat.editing.transform
        >>> csplat.editing.transform.axes_rotation("RDF", "LUF").tolist()
        [[-1.0, 0.0, 0.0], [0.0, -1.0, 0.0], [0.0, 0.0, 1.0]]

    Raises:
        InputError: the letters are not valid axes.
    """
    check_axes(before)
    check_axes(after)
    return np.array([[(old == new) - float(old == _OPPOSITE[new]) for old in before] for new in after]) + 0.0


def convert_axes(scene: Scene, axes: str) -> Scene:
    """Convert a scene to the axes of a format.

    A scene without named axes is assumed to have x right, y down and z forward. If it has an up direction, it is also
    rotated so that this is up.

    Args:
        scene: the scene.
        axes: directions of +x, +y and +z, three letters.
    """
    matrix = rotation_to_axes(scene.metadata, axes)

    def transform_block(model: SplatModel) -> SplatModel:
        turned = rotate_scene(model, matrix)
        return replace(turned, metadata=replace(turned.metadata, coordinate_system=axes))

    return scene if scene.metadata.coordinate_system == axes else scene.map(transform_block)


def rotate_scene(model: SplatModel, rotation: ArrayLike) -> SplatModel:
    """Rotate a scene about its zero: means, rotations, colours, normals, displacements, origin, up direction, cameras.

    If the matrix only permutes and flips axes, the result is exact for means, rotations and scales, and for SH if z
    stays on its line: rotating back restores the arrays bit for bit.

    Args:
        model: the scene, or some of its splats.
        rotation: [3, 3], orthogonal, applied to column vectors; with a reflection, cameras see mirror images.

    Returns:
        The scene. If the named axes are no longer coordinate axes, they are replaced by an up direction.

    Raises:
        InputError: the matrix is not orthogonal.
    """
    matrix = np.asarray(rotation, np.float64)
    if matrix.shape != (3, 3) or not _is_orthogonal(matrix):
        raise InputError(f"the rotation is {matrix.tolist()}, expected an orthogonal matrix [3, 3]")
    quats, scales = _rotate_shapes(model, matrix)
    x, y, z = (_multiply_rows(matrix, np.array(model.origin)) + 0.0).tolist()  # no negative zeros
    doubles = None if model.means_double is None else _multiply_rows(matrix, model.means_double)
    return replace(
        model,
        means=_multiply_rows(matrix, model.means) if doubles is None else (doubles - (x, y, z)).astype(np.float32),
        quats=quats,
        scales=scales,
        shN=_rotate_sh(model.shN, matrix),
        origin=(x, y, z),
        means_double=doubles,
        metadata=rotate_metadata(model.metadata, matrix),
        extra=_map_extra(model, matrix, matrix),
    )


def scale_scene(model: SplatModel, factor: float) -> SplatModel:
    """Multiply all lengths of a scene by a factor, displacements included.

    Raises:
        InputError: the factor is not above 0, or a value exceeds float32.
    """
    if not 0.0 < factor < np.inf:
        raise InputError(f"the factor is {factor}, expected a number above 0")
    with np.errstate(over="ignore"):
        origin = np.array(model.origin) * factor
        doubles = None if model.means_double is None else model.means_double * factor
        means = model.means.astype(np.float64) * factor if doubles is None else doubles - origin
        x, y, z = origin.tolist()
        metadata = _with_cameras(model.metadata, lambda camera: _scale_camera(camera, factor))
        unit = metadata.unit_metres
        return replace(
            model,
            means=means.astype(np.float32),
            scales=(model.scales.astype(np.float64) + np.log(factor)).astype(np.float32),
            origin=(x, y, z),
            means_double=doubles,
            metadata=replace(metadata, unit_metres=None if unit is None else unit / factor),
            extra=_map_extra(model, np.eye(3) * factor, np.eye(3)),
        )


def stretch_scene(model: SplatModel, matrix: ArrayLike) -> SplatModel:
    """Apply a linear map to a scene.

    Colours follow the rotation in the polar decomposition of the map, and normals stay perpendicular to their surfaces.
    Cameras are dropped unless it scales uniformly.

    Args:
        model: the scene, or some of its splats.
        matrix: [3, 3], of full rank, applied to column vectors.

    Raises:
        InputError: a value exceeds float32.
    """
    left, lengths, right = np.linalg.svd(np.asarray(matrix, np.float64))
    model = rotate_scene(model, _round_near_integers(left @ right))
    factor = float(lengths.mean())
    if np.ptp(lengths) < _EVEN * factor:
        return model if abs(factor - 1.0) < _WHOLE else scale_scene(model, factor)
    stretch: F64 = (left * lengths) @ left.T
    x, y, z = (stretch @ model.origin).tolist()
    doubles = None if model.means_double is None else _multiply_rows(stretch, model.means_double)
    with np.errstate(over="ignore"):
        root = stretch @ _rotation_matrices(model.quats) * np.exp(model.scales.astype(np.float64))[:, None]
        turns, axes, _ = np.linalg.svd(root)
        turns[:, :, 2] *= np.linalg.det(turns)[:, None]
        return replace(
            model,
            means=_multiply_rows(stretch, model.means) if doubles is None else (doubles - (x, y, z)).astype(np.float32),
            quats=normalise_quats(_quats_of(turns)),
            scales=np.log(np.maximum(axes, np.finfo(np.float32).tiny)).astype(np.float32),
            origin=(x, y, z),
            means_double=doubles,
            metadata=replace(model.metadata.with_entries(view=None), cameras=None),
            extra=_map_extra(model, stretch, (left / lengths) @ left.T),
        )


def translate_scene(model: SplatModel, offset: Direction) -> SplatModel:
    """Translate a scene by changing its means, because few formats store an origin."""
    step = np.array(offset, np.float64)
    doubles = None if model.means_double is None else model.means_double + step
    means = model.means + step if doubles is None else doubles - np.array(model.origin)
    metadata = _with_cameras(model.metadata, lambda camera: _translate_camera(camera, step))
    with np.errstate(over="ignore"):  # infinity is refused
        return replace(model, means=means.astype(np.float32), means_double=doubles, metadata=metadata)


def _map_extra(model: SplatModel, linear: F64, of_normals: F64) -> dict[str, NDArray[Any]]:
    """Return the extra columns of a model under a linear map; exact if it permutes and flips axes.

    Args:
        model: the model.
        linear: [3, 3], which maps displacements as it maps differences of means.
        of_normals: [3, 3], its inverse transpose or a multiple, which keeps normals perpendicular to their surfaces;
            they keep their lengths.

    Raises:
        InputError: a finite value exceeds the type of its column.
    """
    extra = dict(model.extra)
    for name, column in model.extra.items():
        semantic = model.metadata.semantic_of(name, splat_dtype(column))
        if semantic not in (_spec.SEMANTIC_NORMAL, _spec.SEMANTIC_MOTION):
            continue
        rows = column.reshape(-1, 3).astype(np.float64)
        with np.errstate(over="ignore", invalid="ignore"):
            mapped = _multiply_rows(of_normals if semantic == _spec.SEMANTIC_NORMAL else linear, rows)
            if semantic == _spec.SEMANTIC_NORMAL and not _is_orthogonal(of_normals):
                before, after = (np.linalg.norm(vectors, axis=1, keepdims=True) for vectors in (rows, mapped))
                mapped *= np.divide(before, after, out=np.ones_like(before), where=after > 0.0)
            mapped = mapped.astype(column.dtype)
        if not np.isfinite(mapped[np.isfinite(rows).all(axis=1)]).all():
            raise InputError(f"extra column {name!r} exceeds {column.dtype} after the change of the scene")
        extra[name] = mapped.reshape(column.shape)
    return extra


def _is_orthogonal(matrix: F64) -> bool:
    """Return True if M Mᵀ is the identity, up to rounding."""
    return bool((np.abs(matrix @ matrix.T - np.eye(3)) < _ORTHOGONAL).all())


def rotation_to_axes(metadata: SceneMetadata, axes: str) -> F64:
    """Return the matrix, [3, 3], that takes a scene to the target axes.

    For a scene without axes, the default axes are assumed. If its up direction is known, the result is tilted so that
    it becomes the up direction of the target axes.
    """
    known = metadata.coordinate_system != UNSPECIFIED
    matrix = axes_rotation(metadata.coordinate_system if known else DEFAULT_AXES, axes)
    up, target_up = metadata.stated_up, up_of_axes(axes)
    if known or up is None or target_up is None:
        return matrix
    tilted: F64 = _smallest_rotation(_multiply_rows(matrix, np.array(up, np.float64)), np.array(target_up)) @ matrix
    return tilted


def _smallest_rotation(start: F64, end: F64) -> F64:
    """Return the smallest rotation, [3, 3], that takes the unit vector `start` [3] to `end`.

    For opposite vectors, the axis is perpendicular to `start` and near the coordinate axis of its smallest component.
    """
    axis, cosine = np.cross(start, end), float(start @ end)
    if cosine < -1.0 + _HALF_TURN:  # half a turn about any perpendicular axis
        axis = np.eye(3)[int(np.abs(start).argmin())]
        axis -= start * (axis @ start)
        return _round_near_integers(2.0 * np.outer(axis, axis) / (axis @ axis) - np.eye(3))
    cross = np.array([[0.0, -axis[2], axis[1]], [axis[2], 0.0, -axis[0]], [-axis[1], axis[0], 0.0]])
    left, _, right = np.linalg.svd(np.eye(3) + cross + cross @ cross / (1.0 + cosine))
    return _round_near_integers(left @ right)  # orthogonal even if the vectors are unit to six digits only


def _multiply_rows(matrix: F64, rows: _Rows) -> _Rows:
    """Multiply rows [..., D] by a matrix [D, D]; exact if it only permutes and flips axes."""
    order = np.abs(matrix).argmax(axis=1)
    signs: F64 = matrix[np.arange(len(matrix)), order]
    out = np.empty_like(rows)
    if (np.abs(signs) == 1.0).all() and np.count_nonzero(matrix) == len(matrix):
        permuted = rows if (order == np.arange(len(order))).all() else rows[..., order]
        np.multiply(permuted, signs.astype(rows.dtype), out=out)
        return out
    with np.errstate(over="ignore"):  # `SplatModel` refuses infinite values
        for start in range(0, len(rows), _ROWS):
            part = slice(start, start + _ROWS)
            out[part] = rows[part].astype(np.float64) @ matrix.T
    return out


def _rotate_shapes(model: SplatModel, matrix: F64) -> tuple[F32, F32]:
    """Return the quats [N, 4] and scales [N, 3] of a model rotated by an orthogonal matrix [3, 3].

    A permutation of axes permutes the scales and is exact, unless it moves the third axis of a model of discs.
    """
    proper = matrix * np.sign(np.linalg.det(matrix))
    order = np.abs(matrix).argmax(axis=1)
    whole = np.count_nonzero(matrix) == 3
    # M R S Rᵀ Mᵀ = (M R Mᵀ) (M S Mᵀ) (M R Mᵀ)ᵀ, and M S Mᵀ is diagonal. The third scale of discs must stay the third.
    if whole and not (model.metadata.flat and order[2] != 2):
        turn = np.eye(4)
        turn[1:, 1:] = np.rint(proper)
        return _multiply_rows(turn, model.quats), model.scales[:, order]
    return normalise_quats(_multiply_rows(_left_product(_quats_of(proper)), model.quats)), model.scales


def _quats_of(matrix: F64) -> F64:
    """Convert rotation matrices [..., 3, 3] to quaternions: eigenvectors, accurate at any angle (Bar-Itzhack 2000)."""
    a, b, c, d, e, f, g, h, i = np.moveaxis(matrix.reshape(*matrix.shape[:-2], 9), -1, 0)
    lower = np.zeros((*matrix.shape[:-2], 4, 4))
    entries = (a + e + i, h - f, a - e - i, c - g, b + d, e - a - i, d - b, c + g, f + h, i - a - e)
    for row, column, entry in zip(*np.tril_indices(4), entries, strict=True):
        lower[..., row, column] = entry
    quats: F64 = np.linalg.eigh(lower)[1][..., 3]
    return np.where(quats[..., :1] < 0.0, -quats, quats)  # the signs of eigenvectors differ between machines


def _rotation_matrices(quats: F32) -> F64:
    """Return the rotation matrices [N, 3, 3] of quaternions [N, 4]."""
    w, x, y, z = normalise_quats(quats).astype(np.float64).T
    rows = [
        [1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y)],
        [2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x)],
        [2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)],
    ]
    return np.moveaxis(np.array(rows), 2, 0)


def _left_product(quat: F64) -> F64:
    """Return the matrix, [4, 4], of the left multiplication by a quaternion [4]."""
    w, x, y, z = quat
    return np.array([[w, -x, -y, -z], [x, w, -z, y], [y, z, w, -x], [z, -y, x, w]])


def _rotate_sh(shN: F32, matrix: F64) -> F32:
    """Rotate SH [N, K, 3] by M [3, 3], band by band: the colour in direction v becomes the colour in direction M v."""
    out = np.empty_like(shN)
    for band, turn in enumerate(sh_rotations(sh_degree_of(shN.shape[1]), matrix), start=1):
        part = slice(band**2 - 1, (band + 1) ** 2 - 1)
        shape = len(shN), 2 * band + 1, 3
        channels = np.kron(turn, np.eye(3)).astype(np.float64)  # rotates all three channels
        out[:, part] = _multiply_rows(channels, shN[:, part].reshape(len(shN), channels.shape[0])).reshape(shape)
    return out


def sh_rotations(degree: int, matrix: F64) -> list[F64]:
    """Return the matrices [2 l + 1, 2 l + 1] that rotate or mirror the coefficients of the bands l = 1 to `degree`.

    Args:
        degree: 0 to 4.
        matrix: [3, 3] orthogonal; the colour in direction v becomes the colour in direction `matrix` v.
    """
    directions = sphere_lattice(_DIRECTIONS)
    after, before = evaluate_sh(degree, directions), evaluate_sh(degree, directions @ matrix)  # row v is Mᵀ v before
    bands = [slice(band**2, (band + 1) ** 2) for band in range(1, degree + 1)]
    return [_round_near_integers(np.linalg.lstsq(after[:, band], before[:, band], rcond=None)[0]) for band in bands]


def _round_near_integers(matrix: NDArray[Any]) -> F64:
    """Replace elements within `_WHOLE` of an integer by that integer, so that permutations are exact."""
    whole = np.rint(matrix)
    snapped: F64 = np.where(np.abs(matrix - whole) < _WHOLE, whole, matrix)
    return snapped


def sphere_lattice(count: int) -> F64:
    """Return unit vectors [count, 3] spread evenly over the sphere, on a Fibonacci lattice."""
    index = np.arange(count) + 0.5
    height, angle = 1.0 - 2.0 * index / count, index * np.pi * (3.0 - np.sqrt(5.0))
    ring = np.sqrt(1.0 - height * height)
    return np.stack([ring * np.cos(angle), ring * np.sin(angle), height], axis=1)


def rotate_metadata(metadata: SceneMetadata, matrix: F64) -> SceneMetadata:
    """Rotate axes, up direction and cameras; axes that are no longer coordinate axes become an up direction."""
    letters, up = metadata.coordinate_system, metadata.stated_up
    metadata = _with_cameras(metadata, lambda camera: _rotate_camera(camera, matrix))
    if letters != UNSPECIFIED:
        whole = np.count_nonzero(matrix) == 3
        up = up_of_axes(letters) if up is None and not whole else up
        pairs = zip(np.abs(matrix).argmax(axis=1), matrix.sum(axis=1), strict=True)
        named = "".join(letters[old] if sign > 0.0 else _OPPOSITE[letters[old]] for old, sign in pairs)
        metadata = replace(metadata, coordinate_system=named if whole else UNSPECIFIED)
    return metadata if up is None else metadata.with_entries(up=list(unit_up((matrix @ up).tolist())))


def _with_cameras(metadata: SceneMetadata, change: Callable[[Mapping[str, Any]], dict[str, Any]]) -> SceneMetadata:
    """Return metadata with `change` applied to the cameras and the view; a view that is not a valid camera is kept."""
    if metadata.cameras:
        metadata = replace(metadata, cameras=[change(camera) for camera in metadata.cameras])
    if VIEW in metadata.entries:
        with suppress(TypeError, ValueError, KeyError, IndexError):
            return metadata.with_entries(view=change(metadata.entries[VIEW]))
    return metadata


def _rotate_camera(camera: Mapping[str, Any], matrix: F64) -> dict[str, Any]:
    """Return a camera that sees a scene rotated by a matrix [3, 3] as before, horizontally flipped if that mirrors."""
    view, K = np.array(camera["viewmat"], np.float64), np.array(camera["K"], np.float64)
    view[:3, :3] = view[:3, :3] @ matrix.T
    if np.linalg.det(matrix) < 0.0:  # mirror the image horizontally, so that the view stays a rotation
        view[0] *= -1.0
        K[0, 2] = camera["W"] - K[0, 2]
    return {**camera, "viewmat": view.tolist(), "K": K.tolist()}


def _translate_camera(camera: Mapping[str, Any], step: F64) -> dict[str, Any]:
    """Return a camera that sees a scene translated by a step [3], scene units, as it saw the scene before."""
    view = np.array(camera["viewmat"], np.float64)
    view[:3, 3] -= view[:3, :3] @ step
    return {**camera, "viewmat": view.tolist()}


def _scale_camera(camera: Mapping[str, Any], factor: float) -> dict[str, Any]:
    """Return a camera of the scene with all lengths multiplied by a factor; its near plane is scaled, too."""
    view = np.array(camera["viewmat"], np.float64)
    view[:3, 3] *= factor
    near = {"near": camera["near"] * factor} if "near" in camera else {}
    return {**camera, "viewmat": view.tolist(), **near}

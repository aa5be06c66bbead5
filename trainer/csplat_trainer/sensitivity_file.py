# SPDX-License-Identifier: Apache-2.0
"""Files of sensitivities: an array per group, and a digest of the scene. Requires NumPy, but not the renderer."""

from __future__ import annotations

import hashlib
import math
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from csplat.archives import read_archive
from csplat.encoder import GaussNewtonBlocks, Importance
from csplat.errors import InputError
from csplat.model import SplatModel

if TYPE_CHECKING:
    from csplat_trainer.sensitivity import Sensitivity


#: Arrays [N] float32 of a file, as in `Sensitivity`.
GROUPS = (
    "colour", "opacity", "shape", "opacity_net", "shape_net",
    "colour_squares", "opacity_squares", "shape_squares", "means_squares",
)  # fmt: skip

#: Kinds of views that sensitivities are measured in.
SOURCES = ("training", "cameras", "virtual")

_FORMAT = "csplat sensitivity 2"
_ARRAYS = ("means", "quats", "scales", "opacities", "sh0", "shN")
_CHANNELS = 3.0
_SHAPE = 6.0  # entries of a covariance
_FLOOR = 0.01  # weight of splats that no view shows, as a fraction of the median, since other views may show them


@dataclass(frozen=True, eq=False)
class StoredSensitivity:
    """Contents of a sensitivity file.

    Attributes:
        groups: [N] float32 by name, see `GROUPS`; a file has all of them.
        views: [N] int32, number of views that saw each splat.
        source: kind of views, one of `SOURCES`.
        view_count: number of views.
        missed_share: fraction of the splats that only held-out views saw; NaN if no views were held out.
        shape_matrices: [N, 21] float32, upper triangles of the Gauss–Newton matrices of the covariance over its trace,
            see `Sensitivity.shape_metric`, scaled to a mean diagonal of 1.
        matrices: [N, B (B + 1) / 2] float16, upper triangles of the Gauss–Newton matrices of the SH bands 0 to d,
            scaled to a mean diagonal of 1 above band 0; or `None`.
    """

    groups: dict[str, NDArray[np.float32]]
    views: NDArray[np.int32]
    source: str
    view_count: int
    missed_share: float
    shape_matrices: NDArray[np.float32]
    matrices: NDArray[np.float16] | None

    @classmethod
    def of(
        cls, model: SplatModel, sensitivity: Sensitivity, source: str = "virtual", missed_share: float = float("nan")
    ) -> StoredSensitivity:
        """Return the contents of a file for the measured sensitivities of a scene."""
        return cls(
            {name: group.astype(np.float32) for name in GROUPS if (group := getattr(sensitivity, name)) is not None},
            sensitivity.views.astype(np.int32),
            source,
            sensitivity.view_count,
            missed_share,
            _over_mean(sensitivity.shape_metric, sensitivity.shape_squares / 6.0),
            None if sensitivity.metric is None or not model.sh_degree else _pack(sensitivity.metric),
        )

    @property
    def seen(self) -> NDArray[np.bool_]:
        """[N] bool, True for splats that any view saw."""
        return np.asarray(self.views > 0, np.bool_)

    def importance(self) -> Importance:
        """Return the importance for the encoder; splats that no view saw get `_FLOOR` of the median weight."""
        matrices = self.matrices, self.shape_matrices
        return Importance(
            self._apply_floor("colour_squares"), self._apply_floor("shape_squares"), *matrices, self._curvatures()
        )

    def _curvatures(self) -> GaussNewtonBlocks:
        """Return the Gauss–Newton blocks by attribute, 0 for splats that no view shows."""
        opacity, shape, means = (self.groups[f"{name}_squares"] / _CHANNELS for name in ("opacity", "shape", "means"))
        return GaussNewtonBlocks(
            opacity, self.shape_matrices * (shape / _SHAPE)[:, None], means, self.groups["colour_squares"]
        )

    def _apply_floor(self, name: str) -> NDArray[np.float32]:
        """Return a group [N], with `_FLOOR` of its positive median, or 1 without any, for splats that no view saw."""
        weights = self.groups[name]
        positive = weights[weights > 0.0]
        least = np.float32(_FLOOR * float(np.median(positive))) if len(positive) else np.float32(1.0)
        return np.where(self.seen, weights, least)


def scene_digest(model: SplatModel) -> str:
    """Return the SHA-256 of the arrays of a scene, in hexadecimal digits."""
    digest = hashlib.sha256()
    for name in _ARRAYS:
        array: NDArray[np.float32] = np.ascontiguousarray(getattr(model, name), "<f4")
        digest.update(f"{name}{array.shape}".encode())
        digest.update(array.data)
    return digest.hexdigest()


def write_sensitivity(
    stream: BinaryIO, model: SplatModel, sensitivity: Sensitivity, source: str, missed_share: float = float("nan")
) -> None:
    """Write the measured sensitivities of a scene; `source` and `missed_share` as in `StoredSensitivity`."""
    stored = StoredSensitivity.of(model, sensitivity, source, missed_share)
    arrays: dict[str, Any] = dict(stored.groups)
    if stored.matrices is not None:
        arrays["matrices"] = stored.matrices
    np.savez(
        stream,
        format=np.array(_FORMAT),
        scene=np.array(scene_digest(model)),
        source=np.array(source),
        view_count=np.array(sensitivity.view_count),
        missed_share=np.array(missed_share),
        views=stored.views,
        shape_matrices=stored.shape_matrices,
        **arrays,
    )


def read_sensitivity(path: str | Path, model: SplatModel) -> StoredSensitivity:
    """Read the sensitivities of a scene.

    Raises:
        InputError: the file is damaged, of another kind, or belongs to another scene.
        OSError: the file cannot be read.
    """
    arrays = read_archive(path, "a file of sensitivities (`csplat sensitivity` makes them)")
    if str(arrays["format"]) != _FORMAT:
        arrays.refuse(f"its format is {str(arrays['format'])!r}, expected {_FORMAT!r}")
    if any(arrays[name].shape for name in ("scene", "source", "view_count", "missed_share")):
        arrays.refuse("it has lists, expected single values")
    try:
        stored = StoredSensitivity(
            {name: arrays[name] for name in GROUPS},
            arrays["views"],
            str(arrays["source"]),
            int(arrays["view_count"]),
            float(arrays["missed_share"]),
            arrays["shape_matrices"],
            arrays.get("matrices"),
        )
    except (ValueError, TypeError, OverflowError) as error:
        arrays.refuse(error)
    matrices: list[NDArray[Any]] = [stored.shape_matrices, *([] if stored.matrices is None else [stored.matrices])]
    kinds = {array.dtype.kind for array in (*stored.groups.values(), *matrices)}
    if (kinds, stored.views.dtype.kind, stored.views.ndim) != ({"f"}, "i", 1):
        arrays.refuse("its arrays have unexpected types or shapes")
    if any(array.ndim != 2 or len(array) != len(stored.views) for array in matrices):
        arrays.refuse("its matrices and views are of different splats")
    shape = (len(model),)
    if any(array.shape != shape for array in (*stored.groups.values(), stored.views)):
        raise InputError(f"{path} is of {len(stored.views)} splats, but the scene has {len(model)}")
    if str(arrays["scene"]) != scene_digest(model):
        raise InputError(f"{path} belongs to another scene: its splats differ")
    if not all(np.isfinite(array).all() for array in (*stored.groups.values(), *matrices)):
        arrays.refuse("it holds values that are not finite")
    return stored


def _pack(metric: NDArray[np.float32]) -> NDArray[np.float16]:
    """Return the upper triangles, divided by the mean of the diagonals above band 0."""
    rows, columns = np.triu_indices(_matrix_size(metric))
    mean = metric[:, (rows == columns) & (rows > 0)].mean(axis=1, dtype=np.float64)
    return _over_mean(metric, mean).astype(np.float16)


def _over_mean(triangles: NDArray[Any], mean: NDArray[np.float64]) -> NDArray[np.float32]:
    """Return triangles [N, D (D + 1) / 2] divided by the mean of their diagonals [N].

    Splats that no view shows get the unit matrix.
    """
    seen = mean > 0.0
    scaled = np.empty(triangles.shape, np.float32)
    np.divide(triangles, np.where(seen, mean, 1.0)[:, None], out=scaled, casting="same_kind")
    rows, columns = np.triu_indices(_matrix_size(triangles))
    scaled[~seen] = rows == columns
    return scaled


def _matrix_size(triangles: NDArray[Any]) -> int:
    """Return D of triangles [N, D (D + 1) / 2]."""
    return (math.isqrt(8 * int(triangles.shape[1]) + 1) - 1) // 2
